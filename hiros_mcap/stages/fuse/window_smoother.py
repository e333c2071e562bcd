"""Smooths what the cameras saw in overlapping windows, person by person."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from hiros_mcap.frames import Block
from hiros_mcap.kernels.array_types import B1, F1, F2, I1, J1, arrays, chosen
from hiros_mcap.kernels.averaging import POSITION, VELOCITY
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.skeletons import (
    Floats,
    People,
    SkeletonModel,
    Stamps,
    Uncertainty,
)
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.fuse.displaced_views import (
    DisplacedViews,
    excess_of,
    limits_of,
)
from hiros_mcap.stages.fuse.fuse_params import FuseParams
from hiros_mcap.stages.fuse.fusing import (
    POSE,
    FusedPoses,
    FusionWork,
    JointNoise,
    JointStates,
    Sightings,
    Steps,
    joined_out_of,
    rows_of,
    smooth_joints,
)
from hiros_mcap.stages.fuse.fusion_noise import FusionNoise
from hiros_mcap.stages.fuse.majority import Majority
from hiros_mcap.stages.fuse.pose_error import PoseError
from hiros_mcap.stages.known_cameras import KnownCameras
from hiros_mcap.stages.look_ahead import LookAhead
from hiros_mcap.threads import give_back, run_each

_FORGET = 10.0  # s without a sighting after which a person's filter starts anew
_MAX_DEVIATION = 0.3
"""Deviation, m, beyond which a marker is left out: it was not seen for about a second."""
HALF_CONFIDENCE = 0.02
"""Deviation s, m, of a marker with confidence 0.5, which is 1 / (1 + (s / HALF_CONFIDENCE)^2)."""
_UNSEEN = 0.04
"""Deviation, m, that a hidden joint adds from which on its camera does not count as seeing it: that
of a joint's remembered place."""


class Smoothed(NamedTuple):
    """Fused frames, and what the cameras saw of the people in them."""

    frames: Block
    views: Sightings
    rows: Stamps  # (N,) the row of each view among the people; -1 = none
    excess: Floats  # (N,) variance, m2, that views of displaced cameras were given in addition
    names: tuple[str, ...]  # of the cameras


class WindowSmoother:
    """Smooths window after window; the filters go on from one to the next.

    Parameters
    ----------
    model, params, noise : the skeleton; how long results wait; what is assumed of the cameras.
    known : where the cameras stand and how their clocks go, and how well that is known.
    pose_error : what the cameras' poses add.
    """

    def __init__(
        self, model: SkeletonModel, params: FuseParams, noise: FusionNoise, known: KnownCameras,
        pose_error: PoseError,
    ) -> None:  # fmt: skip
        self._params, self._noise, self._known = params, noise, known
        self._motion = noise.motion(model, params)
        self._pose_error = pose_error
        self.displaced = DisplacedViews(known)
        self._majority, self._voted = Majority(model.n_markers), 0
        """The number of the first instant on which nobody has voted."""
        self._names: tuple[str, ...] = ()
        self._ahead = LookAhead()
        self._views: list[Sightings] = []
        """Not yet filtered; instants are numbered through the log."""
        self._taken = 0
        """Time, ns, before which the filters have taken over everything."""
        self._origin: int | None = None
        self._log_time = 0
        """Of the latest instant, ns."""
        m = model.n_markers
        self._bank: Bank[JointStates] = Bank(JointStates.unknown(0, m, 0), _FORGET)

    def update(self, block: Block, views: Sightings, names: tuple[str, ...]) -> Iterator[Smoothed]:
        """Add instants; yield those whose window is complete."""
        self._make_room(names)
        patience = round((self._params.window + self._params.lookahead) * 1e9)
        bounds = np.searchsorted(views.instants, np.arange(len(block) + 1))
        views = views._replace(instants=views.instants + self._ahead.first + len(self._ahead))
        self._ahead.add(block)
        times = zip(
            block.stamps.tolist(), block.log_times.tolist(), bounds[1:].tolist(), strict=True
        )
        taken = 0
        for unknown, (stamp, log_time, end) in zip(range(len(block))[::-1], times, strict=True):
            self._origin = stamp if self._origin is None else self._origin
            self._log_time = log_time
            while known := len(self._ahead) - unknown:
                first = int(self._ahead.stamps[0])
                if stamp - first < patience:
                    break
                self._views.append(chosen(views, slice(taken, end)))
                taken = end
                yield self._smooth(first + round(self._params.window * 1e9), log_time, known)
        self._views.append(chosen(views, slice(taken, None)))

    def rest(self) -> Iterator[Smoothed]:
        """Yield what is left at the end of the log."""
        if known := len(self._ahead):
            last = int(self._ahead.stamps[-1])
            yield self._smooth(last + 1, self._log_time, known)

    def _make_room(self, names: tuple[str, ...]) -> None:
        """Add states for the offsets of new cameras; of these nothing is known yet."""
        new = len(names) - len(self._names)
        if not new:
            return
        self._names, past = names, self._bank.past
        self.displaced.name(names)
        means = np.pad(past.means, ((0, 0), (0, 0), (0, new), (0, 0)))
        covariances = np.pad(past.covariances, ((0, 0), (0, 0), (0, new), (0, new)))
        size = means.shape[2]
        for k in range(size - new, size):
            seen_before = covariances[:, :, 0, 0] > 0
            covariances[:, :, k, k] = np.where(seen_before, self._noise.offsets**2, 0.0)
        doubts = (np.pad(array, ((0, 0), (0, 0), (0, new))) for array in past[-3:])
        self._bank.past = JointStates(means, covariances, *past[2:-3], *doubts)

    def _smooth(self, end: int, log_time: int, known: int) -> Smoothed:
        """Smooth a window: the instants before ``end``, ns, at least one.

        The ``known`` instants, which are more, tell about it. The filters move on to the boundary,
        the first of the others.
        """
        stamps = self._ahead.stamps[:known]
        n = max(int(np.searchsorted(stamps, end)), 1)
        boundary = int(stamps[min(n, known - 1)])
        views = joined_out_of(self._views)
        first, out = self._ahead.first, self._ahead.release(n)
        if self._params.window > 0:
            give_back()
        owners = np.repeat(np.arange(n), out.sizes)
        of_views = rows_of(views, first + owners, out.people.ids)
        self._bank.expire(int(stamps[0]))
        everybody = np.unique(out.people.ids).astype(np.int64)
        rows = [self._bank.row(person, boundary) for person in everybody.tolist()]
        window = FusionWindow(
            views, self._variances(views), views.stamps >= self._taken,
            out.people.ids, out.stamps[owners], everybody, np.array(rows, np.int64),
            self._origin or 0, boundary,
        )  # fmt: skip
        poses, excess = self._compared(window, of_views)
        seen = cameras_seeing(views, of_views, poses.variances.shape)
        # The filters have taken over what is before the boundary.
        self._taken = boundary
        self._views = [chosen(views, (views.stamps >= boundary) | (views.instants >= first + n))]
        fused = self._finished(out, log_time, poses, seen)
        return Smoothed(fused, views, of_views, excess, self._names)

    def _variances(self, views: Sightings) -> Floats:
        """(N, M) Variance of every measurement along each axis, m2; votes on instants once."""
        variances = self._noise.variances(views, self._names)
        if self._params.majority:
            new = slice(int(np.searchsorted(views.instants, self._voted)), None)
            self._majority.vote(chosen(views, new), variances[new])
            self._voted = int(views.instants[-1]) + 1 if len(views.instants) else self._voted
        return np.asarray(variances + views.outvoted)

    def _compared(self, window: FusionWindow, of_views: Stamps) -> tuple[FusedPoses, Floats]:
        """Smooth a window, and find out whose views are displaced.

        Returns the poses, and (N,) the variance, m2, that was added to views for being displaced: a
        filter adds it to those that come after.
        """
        views, white, finds = window.views, window.variances, self._params.displaced
        looks_ahead, excess = self._params.window > 0, np.zeros(len(white))
        if finds and not looks_ahead:
            excess = self.displaced.expected(views)
        poses = self._smooth_people(window._replace(variances=white + excess[:, None]))
        offsets = np.empty((len(white), 3))
        compare_views.raw(views, white, poses, window.stamps, of_views, offsets)
        found = excess
        if looks_ahead and finds:
            found = excess_of(views, offsets, limits_of(self._names, self._known.errors))
        elif finds:
            self.displaced.remember(views, offsets)
        self.displaced.count(views, found, of_views >= 0)
        self._pose_error.learn(views, np.where(found > 0, np.nan, offsets.T).T)
        return poses, excess

    def _smooth_people(self, window: FusionWindow) -> FusedPoses:
        """Smooth everybody; the filters stand at the boundary afterwards."""
        n, m = len(window.people), window.variances.shape[1]
        states, poses = self._bank.past, FusedPoses.absent(n, m)

        def smooth(first: int, last: int, steps: int) -> None:
            work = StepWork.of(steps, states.means.shape[2], m)
            smooth_people.raw(window, first, last, self._motion, states, poses, work)

        if self._params.window > 0:
            some = enumerate(window.everybody.tolist())
            run_each([partial(smooth, k, k + 1, _steps_of(window, person)) for k, person in some])
        else:  # one pose of each takes less time than to start a thread
            smooth(0, len(window.everybody), len(window.new) + n)
        return poses

    def _finished(self, out: Block, log_time: int, poses: FusedPoses, seen: Stamps) -> Block:
        """Write poses, confidences and uncertainty."""
        shared = self._pose_error.variances(poses.positions, seen, self._names)
        if late := self._known.time_variance(self._names, int(out.stamps[-1])):
            shared = shared + late / 3 * (poses.velocities**2).sum(axis=-1)
        deviations = np.empty_like(shared)
        write_fused.raw(poses, shared, _MAX_DEVIATION, HALF_CONFIDENCE, out.people, deviations)
        uncertainty = Uncertainty(deviations, seen, self._names, np.sqrt(shared))
        log_times = np.full(len(out), log_time)
        return replace(out, log_times=log_times, uncertainty=uncertainty)


def cameras_seeing(views: Sightings, rows: Stamps, shape: tuple[int, ...]) -> Stamps:
    """(K, M) which cameras saw each marker of a person at an instant, a bit each.

    ``rows`` (N,) : the K results' row of each view; -1 = none.
    """
    sees = ~np.isnan(views.positions[:, :, 0]) & (views.hidden + views.outvoted < _UNSEEN**2)
    seen, these = np.zeros(shape, np.int64), rows >= 0
    np.bitwise_or.at(seen, rows[these], (sees << views.cameras[:, None])[these])
    return seen


def _steps_of(window: FusionWindow, person: int) -> int:
    """Return how many new views of a person and wanted poses there are."""
    views = window.new & (window.views.people == person)
    return int(views.sum() + (window.people == person).sum())


# Views against the fused poses, and the results, compiled.


@entry
def compare_views(
    views: Sightings, variances: F2, poses: FusedPoses, stamps: I1, rows: I1, offsets: F2
) -> None:
    """Write the mean residual of the joints of each view, weighted by 1 / variance.

    Parameters
    ----------
    variances : (N, M) of the measurements, m2. poses, stamps : (K, M) results and (K,) times, ns.
    rows : (N,) the result of each view; -1 = none.
    offsets : (N, 3) m; NaN = nothing to compare.
    """
    for n in range(len(rows)):
        k, total, x, y, z = rows[n], 0.0, 0.0, 0.0, 0.0
        later = (views.stamps[n] - stamps[k]) * 1e-9 if k >= 0 else 0.0
        for m in range(variances.shape[1] if k >= 0 else 0):
            measured, pose = views.positions[n, m], poses.positions[k, m]
            speed = poses.velocities[k, m]
            if math.isnan(measured[0]) or math.isnan(pose[0]):
                continue
            weight = 1.0 / variances[n, m]
            total += weight
            x += weight * (measured[0] - pose[0] - later * speed[0])
            y += weight * (measured[1] - pose[1] - later * speed[1])
            z += weight * (measured[2] - pose[2] - later * speed[2])
        offsets[n, 0], offsets[n, 1], offsets[n, 2] = x / total, y / total, z / total


@entry
def write_fused(
    poses: FusedPoses, shared: F2, most: float, half: float, people: People, deviations: F2
) -> None:
    """Write positions, velocities, and confidences 1 / (1 + variance / half^2) of people.

    Parameters
    ----------
    shared : (K, M) variance that is added, m2. deviations : (K, M) get the square root of the sum.
    most : deviation, m, beyond which a marker is unknown. half : that of the confidence 0.5, m.
    """
    for k in range(len(shared)):
        count, total = 0, 0.0
        for m in range(shared.shape[1]):
            variance = poses.variances[k, m] + shared[k, m]
            known = variance <= most * most
            for c in range(3):
                place, speed = poses.positions[k, m, c], poses.velocities[k, m, c]
                people.markers[k, m, POSITION + c] = place if known else np.nan
                people.markers[k, m, VELOCITY + c] = speed if known else np.nan
            confidence = 1.0 / (1.0 + variance / (half * half)) if known else np.nan
            people.marker_confidences[k, m] = confidence
            deviations[k, m] = math.sqrt(variance) if known else np.nan
            if known:
                count += 1
                total += confidence
        people.confidences[k] = total / count


# Views of people become steps in the order of time, and steps become poses; compiled.


class FusionWindow(NamedTuple):
    """The input of one smoothing: N views of people, and the K wanted poses."""

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

    order: I1  # (T,) views by their rows, wanted poses by N + their rows; at last rows, of Steps
    times: F1  # (T,) of Steps
    cameras: I1  # (T,)
    joint: FusionWork

    @classmethod
    def of(cls, steps: int, size: int, markers: int) -> StepWork:
        """Make room for M joints with states of length ``size``."""
        return arrays(cls, steps, steps, steps, FusionWork.of(steps, size, markers))


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
    n, poses, first_pose = 0, 0, len(window.views.people)
    for i in range(first_pose):
        if window.new[i] and window.views.people[i] == person:
            at = n  # views are nearly in order
            while at > 0 and _is_later(window, order[at - 1], i):
                order[at] = order[at - 1]
                at -= 1
            order[at] = i
            n += 1
    for k in range(len(window.people)):
        poses += int(window.people[k] == person)
    steps = free = n + poses
    # Wanted poses are merged into the n views from behind: what lies between is free.
    for k in range(len(window.people) - 1, -1, -1):
        if window.people[k] == person:
            while n > 0 and _is_later(window, order[n - 1], first_pose + k):
                free, n = free - 1, n - 1
                order[free] = order[n]
            free -= 1
            order[free] = first_pose + k
    return steps


@kernel
def _write_steps(window: FusionWindow, person: int, work: StepWork) -> tuple[int, int]:
    """Write a person's new views and wanted poses as steps.

    Returns how many steps there are, and how many of them come before the boundary. ``work.order``
    then has the row of each step: of its view, or of its wanted pose.
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
