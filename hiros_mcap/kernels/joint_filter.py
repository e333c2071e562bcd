"""Malaguti's Kalman filter of all joints, joint by joint, and his limb lengths.

The 6M-state filter of the paper has no noise that couples two joints or two axes: its covariance
stays block-diagonal, and the three axes of a joint share one 2x2 block. So a joint is 3 positions,
3 velocities and 3 numbers of covariance, which is exact and two thousand times faster.
"""

# mypy: disable-error-code="no-any-return"

from __future__ import annotations

import numpy as np
from numba import types

from hiros_mcap.kernels.compile import kernel
from hiros_mcap.skeletons import Flags, Floats, Ints, Stamps

# Columns of ``numbers``.
MEASUREMENT, PROCESS, STEP, REJECT, OUTLIER, LIMIT, CONFIDENCE = 0, 1, 2, 3, 4, 5, 6
# Columns of a joint's state: position, velocity, covariance 00 01 11.
STATE = 9
_VELOCITY = 7

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


@kernel
def _correct(
    states: Floats,
    known: Flags,
    history: Floats,
    filled: Stamps,
    strikes: Stamps,
    row: int,
    markers: Floats,
    p: int,
    confidences: Floats,
    extra: float,
    numbers: Floats,
) -> int:
    """Update one person with one detection; return how many joints were taken for outliers.

    Parameters
    ----------
    states : (R, M, 9), predicted to the detection's time. known : (R, M), joints that have one.
    history : (R, M, N) last distances of accepted measurements, m; filled, strikes : (R, M).
    markers : (P, M, 19) m; confidences : (P, M); of person ``p``. extra : variance added, m2.
    numbers : see the columns above.
    """
    outliers = 0
    for m in range(states.shape[1]):
        if np.isnan(markers[p, m, 0]):
            continue
        confidence = 1.0
        if numbers[CONFIDENCE] > 0 and not np.isnan(confidences[p, m]):
            confidence = confidences[p, m]
            if confidence < numbers[REJECT]:
                continue  # the prediction stands in for it (III-C)
        variance = numbers[MEASUREMENT] / max(confidence, 1e-3) + extra  # eq 8
        state = states[row, m]
        if not known[row, m]:
            known[row, m] = True
            for c in range(3):
                state[c] = markers[p, m, c]
                state[3 + c] = 0.0
            state[6], state[7], state[8] = variance, 0.0, 1.0
            filled[row, m] = strikes[row, m] = 0
            continue
        squared = 0.0
        for c in range(3):
            squared += (markers[p, m, c] - state[c]) ** 2
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
            error = markers[p, m, c] - state[c]
            state[c] += gain0 * error
            state[3 + c] += gain1 * error
        state[8] -= gain1 * state[7]
        state[7] *= 1 - gain0
        state[6] *= 1 - gain0
    return outliers


@kernel(
    types.int64(
        _F3,
        types.boolean[:, ::1],
        _F3,
        types.int64[:, ::1],
        types.int64[:, ::1],
        types.int64[::1],
        types.int64[::1],
        _F1,
        _F3,
        _F2,
        _F1,
        _F1,
    )
)
def update(
    states: Floats,
    known: Flags,
    history: Floats,
    filled: Stamps,
    strikes: Stamps,
    rows: Stamps,
    people: Stamps,
    dts: Floats,
    markers: Floats,
    confidences: Floats,
    extra: Floats,
    numbers: Floats,
) -> int:
    """Predict and correct the people of one message; return how many joints were outliers.

    ``people[i]`` of markers (P, M, 19) is the person in row ``rows[i]``, last seen ``dts[i]`` s
    ago; extra (P,) m2. The rest is as in :func:`correct`.
    """
    outliers = 0
    for i in range(len(rows)):
        row, p = rows[i], people[i]
        if dts[i] > 0:
            predict(states, known, row, dts[i], numbers[PROCESS], numbers[STEP])
        outliers += _correct(
            states, known, history, filled, strikes, row, markers, p, confidences, extra[i], numbers
        )
    return outliers


@kernel(types.void(_F3, types.boolean[:, ::1], types.int64[::1], _F1, _F3))
def emit(states: Floats, known: Flags, rows: Stamps, dts: Floats, markers: Floats) -> None:
    """Write positions and velocities of ``rows``, ``dts`` s on, into markers (P, M, 19)."""
    for i in range(len(rows)):
        row = rows[i]
        for m in range(states.shape[1]):
            for c in range(3):
                if known[row, m]:
                    velocity = states[row, m, 3 + c]
                    markers[i, m, c] = states[row, m, c] + dts[i] * velocity
                    markers[i, m, _VELOCITY + c] = velocity
                else:
                    markers[i, m, c] = markers[i, m, _VELOCITY + c] = np.nan


@kernel
def _move_chain(
    markers: Floats, p: int, lengths: Floats, row: int, links: Ints, order: Stamps
) -> None:
    """Place every child, parents first.

    A child's filtered place is needed just once, when it is placed: all happens in place.
    """
    for k in order:
        parent, child = links[k, 0], links[k, 1]
        squared = 0.0
        for c in range(3):
            squared += (markers[p, child, c] - markers[p, parent, c]) ** 2
        if np.isnan(squared) or squared < 1e-12:
            continue
        scale = lengths[row, k] / np.sqrt(squared)
        for c in range(3):
            start = markers[p, parent, c]
            markers[p, child, c] = start + scale * (markers[p, child, c] - start)


@kernel(
    types.void(
        _F3,
        types.int64[::1],
        _F2,
        types.int64[::1],
        types.int32[:, ::1],
        types.int64[::1],
        types.int64,
        types.float64,
    )
)
def straighten(
    markers: Floats,
    rows: Stamps,
    lengths: Floats,
    frames: Stamps,
    links: Ints,
    order: Stamps,
    enough: int,
    rate: float,
) -> None:
    """Learn the lengths of people's links, and give every link its length, root to leaves.

    The minimum of eq 12 in closed form: the child lies on the line from its parent, where that now
    is, to where the filter has the child, at the link's length; both terms are 0 there.

    Parameters
    ----------
    markers : (P, M, 19), positions changed in place once a person has ``enough`` frames.
    rows : (P,) row of each person in lengths (R, L), m, and frames (R,); -1 = leave alone.
    links : (L, 2) marker slots; order : links, parents first. rate : share of a new measurement.
    """
    measured = 0.0
    for p in range(markers.shape[0]):
        row = rows[p]
        if row < 0:
            continue
        whole = True
        for k in order:
            whole &= not np.isnan(markers[p, links[k, 0], 0] + markers[p, links[k, 1], 0])
        for k in order:
            squared = 0.0
            for c in range(3):
                squared += (markers[p, links[k, 0], c] - markers[p, links[k, 1], c]) ** 2
            measured = np.sqrt(squared)
            if frames[row] < enough:
                if whole:
                    lengths[row, k] += (measured - lengths[row, k]) / (frames[row] + 1)
            elif not np.isnan(measured):
                lengths[row, k] += rate * (measured - lengths[row, k])
        if frames[row] < enough:
            frames[row] += whole
        if frames[row] < enough:
            continue
        _move_chain(markers, p, lengths, row, links, order)
