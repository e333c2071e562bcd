"""Skeleton filter (Hi-ROS 2023, section 3.4): smooth trajectories, velocities, accelerations.

Each marker and link of a person is a track of its own, filtered at the person's source times by
one of two filters with a free cut-off and order. With a look-ahead (the default) the estimate at
time t also uses the data up to t + lookahead: no lag and less error than the input, where a
strictly causal filter of the same smoothness adds error (benchmarks/bench_filter.py). Frames come
out in the order they came in, each with the log time of the frame that completed its look-ahead.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from statistics import median
from typing import Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from hiros_mcap.blocks import Block, frames_of
from hiros_mcap.events import Events
from hiros_mcap.kernels import filters as _filters
from hiros_mcap.params import Params
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, SkeletonModel

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
    push: Callable[..., None]
    emit: Callable[..., None]
    ring_columns: int
    state_columns: int
    age_column: int


def _method(params: FilterParams) -> _Method:
    """Kernels of the chosen filter; those of the other one are not even compiled."""
    if params.method == "state_space":
        return _Method(
            _filters.state_space_noise,
            _filters.state_space_push,
            _filters.state_space_emit,
            _filters.COLUMNS,
            _filters.STATE,
            _filters.NOW_AGE,
        )
    from hiros_mcap.kernels import butterworth

    return _Method(
        butterworth.butterworth_rate,
        butterworth.butterworth_push,
        butterworth.butterworth_emit,
        butterworth.COLUMNS,
        butterworth.STATE + 3 * (params.order - 1),
        butterworth.NOW_AGE,
    )


def smooth(
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
    run = _Run(model, params, Events() if events is None else events)
    waiting: deque[_Waiting] = deque()
    patience = max(params.lookahead - _JITTER, 0.0) * 1e9
    last: Frame | None = None
    for frame in frames:
        if last is not None and frame.stamp - last.stamp > params.max_gap * 1e9:
            while waiting:
                yield run.finish(waiting.popleft(), last.log_time)
        waiting.append(run.take(frame))
        while waiting and frame.stamp - waiting[0].frame.stamp >= patience:
            yield run.finish(waiting.popleft(), frame.log_time)
        last = frame
    while waiting and last is not None:
        yield run.finish(waiting.popleft(), last.log_time)


def smooth_blocks(
    blocks: Iterable[Block],
    model: SkeletonModel,
    params: FilterParams = FilterParams(),  # noqa: B008 - immutable
    events: Events | None = None,
) -> Iterator[Block]:
    """Do what :func:`smooth` does, a block at a time."""
    yield from map(Block.of, smooth(frames_of(blocks), model, params, events))


@dataclass(slots=True)
class _Waiting:
    """A frame whose look-ahead is not complete, and where each filtered person's data are."""

    frame: Frame
    rows: list[tuple[int, _Person, int]]


class _Rhythm:
    """The sample time of one source and the filter tuned to it."""

    def __init__(self, params: FilterParams, method: _Method, events: Events, source: str) -> None:
        self._params, self._method, self._events, self._source = params, method, events, source
        self._intervals: deque[float] = deque(maxlen=_INTERVALS)
        self._stamp: int | None = None
        self._tuned_to = 0.0
        self.period = 1 / 30
        self.tuning: Floats = np.zeros(2)
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
        self.tuning = np.array([corner, period])
        self._tuned_to = period


class _Person:
    """The tracks of one person: their filters' states and a ring of the steps still waited for."""

    def __init__(self, model: SkeletonModel, method: _Method) -> None:
        n_tracks = 2 * (model.n_markers + model.n_links)
        self.now = np.zeros((n_tracks, method.state_columns))
        self.now[:, method.age_column] = np.inf
        self.ring = np.zeros((4, n_tracks, method.ring_columns))
        self.ring[:, :, _filters.AGE] = np.inf
        self.times = np.zeros(4)
        self.lengths = np.zeros((model.n_links, 2))
        self.n_steps = 0
        self.first = 0
        self.start = self.stamp = 0

    def step(self, stamp: int) -> int:
        """Make room for a step at ``stamp``, ns; return its number."""
        if self.n_steps == 0:
            self.start = stamp
        if self.n_steps - self.first + 2 > len(self.times):  # + the step before the first
            self._grow()
        self.times[self.n_steps % len(self.times)] = (stamp - self.start) * 1e-9
        self.stamp = stamp
        self.n_steps += 1
        return self.n_steps - 1

    def _grow(self) -> None:
        old = np.arange(max(self.first - 1, 0), self.n_steps)
        size = len(self.times)
        ring, times = np.zeros((2 * size, *self.ring.shape[1:])), np.zeros(2 * size)
        ring[:, :, _filters.AGE] = np.inf
        ring[old % (2 * size)] = self.ring[old % size]
        times[old % (2 * size)] = self.times[old % size]
        self.ring, self.times = ring, times


@dataclass(slots=True)
class _Run:
    """One pass of the filter over a log."""

    model: SkeletonModel
    params: FilterParams
    events: Events
    people: dict[tuple[str, int], _Person] = field(default_factory=dict)
    rhythms: dict[str, _Rhythm] = field(default_factory=dict)
    limbs: npt.NDArray[np.int32] = field(init=False)
    method: _Method = field(init=False)

    def __post_init__(self) -> None:
        self.method = _method(self.params)
        self.limbs = np.ascontiguousarray(self.model.links)

    def take(self, frame: Frame) -> _Waiting:
        """Update the filters of the people of a frame."""
        rhythm = self.rhythms.get(frame.source)
        if rhythm is None:
            rhythm = self.rhythms[frame.source] = _Rhythm(
                self.params, self.method, self.events, frame.source
            )
        rhythm.beat(frame.stamp)
        self._forget(frame.stamp)
        rows = []
        identities = zip(frame.ids.tolist(), frame.stamps.tolist(), strict=True)
        for row, (identity, given) in enumerate(identities):
            if identity != UNTRACKED:
                stamp = given or frame.stamp
                person = self._person((frame.source, identity), stamp)
                if person is None:
                    self.events.count("filter: time not increasing", frame.source)
                    continue
                rows.append((row, person, self._push(frame, row, person, stamp)))
        return _Waiting(frame, rows)

    def _forget(self, stamp: int) -> None:
        limit = stamp - self.params.max_gap * 1e9
        for key in [key for key, person in self.people.items() if person.stamp < limit]:
            del self.people[key]

    def _person(self, key: tuple[str, int], stamp: int) -> _Person | None:
        """Return who goes on, or starts anew after a gap; None when time stands still."""
        person = self.people.get(key)
        if person is not None and stamp <= person.stamp:
            return None
        if person is None or stamp - person.stamp > self.params.max_gap * 1e9:
            person = self.people[key] = _Person(self.model, self.method)
        return person

    def _push(self, frame: Frame, row: int, person: _Person, stamp: int) -> int:
        params, rhythm = self.params, self.rhythms[frame.source]
        before = person.stamp if person.n_steps else stamp - int(rhythm.period * 1e9)
        step = person.step(stamp)
        self.method.push(
            frame.markers,
            frame.links,
            frame.marker_confidences,
            frame.link_confidences,
            row,
            person.ring,
            person.times,
            step,
            person.now,
            params.max_gap,
            rhythm.tuning,
            params.order,
        )
        if params.keep_lengths:
            _filters.follow_lengths(
                frame.markers,
                row,
                self.limbs,
                (stamp - before) * 1e-9,
                params.length_time,
                person.lengths,
            )
        return step

    def finish(self, waiting: _Waiting, log_time: int) -> Frame:
        """Write the estimates into a copy of the frame, with all the data there are by now."""
        frame, params = waiting.frame, self.params
        out = frame.replace(
            log_time=log_time,
            markers=frame.markers.copy(),
            links=frame.links.copy(),
            marker_confidences=frame.marker_confidences.copy(),
            link_confidences=frame.link_confidences.copy(),
        )
        for row, person, step in waiting.rows:
            self.method.emit(
                person.ring,
                person.times,
                step,
                person.n_steps,
                self.rhythms[frame.source].tuning,
                params.order,
                params.bridge,
                out.markers,
                out.links,
                out.marker_confidences,
                out.link_confidences,
                row,
            )
            person.first = step + 1
            if params.keep_lengths:
                _filters.restore_lengths(
                    out.markers, row, self.limbs, person.lengths, _SWEEPS, _TOLERANCE
                )
        return out
