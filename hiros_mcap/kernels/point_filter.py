"""Kalman filter of one point in arrays: what Malaguti's filters and Lee's have in common.

``x`` is (S, C): position, velocity and acceleration of C axes, or the first one or two of them.
``p`` is the covariance (6,) of ``kernels.kalman_filter``, which the axes share.
"""

from __future__ import annotations

from hiros_mcap.kernels import kalman_filter
from hiros_mcap.kernels.compile import kernel
from hiros_mcap.kernels.kalman_filter import Covariance
from hiros_mcap.skeletons import Floats

TRIANGLE = 6  # numbers of a covariance

_correct = kalman_filter.correct
_gain = kalman_filter.gain
_predict = kalman_filter.predict


@kernel
def _store(p: Floats, covariance: Covariance) -> None:
    for i in range(TRIANGLE):
        p[i] = covariance[i]


@kernel
def start(x: Floats, p: Floats, measured: Floats, covariance: Covariance) -> None:
    """Start at a measured position (C,), without motion."""
    x[:] = 0.0
    for c in range(len(measured)):
        x[0, c] = measured[c]
    _store(p, covariance)


@kernel
def predict(x: Floats, p: Floats, dt: float, process: Covariance) -> None:
    """Carry a point on by ``dt``: x = F x, P = F P F' + ``process``."""
    for i in range(len(x)):
        factor = 1.0
        for j in range(i + 1, len(x)):
            factor *= dt / (j - i)
            for c in range(x.shape[1]):
                x[i, c] += factor * x[j, c]
    _store(p, _predict((p[0], p[1], p[2], p[3], p[4], p[5]), dt, process))


@kernel
def correct(x: Floats, p: Floats, measured: Floats, variance: float) -> None:
    """Correct a point by a measured position (C,): x += K (z - H x), P = (1 - K H) P."""
    covariance = p[0], p[1], p[2], p[3], p[4], p[5]
    gain = _gain(covariance, p[0] + variance)  # K = P H' (H P H' + R)^-1
    for c in range(x.shape[1]):
        innovation = measured[c] - x[0, c]
        for i in range(len(x)):
            x[i, c] += gain[i] * innovation
    _store(p, _correct(covariance, gain))
