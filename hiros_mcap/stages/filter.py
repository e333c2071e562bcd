"""Skeleton filter (Hi-ROS 2023, section 3.4): smooth trajectories, velocities, accelerations.

Each marker and link of a person is a track of its own, filtered at the person's source times by
one of two filters with a free cut-off and order. With a look-ahead (the default) the estimate at
time t also uses the data up to t + lookahead: no lag and less error than the input, where a
strictly causal filter of the same smoothness adds error (benchmarks/bench_filter.py). Frames come
out in the order they came in, each with the log time of the frame that completed its look-ahead.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from hiros_mcap.events import Events
from hiros_mcap.frames import Block, Part, frames_of, join, most_often
from hiros_mcap.kernels import filtering as _filters
from hiros_mcap.params import Params
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, People, SkeletonModel
from hiros_mcap.stages.bank import ArrayBank

_JITTER = 0.001
"""s by which a frame may come early and still complete a look-ahead: stamps are rounded."""
_INTERVALS = 31
"""Number of intervals whose median is taken as the sample time."""
_RETUNE = 0.1
"""Relative change of the sample time, once well known, that makes the filter be designed anew."""
_SHORTEST = 0.002
"""Least sample time in s to design for; nothing that sees people is faster."""
_HIGHEST = 0.4
"""Highest cut-off over the sample rate; half of the rate cannot be filtered at all."""
_AT_ONCE = 16
"""Most frames that are filtered in one call: each takes room in the rings."""
_SWEEPS, _TOLERANCE = 30, 2e-3
"""Limit of the projections onto the limb lengths, and their relative accuracy."""


class FilterParams(Params):
    """How the trajectories of markers and links are smoothed."""

    method: Literal["state_space", "butterworth"] = Field(
        "state_space",
        description="state_space: Kalman filter of integrated white noise, no lag on steady "
        "motion. butterworth: maximally flat, any order, lags unless it looks ahead.",
    )
    cutoff: float = Field(
        4.5,
        gt=0,
        description="Frequency in Hz at which the whole filter, look-ahead included, is at -3 dB. "
        "Human motion with merged-camera noise has its least error at 4 to 5 Hz "
        "(benchmarks/bench_filter.py); Winter 2009 gives 6 to 10 Hz for marker-based capture.",
    )
    order: int = Field(
        2,
        ge=1,
        le=10,
        description="Order. state_space: 2 = constant velocity, 3 = constant acceleration "
        "(sharper, and a better acceleration); butterworth: any.",
    )
    lookahead: float = Field(
        0.3,
        ge=0,
        description="s of data after an instant that its estimate uses. 0 = strictly causal. More "
        "than 1 / cutoff changes nothing at order 2 or 3; a high order rings for longer.",
    )
    bridge: float = Field(
        0.2,
        ge=0,
        description="s for which a marker or link may be missing and is filled in, with half of "
        "its last confidence. A gap must end within the look-ahead to be known as this short.",
    )
    max_gap: float = Field(
        1.0,
        gt=0,
        description="s without data after which a person, a marker or a link starts anew.",
    )
    keep_lengths: bool = Field(
        True,
        description="Give each link the length that it has in the input, averaged over "
        "length_time; smoothing each joint on its own shortens limbs that swing.",
    )
    length_time: float = Field(
        2.0,
        gt=0,
        description="Time constant in s of the average of the link lengths. Longer is slightly "
        "better where nothing has corrected the lengths before, and slower to follow a new "
        "calibration.",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.method == "state_space" and self.order not in (2, 3):
            raise ValueError("order of a state-space filter must be 2 or 3")
        return self


@dataclass(frozen=True, slots=True)
class _Method:
    """The kernels of one filter and the number of columns that they keep per track."""

    tune: Callable[[int, float, float, int], float]
    run: Callable[..., None]
    ring_columns: int
    state_columns: int
    age_column: int


def _method(params: FilterParams) -> _Method:
    """Kernels of the chosen filter; those of the other one are not even compiled."""
    if params.method == "state_space":
        return _Method(
            _filters.state_space_noise,
            _filters.run_state_space,
            _filters.COLUMNS,
            _filters.STATE,
            _filters.NOW_AGE,
        )
    from hiros_mcap.kernels import butterworth

    return _Method(
        butterworth.butterworth_rate,
        butterworth.run_butterworth,
        butterworth.COLUMNS,
        butterworth.STATE + 3 * (params.order - 1),
        butterworth.NOW_AGE,
    )


def filter_frames(
    frames: Iterable[Frame],
    model: SkeletonModel,
    params: FilterParams = FilterParams(),  # noqa: B008 - immutable
    events: Events | None = None,
) -> Iterator[Frame]:
    """Filter marker positions and link orientations; fill in velocities and accelerations.

    Parameters
    ----------
    frames : tracked, merged or optimised frames, stamps in ns not decreasing; people are told
        apart by (source, id). Untracked people (-1) pass through unchanged.
    model : the skeleton; its links are the limbs whose lengths are kept.
    params : see :class:`FilterParams`.
    events : counts "filter: time not increasing" (a person passed unchanged) and "filter: cut-off
        lowered" (the frames come too slowly for the chosen one).

    Yields
    ------
    The same frames in the same order: poses in m and unit quaternions, velocities in m/s and
    rad/s, accelerations in m/s2 and rad/s2, all in the fixed frame. ``log_time`` is that of the
    first frame at or beyond stamp + lookahead, or of the last frame before a gap longer than
    ``max_gap`` or the end.
    """
    return frames_of(filter_blocks(map(Block.of, frames), model, params, events))


def filter_blocks(
    blocks: Iterable[Block],
    model: SkeletonModel,
    params: FilterParams = FilterParams(),  # noqa: B008 - immutable
    events: Events | None = None,
) -> Iterator[Block]:
    """Do what :func:`filter_frames` does, a block at a time."""
    run = _Run(model, params, Events() if events is None else events)
    for block in blocks:
        for start in range(0, len(block), _AT_ONCE):
            yield from run.take(block, range(start, min(start + _AT_ONCE, len(block))))
    yield from run.rest()


class _Waiting(NamedTuple):
    """A frame whose look-ahead is not complete, and where each filtered person's data are."""

    part: Part
    stamp: int
    source: str
    people: list[tuple[int, _Person, int]]
    """Row in the frame, who, and the number of the step."""


class _Rhythm:
    """The sample time of one source and the filter tuned to it."""

    def __init__(self, params: FilterParams, method: _Method, events: Events, source: str) -> None:
        self._params, self._method, self._events, self._source = params, method, events, source
        self._intervals: deque[float] = deque(maxlen=_INTERVALS)
        self._stamp: int | None = None
        self._tuned_to = 0.0
        self.period = 1 / 30
        self.tuning = 0.0, 0.0
        self._tune()

    def beat(self, stamp: int) -> None:
        """Note a frame; design the filter anew when the sample time has changed."""
        if self._stamp is not None and 0 < stamp - self._stamp <= self._params.max_gap * 1e9:
            self._intervals.append((stamp - self._stamp) * 1e-9)
            self.period = max(median(self._intervals), _SHORTEST)
        self._stamp = stamp
        doubt = _RETUNE * (_INTERVALS / max(len(self._intervals), 1)) ** 0.5
        first = len(self._intervals) == 1 and self.period != self._tuned_to
        if first or abs(self.period - self._tuned_to) > doubt * self._tuned_to:
            self._tune()

    def _tune(self) -> None:
        params, period = self._params, self.period
        cutoff = min(params.cutoff, _HIGHEST / period)
        if cutoff < params.cutoff:
            self._events.count("filter: cut-off lowered", self._source)
        ahead = int(np.ceil(max(params.lookahead - _JITTER, 0.0) / period))
        corner = self._method.tune(params.order, cutoff, period, ahead)
        self.tuning = corner, period
        self._tuned_to = period


@dataclass(slots=True, eq=False)
class _Person:
    """How far the filters of one person are; their numbers are a row of the bank."""

    row: int
    start: int
    """Time of the first step, ns."""
    stamp: int
    """Time of the last one."""
    n_steps: int = 0
    first: int = 0
    """The step that is estimated next."""


class _Bank(ArrayBank):
    """The filters of all people."""

    ARRAYS = ("now", "ring", "times", "lengths")

    def __init__(self, model: SkeletonModel, method: _Method) -> None:
        super().__init__()
        self._method = method
        n_tracks = 2 * (model.n_markers + model.n_links)
        self.now: Floats = np.zeros((0, n_tracks, method.state_columns))
        self.ring: Floats = np.zeros((0, 4, n_tracks, method.ring_columns))
        """The steps that are still waited for, and the one before."""
        self.times: Floats = np.zeros((0, 4))
        """s since the person's start, of the steps in the ring."""
        self.lengths: Floats = np.zeros((0, model.n_links, 2))

    def take(self) -> int:
        """Return a row for a person who has no steps yet."""
        row = super().take()
        for array in (self.now, self.ring, self.times, self.lengths):
            array[row] = 0.0
        self.now[row, :, self._method.age_column] = np.inf
        self.ring[row, :, :, _filters.AGE] = np.inf
        return row

    def make_room(self, steps: int, people: Iterable[_Person]) -> None:
        """Let the ring hold so many steps of everybody, keeping those of ``people``."""
        size = self.ring.shape[1]
        if steps <= size:
            return
        while size < steps:
            size *= 2
        ring = np.zeros((len(self.ring), size, *self.ring.shape[2:]))
        ring[..., _filters.AGE] = np.inf
        times = np.zeros((len(self.times), size))
        for person in people:
            steps_kept = np.arange(max(person.first - 1, 0), person.n_steps)
            old, new = steps_kept % self.ring.shape[1], steps_kept % size
            ring[person.row, new] = self.ring[person.row, old]
            times[person.row, new] = self.times[person.row, old]
        self.ring, self.times = ring, times


@dataclass(slots=True)
class _Jobs:
    """What the kernel is to do, one after the other."""

    places: list[tuple[int, int, int, int, int]] = field(default_factory=list)
    """Kind, row of the person's pose, row in the bank, step, step before which data end."""
    numbers: list[tuple[float, float, float, float]] = field(default_factory=list)
    """Time of the step and since the last one, s; tuning."""
    done: list[Part] = field(default_factory=list)
    log_times: list[int] = field(default_factory=list)
    """Of the frames that are complete then."""
    rows: int = 0
    """People in these."""


class _Frames:
    """A block, with what is asked for one by one as lists, which is faster."""

    def __init__(self, block: Block) -> None:
        self.block = block
        self.stamps, self.log_times = block.stamps.tolist(), block.log_times.tolist()
        self.rows = block.rows.tolist()
        self.ids, self.times = block.people.ids.tolist(), block.people.stamps.tolist()


class _Run:
    """One pass of the filter over a log."""

    def __init__(self, model: SkeletonModel, params: FilterParams, events: Events) -> None:
        self._params, self._events = params, events
        self._method = _method(params)
        self._bank = _Bank(model, self._method)
        self._limbs = np.ascontiguousarray(model.links)
        self._people: dict[tuple[str, int], _Person] = {}
        self._leaving: list[_Person] = []
        """Who gets no more steps but may be waited for."""
        self._rhythms: dict[str, _Rhythm] = {}
        self._waiting: deque[_Waiting] = deque()
        self._patience = max(params.lookahead - _JITTER, 0.0) * 1e9
        self._last: tuple[int, int] | None = None
        """Stamp and log time of the last frame."""

    def take(self, block: Block, places: Sequence[int]) -> Iterator[Block]:
        """Update the filters with frames of a block; yield the frames that are complete."""
        everybody = [*self._people.values(), *self._leaving]
        held = max((p.n_steps - p.first for p in everybody), default=0)
        frames = _Frames(block)
        new = sum(most_often(frames.ids[slice(*frames.rows[i])]) for i in places)
        # And the step before the first.
        self._bank.make_room(held + new + 2, everybody)
        jobs = _Jobs()
        for i in places:
            stamp, log_time = frames.stamps[i], frames.log_times[i]
            if self._last and stamp - self._last[0] > self._params.max_gap * 1e9:
                while self._waiting:
                    self._finish(jobs, self._last[1])
            self._waiting.append(self._push(jobs, frames, i))
            while self._waiting and stamp - self._waiting[0].stamp >= self._patience:
                self._finish(jobs, log_time)
            self._last = stamp, log_time
        yield from self._carry_out(jobs, block.people)

    def rest(self) -> Iterator[Block]:
        """Yield the frames that are left, now that nothing more comes."""
        jobs = _Jobs()
        if self._waiting and self._last:
            people = self._waiting[0].part[0].people
            while self._waiting:
                self._finish(jobs, self._last[1])
            yield from self._carry_out(jobs, people)

    def _push(self, jobs: _Jobs, frames: _Frames, i: int) -> _Waiting:
        """Plan the steps of the people of a frame."""
        stamp, source = frames.stamps[i], frames.block.sources[i]
        rhythm = self._rhythms.get(source)
        if rhythm is None:
            rhythm = self._rhythms[source] = _Rhythm(
                self._params, self._method, self._events, source
            )
        rhythm.beat(stamp)
        self._forget(stamp)
        begin, end = frames.rows[i]
        found = []
        for row in range(end - begin):
            identity, given = frames.ids[begin + row], frames.times[begin + row]
            if identity == UNTRACKED:
                continue
            now = given or stamp
            person = self._person((source, identity), now)
            if person is None:
                self._events.count("filter: time not increasing", source)
                continue
            before = person.stamp if person.n_steps else now - int(rhythm.period * 1e9)
            step, person.stamp = person.n_steps, now
            person.n_steps += 1
            jobs.places.append((_filters.PUSH, begin + row, person.row, step, 0))
            jobs.numbers.append(
                ((now - person.start) * 1e-9, (now - before) * 1e-9, *rhythm.tuning)
            )
            found.append((row, person, step))
        return _Waiting((frames.block, i), stamp, source, found)

    def _forget(self, stamp: int) -> None:
        limit = stamp - self._params.max_gap * 1e9
        for key in [key for key, person in self._people.items() if person.stamp < limit]:
            self._leaving.append(self._people.pop(key))

    def _person(self, key: tuple[str, int], stamp: int) -> _Person | None:
        """Return who goes on, or starts anew after a gap; None when time stands still."""
        person = self._people.get(key)
        if person is not None and stamp <= person.stamp:
            return None
        if person is not None and stamp - person.stamp > self._params.max_gap * 1e9:
            self._leaving.append(person)
            person = None
        if person is None:
            person = self._people[key] = _Person(self._bank.take(), stamp, stamp)
        return person

    def _finish(self, jobs: _Jobs, log_time: int) -> None:
        """Plan to write the estimates of the frame that waits longest, with all the data so far."""
        waiting = self._waiting.popleft()
        tuning = self._rhythms[waiting.source].tuning
        for row, person, step in waiting.people:
            jobs.places.append((_filters.EMIT, jobs.rows + row, person.row, step, person.n_steps))
            jobs.numbers.append((0.0, 0.0, *tuning))
            person.first = step + 1
        block, i = waiting.part
        jobs.rows += int(block.rows[i, 1] - block.rows[i, 0])
        jobs.done.append(waiting.part)
        jobs.log_times.append(log_time)

    def _carry_out(self, jobs: _Jobs, people: People) -> Iterator[Block]:
        """Do as planned; ``people`` are those whose steps are."""
        params, bank = self._params, self._bank
        out = join(jobs.done) if jobs.done else None
        into = people if out is None else out.people
        self._method.run(
            np.array(jobs.places, np.int64).reshape(-1, 5),
            np.array(jobs.numbers, np.float64).reshape(-1, 4),
            params.order,
            np.array([
                params.max_gap, params.bridge, params.length_time if params.keep_lengths else 0.0,
                _SWEEPS, _TOLERANCE,
            ]),
            self._limbs, people.markers, people.links, people.marker_confidences,
            people.link_confidences, bank.ring, bank.times, bank.now, bank.lengths, into.markers,
            into.links, into.marker_confidences, into.link_confidences,
        )  # fmt: skip
        for person in self._leaving:
            if person.first == person.n_steps:
                bank.give_back(person.row)
        self._leaving = [person for person in self._leaving if person.first < person.n_steps]
        if out is not None:
            yield replace(out, log_times=np.array(jobs.log_times, np.int64))
