"""Kernel of Lee's Kalman filter: every joint on its own (Lee et al. 2022, section 2.2.3).

The three axes of a joint share one covariance, since they share every noise.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from hiros_mcap.kernels.compile import kernel
from hiros_mcap.skeletons import Floats

_DERIVATIVES = (7, 13)  # first columns of velocity and acceleration in a KinematicState


@kernel
def _write_derivatives(state: Floats, m: int, period: float, out: Floats) -> None:
    """Write a joint's velocity and acceleration, as far as its state has them."""
    scale = 1.0
    for order in range(1, state.shape[1]):
        scale *= period
        for c in range(3):
            out[_DERIVATIVES[order - 1] + c] = state[m, order, c] / scale


@njit(
    "void(float64[:,:,::1], int64, float64, float64, float64, float64, float64, boolean,"
    " float64[:,:,::1], float64[:,:,::1], float64[::1])",
    cache=True,
    nogil=True,
)
def predict_and_correct(
    markers: Floats,
    p: int,
    steps: float,
    period: float,
    process: float,
    measurement: float,
    max_steps: float,
    corrected: bool,
    state: Floats,
    covariance: Floats,
    age: Floats,
) -> None:
    """Predict each joint, correct it by its measurement, write one of both, and its derivatives.

    Parameters
    ----------
    markers : (P, M, 19); row ``p`` holds the measured positions, which are replaced; velocities,
        and accelerations if the state has them, are filled in where a position is measured.
    steps : time since the previous call, in time steps of the noises. period : s of such a step.
    process, measurement : Q per step and R, m2; Q is that of every element of the state.
    max_steps : after so long without a measurement a joint starts anew.
    corrected : whether the corrected position is written, or the predicted one.
    state : (M, S, 3) position and its derivatives, per step. covariance : (M, S, S).
    age : (M,) steps since the last measurement, inf = not known.
    """
    size = state.shape[1]
    move, moved = np.zeros((size, size)), np.empty((size, size))
    for i in range(size):
        move[i, i] = 1.0
        for j in range(i + 1, size):
            move[i, j] = move[i, j - 1] * steps / (j - i)
    for m in range(len(age)):
        here = markers[p, m]
        seen = not math.isnan(here[0])
        age[m] += steps
        if age[m] > max_steps:
            age[m] = np.inf
            if not seen:
                continue
            for i in range(size):
                for c in range(3):
                    state[m, i, c] = here[c] if i == 0 else 0.0
                for j in range(size):
                    covariance[m, i, j] = measurement if i == j else 0.0
            age[m] = 0.0
            _write_derivatives(state, m, period, here)
            continue
        for i in range(size):
            for c in range(3):
                total = 0.0
                for j in range(i, size):
                    total += move[i, j] * state[m, j, c]
                state[m, i, c] = total
        for i in range(size):
            for j in range(size):
                total = 0.0
                for k in range(i, size):
                    total += move[i, k] * covariance[m, k, j]
                moved[i, j] = total
        for i in range(size):
            for j in range(size):
                total = process * steps if i == j else 0.0
                for k in range(j, size):
                    total += moved[i, k] * move[j, k]
                covariance[m, i, j] = total
        if not seen:
            continue
        age[m] = 0.0
        scale = 1.0 / (covariance[m, 0, 0] + measurement)
        for c in range(3):
            predicted = state[m, 0, c]
            change = here[c] - predicted
            for i in range(size):
                state[m, i, c] += covariance[m, i, 0] * scale * change
            here[c] = state[m, 0, c] if corrected else predicted
        _write_derivatives(state, m, period, here)
        for i in range(size - 1, -1, -1):  # the first row, which the others need, comes last
            gain = covariance[m, i, 0] * scale
            for j in range(size):
                covariance[m, i, j] -= gain * covariance[m, 0, j]
