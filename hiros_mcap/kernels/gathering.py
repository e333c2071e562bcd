"""Copy people from arrays to arrays, without holding Python's lock."""

from __future__ import annotations

from numba import types

from hiros_mcap.kernels.bytes import copy
from hiros_mcap.kernels.compile import I2, PEOPLE, kernel
from hiros_mcap.skeletons import Floats, People, Stamps

BEGIN, END, TARGET = 0, 1, 2


@kernel
def _copy_rows(to: Floats, source: Floats, piece: Stamps) -> None:
    """Copy some rows of the first axis."""
    size = source.size // max(1, len(source)) * source.itemsize
    n = (piece[END] - piece[BEGIN]) * size
    copy(to, piece[TARGET] * size, source, piece[BEGIN] * size, n)


@kernel(types.void(I2, PEOPLE, PEOPLE))
def gather(pieces: Stamps, people: People, target: People) -> None:
    """Copy rows of people into ``target``.

    ``pieces`` (K, 3): first row, the row after the last, and the row that the first one becomes.
    """
    for k in range(len(pieces)):
        _copy_rows(target.ids, people.ids, pieces[k])
        _copy_rows(target.stamps, people.stamps, pieces[k])
        _copy_rows(target.confidences, people.confidences, pieces[k])
        _copy_rows(target.markers, people.markers, pieces[k])
        _copy_rows(target.marker_confidences, people.marker_confidences, pieces[k])
        _copy_rows(target.links, people.links, pieces[k])
        _copy_rows(target.link_confidences, people.link_confidences, pieces[k])
        _copy_rows(target.boxes, people.boxes, pieces[k])
