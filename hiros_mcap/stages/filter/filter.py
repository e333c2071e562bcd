"""Skeleton filter (Hi-ROS 2023, section 3.4): smooth trajectories, velocities, accelerations.

Each marker and link of a person has a trajectory, filtered at the person's own times by one of two
filters with a free cut-off and order. With a look-ahead (the default) the estimate at time t also
uses the data until t + lookahead: no lag and less error than the input, where a strictly causal
filter of the same smoothness adds error (benchmarks/bench_filter.py). Frames come out in the order
they came in. Each is logged when its look-ahead is complete.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.frames import Block, HeldFrames
from hiros_mcap.kernels.array_types import arrays, settings_of
from hiros_mcap.skeletons import POSITION, UNTRACKED, People, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.delay import Delay
from hiros_mcap.stages.filter import state_space
from hiros_mcap.stages.filter.filter_params import FilterParams
from hiros_mcap.stages.filter.filtering import FilterMethod, FilterPast, FilterSettings, FilterSteps
from hiros_mcap.stages.filter.link_lengths import average_lengths, restore_lengths

_JITTER = 0.001
"""s by which a frame may come early and still complete a look-ahead: stamps are rounded."""
_INTERVALS = 31  # number of intervals whose median is the sample time
_REDESIGN = 0.1
"""Relative change of the sample time, once well known, at which the filter is designed anew."""
_SHORTEST = 0.002  # least sample time in s to design for; nothing that sees people is faster
_HIGHEST = 0.4  # highest cut-off over the sample rate; half of the rate cannot be filtered at all
_BATCH = 16  # most frames that are filtered in one call: each takes a slot of the rings
_SLOTS = 32  # slots of the rings at first: enough for a batch and the default look-ahead at 30 Hz


def filter_blocks(
    blocks: Iterable[Block],
    model: SkeletonModel,
    params: FilterParams = FilterParams(),  # noqa: B008 - immutable
    events: Events | None = None,
    *,
    keep_positions: bool = False,
) -> Iterator[Block]:
    """Filter marker positions and link orientations; fill in velocities and accelerations.

    Parameters
    ----------
    blocks : tracked, merged or optimized frames, stamps in ns not decreasing. A person is known
        by source and id. Untracked people (-1) pass through unchanged.
    model : the skeleton; its links are the limbs whose lengths are kept.
    params : see :class:`FilterParams`.
    events : counts "filter: time not increasing" (a person passed unchanged) and "filter: cut-off
        lowered" (the frames come too slowly for the chosen one).
    keep_positions : leave markers where they are, because an earlier stage has smoothed them.
        Their velocities and accelerations, and the links, are filtered.

    Yields
    ------
    The same frames in the same order: poses in m and unit quaternions, velocities in m/s and
    rad/s, accelerations in m/s2 and rad/s2, all in the fixed frame. ``log_time`` is that of the
    first frame at or beyond stamp + lookahead, or of the last frame before a gap longer than
    ``max_gap`` or the end.
    """
    events = Events() if events is None else events
    skeletons = _SkeletonFilter(model, params, events, keep_positions=keep_positions)
    for block in blocks:
        for start in range(0, len(block), _BATCH):
            yield from skeletons.update(block.select(slice(start, start + _BATCH)))
        del block  # else it lies in memory until the next one is made
    yield from skeletons.rest()


class _SkeletonFilter:
    """Hi-ROS 2023, section 3.4: the filters of all people, and the frames that are held."""

    def __init__(
        self, model: SkeletonModel, params: FilterParams, events: Events, *,
        keep_positions: bool = False,
    ) -> None:  # fmt: skip
        self._params, self._events, self._method = params, events, _method(params)
        self._keep_positions = keep_positions
        self._settings = settings_of(FilterSettings, params)
        self._links = np.ascontiguousarray(model.links)
        self._bank = Bank(
            _nobody(model, params.order, self._method), params.max_gap + params.lookahead
        )
        self._work = self._method.work(params.order, _SLOTS)
        self._people: dict[tuple[str, int], _FilteredPerson] = {}
        self._n_people = 0
        self._sample_times: dict[str, _SampleTime] = {}
        self._delay: Delay[_HeldFrame] = Delay(max(params.lookahead - _JITTER, 0.0))
        self._held = HeldFrames()
        self._last: tuple[int, int] | None = None
        """Stamp and log time of the latest frame."""

    def update(self, block: Block) -> Iterator[Block]:
        """Filter frames; yield those whose look-ahead is complete."""
        plan, first = _FilterPlan(), self._held.add(block)
        for i, (stamp, source, log_time) in enumerate(block.messages()):
            if self._last and stamp - self._last[0] > self._params.max_gap * 1e9:
                self._estimate(plan, self._delay.rest(), self._last[1])  # no frame waits over a gap
            people = self._add(plan, block.people, block.rows[i], stamp, source)  # 3.4: with ids
            held = _HeldFrame(first + i, int(block.sizes[i]), people, self._sample_times[source])
            self._delay.push(stamp, held)  # until its look-ahead is complete
            self._estimate(plan, self._delay.release(stamp, lambda held: False), log_time)
            self._last = stamp, log_time
        yield from self._filter(plan, block.people)

    def rest(self) -> Iterator[Block]:
        """Yield the frames that are left, after the last one of the log."""
        plan = _FilterPlan()
        if self._last:
            self._estimate(plan, self._delay.rest(), self._last[1])
            yield from self._filter(plan, None)

    def _filter(self, plan: _FilterPlan, people: People | None) -> Iterator[Block]:
        """Take over the poses of ``people``, then write the estimates that are complete."""
        self._reserve(plan)
        past, settings, work = self._bank.past, self._settings, self._work
        if people is not None:
            steps = plan.updates(past)
            # 3.4: low-pass of marker positions and link orientations, by the chosen method
            self._method.update(people, steps, past, settings, work)
            if self._params.keep_lengths:
                average_lengths(people, steps, past, self._links, self._params.length_time)
        if plan.done:
            out, steps = self._held.copies(plan.done), plan.estimates()
            self._held.keep(range(plan.done[-1] + 1, self._held.count))
            given = out.people.markers[:, :, POSITION].copy()
            # Beyond 3.4: the look-ahead, which removes the lag (fixed-lag smoothing)
            self._method.estimate(out.people, steps, past, settings, work)
            if self._keep_positions:
                positions = out.people.markers[:, :, POSITION]
                positions[:] = np.where(np.isnan(given), positions, given)
            elif self._params.keep_lengths:
                restore_lengths(out.people, steps, past, self._links)
            yield out.logged_at(plan.log_times)
        if self._last and self._bank.expire(self._last[0]):
            rows = self._bank.rows
            self._people = {key: p for key, p in self._people.items() if p.number in rows}

    def _add(
        self, plan: _FilterPlan, people: People, rows: Stamps, stamp: int, source: str
    ) -> list[tuple[int, _FilteredPerson, int]]:
        """Plan a step of everybody in a frame; return them as in :class:`_HeldFrame`."""
        if source not in self._sample_times:
            self._sample_times[source] = _SampleTime(self._params, self._method, source)
        sample_time = self._sample_times[source]
        sample_time.update(stamp, self._events)
        begin, end = rows.tolist()
        ids, times = people.ids[begin:end].tolist(), people.stamps[begin:end].tolist()
        steps = []
        for row, (identity, given) in enumerate(zip(ids, times, strict=True)):
            if identity == UNTRACKED:
                continue
            time = given or stamp
            person = self._person((source, identity), stamp, time)
            if person.n_steps and time <= person.stamp:
                self._events.count("filter: time not increasing", source)
                continue
            bank_row = self._bank.row(person.number, stamp)
            plan.update(begin + row, bank_row, person, time, sample_time)
            steps.append((row, person, person.n_steps - 1))
        return steps

    def _person(self, key: tuple[str, int], stamp: int, time: int) -> _FilteredPerson:
        """Return who goes on, or starts anew after a long gap."""
        person = self._people.get(key)
        gap = stamp - self._bank.last_seen[person.number] if person else np.inf
        if person is None or gap > self._params.max_gap * 1e9:
            person = self._people[key] = _FilteredPerson(self._n_people, time, time)
            self._n_people += 1
        return person

    def _estimate(self, plan: _FilterPlan, frames: Iterable[_HeldFrame], log_time: int) -> None:
        """Plan to write the estimates of frames, with all the data so far."""
        for held in frames:
            for row, person, step in held.people:
                bank_row = self._bank.rows[person.number]
                plan.estimate(row, bank_row, person, step, held.sample_time)
            plan.finish(held, log_time)

    def _reserve(self, plan: _FilterPlan) -> None:
        """Let the rings hold all steps that are waited for, and the one before."""
        needed = plan.most_steps() + 1
        past = self._bank.past
        while past.ring.shape[1] < needed:
            # Twice the same: wherever a step belongs in the longer ring, there it is.
            ring, times, lengths = (np.concatenate([a, a], axis=1) for a in past[1:])
            past = FilterPast(past.states, ring, times, lengths)
        if past is not self._bank.past:
            self._bank.past = past
            self._work = self._method.work(self._params.order, past.ring.shape[1])


def _method(params: FilterParams) -> FilterMethod:
    """Return the chosen filter; Butterworth's kernels are compiled only where it is chosen."""
    if params.method == "state_space":
        return state_space.METHOD
    from hiros_mcap.stages.filter import butterworth

    return butterworth.METHOD


def _nobody(model: SkeletonModel, order: int, method: FilterMethod) -> FilterPast:
    n = 2 * (model.n_markers + model.n_links)
    rings = (0, _SLOTS, n, method.slot_columns), (0, _SLOTS), (0, _SLOTS, model.n_links, 2)
    return arrays(FilterPast, (0, n, method.state_columns(order)), *rings)


class _SampleTime:
    """The sample time of one source, and the filter that is designed for it."""

    def __init__(self, params: FilterParams, method: FilterMethod, source: str) -> None:
        self._params, self._method, self._source = params, method, source
        self._intervals: deque[float] = deque(maxlen=_INTERVALS)
        self._stamp: int | None = None
        self._designed_for = 0.0
        self.period = 1 / 30
        self.tuning = 0.0

    def update(self, stamp: int, events: Events) -> None:
        """Add a frame; design the filter anew if the sample time has changed."""
        if self._stamp is not None and 0 < stamp - self._stamp <= self._params.max_gap * 1e9:
            self._intervals.append((stamp - self._stamp) * 1e-9)
            self.period = max(median(self._intervals), _SHORTEST)
        self._stamp = stamp
        change = abs(self.period - self._designed_for)
        # The median of few intervals is not well known, but one is better than none.
        tolerance = _REDESIGN * (_INTERVALS / max(len(self._intervals), 1)) ** 0.5
        is_first = len(self._intervals) == 1 and change > 0
        if is_first or change > tolerance * self._designed_for:
            self._design(events)

    def _design(self, events: Events) -> None:
        params, self._designed_for = self._params, self.period
        cutoff = min(params.cutoff, _HIGHEST / self.period)
        if cutoff < params.cutoff:
            events.count("filter: cut-off lowered", self._source)
        ahead = int(np.ceil(max(params.lookahead - _JITTER, 0.0) / self.period))
        self.tuning = self._method.tune(params.order, cutoff, self.period, ahead)


@dataclass(slots=True, eq=False)
class _FilteredPerson:
    """How far the filters of one person are."""

    number: int  # in the bank; whoever comes back after a long gap gets a new one
    start: int  # time of the first step, ns
    stamp: int  # time of the latest step, ns
    n_steps: int = 0
    n_estimated: int = 0  # steps whose estimates are written


class _HeldFrame(NamedTuple):
    """A frame whose look-ahead is not complete."""

    number: int
    n_rows: int
    people: list[tuple[int, _FilteredPerson, int]]
    """Row in the frame, who, and the number of the step."""
    sample_time: _SampleTime


class _FilterPlan:
    """What the kernels are to do with a batch of frames."""

    def __init__(self) -> None:
        self.done: list[int] = []
        """Numbers of frames whose look-ahead is complete."""
        self.log_times: list[int] = []
        """Of these frames, ns."""
        self._n_rows = 0
        self._updates: list[tuple[float, ...]] = []
        self._estimates: list[tuple[float, ...]] = []
        self._times: list[float] = []
        self._first: dict[_FilteredPerson, int] = {}
        """The first step of each person that is estimated in this batch or later."""

    def update(
        self, row: int, bank_row: int, person: _FilteredPerson, time: int, sample: _SampleTime
    ) -> None:
        """Add a step of a person, measured at ``time``, ns."""
        self._first.setdefault(person, person.n_estimated)
        self._times.append((time - person.start) * 1e-9)
        step, person.stamp, person.n_steps = person.n_steps, time, person.n_steps + 1
        self._updates.append((row, bank_row, step, step + 1, sample.tuning, sample.period))

    def estimate(
        self, row: int, bank_row: int, person: _FilteredPerson, step: int, sample: _SampleTime
    ) -> None:
        """Add the estimate of a step, with all the data of the person so far."""
        self._first.setdefault(person, person.n_estimated)
        person.n_estimated, row, end = step + 1, self._n_rows + row, person.n_steps
        self._estimates.append((row, bank_row, step, end, sample.tuning, sample.period))

    def finish(self, held: _HeldFrame, log_time: int) -> None:
        """Add a frame whose estimates are all planned."""
        self.done.append(held.number)
        self.log_times.append(log_time)
        self._n_rows += held.n_rows

    def most_steps(self) -> int:
        """Most steps of a person that the kernels need at once."""
        return max((p.n_steps - first for p, first in self._first.items()), default=0)

    def updates(self, past: FilterPast) -> FilterSteps:
        """Return the steps to add, after writing their times into the ring."""
        steps = _columns(self._updates)
        past.times[steps.rows, steps.steps & (past.times.shape[1] - 1)] = self._times
        return steps

    def estimates(self) -> FilterSteps:
        """Return the steps to estimate; rows of people are those of the joined frames."""
        return _columns(self._estimates)


def _columns(rows: list[tuple[float, ...]]) -> FilterSteps:
    columns = np.array(rows, np.float64).reshape(-1, 6).T
    return FilterSteps(*columns[:4].astype(np.int64, order="C"), *columns[4:].copy())
