"""The common part of the methods of the skeleton filter (Hi-ROS 2023, section 3.4).

A person has T trajectories in four groups: the positions of the M markers, the orientations of the
L links, the positions of the links, the orientations of the markers. A trajectory is a pose (three
numbers, or a unit quaternion x y z w), a velocity and an acceleration in the fixed frame. The
difference of two orientations is a rotation vector, so the same linear filter serves positions and
orientations, and the sign of a quaternion has no effect.

A person's steps are numbered from 0. A ring of R slots per person (R a power of two) holds the
latest steps, which the estimates with look-ahead read.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.kernels import quaternions
from hiros_mcap.kernels.array_types import F1, F2, F3, F4, I1, I2
from hiros_mcap.kernels.compile import kernel
from hiros_mcap.kernels.quaternions import Quaternion, Vector
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

# Columns of a slot of the ring that every method fills.
SLOT_POSE = 0  # predicted (state_space), or the output at the last measurement (butterworth)
SLOT_VELOCITY = 4
SLOT_ACCELERATION = 7
SLOT_CONTINUES = 10
"""1 if the trajectory goes on from the previous slot, 0 if it starts or is absent."""
SLOT_AGE = 11  # s since the last measurement; inf = the trajectory is absent
SLOT_CONFIDENCE = 12  # confidence of the last measurement
SLOT_METHOD = 13  # first column that belongs to the method

GROUPS = 4  # marker positions, link orientations, link positions, marker orientations


class FilterSteps(NamedTuple):
    """The steps, in order: one person at one step per row."""

    people: I1  # row of the person's pose in People
    rows: I1  # row of the person in the bank
    steps: I1  # number of the step
    ends: I1  # number of the first step that is not known yet
    tunings: F1  # what ``FilterMethod.tune`` returned
    periods: F1  # sample time of the person's source, s
    # Parameters of the stage.
    order: int
    max_gap: float  # s
    bridge: float  # s


class FilterPast(NamedTuple):
    """The memory of the filters of B people."""

    states: F3  # (B, T, ...) state of each trajectory's recursion; columns of the method
    ring: F4  # (B, R, T, ...) the latest steps
    times: F2  # (B, R) their times since the person's first step, s
    lengths: F4  # (B, R, L, 2) mean length of each link at these steps, m, and the s that it covers
    progress: I2  # (B, PROGRESS) how far their steps are; see filter.py


class FilterMethod(NamedTuple):
    """One kind of filter. ``update`` fills the ring; ``estimate`` reads it and writes poses."""

    tune: Callable[[int, float, float, int], float]
    """order, cutoff (Hz), sample time (s), look-ahead (samples) -> tuning."""
    update: Callable[[People, FilterSteps, FilterPast, Any], None]
    estimate: Callable[[People, FilterSteps, FilterPast, Any], None]
    work: Callable[[int, int], Any]  # order, R -> constants and scratch of the kernels
    state_columns: Callable[[int], int]  # order -> columns of ``FilterPast.states``
    slot_columns: int


class Group(NamedTuple):
    """One of the four groups of a person's trajectories."""

    first: int  # index of its first trajectory
    angular: bool
    elements: Floats  # (n, 19) KinematicStates
    confidences: Floats  # (n,)


class Step(NamedTuple):
    """A person's step while it is filled."""

    states: Floats
    slot: Floats
    before: Floats  # slot of the previous step
    interval: float  # s since the previous step; inf at the first
    tuning: float
    period: float


class Window(NamedTuple):
    """The steps of a person that an estimate uses: from ``first`` until before ``end``."""

    ring: F3
    times: F1
    mask: int
    first: int
    end: int
    tuning: float
    period: float


@kernel
def group_of(people: People, person: int, number: int) -> Group:
    """Return group 0 to 3 of a person."""
    n_markers, n_links = people.markers.shape[1], people.links.shape[1]
    if number == 0:
        return Group(0, False, people.markers[person], people.marker_confidences[person])
    if number == 1:
        return Group(n_markers, True, people.links[person], people.link_confidences[person])
    first = n_markers + n_links
    if number == 2:
        return Group(first, False, people.links[person], people.link_confidences[person])
    first += n_links
    return Group(first, True, people.markers[person], people.marker_confidences[person])


@kernel
def step_of(steps: FilterSteps, past: FilterPast, j: int) -> Step:
    """Return the slots of row ``j`` of ``steps``."""
    row, step, mask = steps.rows[j], steps.steps[j], past.ring.shape[1] - 1
    slot, before = step & mask, (step - 1) & mask
    interval = past.times[row, slot] - past.times[row, before] if step > 0 else np.inf
    states, ring = past.states[row], past.ring[row]
    return Step(states, ring[slot], ring[before], interval, steps.tunings[j], steps.periods[j])


@kernel
def window_of(steps: FilterSteps, past: FilterPast, j: int) -> Window:
    """Return what the estimate of row ``j`` of ``steps`` may use."""
    ring, times, mask = past.ring[steps.rows[j]], past.times[steps.rows[j]], past.ring.shape[1] - 1
    first, end, tuning, period = steps.steps[j], steps.ends[j], steps.tunings[j], steps.periods[j]
    return Window(ring, times, mask, first, end, tuning, period)


@kernel
def vector_at(row: Any, column: int) -> Vector:
    """Three numbers from ``column`` on."""
    return row[column], row[column + 1], row[column + 2]


@kernel
def pose_at(row: Any, column: int) -> Quaternion:
    """Four numbers from ``column`` on: a quaternion, or a position and a number of no effect."""
    return row[column], row[column + 1], row[column + 2], row[column + 3]


@kernel
def put(row: Any, column: int, numbers: Any) -> None:
    """Write numbers into a row from ``column`` on."""
    for c in range(len(numbers)):
        row[column + c] = numbers[c]


@kernel
def difference(pose: Quaternion, origin: Quaternion, angular: bool) -> Vector:
    """``pose - origin``, for orientations as a rotation vector."""
    if angular:
        return quaternions.difference(pose, origin)
    return pose[0] - origin[0], pose[1] - origin[1], pose[2] - origin[2]


@kernel
def displace(pose: Quaternion, by: Vector, angular: bool) -> Quaternion:
    """``pose + by``, the inverse of :func:`difference`."""
    if angular:
        rotation = quaternions.exponential(by[0], by[1], by[2])
        return quaternions.normalize(quaternions.multiply(rotation, pose))
    return pose[0] + by[0], pose[1] + by[1], pose[2] + by[2], 0.0


@kernel
def measure(group: Group, k: int) -> tuple[Quaternion, bool]:
    """Position or normalized orientation of element ``k``, and whether there is one."""
    row = group.elements[k]
    if not group.angular:
        x, y, z = vector_at(row, POSITION.start)
        return (x, y, z, 0.0), bool(np.isfinite(x + y + z))
    q = pose_at(row, ORIENTATION.start)
    if not 1e-12 < quaternions.dot(q, q) < np.inf:
        return q, False
    return quaternions.normalize(q), True


@kernel
def write_pose(group: Group, k: int, pose: Quaternion) -> None:
    """Replace the position or orientation of element ``k``."""
    if group.angular:
        put(group.elements[k], ORIENTATION.start, pose)
    else:
        put(group.elements[k], POSITION.start, (pose[0], pose[1], pose[2]))


@kernel
def write_motion(group: Group, k: int, c: int, velocity: float, acceleration: float) -> None:
    """Replace component ``c`` of the velocity and acceleration of element ``k``."""
    if group.angular:
        group.elements[k, ANGULAR_VELOCITY.start + c] = velocity
        group.elements[k, ANGULAR_ACCELERATION.start + c] = acceleration
    else:
        group.elements[k, VELOCITY.start + c] = velocity
        group.elements[k, ACCELERATION.start + c] = acceleration


@kernel
def erase(group: Group, k: int) -> None:
    """Make a position or orientation, its velocity and its acceleration absent."""
    write_pose(group, k, (np.nan, np.nan, np.nan, np.nan))
    for c in range(3):
        write_motion(group, k, c, np.nan, np.nan)


@kernel
def clear(row: Any) -> None:
    """Make a trajectory absent from a slot."""
    if row[SLOT_AGE] < np.inf:
        for c in range(len(row)):
            row[c] = 0.0
        row[SLOT_AGE] = np.inf


@kernel
def is_shown(window: Window, t: int, bridge: float) -> bool:
    """Whether trajectory ``t`` is measured at the first step, or in a gap of at most ``bridge`` s.

    The gap ends at the next measurement that the window holds, or else at its last step.
    """
    age = window.ring[window.first & window.mask, t, SLOT_AGE]
    if age == 0.0 or not age <= bridge:
        return bool(age == 0.0)
    last = window.first
    for step in range(window.first + 1, window.end):
        row = window.ring[step & window.mask, t]
        if row[SLOT_CONTINUES] == 0.0:
            break
        last = step
        if row[SLOT_AGE] == 0.0:
            break
    times, mask = window.times, window.mask
    return bool(age + times[last & mask] - times[window.first & mask] <= bridge)


@kernel
def fill_confidence(group: Group, k: int, row: Any) -> None:
    """Give an element that is filled in half of the confidence of its last measurement."""
    if row[SLOT_AGE] > 0.0 and np.isnan(group.confidences[k]):
        group.confidences[k] = 0.5 * row[SLOT_CONFIDENCE]
