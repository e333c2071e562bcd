"""Rotations of many bodies at once: what :mod:`~hiros_mcap.body.rotations` lacks."""

from __future__ import annotations

import numpy as np

from hiros_mcap.skeletons import Floats


def quaternions(matrices: Floats) -> Floats:
    """(..., 4) unit quaternions of exact rotation matrices (..., 3, 3), largest component positive.

    Shepperd's method: of four ways to write the quaternion, take the well-conditioned one. Much
    faster than the eigenvectors that a matrix with errors needs.
    """
    m = matrices
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    xy, yx = m[..., 0, 1], m[..., 1, 0]
    xz, zx = m[..., 0, 2], m[..., 2, 0]
    yz, zy = m[..., 1, 2], m[..., 2, 1]
    rows = [
        [1 + xx - yy - zz, xy + yx, xz + zx, zy - yz],
        [xy + yx, 1 - xx + yy - zz, yz + zy, xz - zx],
        [xz + zx, yz + zy, 1 - xx - yy + zz, yx - xy],
        [zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz],
    ]
    table = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    best = np.argmax(np.diagonal(table, axis1=-2, axis2=-1), axis=-1)
    chosen = np.take_along_axis(table, best[..., None, None], axis=-2)[..., 0, :]
    unit: Floats = chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)
    return unit


def from_vector(vectors: Floats) -> Floats:
    """(..., 4) quaternion of rotation vectors (..., 3), rad; exactly identity at zero."""
    half = 0.5 * np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate([0.5 * np.sinc(half / np.pi) * vectors, np.cos(half)], axis=-1)


def vectors(quaternions: Floats) -> Floats:
    """(..., 3) rotation vectors, rad, of the shorter way round."""
    q = np.where(quaternions[..., 3:] < 0, -quaternions, quaternions)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., 3:])
    scale = np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-12)
    turn: Floats = q[..., :3] * scale
    return turn


def second_axis(quaternions: Floats) -> Floats:
    """(..., 3) where the rotation takes the y axis: up along a segment."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    return np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=-1)
