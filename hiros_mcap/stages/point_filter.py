"""Kalman filters of many points at once: what Malaguti's filters and Lee's have in common.

``x`` is (..., S, C): position, velocity and acceleration of C axes, or the first one or two of
them. ``p`` is the covariance (..., S, S), which the axes share.
"""

from __future__ import annotations

import numpy as np

from hiros_mcap.skeletons import Floats, Stamps

# F = A[0] + A[1] dt + A[2] dt^2.
_POWERS = np.array([np.eye(3), np.eye(3, k=1), np.eye(3, k=2) / 2])


def predict(x: Floats, p: Floats, dt: Floats | float, process: Floats) -> tuple[Floats, Floats]:
    """Carry points on by ``dt`` (...): x = F x, P = F P F' + ``process`` (..., S, S)."""
    size, t = x.shape[-2], np.asarray(dt)[..., None, None]
    constant, linear, square = _POWERS[:, :size, :size]
    move = constant + linear * t + square * t**2
    return move @ x, move @ p @ np.swapaxes(move, -1, -2) + process


def correct(x: Floats, p: Floats, measured: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Correct points by positions (..., C) of ``variance`` (...): x += K (z - H x)."""
    gain = p[..., 0] / (p[..., 0, 0] + variance)[..., None]  # K = P H' (H P H' + R)^-1
    innovation = measured - x[..., 0, :]
    x = x + gain[..., None] * innovation[..., None, :]
    return x, p - gain[..., None] * p[..., :1, :]  # P = (1 - K H) P


def seconds(duration: Stamps) -> Floats:
    """(...) Times in ns as s."""
    return np.asarray(duration * 1e-9, np.float64)


def white_acceleration(dt: Floats, density: float) -> Floats:
    """(..., 2, 2) Process noise of ``dt`` s of constant velocity; ``density`` in m2/s3."""
    rows = [[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]
    return density * np.moveaxis(np.array(rows), (0, 1), (-2, -1))
