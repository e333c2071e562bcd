"""Rigid motion of whole skeletons."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from numba import njit

if TYPE_CHECKING:
    import numpy.typing as npt

_STATE = 19


@njit(cache=True, nogil=True)
def _rotate(m, source, target, at):  # type: ignore[no-untyped-def]
    x, y, z = source[at], source[at + 1], source[at + 2]
    for k in range(3):
        target[at + k] = m[k, 0] * x + m[k, 1] * y + m[k, 2] * z


@njit(cache=True, nogil=True)
def _move_state(xyzw, matrix, translation, source, target):  # type: ignore[no-untyped-def]
    _rotate(matrix, source, target, 0)
    for k in range(3):
        target[k] += translation[k]
    ax, ay, az, aw = xyzw[0], xyzw[1], xyzw[2], xyzw[3]
    bx, by, bz, bw = source[3], source[4], source[5], source[6]
    target[3] = aw * bx + ax * bw + ay * bz - az * by
    target[4] = aw * by - ax * bz + ay * bw + az * bx
    target[5] = aw * bz + ax * by - ay * bx + az * bw
    target[6] = aw * bw - ax * bx - ay * by - az * bz
    for at in range(7, _STATE, 3):
        _rotate(matrix, source, target, at)


@njit(
    [
        "void(float64[::1], float64[:,::1], float64[::1], float64[:,:,::1], float64[:,:,::1],"
        " float64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,::1])"
    ],
    cache=True,
    nogil=True,
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
    """Express KinematicStates in another frame (Hi-ROS eq. 5), NaN staying NaN.

    Positions are rotated and shifted; orientations are multiplied from the left; the linear and
    angular velocities and accelerations are rotated, which is exact for a frame at rest in the
    other. The sizes of a box stay.

    Parameters
    ----------
    xyzw, matrix, translation : the same rotation twice, (4,) and (3, 3), and (3,) m.
    markers, links : (P, M, 19), (P, L, 19).
    boxes : (P, 22).
    moved_markers, moved_links, moved_boxes : filled, shapes as above.
    """
    for p in range(markers.shape[0]):
        for m in range(markers.shape[1]):
            _move_state(xyzw, matrix, translation, markers[p, m], moved_markers[p, m])
        for n in range(links.shape[1]):
            _move_state(xyzw, matrix, translation, links[p, n], moved_links[p, n])
        _move_state(xyzw, matrix, translation, boxes[p], moved_boxes[p])
        for k in range(_STATE, boxes.shape[1]):
            moved_boxes[p, k] = boxes[p, k]
