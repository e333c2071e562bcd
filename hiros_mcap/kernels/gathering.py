"""Copy people from arrays to arrays, without holding Python's lock."""

from __future__ import annotations

from hiros_mcap.kernels.bytes import copy
from hiros_mcap.kernels.compile import kernel
from hiros_mcap.skeletons import Floats, Ints, Stamps


@kernel
def _copy_rows(to: Floats, at: int, source: Floats, begin: int, end: int) -> None:
    """Copy some rows of the first axis."""
    size = source.size // max(1, len(source)) * source.itemsize
    copy(to, at * size, source, begin * size, (end - begin) * size)


@kernel(
    "void(int64[:,::1], int32[::1], int64[::1], float64[::1], float64[:,:,::1], float64[:,::1],"
    " float64[:,:,::1], float64[:,::1], float64[:,::1], int32[::1], int64[::1], float64[::1],"
    " float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1], float64[:,::1])",
)
def gather(
    pieces: Stamps,
    ids: Ints,
    stamps: Stamps,
    confidences: Floats,
    markers: Floats,
    marker_confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    boxes: Floats,
    to_ids: Ints,
    to_stamps: Stamps,
    to_confidences: Floats,
    to_markers: Floats,
    to_marker_confidences: Floats,
    to_links: Floats,
    to_link_confidences: Floats,
    to_boxes: Floats,
) -> None:
    """Copy rows of people's arrays.

    ``pieces`` (K, 3): first row, the row after the last, and the row that the first one becomes.
    """
    for k in range(len(pieces)):
        begin, end, at = pieces[k, 0], pieces[k, 1], pieces[k, 2]
        _copy_rows(to_ids, at, ids, begin, end)
        _copy_rows(to_stamps, at, stamps, begin, end)
        _copy_rows(to_confidences, at, confidences, begin, end)
        _copy_rows(to_markers, at, markers, begin, end)
        _copy_rows(to_marker_confidences, at, marker_confidences, begin, end)
        _copy_rows(to_links, at, links, begin, end)
        _copy_rows(to_link_confidences, at, link_confidences, begin, end)
        _copy_rows(to_boxes, at, boxes, begin, end)
