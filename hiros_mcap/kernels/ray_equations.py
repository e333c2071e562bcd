"""Normal equations of poses and lags of RGB cameras, with the people's joints eliminated.

A joint X of the room is at ``R X + t`` before a camera and, without the lens, at x / z and y / z of
its image. Residuals are in standard deviations of the keypoints. Robust weights are Cauchy's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2, F3, arrays
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.skeletons import Floats

UNKNOWNS = 7  # of a camera: rotation, shift, lag
LAG = 6
CAUCHY = 2.0
"""Scale of the robust loss, in standard deviations."""
_NEAREST_M = 0.05
"""A joint that is nearer to a camera, or behind it, tells that camera nothing."""
BEHIND = 1e4
"""Such a joint counts as if it were off by 100 times the scale."""
_SINGULAR = 1e-10
"""Rays that are more alike tell no place."""


class RayPoints(NamedTuple):
    """P joints at instants, as C cameras see them."""

    rays: F3
    """(P, C, 2) x / z and y / z, at the instant on the camera's clock."""
    velocities: F3
    """(P, C, 2) 1/s."""
    weights: F2
    """(P, C) 0 where a camera does not see the joint, else up to 1."""


class RayCameras(NamedTuple):
    """C cameras."""

    rotations: F3
    """(C, 3, 3) from the room to the optical frame."""
    shifts: F2
    """(C, 3) of the same, m."""
    lags: F1
    """(C,) s by which the instant on the camera's clock is later than where the rays are from."""
    scales: F1
    """(C,) focal length over the keypoints' standard deviation: residuals per unit of a ray."""


class RayWork(NamedTuple):
    """Scratch for one joint before C cameras. Zeros at first."""

    by_camera: F3
    """(C, 2, 7) Jacobians of the two residuals by the camera's unknowns."""
    by_place: F3
    """(C, 2, 3) the same by the joint's place."""
    residuals: F2
    """(C, 2)"""
    weights: F1
    """(C,) with the robust ones."""
    hessian: F2
    """(3, 3) of the joint's place; then its inverse."""
    slope: F1
    """(3,)"""
    mixed: F3
    """(C, 7, 3) Hessian of a camera and the joint's place."""
    solved: F2
    """(7, 3) that times the inverse."""

    @classmethod
    def allocate(cls, n_cameras: int) -> RayWork:
        """Allocate the arrays."""
        c, n = n_cameras, UNKNOWNS
        return arrays(cls, (c, 2, n), (c, 2, 3), (c, 2), c, (3, 3), 3, (c, n, 3), (n, 3))


@inlined
def _residual(
    points: RayPoints, cameras: RayCameras, p: int, c: int, place: Floats
) -> tuple[float, float, float, float, float]:
    """Return both residuals of a joint, and where it is in the optical frame, m."""
    turn, shift = cameras.rotations[c], cameras.shifts[c]
    x = turn[0, 0] * place[0] + turn[0, 1] * place[1] + turn[0, 2] * place[2] + shift[0]
    y = turn[1, 0] * place[0] + turn[1, 1] * place[1] + turn[1, 2] * place[2] + shift[1]
    z = turn[2, 0] * place[0] + turn[2, 1] * place[1] + turn[2, 2] * place[2] + shift[2]
    scale, lag = cameras.scales[c], cameras.lags[c]
    u = scale * (x / z - points.rays[p, c, 0] - lag * points.velocities[p, c, 0])
    v = scale * (y / z - points.rays[p, c, 1] - lag * points.velocities[p, c, 1])
    return u, v, x, y, z


@entry
def ray_loss(points: RayPoints, cameras: RayCameras, places: F2, squares: F2) -> float:
    """Return the robust loss of joints at ``places``, (P, 3) m.

    ``squares`` (P, C) gets the squared residuals: NaN where a camera does not see a joint, infinite
    where the joint is behind it.
    """
    loss = 0.0
    for p in range(len(places)):
        for c in range(len(cameras.scales)):
            squares[p, c] = np.nan
            if points.weights[p, c] <= 0.0:
                continue
            u, v, _, _, z = _residual(points, cameras, p, c, places[p])
            squares[p, c] = u * u + v * v if z > _NEAREST_M else np.inf
            bounded = min(squares[p, c] / CAUCHY**2, BEHIND)
            loss += points.weights[p, c] * 0.5 * CAUCHY**2 * math.log1p(bounded)
    return loss


@kernel
def _differentiate(
    points: RayPoints, cameras: RayCameras, p: int, c: int, place: Floats, work: RayWork
) -> None:
    """Write the residuals of a joint before a camera, their Jacobians and their weight."""
    work.weights[c] = 0.0
    if points.weights[p, c] <= 0.0:
        return
    u, v, x, y, z = _residual(points, cameras, p, c, place)
    if z <= _NEAREST_M:
        return
    work.residuals[c, 0], work.residuals[c, 1] = u, v
    work.weights[c] = points.weights[p, c] / (1.0 + (u * u + v * v) / CAUCHY**2)
    turn, scale = cameras.rotations[c], cameras.scales[c]
    for k in range(2):
        image = x / z if k == 0 else y / z
        jacobian = work.by_camera[c, k]
        # by the joint in the optical frame; then by a rotation, a shift and a lag
        dx, dy, dz = scale / z * (1 - k), scale / z * k, -scale / z * image
        jacobian[0], jacobian[1], jacobian[2] = dz * y - dy * z, dx * z - dz * x, dy * x - dx * y
        jacobian[3], jacobian[4], jacobian[5] = dx, dy, dz
        jacobian[LAG] = -scale * points.velocities[p, c, k]
        for i in range(3):
            work.by_place[c, k, i] = dx * turn[0, i] + dy * turn[1, i] + dz * turn[2, i]


@kernel
def _invert(matrix: Floats, damping: float) -> bool:
    """Invert a symmetric matrix (3, 3) in place, its diagonal enlarged; False if it is singular."""
    for i in range(3):
        matrix[i, i] *= 1.0 + damping
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * p + b * q + c * r
    if not determinant > _SINGULAR * a * d * f:
        return False
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = p, q, r
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = q, a * f - c * c, b * c - a * e
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = r, b * c - a * e, a * d - b * b
    for i in range(3):
        for j in range(3):
            matrix[i, j] /= determinant
    return True


@kernel
def _eliminate(
    points: RayPoints, cameras: RayCameras, p: int, place: Floats, damping: float, work: RayWork
) -> bool:
    """Write the equations of a joint before all cameras; False if they do not tell its place."""
    work.hessian[:] = 0.0
    work.slope[:] = 0.0
    for c in range(len(cameras.scales)):
        _differentiate(points, cameras, p, c, place, work)
        for k in range(2 if work.weights[c] > 0.0 else 0):
            for i in range(3):
                pull = work.weights[c] * work.by_place[c, k, i]
                work.slope[i] += pull * work.residuals[c, k]
                for j in range(3):
                    work.hessian[i, j] += pull * work.by_place[c, k, j]
        for n in range(UNKNOWNS if work.weights[c] > 0.0 else 0):
            for i in range(3):
                work.mixed[c, n, i] = work.weights[c] * (
                    work.by_camera[c, 0, n] * work.by_place[c, 0, i]
                    + work.by_camera[c, 1, n] * work.by_place[c, 1, i]
                )
    return _invert(work.hessian, damping)


@entry
def add_rays(
    points: RayPoints, cameras: RayCameras, places: F2, damping: float, hessian: F2, slope: F1,
    work: RayWork,
) -> None:  # fmt: skip
    """Add all joints to the equations of the cameras, without the joints' own unknowns (Schur).

    Parameters
    ----------
    places : (P, 3) m. damping : share by which the diagonals of the joints' equations are larger.
    hessian : (7 C, 7 C) all of it is written. slope : (7 C,) the gradient.
    """
    n_cameras = len(cameras.scales)
    for p in range(len(places)):
        if not _eliminate(points, cameras, p, places[p], damping, work):
            continue
        for c in range(n_cameras):
            w, row = work.weights[c], UNKNOWNS * c
            if w <= 0.0:
                continue
            ones = work.by_camera[c]
            for n in range(UNKNOWNS):
                slope[row + n] += w * (
                    ones[0, n] * work.residuals[c, 0] + ones[1, n] * work.residuals[c, 1]
                )
                for m in range(UNKNOWNS):
                    hessian[row + n, row + m] += w * (
                        ones[0, n] * ones[0, m] + ones[1, n] * ones[1, m]
                    )
                for i in range(3):
                    work.solved[n, i] = 0.0
                    for j in range(3):
                        work.solved[n, i] += work.mixed[c, n, j] * work.hessian[j, i]
                    slope[row + n] -= work.solved[n, i] * work.slope[i]
            for d in range(n_cameras):
                for n in range(UNKNOWNS if work.weights[d] > 0.0 else 0):
                    for m in range(UNKNOWNS):
                        for i in range(3):
                            hessian[row + n, UNKNOWNS * d + m] -= (
                                work.solved[n, i] * work.mixed[d, m, i]
                            )


@entry
def move_places(
    points: RayPoints, cameras: RayCameras, places: F2, damping: float, steps: F2, moved: F2,
    work: RayWork,
) -> None:  # fmt: skip
    """Write where the joints go if the cameras make steps (C, 7), which were solved for.

    Parameters
    ----------
    places, moved : (P, 3) m. A joint whose place nothing tells stays.
    """
    for p in range(len(places)):
        for i in range(3):
            moved[p, i] = places[p, i]
        if not _eliminate(points, cameras, p, places[p], damping, work):
            continue
        for c in range(len(cameras.scales)):
            for n in range(UNKNOWNS if work.weights[c] > 0.0 else 0):
                for i in range(3):
                    work.slope[i] += work.mixed[c, n, i] * steps[c, n]
        for i in range(3):
            for j in range(3):
                moved[p, i] -= work.hessian[i, j] * work.slope[j]
