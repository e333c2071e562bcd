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
from statistics import median

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.frames import Block, CameraNumbers
from hiros_mcap.kernels.array_types import F1, I1, I2, arrays
from hiros_mcap.kernels.compile import entry
from hiros_mcap.skeletons import POSITION, STATE, UNTRACKED, Floats, Ints, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.filter import state_space
from hiros_mcap.stages.filter.filter_params import FilterParams
from hiros_mcap.stages.filter.filtering import FilterMethod, FilterPast, FilterSteps
from hiros_mcap.stages.filter.link_lengths import average_lengths, restore_lengths
from hiros_mcap.stages.look_ahead import LookAhead

_JITTER = 0.001
"""s by which a frame may come early and still complete a look-ahead: stamps are rounded."""
_INTERVALS = 31  # number of intervals whose median is the sample time
_REDESIGN = 0.1
"""Relative change of the sample time, once well known, at which the filter is designed anew."""
_SHORTEST = 0.002  # least sample time in s to design for; nothing that sees people is faster
_HIGHEST = 0.4  # highest cut-off over the sample rate; half of the rate cannot be filtered at all
_BATCH = 16  # most frames that are filtered in one call: each takes a slot of the rings
_CROWD = 512  # people from which on they are fewer: rings of many people take much memory
_SLOTS = 8  # slots of the rings at first

# Columns of FilterPast.progress.
STEPS = 0  # so far
ESTIMATED = 1  # steps whose estimates are written
KNOWN = 2  # steps up to the frame that is looked at
FIRST_TIME = 3  # ns
LAST_TIME = 4  # ns
PROGRESS = 5

# Columns of people in frames.
ROW = 0  # in the bank
STEP = 1


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
        Their velocities and accelerations, and the links, are filtered. Gaps stay gaps.

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
        yield from skeletons.update(block)
        del block  # else it lies in memory until the next one is made
    yield from skeletons.rest()


class _SkeletonFilter:
    """Hi-ROS 2023, section 3.4: the filters of all people."""

    def __init__(
        self, model: SkeletonModel, params: FilterParams, events: Events, *,
        keep_positions: bool = False,
    ) -> None:  # fmt: skip
        self._params, self._events, self._method = params, events, _method(params)
        self._keep_positions = keep_positions
        # What the earlier stage leaves out, it does not know.
        self._bridge = 0.0 if keep_positions else params.bridge
        self._links = np.ascontiguousarray(model.links)
        self._max_gap = round(params.max_gap * 1e9)
        nobody = _nobody(model, params.order, self._method)
        self._bank = Bank(nobody, params.max_gap + params.lookahead)
        self._work = self._method.work(params.order, _SLOTS)
        self._numbers: dict[int, int] = {}  # source and id to the person's number in the bank
        self._n_people = 0
        self._sources = CameraNumbers()
        self._sample_times: list[_SampleTime] = []
        self._ahead = LookAhead(max(params.lookahead - _JITTER, 0.0))
        self._waiting = np.empty((0, 3), np.int64)
        """Bank row, step (-1 = none) and source of the people in the frames that wait."""
        self._last: tuple[int, int] | None = None  # stamp and log time of the latest frame

    def update(self, block: Block) -> Iterator[Block]:
        """Filter frames; yield those whose look-ahead is complete."""
        begin = 0
        while begin < len(block):
            stamp = int(block.stamps[begin])
            if self._last and stamp - self._last[0] > self._max_gap:
                yield from self.rest()  # no frame waits over a gap
            end = int(np.searchsorted(block.stamps, stamp + self._max_gap, "right"))
            batch = max(1, min(_BATCH, _CROWD // max(int(block.sizes[begin]), 1)))
            end = max(begin + 1, min(end, begin + batch))  # nobody has a gap within a batch
            yield from self._update(block.select(slice(begin, end)))
            begin = end

    def rest(self) -> Iterator[Block]:
        """Yield the frames that are left, after the last one of the log."""
        if self._last and len(self._ahead):
            completing, log_times = np.zeros(len(self._ahead), np.int64), np.array([self._last[1]])
            designs = np.array([[each.design for each in self._sample_times]])
            nobody = self._waiting[:0], self._waiting[:0, 0]
            yield self._estimate(completing, log_times, designs, *nobody)

    def _update(self, block: Block) -> Iterator[Block]:
        """Filter a batch of frames."""
        rows, owners = block.everybody()
        codes, stamps = self._sources.of(block), block.stamps[owners]
        designs, sources = self._designs(block, codes), codes[owners]
        people = self._bank_rows(sources, block.people.ids[rows], stamps)
        own = block.people.stamps[rows]
        steps, seconds = np.empty_like(rows), np.empty(len(rows))
        most = number_steps(
            people, np.where(own != 0, own, stamps), self._bank.past.progress, steps, seconds
        )
        self._reserve(most + 1)
        for late in np.flatnonzero((steps < 0) & (people >= 0)).tolist():
            self._events.count("filter: time not increasing", block.source(owners[late]))
        new, past = np.flatnonzero(steps >= 0), self._bank.past
        past.times[people[new], steps[new] & (past.times.shape[1] - 1)] = seconds[new]
        design = designs[owners[new], sources[new]].T.copy()
        todo = self._steps(rows[new], people[new], steps[new], steps[new] + 1, design)
        # 3.4: low-pass of marker positions and link orientations, by the chosen method
        self._method.update(block.people, todo, past, self._work)
        if self._params.keep_lengths:
            average_lengths(block.people, todo, past, self._links, self._params.length_time)
        known = np.stack([people, steps, sources], axis=1)
        self._waiting = np.concatenate([self._waiting, known])
        completing = self._ahead.add(block)
        if len(completing):
            yield self._estimate(completing, block.log_times, designs, known, owners)
        self._last = int(block.stamps[-1]), int(block.log_times[-1])
        if self._bank.expire(self._last[0]):
            rows_of = self._bank.rows
            self._numbers = {key: n for key, n in self._numbers.items() if n in rows_of}

    def _estimate(
        self, completing: Stamps, log_times: Stamps, designs: Floats, known: Stamps, owners: Stamps
    ) -> Block:
        """Write the estimates of the oldest frames.

        ``completing`` says which new frame completes the look-ahead of each; ``known`` are the
        people of the new frames, ``owners`` their frames, ``designs`` the filters at each.
        """
        out, past = self._ahead.release(len(completing), STATE), self._bank.past
        n = len(out.people.ids)
        leaving, self._waiting = self._waiting[:n].copy(), self._waiting[n:]
        at = np.repeat(completing, out.sizes)
        ends = np.empty(n, np.int64)
        find_ends(known, owners, leaving, at, past.progress, ends)
        rows = np.flatnonzero(leaving[:, 1] >= 0)
        people, steps, sources = leaving[rows].T.copy()
        design = designs[at[rows], sources].T.copy()
        todo = self._steps(rows, people, steps, ends[rows], design)
        positions = out.people.markers[:, :, POSITION]
        unfiltered = positions.copy() if self._keep_positions else positions
        # Beyond 3.4: the look-ahead, which removes the lag (fixed-lag smoothing)
        self._method.estimate(out.people, todo, past, self._work)
        if self._keep_positions:
            positions[:] = unfiltered
        elif self._params.keep_lengths:
            restore_lengths(out.people, todo, past, self._links)
        return out.logged_at(log_times[completing])

    def _steps(
        self, rows: Stamps, people: Stamps, steps: Stamps, ends: Stamps, design: Floats
    ) -> FilterSteps:
        """Return what to do; ``design`` (2, N) are the tunings and the sample times."""
        (tunings, periods), params = design, self._params
        return FilterSteps(
            rows, people, steps, ends, tunings, periods, params.order, params.max_gap, self._bridge
        )

    def _designs(self, block: Block, sources: Stamps) -> Floats:
        """(N, S, 2) Tuning and sample time, s, of the filter of each source at each frame."""
        for name in list(self._sources)[len(self._sample_times) :]:
            self._sample_times.append(_SampleTime(self._params, self._method, name))
        designs = []
        for stamp, source in zip(block.stamps.tolist(), sources.tolist(), strict=True):
            self._sample_times[source].update(stamp, self._events)
            designs.append([each.design for each in self._sample_times])
        return np.array(designs)

    def _bank_rows(self, sources: Stamps, ids: Ints, stamps: Stamps) -> Stamps:
        """(P,) Rows of people in the bank; -1 where UNTRACKED. Nobody goes on after a long gap."""
        rows = np.full(len(ids), -1)
        keys = np.where(ids == UNTRACKED, -1, (sources << 32) + ids + (1 << 31))
        for key in sorted({*keys.tolist()} - {-1}):
            theirs = np.flatnonzero(keys == key)
            first, last = stamps[theirs[[0, -1]]].tolist()
            number = self._numbers.get(key)
            if number is None or first - self._bank.last_seen[number] > self._max_gap:
                number = self._numbers[key] = self._n_people
                self._n_people += 1
            rows[theirs] = self._bank.row(number, last)
        return rows

    def _reserve(self, needed: int) -> None:
        """Let the rings hold so many steps: all that are waited for, and the one before."""
        past = self._bank.past
        while past.ring.shape[1] < needed:
            # Twice the same: wherever a step belongs in the longer ring, there it is.
            ring, times, lengths = (np.concatenate([a, a], axis=1) for a in past[1:4])
            past = past._replace(ring=ring, times=times, lengths=lengths)
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
    return arrays(FilterPast, (0, n, method.state_columns(order)), *rings, (0, PROGRESS))


class _SampleTime:
    """The sample time of one source, and the filter that is designed for it."""

    def __init__(self, params: FilterParams, method: FilterMethod, source: str) -> None:
        self._params, self._method, self._source = params, method, source
        self._intervals: deque[float] = deque(maxlen=_INTERVALS)
        self._stamp: int | None = None
        self._designed_for = 0.0
        self.period = 1 / 30
        self.tuning = 0.0

    @property
    def design(self) -> tuple[float, float]:
        """The design by ``FilterMethod.tune``, and the sample time, s."""
        return self.tuning, self.period

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


# Which step of whom is in a frame, and up to which step the look-ahead of a frame goes; compiled.


@entry
def number_steps(rows: I1, times: I1, progress: I2, steps: I1, seconds: F1) -> int:
    """Give numbers to the steps of P people, in the order of their frames.

    Parameters
    ----------
    rows : (P,) of the people in the bank; -1 = nobody.
    times : (P,) their own times, ns.
    progress : (B, PROGRESS), which goes on.
    steps, seconds : (P,) get the number of each step, and the time since the person's first one.
        There is no step (-1) where a person's times do not increase.

    Returns
    -------
    Most steps of a person whose estimates are not written.
    """
    most = 0
    for k in range(len(rows)):
        steps[k] = -1
        if rows[k] < 0:
            continue
        person = progress[rows[k]]
        if person[STEPS] == 0:
            person[FIRST_TIME] = times[k]
        elif times[k] <= person[LAST_TIME]:
            continue
        steps[k] = person[STEPS]
        seconds[k] = (times[k] - person[FIRST_TIME]) * 1e-9
        person[STEPS] += 1
        person[LAST_TIME] = times[k]
        most = max(most, person[STEPS] - person[ESTIMATED])
    return most


@entry
def find_ends(new: I2, frames: I1, leaving: I2, completing: I1, progress: I2, ends: I1) -> None:
    """Find how many steps of each person are known when the look-ahead of a frame is complete.

    Parameters
    ----------
    new, frames : (P, 3) the people of some new frames, and the frame of each.
    leaving, completing : (Q, 3) the people of the oldest frames, and the new frame that completes
        the look-ahead of each. ``new`` may be among them.
    progress : (B, PROGRESS), which goes on.
    ends : (Q,) gets the number of the first step that is not known yet.
    """
    for k in range(len(new)):
        if new[k, STEP] >= 0:
            progress[new[k, ROW], KNOWN] = progress[new[k, ROW], STEPS]
    for j in range(len(leaving)):
        if leaving[j, STEP] >= 0:
            progress[leaving[j, ROW], KNOWN] = progress[leaving[j, ROW], STEPS]
            progress[leaving[j, ROW], ESTIMATED] = leaving[j, STEP] + 1
    k = len(new) - 1
    for j in range(len(leaving) - 1, -1, -1):
        while k >= 0 and frames[k] > completing[j]:
            if new[k, STEP] >= 0:
                progress[new[k, ROW], KNOWN] = new[k, STEP]
            k -= 1
        if leaving[j, STEP] >= 0:
            ends[j] = progress[leaving[j, ROW], KNOWN]
