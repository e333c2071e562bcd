"""Malaguti's Kalman filter of all joints, joint by joint, and his limb lengths.

The 6M-state filter of the paper has no noise that couples two joints or two axes: its covariance
stays block-diagonal, and the three axes of a joint share one 2x2 block. So a joint is 3 positions,
3 velocities and 3 numbers of covariance, which is exact and two thousand times faster.
"""

# mypy: disable-error-code="no-any-return"

from __future__ import annotations

import numpy as np
from numba import types

from hiros_mcap.kernels.unaligned import kernel
from hiros_mcap.skeletons import Flags, Floats, Ints, Stamps

# Columns of ``numbers``.
MEASUREMENT, PROCESS, STEP, REJECT, OUTLIER, LIMIT, CONFIDENCE = 0, 1, 2, 3, 4, 5, 6
NUMBERS = 7
# Columns of a joint's state: position, velocity, covariance 00 01 11.
STATE = 9

_F1, _F2, _F3 = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]


@kernel
def _predict(state: Floats, dt: float, process: float, step: float) -> None:
    """One joint, ``dt`` s on: eq 5, in steps of the paper's period or exactly."""
    if step > 0:
        n = int(np.round(dt / step))
        for _ in range(n):
            _advance(state, step, process * step**4 / 4, process * step**3 / 2, process * step**2)
    else:
        q = process / 30.0  # as much as the paper's model adds per second at its 30 Hz
        _advance(state, dt, q * dt**3 / 3, q * dt**2 / 2, q * dt)


@kernel
def _advance(state: Floats, dt: float, q00: float, q01: float, q11: float) -> None:
    for c in range(3):
        state[c] += dt * state[3 + c]
    state[6] += dt * (2 * state[7] + dt * state[8]) + q00
    state[7] += dt * state[8] + q01
    state[8] += q11


@kernel(
    types.void(_F3, types.boolean[:, ::1], types.int64, types.float64, types.float64, types.float64)
)
def predict(states: Floats, known: Flags, row: int, dt: float, process: float, step: float) -> None:
    """Carry the joints (R, M, 9) of one person on by ``dt`` s."""
    for m in range(states.shape[1]):
        if known[row, m]:
            _predict(states[row, m], dt, process, step)


@kernel(
    types.int64(
        _F3,
        types.boolean[:, ::1],
        _F3,
        types.int64[:, ::1],
        types.int64[:, ::1],
        types.int64,
        _F2,
        _F1,
        types.float64,
        _F1,
    )
)
def correct(
    states: Floats,
    known: Flags,
    history: Floats,
    filled: Stamps,
    strikes: Stamps,
    row: int,
    positions: Floats,
    confidences: Floats,
    extra: float,
    numbers: Floats,
) -> int:
    """Update one person with one detection; return how many joints were taken for outliers.

    Parameters
    ----------
    states : (R, M, 9), predicted to the detection's time. known : (R, M), joints that have one.
    history : (R, M, N) last distances of accepted measurements, m; filled, strikes : (R, M).
    positions : (M, 3) m. confidences : (M,). extra : variance added to all, m2.
    numbers : see the columns above.
    """
    outliers = 0
    for m in range(states.shape[1]):
        if np.isnan(positions[m, 0]):
            continue
        confidence = 1.0
        if numbers[CONFIDENCE] > 0 and not np.isnan(confidences[m]):
            confidence = confidences[m]
            if confidence < numbers[REJECT]:
                continue  # the prediction stands in for it (III-C)
        variance = numbers[MEASUREMENT] / max(confidence, 1e-3) + extra  # eq 8
        state = states[row, m]
        if not known[row, m]:
            known[row, m] = True
            for c in range(3):
                state[c] = positions[m, c]
                state[3 + c] = 0.0
            state[6], state[7], state[8] = variance, 0.0, 1.0
            filled[row, m] = strikes[row, m] = 0
            continue
        squared = 0.0
        for c in range(3):
            squared += (positions[m, c] - state[c]) ** 2
        distance = np.sqrt(squared)
        size = history.shape[2]
        if size > 0:
            highest = 0.0
            for i in range(size):
                highest = max(highest, history[row, m, i])
            threshold = numbers[OUTLIER] * highest  # eq 9
            suspicious = filled[row, m] >= size and distance > threshold > 0
            if suspicious and strikes[row, m] < numbers[LIMIT]:
                strikes[row, m] += 1
                outliers += 1
                variance *= distance / threshold  # eq 10
            else:
                strikes[row, m] = 0
                history[row, m, filled[row, m] % size] = distance
                filled[row, m] += 1
        gain0 = state[6] / (state[6] + variance)
        gain1 = state[7] / (state[6] + variance)
        for c in range(3):
            error = positions[m, c] - state[c]
            state[c] += gain0 * error
            state[3 + c] += gain1 * error
        state[8] -= gain1 * state[7]
        state[7] *= 1 - gain0
        state[6] *= 1 - gain0
    return outliers


@kernel(types.void(_F2, types.int32[:, ::1], types.int64[::1], _F1, _F2))
def straighten(positions: Floats, links: Ints, order: Stamps, lengths: Floats, out: Floats) -> None:
    """Give every link its length, from the root to the leaves; (M, 3) to (M, 3).

    The minimum of eq 12 in closed form: the child lies on the line from its parent, where that now
    is, to where the filter has the child, at the link's length; both terms are 0 there.
    """
    for m in range(positions.shape[0]):
        for c in range(3):
            out[m, c] = positions[m, c]
    for k in order:
        parent, child = links[k, 0], links[k, 1]
        squared = 0.0
        for c in range(3):
            squared += (positions[child, c] - out[parent, c]) ** 2
        if np.isnan(squared) or squared < 1e-12 or np.isnan(lengths[k]):
            continue
        scale = lengths[k] / np.sqrt(squared)
        for c in range(3):
            out[child, c] = out[parent, c] + scale * (positions[child, c] - out[parent, c])
