"""Poses that a body can have: constant lengths, rigid groups, and the person's own motion.

1. The lengths of limbs, and the distances within head, thorax and pelvis, are measured once per
   person (:mod:`hiros_mcap.stages.fuse.pair_lengths`).
2. Each pose is projected onto them. Uncertain markers move most.
3. The person's poses of a minute are the prior of each of them
   (:mod:`hiros_mcap.stages.fuse.pose_prior`); then lengths are restored.
4. Both take the part of the variance of each marker that their steps show.

With a window, a pose knows those after it. Without one, lengths run on and the prior is the motion
of the minute before.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, join
from hiros_mcap.skeletons import POSITION, UNTRACKED, Floats, SkeletonModel, Stamps
from hiros_mcap.stages.fuse.fuse_params import ConstrainParams
from hiros_mcap.stages.fuse.pair_lengths import (
    MINUTE,
    LastMinute,
    MeasuredLengths,
    PairLimbs,
    RunningLengths,
)
from hiros_mcap.stages.fuse.pose_prior import (
    RecentMotion,
    body_frames,
    has_heading,
    local_frames,
    shrink_noise,
)
from hiros_mcap.stages.fuse.residuals import restated
from hiros_mcap.stages.look_ahead import LookAhead
from hiros_mcap.threads import run_each

UNKNOWN_DEVIATION = 0.01  # m; of markers whose uncertainty no stage has said
_FORGET = 600.0  # s; somebody who returns has the same body
_PIECE = 256  # poses that are projected together
_LEAST_LEFT = 0.25  # of the variance. A longer step says that there was more noise than assumed.
_STEPS_KEPT = 10.0  # s; time constant of the mean of the steps
_SWEEPS, _TOLERANCE = 20, 1e-3
"""Most sweeps of the projection onto the lengths, and the relative accuracy at which they end."""


def constrain_blocks(
    blocks: Iterable[Block], model: SkeletonModel, params: ConstrainParams | None = None,
    events: Events | None = None, limbs: LimbTable | None = None,
) -> Iterator[Block]:  # fmt: skip
    """Give everybody constant lengths and less noise.

    Parameters
    ----------
    blocks : fused frames; the uncertainty of their markers is used if it is known.
    model, params : the skeleton; see :class:`ConstrainParams`.
    events : notes when somebody's limbs are measured.
    limbs : lengths known from before, which these people keep. Those of the others are filled in.

    Yields
    ------
    The same frames with other positions, m, and orientations, logged when the lengths of everybody
    in their window were known; without a window, at once.

    Raises
    ------
    ConfigError
        If ``limbs`` names a link that the model lacks.
    """
    params = params or ConstrainParams()
    events = Events() if events is None else events
    bodies = _Bodies(model, params, events, LimbTable() if limbs is None else limbs)
    ahead, waiting = LookAhead(params.window), deque[_WaitingWindow]()
    log_time = 0
    for block in blocks:
        if params.window == 0:
            yield bodies.corrected(bodies.measure(join([block])))
            continue
        for window in ahead.windows(block):
            waiting.append(bodies.measure(window))
            now, log_time = int(window.stamps[-1]), int(window.log_times[-1])
            while waiting and bodies.can_correct(waiting[0], now):
                yield _logged_at(bodies.corrected(waiting.popleft()), log_time)
            del window  # it takes more memory than what waits
        log_time = int(block.log_times[-1])
        del block  # for the same reason
    if len(ahead):
        waiting.append(bodies.measure(ahead.release(len(ahead))))
    bodies.end_of_log()
    while waiting:
        yield _logged_at(bodies.corrected(waiting.popleft()), log_time)


def _logged_at(block: Block, log_time: int) -> Block:
    return block.logged_at([log_time] * len(block))


class _WaitingWindow(NamedTuple):
    """Frames that are corrected together, and wait for lengths."""

    frames: Block
    variances: Floats  # (P, M) of its markers before, m2
    people: list[tuple[int, Stamps]]
    """Who has an id in them, and the rows; without a window, several parts of them."""
    lengths: list[Floats]
    """(K,) m, of each of ``people``, without a window: those that were known then."""


@dataclass
class _Body:
    """The body of one person."""

    minute: LastMinute
    running: RunningLengths  # in place of the minute, where each pose is corrected by those before
    recent: RecentMotion
    steps: StepMeter
    first: int
    last: int = 0  # when the person was first and last seen, ns
    measured: MeasuredLengths | None = None  # None = not since the last pose
    is_fixed: bool = False  # whether the lengths stay as they are


class _Bodies:
    """The learned bodies of all people."""

    def __init__(
        self, model: SkeletonModel, params: ConstrainParams, events: Events, limbs: LimbTable
    ) -> None:
        from hiros_mcap.body.symmetry import constant_pairs

        self._params, self._events = params, events
        symmetry = symmetry_of(model)
        self._lateral, self._mirror = symmetry.lateral, symmetry.mirror
        self._pairs = constant_pairs(model, rigid=params.rigid)
        self._limbs = PairLimbs(model, self._pairs, limbs)
        self._people: dict[int, _Body] = {}

    def measure(self, out: Block) -> _WaitingWindow:
        """Measure everybody in a window, as long as the lengths are not well known."""
        variances, stamps = unshared_variances(out), np.repeat(out.stamps, out.sizes)
        positions, enough = out.people.markers[:, :, POSITION], self._params.enough * 1e9
        people = list(_tracked(out))
        if self._params.window == 0:
            people = self._one_by_one(people, stamps)
        lengths = list[Floats]()
        for person, rows in people:
            body = self._body(person, int(stamps[rows[0]]))
            body.last = int(stamps[rows[-1]])
            if self._params.window > 0:
                body.minute.update(stamps[rows], positions[rows], variances[rows])  # 1
            elif stamps[rows[0]] - body.first <= enough:
                body.running.update(positions[rows], variances[rows])
            if not body.is_fixed:
                body.measured = None
                if body.last - body.first >= enough:
                    self._keep(person, body)
                    body.is_fixed = True
            if self._params.window == 0:
                lengths.append(self._lengths(person))
        return _WaitingWindow(out, variances, people, lengths)

    def _one_by_one(
        self, people: list[tuple[int, Stamps]], stamps: Stamps
    ) -> list[tuple[int, Stamps]]:
        """Return people and their rows: each row by itself while lengths may change with it.

        ``stamps`` (P,) are the times of all rows, ns.
        """
        whole, rows = list[tuple[int, Stamps]](), list[tuple[int, Stamps]]()
        for person, theirs in people:
            body = self._people.get(person)
            if body is not None and body.is_fixed:
                unseen = np.diff(stamps[theirs], prepend=body.last).max()
                if unseen <= _FORGET * 1e9:
                    whole.append((person, theirs))
                    continue
            rows += [(person, theirs[k : k + 1]) for k in range(len(theirs))]
        return whole + sorted(rows, key=lambda person_and_row: int(person_and_row[1][0]))

    def _body(self, person: int, stamp: int) -> _Body:
        """Return what is known of somebody who is seen at ``stamp``, ns."""
        body = self._people.get(person)
        if body is None or stamp - body.last > _FORGET * 1e9:
            minute = LastMinute(self._pairs, self._mirror, max(MINUTE, self._params.enough))
            running = RunningLengths(self._pairs, self._mirror)
            body = self._people[person] = _Body(minute, running, RecentMotion(), StepMeter(), stamp)
        return body

    def _lengths(self, person: int) -> Floats:
        """(K,) Lengths of a person as they are known, m."""
        return self._limbs.given_or(person, self._result(self._people[person])[0])

    def _result(self, body: _Body) -> MeasuredLengths:
        """Return the lengths of a body, measured anew if there are new poses."""
        if body.measured is None:
            meter = body.minute if self._params.window > 0 else body.running
            body.measured = meter.result()
        return body.measured

    def _keep(self, person: int, body: _Body) -> None:
        """Put a person's lengths into the run's table."""
        measured = self._result(body)
        self._limbs.keep(person, measured)
        detail = f"{measured[2].max(initial=0)} frames"
        self._events.note(body.last, "limbs calibrated", person=person, detail=detail)

    def end_of_log(self) -> None:
        """Keep the lengths of those who were not seen for long enough."""
        for person, body in self._people.items():
            if not body.is_fixed:
                self._keep(person, body)

    def can_correct(self, window: _WaitingWindow, now: int) -> bool:
        """Whether nothing more about the people of a window is worth waiting for at ``now``, ns."""
        patience = self._params.enough + self._params.window if self._params.window > 0 else 0.0
        waited = now - int(window.frames.stamps[0]) >= patience * 1e9
        return waited or all(self._people[person].is_fixed for person, _ in window.people)

    def corrected(self, window: _WaitingWindow) -> Block:
        """Project a window, in place, onto the lengths; move towards what people do; project."""
        out, variances, people, known = window
        lengths = np.ones((len(people), len(self._pairs), 2))
        which = np.full(len(out.people.ids), -1)
        for k, (person, rows) in enumerate(people):
            lengths[k, :, 0] = known[k] if known else self._lengths(person)
            which[rows] = k
        measured = out.people.markers[:, :, POSITION].copy()
        self._project(out, which, lengths, variances)  # 2
        if self._params.prior:
            self._shrink(out, people, variances)  # 3
            self._project(out, which, lengths, variances)
        steps, left = out.people.markers[:, :, POSITION] - measured, np.ones(variances.shape)
        stamps = np.repeat(out.stamps, out.sizes)
        for person, rows in people:  # 4
            meter = self._people[person].steps
            for some in [rows] if self._params.window > 0 else rows[:, None]:
                left[some] = meter.left(steps[some], variances[some], int(stamps[some[-1]]))
        now = int(out.stamps[-1])
        self._people = {p: b for p, b in self._people.items() if now - b.last <= _FORGET * 1e9}
        return surer(out, variances * left)

    def _project(self, out: Block, which: Stamps, lengths: Floats, variances: Floats) -> None:
        from hiros_mcap.stages.filter.link_lengths import project_all

        def project(rows: slice) -> None:
            markers, rest = out.people.markers[rows], (self._pairs, lengths, _SWEEPS, _TOLERANCE)
            project_all(markers, which[rows], variances[rows], *rest)

        starts = range(0, len(which), _PIECE)
        run_each([partial(project, slice(start, start + _PIECE)) for start in starts])

    def _shrink(self, out: Block, people: list[tuple[int, Stamps]], variances: Floats) -> None:
        """Move everybody towards what the person does, in the person's own frame."""
        positions = out.people.markers[:, :, POSITION]
        stamps = np.repeat(out.stamps, out.sizes)
        if self._params.window > 0:
            for person, rows in people:
                seconds = (stamps[rows[-1]] - stamps[rows[0]]) * 1e-9
                rate = (len(rows) - 1) / seconds if seconds > 0 else 1.0
                minute = self._people[person].minute.poses()
                positions[rows] = self._moved(positions[rows], variances[rows], minute, rate)
            return
        frames, origins = local_frames(positions, self._lateral)
        poses = (positions - origins) @ frames
        for person, rows in people:
            recent = self._people[person].recent
            poses[rows] = recent.shrink(poses[rows], variances[rows], stamps[rows])
        positions[:] = poses @ np.swapaxes(frames, 1, 2) + origins

    def _moved(
        self, positions: Floats, variances: Floats, minute: tuple[Floats, Floats], rate: float
    ) -> Floats:
        """Move poses of a person (T, M, 3), m, in a frame that suits the whole minute."""
        n, poses = len(positions), np.concatenate([positions, minute[0]])
        if has_heading(minute[0], self._lateral):
            frames, origins = local_frames(poses, self._lateral)
        else:
            frames, origins = body_frames(poses, np.concatenate([variances, minute[1]]))
        poses -= origins
        poses = poses @ frames
        shrunk = shrink_noise(poses[:n], variances, (poses[n:], minute[1]), rate)
        return np.asarray(shrunk @ np.swapaxes(frames[:n], 1, 2) + origins[:n])


def _tracked(block: Block) -> Iterator[tuple[int, Stamps]]:
    """Yield everybody who has an id, with the person's rows."""
    for person in np.unique(block.people.ids).tolist():
        if person != UNTRACKED:
            yield person, np.flatnonzero(block.people.ids == person)


def unshared_variances(block: Block) -> Floats:
    """(P, M) Variance of each marker along each axis by itself, m2, without what all share."""
    if block.uncertainty is None:
        return np.full(block.people.marker_confidences.shape, UNKNOWN_DEVIATION**2)
    variances = block.uncertainty.deviations**2 - block.uncertainty.shared**2
    return np.where(np.isnan(variances), UNKNOWN_DEVIATION**2, np.maximum(variances, 1e-8))


def surer(out: Block, variances: Floats) -> Block:
    """Return a block whose markers have variances (P, M), m2, without what all share."""
    if out.uncertainty is None:
        return out
    return restated(out, np.where(np.isnan(out.uncertainty.deviations), np.nan, variances))


class StepMeter:
    """Measures which share of the variance of a person's markers is left after steps.

    The error of a best estimate is uncorrelated with the step that led to it from the measured
    place (principle of orthogonality). So the variance before is the mean square of the steps, and
    what is left: lengths take little where all joints of a limb err together.
    """

    def __init__(self) -> None:
        self._took: Floats | float = 0.0
        self._had: Floats | float = 0.0
        """(M,) Sums of squared steps, and of variances, of which the old ones count less, m2."""
        self._last = 0  # ns

    def left(self, steps: Floats, variances: Floats, stamp: int) -> Floats:
        """(M,) Share that is left, as these steps (T, M, 3), m, and those before them show.

        Parameters
        ----------
        variances : (T, M) before the steps, m2. stamp : of the last step, ns.
        """
        squares = (steps**2).sum(axis=2) / 3
        there = ~np.isnan(squares)
        keep = math.exp((self._last - stamp) * 1e-9 / _STEPS_KEPT)
        self._took = keep * self._took + np.where(there, squares, 0.0).sum(axis=0)
        self._had = keep * self._had + np.where(there, variances, 0.0).sum(axis=0)
        self._last = stamp
        return np.clip(1 - self._took / np.maximum(self._had, 1e-12), _LEAST_LEFT, 1.0)
