"""The records of an MCAP chunk, found in one walk: 100 to 1000 times the speed of Python's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.kernels.array_types import C1, W2
from hiros_mcap.kernels.compile import entry, kernel

if TYPE_CHECKING:
    import numpy.typing as npt

OK, PAST_END, SHORT_MESSAGE, FORBIDDEN = 0, 1, 2, 3
COLUMNS = 6
CHANNEL, SEQUENCE, LOG_TIME, PUBLISH_TIME, START, STOP = range(COLUMNS)

_HEAD = 9
_FIXED = 22


@kernel
def _number(data, at, width):  # type: ignore[no-untyped-def]
    value = np.uint64(0)
    for k in range(width):
        value |= np.uint64(data[at + k]) << np.uint64(8 * k)
    return value


@entry
def _walk(data: C1, messages: W2, definitions: W2) -> tuple[int, int, int, int]:
    """Fill the tables as far as they reach; return status, where, and how many there are."""
    n_messages, n_definitions, size = 0, 0, len(data)
    at = 0
    while at < size:
        if size - at < _HEAD:
            return PAST_END, at, n_messages, n_definitions
        opcode, length = data[at], _number(data, at + 1, 8)
        begin = at + _HEAD
        if length > np.uint64(size - begin):
            return PAST_END, at, n_messages, n_definitions
        stop = begin + int(length)
        if opcode == 5:
            if stop - begin < _FIXED:
                return SHORT_MESSAGE, at, n_messages, n_definitions
            if n_messages < len(messages):
                row = messages[n_messages]
                row[CHANNEL] = _number(data, begin, 2)
                row[SEQUENCE] = _number(data, begin + 2, 4)
                row[LOG_TIME] = _number(data, begin + 6, 8)
                row[PUBLISH_TIME] = _number(data, begin + 14, 8)
                row[START] = np.uint64(begin + _FIXED)
                row[STOP] = np.uint64(stop)
            n_messages += 1
        elif opcode == 3 or opcode == 4:
            if n_definitions < len(definitions):
                definitions[n_definitions, 0] = np.uint64(opcode)
                definitions[n_definitions, 1] = np.uint64(begin)
                definitions[n_definitions, 2] = np.uint64(stop)
            n_definitions += 1
        elif opcode < 0x80:
            return FORBIDDEN, at, n_messages, n_definitions
        at = stop
    return OK, at, n_messages, n_definitions


def index_records(
    data: npt.NDArray[np.uint8],
) -> tuple[int, int, npt.NDArray[np.uint64], npt.NDArray[np.uint64]]:
    """Find every message and every definition in the records of a chunk.

    Parameters
    ----------
    data : the uncompressed records.

    Returns
    -------
    status : OK or what is wrong.
    where : first byte of the record that is wrong.
    messages : (n, 6) channel, sequence, log time, publish time, first and past-the-end data byte.
    definitions : (k, 3) opcode (3 schema, 4 channel), first and past-the-end byte of content.
    """
    none = np.empty((0, COLUMNS), np.uint64)
    status, where, n_messages, n_definitions = _walk(data, none, none)
    messages = np.empty((n_messages, COLUMNS), np.uint64)
    definitions = np.empty((n_definitions, 3), np.uint64)
    _walk(data, messages, definitions)
    return status, where, messages, definitions
