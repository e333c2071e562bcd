"""Decode, clean and move all messages of some chunks in one call, without Python's lock."""

from __future__ import annotations

from typing import NamedTuple

from hiros_mcap.kernels.array_types import C1, I1, I2
from hiros_mcap.kernels.cdr import (
    COUNT,
    FRAME,
    FRAME_END,
    OK,
    TOO_NARROW,
    Tables,
    decode,
    read_header,
)
from hiros_mcap.kernels.cleaning import clean
from hiros_mcap.kernels.compile import entry, rows_of
from hiros_mcap.kernels.transforming import PoseArrays, move
from hiros_mcap.skeletons import People

START, STOP = 0, 1


class Results(NamedTuple):
    """What is found out about N messages and their P people."""

    first: I1  # (N + 1,) row of each message's first person, and P
    codes: I1  # (N,) OK or a fault of kernels.cdr
    reports: I2  # (N, REPORT) report of kernels.cdr
    pose_of: I1
    """(N,) pose that moves the message's people, -1 = none; chosen between the two kernels."""
    cleaned: I2  # (N, COUNTS) numbers that were taken out, by kind (kernels.cleaning)
    sources: I2
    """(P, 2) first byte of each person's src_frame in its message, and the one after the last."""


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
        clean(mine, results.cleaned[i])
        if results.pose_of[i] >= 0:
            move(poses, results.pose_of[i], mine)
    return True
