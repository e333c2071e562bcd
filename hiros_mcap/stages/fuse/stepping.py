"""Views of people become steps in the order of time, and steps become smoothed poses."""

from __future__ import annotations

from typing import NamedTuple

from hiros_mcap.kernels.array_types import B1, F1, F2, I1, J1, arrays
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
    stamps: I1  # (K,) at which time, ns, in order for each person
    everybody: I1  # (E,) of ``people``, each once, sorted
    rows: I1  # (E,) of their filters
    origin: int  # time of second 0, ns
    boundary: int  # time at which the filters stand afterwards, ns


class StepWork(NamedTuple):
    """Scratch for T steps of one person."""

    order: I1  # (T,) views by their numbers, then wanted poses: from N on
    times: F1  # (T,) of Steps
    cameras: I1  # (T,)
    joint: FusionWork

    @classmethod
    def of(cls, steps: int, size: int) -> StepWork:
        """Make room for joints with states of length ``size``."""
        return arrays(cls, steps, steps, steps, FusionWork.of(steps, size))


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
def _order_steps(window: FusionWindow, person: int, order: Stamps) -> int:
    """Write a person's new views and wanted poses in the order of time; return how many."""
    n, end, first_pose = 0, 0, len(window.views.people)
    for i in range(first_pose):
        if window.new[i] and window.views.people[i] == person:
            at = n  # views are nearly in order
            while at > 0 and _is_later(window, order[at - 1], i):
                order[at] = order[at - 1]
                at -= 1
            order[at] = i
            n += 1
    for k in range(len(window.people)):
        end += int(window.people[k] == person)
    end += n
    steps = end
    for k in range(len(window.people) - 1, -1, -1):  # merged from behind, where room is
        if window.people[k] == person:
            while n > 0 and _is_later(window, order[n - 1], first_pose + k):
                end, n = end - 1, n - 1
                order[end] = order[n]
            end -= 1
            order[end] = first_pose + k
    return steps


@kernel
def _write_steps(window: FusionWindow, person: int, work: StepWork) -> tuple[int, int]:
    """Write a person's new views and wanted poses as steps.

    Returns how many steps there are, and how many of them come before the boundary. Their order
    becomes their rows.
    """
    first_pose, before = len(window.views.people), 0
    n = _order_steps(window, person, work.order)
    for t in range(n):
        i, stamp = work.order[t], _time_of(window, work.order[t])
        work.times[t] = (stamp - window.origin) * 1e-9
        work.cameras[t] = window.views.cameras[i] if i < first_pose else POSE
        work.order[t] = i if i < first_pose else i - first_pose
        before += int(stamp < window.boundary)
    return n, before


@entry
def smooth_people(
    window: FusionWindow, first: int, last: int, noise: JointNoise, states: JointStates,
    out: FusedPoses, work: StepWork,
) -> None:  # fmt: skip
    """Smooth some of the people of a window: ``everybody[first:last]``.

    Parameters
    ----------
    states : where the filters stand; brought to the boundary of the window.
    out : (K,) unknown; gets the poses that are wanted of these people.
    work : has room for the steps of each.
    """
    for e in range(first, last):
        n, before = _write_steps(window, window.everybody[e], work)
        steps = Steps(
            work.times[:n], work.cameras[:n], work.order[:n], window.views.positions,
            window.variances,
        )  # fmt: skip
        smooth_joints(steps, before, noise, states, window.rows[e], out, work.joint)
