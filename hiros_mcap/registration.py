"""Rigid registration of corresponding points: where a camera stands (Lee et al. 2022, 2.1).

The points themselves (centres of a ball, corners of a board) have to come from elsewhere: nothing
here reads images.
"""

from __future__ import annotations

import numpy as np

from hiros_mcap.rotations import Rigid, from_matrix, rotate
from hiros_mcap.skeletons import Floats

_FLAT = 1e-9
"""Least spread across the main direction, over the spread along it, that is no line."""


def rigid_fit(source: Floats, target: Floats) -> Rigid:
    """Return the rigid transform that brings ``source`` nearest to ``target`` (Lee, 2.1.1).

    It minimises the sum of squared distances ``|target - (R source + T)|`` by the singular value
    decomposition of the covariance ``U S V'`` (Arun et al. 1987; Kabsch 1976). As printed, the
    paper's ``R = U V'`` is the inverse rotation, may be a reflection, and its T lacks R: here
    ``R = V diag(1, 1, det) U'``, ``T = mean(target) - R mean(source)``.

    Parameters
    ----------
    source, target : (N, 3) corresponding points, m; pairs with NaN (a frame in which one sensor
        misses the object) are left out.

    Raises
    ------
    ValueError
        The shapes differ, fewer than three pairs are known, or all lie on a line.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"points of shape (N, 3) needed, got {source.shape} and {target.shape}")
    known = np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1)
    if known.sum() < 3:
        raise ValueError(f"at least 3 corresponding points needed, got {known.sum()}")
    source, target = source[known], target[known]
    start, goal = source.mean(axis=0), target.mean(axis=0)
    for points, centre in ((source, start), (target, goal)):
        spread = np.linalg.svd(points - centre, compute_uv=False)
        if spread[1] <= _FLAT * spread[0]:
            raise ValueError("the points lie on a line: they do not tell the rotation about it")
    u, _, vt = np.linalg.svd((source - start).T @ (target - goal))
    handed = np.sign(np.linalg.det(vt.T @ u.T))
    turn = from_matrix(vt.T @ np.diag([1.0, 1.0, handed]) @ u.T)
    return Rigid(turn, goal - rotate(turn, start))


def board_frame(centres: Floats) -> Rigid:
    """Return the pose of a board of four markers in the sensor's frame (Lee, 2.1.2).

    The origin is the centre of marker 1, x points from it to marker 2, y towards marker 0, z is
    their cross product. Measured x and y are not quite orthogonal: x is kept, y is straightened.

    Parameters
    ----------
    centres : (3 or more, 3) centres of markers 0, 1, 2, m.

    Raises
    ------
    ValueError
        A centre is missing, or the three lie on a line.
    """
    centres = np.asarray(centres, np.float64)
    if centres.ndim != 2 or centres.shape[0] < 3 or not np.isfinite(centres[:3]).all():
        raise ValueError("the centres of markers 0, 1 and 2 are needed")
    origin = centres[1]
    x, y = centres[2] - origin, centres[0] - origin
    z = np.cross(x, y)
    if np.linalg.norm(z) <= _FLAT * np.linalg.norm(x) * np.linalg.norm(y):
        raise ValueError("the markers lie on a line: they do not span a board")
    axes = [x, np.cross(z, x), z]
    matrix = np.stack([axis / np.linalg.norm(axis) for axis in axes], axis=1)
    return Rigid(from_matrix(matrix), origin)
