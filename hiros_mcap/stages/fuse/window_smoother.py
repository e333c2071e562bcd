"""Smooths what the cameras saw in overlapping windows, person by person."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from hiros_mcap.frames import Block
from hiros_mcap.kernels.array_types import F1, F2, I1, arrays, chosen
from hiros_mcap.kernels.averaging import POSITION, VELOCITY
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.skeletons import People, SkeletonModel, Stamps, Uncertainty
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.fuse.displaced_views import (
    DisplacedViews,
    OffsetsBefore,
    excess_of,
    expect,
    limits_of,
    remember,
)
from hiros_mcap.stages.fuse.fuse_params import FuseParams
from hiros_mcap.stages.fuse.fusing import (
    PEOPLE,
    POSE,
    POSES,
    VIEWS,
    FusedPoses,
    FusionWindows,
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
from hiros_mcap.stages.fuse.pose_error import PoseError
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
_ROUNDS = 3  # of smoothing again without displaced cameras; the first finds nearly all
_RENEWED = 500_000_000  # ns; how good cameras and poses are need not be looked at for each instant


class _Window(NamedTuple):
    """Instants that are smoothed at once, counted among those that wait."""

    first: int
    end: int
    known: int  # instants of those that wait
    boundary: int  # ns; nothing older is merged any more
    log_time: int  # ns, when it was complete


class WindowSmoother:
    """Smooths window after window; the filters go on from one to the next.

    A filter's window is one instant. Those that are complete at the same time are smoothed in one
    call, one after the other; how good cameras and poses are is the same for all of them.

    Parameters
    ----------
    model, params, noise : the skeleton; how long results wait; what is assumed of the cameras.
    pose_error : what the cameras' poses add.
    """

    def __init__(
        self, model: SkeletonModel, params: FuseParams, noise: FusionNoise, pose_error: PoseError
    ) -> None:
        self._params, self._noise = params, noise
        self._motion = noise.motion(params.freedom)
        self._pose_error = pose_error
        self.displaced = DisplacedViews(noise.pose_errors)
        self._names: tuple[str, ...] = ()
        self._ahead = LookAhead()
        self._views: list[Sightings] = []
        """Not yet filtered; instants are numbered through the log."""
        self._windows: list[_Window] = []
        """Complete, and not yet smoothed."""
        self._taken = 0
        """Time, ns, before which the filters have taken over everything."""
        self._renewed = -1
        """When it was looked at how good cameras and poses are, in units of _RENEWED."""
        self._origin: int | None = None
        self._log_time = 0
        """Of the latest instant, ns."""
        m = model.n_markers
        self._bank: Bank[JointStates] = Bank(JointStates.unknown(0, m, 0), _FORGET)

    def update(self, block: Block, views: Sightings, names: tuple[str, ...]) -> Iterator[Block]:
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
            while (first := self._next) < (known := len(self._ahead) - unknown):
                begin = int(self._ahead.stamps[first])
                if stamp - begin < patience:
                    break
                window = self._window(begin + round(self._params.window * 1e9), known)
                if self._windows and not self._goes_with_others(window):
                    yield self._smooth()
                    continue
                self._views.append(chosen(views, slice(taken, end)))
                taken = end
                self._windows.append(window)
        if self._windows:
            yield self._smooth()
        self._views.append(chosen(views, slice(taken, None)))

    def rest(self) -> Iterator[Block]:
        """Yield what is left at the end of the log."""
        if known := len(self._ahead):
            self._windows.append(self._window(int(self._ahead.stamps[-1]) + 1, known))
            yield self._smooth()

    @property
    def _next(self) -> int:
        """Number of the first instant, among those that wait, that no window has."""
        return self._windows[-1].end if self._windows else 0

    def _window(self, end: int, known: int) -> _Window:
        """Return the window of the next instants before ``end``, ns, or at least of one.

        So many instants are ``known`` of those that wait.
        """
        stamps, first = self._ahead.stamps[:known], self._next
        last = max(int(np.searchsorted(stamps, end)), first + 1)
        return _Window(first, last, known, int(stamps[min(last, known - 1)]), self._log_time)

    def _goes_with_others(self, window: _Window) -> bool:
        """Whether a window is smoothed together with those that are complete."""
        same = window.boundary // _RENEWED == self._windows[-1].boundary // _RENEWED
        return self._params.window == 0 and same

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
        self._bank.past = past._replace(means=means, covariances=covariances)

    def _smooth(self) -> Block:
        """Smooth the windows that are complete."""
        spans, self._windows = self._windows, []
        stamps, boundary, n = self._ahead.stamps, spans[-1].boundary, spans[-1].end
        if self._params.window > 0:
            give_back()
        waiting = joined_out_of(self._views)
        first, out = self._ahead.first, self._ahead.release(n)
        if self._params.window > 0:
            give_back()
        # The filters have taken over what is before the boundary of the window before.
        taken = np.array([self._taken, *(span.boundary for span in spans[:-1])])
        views, owners = _views_of(waiting, spans, first, taken)
        in_first = slice(int(np.searchsorted(owners, 1)))
        is_due = boundary // _RENEWED != self._renewed
        if is_due:
            self._noise.hold(chosen(views, in_first))
            self._noise.learn(self._names)
        self._noise.hold(waiting)
        windows = self._to_smooth(spans, out, stamps, views, owners, taken)
        windows, poses = self._without_displaced(windows)
        seen = cameras_seeing(views, windows.results, poses.variances.shape)
        self.displaced.count(views, windows.excess, windows.results >= 0)
        if is_due:
            right = np.where(windows.excess > 0, np.nan, windows.offsets.T).T
            self._pose_error.learn(chosen(views, in_first), right[in_first], self._names)
        self._taken, self._renewed = boundary, boundary // _RENEWED
        left = (waiting.stamps >= boundary) | (waiting.instants >= first + n)
        self._views = [chosen(waiting, left)]
        del waiting, views, windows
        return self._finished(spans, out, poses, seen)

    def _to_smooth(
        self, spans: Sequence[_Window], out: Block, stamps: Stamps, views: Sightings,
        owners: Stamps, taken: Stamps,
    ) -> FusionWindows:  # fmt: skip
        """Return what is smoothed: ``views``, each of the window that ``owners`` says."""
        begins, ids = np.concatenate([[0], np.cumsum(out.sizes)]), out.people.ids
        everybody, rows, ends = list[int](), list[int](), list[tuple[int, int, int]]()
        for k, span in enumerate(spans):
            self._bank.expire(int(stamps[span.first]))
            begin, end = begins[span.first], begins[span.end]
            some = np.unique(ids[begin:end]).tolist()
            everybody += some
            rows += [self._bank.row(person, span.boundary) for person in some]
            ends.append((int(np.searchsorted(owners, k + 1)), int(end), len(rows)))
        instants = self._ahead.first - len(out) + np.repeat(np.arange(len(out)), out.sizes)
        results = rows_of(views, instants, ids)
        if len(ids):  # a view of the look-ahead has its result in a later window
            of_result = np.repeat(
                np.arange(len(spans)), np.diff([end[POSES] for end in ends], prepend=0)
            )
            results = np.where(of_result[results] == owners, results, -1)
        white, n = self._noise.variances(views, self._names, owners), len(owners)
        return FusionWindows(
            views, white, white.copy(), np.zeros(n), views.stamps >= taken[owners], results,
            np.empty((n, 3)), ids, np.repeat(out.stamps, out.sizes), np.array(everybody, np.int64),
            np.array(rows, np.int64), np.array(ends), np.array([s.boundary for s in spans]),
            self._origin or 0,
        )  # fmt: skip

    def _without_displaced(self, windows: FusionWindows) -> tuple[FusionWindows, FusedPoses]:
        """Smooth windows. Cameras that prove to be displaced lose their weight."""
        if self._params.window == 0:
            return windows, self._smooth_people(windows, self.displaced.before(windows))
        limits = limits_of(self._names, self._noise.pose_errors)
        for again in range(1 + _ROUNDS):
            past = self._bank.past
            self._bank.past = JointStates(*[array.copy() for array in past])
            poses = self._smooth_people(windows, self.displaced.nothing)
            compare_views(windows, 0, len(windows.excess), poses)
            excess = excess_of(windows.views, windows.offsets, limits)
            is_same = ((excess > 0) == (windows.excess > 0)).all()
            windows = windows._replace(excess=excess)
            if again == _ROUNDS or is_same:
                break
            windows = windows._replace(variances=windows.white + excess[:, None])
            self._bank.past = past
        return windows, poses

    def _smooth_people(self, windows: FusionWindows, before: OffsetsBefore) -> FusedPoses:
        """Smooth everybody; the filters stand at the boundary afterwards."""
        n, m = len(windows.people), windows.white.shape[1]
        states, poses = self._bank.past, FusedPoses.absent(n, m)

        def smooth(first: int, last: int, steps: int) -> None:
            work = StepWork.of(steps, states.means.shape[2])
            smooth_people(windows, first, last, self._motion, states, before, poses, work)

        if self._params.window > 0:
            some = enumerate(windows.everybody.tolist())
            run_each([partial(smooth, k, k + 1, _steps_of(windows, person)) for k, person in some])
        else:  # one pose of each takes less time than to start a thread
            sizes = np.diff(windows.ends[:, :PEOPLE], axis=0, prepend=0).sum(axis=1)
            smooth(0, len(windows.everybody), int(sizes.max()))
        return poses

    def _finished(
        self, spans: Sequence[_Window], out: Block, poses: FusedPoses, seen: Stamps
    ) -> Block:
        """Write poses, confidences and uncertainty."""
        shared = self._pose_error.variances(poses.positions, seen, self._names)
        lengths = [span.end - span.first for span in spans]
        stamps = [int(out.stamps[span.end - 1]) for span in spans]
        late = np.array([self._noise.time_variance(self._names, stamp) for stamp in stamps])
        if late.any():
            of_pose = np.repeat(np.repeat(late, lengths), out.sizes)[:, None]
            shared = shared + of_pose / 3 * (poses.velocities**2).sum(axis=-1)
        deviations = np.empty_like(shared)
        write_fused(poses, shared, _MAX_DEVIATION, HALF_CONFIDENCE, out.people, deviations)
        uncertainty = Uncertainty(deviations, seen, self._names, np.sqrt(shared))
        log_times = np.repeat([span.log_time for span in spans], lengths)
        return replace(out, log_times=log_times, uncertainty=uncertainty)


def _views_of(
    views: Sightings, spans: Sequence[_Window], first: int, taken: Stamps
) -> tuple[Sightings, Stamps]:
    """Return the views of each window, and (N,) of which window they are.

    Those of its instants, counted from ``first`` on, and of the look-ahead; and those that the
    filters have not ``taken`` over: of a view that waits, a window of each.
    """
    if len(spans) == 1:
        return views, np.zeros(len(views.stamps), np.int64)
    begins, ends = np.array([(span.first, span.known) for span in spans]).T[:, :, None] + first
    wanted = (views.instants >= begins) | (views.stamps >= taken[:, None])
    owners, rows = np.nonzero(wanted & (views.instants < ends))
    return chosen(views, rows), owners


def cameras_seeing(views: Sightings, rows: Stamps, shape: tuple[int, ...]) -> Stamps:
    """(K, M) which cameras saw each marker of a person at an instant, a bit each.

    ``rows`` (N,) : the K results' row of each view; -1 = none.
    """
    sees = ~np.isnan(views.positions[:, :, 0]) & (views.hidden < _UNSEEN**2)
    seen, these = np.zeros(shape, np.int64), rows >= 0
    np.bitwise_or.at(seen, rows[these], (sees << views.cameras[:, None])[these])
    return seen


def _steps_of(windows: FusionWindows, person: int) -> int:
    """Return how many new views of a person and wanted poses there are."""
    views = windows.new & (windows.views.people == person)
    return int(views.sum() + (windows.people == person).sum())


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


class StepWork(NamedTuple):
    """Scratch for T steps of one person."""

    order: I1  # (T,) views by their rows, wanted poses by N + their rows; at last rows, of Steps
    times: F1  # (T,) of Steps
    cameras: I1  # (T,)
    joint: FusionWork

    @classmethod
    def of(cls, steps: int, size: int) -> StepWork:
        """Make room for joints with states of length ``size``."""
        return arrays(cls, steps, steps, steps, FusionWork.of(steps, size))


@inlined
def _span(windows: FusionWindows, w: int, column: int) -> tuple[int, int]:
    """Begin and end of the VIEWS, POSES or PEOPLE of a window."""
    return (windows.ends[w - 1, column] if w > 0 else 0), windows.ends[w, column]


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
    """Write a person's new views and wanted poses in the order of time; return how many."""
    n, poses, first_pose = 0, 0, len(windows.views.people)
    begin, end = _span(windows, w, VIEWS)
    for i in range(begin, end):
        if windows.new[i] and windows.views.people[i] == person:
            at = n  # views are nearly in order
            while at > 0 and _is_later(windows, order[at - 1], i):
                order[at] = order[at - 1]
                at -= 1
            order[at] = i
            n += 1
    begin, end = _span(windows, w, POSES)
    for k in range(begin, end):
        poses += int(windows.people[k] == person)
    steps = free = n + poses
    # Wanted poses are merged into the n views from behind: what lies between is free.
    for k in range(end - 1, begin - 1, -1):
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
        before += int(stamp < windows.boundaries[w])
    return n, before


@entry
def compare_views(windows: FusionWindows, begin: int, end: int, poses: FusedPoses) -> None:
    """Write the mean residual of the joints of some views, weighted by 1 / variance of the noise.

    NaN = nothing to compare.
    """
    views, offsets = windows.views, windows.offsets
    for n in range(begin, end):
        k, total, x, y, z = windows.results[n], 0.0, 0.0, 0.0, 0.0
        later = (views.stamps[n] - windows.stamps[k]) * 1e-9 if k >= 0 else 0.0
        for m in range(windows.white.shape[1] if k >= 0 else 0):
            measured, pose = views.positions[n, m], poses.positions[k, m]
            speed = poses.velocities[k, m]
            if math.isnan(measured[0]) or math.isnan(pose[0]):
                continue
            weight = 1.0 / windows.white[n, m]
            total += weight
            x += weight * (measured[0] - pose[0] - later * speed[0])
            y += weight * (measured[1] - pose[1] - later * speed[1])
            z += weight * (measured[2] - pose[2] - later * speed[2])
        offsets[n, 0], offsets[n, 1], offsets[n, 2] = x / total, y / total, z / total


@entry
def smooth_people(
    windows: FusionWindows, first: int, last: int, noise: JointNoise, states: JointStates,
    before: OffsetsBefore, out: FusedPoses, work: StepWork,
) -> None:  # fmt: skip
    """Smooth some of the people of windows, one window after the other: ``everybody[first:last]``.

    Parameters
    ----------
    states : where the filters stand; brought to the boundary of the last window.
    before : with limits, views of displaced cameras lose their weight by the windows before.
    out : (K,) unknown; gets the poses that are wanted of these people.
    work : has room for the steps of each.
    """
    for w in range(len(windows.boundaries)):
        begin, end = _span(windows, w, VIEWS)
        if len(before.limits) > 0:
            expect(before, windows.views.cameras, begin, end, windows.excess)
            for i in range(begin, end):
                for m in range(windows.white.shape[1]):
                    windows.variances[i, m] = windows.white[i, m] + windows.excess[i]
        first_here, last_here = _span(windows, w, PEOPLE)
        for e in range(max(first, first_here), min(last, last_here)):
            n, old = _write_steps(windows, w, windows.everybody[e], work)
            steps = Steps(
                work.times[:n], work.cameras[:n], work.order[:n], windows.views.positions,
                windows.variances,
            )  # fmt: skip
            smooth_joints(steps, old, noise, states, windows.rows[e], out, work.joint)
        if len(before.limits) > 0:
            compare_views(windows, begin, end, out)
            remember(
                before, windows.views.cameras, windows.views.stamps, windows.offsets, begin, end
            )
