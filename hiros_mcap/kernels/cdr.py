"""Read SkeletonGroup messages in CDR, byte by byte (DDSI-RTPS 10.2, XCDR version 1).

A message is four bytes of encapsulation, then the fields in order, each aligned to its size
counted from byte 4. Strings carry their length with the final NUL, sequences their count. Nothing
is read before it is known to lie inside the buffer. Machines are taken to be little-endian, as
every platform of numba is.

A marker starts with (id, length of name, name, NUL), a link likewise: these bytes are the same in
every message, so the codec prepares them once per slot, as 64-bit words padded with zeros. The
decoder compares them with the message instead of parsing, the encoder copies them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hiros_mcap.kernels.array_types import C1, I1, I2, W1
from hiros_mcap.kernels.bytes import copy, load32, load64, swap32, swap64, to_double
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import BOX as BOX
from hiros_mcap.skeletons import STATE as STATE
from hiros_mcap.skeletons import Floats, People

# A message is right, or has one of the faults, or the arrays have no columns for its numbers.
OK, TRUNCATED, ENCAPSULATION, TRAILING, STRING_LENGTH, STRING_END, NANOSEC, TOO_MANY = range(8)
# Those of a link follow those of a marker.
UNKNOWN_MARKER, UNKNOWN_LINK, MARKER_NAME, LINK_NAME, LINK_ENDS = range(8, 13)
REPEATED_MARKER, REPEATED_LINK, TOO_NARROW = range(13, 16)

MAX_PEOPLE = 1000
MAX_STRING = 65536
# RTPS pads a payload to a multiple of four bytes, and some recorders keep that padding.
MAX_PADDING = 3

# Added to a negative id that no marker has: beyond every int32, and that id again in 32 bits.
ABSENT = 1 << 32

# Elements of a report: where a message is at fault, and what it holds besides its people. An
# outline looks at no source: its counts have those places.
AT, PERSON, ID, NAME, NAME_END = range(5)
COUNT, HEADER_STAMP, FRAME, FRAME_END, SOURCE, SOURCE_END, MIXED, LEFT_OUT = range(5, 13)
ROWS, MOST_MARKERS, MOST_LINKS = 9, 10, 11
REPORT = 13

# Columns of an outline.
IS_LINK, ROW_ID, ROW_NAME, ROW_END, PARENT, CHILD = range(6)
OUTLINE = 6

# The fewest bytes that an element takes: its numbers and an empty string.
MIN_PERSON = 216
MIN_MARKER = 168
MIN_LINK = 176

ORIGIN = 4
NANO = 1_000_000_000

_INT32_MAX = 2**31 - 1

Bytes = npt.NDArray[np.uint8]
Table = npt.NDArray[np.int64]
Words = npt.NDArray[np.uint64]


class Tables(NamedTuple):
    """A skeleton model as messages are compared with it; ids increase from row to row."""

    markers: I2  # (M, 3) id, first of its prepared words, how many bytes they are
    links: I2
    """(L, 5) the same, then the ids of the parent and the child marker; ABSENT + an unused id
    stands for a marker that the log never shows."""
    words: W1  # prepared bytes of all slots
    is_open: bool  # whether markers and links that the model lacks are left out, and no fault


# Columns of the tables.
SLOT_ID, WORD, LENGTH, LINK_ENDS_AT = range(4)


class Slots(NamedTuple):
    """Where the markers, or the links, of a message go; arrays are flat, row after row."""

    table: Table
    seen: Table  # (n,) who had the slot last
    states: Floats
    confidences: Floats
    width: int  # columns of the states: STATE, or as many as come first


@kernel
def align4(at: int) -> int:
    """Return the next byte offset of a message that suits four bytes."""
    return (at + 3) & ~3


@kernel
def align8(at: int) -> int:
    """Return the next byte offset of a message that suits eight bytes."""
    return ((at - ORIGIN + 7) & ~7) + ORIGIN


@kernel
def _unsigned(data: Bytes, at: int, swap: bool) -> np.int64:
    word = load32(data, at)
    return np.int64(swap32(word) if swap else word)


@kernel
def _signed(data: Bytes, at: int, swap: bool) -> np.int64:
    word = load32(data, at)
    return np.int64(np.int32(swap32(word) if swap else word))


@kernel
def _double(data: Bytes, at: int, swap: bool) -> float:
    word = load64(data, at)
    return to_double(swap64(word) if swap else word)


@kernel
def _doubles(data: Bytes, at: int, swap: bool, out: Floats, first: int, n: int) -> None:
    if swap:
        for k in range(n):
            out[first + k] = _double(data, at + 8 * k, True)
    else:
        copy(out, 8 * first, data, at, 8 * n)


@kernel
def _string(data: Bytes, at: int, swap: bool) -> tuple[int, int, int, int]:
    """Return fault, first byte, the byte after the last one, and where the next field may start."""
    at = align4(at)
    if at + 4 > data.size:
        return TRUNCATED, at, 0, at
    length = _unsigned(data, at, swap)
    start = at + 4
    if length > data.size - start:
        return TRUNCATED, at, 0, at
    if length > MAX_STRING:
        return STRING_LENGTH, at, 0, at
    if length == 0:  # some writers give an empty string no NUL
        return OK, start, start, start
    if data[start + length - 1] != 0:
        return STRING_END, at, 0, at
    return OK, start, start + length - 1, start + length


@kernel
def _count(data: Bytes, at: int, swap: bool, smallest: int) -> tuple[int, int]:
    """Return the count of a sequence, -1 if that many elements cannot follow, and its end."""
    at = align4(at)
    if at + 4 > data.size:
        return -1, at
    count = _unsigned(data, at, swap)
    if count > (data.size - at - 4) // smallest:
        return -1, at
    return count, at + 4


@kernel
def _stamp(data: Bytes, at: int, swap: bool) -> tuple[int, int]:
    """Return fault and ns since the epoch; the eight bytes must be there."""
    nanosec = _unsigned(data, at + 4, swap)
    if nanosec >= NANO:
        return NANOSEC, 0
    return OK, _signed(data, at, swap) * NANO + nanosec


@kernel
def read_header(data: Bytes, report: Table) -> tuple[int, int, bool]:
    """Read up to the number of people; return fault, where they start, whether to swap bytes."""
    report[AT] = 0
    report[PERSON] = -1
    if data.size < ORIGIN:
        return TRUNCATED, 0, False
    if data[0] != 0 or data[1] > 1:
        return ENCAPSULATION, 0, False
    swap = data[1] == 0
    at = ORIGIN
    report[AT] = at
    if data.size < at + 8:
        return TRUNCATED, at, swap
    fault, report[HEADER_STAMP] = _stamp(data, at, swap)
    if fault != OK:
        return fault, at, swap
    fault, report[FRAME], report[FRAME_END], at = _string(data, at + 8, swap)
    report[AT] = at
    if fault != OK:
        return fault, at, swap
    report[COUNT], at = _count(data, at, swap, MIN_PERSON)
    report[AT] = at
    if report[COUNT] < 0:
        return TRUNCATED, at, swap
    if report[COUNT] > MAX_PEOPLE:
        return TOO_MANY, at, swap
    return OK, at, swap


@kernel
def _person(data: Bytes, at: int, swap: bool) -> tuple[int, int, int, int, int]:
    """Read id to src_frame; return fault, stamp, first byte and end of the string, and its end.

    On success the numbers up to the count of markers are known to lie in the buffer.
    """
    if at + 12 > data.size:
        return TRUNCATED, 0, 0, 0, at
    fault, stamp = _stamp(data, at + 4, swap)
    if fault != OK:
        return fault, 0, 0, 0, at
    fault, start, end, after = _string(data, at + 12, swap)
    if fault != OK:
        return fault, 0, 0, 0, after
    after = align4(after)
    if align8(after + 8) + 8 * (1 + BOX) > data.size:
        return TRUNCATED, 0, 0, 0, after
    return OK, stamp, start, end, after


@kernel
def _end(data: Bytes, at: int, report: Table) -> int:
    report[AT] = at
    report[PERSON] = -1
    return TRAILING if data.size - at > MAX_PADDING else OK


@kernel
def _element(data: Bytes, at: int, swap: bool, report: Table) -> tuple[int, int]:
    """Read the id and the name of a marker or a link into the report; return fault and end."""
    at = align4(at)
    report[AT] = at
    if at + 4 > data.size:
        return TRUNCATED, at
    report[ID] = _signed(data, at, swap)
    fault, report[NAME], report[NAME_END], after = _string(data, at + 4, swap)
    return fault, after


@entry
def outline(data: C1, rows: I2, report: I1) -> int:
    """List the markers and the links of a message: ids, names and ends.

    ``rows`` is (n, 6), n at least ``data.size // MIN_MARKER + 1``; the first ``report[ROWS]`` rows
    are filled, names by their place in ``data``. Returns OK or a fault.
    """
    fault, at, swap = read_header(data, report)
    if fault != OK:
        return fault
    n_rows = 0
    report[MOST_MARKERS] = 0
    report[MOST_LINKS] = 0
    for person in range(report[COUNT]):
        report[AT] = at = align4(at)
        report[PERSON] = person
        fault, _, _, _, at = _person(data, at, swap)
        if fault != OK:
            return fault
        report[MOST_MARKERS] = max(report[MOST_MARKERS], _unsigned(data, at, swap))
        report[MOST_LINKS] = max(report[MOST_LINKS], _unsigned(data, at + 4, swap))
        at = align8(at + 8) + 8 * (1 + BOX)
        for is_link in range(2):
            count, at = _count(data, at, swap, MIN_LINK if is_link else MIN_MARKER)
            report[AT] = at
            if count < 0:
                return TRUNCATED
            for _ in range(count):
                fault, at = _element(data, at, swap, report)
                if fault != OK:
                    return fault
                row = rows[n_rows]
                row[IS_LINK] = is_link
                row[ROW_ID] = report[ID]
                row[ROW_NAME] = report[NAME]
                row[ROW_END] = report[NAME_END]
                if is_link:
                    at = align4(at)
                    if at + 8 > data.size:
                        return TRUNCATED
                    row[PARENT] = _signed(data, at, swap)
                    row[CHILD] = _signed(data, at + 4, swap)
                    at += 8
                at = align8(at) + 8 * (1 + STATE)
                if at > data.size:
                    return TRUNCATED
                n_rows += 1
    report[ROWS] = n_rows
    return _end(data, at, report)


@kernel
def _starts_with(data: Bytes, at: int, words: Words, first: int, length: int) -> bool:
    """Whether the prepared bytes stand at ``at``; seven bytes more than they are may be read."""
    whole = length >> 3
    for k in range(whole):
        if load64(data, at + 8 * k) != words[first + k]:
            return False
    rest = length & 7
    if rest == 0:
        return True
    difference = load64(data, at + 8 * whole) ^ words[first + whole]
    return difference << np.uint64(64 - 8 * rest) == 0


@kernel
def _same_name(data: Bytes, start: int, end: int, words: Words, row: Table) -> bool:
    """Whether the bytes from ``start`` to ``end`` are the name within a row's prepared bytes."""
    if end - start != row[LENGTH] - 9:  # id, length and NUL
        return False
    for k in range(end - start):
        byte = words[row[WORD] + ((8 + k) >> 3)] >> np.uint64(8 * (k & 7)) & np.uint64(255)
        if byte != data[start + k]:
            return False
    return True


@kernel
def slot_of(table: Table, wanted: int) -> int:
    """Return the row of an id by bisection, -1 if it has none."""
    low, high = 0, len(table)
    while low < high:
        middle = (low + high) >> 1
        if table[middle, SLOT_ID] < wanted:
            low = middle + 1
        else:
            high = middle
    return low if low < len(table) and table[low, SLOT_ID] == wanted else -1


@kernel
def _identify(
    data: Bytes, at: int, swap: bool, guess: int, slots: Slots, words: Words, report: Table
) -> tuple[int, int, int]:
    """Read id and name of an element; return fault, slot and end.

    ``guess`` is the slot that comes next if nothing is left out. The faults are those of a marker.
    """
    at = align4(at)
    table = slots.table
    if not swap and guess < len(table):
        length = table[guess, LENGTH]
        first = table[guess, WORD]
        if at + length + 7 <= data.size and _starts_with(data, at, words, first, length):
            return OK, guess, at + length
    fault, after = _element(data, at, swap, report)
    if fault != OK:
        return fault, -1, after
    slot = slot_of(table, report[ID])
    if slot < 0:
        return UNKNOWN_MARKER, -1, after
    if not _same_name(data, report[NAME], report[NAME_END], words, table[slot]):
        return MARKER_NAME, slot, after
    return OK, slot, after


@kernel
def _numbers(data: Bytes, at: int, swap: bool, slots: Slots, row: int) -> int:
    """Read the confidence and the KinematicState of a row; return their end, or minus a fault."""
    at = align8(at)
    if at + 8 * (1 + STATE) > data.size:
        return -TRUNCATED
    slots.confidences[row] = _double(data, at, swap)
    _doubles(data, at + 8, swap, slots.states, row * slots.width, slots.width)
    absent = True
    for k in range(slots.width, STATE):
        absent &= math.isnan(_double(data, at + 8 + 8 * k, swap))
    return at + 8 * (1 + STATE) if absent else -TOO_NARROW


@kernel
def _leave_out(slots: Slots, person: int) -> None:
    """Mark as absent what the person does not have of the markers or links."""
    n = len(slots.table)
    for slot in range(n):
        if slots.seen[slot] != person:
            row = person * n + slot
            slots.confidences[row] = np.nan
            for k in range(row * slots.width, (row + 1) * slots.width):
                slots.states[k] = np.nan


@kernel
def _ends(data: Bytes, at: int, swap: bool, link: Table, markers: Table) -> tuple[int, int]:
    """Compare the parent and the child of a link with the model's; return fault and end."""
    at = align4(at)
    if at + 8 > data.size:
        return TRUNCATED, at
    for end in range(2):
        marker, expected = _signed(data, at + 4 * end, swap), link[LINK_ENDS_AT + end]
        is_absent = expected > _INT32_MAX and slot_of(markers, marker) < 0
        if not (marker == expected or is_absent):
            return LINK_ENDS, at
    return OK, at + 8


@kernel
def _elements(
    data: Bytes, at: int, swap: bool, slots: Slots, tables: Tables, report: Table
) -> tuple[int, int]:
    """Read the markers, or the links, of a person; return fault and end."""
    report[AT] = at
    is_link = slots.table.shape[1] > LINK_ENDS_AT
    count, at = _count(data, at, swap, MIN_LINK if is_link else MIN_MARKER)
    if count < 0:
        return TRUNCATED, at
    person, n, slot, left_out = report[PERSON], len(slots.table), -1, 0
    for _ in range(count):
        report[AT] = at
        fault, slot, at = _identify(data, at, swap, slot + 1, slots, tables.words, report)
        if fault == UNKNOWN_MARKER and tables.is_open:
            at = align8(align4(at) + 8 if is_link else at) + 8 * (1 + STATE)
            if at > data.size:
                return TRUNCATED, at
            left_out += 1
            continue
        if fault == OK:
            report[ID] = slots.table[slot, SLOT_ID]
            if is_link:
                fault, at = _ends(data, at, swap, slots.table[slot], tables.markers)
        if fault == OK and slots.seen[slot] == person:
            fault = REPEATED_MARKER
        if fault != OK:
            is_of_marker = fault in (UNKNOWN_MARKER, MARKER_NAME, REPEATED_MARKER)
            return fault + (1 if is_link and is_of_marker else 0), at
        slots.seen[slot] = person
        at = _numbers(data, at, swap, slots, person * n + slot)
        if at < 0:
            return -at, at
    if count - left_out < n:
        _leave_out(slots, person)
    report[LEFT_OUT] += left_out
    return OK, at


@kernel
def is_same_text(data: Bytes, one: Table, other: Table) -> bool:
    """Whether two texts of a message, by first byte and the one after the last, are equal."""
    if one[1] - one[0] != other[1] - other[0]:
        return False
    for k in range(one[1] - one[0]):
        if data[one[0] + k] != data[other[0] + k]:
            return False
    return True


@kernel
def decode(
    data: Bytes, tables: Tables, people: People, sources: Table, seen: Table, report: Table
) -> int:
    """Fill the arrays of a message's people; return OK, a fault, or TOO_NARROW.

    The arrays are for as many people as :func:`read_header` found. ``sources`` (P, 2) gets the
    places of their src_frame. ``seen`` is scratch of M + L. ``report`` says where a fault is, or
    the header's stamp and the places of the strings.
    """
    fault, at, swap = read_header(data, report)
    if fault != OK:
        return fault
    report[SOURCE] = 0
    report[SOURCE_END] = 0
    report[MIXED] = 0
    report[LEFT_OUT] = 0
    seen[:] = -1
    n = len(tables.markers)
    # Flat arrays and a row: a slice per row would cost more than its numbers.
    boxes = people.boxes.reshape(-1)
    markers = Slots(
        tables.markers, seen[:n], people.markers.reshape(-1), people.marker_confidences.reshape(-1),
        people.markers.shape[2],
    )  # fmt: skip
    links = Slots(
        tables.links, seen[n:], people.links.reshape(-1), people.link_confidences.reshape(-1),
        people.links.shape[2],
    )  # fmt: skip
    for person in range(len(people.ids)):
        report[AT] = at = align4(at)
        report[PERSON] = person
        fault, stamp, start, end, after = _person(data, at, swap)
        if fault != OK:
            return fault
        people.ids[person] = _signed(data, at, swap)
        people.stamps[person] = stamp
        sources[person, 0] = start
        sources[person, 1] = end
        if person == 0:
            report[SOURCE], report[SOURCE_END] = start, end
        elif not is_same_text(data, sources[0], sources[person]):
            report[MIXED] = 1
        at = align8(after + 8)
        people.confidences[person] = _double(data, at, swap)
        _doubles(data, at + 8, swap, boxes, person * BOX, BOX)
        fault, at = _elements(data, at + 8 * (1 + BOX), swap, markers, tables, report)
        if fault != OK:
            return fault
        fault, at = _elements(data, at, swap, links, tables, report)
        if fault != OK:
            return fault
    return _end(data, at, report)
