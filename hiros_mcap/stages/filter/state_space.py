"""State-space filter (Hi-ROS 2023, section 3.4): Kalman filter and fixed-lag smoother.

The process is integrated white noise: white acceleration at order 2, white jerk at order 3
(Bar-Shalom et al. 2001, sections 6.2.2 and 6.2.3). A measurement has variance 1, so the ratio of
the noises is the only number to tune.

The smoother is Bryson and Frazier's (Bierman 1977, section X.4): it carries back an adjoint of the
innovations instead of states. It needs no inverse and, for an orientation, one exponential.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.kernels import kalman_filter
from hiros_mcap.kernels.array_types import F2
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.kernels.kalman_filter import Covariance, Gain
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

# Columns of a trajectory's state, all after the correction.
POSE = 0
VELOCITY = 4
ACCELERATION = 7
COVARIANCE = 10  # 00 01 02 11 12 22
STATE_COLUMNS = 16

# Columns of a slot beside the common ones, which hold the prediction.
INNOVATION = SLOT_METHOD
INFORMATION = SLOT_METHOD + 3  # 1 / variance of the innovation; 0 = not measured
PREDICTED_COVARIANCE = SLOT_METHOD + 4
SLOT_COLUMNS = SLOT_METHOD + 10

DIFFUSE = 1e6  # variance of the prior over that of a measurement

# What happens to a trajectory in a step.
STARTS, UNSEEN, SEEN = 0, 1, 2


class CovarianceStep(NamedTuple):
    """One step of a covariance."""

    case: int
    before: Covariance
    predicted: Covariance
    information: float
    gain: Gain
    corrected: Covariance


@kernel
def _process_noise(dt: float, noise: float, order: int) -> Covariance:
    """Q of integrated white noise."""
    if order == 2:
        return kalman_filter.white_acceleration(dt, noise)
    return kalman_filter.white_jerk(dt, noise)


@kernel
def _prior(noise: float, order: int) -> Covariance:
    """Diffuse prior: nothing is known of the first pose, velocity and acceleration."""
    rate = noise ** (1.0 / (2 * order - 1))
    acceleration = DIFFUSE * rate**4 if order == 3 else 0.0
    return kalman_filter.prior(DIFFUSE, DIFFUSE * rate**2, acceleration)


@kernel
def _covariance_step(
    case: int, before: Covariance, dt: float, noise: float, order: int
) -> CovarianceStep:
    """Predict a covariance and, if there is a measurement, correct it."""
    if case == STARTS:
        p = _prior(noise, order)
    else:
        p = kalman_filter.predict(before, dt, _process_noise(dt, noise, order))
    if case == UNSEEN:
        return CovarianceStep(case, before, p, 0.0, (0.0, 0.0, 0.0), p)
    variance = p[0] + 1.0
    k = kalman_filter.gain(p, variance)
    return CovarianceStep(case, before, p, 1.0 / variance, k, kalman_filter.correct(p, k))


@kernel
def _covariance_at(row: Any, column: int) -> Covariance:
    return (
        row[column], row[column + 1], row[column + 2],
        row[column + 3], row[column + 4], row[column + 5],
    )  # fmt: skip


@kernel
def _predict(state: Any, dt: float, angular: bool, slot: Any) -> None:
    """Carry a state on by ``dt`` with constant acceleration, into a slot."""
    v, a = vector_at(state, VELOCITY), vector_at(state, ACCELERATION)
    step = (
        dt * (v[0] + 0.5 * dt * a[0]),
        dt * (v[1] + 0.5 * dt * a[1]),
        dt * (v[2] + 0.5 * dt * a[2]),
    )
    put(slot, SLOT_POSE, displace(pose_at(state, POSE), step, angular))
    put(slot, SLOT_VELOCITY, (v[0] + dt * a[0], v[1] + dt * a[1], v[2] + dt * a[2]))
    put(slot, SLOT_ACCELERATION, a)


@kernel
def _start(z: Quaternion, slot: Any) -> None:
    """Let the first measurement be the prediction, at rest."""
    put(slot, SLOT_POSE, z)
    put(slot, SLOT_VELOCITY, (0.0, 0.0, 0.0))
    put(slot, SLOT_ACCELERATION, (0.0, 0.0, 0.0))


@kernel
def _correct(
    slot: Any, innovation: Vector, step: CovarianceStep, angular: bool, state: Any
) -> None:
    """State after the measurement: x + K innovation. The smoother's numbers stay in the slot."""
    k = step.gain
    shift = k[0] * innovation[0], k[0] * innovation[1], k[0] * innovation[2]
    put(state, POSE, displace(pose_at(slot, SLOT_POSE), shift, angular))
    for c in range(3):
        state[VELOCITY + c] = slot[SLOT_VELOCITY + c] + k[1] * innovation[c]
        state[ACCELERATION + c] = slot[SLOT_ACCELERATION + c] + k[2] * innovation[c]
    put(state, COVARIANCE, step.corrected)
    put(slot, INNOVATION, innovation)
    slot[INFORMATION] = step.information
    put(slot, PREDICTED_COVARIANCE, step.predicted)


@entry
def update(
    people: People, steps: FilterSteps, past: FilterPast, work: F2,
) -> None:  # fmt: skip
    """Predict every trajectory of every step; correct those that are measured; start new ones."""
    for j in range(len(steps.rows)):
        step = step_of(steps, past, j)
        nothing = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        shared = CovarianceStep(-1, nothing, nothing, 0.0, (0.0, 0.0, 0.0), nothing)
        for number in range(GROUPS):
            group = group_of(people, steps.people[j], number)
            for k in range(len(group.elements)):
                t = group.first + k
                state, slot, before = step.states[t], step.slot[t], step.before[t]
                z, seen = measure(group, k)
                age = before[SLOT_AGE] + step.interval
                active = age <= steps.max_gap
                if not active and not seen:
                    clear(slot)
                    continue
                case = STARTS if not active else SEEN if seen else UNSEEN
                # Trajectories with the same history have the same covariance.
                covariance = _covariance_at(state, COVARIANCE)
                if case != shared.case or (case != STARTS and covariance != shared.before):
                    shared = _covariance_step(
                        case, covariance, step.interval, step.tuning, steps.order
                    )
                if active:
                    _predict(state, step.interval, group.angular, slot)
                else:
                    _start(z, slot)
                innovation = (0.0, 0.0, 0.0)
                if seen:
                    innovation = difference(z, pose_at(slot, SLOT_POSE), group.angular)
                _correct(slot, innovation, shared, group.angular, state)
                slot[SLOT_CONTINUES] = 1.0 if active else 0.0
                slot[SLOT_AGE] = 0.0 if seen else age
                slot[SLOT_CONFIDENCE] = group.confidences[k] if seen else before[SLOT_CONFIDENCE]


@kernel
def _carry_back(window: Window, t: int, adjoint: Floats) -> None:
    """Adjoint of the innovations of a window's steps, at its first step before the measurement.

    ``adjoint`` (3, 3): of position, velocity and acceleration, by component.
    """
    adjoint[:] = 0.0
    stop = window.first + 1
    while stop < window.end and window.ring[stop & window.mask, t, SLOT_CONTINUES] == 1.0:
        stop += 1
    dt = 0.0
    for step in range(stop - 1, window.first - 1, -1):
        slot = window.ring[step & window.mask, t]
        if step < stop - 1:
            dt = window.times[(step + 1) & window.mask] - window.times[step & window.mask]
        half, information = 0.5 * dt * dt, slot[INFORMATION]
        p0, p1, p2 = vector_at(slot, PREDICTED_COVARIANCE)
        for c in range(3):
            # F' a
            a0, a1, a2 = adjoint[0, c], adjoint[1, c], adjoint[2, c]
            a2 += dt * a1 + half * a0
            a1 += dt * a0
            # (I - K H)' a + H' innovation / S; with P H' / S = K, both are one term
            error = slot[INNOVATION + c] - p0 * a0 - p1 * a1 - p2 * a2
            adjoint[0, c] = a0 + information * error
            adjoint[1, c] = a1
            adjoint[2, c] = a2


@kernel
def _acceleration(slot: Any, adjoint: Any, interval: float, window: Window, c: int) -> float:
    """Acceleration at order 2, which has none in its state.

    With a look-ahead it is the smoothed process noise, Q a / dt; without one, the rate at which
    the velocity changed.
    """
    if window.end > window.first + 1:
        return float(window.tuning * adjoint[1, c])
    if interval > 0.0:
        gain = slot[PREDICTED_COVARIANCE + 1] * slot[INFORMATION]
        return float(gain * slot[INNOVATION + c] / interval)
    return float(slot[SLOT_ACCELERATION + c])


@kernel
def _smooth(
    group: Group, k: int, slot: Any, adjoint: Any, window: Window, interval: float, order: int
) -> None:
    """Write the estimate of element ``k``: prediction + P a."""
    p00, p01, p02, p11, p12, p22 = _covariance_at(slot, PREDICTED_COVARIANCE)
    for c in range(3):
        a0, a1, a2 = adjoint[0, c], adjoint[1, c], adjoint[2, c]
        velocity = slot[SLOT_VELOCITY + c] + p01 * a0 + p11 * a1 + p12 * a2
        acceleration = slot[SLOT_ACCELERATION + c] + p02 * a0 + p12 * a1 + p22 * a2
        if order == 2:
            acceleration = _acceleration(slot, adjoint, interval, window, c)
        write_motion(group, k, c, velocity, acceleration)
    shift = (
        p00 * adjoint[0, 0] + p01 * adjoint[1, 0] + p02 * adjoint[2, 0],
        p00 * adjoint[0, 1] + p01 * adjoint[1, 1] + p02 * adjoint[2, 1],
        p00 * adjoint[0, 2] + p01 * adjoint[1, 2] + p02 * adjoint[2, 2],
    )
    write_pose(group, k, displace(pose_at(slot, SLOT_POSE), shift, group.angular))


@entry
def estimate(
    people: People, steps: FilterSteps, past: FilterPast, work: F2,
) -> None:  # fmt: skip
    """Write the estimates of steps, given the data until their ends; ``work`` (3, 3) is scratch."""
    for j in range(len(steps.rows)):
        window, step = window_of(steps, past, j), step_of(steps, past, j)
        interval = step.interval if step.interval < np.inf else 0.0
        for number in range(GROUPS):
            group = group_of(people, steps.people[j], number)
            for k in range(len(group.elements)):
                t = group.first + k
                slot = step.slot[t]
                if not slot[SLOT_AGE] < np.inf:
                    continue
                if not is_shown(window, t, steps.bridge):
                    erase(group, k)
                    continue
                _carry_back(window, t, work)
                _smooth(group, k, slot, work, window, interval, steps.order)
                fill_confidence(group, k, slot)


@entry
def gain_at(order: int, noise: float, dt: float, ahead: int, frequency: float) -> float:
    """Magnitude response of the steady filter (``ahead`` = 0) or fixed-lag smoother.

    ``noise`` is the spectral density of the process noise over the variance of a measurement,
    ``dt`` the sample time in s, ``ahead`` the look-ahead in samples, ``frequency`` in Hz.
    """
    rate = (noise / dt) ** (0.5 / order)
    p = kalman_filter.prior(1.0, rate**2, rate**4 if order == 3 else 0.0)
    k, process = (0.0, 0.0, 0.0), _process_noise(dt, noise, order)
    information = 0.0
    for _ in range(100000):
        last = k[0] + k[order - 1] / rate ** (order - 1)
        before = kalman_filter.predict(p, dt, process)
        information = 1.0 / (before[0] + 1.0)
        k = kalman_filter.gain(before, before[0] + 1.0)
        p = kalman_filter.correct(before, k)
        if abs(k[0] + k[order - 1] / rate ** (order - 1) - last) < 1e-13:
            break
    z = np.exp(2j * np.pi * frequency * dt)
    # (z I - F (I - K H)) x = F K: F is triangular, so x0 = y0 / (1 + y0) with (z I - F) y = F K.
    y2 = k[2] / (z - 1.0)
    y1 = (k[1] + dt * (k[2] + y2)) / (z - 1.0)
    y0 = (k[0] + dt * (k[1] + y1) + 0.5 * dt * dt * (k[2] + y2)) / (z - 1.0)
    predicted = y0 / (1.0 + y0)
    innovation = information * (1.0 - predicted)
    a0 = a1 = a2 = 0j
    for _ in range(ahead + 1):
        m0 = z * a0
        m1 = z * (dt * a0 + a1)
        m2 = z * (0.5 * dt * dt * a0 + dt * a1 + a2)
        a0 = innovation + m0 - k[0] * m0 - k[1] * m1 - k[2] * m2
        a1, a2 = m1, m2
    return float(abs(predicted + before[0] * a0 + before[1] * a1 + before[2] * a2))


@entry
def tune(order: int, cutoff: float, dt: float, ahead: int) -> float:
    """Noise ratio that puts the -3 dB point of :func:`gain_at` at ``cutoff``, Hz."""
    low = 2 * order * np.log(2.0 * np.pi * cutoff) + np.log(dt)
    while gain_at(order, np.exp(low), dt, ahead, cutoff) > np.sqrt(0.5):
        low -= 2.0
    high = low + 2.0
    while gain_at(order, np.exp(high), dt, ahead, cutoff) < np.sqrt(0.5):
        high += 2.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        if gain_at(order, np.exp(middle), dt, ahead, cutoff) < np.sqrt(0.5):
            low = middle
        else:
            high = middle
    return float(np.exp(0.5 * (low + high)))


METHOD = FilterMethod(
    tune=tune,
    update=update,
    estimate=estimate,
    work=lambda order, slots: np.zeros((3, 3)),
    state_columns=lambda order: STATE_COLUMNS,
    slot_columns=SLOT_COLUMNS,
)
