"""Views of people become steps in the order of time, and steps become smoothed poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import B1, F2, I1, J1, arrays
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.skeletons import Stamps
from hiros_mcap.stages.fuse.fusing import (
    POSE,
    FusedPoses,
    FusionWork,
    JointNoise,
    JointStates,
    Sightings,
    Steps,
    smooth_joints,
)


class FusionWindow(NamedTuple):
    """What is smoothed at once: N views of people, and the K poses that are wanted of them."""

    views: Sightings
    variances: F2  # (N, M) of the white noise of the views, m2
    new: B1  # (N,) whether the filters have not taken a view yet
    people: J1  # (K,) whose pose is wanted
    stamps: I1  # (K,) at which time, ns
    everybody: I1  # (E,) of ``people``, each once, sorted
    rows: I1  # (E,) of their filters
    origin: int  # time of second 0, ns
    boundary: int  # time at which the filters stand afterwards, ns


class StepWork(NamedTuple):
    """Scratch for T steps of one person, of which K want a pose."""

    order: I1  # (T,) views by their numbers, then wanted poses: from N on
    steps: Steps
    poses: FusedPoses
    joint: FusionWork

    @classmethod
    def of(cls, steps: int, wanted: int, markers: int, size: int) -> StepWork:
        """Make room for joints with states of length ``size``, and for the ``wanted`` poses."""
        t, k, m = steps, wanted, markers
        poses = arrays(FusedPoses, (k, m, 3), (k, m, 3), (k, m))
        measured = arrays(Steps, t, t, (t, m, 3), (t, m))
        return arrays(cls, t, measured, poses, FusionWork.of(t, size))


@inlined
def _time_of(window: FusionWindow, i: int) -> int:
    """Time, ns, of a view, or of a wanted pose."""
    n = len(window.views.stamps)
    return int(window.views.stamps[i] if i < n else window.stamps[i - n])


@inlined
def _is_later(window: FusionWindow, i: int, j: int) -> bool:
    """Whether ``i`` comes behind ``j``: at one time by camera, wanted poses last."""
    n, a, b = len(window.views.stamps), _time_of(window, i), _time_of(window, j)
    if a != b or j >= n:
        return a > b
    return bool(i >= n or window.views.cameras[i] > window.views.cameras[j])


@kernel
def _insert(window: FusionWindow, i: int, order: Stamps, n: int) -> None:
    """Put a view or a wanted pose in its place among the ``n`` that are in order."""
    while n > 0 and _is_later(window, order[n - 1], i):
        order[n] = order[n - 1]
        n -= 1
    order[n] = i


@kernel
def _write_steps(window: FusionWindow, person: int, work: StepWork) -> tuple[int, int, int]:
    """Write a person's new views and wanted poses as steps.

    Returns how many steps there are, how many of them come before the boundary, and how many want
    a pose.
    """
    views, steps, order = window.views, work.steps, work.order
    n, before = 0, 0
    for i in range(len(views.people)):
        if window.new[i] and views.people[i] == person:
            _insert(window, i, order, n)
            n += 1
    measured = n
    for k in range(len(window.people)):
        if window.people[k] == person:
            _insert(window, len(views.people) + k, order, n)
            n += 1
    for t in range(n):
        i, stamp = order[t], _time_of(window, order[t])
        steps.times[t] = (stamp - window.origin) * 1e-9
        before += int(stamp < window.boundary)
        if i >= len(views.people):
            steps.cameras[t] = POSE
            continue
        steps.cameras[t] = views.cameras[i]
        for m in range(steps.variances.shape[1]):
            steps.variances[t, m] = window.variances[i, m]
            for c in range(3):
                steps.positions[t, m, c] = views.positions[i, m, c]
    return n, before, n - measured


@kernel
def _blank(poses: FusedPoses) -> None:
    """Make poses unknown."""
    poses.positions[:] = np.nan
    poses.velocities[:] = np.nan
    poses.variances[:] = np.nan


@kernel
def _copy_pose(source: FusedPoses, at: int, to: FusedPoses, k: int) -> None:
    """Copy a pose."""
    for m in range(to.variances.shape[1]):
        to.variances[k, m] = source.variances[at, m]
        for c in range(3):
            to.positions[k, m, c] = source.positions[at, m, c]
            to.velocities[k, m, c] = source.velocities[at, m, c]


@entry
def smooth_people(
    window: FusionWindow, first: int, last: int, noise: JointNoise, states: JointStates,
    out: FusedPoses, work: StepWork,
) -> None:  # fmt: skip
    """Smooth some of the people of a window: ``everybody[first:last]``.

    Parameters
    ----------
    states : where the filters stand; brought to the boundary of the window.
    out : (K,) gets the poses that are wanted of these people. work : has room for their steps.
    """
    for e in range(first, last):
        n, before, wanted = _write_steps(window, window.everybody[e], work)
        steps = Steps(
            work.steps.times[:n], work.steps.cameras[:n], work.steps.positions[:n],
            work.steps.variances[:n],
        )  # fmt: skip
        poses = FusedPoses(
            work.poses.positions[:wanted], work.poses.velocities[:wanted],
            work.poses.variances[:wanted],
        )  # fmt: skip
        _blank(poses)
        smooth_joints(steps, before, noise, states, window.rows[e], poses, work.joint)
        at = 0
        for t in range(n):
            if steps.cameras[t] == POSE:
                _copy_pose(poses, at, out, work.order[t] - len(window.views.people))
                at += 1
