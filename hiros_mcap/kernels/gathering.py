"""Copy people from arrays to arrays, without holding Python's lock."""

from __future__ import annotations

import numpy as np

from hiros_mcap.kernels.array_types import I1, I2
from hiros_mcap.kernels.bytes import copy
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import Floats, People


@kernel
def _copy_rows(to: Floats, at: int, source: Floats, begin: int, end: int) -> None:
    """Copy some rows of the first axis."""
    size = source.size // max(1, len(source)) * source.itemsize
    copy(to, at * size, source, begin * size, (end - begin) * size)


@kernel
def _widen_rows(to: Floats, at: int, source: Floats, begin: int, end: int) -> None:
    """Copy some rows of the first axis; what follows the columns of ``source`` becomes NaN."""
    if source.shape[2] == to.shape[2]:
        _copy_rows(to, at, source, begin, end)
        return
    for p in range(end - begin):
        for m in range(to.shape[1]):
            for c in range(source.shape[2]):
                to[at + p, m, c] = source[begin + p, m, c]
            for c in range(source.shape[2], to.shape[2]):
                to[at + p, m, c] = np.nan


@entry
def gather(rows: I2, targets: I1, people: People, target: People) -> None:
    """Copy the people of frames into ``target``; neighbours are copied together.

    ``rows`` (N, 2): first row of each frame, and the row after the last; ``targets`` (N,): the row
    that the first one becomes. ``target`` may have more columns of markers and links: these become
    NaN.
    """
    first = 0
    for k in range(len(rows)):
        begin, end, at = rows[first, 0], rows[k, 1], targets[first]
        is_last = k + 1 == len(rows)
        if not is_last and rows[k + 1, 0] == end and targets[k + 1] == at + end - begin:
            continue
        first = k + 1
        _copy_rows(target.ids, at, people.ids, begin, end)
        _copy_rows(target.stamps, at, people.stamps, begin, end)
        _copy_rows(target.confidences, at, people.confidences, begin, end)
        _widen_rows(target.markers, at, people.markers, begin, end)
        _copy_rows(target.marker_confidences, at, people.marker_confidences, begin, end)
        _widen_rows(target.links, at, people.links, begin, end)
        _copy_rows(target.link_confidences, at, people.link_confidences, begin, end)
        _copy_rows(target.boxes, at, people.boxes, begin, end)
