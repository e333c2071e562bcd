"""Decode, clean and move all messages of a chunk in one call, which another thread can make."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import types

from hiros_mcap.kernels.cdr import COUNT, FRAME, FRAME_END, OK, decode, read_header
from hiros_mcap.kernels.cleaning import clean
from hiros_mcap.kernels.compile import kernel
from hiros_mcap.kernels.transforming import move
from hiros_mcap.skeletons import Floats, Ints, Stamps

Bytes = npt.NDArray[np.uint8]
Words = npt.NDArray[np.uint64]

_BYTES = types.Array(types.uint8, 1, "C", readonly=True)
_I1, _I2 = types.int64[::1], types.int64[:, ::1]
_F1, _F2, _F3 = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]


# As short as it is, giving up the GIL would take longer.
@kernel(types.void(_BYTES, _I2, _I2, _I1), nogil=False)
def read_headers(data: Bytes, places: Stamps, reports: Stamps, first: Stamps) -> None:
    """Find out how many people each message holds, 0 where its beginning is damaged.

    ``places`` (N, 2) are the first byte of each message in ``data`` and the byte after its last;
    ``first`` (N + 1,), of which the first is given, becomes the row of each message's first person,
    ``reports`` (N, REPORT) say where its frame_id lies, nowhere where the beginning is damaged.
    """
    for i in range(len(places)):
        fault, _, _ = read_header(data[places[i, 0] : places[i, 1]], reports[i])
        first[i + 1] = first[i] + (reports[i, COUNT] if fault == OK else 0)
        if fault != OK:
            reports[i, FRAME] = reports[i, FRAME_END] = 0


@kernel(
    types.void(
        _BYTES, _I2, _I2, _I2, types.uint64[::1], _I1, _I2, _I2, _I1, _I1, _I2,
        types.int32[::1], _I1, _F1, _F3, _F2, _F3, _F2, _F2, _I1, _F2, _F3, _F2,
    ),
)  # fmt: skip
def decode_batch(
    data: Bytes,
    places: Stamps,
    marker_table: Stamps,
    link_table: Stamps,
    words: Words,
    seen: Stamps,
    reports: Stamps,
    cleaned: Stamps,
    codes: Stamps,
    first: Stamps,
    sources: Stamps,
    ids: Ints,
    stamps: Stamps,
    confidences: Floats,
    markers: Floats,
    marker_confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    boxes: Floats,
    pose_of: Stamps,
    xyzw: Floats,
    matrices: Floats,
    translations: Floats,
) -> None:
    """Fill one set of arrays from N messages, take out numbers that cannot be true, and move.

    Message i has the rows ``first[i]`` to ``first[i + 1]``, the result ``codes[i]`` and the report
    ``reports[i]`` of :func:`hiros_mcap.kernels.cdr.decode`, and the counts ``cleaned[i]`` of
    :func:`hiros_mcap.kernels.cleaning.clean`. ``pose_of`` (N,) says by which pose its people are
    moved (see :func:`hiros_mcap.kernels.transforming.move`), -1 = by none; ``xyzw`` (K, 4),
    ``matrices`` (K, 3, 3) and ``translations`` (K, 3) are the poses.
    """
    for i in range(len(places)):
        a, b = first[i], first[i + 1]
        codes[i] = decode(
            data[places[i, 0] : places[i, 1]], marker_table, link_table, words, seen, reports[i],
            sources[a:b], ids[a:b], stamps[a:b], confidences[a:b], markers[a:b],
            marker_confidences[a:b], links[a:b], link_confidences[a:b], boxes[a:b],
        )  # fmt: skip
        if codes[i] == OK:
            clean(
                cleaned[i], True, confidences[a:b], markers[a:b], marker_confidences[a:b],
                links[a:b], link_confidences[a:b], boxes[a:b],
            )  # fmt: skip
            k = pose_of[i]
            if k >= 0:
                move(
                    xyzw[k], matrices[k], translations[k], markers[a:b], links[a:b], boxes[a:b],
                    markers[a:b], links[a:b], boxes[a:b],
                )  # fmt: skip
