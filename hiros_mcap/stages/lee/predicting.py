"""Lee's Kalman filter, every joint on its own (Lee et al. 2022, section 2.2.3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import B2, F3, F4, I1, I2, arrays
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.kernels.kalman_filter import Covariance
from hiros_mcap.kernels.point_filter import TRIANGLE, correct, predict, start
from hiros_mcap.skeletons import ACCELERATION, POSITION, VELOCITY, Floats

STEP = 1 / 30  # s: time step of Q, the period of the paper's cameras
_X = POSITION.start
_DERIVATIVES = (VELOCITY.start, ACCELERATION.start)


class PredictedPeople(NamedTuple):
    """The filters of all people: R rows, M joints, S elements of the state."""

    stamps: I1  # (R,) time of the state, ns
    started: B2  # (R, M) joints that were measured at least once
    seen: I2  # (R, M) time of the last measurement, ns
    states: F4  # (R, M, S, 3) position, m, and its derivatives per step
    covariances: F3  # (R, M, 6) of ``kalman_filter``, per R and step

    @classmethod
    def empty(cls, markers: int, size: int) -> PredictedPeople:
        """Return the filters of nobody, with ``size`` elements (S) of the state."""
        m, covariances = (0, markers), (0, markers, TRIANGLE)
        return arrays(cls, 0, m, m, (0, markers, size, 3), covariances)


class PredictSettings(NamedTuple):
    """Parameters of ``predict`` that the kernel needs."""

    noise_ratio: float
    max_gap: float
    corrected: bool


@kernel
def _diagonal(size: int, variance: float) -> Covariance:
    """Covariance of a state with ``size`` elements of equal variance."""
    return variance, 0.0, 0.0, variance if size > 1 else 0.0, 0.0, variance if size > 2 else 0.0


@kernel
def _filter(x: Floats, p: Floats, marker: Floats, steps: float, settings: PredictSettings) -> None:
    """Carry a joint on by ``steps``; replace a measured marker (19,) by the paper's result.

    All variances are multiples of R. Q is that of every element of the state and accumulates.
    """
    process = _diagonal(len(x), settings.noise_ratio * steps)  # Q
    predict(x, p, steps, process)  # X~ = A X^, P~ = A P A' + Q
    if np.isnan(marker[_X]):
        return
    predicted = x[0, 0], x[0, 1], x[0, 2]
    correct(x, p, marker[_X : _X + 3], 1.0)  # K, X^ = X~ + K (Z - H X~), P = (1 - K H) P~
    for c in range(3):
        marker[_X + c] = x[0, c] if settings.corrected else predicted[c]  # "X~ is used"
    _write_derivatives(x, marker)


@kernel
def _write_derivatives(x: Floats, marker: Floats) -> None:
    """Write a joint's velocity and acceleration, as far as its state has them."""
    scale = 1.0
    for order in range(1, len(x)):
        scale *= STEP
        for c in range(3):
            marker[_DERIVATIVES[order - 1] + c] = x[order, c] / scale


@entry
def filter_people(
    past: PredictedPeople, markers: F3, rows: I1, stamps: I1, settings: PredictSettings
) -> None:
    """Replace the measured positions of (P, M, 19) and fill in the derivatives of the state.

    Parameters
    ----------
    rows : (P,) row of each person in ``past``; -1 = left alone. stamps : (P,) times, ns.
    """
    for i in range(len(rows)):
        row, now = rows[i], stamps[i]
        if row < 0:
            continue
        steps = (now - past.stamps[row]) * 1e-9 / STEP
        for m in range(markers.shape[1]):
            x, p, marker = past.states[row, m], past.covariances[row, m], markers[i, m]
            is_seen = not np.isnan(marker[_X])
            unseen_for = (now - past.seen[row, m]) * 1e-9
            if past.started[row, m] and unseen_for <= settings.max_gap:
                _filter(x, p, marker, steps, settings)
            elif is_seen:
                start(x, p, marker[_X : _X + 3], _diagonal(len(x), 1.0))
                past.started[row, m] = True
                _write_derivatives(x, marker)
            if is_seen:
                past.seen[row, m] = now
        past.stamps[row] = now
