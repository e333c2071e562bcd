"""Write SkeletonGroup messages in little-endian CDR, byte for byte as the generic writer does.

The tables of the model are those of ``kernels.cdr``. There is no check per byte: ``out`` is as
large as the largest message of so many people, or nothing is written.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import C1, I1, I2, U1
from hiros_mcap.kernels.bytes import load64, store32, store64, to_word
from hiros_mcap.kernels.cdr import (
    BOX,
    MIN_PERSON,
    NANO,
    STATE,
    Bytes,
    Table,
    Tables,
    Words,
    align4,
    align8,
)
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import ORIENTATION, POSE, Floats, People

# Faults of a frame.
SHAPE = 1
STAMP = 2

_SLACK = 16

_ABSENT = np.uint64(0x7FF8000000000000)  # the NaN of numpy
_SIGN = np.uint64(1 << 63)
_INFINITY = np.uint64(0x7FF0000000000000)  # every larger magnitude is a NaN
_ONE = np.uint64(1)


class Messages(NamedTuple):
    """Fields of N messages besides their people."""

    texts: C1
    places: I2
    """(N, 4) first byte of ``texts`` and the one after the last, of frame_id and of src_frame."""
    stamps: I1  # (N,) ns
    rows: I2  # (N, 2) first row of the people, and the row after the last


class Format(NamedTuple):
    """Which numbers are written, how exactly, and what all messages say of the model."""

    columns: int
    """How many of the numbers of a KinematicState: all, or the pose only. The others are NaN."""
    dropped: int  # how many of the 52 bits of the mantissa are rounded away, the lowest ones
    boxed: int
    """Whether bounding boxes are those of the markers; else they are written as they are given."""
    max_markers: int
    max_links: int


@kernel
def _rounded(word: Any, dropped: int) -> Any:
    """Round the bits of a float64 to the nearest, ties away from zero.

    Infinities and NaNs keep their bits. So do finite numbers that would become infinite.
    """
    unit = _ONE << np.uint64(dropped)
    magnitude = ((word & ~_SIGN) + (unit >> _ONE)) & ~(unit - _ONE)
    return word if magnitude >= _INFINITY else magnitude | (word & _SIGN)


@kernel
def _pad8(out: Bytes, at: int) -> int:
    store64(out, at, np.uint64(0))
    return align8(at)


@kernel
def _put(out: Bytes, at: int, value: int) -> int:
    store32(out, at, np.uint32(value))
    return at + 4


@kernel
def _put_numbers(out: Bytes, at: int, values: Floats, first: int, n: int, dropped: int) -> int:
    for k in range(n):
        store64(out, at + 8 * k, _rounded(load64(values, 8 * (first + k)), dropped))
    return at + 8 * n


@kernel
def _put_state(out: Bytes, at: int, values: Floats, first: int, columns: int, dropped: int) -> int:
    """Write a KinematicState, of which so many columns are not left out."""
    at = _put_numbers(out, at, values, first, columns, dropped)
    for _ in range(STATE - columns):
        store64(out, at, _ABSENT)
        at += 8
    return at


@kernel
def _put_stamp(out: Bytes, at: int, stamp: int) -> int:
    seconds = stamp // NANO
    at = _put(out, at, seconds)
    return _put(out, at, stamp - seconds * NANO)


@kernel
def _put_string(out: Bytes, at: int, text: Bytes) -> int:
    at = _put(out, at, len(text) + 1)
    for k in range(len(text)):
        out[at + k] = text[k]
    at += len(text)
    store32(out, at, np.uint32(0))  # the NUL and the padding up to a multiple of four
    return align4(at + 1)


@kernel
def _has_seconds(stamp: int) -> bool:
    """Whether the seconds fit the message's int32."""
    return -2147483648 <= stamp // NANO <= 2147483647


@kernel
def _is_present(states: Floats, first: int, confidence: float, columns: int) -> bool:
    """Whether any of the numbers that would be written is known."""
    present = not np.isnan(confidence)
    k = first
    while not present and k < first + columns:
        present = not np.isnan(states[k])
        k += 1
    return present


@kernel
def _put_element(out: Bytes, at: int, table: Table, slot: int, words: Words) -> int:
    """Write what a marker or a link starts with: its id, its name and a link's ends."""
    first, length = table[slot, 1], table[slot, 2]
    for k in range((length + 7) >> 3):
        store64(out, at + 8 * k, words[first + k])
    at += length
    if table.shape[1] == 5:
        store32(out, at, np.uint32(0))
        at = _put(out, _put(out, align4(at), table[slot, 3]), table[slot, 4])
    return _pad8(out, at)


@kernel
def _put_elements(
    out: Bytes, at: int, table: Table, words: Words, states: Floats, confidences: Floats,
    person: int, form: Format,
) -> int:  # fmt: skip
    """Write the markers or the links of a person that are present, after their count."""
    count_at, count = at, 0
    at += 4
    width = len(states) // max(len(confidences), 1)
    columns = min(width, form.columns)
    for slot in range(len(table)):
        row = person * len(table) + slot
        if _is_present(states, row * width, confidences[row], columns):
            count += 1
            at = _put_element(out, at, table, slot, words)
            at = _put_numbers(out, at, confidences, row, 1, form.dropped)
            at = _put_state(out, at, states, row * width, columns, form.dropped)
    _put(out, count_at, count)
    return at


@kernel
def _span(flat: People, person: int, count: int, axis: int) -> tuple[float, float]:
    """Return the least and the greatest coordinate of a person's ``count`` markers; NaN = none."""
    least, greatest = np.nan, np.nan
    markers, width = flat.markers, len(flat.markers) // max(len(flat.marker_confidences), 1)
    for m in range(count):
        at = (person * count + m) * width
        if np.isnan(markers[at] + markers[at + 1] + markers[at + 2]):
            continue
        x = markers[at + axis]
        least = x if not least <= x else least
        greatest = x if not greatest >= x else greatest
    return least, greatest


@kernel
def _put_number(out: Bytes, at: int, value: float, dropped: int) -> int:
    store64(out, at, _rounded(to_word(value), dropped))
    return at + 8


@kernel
def _put_box(out: Bytes, at: int, person: int, n_markers: int, flat: People, form: Format) -> int:
    """Write a bounding box: as given, or the smallest along the frame's axes with all markers.

    Height is along z, length along x, width along y. Of a person without markers the box is
    written as given.
    """
    x0, x1 = _span(flat, person, n_markers, 0)
    if not form.boxed or np.isnan(x0):
        at = _put_state(out, at, flat.boxes, person * BOX, form.columns, form.dropped)
        return _put_numbers(out, at, flat.boxes, person * BOX + STATE, BOX - STATE, form.dropped)
    y0, y1 = _span(flat, person, n_markers, 1)
    z0, z1 = _span(flat, person, n_markers, 2)
    for value in (0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (z0 + z1), 0.0, 0.0, 0.0, 1.0):
        at = _put_number(out, at, value, form.dropped)
    for _ in range(STATE - ORIENTATION.stop):
        store64(out, at, _ABSENT)
        at += 8
    for value in (z1 - z0, x1 - x0, y1 - y0):
        at = _put_number(out, at, value, form.dropped)
    return at


@kernel
def _size(n_people: int, texts: int, marker_table: Table, link_table: Table) -> int:
    """Bytes that are enough for any message of so many people, with the padding."""
    person = MIN_PERSON + texts + 2 * _SLACK
    for slot in range(len(marker_table)):
        person += marker_table[slot, 2] + 8 * (1 + STATE) + _SLACK
    for slot in range(len(link_table)):
        person += link_table[slot, 2] + 8 * (2 + STATE) + _SLACK
    return 24 + texts + n_people * person + 2 * _SLACK


@kernel
def _put_person(
    out: Bytes, at: int, source: Bytes, person: int, model: Tables, flat: People, form: Format
) -> int:
    """Write a person; ``flat`` are arrays of one dimension."""
    at = _put_stamp(out, _put(out, at, flat.ids[person]), flat.stamps[person])
    at = _put_string(out, at, source)
    at = _pad8(out, _put(out, _put(out, at, form.max_markers), form.max_links))
    at = _put_numbers(out, at, flat.confidences, person, 1, form.dropped)
    at = _put_box(out, at, person, len(model.markers), flat, form)
    at = _put_elements(
        out, at, model.markers, model.words, flat.markers, flat.marker_confidences, person, form
    )
    return _put_elements(
        out, at, model.links, model.words, flat.links, flat.link_confidences, person, form
    )


@kernel
def _put_message(
    out: Bytes, messages: Messages, i: int, model: Tables, flat: People, form: Format
) -> int:
    """Write message ``i``, which ``out`` has room for; return its length, or minus a fault."""
    begin, end = messages.rows[i, 0], messages.rows[i, 1]
    in_range = _has_seconds(messages.stamps[i])
    for person in range(begin, end):
        in_range &= _has_seconds(flat.stamps[person])
    if not in_range:
        return -STAMP
    places = messages.places[i]
    source = messages.texts[places[2] : places[3]]
    at = _put_stamp(out, _put(out, 0, 0x0100), messages.stamps[i])
    at = _put(out, _put_string(out, at, messages.texts[places[0] : places[1]]), end - begin)
    for person in range(begin, end):
        at = _put_person(out, at, source, person, model, flat, form)
    return at


@kernel
def _fits(people: People, model: Tables) -> bool:
    """Whether the arrays are for the same people, and for this model."""
    n, m, n_links = len(people.ids), len(model.markers), len(model.links)
    return (
        len(people.stamps) == n and len(people.confidences) == n and people.boxes.shape == (n, BOX)
        and people.markers.shape[:2] == (n, m) and people.marker_confidences.shape == (n, m)
        and people.links.shape[:2] == (n, n_links)
        and POSE <= people.markers.shape[2] <= STATE and POSE <= people.links.shape[2] <= STATE
        and people.link_confidences.shape == (n, n_links)
    )  # fmt: skip


@entry
def encode(
    out: U1, messages: Messages, model: Tables, people: People, form: Format, ends: I1
) -> int:  # fmt: skip
    """Write messages, little-endian, one after the other into ``out``.

    Parameters
    ----------
    messages, people : what is written. model : its markers and links.
    form : which numbers are written, and how exactly.
    ends : (N,) byte after each message that was written.

    Returns
    -------
    How many messages were written. If there is no room for the first one, minus the size that
    ``out`` must have; -SHAPE or -STAMP for frames that cannot be written.
    """
    if not _fits(people, model):
        return -SHAPE
    flat = People(
        people.ids, people.stamps, people.confidences, people.markers.reshape(-1),
        people.marker_confidences.reshape(-1), people.links.reshape(-1),
        people.link_confidences.reshape(-1), people.boxes.reshape(-1),
    )  # fmt: skip
    at = 0
    for i in range(len(messages.rows)):
        places = messages.places[i]
        texts = places[1] - places[0] + places[3] - places[2]
        n_people = messages.rows[i, 1] - messages.rows[i, 0]
        size = at + _size(n_people, texts, model.markers, model.links)
        if len(out) < size:
            return i if i > 0 else -size
        length = _put_message(out[at:], messages, i, model, flat, form)
        if length < 0:
            return length
        at += length
        ends[i] = at
    return len(messages.rows)
