"""Write SkeletonGroup messages in little-endian CDR, byte for byte as the generic writer does.

The tables of the model are those of ``kernels.cdr``. There is no check per byte: ``out`` is as
large as the largest message of so many people, or nothing is written.
"""

# mypy: disable-error-code="no-any-return"
# (numba's decorator hides the types of the helpers from their callers)

from __future__ import annotations

import numpy as np
from numba import types

from hiros_mcap.kernels.bytes import copy, store32, store64
from hiros_mcap.kernels.cdr import BOX, MIN_PERSON, NANO, STATE, Bytes, Table, Words, align4, align8
from hiros_mcap.kernels.compile import kernel
from hiros_mcap.skeletons import Floats, Ints

# Faults of a frame.
SHAPE = 1
STAMP = 2

_SLACK = 16

_BYTES = types.Array(types.uint8, 1, "C", readonly=True)
_I1, _I2 = types.int64[::1], types.int64[:, ::1]
_F1, _F2, _F3 = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]


@kernel
def _pad8(out: Bytes, at: int) -> int:
    store64(out, at, np.uint64(0))
    return align8(at)


@kernel
def _put(out: Bytes, at: int, value: int) -> int:
    store32(out, at, np.uint32(value))
    return at + 4


@kernel
def _put_doubles(out: Bytes, at: int, values: Floats, first: int, n: int) -> int:
    copy(out, at, values, 8 * first, 8 * n)
    return at + 8 * n


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
def _is_present(states: Floats, confidences: Floats, row: int) -> bool:
    present = not np.isnan(confidences[row])
    k = row * STATE
    while not present and k < (row + 1) * STATE:
        present = not np.isnan(states[k])
        k += 1
    return present


@kernel
def _put_elements(
    out: Bytes,
    at: int,
    table: Table,
    words: Words,
    states: Floats,
    confidences: Floats,
    person: int,
) -> int:
    """Write the markers or the links of a person that are present, after their count."""
    count_at = at
    count = 0
    at += 4
    for slot in range(len(table)):
        row = person * len(table) + slot
        if not _is_present(states, confidences, row):
            continue
        count += 1
        first, length = table[slot, 1], table[slot, 2]
        for k in range((length + 7) >> 3):
            store64(out, at + 8 * k, words[first + k])
        at += length
        if table.shape[1] == 5:
            store32(out, at, np.uint32(0))
            at = _put(out, _put(out, align4(at), table[slot, 3]), table[slot, 4])
        at = _put_doubles(out, _pad8(out, at), confidences, row, 1)
        at = _put_doubles(out, at, states, row * STATE, STATE)
    _put(out, count_at, count)
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
def _encode(
    out: Bytes,
    frame_id: Bytes,
    source: Bytes,
    stamp: int,
    most: Table,
    marker_table: Table,
    link_table: Table,
    words: Words,
    ids: Ints,
    stamps: Table,
    confidences: Floats,
    flat_markers: Floats,
    flat_marker_confidences: Floats,
    flat_links: Floats,
    flat_link_confidences: Floats,
    flat_boxes: Floats,
    begin: int,
    end: int,
) -> int:
    """Write the message of the people from row ``begin`` to ``end``, which ``out`` has room for."""
    if not _has_seconds(stamp):
        return -STAMP
    at = _put(out, 0, 0x0100)
    at = _put_string(out, _put_stamp(out, at, stamp), frame_id)
    at = _put(out, at, end - begin)
    for person in range(begin, end):
        if not _has_seconds(stamps[person]):
            return -STAMP
        at = _put_stamp(out, _put(out, at, ids[person]), stamps[person])
        at = _put_string(out, at, source)
        at = _pad8(out, _put(out, _put(out, at, most[0]), most[1]))
        at = _put_doubles(out, at, confidences, person, 1)
        at = _put_doubles(out, at, flat_boxes, person * BOX, BOX)
        at = _put_elements(
            out, at, marker_table, words, flat_markers, flat_marker_confidences, person
        )
        at = _put_elements(out, at, link_table, words, flat_links, flat_link_confidences, person)
    return at


@kernel(
    types.int64(
        types.uint8[::1], types.int64, types.int64, _BYTES, _I2, _I1, _I2, _I1,
        _I2, _I2, types.uint64[::1], types.int32[::1], _I1, _F1, _F3, _F2, _F3, _F2, _F2, _I1,
    ),
)  # fmt: skip
def encode(
    out: Bytes,
    gap: int,
    limit: int,
    names: Bytes,
    name_places: Table,
    message_stamps: Table,
    rows: Table,
    most: Table,
    marker_table: Table,
    link_table: Table,
    words: Words,
    ids: Ints,
    stamps: Table,
    confidences: Floats,
    markers: Floats,
    marker_confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    boxes: Floats,
    ends: Table,
) -> int:
    """Write messages, little-endian, one after the other into ``out``.

    Parameters
    ----------
    gap : bytes that are left free before each message.
    limit : no message is begun at this byte of ``out`` or later; the first one is.
    names, name_places : texts; (N, 4) first byte and the one after the last, of each message's
        frame_id and of its people's src_frame.
    message_stamps, rows : (N,) ns; (N, 2) first row of its people, and the row after the last.
    most : max_markers and max_links.
    marker_table, link_table, words : of the model. ids to boxes : (P, ...).
    ends : (N,) byte after each message that was written.

    Returns
    -------
    How many messages were written. If there is no room for the first one, minus the size that
    ``out`` must have; -SHAPE or -STAMP for frames that cannot be written.
    """
    n, m, n_links = len(ids), len(marker_table), len(link_table)
    if (
        len(stamps) != n or len(confidences) != n or boxes.shape != (n, BOX)
        or markers.shape != (n, m, STATE) or marker_confidences.shape != (n, m)
        or links.shape != (n, n_links, STATE) or link_confidences.shape != (n, n_links)
    ):  # fmt: skip
        return -SHAPE
    at = 0
    for i in range(len(rows)):
        begin, end = rows[i, 0], rows[i, 1]
        texts = name_places[i, 1] - name_places[i, 0] + name_places[i, 3] - name_places[i, 2]
        size = at + gap + _size(end - begin, texts, marker_table, link_table)
        if i > 0 and (at >= limit or len(out) < size):
            return i
        if len(out) < size:
            return -size
        at += gap
        length = _encode(
            out[at:], names[name_places[i, 0] : name_places[i, 1]],
            names[name_places[i, 2] : name_places[i, 3]], message_stamps[i], most, marker_table,
            link_table, words, ids, stamps, confidences, markers.reshape(-1),
            marker_confidences.reshape(-1), links.reshape(-1), link_confidences.reshape(-1),
            boxes.reshape(-1), begin, end,
        )  # fmt: skip
        if length < 0:
            return length
        at += length
        ends[i] = at
    return len(rows)
