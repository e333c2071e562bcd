"""A person's own motion as a prior: joints move together, noise does not.

In a window of some seconds, poses vary in few directions. What exceeds the known variance of the
markers there is motion; an estimate between the mean pose and the measured one follows (Wiener).
"""

from __future__ import annotations

import numpy as np

from hiros_mcap.skeletons import Floats, Ints

WINDOW = 90
"""Poses, 3 s at 30 Hz."""
_FEWEST = 30
_EXCESS = 1.5  # eigenvalue, in units of the noise, that noise alone may have
_FREE = 0.003  # m; what each marker may do by itself
_ABSENT = 1.0  # m2; variance of a marker that is missing


def shrink_noise(positions: Floats, variances: Floats, lateral: Ints) -> Floats:
    """Return poses (T, M, 3), m, moved towards what the person does in the window.

    Parameters
    ----------
    variances : (T, M) m2 along each axis. lateral : (K, 2) left and right slots that show the yaw.
    """
    out, weights = np.zeros_like(positions), np.zeros(len(positions))
    if len(positions) < _FEWEST:
        return positions
    known = ~np.isnan(positions).any(axis=2).all(axis=0)
    starts = range(0, max(len(positions) - WINDOW // 2, 1), WINDOW // 2)
    for start in starts:
        part = slice(start, start + WINDOW)
        n = len(positions[part])
        # Neighbouring windows overlap by half and are faded into each other.
        fade = np.minimum(np.arange(n), np.arange(n)[::-1]) + 1.0
        estimate = positions[part].copy()
        if n >= _FEWEST:
            frames, origins = _local(positions[part], lateral)
            local = np.einsum("tij,tmi->tmj", frames, positions[part] - origins)
            local[:, known] = _wiener(local[:, known], variances[part][:, known])
            estimate = np.einsum("tij,tmj->tmi", frames, local) + origins
        out[part] += fade[:, None, None] * estimate
        weights[part] += fade
    return np.asarray(out / weights[:, None, None])


def _local(positions: Floats, lateral: Ints) -> tuple[Floats, Floats]:
    """(T, 3, 3) and (T, 1, 3): yaw and centre of each pose; the world's where unknown."""
    frames = np.tile(np.eye(3), (len(positions), 1, 1))
    trunk = positions[:, lateral.ravel()] if len(lateral) else positions
    seen = ~np.isnan(trunk[:, :, :1])
    origins = np.nan_to_num(trunk).sum(axis=1, keepdims=True)
    origins /= np.maximum(seen.sum(axis=1, keepdims=True), 1)
    if len(lateral):
        lines = positions[:, lateral[:, 1]] - positions[:, lateral[:, 0]]
        across = np.nan_to_num(lines).sum(axis=1)
        norm = np.hypot(across[:, 0], across[:, 1])
        good = norm > 1e-6
        cos = np.where(good, across[:, 0] / np.maximum(norm, 1e-6), 1.0)
        sin = np.where(good, across[:, 1] / np.maximum(norm, 1e-6), 0.0)
        frames[:, 0, 0], frames[:, 1, 0] = cos, sin
        frames[:, 0, 1], frames[:, 1, 1] = -sin, cos
    return frames, origins


def _wiener(positions: Floats, variances: Floats) -> Floats:
    """Estimate mu + P (P + V)^-1 (y - mu), P from the excess of the covariance over V."""
    shape = positions.shape
    y = positions.reshape(len(positions), -1)
    absent = np.isnan(y)
    v = np.where(absent, _ABSENT, np.repeat(variances, 3, axis=1))
    mean = np.nanmean(y, axis=0)
    off = np.where(absent, 0.0, y - mean)
    noise = np.sqrt(np.nanmean(np.where(absent, np.nan, v), axis=0))
    # P: directions in which the whitened poses vary by more than noise does.
    _, scales, directions = np.linalg.svd(off / noise, full_matrices=False)
    excess = scales**2 / len(y) - _EXCESS
    used = excess > 0
    basis = noise[:, None] * directions[used].T * np.sqrt(excess[used])
    # (B B' + D)^-1 by Woodbury, with the variances of each pose.
    rank = basis.shape[1]
    d = _FREE**2 + v
    pairs = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), rank * rank)
    inner = (1 / d @ pairs).reshape(len(y), rank, rank) + np.eye(rank)
    right = (off / d) @ basis
    solved = np.linalg.solve(inner, right[:, :, None])[:, :, 0]
    u = (off - solved @ basis.T) / d
    estimate = mean + u @ basis @ basis.T + _FREE**2 * u
    return np.where(absent, y, estimate).reshape(shape)
