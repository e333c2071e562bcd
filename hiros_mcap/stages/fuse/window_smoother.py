"""Smooths what the cameras saw in overlapping windows, person by person."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from hiros_mcap.frames import Block
from hiros_mcap.kernels.array_types import chosen, joined
from hiros_mcap.skeletons import (
    SkeletonModel,
    Stamps,
    Uncertainty,
)
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.fuse.comparing import compare_views, find_cameras, write_fused
from hiros_mcap.stages.fuse.displaced_views import (
    DisplacedViews,
    excess_of,
    limits_of,
)
from hiros_mcap.stages.fuse.fuse_params import FuseParams
from hiros_mcap.stages.fuse.fusing import FusedPoses, JointStates, Sightings
from hiros_mcap.stages.fuse.fusion_noise import FusionNoise
from hiros_mcap.stages.fuse.pose_error import PoseError
from hiros_mcap.stages.fuse.sightings import rows_of
from hiros_mcap.stages.fuse.stepping import FusionWindow, StepWork, smooth_people
from hiros_mcap.stages.look_ahead import LookAhead
from hiros_mcap.threads import run_each

_FOLLOW = 0.05  # share of each interval in the mean of all
_FORGET = 10.0  # s without a sighting after which a person's filter starts anew
_MAX_DEVIATION = 0.3
"""Deviation, m, beyond which a marker is left out: it was not seen for about a second."""
HALF_CONFIDENCE = 0.02
"""Deviation s, m, of a marker with confidence 0.5, which is 1 / (1 + (s / HALF_CONFIDENCE)^2)."""
_UNSEEN = 0.04
"""Deviation, m, that a hidden joint adds from which on its camera does not count as seeing it: that
of a joint's remembered place."""
_ROUNDS = 3  # of smoothing again without displaced cameras; the first finds nearly all


class WindowSmoother:
    """Smooths window after window; the filters go on from one to the next.

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
        self._taken = 0
        """Time, ns, before which the filters have taken over everything."""
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
            while known := len(self._ahead) - unknown:
                first = int(self._ahead.stamps[0])
                if stamp - first < patience:
                    break
                self._views.append(chosen(views, slice(taken, end)))
                taken = end
                yield self._smooth(first + round(self._params.window * 1e9), log_time, known)
        self._views.append(chosen(views, slice(taken, None)))

    def rest(self) -> Iterator[Block]:
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
        self._bank.past = past._replace(means=means, covariances=covariances)

    def _smooth(self, end: int, log_time: int, known: int) -> Block:
        """Smooth the instants before ``end``, ns, or at least one, by those that are ``known``."""
        stamps = self._ahead.stamps[:known]
        n = max(int(np.searchsorted(stamps, end)), 1)
        boundary = int(stamps[min(n, known - 1)])  # nothing older is merged any more
        first, out = self._ahead.first, self._ahead.release(n)
        views = joined(self._views)
        self._views = [views]
        owners = np.repeat(np.arange(n), out.sizes)
        of_views = rows_of(views, first + owners, out.people.ids)
        self._bank.expire(int(stamps[0]))
        everybody = np.unique(out.people.ids).astype(np.int64)
        rows = [self._bank.row(person, boundary) for person in everybody.tolist()]
        window = FusionWindow(
            views, self._noise.variances(views, self._names), views.stamps >= self._taken,
            out.people.ids, out.stamps[owners], everybody, np.array(rows, np.int64),
            self._origin or 0, boundary,
        )  # fmt: skip
        poses = self._without_displaced(window, of_views)
        seen = np.zeros(poses.variances.shape, np.int64)
        find_cameras(views, of_views, _UNSEEN**2, seen)
        # The filters have taken over what is before the boundary.
        self._taken = boundary
        self._views = [chosen(views, (views.stamps >= boundary) | (views.instants >= first + n))]
        return self._finished(out, log_time, poses, seen)

    def _without_displaced(self, window: FusionWindow, of_views: Stamps) -> FusedPoses:
        """Smooth a window. Cameras that prove to be displaced lose their weight."""
        views, white = window.views, window.variances
        limits = limits_of(self._names, self._noise.pose_errors)
        ahead = self._params.window > 0
        excess = np.zeros(len(white)) if ahead else self.displaced.expected(views)
        for again in range(1 + _ROUNDS):
            before = self._bank.past
            if ahead:
                self._bank.past = JointStates(*[array.copy() for array in before])
            poses = self._smooth_people(window._replace(variances=white + excess[:, None]))
            offsets = np.empty((len(white), 3))
            compare_views(views, white, poses, window.stamps, of_views, offsets)
            if not ahead:
                self.displaced.remember(views, offsets)
                break
            last, excess = excess, excess_of(views, offsets, limits)
            if again == _ROUNDS or not ((excess > 0) != (last > 0)).any():
                break
            self._bank.past = before
        self.displaced.count(views, excess, of_views >= 0)
        self._pose_error.learn(views, np.where(excess > 0, np.nan, offsets.T).T, self._names)
        return poses

    def _smooth_people(self, window: FusionWindow) -> FusedPoses:
        """Smooth everybody; the filters stand at the boundary afterwards."""
        n, m = len(window.people), window.variances.shape[1]
        states, poses = self._bank.past, FusedPoses.absent(n, m)

        def smooth(first: int, last: int, steps: int) -> None:
            work = StepWork.of(steps, states.means.shape[2])
            smooth_people(window, first, last, self._motion, states, poses, work)

        if self._params.window > 0:
            some = enumerate(window.everybody.tolist())
            run_each([partial(smooth, k, k + 1, _steps_of(window, person)) for k, person in some])
        else:  # one pose of each takes less time than to start a thread
            smooth(0, len(window.everybody), len(window.new) + n)
        return poses

    def _finished(self, out: Block, log_time: int, poses: FusedPoses, seen: Stamps) -> Block:
        """Write poses, confidences and uncertainty."""
        shared = self._pose_error.variances(poses.positions, seen, self._names)
        if late := self._noise.time_variance(self._names):
            shared = shared + late / 3 * (poses.velocities**2).sum(axis=-1)
        deviations = np.empty_like(shared)
        write_fused(poses, shared, _MAX_DEVIATION, HALF_CONFIDENCE, out.people, deviations)
        uncertainty = Uncertainty(deviations, seen, self._names, np.sqrt(shared))
        log_times = np.full(len(out), log_time)
        return replace(out, log_times=log_times, uncertainty=uncertainty)


def _steps_of(window: FusionWindow, person: int) -> int:
    """Return how many new views of a person and wanted poses there are."""
    views = window.new & (window.views.people == person)
    return int(views.sum() + (window.people == person).sum())
