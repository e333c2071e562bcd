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

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import conjugate, from_vector, multiply, to_vector
from hiros_mcap.skeletons import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    ANGULAR_VELOCITY,
    ORIENTATION,
    POSITION,
    VELOCITY,
    Floats,
    People,
)
from hiros_mcap.stages.filter.filtering import (
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
)

_LINEAR = POSITION, VELOCITY, ACCELERATION
_ANGULAR = ORIENTATION, ANGULAR_VELOCITY, ANGULAR_ACCELERATION

# Columns of a slot. Its pose is the output at the last measurement.
_VELOCITY, _ACCELERATION = (slice(c, c + 3) for c in (SLOT_VELOCITY, SLOT_ACCELERATION))
_DERIVATIVES = 4
"""Column of a state, behind the last measurement: by component, the derivatives of the output, 1 to
order - 1, the i-th over corner^i."""


class _Design(NamedTuple):
    """A filter."""

    polynomial: Floats  # (order + 1,) ascending coefficients of the normalized polynomial
    corner: float  # rad/s
    period: float  # usual sample time, s

    def run(self, state: Floats, u0: Floats, u1: Floats, interval: float) -> Floats:
        """Return the state (..., order) after ``interval`` s in which the input goes u0 -> u1.

        Trapezoidal rule: s' = 2 x - s, (I - h A) x = s + h b u, with the companion matrix A.
        """
        n = len(self.polynomial) - 1
        is_usual = interval < 1.5 * self.period
        count = 1 if is_usual else int(np.ceil(interval / self.period - 0.1))
        h = 0.5 * self.corner * interval / count
        companion = np.eye(n, k=1)
        companion[-1] -= self.polynomial[:n]
        inverse = np.linalg.inv(np.eye(n) - h * companion).T
        for i in range(count):
            middle = u0 + (i + 0.5) / count * (u1 - u0)
            driven = state.copy()
            driven[..., -1] += h * middle
            state = 2.0 * driven @ inverse - state
        return state

    def weights(self, times: Floats) -> Floats:
        """(N,) Weights of the outputs at ``times`` (N,), s, in a backward run to the first."""
        outputs, state = np.eye(len(times)), np.zeros((len(times), len(self.polynomial) - 1))
        state[-1, 0] = 1.0  # it starts at rest
        for k in range(len(times) - 1, 0, -1):
            state = self.run(state, outputs[k], outputs[k - 1], times[k] - times[k - 1])
        return np.asarray(state[:, 0])

    def gain(self, ahead: int, frequency: float) -> float:
        """Magnitude response at ``frequency``, Hz; ``ahead`` in samples, 0 = causal."""
        warped = 2.0 / self.period * np.tan(np.pi * frequency * self.period)  # bilinear transform
        forward = 1.0 / np.sqrt(1.0 + (warped / self.corner) ** (2 * len(self.polynomial) - 2))
        times = np.linspace(0.0, ahead * self.period, ahead + 1)
        return float(forward * abs(self.weights(times) @ np.exp(2j * np.pi * frequency * times)))


def tune(order: int, cutoff: float, dt: float, ahead: int) -> float:
    """Corner, rad/s, that puts the -3 dB point at ``cutoff``, Hz."""
    from scipy.optimize import brentq

    polynomial, middle = polynomial_of(order), np.log(2.0 * np.pi * cutoff)

    def excess(log: float) -> float:
        return _Design(polynomial, float(np.exp(log)), dt).gain(ahead, cutoff) - np.sqrt(0.5)

    return float(np.exp(brentq(excess, middle - 1.0, middle + 5.0, xtol=1e-13)))


def polynomial_of(order: int) -> Floats:
    """Ascending coefficients of the normalized Butterworth polynomial, (order + 1,)."""
    from scipy.signal import butter

    return np.ascontiguousarray(butter(order, 1.0, analog=True)[1][::-1])


class _Group(NamedTuple):
    """One of the groups of a person's trajectories."""

    part: slice  # of all trajectories
    states: Floats  # (n, 19) KinematicStates
    confidences: Floats  # (n,)
    columns: tuple[slice, slice, slice]  # of pose, velocity and acceleration

    @property
    def pose(self) -> slice:
        """Columns of the pose in a slot: of a position, or an orientation."""
        return slice(SLOT_POSE, SLOT_POSE + (4 if self.columns == _ANGULAR else 3))

    def measured(self) -> Floats:
        """(n, 3) positions, or (n, 4) normalized orientations; NaN = absent."""
        poses = self.states[:, self.columns[0]]
        if self.columns == _ANGULAR:
            lengths = np.linalg.norm(poses, axis=1, keepdims=True)
            poses = poses / np.where((lengths > 1e-6) & (lengths < np.inf), lengths, np.nan)
        return np.where(np.isfinite(poses).all(axis=1, keepdims=True), poses, np.nan)


def _groups(people: People, person: int) -> Iterator[_Group]:
    """Yield the groups in their order."""
    markers = people.markers[person], people.marker_confidences[person]
    links = people.links[person], people.link_confidences[person]
    first = 0
    for states, columns in ((markers, 0), (links, 1), (links, 0), (markers, 1)):
        end = first + len(states[0])
        yield _Group(slice(first, end), *states, _ANGULAR if columns else _LINEAR)
        first = end


def _difference(poses: Floats, origins: Floats) -> Floats:
    """``poses - origins`` (..., 3), for orientations as rotation vectors."""
    if poses.shape[-1] == 3:
        return np.asarray(poses - origins)
    return to_vector(multiply(poses, conjugate(origins)))


def _displaced(poses: Floats, by: Floats) -> Floats:
    """``poses + by``, the inverse of :func:`_difference`."""
    if poses.shape[-1] == 3:
        return np.asarray(poses + by)
    turned = multiply(from_vector(by), poses)
    return np.asarray(turned / np.linalg.norm(turned, axis=-1, keepdims=True))


def update(people: People, steps: FilterSteps, past: FilterPast, polynomial: Floats) -> None:
    """Run the trajectories that are measured at each step; hold the others; start new ones."""
    mask = past.ring.shape[1] - 1
    for j, (person, row, at) in enumerate(zip(steps.people, steps.rows, steps.steps, strict=True)):
        now, last = at & mask, (at - 1) & mask
        interval = past.times[row, now] - past.times[row, last] if at > 0 else np.inf
        design = _Design(polynomial, steps.tunings[j], steps.periods[j])
        for group in _groups(people, person):
            slot, before = past.ring[row, now, group.part], past.ring[row, last, group.part]
            z, state = group.measured(), past.states[row, group.part]
            seen, age = ~np.isnan(z[:, 0]), before[:, SLOT_AGE] + interval
            active = age <= steps.max_gap
            slot[:] = np.where((active & ~seen)[:, None], before, 0.0)
            slot[:, SLOT_AGE] = np.where(seen, 0.0, np.where(active, age, np.inf))
            if not (active | seen).any():
                continue
            slot[:, _ACCELERATION], state[seen & ~active] = 0.0, 0.0
            slot[seen, group.pose] = z[seen]  # where it starts
            for each in np.unique(age[active & seen]):
                some = active & seen & (age == each)
                found = _filtered(z[some], state[some], before[some, group.pose], each, design)
                slot[some, : _ACCELERATION.stop], state[some, _DERIVATIVES:] = found
            state[seen, group.pose] = z[seen]
            slot[:, SLOT_CONTINUES] = active
            slot[seen, SLOT_CONFIDENCE] = group.confidences[seen]


def _filtered(
    z: Floats, state: Floats, last: Floats, age: float, design: _Design
) -> tuple[Floats, Floats]:
    """Run trajectories from the outputs ``last``, ``age`` s ago, to the measurements ``z``.

    Returns their output, velocity and acceleration as in a slot, and the derivatives of a state.
    """
    count, n, width = len(z), len(design.polynomial) - 1, z.shape[1]
    x = np.zeros((count, 3, n))  # the output relative to the last one, and its derivatives
    x[:, :, 1:] = state[:, _DERIVATIVES:].reshape(count, 3, n - 1)
    inputs = [_difference(u, last) for u in (state[:, :width], z)]
    x = design.run(x, inputs[0], inputs[1], age)
    output = _displaced(last, x[:, :, 0])
    # The highest derivative follows from the differential equation.
    x[:, :, 0] = 0.0
    highest = _difference(z, output) - x @ design.polynomial[:n]
    rates = np.append(x[:, :, 1:], highest[:, :, None], axis=2)
    out = np.zeros((count, _ACCELERATION.stop))
    out[:, SLOT_POSE : SLOT_POSE + width] = output
    out[:, _VELOCITY] = design.corner * rates[:, :, 0]
    out[:, _ACCELERATION] = design.corner**2 * rates[:, :, 1]
    return out, x[:, :, 1:].reshape(count, -1)


def estimate(people: People, steps: FilterSteps, past: FilterPast, polynomial: Floats) -> None:
    """Write the estimates of steps, given the data until their ends.

    They are weighted means of a trajectory's outputs, velocities and accelerations. In a gap the
    output moves evenly to the next one, or on at its velocity. Where the trajectory ends, it stays
    as it was last.
    """
    mask = past.ring.shape[1] - 1
    for j, (person, row) in enumerate(zip(steps.people, steps.rows, strict=True)):
        window = np.arange(steps.steps[j], steps.ends[j]) & mask
        design = _Design(polynomial, steps.tunings[j], steps.periods[j])
        times = past.times[row, window]
        weights = design.weights(times)
        for group in _groups(people, person):
            ring = past.ring[row, window, group.part]
            known = ring[0, :, SLOT_AGE] < np.inf
            if not known.any():
                continue
            ring = ring[:, known]
            goes_on = np.logical_and.accumulate(ring[1:, :, SLOT_CONTINUES] == 1.0)
            last, columns = goes_on.sum(axis=0), np.arange(known.sum())
            ring = ring[np.minimum(np.arange(len(window))[:, None], last), columns]
            outputs, age = ring[:, :, group.pose], ring[:, :, SLOT_AGE, None]
            velocity = ring[:, :, _VELOCITY].copy()
            for k in range(len(window) - 2, -1, -1):
                passed = age[k] + times[k + 1] - times[k]
                evenly = _difference(outputs[k + 1], outputs[k]) / passed
                later = np.where(age[k + 1] > 0.0, velocity[k + 1], evenly)
                velocity[k] = np.where(age[k] > 0.0, later, velocity[k])
            poses = _displaced(outputs, age * velocity)
            shift = np.tensordot(weights, _difference(poses, poses[0]), axes=1)
            rates = (
                np.tensordot(weights, ring[:, :, c], axes=1) for c in (_VELOCITY, _ACCELERATION)
            )
            found = _displaced(poses[0], shift), *rates
            for column, values in zip(group.columns, found, strict=True):
                group.states[known, column] = values


METHOD = FilterMethod(
    tune=tune,
    update=update,
    estimate=estimate,
    work=polynomial_of,
    state_columns=lambda order: _DERIVATIVES + 3 * (order - 1),
    slot_columns=SLOT_METHOD,
)
