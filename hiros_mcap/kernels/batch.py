"""Decode, clean and move all messages of some chunks in one call, without Python's lock."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import C1, I1, I2
from hiros_mcap.kernels.cdr import (
    COUNT,
    FRAME,
    FRAME_END,
    LINK_ENDS_AT,
    OK,
    TOO_NARROW,
    Tables,
    decode,
    is_same_text,
    read_header,
    slot_of,
)
from hiros_mcap.kernels.compile import entry, kernel, rows_of
from hiros_mcap.kernels.people_rows import PoseArrays, move
from hiros_mcap.skeletons import BOX, ORIENTATION, STATE, VELOCITY, Floats, People, Stamps

START, STOP = 0, 1


# Numbers that cannot be true become NaN. An absent quaternion or vector is NaN throughout.

LIMIT = 1e4  # largest believable number: m, m/s, rad/s, m/s2, rad/s2

# Elements of the counts.
COUNTS = 8
ABSURD, INCOMPLETE, NO_ROTATION, NOT_UNIT, ABOVE_ONE, NEGATIVE, NOBODY, COPY = range(COUNTS)
KINDS = (
    "absurd number", "incomplete vector", "quaternion of length 0", "quaternion normalised",
    "confidence above 1", "negative confidence", "nobody", "copy",
)  # fmt: skip
"""Names of the counts in reports."""

_QUATERNION = ORIENTATION.start

_UNIT = 1e-6  # a quaternion of float32 numbers is this far from unit length: left as it is
_NOTICE = 1e-3  # farther off than this is worth a note (rounding to three digits, say)
_SHORTEST = 1e-6  # shorter than this it has no direction
SAME = 1e-3  # m; no two people have joints so near to each other
TELLING = 3  # joints at the same places


@kernel
def _vector(state: Floats, first: int, n: int, counts: Stamps) -> bool:
    """Unset ``n`` numbers that belong together unless all are believable; return if they are."""
    unknown = 0
    absurd = False
    for k in range(first, first + n):
        unknown += np.isnan(state[k])
        absurd |= abs(state[k]) > LIMIT
    if not absurd and (unknown == 0 or unknown == n):
        return unknown == 0
    counts[ABSURD if absurd else INCOMPLETE] += 1
    for k in range(first, first + n):
        state[k] = np.nan
    return False


@kernel
def _rotation(state: Floats, counts: Stamps) -> None:
    """Give the quaternion the length 1, or unset it."""
    if not _vector(state, _QUATERNION, 4, counts):
        return
    square = 0.0
    for k in range(_QUATERNION, _QUATERNION + 4):
        square += state[k] * state[k]
    norm = np.sqrt(square)
    if abs(norm - 1.0) <= _UNIT:
        return
    if norm < _SHORTEST:
        counts[NO_ROTATION] += 1
        norm = np.nan
    elif abs(norm - 1.0) > _NOTICE:
        counts[NOT_UNIT] += 1
    for k in range(_QUATERNION, _QUATERNION + 4):
        state[k] /= norm


@kernel
def _state(state: Floats, counts: Stamps) -> None:
    _vector(state, 0, 3, counts)
    for first in range(VELOCITY.start, min(len(state), STATE), 3):
        _vector(state, first, 3, counts)
    _rotation(state, counts)


@kernel
def _confidence(confidences: Floats, k: int, counts: Stamps) -> None:
    value = confidences[k]
    if np.isinf(value):
        counts[ABSURD] += 1
        confidences[k] = np.nan
    elif value > 1.0:
        counts[ABOVE_ONE] += 1
        confidences[k] = 1.0
    elif value < 0.0:
        counts[NEGATIVE] += 1
        confidences[k] = np.nan


@kernel
def _is_zero(states: Floats, p: int, n: int) -> bool:
    """Whether the position of state (p, n) is exactly 0 0 0."""
    return states[p, n, 0] == 0.0 and states[p, n, 1] == 0.0 and states[p, n, 2] == 0.0


@kernel
def _unset(states: Floats, p: int, n: int, confidences: Floats) -> None:
    """Make state (p, n) absent."""
    for k in range(states.shape[2]):
        states[p, n, k] = np.nan
    confidences[p, n] = np.nan


@kernel
def take_out_zeros(people: People, tables: Tables, zeros: Stamps) -> None:
    """Make markers at exactly 0 0 0 absent, in place: detectors write so what they did not see.

    No joint is where the camera is, to the last bit. The confidence does not matter. A link is
    absent, too, if one of its ends is: its numbers were made of the 0 0 0. ``zeros`` (M,) are added
    to, but not for a person with no other marker, who is nobody.
    """
    markers = people.markers
    for person in range(len(people.ids)):
        found, shown = 0, False
        for slot in range(markers.shape[1]):
            if _is_zero(markers, person, slot):
                found += 1
            else:
                shown |= not math.isnan(markers[person, slot, 0])
        if not found:
            continue
        for link in range(people.links.shape[1]):
            for end in range(2):
                slot = slot_of(tables.markers, tables.links[link, LINK_ENDS_AT + end])
                if slot >= 0 and _is_zero(markers, person, slot):
                    _unset(people.links, person, link, people.link_confidences)
        for slot in range(markers.shape[1]):
            if _is_zero(markers, person, slot):
                _unset(markers, person, slot, people.marker_confidences)
                zeros[slot] += shown


@kernel
def _is_somebody(markers: Floats, person: int) -> bool:
    """Whether any marker of a person is there."""
    for slot in range(markers.shape[1]):
        if not math.isnan(markers[person, slot, 0]):
            return True
    return False


@kernel
def clean(people: People, counts: Stamps) -> None:
    """Take out numbers that cannot be true, in place; ``counts`` (COUNTS,) are added to.

    - ABSURD: infinite or beyond 1e4 (m, m/s, ...): its whole vector becomes NaN;
    - INCOMPLETE: some numbers of a vector are NaN: all become NaN;
    - NO_ROTATION: a quaternion of length 0 becomes NaN;
    - NOT_UNIT: a quaternion's length was off by more than 1e-3. It becomes 1, also after smaller
      errors, which are not counted;
    - ABOVE_ONE: a confidence becomes 1; an infinite one is absurd;
    - NEGATIVE: a confidence becomes NaN, since detectors mean by -1 that they give none;
    - NOBODY: a person without any marker, who stays here and is left out by whoever decodes.
    """
    for person in range(len(people.ids)):
        _confidence(people.confidences, person, counts)
        _state(people.boxes[person], counts)
        _vector(people.boxes[person], STATE, BOX - STATE, counts)
        for slot in range(people.markers.shape[1]):
            _confidence(people.marker_confidences[person], slot, counts)
            _state(people.markers[person, slot], counts)
        for slot in range(people.links.shape[1]):
            _confidence(people.link_confidences[person], slot, counts)
            _state(people.links[person, slot], counts)
        counts[NOBODY] += not _is_somebody(people.markers, person)


@kernel
def _joints_of_both(markers: Floats, one: int, other: int) -> tuple[int, int, int]:
    """Return how many joints two people have at the same places, and each of them alone.

    All are 0 as soon as a joint is at two places.
    """
    both, first, second = 0, 0, 0
    for slot in range(markers.shape[1]):
        here, there = markers[one, slot], markers[other, slot]
        if math.isnan(here[0]) or math.isnan(there[0]):
            first += not math.isnan(here[0])
            second += not math.isnan(there[0])
            continue
        for axis in range(3):
            if abs(here[axis] - there[axis]) > SAME:
                return 0, 0, 0
        both += 1
    return both, first, second


@kernel
def take_out_copies(data: C1, people: People, sources: I2, counts: Stamps) -> None:
    """Leave one of several people of a camera who have the same joints at the same places.

    A detector, or whoever collects its messages, has put one person into the message twice. The
    one with more joints stays. The other has no marker any more; ``counts`` (COUNTS,) are added to.
    ``sources`` are the places of each person's src_frame in the message ``data``.
    """
    markers = people.markers
    telling = min(TELLING, markers.shape[1])
    for other in range(1, len(people.ids)):
        for one in range(other):
            both, first, second = _joints_of_both(markers, one, other)
            if both >= telling and is_same_text(data, sources[one], sources[other]):
                copy = other if first >= second else one
                markers[copy] = np.nan
                people.links[copy] = np.nan
                counts[COPY] += 1
                if copy == other:
                    break


# All messages of some chunks.


class Results(NamedTuple):
    """Faults, rows and counts of N messages and their P people."""

    first: I1  # (N + 1,) row of each message's first person, and P
    codes: I1  # (N,) OK or a fault of kernels.cdr
    reports: I2  # (N, REPORT) report of kernels.cdr
    pose_of: I1
    """(N,) pose that moves the message's people, -1 = none; chosen between the two kernels."""
    cleaned: I2  # (N, COUNTS) numbers that were taken out, by kind (KINDS)
    sources: I2
    """(P, 2) first byte of each person's src_frame in its message, and the one after the last."""
    zeros: I2
    """(N, M) people of each message, of whom it has a marker at exactly 0 0 0."""


# As short as it is, giving up the GIL would take longer.
@entry(nogil=False)
def read_headers(data: C1, places: I2, message: int, first: I1, reports: I2) -> None:
    """Find out how many people each message holds, 0 where its beginning is damaged.

    ``places`` (n, 2) are the first byte of each message in ``data`` and the one after its last.
    They are messages number ``message``, ``message + 1``, ... of ``first`` and ``reports``, which
    are those of :class:`Results`. A report says where frame_id is: nowhere in a damaged message.
    """
    for k in range(len(places)):
        i = message + k
        fault, _, _ = read_header(data[places[k, START] : places[k, STOP]], reports[i])
        first[i + 1] = first[i] + (reports[i, COUNT] if fault == OK else 0)
        if fault != OK:
            reports[i, FRAME] = reports[i, FRAME_END] = 0


@entry
def decode_messages(
    data: C1, places: I2, message: int, tables: Tables, results: Results, people: People,
    poses: PoseArrays, seen: I1, exact: bool,
) -> bool:  # fmt: skip
    """Fill the people's arrays from messages, take out numbers that cannot be true, and move.

    ``places`` and ``message`` are as for :func:`read_headers`; ``seen`` is scratch of M + L. With
    ``exact`` the numbers stay as they are in the messages. Returns False as soon as a message holds
    numbers that the arrays have no columns for.
    """
    for k in range(len(places)):
        i = message + k
        begin, end = results.first[i], results.first[i + 1]
        mine = rows_of(people, begin, end)
        data_of, sources = data[places[k, START] : places[k, STOP]], results.sources[begin:end]
        results.codes[i] = decode(data_of, tables, mine, sources, seen, results.reports[i])
        if results.codes[i] == TOO_NARROW:
            return False
        if results.codes[i] != OK or exact:
            continue
        take_out_zeros(mine, tables, results.zeros[i])
        clean(mine, results.cleaned[i])
        take_out_copies(data_of, mine, sources, results.cleaned[i])
        if results.pose_of[i] >= 0:
            move(poses, results.pose_of[i], mine)
    return True
