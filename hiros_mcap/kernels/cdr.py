"""Read and write SkeletonGroup messages in CDR, byte by byte (DDSI-RTPS 10.2, XCDR version 1).

A message is four bytes of encapsulation, then the fields in order, each aligned to its size
counted from byte 4. Strings carry their length with the final NUL, sequences their count. Nothing
is read before it is known to lie inside the buffer. Machines are taken to be little-endian, as
every platform of numba is.

A marker starts with (id, length of name, name, NUL), a link likewise: these bytes are the same in
every message, so the codec prepares them once per slot, as 64-bit words padded with zeros. The
decoder compares them with the message instead of parsing, the encoder copies them.

Tables, one row per slot, ids increasing::

    marker_table  (M, 3) int64   id, first word of its prepared bytes, how many bytes
    link_table    (L, 5) int64   the same, then the ids of the parent and the child marker,
                                 ABSENT for a marker that the log never shows
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

OK = 0
# Faults of a message.
TRUNCATED = 1
ENCAPSULATION = 2
TRAILING = 3
STRING_LENGTH = 4
STRING_END = 5
NANOSEC = 6
TOO_MANY = 7
UNKNOWN_MARKER = 8
UNKNOWN_LINK = 9
MARKER_NAME = 10
LINK_NAME = 11
LINK_ENDS = 12
REPEATED_MARKER = 13
REPEATED_LINK = 14
# What the caller has to put right.
PEOPLE = 20  # the arrays are for another number of people
# Faults of a frame.
SHAPE = 30
STAMP = 31

MAX_PEOPLE = 1000
MAX_STRING = 65536
# RTPS pads a payload to a multiple of four bytes, and some recorders keep that padding.
MAX_PADDING = 3

# No int32, so it is no id; written as 32 bits it is -1.
ABSENT = 0xFFFFFFFF

# Elements of the report.
AT, PERSON, ID, NAME, NAME_LENGTH = 0, 1, 2, 3, 4
COUNT, HEADER_STAMP, FRAME, FRAME_LENGTH, SOURCE, SOURCE_LENGTH, MIXED = 5, 6, 7, 8, 9, 10, 11
ROWS, MOST_MARKERS, MOST_LINKS = 9, 10, 11
REPORT = 12

# Columns of an outline.
IS_LINK, ROW_ID, ROW_NAME, ROW_LENGTH, PARENT, CHILD = 0, 1, 2, 3, 4, 5
OUTLINE = 6

# The fewest bytes that an element takes: its numbers and an empty string.
MIN_PERSON = 216
MIN_MARKER = 168
MIN_LINK = 176

_ORIGIN = 4
_STATE = 19
_BOX = 22
_NANO = 1_000_000_000
_SLACK = 16

_BYTES = types.Array(types.uint8, 1, "C", readonly=True)
_OUT = types.uint8[::1]
_WORDS = types.uint64[::1]
_I1, _I2 = types.int64[::1], types.int64[:, ::1]
_F1, _F2, _F3 = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]


def _place(context, builder, array_type, array, offset, bits):  # type: ignore[no-untyped-def]
    """Emit the pointer to ``bits`` bits at a byte offset of an array of bytes."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [offset]), ir.IntType(bits).as_pointer())


def _loader(bits, result):  # type: ignore[no-untyped-def]
    """Make a load of an integer at any byte offset: numba has none that is not aligned."""

    @intrinsic
    def load(typing_context, data, offset):  # type: ignore[no-untyped-def]
        def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
            pointer = _place(context, builder, signature.args[0], args[0], args[1], bits)
            word = builder.load(pointer)
            word.align = 1
            return word

        return result(data, types.int64), generate

    return load


def _storer(bits, value_type):  # type: ignore[no-untyped-def]
    """Make a store of an integer at any byte offset."""

    @intrinsic
    def store(typing_context, data, offset, value):  # type: ignore[no-untyped-def]
        def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
            pointer = _place(context, builder, signature.args[0], args[0], args[1], bits)
            builder.store(args[2], pointer).align = 1
            return context.get_dummy_value()

        return types.void(data, types.int64, value_type), generate

    return store


def _caster(source, target, bits):  # type: ignore[no-untyped-def]
    """Make a change of type that keeps the 64 bits, the payload of a NaN included."""

    @intrinsic
    def cast(typing_context, value):  # type: ignore[no-untyped-def]
        def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return builder.bitcast(args[0], bits)

        return target(source), generate

    return cast


@intrinsic
def _swap32(typing_context, value):  # type: ignore[no-untyped-def]
    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.bswap(args[0])

    return types.uint32(types.uint32), generate


@intrinsic
def _swap64(typing_context, value):  # type: ignore[no-untyped-def]
    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.bswap(args[0])

    return types.uint64(types.uint64), generate


_load32 = _loader(32, types.uint32)
_load64 = _loader(64, types.uint64)
_store32 = _storer(32, types.uint32)
_store64 = _storer(64, types.uint64)
_to_double = _caster(types.uint64, types.float64, ir.DoubleType())
_to_word = _caster(types.float64, types.uint64, ir.IntType(64))


# --- reading -----------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _align4(at: int) -> int:
    return (at + 3) & ~3


@njit(cache=True, nogil=True)
def _align8(at: int) -> int:
    return ((at - _ORIGIN + 7) & ~7) + _ORIGIN


@njit(cache=True, nogil=True)
def _unsigned(data: np.ndarray, at: int, swap: bool) -> int:
    word = _load32(data, at)
    return np.int64(_swap32(word) if swap else word)


@njit(cache=True, nogil=True)
def _signed(data: np.ndarray, at: int, swap: bool) -> int:
    word = _load32(data, at)
    return np.int64(np.int32(_swap32(word) if swap else word))


@njit(cache=True, nogil=True)
def _double(data: np.ndarray, at: int, swap: bool) -> float:
    word = _load64(data, at)
    return _to_double(_swap64(word) if swap else word)


@njit(cache=True, nogil=True)
def _doubles(data: np.ndarray, at: int, swap: bool, out: np.ndarray, n: int) -> None:
    if swap:
        for k in range(n):
            out[k] = _to_double(_swap64(_load64(data, at + 8 * k)))
    else:
        for k in range(n):
            out[k] = _to_double(_load64(data, at + 8 * k))


@njit(cache=True, nogil=True)
def _string(data: np.ndarray, at: int, swap: bool) -> tuple[int, int, int, int]:
    """Return fault, first byte, bytes without the NUL, and where the next field may start."""
    at = _align4(at)
    if at + 4 > data.size:
        return TRUNCATED, at, 0, at
    length = _unsigned(data, at, swap)
    start = at + 4
    if length > data.size - start:
        return TRUNCATED, at, 0, at
    if length > MAX_STRING:
        return STRING_LENGTH, at, 0, at
    if length == 0:  # some writers give an empty string no NUL
        return OK, start, 0, start
    if data[start + length - 1] != 0:
        return STRING_END, at, 0, at
    return OK, start, length - 1, start + length


@njit(cache=True, nogil=True)
def _count(data: np.ndarray, at: int, swap: bool, smallest: int) -> tuple[int, int]:
    """Return the count of a sequence, -1 if that many elements cannot follow, and its end."""
    at = _align4(at)
    if at + 4 > data.size:
        return -1, at
    count = _unsigned(data, at, swap)
    if count > (data.size - at - 4) // smallest:
        return -1, at
    return count, at + 4


@njit(cache=True, nogil=True)
def _stamp(data: np.ndarray, at: int, swap: bool) -> tuple[int, int]:
    """Return fault and ns since the epoch; the eight bytes must be there."""
    nanosec = _unsigned(data, at + 4, swap)
    if nanosec >= _NANO:
        return NANOSEC, 0
    return OK, _signed(data, at, swap) * _NANO + nanosec


@njit(cache=True, nogil=True)
def _header(data: np.ndarray, report: np.ndarray) -> tuple[int, int, bool]:
    """Read up to the number of people; return fault, where they start, whether to swap bytes."""
    report[AT] = 0
    report[PERSON] = -1
    if data.size < _ORIGIN:
        return TRUNCATED, 0, False
    if data[0] != 0 or data[1] > 1:
        return ENCAPSULATION, 0, False
    swap = data[1] == 0
    at = _ORIGIN
    report[AT] = at
    if data.size < at + 8:
        return TRUNCATED, at, swap
    fault, report[HEADER_STAMP] = _stamp(data, at, swap)
    if fault != OK:
        return fault, at, swap
    fault, report[FRAME], report[FRAME_LENGTH], at = _string(data, at + 8, swap)
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


@njit(cache=True, nogil=True)
def _person(data: np.ndarray, at: int, swap: bool) -> tuple[int, int, int, int, int]:
    """Read id to src_frame; return fault, stamp, the string's place and length, and the end.

    On success the numbers up to the count of markers are known to lie in the buffer.
    """
    if at + 12 > data.size:
        return TRUNCATED, 0, 0, 0, at
    fault, stamp = _stamp(data, at + 4, swap)
    if fault != OK:
        return fault, 0, 0, 0, at
    fault, start, length, after = _string(data, at + 12, swap)
    if fault != OK:
        return fault, 0, 0, 0, after
    after = _align4(after)
    if _align8(after + 8) + 8 * (1 + _BOX) > data.size:
        return TRUNCATED, 0, 0, 0, after
    return OK, stamp, start, length, after


@njit(cache=True, nogil=True)
def _end(data: np.ndarray, at: int, report: np.ndarray) -> int:
    report[AT] = at
    report[PERSON] = -1
    return TRAILING if data.size - at > MAX_PADDING else OK


@njit(cache=True, nogil=True)
def _element(data: np.ndarray, at: int, swap: bool, report: np.ndarray) -> tuple[int, int]:
    """Read the id and the name of a marker or a link into the report; return fault and end."""
    at = _align4(at)
    report[AT] = at
    if at + 4 > data.size:
        return TRUNCATED, at
    report[ID] = _signed(data, at, swap)
    fault, report[NAME], report[NAME_LENGTH], after = _string(data, at + 4, swap)
    return fault, after


@njit(types.int64(_BYTES, _I2, _I1), cache=True, nogil=True)
def outline(data: np.ndarray, rows: np.ndarray, report: np.ndarray) -> int:
    """List the markers and the links of a message: ids, names and ends.

    ``rows`` is (n, 6), n at least ``data.size // MIN_MARKER + 1``; the first ``report[ROWS]`` rows
    are filled, names by their place in ``data``. Returns OK or a fault.
    """
    fault, at, swap = _header(data, report)
    if fault != OK:
        return fault
    n_rows = 0
    report[MOST_MARKERS] = 0
    report[MOST_LINKS] = 0
    for person in range(report[COUNT]):
        report[AT] = at = _align4(at)
        report[PERSON] = person
        fault, _, _, _, at = _person(data, at, swap)
        if fault != OK:
            return fault
        report[MOST_MARKERS] = max(report[MOST_MARKERS], _unsigned(data, at, swap))
        report[MOST_LINKS] = max(report[MOST_LINKS], _unsigned(data, at + 4, swap))
        at = _align8(at + 8) + 8 * (1 + _BOX)
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
                row[ROW_LENGTH] = report[NAME_LENGTH]
                if is_link:
                    at = _align4(at)
                    if at + 8 > data.size:
                        return TRUNCATED
                    row[PARENT] = _signed(data, at, swap)
                    row[CHILD] = _signed(data, at + 4, swap)
                    at += 8
                at = _align8(at) + 8 * (1 + _STATE)
                if at > data.size:
                    return TRUNCATED
                n_rows += 1
    report[ROWS] = n_rows
    return _end(data, at, report)


@njit(cache=True, nogil=True)
def _starts_with(data: np.ndarray, at: int, words: np.ndarray, first: int, length: int) -> bool:
    """Whether the prepared bytes stand at ``at``; seven bytes more than they are may be read."""
    whole = length >> 3
    for k in range(whole):
        if _load64(data, at + 8 * k) != words[first + k]:
            return False
    rest = length & 7
    if rest == 0:
        return True
    difference = _load64(data, at + 8 * whole) ^ words[first + whole]
    return difference << np.uint64(64 - 8 * rest) == 0


@njit(cache=True, nogil=True)
def _same_name(
    data: np.ndarray, start: int, length: int, words: np.ndarray, row: np.ndarray
) -> bool:
    """Whether the ``length`` bytes at ``start`` are the name within a row's prepared bytes."""
    if length != row[2] - 9:  # id, length and NUL
        return False
    for k in range(length):
        byte = words[row[1] + ((8 + k) >> 3)] >> np.uint64(8 * (k & 7)) & np.uint64(255)
        if byte != data[start + k]:
            return False
    return True


@njit(cache=True, nogil=True)
def _slot(table: np.ndarray, wanted: int) -> int:
    """Return the row of an id by bisection, -1 if it has none."""
    low, high = 0, len(table)
    while low < high:
        middle = (low + high) >> 1
        if table[middle, 0] < wanted:
            low = middle + 1
        else:
            high = middle
    return low if low < len(table) and table[low, 0] == wanted else -1


@njit(cache=True, nogil=True)
def _identify(
    data: np.ndarray,
    at: int,
    swap: bool,
    guess: int,
    table: np.ndarray,
    words: np.ndarray,
    report: np.ndarray,
) -> tuple[int, int, int]:
    """Read id and name of an element; return fault, slot and end.

    ``guess`` is the slot that comes next if nothing is left out. The faults are those of a marker.
    """
    at = _align4(at)
    if not swap and guess < len(table):
        length = table[guess, 2]
        if at + length + 7 <= data.size and _starts_with(data, at, words, table[guess, 1], length):
            return OK, guess, at + length
    fault, after = _element(data, at, swap, report)
    if fault != OK:
        return fault, -1, after
    slot = _slot(table, report[ID])
    if slot < 0:
        return UNKNOWN_MARKER, -1, after
    if not _same_name(data, report[NAME], report[NAME_LENGTH], words, table[slot]):
        return MARKER_NAME, slot, after
    return OK, slot, after


@njit(cache=True, nogil=True)
def _numbers(
    data: np.ndarray, at: int, swap: bool, states: np.ndarray, confidences: np.ndarray, slot: int
) -> int:
    """Read the confidence and the KinematicState of a slot; return their end, -1 if truncated."""
    at = _align8(at)
    if at + 8 * (1 + _STATE) > data.size:
        return -1
    confidences[slot] = _double(data, at, swap)
    _doubles(data, at + 8, swap, states[slot], _STATE)
    return at + 8 * (1 + _STATE)


@njit(cache=True, nogil=True)
def _leave_out(seen: np.ndarray, person: int, states: np.ndarray, confidences: np.ndarray) -> None:
    """Mark as absent what the person does not have."""
    for slot in range(len(seen)):
        if seen[slot] != person:
            confidences[slot] = np.nan
            for k in range(_STATE):
                states[slot, k] = np.nan


@njit(cache=True, nogil=True)
def _markers(
    data: np.ndarray,
    at: int,
    swap: bool,
    table: np.ndarray,
    words: np.ndarray,
    seen: np.ndarray,
    report: np.ndarray,
    states: np.ndarray,
    confidences: np.ndarray,
) -> tuple[int, int]:
    """Read the markers of a person; return fault and end."""
    report[AT] = at
    count, at = _count(data, at, swap, MIN_MARKER)
    if count < 0:
        return TRUNCATED, at
    slot = -1
    for _ in range(count):
        report[AT] = at
        fault, slot, at = _identify(data, at, swap, slot + 1, table, words, report)
        if fault != OK:
            return fault, at
        if seen[slot] == report[PERSON]:
            report[ID] = table[slot, 0]
            return REPEATED_MARKER, at
        seen[slot] = report[PERSON]
        at = _numbers(data, at, swap, states, confidences, slot)
        if at < 0:
            return TRUNCATED, at
    _leave_out(seen, report[PERSON], states, confidences)
    return OK, at


@njit(cache=True, nogil=True)
def _is_end(marker: int, expected: int, marker_table: np.ndarray) -> bool:
    """Whether a link's parent or child is the marker that the model has there."""
    return marker == expected or (expected == ABSENT and _slot(marker_table, marker) < 0)


@njit(cache=True, nogil=True)
def _links(
    data: np.ndarray,
    at: int,
    swap: bool,
    marker_table: np.ndarray,
    table: np.ndarray,
    words: np.ndarray,
    seen: np.ndarray,
    report: np.ndarray,
    states: np.ndarray,
    confidences: np.ndarray,
) -> tuple[int, int]:
    """Read the links of a person; return fault and end."""
    report[AT] = at
    count, at = _count(data, at, swap, MIN_LINK)
    if count < 0:
        return TRUNCATED, at
    slot = -1
    for _ in range(count):
        report[AT] = at
        fault, slot, at = _identify(data, at, swap, slot + 1, table, words, report)
        if fault == UNKNOWN_MARKER:
            return UNKNOWN_LINK, at
        if fault == MARKER_NAME:
            return LINK_NAME, at
        if fault != OK:
            return fault, at
        report[ID] = table[slot, 0]
        at = _align4(at)
        if at + 8 > data.size:
            return TRUNCATED, at
        for end in range(2):
            if not _is_end(_signed(data, at + 4 * end, swap), table[slot, 3 + end], marker_table):
                return LINK_ENDS, at
        if seen[slot] == report[PERSON]:
            return REPEATED_LINK, at
        seen[slot] = report[PERSON]
        at = _numbers(data, at + 8, swap, states, confidences, slot)
        if at < 0:
            return TRUNCATED, at
    _leave_out(seen, report[PERSON], states, confidences)
    return OK, at


@njit(cache=True, nogil=True)
def _note_source(
    data: np.ndarray, person: int, start: int, length: int, report: np.ndarray
) -> None:
    """Keep the first person's src_frame and whether another one differs."""
    if person == 0:
        report[SOURCE] = start
        report[SOURCE_LENGTH] = length
        return
    if length != report[SOURCE_LENGTH]:
        report[MIXED] = 1
        return
    for k in range(length):
        if data[start + k] != data[report[SOURCE] + k]:
            report[MIXED] = 1
            return


@njit(
    types.int64(
        _BYTES, _I2, _I2, _WORDS, _I1, _I1, _I2,
        types.int32[::1], _I1, _F1, _F3, _F2, _F3, _F2, _F2,
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def decode(
    data: np.ndarray,
    marker_table: np.ndarray,
    link_table: np.ndarray,
    words: np.ndarray,
    seen: np.ndarray,
    report: np.ndarray,
    sources: np.ndarray,
    ids: np.ndarray,
    stamps: np.ndarray,
    confidences: np.ndarray,
    markers: np.ndarray,
    marker_confidences: np.ndarray,
    links: np.ndarray,
    link_confidences: np.ndarray,
    boxes: np.ndarray,
) -> int:
    """Fill the arrays of a Frame of P people from a message.

    ``seen`` is scratch of M + L; ``report`` (12,) says where a fault is, or else the header's
    stamp and the places of the strings; ``sources`` (MAX_PEOPLE, 2) gets the places of src_frame.
    Returns OK, a fault, or PEOPLE when the message has ``report[COUNT]`` people instead of P.
    """
    fault, at, swap = _header(data, report)
    if fault != OK:
        return fault
    if report[COUNT] != len(ids):
        return PEOPLE
    report[SOURCE_LENGTH] = 0
    report[MIXED] = 0
    n_markers = len(marker_table)
    for slot in range(len(seen)):
        seen[slot] = -1
    for person in range(len(ids)):
        report[AT] = at = _align4(at)
        report[PERSON] = person
        fault, stamp, start, length, after = _person(data, at, swap)
        if fault != OK:
            return fault
        ids[person] = _signed(data, at, swap)
        stamps[person] = stamp
        sources[person, 0] = start
        sources[person, 1] = length
        _note_source(data, person, start, length, report)
        at = _align8(after + 8)
        confidences[person] = _double(data, at, swap)
        _doubles(data, at + 8, swap, boxes[person], _BOX)
        fault, at = _markers(
            data, at + 8 * (1 + _BOX), swap, marker_table, words, seen[:n_markers], report,
            markers[person], marker_confidences[person],
        )  # fmt: skip
        if fault != OK:
            return fault
        fault, at = _links(
            data, at, swap, marker_table, link_table, words, seen[n_markers:], report,
            links[person], link_confidences[person],
        )  # fmt: skip
        if fault != OK:
            return fault
    return _end(data, at, report)


# --- writing -----------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _pad8(out: np.ndarray, at: int) -> int:
    _store64(out, at, np.uint64(0))
    return _align8(at)


@njit(cache=True, nogil=True)
def _put(out: np.ndarray, at: int, value: int) -> int:
    _store32(out, at, np.uint32(value))
    return at + 4


@njit(cache=True, nogil=True)
def _put_doubles(out: np.ndarray, at: int, values: np.ndarray, n: int) -> int:
    for k in range(n):
        _store64(out, at + 8 * k, _to_word(values[k]))
    return at + 8 * n


@njit(cache=True, nogil=True)
def _put_stamp(out: np.ndarray, at: int, stamp: int) -> int:
    seconds = stamp // _NANO
    at = _put(out, at, seconds)
    return _put(out, at, stamp - seconds * _NANO)


@njit(cache=True, nogil=True)
def _put_string(out: np.ndarray, at: int, text: np.ndarray) -> int:
    at = _put(out, at, len(text) + 1)
    for k in range(len(text)):
        out[at + k] = text[k]
    at += len(text)
    _store32(out, at, np.uint32(0))  # the NUL and the padding up to a multiple of four
    return _align4(at + 1)


@njit(cache=True, nogil=True)
def _has_seconds(stamp: int) -> bool:
    """Whether the seconds fit the message's int32."""
    return -2147483648 <= stamp // _NANO <= 2147483647


@njit(cache=True, nogil=True)
def _is_present(state: np.ndarray, confidence: float) -> bool:
    present = not np.isnan(confidence)
    k = 0
    while not present and k < _STATE:
        present = not np.isnan(state[k])
        k += 1
    return present


@njit(cache=True, nogil=True)
def _put_elements(
    out: np.ndarray,
    at: int,
    table: np.ndarray,
    words: np.ndarray,
    states: np.ndarray,
    confidences: np.ndarray,
) -> int:
    """Write the markers or the links of a person that are present, after their count."""
    count_at = at
    count = 0
    at += 4
    for slot in range(len(table)):
        if not _is_present(states[slot], confidences[slot]):
            continue
        count += 1
        length = table[slot, 2]
        for k in range((length + 7) >> 3):
            _store64(out, at + 8 * k, words[table[slot, 1] + k])
        at += length
        if table.shape[1] == 5:
            _store32(out, at, np.uint32(0))
            at = _put(out, _put(out, _align4(at), table[slot, 3]), table[slot, 4])
        at = _pad8(out, at)
        _store64(out, at, _to_word(confidences[slot]))
        at = _put_doubles(out, at + 8, states[slot], _STATE)
    _put(out, count_at, count)
    return at


@njit(cache=True, nogil=True)
def _size(n_people: int, texts: int, marker_table: np.ndarray, link_table: np.ndarray) -> int:
    """Bytes that are enough for any message of so many people, with the padding."""
    person = MIN_PERSON + texts + 2 * _SLACK
    for slot in range(len(marker_table)):
        person += marker_table[slot, 2] + 8 * (1 + _STATE) + _SLACK
    for slot in range(len(link_table)):
        person += link_table[slot, 2] + 8 * (2 + _STATE) + _SLACK
    return 24 + texts + n_people * person + 2 * _SLACK


@njit(
    types.int64(
        _OUT, _BYTES, _BYTES, types.int64, types.int64, types.int64, _I2, _I2, _WORDS,
        types.int32[::1], _I1, _F1, _F3, _F2, _F3, _F2, _F2,
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def encode(
    out: np.ndarray,
    frame_id: np.ndarray,
    source: np.ndarray,
    stamp: int,
    max_markers: int,
    max_links: int,
    marker_table: np.ndarray,
    link_table: np.ndarray,
    words: np.ndarray,
    ids: np.ndarray,
    stamps: np.ndarray,
    confidences: np.ndarray,
    markers: np.ndarray,
    marker_confidences: np.ndarray,
    links: np.ndarray,
    link_confidences: np.ndarray,
    boxes: np.ndarray,
) -> int:
    """Write a message, little-endian, into ``out``; return its length.

    Negative results: -SHAPE and -STAMP for a frame that cannot be written, else minus the size
    that ``out`` must have.
    """
    n, m, n_links = len(ids), len(marker_table), len(link_table)
    if (
        len(stamps) != n or len(confidences) != n or boxes.shape != (n, _BOX)
        or markers.shape != (n, m, _STATE) or marker_confidences.shape != (n, m)
        or links.shape != (n, n_links, _STATE) or link_confidences.shape != (n, n_links)
    ):  # fmt: skip
        return -SHAPE
    size = _size(n, len(frame_id) + len(source), marker_table, link_table)
    if len(out) < size:
        return -size
    if not _has_seconds(stamp):
        return -STAMP
    at = _put(out, 0, 0x0100)
    at = _put_string(out, _put_stamp(out, at, stamp), frame_id)
    at = _put(out, at, n)
    for person in range(n):
        if not _has_seconds(stamps[person]):
            return -STAMP
        at = _put_stamp(out, _put(out, at, ids[person]), stamps[person])
        at = _put_string(out, at, source)
        at = _pad8(out, _put(out, _put(out, at, max_markers), max_links))
        _store64(out, at, _to_word(confidences[person]))
        at = _put_doubles(out, at + 8, boxes[person], _BOX)
        at = _put_elements(
            out, at, marker_table, words, markers[person], marker_confidences[person]
        )
        at = _put_elements(out, at, link_table, words, links[person], link_confidences[person])
    return at
