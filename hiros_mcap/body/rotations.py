"""Rotations and rigid transforms. Quaternions are x y z w, unit length, active, everywhere.

Messages, arrays and kernels all have the scalar last. scipy has these functions, too, but importing
it takes 0.3 s, and every run needs the ones below.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.skeletons import Floats

IDENTITY = (0.0, 0.0, 0.0, 1.0)
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns axes with z up into those of OpenSim and animation programs, y up: (x, z, -y)."""


def multiply(a_xyzw: Floats, b_xyzw: Floats) -> Floats:
    """Hamilton product: the rotation ``b`` followed by ``a``. (..., 4) each, broadcast."""
    ax, ay, az, aw = np.moveaxis(np.asarray(a_xyzw, np.float64), -1, 0)
    bx, by, bz, bw = np.moveaxis(np.asarray(b_xyzw, np.float64), -1, 0)
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def conjugate(xyzw: Floats) -> Floats:
    """Inverse of a unit quaternion. (..., 4)."""
    return np.asarray(np.asarray(xyzw, np.float64) * np.array([-1.0, -1.0, -1.0, 1.0]))


def rotate(xyzw: Floats, vectors: Floats) -> Floats:
    """Rotate vectors, (..., 3), by unit quaternions, (..., 4), broadcast."""
    xyzw, vectors = np.asarray(xyzw, np.float64), np.asarray(vectors, np.float64)
    axis, w = xyzw[..., :3], xyzw[..., 3:]
    twice = 2.0 * np.cross(axis, vectors)
    return vectors + w * twice + np.cross(axis, twice)


def angle(a_xyzw: Floats, b_xyzw: Floats) -> Floats:
    """Angle between two orientations, rad, 0..pi; q and -q are the same (Hi-ROS eq. 10).

    By the tangent of the relative rotation: an arc cosine loses half of the digits near 0, and
    more when a quaternion's length is not exactly one.
    """
    relative = multiply(conjugate(a_xyzw), b_xyzw)
    sine = np.linalg.norm(relative[..., :3], axis=-1)
    return np.asarray(2.0 * np.arctan2(sine, np.abs(relative[..., 3])))


def nearest_rotation(covariances: Floats, *, mirrors: bool = False) -> Floats:
    """Return the rotations R that maximise trace(R C) for C, (..., 3, 3) each (Kabsch 1976).

    With C = sum source target', they bring the source nearest to the target. With ``mirrors``, they
    are improper: their determinant is -1.
    """
    u, _, vt = np.linalg.svd(covariances)
    signs = np.ones(u.shape[:-1])
    signs[..., 2] = np.sign(np.linalg.det(u @ vt)) * (-1.0 if mirrors else 1.0)
    return np.asarray(np.swapaxes(vt, -1, -2) @ (signs[..., None] * np.swapaxes(u, -1, -2)))


def to_matrix(xyzw: Floats) -> Floats:
    """Rotation matrices, (..., 3, 3), of unit quaternions, (..., 4)."""
    rows = rotate(np.asarray(xyzw)[..., None, :], np.eye(3))
    return np.ascontiguousarray(np.swapaxes(rows, -1, -2))


def from_matrix(matrices: Floats) -> Floats:
    """Return unit quaternions, (..., 4), w >= 0, of rotation matrices, (..., 3, 3).

    4 q q' is linear in the matrix; its row with the largest diagonal is q, up to a factor.
    """
    m = np.asarray(matrices, np.float64)
    products = np.empty((*m.shape[:-2], 4, 4))
    products[..., :3, :3] = m + np.swapaxes(m, -1, -2)
    trace = np.trace(m, axis1=-2, axis2=-1)
    for i in range(3):
        products[..., i, i] = 1.0 + 2.0 * m[..., i, i] - trace
        j, k = (i + 1) % 3, (i + 2) % 3
        products[..., i, 3] = products[..., 3, i] = m[..., k, j] - m[..., j, k]
    products[..., 3, 3] = 1.0 + trace
    best = np.diagonal(products, axis1=-2, axis2=-1).argmax(axis=-1)
    rows = np.take_along_axis(products, best[..., None, None], axis=-2)[..., 0, :]
    rows = np.where(rows[..., 3:] < 0.0, -rows, rows)
    return np.asarray(rows / np.linalg.norm(rows, axis=-1, keepdims=True))


def from_vector(vectors: Floats) -> Floats:
    """Return unit quaternions, (..., 4), of rotation vectors, (..., 3), rad."""
    half = 0.5 * np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate([0.5 * np.sinc(half / np.pi) * vectors, np.cos(half)], axis=-1)


def to_vector(xyzw: Floats) -> Floats:
    """Return rotation vectors, (..., 3), rad, at most pi long, of unit quaternions, (..., 4)."""
    short = np.where(xyzw[..., 3:] < 0.0, -xyzw, xyzw)
    half = np.arctan2(np.linalg.norm(short[..., :3], axis=-1, keepdims=True), short[..., 3:])
    return np.asarray(2.0 * short[..., :3] / np.sinc(half / np.pi))


def slerp(a_xyzw: Floats, b_xyzw: Floats, share: float) -> Floats:
    """Return the rotation on the shorter way from ``a`` (share 0) to ``b`` (share 1), (4,) each.

    A log with a moving camera asks for one per detection: 6 us here, 150 us by scipy's Slerp.
    """
    a, b = np.asarray(a_xyzw, np.float64), np.asarray(b_xyzw, np.float64)
    dot = float(a @ b)
    if dot < 0:
        b, dot = -b, -dot
    if dot > 1 - 1e-9:
        # The sines vanish; the chord is as good as the arc here.
        mix = (1 - share) * a + share * b
    else:
        whole = np.arccos(dot)
        mix = np.sin((1 - share) * whole) * a + np.sin(share * whole) * b
    return np.asarray(mix / np.linalg.norm(mix))


class Rigid(NamedTuple):
    """A rigid transform of points; see :meth:`moved`."""

    xyzw: Floats  # (4,) unit quaternion
    translation: Floats  # (3,) m

    def __matmul__(self, first: Rigid) -> Rigid:
        """Return the transform that does ``first``, then this one."""
        return Rigid(
            multiply(self.xyzw, first.xyzw),
            rotate(self.xyzw, first.translation) + self.translation,
        )

    def moved(self, points: Floats) -> Floats:
        """Return where points (..., 3), m, go."""
        return np.asarray(rotate(self.xyzw, points) + self.translation)

    def inverse(self) -> Rigid:
        """Return the transform that undoes this one."""
        back = conjugate(self.xyzw)
        return Rigid(back, -rotate(back, self.translation))

    def apart(self, other: Rigid) -> tuple[float, float]:
        """Return how far another transform is from this one, m and degrees."""
        metres = float(np.linalg.norm(self.translation - other.translation))
        return metres, float(np.degrees(angle(self.xyzw, other.xyzw)))

    def towards(self, other: Rigid, share: float) -> Rigid:
        """Return the transform between this one (share 0) and another (share 1)."""
        return Rigid(
            slerp(self.xyzw, other.xyzw, share),
            (1 - share) * self.translation + share * other.translation,
        )

    @classmethod
    def identity(cls) -> Rigid:
        """Return the transform that leaves everything as it is."""
        return cls(np.array(IDENTITY), np.zeros(3))
