"""Smooths what the cameras saw in overlapping windows, person by person."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from hiros_mcap.frames import Block
from hiros_mcap.kernels.array_types import F1, F2, I1, I2, J1, arrays, chosen
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
from hiros_mcap.stages.fuse.displaced_views import DisplacedViews
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

BATCH = 48
"""Instants of a filter after which it learns how much the cameras scatter. They begin at multiples
of it, so the result does not depend on how many instants come at a time."""
_FORGET = 10.0  # s without a sighting after which a person's filter starts anew
_MAX_DEVIATION = 0.3
"""Deviation, m, beyond which a marker is left out: it was not seen for about a second."""
HALF_CONFIDENCE = 0.02
"""Deviation s, m, of a marker with confidence 0.5, which is 1 / (1 + (s / HALF_CONFIDENCE)^2)."""
_UNSEEN = 0.04
"""Deviation, m, that a hidden joint adds from which on its camera does not count as seeing it: that
of a joint's remembered place."""
_VIEWS, _VIEWS_END, _POSES, _POSES_END, _BEFORE, _AFTER = range(6)  # columns of a window's part


class Smoothed(NamedTuple):
    """Fused frames, and what the cameras saw of the people in them."""

    frames: Block
    views: Sightings
    rows: Stamps  # (N,) the row of each view among the people; -1 = none
    names: tuple[str, ...]  # of the cameras


class InstantWindow(NamedTuple):
    """Instants that are smoothed at once, by their numbers in the log."""

    first: int
    end: int  # the instant after the last one
    known: int  # the instant after the last one that tells about them


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
        self._is_filter = params.window == 0
        self._motion = noise.motion(model, params)
        self._pose_error = pose_error
        self.displaced = DisplacedViews(known, is_filter=self._is_filter)
        self._majority = Majority(model.n_markers)
        self._names: tuple[str, ...] = ()
        self._ahead = LookAhead()
        self._views: list[Sightings] = []  # not yet filtered; instants are numbered through the log
        self._next = self._batch = 0
        """The number of the first instant on which nobody has voted; the latest batch."""
        self._taken = 0  # time, ns, before which the filters have taken over everything
        self._origin: int | None = None
        self._log_time = 0  # of the latest instant, ns
        m = model.n_markers
        self._bank = Bank(JointStates.unknown(0, m, 0), _FORGET)

    def update(self, block: Block, views: Sightings, names: tuple[str, ...]) -> Iterator[Smoothed]:
        """Add instants; yield those whose window is complete: filtered ones together."""
        self._make_room(names)
        if not len(block):
            return
        before = self._ahead.first + len(self._ahead)
        self._views.append(views._replace(instants=views.instants + before))
        self._ahead.add(block)
        if self._origin is None:
            self._origin = int(block.stamps[0])
        self._log_time = int(block.log_times[-1])
        for windows in self._together(self._complete()):
            log_times = [
                block.log_times[window.known - 1 - before] for window in windows
                for _ in range(window.first, window.end)
            ]  # fmt: skip
            yield self._smooth(windows, np.array(log_times))

    def rest(self) -> Iterator[Smoothed]:
        """Yield what is left at the end of the log."""
        if n := len(self._ahead):
            first = self._ahead.first
            yield self._smooth(
                [InstantWindow(first, first + n, first + n)], np.full(n, self._log_time)
            )

    def _complete(self) -> list[InstantWindow]:
        """Return the windows whose look-ahead has come."""
        length, patience = self._params.window, self._params.window + self._params.lookahead
        stamps, number, windows = (
            self._ahead.stamps.tolist(),
            self._ahead.first,
            list[InstantWindow](),
        )
        first = 0
        while first < len(stamps):
            last = bisect_left(stamps, stamps[first] + round(patience * 1e9), first)
            if last == len(stamps):
                break
            end = bisect_left(stamps, stamps[first] + round(length * 1e9), first + 1, last + 1)
            windows.append(InstantWindow(number + first, number + end, number + last + 1))
            first = end
        return windows

    def _together(self, windows: list[InstantWindow]) -> Iterator[list[InstantWindow]]:
        """Yield the windows that are smoothed in one call: of a filter, all of a batch."""
        if not self._is_filter:
            yield from ([window] for window in windows)
            return
        firsts = [window.first for window in windows]
        while windows:
            n = bisect_left(firsts, (firsts[0] // BATCH + 1) * BATCH)
            yield windows[:n]
            windows, firsts = windows[n:], firsts[n:]

    def _make_room(self, names: tuple[str, ...]) -> None:
        """Add states for the offsets of new cameras; of these nothing is known yet."""
        new = len(names) - len(self._names)
        if not new:
            return
        self._names = names
        self.displaced.name(names)
        past = self._bank.past
        means = np.pad(past.means, ((0, 0), (0, 0), (0, new), (0, 0)))
        covariances = np.pad(past.covariances, ((0, 0), (0, 0), (0, new), (0, new)))
        size = means.shape[2]
        for k in range(size - new, size):
            seen_before = covariances[:, :, 0, 0] > 0
            covariances[:, :, k, k] = np.where(seen_before, self._noise.offsets**2, 0.0)
        doubts = [np.pad(array, ((0, 0), (0, 0), (0, new))) for array in past[-3:]]
        self._bank.past = JointStates(means, covariances, *past[2:-3], *doubts)

    def _smooth(self, windows: list[InstantWindow], log_times: Stamps) -> Smoothed:
        """Smooth windows that follow each other.

        The instants that are known, which are more, tell about each. The filters move on to its
        boundary, the first instant after it.
        """
        first, end, known = windows[0].first, windows[-1].end, windows[-1].known
        stamps = self._ahead.stamps[: known - first]
        waiting = joined_out_of(self._views)
        views = chosen(waiting, slice(int(np.searchsorted(waiting.instants, known))))
        out = self._ahead.release(end - first)
        if not self._is_filter:
            give_back()
        owners = np.repeat(np.arange(end - first), out.sizes)
        of_views = rows_of(views, first + owners, out.people.ids)
        parts = self._parts(windows, stamps, views, np.append(0, np.cumsum(out.sizes)))
        people, times = out.people.ids, out.stamps[owners]
        filters = self._bank.rows_of(people, times)
        everybody, of_each = np.unique(people, return_index=True)
        work = FusionWindows(
            views, self._variances(views, first), of_views, people, times,
            parts, everybody.astype(np.int32), filters[of_each], self._origin or 0,
        )  # fmt: skip
        poses, compared = self._smooth_people(work)
        excess = self.displaced.take(views, compared.offsets, of_views >= 0)
        compared.offsets[excess > 0] = np.nan
        ratios = self._learned_pose_errors(work, compared)
        # The filters have taken over what is before the boundary.
        self._taken = boundary = int(parts[-1, _AFTER])
        self._views = [chosen(waiting, (waiting.stamps >= boundary) | (waiting.instants >= end))]
        fused = self._finished(replace(out, log_times=log_times), poses, compared.seen, ratios)
        return Smoothed(fused, views, of_views, self._names)

    def _parts(
        self, windows: list[InstantWindow], stamps: Stamps, views: Sightings, first_poses: Stamps
    ) -> Stamps:
        """(W, 6) What belongs to each window, as :class:`FusionWindows` takes it.

        ``stamps`` are the times, ns, of all instants from the first one of the windows on, and
        ``first_poses`` the rows at which they begin among the people.
        """
        firsts, ends, knowns = np.array(windows).T
        number = firsts[0]
        boundaries = stamps[np.minimum(ends, knowns - 1) - number]
        taken = np.append(self._taken, boundaries[:-1])
        # Of the views before, some may have later times, which the filters have not reached.
        latest = np.maximum.accumulate(views.stamps)
        begins = np.minimum(np.searchsorted(views.instants, firsts), np.searchsorted(latest, taken))
        return np.column_stack([
            begins, np.searchsorted(views.instants, knowns),
            first_poses[firsts - number], first_poses[ends - number], taken, boundaries,
        ])  # fmt: skip

    def _variances(self, views: Sightings, first: int) -> Floats:
        """(N, M) Variance of every measurement along each axis, m2; votes on instants once.

        ``first`` is the number of the first instant.
        """
        if self._batch < first // BATCH:
            self._batch = first // BATCH
            self.displaced.learn()
        first_new = int(np.searchsorted(views.instants, self._next))
        self._next = int(views.instants[-1]) + 1 if len(views.instants) else self._next
        new = chosen(views, slice(first_new, None))
        variances = self._noise.variances(views, self._names, by_instant=self._is_filter)
        if self._params.majority:
            self._majority.vote(new, variances[first_new:])
        new.outvoted[:] += self.displaced.expected(new)[:, None]
        return np.asarray(variances + views.outvoted)

    def _smooth_people(self, windows: FusionWindows) -> tuple[FusedPoses, ComparedViews]:
        """Smooth everybody; the filters stand at the last boundary afterwards."""
        n, m = windows.variances.shape
        states, poses = self._bank.past, FusedPoses.absent(len(windows.people), m)
        compared = ComparedViews.none(n, len(windows.people), m)

        def smooth(first: int, last: int, steps: int) -> None:
            work = StepWork.of(steps, states.means.shape[2], m)
            smooth_people.raw(windows, first, last, self._motion, states, poses, compared, work)

        if self._is_filter:  # one pose of each takes less time than to start a thread
            spans = windows.parts[:, 1::2] - windows.parts[:, ::2]
            smooth(0, len(windows.everybody), int(spans[:, :2].sum(axis=1).max()))
        else:
            some = enumerate(windows.everybody.tolist())
            run_each([partial(smooth, k, k + 1, _steps_of(windows, who)) for k, who in some])
        return poses, compared

    def _learned_pose_errors(self, windows: FusionWindows, compared: ComparedViews) -> Floats:
        """(K,) Ratio of the poses' variances to the assumed ones, as known at each result."""
        ratios = np.full(len(windows.people), self._pose_error.ratio)
        for _, _, first, end, _, boundary in windows.parts.tolist():
            if self._pose_error.is_due(boundary):
                own = (windows.rows >= first) & (windows.rows < end)
                self._pose_error.learn(chosen(windows.views, own), compared.offsets[own])
                ratios[first:] = self._pose_error.ratio
        return ratios

    def _finished(self, out: Block, poses: FusedPoses, seen: Stamps, ratios: Floats) -> Block:
        """Write poses, confidences and uncertainty."""
        shared = self._pose_error.variances(poses.positions, seen, self._names, ratios)
        late = self._known.time_variances(self._names, out.stamps)
        if late.any():
            late = np.repeat(late, out.sizes)[:, None]
            shared = shared + late / 3 * (poses.velocities**2).sum(axis=-1)
        deviations = np.empty_like(shared)
        write_fused.raw(poses, shared, _MAX_DEVIATION, HALF_CONFIDENCE, out.people, deviations)
        return replace(out, uncertainty=Uncertainty(deviations, seen, self._names, np.sqrt(shared)))


def _steps_of(windows: FusionWindows, person: int) -> int:
    """Return how many views of a person and wanted poses there are."""
    views, of_person = windows.views, windows.views.people == person
    new = of_person & (views.stamps >= windows.parts[0, _BEFORE])
    return int(new.sum() + (windows.people == person).sum())


# The results, compiled.


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


class FusionWindows(NamedTuple):
    """The input of W smoothings, one after the other: N views of people, and the K wanted poses."""

    views: Sightings
    variances: F2  # (N, M) of the views, m2
    rows: I1  # (N,) the pose of each view's person and instant; -1 = none
    people: J1  # (K,) whose pose is wanted
    stamps: I1  # (K,) at which time, ns, in order for each person
    parts: I2
    """(W, 6) of a window: the first of its views, and of those that come too late; the same of its
    poses; the times, ns, at which the filters stand before and after it."""
    everybody: J1  # (E,) of ``people``, each once, sorted
    filters: I1  # (E,) rows of their filters
    origin: int  # time of second 0, ns


class ComparedViews(NamedTuple):
    """What smoothing tells of N views and K poses."""

    offsets: F2  # (N, 3) mean residual of the joints of each view, m; NaN = nothing to compare
    seen: I2  # (K, M) which cameras saw each marker at its instant, a bit each

    @classmethod
    def none(cls, views: int, poses: int, markers: int) -> ComparedViews:
        """Return what is known before."""
        return cls(np.full((views, 3), np.nan), np.zeros((poses, markers), int))


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
def _time_of(windows: FusionWindows, i: int) -> int:
    """Time, ns, of a view, or of a wanted pose."""
    n = len(windows.views.stamps)
    return int(windows.views.stamps[i] if i < n else windows.stamps[i - n])


@inlined
def _is_later(windows: FusionWindows, i: int, j: int) -> bool:
    """Whether ``i`` comes behind ``j``: at one time by camera, wanted poses last."""
    n, a, b = len(windows.views.stamps), _time_of(windows, i), _time_of(windows, j)
    if a != b or j >= n:
        return a > b
    return bool(i >= n or windows.views.cameras[i] > windows.views.cameras[j])


@kernel
def _order_steps(windows: FusionWindows, w: int, person: int, order: Stamps) -> int:
    """Write a person's new views and wanted poses in the order of time; return how many.

    Nothing is new to whom no pose is wanted of.
    """
    n, poses, first_pose = 0, 0, len(windows.views.people)
    first, last, taken = (
        windows.parts[w, _POSES],
        windows.parts[w, _POSES_END],
        windows.parts[w, _BEFORE],
    )
    for k in range(first, last):
        poses += int(windows.people[k] == person)
    if poses == 0:
        return 0
    for i in range(windows.parts[w, _VIEWS], windows.parts[w, _VIEWS_END]):
        if windows.views.stamps[i] >= taken and windows.views.people[i] == person:
            at = n  # views are nearly in order
            while at > 0 and _is_later(windows, order[at - 1], i):
                order[at] = order[at - 1]
                at -= 1
            order[at] = i
            n += 1
    steps = free = n + poses
    # Wanted poses are merged into the n views from behind: what lies between is free.
    for k in range(last - 1, first - 1, -1):
        if windows.people[k] == person:
            while n > 0 and _is_later(windows, order[n - 1], first_pose + k):
                free, n = free - 1, n - 1
                order[free] = order[n]
            free -= 1
            order[free] = first_pose + k
    return steps


@kernel
def _write_steps(windows: FusionWindows, w: int, person: int, work: StepWork) -> tuple[int, int]:
    """Write a person's new views and wanted poses as steps.

    Returns how many steps there are, and how many of them come before the boundary. ``work.order``
    then has the row of each step: of its view, or of its wanted pose.
    """
    first_pose, before = len(windows.views.people), 0
    n = _order_steps(windows, w, person, work.order)
    for t in range(n):
        i, stamp = work.order[t], _time_of(windows, work.order[t])
        work.times[t] = (stamp - windows.origin) * 1e-9
        work.cameras[t] = windows.views.cameras[i] if i < first_pose else POSE
        work.order[t] = i if i < first_pose else i - first_pose
        before += int(stamp < windows.parts[w, _AFTER])
    return n, before


@kernel
def _compare(windows: FusionWindows, i: int, poses: FusedPoses, compared: ComparedViews) -> None:
    """Write how far a view is from its pose on average, weighted by 1 / variance; who sees it."""
    k, total, x, y, z = windows.rows[i], 0.0, 0.0, 0.0, 0.0
    views, later = windows.views, (windows.views.stamps[i] - windows.stamps[k]) * 1e-9
    bit = 1 << views.cameras[i]
    for m in range(windows.variances.shape[1]):
        measured, pose, speed = views.positions[i, m], poses.positions[k, m], poses.velocities[k, m]
        if math.isnan(measured[0]):
            continue
        if views.hidden[i, m] + views.outvoted[i, m] < _UNSEEN * _UNSEEN:
            compared.seen[k, m] |= bit
        if math.isnan(pose[0]):
            continue
        weight = 1.0 / windows.variances[i, m]
        total += weight
        x += weight * (measured[0] - pose[0] - later * speed[0])
        y += weight * (measured[1] - pose[1] - later * speed[1])
        z += weight * (measured[2] - pose[2] - later * speed[2])
    offset = compared.offsets[i]
    offset[0], offset[1], offset[2] = x / total, y / total, z / total


@entry
def smooth_people(
    windows: FusionWindows, first: int, last: int, noise: JointNoise, states: JointStates,
    out: FusedPoses, compared: ComparedViews, work: StepWork,
) -> None:  # fmt: skip
    """Smooth some of the people of windows: ``everybody[first:last]``.

    Parameters
    ----------
    states : where the filters stand; brought to the boundary of the last window.
    out, compared : unknown; get the poses that are wanted of these people, and how far views are
        from them.
    work : has room for the steps of each.
    """
    for e in range(first, last):
        person, row = windows.everybody[e], windows.filters[e]
        for w in range(len(windows.parts)):
            n, before = _write_steps(windows, w, person, work)
            if n == 0:
                continue
            steps = Steps(
                work.times[:n], work.cameras[:n], work.order[:n], windows.views.positions,
                windows.variances,
            )  # fmt: skip
            smooth_joints(steps, before, noise, states, row, out, work.joint)
            for i in range(windows.parts[w, _VIEWS], windows.parts[w, _VIEWS_END]):
                k = windows.rows[i]
                is_own = windows.parts[w, _POSES] <= k < windows.parts[w, _POSES_END]
                if is_own and windows.people[k] == person:
                    _compare(windows, i, out, compared)
