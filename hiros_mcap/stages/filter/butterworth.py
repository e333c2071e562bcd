"""Butterworth low-pass of any order for trajectories (Hi-ROS 2023, section 3.4).

The analogue filter runs by the trapezoidal rule (bilinear transform) over each sample's own
interval. Its states are the derivatives of the output, so velocity and acceleration come for free.
All steps are functions of one stable matrix, so any mixture of intervals is stable. The corner is
prewarped: at a steady rate the response is the digital Butterworth filter's. An interval much
longer than usual is taken in shorter steps along a straight line, which prevents ringing. For an
orientation all of it happens in the tangent space at the last output.

With a look-ahead the same filter also runs backwards over the outputs, which cancels its phase
(Winter 2009, section 2.4). The backward run is linear: one weight per step, for all trajectories.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.kernels.quaternions import Quaternion, Vector
from hiros_mcap.skeletons import Floats, People
from hiros_mcap.stages.filter.filtering import (
    GROUPS,
    SLOT_ACCELERATION,
    SLOT_AGE,
    SLOT_CONFIDENCE,
    SLOT_CONTINUES,
    SLOT_METHOD,
    SLOT_POSE,
    SLOT_VELOCITY,
    FilterMethod,
    FilterPast,
    FilterSteps,
    Group,
    Step,
    Window,
    clear,
    difference,
    displace,
    erase,
    fill_confidence,
    group_of,
    is_shown,
    measure,
    pose_at,
    put,
    step_of,
    vector_at,
    window_of,
    write_motion,
    write_pose,
)

# Columns of a trajectory's state.
INPUT = 0  # the last measurement
DERIVATIVES = 4  # of the output, 1 to order - 1, the i-th over corner^i; by component

# Column of a slot beside the common ones, whose pose is the output at the last measurement.
MEAN_VELOCITY = SLOT_METHOD  # of the output, between the last two measurements
SLOT_COLUMNS = SLOT_METHOD + 3


class ButterworthWork(NamedTuple):
    """The filter, and scratch."""

    polynomial: F1  # (order + 1,) ascending coefficients of the normalized Butterworth polynomial
    state: F2  # (3, order) the output relative to the last one and its derivatives, by component
    adjoint: F1  # (order,)
    weights: F1  # (R,) of the steps of a window
    motion: F1  # (6,) velocity and acceleration


@kernel
def _substeps(interval: float, period: float) -> int:
    """Return into how many steps an interval is divided if ``period`` is the usual one."""
    return 1 if interval < 1.5 * period else int(np.ceil(interval / period - 0.1))


@kernel
def _advance(state: Floats, polynomial: Floats, h: float, u: float) -> None:
    """Trapezoidal rule: s' = 2 x - s, (I - h A) x = s + h b u, with the companion matrix A.

    ``state`` (order,), ``h`` half of corner times interval, ``u`` the input in the middle.
    """
    n = len(state)
    top, c, scale = state[n - 1] + h * u, 0.0, 1.0
    for i in range(n - 2, -1, -1):  # x_i = c_i + h^(n-1-i) x_(n-1)
        c = state[i] + h * c
        top -= h * polynomial[i] * c
    scale = polynomial[0]
    for i in range(1, n + 1):
        scale = h * scale + polynomial[i]
    x = top / scale
    state[n - 1] = 2.0 * x - state[n - 1]
    for i in range(n - 2, -1, -1):
        x = state[i] + h * x
        state[i] = 2.0 * x - state[i]


@kernel
def _carry_back(adjoint: Floats, polynomial: Floats, h: float) -> float:
    """Transpose of :func:`_advance`: r' = 2 y - r, (I - h A)' y = r; return the weight of u."""
    n, p, q = len(adjoint), 0.0, 0.0
    for i in range(n):  # y_i = p_i - q_i y_(n-1)
        p = adjoint[i] + h * p
        q = h * (polynomial[i] + q)
    top, p, q = p / (1.0 + q), 0.0, 0.0
    for i in range(n):
        p = adjoint[i] + h * p
        q = h * (polynomial[i] + q)
        adjoint[i] = 2.0 * (p - q * top) - adjoint[i]
    return 2.0 * h * top


@kernel
def _hold(before: Any, age: float, slot: Any) -> None:
    """Fill the slot of a trajectory that is not measured."""
    for c in range(len(slot)):
        slot[c] = before[c]
    put(slot, SLOT_ACCELERATION, (0.0, 0.0, 0.0))
    slot[SLOT_AGE] = age
    slot[SLOT_CONTINUES] = 1.0


@kernel
def _start(z: Quaternion, state: Any, slot: Any) -> None:
    """Start at rest."""
    state[:] = 0.0
    slot[:] = 0.0
    put(state, INPUT, z)
    put(slot, SLOT_POSE, z)


@kernel
def _load(row: Any, state: Floats) -> None:
    """Load the derivatives of a trajectory; its output is the origin."""
    n = state.shape[1]
    for c in range(3):
        state[c, 0] = 0.0
        for i in range(1, n):
            state[c, i] = row[DERIVATIVES + c * (n - 1) + i - 1]


@kernel
def _store(row: Any, state: Floats) -> None:
    n = state.shape[1]
    for c in range(3):
        for i in range(1, n):
            row[DERIVATIVES + c * (n - 1) + i - 1] = state[c, i]


@kernel
def _filter(
    z: Quaternion, angular: bool, age: float, t: int, step: Step, work: ButterworthWork
) -> None:
    """Run a trajectory from its last measurement, ``age`` s ago, to measurement ``z``."""
    row, slot, last = step.states[t], step.slot[t], pose_at(step.before[t], SLOT_POSE)
    u0 = difference(pose_at(row, INPUT), last, angular)
    u1 = difference(z, last, angular)
    _load(row, work.state)
    count = _substeps(age, step.period)
    h = 0.5 * step.tuning * age / count
    for i in range(count):
        middle = (i + 0.5) / count
        for c in range(3):
            _advance(work.state[c], work.polynomial, h, u0[c] + middle * (u1[c] - u0[c]))
    s = work.state
    output = displace(last, (s[0, 0], s[1, 0], s[2, 0]), angular)
    moved = difference(output, last, angular)
    put(slot, MEAN_VELOCITY, (moved[0] / age, moved[1] / age, moved[2] / age))
    put(slot, SLOT_POSE, output)
    _derive(difference(z, output, angular), t, step, work)
    put(row, INPUT, z)
    _store(row, work.state)
    slot[SLOT_CONTINUES] = 1.0


@kernel
def _derive(u: Vector, t: int, step: Step, work: ButterworthWork) -> None:
    """Velocity and acceleration of the output, given the input ``u`` relative to it.

    The highest derivative follows from the differential equation, and an acceleration at order 1
    from the previous velocity.
    """
    slot, before, n, rate = step.slot[t], step.before[t], work.state.shape[1], step.tuning
    for c in range(3):
        top = u[c]
        for i in range(1, n):
            top -= work.polynomial[i] * work.state[c, i]
        velocity = rate * (work.state[c, 1] if n > 1 else top)
        slot[SLOT_VELOCITY + c] = velocity
        if n == 1:
            change = velocity - before[SLOT_VELOCITY + c]
            slot[SLOT_ACCELERATION + c] = change / step.interval
        else:
            slot[SLOT_ACCELERATION + c] = rate * rate * (work.state[c, 2] if n > 2 else top)


@entry
def update(
    people: People, steps: FilterSteps, past: FilterPast,
    work: ButterworthWork,
) -> None:  # fmt: skip
    """Run the trajectories that are measured at each step; hold the others; start new ones."""
    for j in range(len(steps.rows)):
        step = step_of(steps, past, j)
        for number in range(GROUPS):
            group = group_of(people, steps.people[j], number)
            for k in range(len(group.elements)):
                t = group.first + k
                slot, before = step.slot[t], step.before[t]
                z, seen = measure(group, k)
                age = before[SLOT_AGE] + step.interval
                active = age <= steps.max_gap
                if not seen:
                    if active:
                        _hold(before, age, slot)
                    else:
                        clear(slot)
                    continue
                if active:
                    _filter(z, group.angular, age, t, step, work)
                else:
                    _start(z, step.states[t], slot)
                slot[SLOT_AGE] = 0.0
                slot[SLOT_CONFIDENCE] = group.confidences[k]


@entry
def write_weights(window: Window, work: ButterworthWork) -> None:
    """Weight of the output of each step of a window in the backward run; their sum is 1."""
    n_steps = window.end - window.first
    work.weights[:n_steps] = 0.0
    work.adjoint[:] = 0.0
    work.adjoint[0] = 1.0
    for i in range(n_steps - 1):
        step = window.first + i
        dt = window.times[(step + 1) & window.mask] - window.times[step & window.mask]
        count = _substeps(dt, window.period)
        for part in range(count):
            later = (part + 0.5) / count
            weight = _carry_back(work.adjoint, work.polynomial, 0.5 * window.tuning * dt / count)
            work.weights[i] += weight * (1.0 - later)
            work.weights[i + 1] += weight * later
    work.weights[n_steps - 1] += work.adjoint[0]  # the backward run starts at rest


@kernel
def _run_back(group: Group, k: int, window: Window, weights: Floats, motion: Floats) -> None:
    """Write the weighted mean of a trajectory's outputs, velocities and accelerations.

    Between two measurements the output moves evenly; after the last one, at its velocity. Where
    the trajectory ends within the window, it stays as it was last.
    """
    t, mask, first = group.first + k, window.mask, window.first
    last = first
    while last + 1 < window.end and window.ring[(last + 1) & mask, t, SLOT_CONTINUES] == 1.0:
        last += 1
    velocity, x, y, z = vector_at(window.ring[last & mask, t], SLOT_VELOCITY), 0.0, 0.0, 0.0
    later = 0.0
    motion[:] = 0.0
    for step in range(window.end - 1, first - 1, -1):
        slot = window.ring[min(step, last) & mask, t]
        weight = weights[step - first]
        later += weight
        for c in range(3):
            motion[c] += weight * slot[SLOT_VELOCITY + c]
            motion[3 + c] += weight * slot[SLOT_ACCELERATION + c]
        if first < step <= last:
            if slot[SLOT_AGE] == 0.0:
                velocity = vector_at(slot, MEAN_VELOCITY)
            share = later * (window.times[step & mask] - window.times[(step - 1) & mask])
            x, y, z = x + share * velocity[0], y + share * velocity[1], z + share * velocity[2]
    slot = window.ring[first & mask, t]
    pose, age = pose_at(slot, SLOT_POSE), slot[SLOT_AGE]
    if age > 0.0:
        since = age * velocity[0], age * velocity[1], age * velocity[2]
        pose = displace(pose, since, group.angular)
    write_pose(group, k, displace(pose, (x, y, z), group.angular))
    for c in range(3):
        write_motion(group, k, c, motion[c], motion[3 + c])


@entry
def estimate(
    people: People, steps: FilterSteps, past: FilterPast,
    work: ButterworthWork,
) -> None:  # fmt: skip
    """Write the estimates of steps, given the data until their ends."""
    for j in range(len(steps.rows)):
        window = window_of(steps, past, j)
        write_weights(window, work)
        for number in range(GROUPS):
            group = group_of(people, steps.people[j], number)
            for k in range(len(group.elements)):
                t = group.first + k
                slot = window.ring[window.first & window.mask, t]
                if not slot[SLOT_AGE] < np.inf:
                    continue
                if not is_shown(window, t, steps.bridge):
                    erase(group, k)
                    continue
                _run_back(group, k, window, work.weights, work.motion)
                fill_confidence(group, k, slot)


def polynomial_of(order: int) -> Floats:
    """Ascending coefficients of the normalized Butterworth polynomial, (order + 1,)."""
    from scipy.signal import butter

    return np.ascontiguousarray(butter(order, 1.0, analog=True)[1][::-1])


def work_of(order: int, slots: int) -> ButterworthWork:
    """Return the filter of an order, and scratch for a ring of so many slots."""
    scratch = np.zeros((3, order)), np.zeros(order), np.zeros(slots), np.zeros(6)
    return ButterworthWork(polynomial_of(order), *scratch)


def gain_at(corner: float, dt: float, ahead: int, frequency: float, work: ButterworthWork) -> float:
    """Magnitude response at a constant sample time ``dt``, s; ``ahead`` in samples, 0 = causal.

    ``corner`` is the analogue filter's, rad/s; ``frequency`` in Hz.
    """
    warped = 2.0 / dt * np.tan(np.pi * frequency * dt)  # bilinear transform
    forward = 1.0 / np.sqrt(1.0 + (warped / corner) ** (2 * len(work.adjoint)))
    steps = np.arange(ahead + 1, dtype=np.float64)
    write_weights(Window(np.zeros((0, 0, 0)), steps * dt, -1, 0, ahead + 1, corner, dt), work)
    backward = work.weights[: ahead + 1] @ np.exp(2j * np.pi * frequency * dt * steps)
    return float(forward * abs(backward))


def tune(order: int, cutoff: float, dt: float, ahead: int) -> float:
    """Corner, rad/s, that puts the -3 dB point of :func:`gain_at` at ``cutoff``, Hz."""
    from scipy.optimize import brentq

    work, middle = work_of(order, ahead + 1), np.log(2.0 * np.pi * cutoff)

    def excess(corner: float) -> float:
        return float(gain_at(np.exp(corner), dt, ahead, cutoff, work) - np.sqrt(0.5))

    return float(np.exp(brentq(excess, middle - 1.0, middle + 5.0, xtol=1e-13)))


METHOD = FilterMethod(
    tune=tune,
    update=update,
    estimate=estimate,
    work=work_of,
    state_columns=lambda order: DERIVATIVES + 3 * (order - 1),
    slot_columns=SLOT_COLUMNS,
)
