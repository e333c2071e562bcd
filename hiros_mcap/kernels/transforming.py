"""Rigid motion of whole skeletons."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_mcap.kernels.compile import kernel

if TYPE_CHECKING:
    import numpy.typing as npt

_STATE = 19


@kernel
def _move_state(xyzw, matrix, translation, source, target, p, n):  # type: ignore[no-untyped-def]
    """Move state (p, n). Most of a state is absent: a NaN at the front stands for its vector."""
    for at in (0, 7, 10, 13, 16):
        x, y, z = source[p, n, at], source[p, n, at + 1], source[p, n, at + 2]
        if math.isnan(x):
            for k in range(3):
                target[p, n, at + k] = x
            continue
        for k in range(3):
            target[p, n, at + k] = matrix[k, 0] * x + matrix[k, 1] * y + matrix[k, 2] * z
        if at == 0:
            for k in range(3):
                target[p, n, k] += translation[k]
    bx, by, bz, bw = source[p, n, 3], source[p, n, 4], source[p, n, 5], source[p, n, 6]
    if math.isnan(bx):
        for k in range(3, 7):
            target[p, n, k] = bx
        return
    ax, ay, az, aw = xyzw[0], xyzw[1], xyzw[2], xyzw[3]
    target[p, n, 3] = aw * bx + ax * bw + ay * bz - az * by
    target[p, n, 4] = aw * by - ax * bz + ay * bw + az * bx
    target[p, n, 5] = aw * bz + ax * by - ay * bx + az * bw
    target[p, n, 6] = aw * bw - ax * bx - ay * by - az * bz


@kernel(
    "void(float64[::1], float64[:,::1], float64[::1], float64[:,:,::1], float64[:,:,::1],"
    " float64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,::1])"
)
def move(
    xyzw: npt.NDArray[Any],
    matrix: npt.NDArray[Any],
    translation: npt.NDArray[Any],
    markers: npt.NDArray[Any],
    links: npt.NDArray[Any],
    boxes: npt.NDArray[Any],
    moved_markers: npt.NDArray[Any],
    moved_links: npt.NDArray[Any],
    moved_boxes: npt.NDArray[Any],
) -> None:
    """Express KinematicStates in another frame (Hi-ROS eq. 5); a vector that is NaN stays so.

    Positions are rotated and shifted; orientations are multiplied from the left; the linear and
    angular velocities and accelerations are rotated, which is exact for a frame at rest in the
    other. The sizes of a box stay.

    Parameters
    ----------
    xyzw, matrix, translation : the same rotation twice, (4,) and (3, 3), and (3,) m.
    markers, links : (P, M, 19), (P, L, 19).
    boxes : (P, 22).
    moved_markers, moved_links, moved_boxes : filled, shapes as above; may be the same arrays.
    """
    people = markers.shape[0]
    box = boxes.reshape((people, 1, boxes.shape[1]))
    moved_box = moved_boxes.reshape((people, 1, boxes.shape[1]))
    for p in range(people):
        for m in range(markers.shape[1]):
            _move_state(xyzw, matrix, translation, markers, moved_markers, p, m)
        for n in range(links.shape[1]):
            _move_state(xyzw, matrix, translation, links, moved_links, p, n)
        _move_state(xyzw, matrix, translation, box, moved_box, p, np.int64(0))
        for k in range(_STATE, boxes.shape[1]):
            moved_boxes[p, k] = boxes[p, k]
