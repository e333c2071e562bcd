"""Corrects the stamps of a live system: each message by those before it.

The tests are those of :mod:`hiros_mcap.io.camera_clock`, on the last seconds of the log. A step is
known some messages after it. Until then, stamps far in the future are replaced, so that no camera
takes the others with it; a clock that was set back only loses its own messages. What the people
prove (:mod:`hiros_mcap.running.pose_follower`) comes in slowly, so that nobody jumps.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import chain

import numpy as np

from hiros_mcap.frames import Block
from hiros_mcap.io.camera_clock import (
    DRIFT,
    IRREGULAR,
    LEAST_AFTER,
    LONGEST_DELAY,
    OFFSET,
    STEP,
    CameraTimes,
    ClockFault,
    find_drifts,
    find_steps,
    middle_of,
)

_FIRST = 1_000_000_000  # ns: from the first message on, until all clocks are compared
_CONFIRMED = 30  # messages after an odd interval, until a clock counts as set back
_LEAST_STEP = 0.08  # s: a part of the log alone does not tell smaller ones
_WINDOW = 600  # messages of each camera that are kept: 20 s at 30 Hz
_AHEAD = 0.3  # s: no delivery becomes so much faster
_RENEWED = 15  # messages after which the usual interval is found again
_RECENT = 90  # messages
_EVERY = 2_000_000_000  # ns between two looks for drifts
_FORESIGHT = 0.005  # s: nobody logs a message so long before its time
_SLEW = 0.1
"""s/s: so fast stamps follow what is proved while results go out. People then seem to be a tenth
faster or slower for a moment."""


@dataclass(slots=True)
class _FollowedClock:
    """One camera: how its stamps are corrected, and its last messages."""

    offset: int = 0
    """ns, added to stamps."""
    drift: float = 0.0
    """Added per unit of time since ``origin``."""
    origin: int = 0
    """Stamp, ns, before the correction."""
    latest: int = 0
    """Stamp of the last message, ns, before the correction."""
    proved: int = 0
    """ns that are to be added to the stamps."""
    added: int = 0
    """ns of it that are in ``offset`` already."""
    stamps: array[int] = field(default_factory=partial(array, "q"))
    """Corrected stamps of the last messages, ns."""
    log_times: array[int] = field(default_factory=partial(array, "q"))
    period: int = 0
    """Usual interval between messages, ns."""
    least: int = 0
    """Least lag before an odd interval, ns."""
    suspected: int = 0
    """Messages that are still to come before an odd interval is judged; 0 = none is suspected."""
    again: bool = False
    """Whether another interval was odd meanwhile."""

    def corrected(self, stamp: int) -> int:
        """Return a stamp without what is known to be wrong."""
        return stamp + self.offset + round((stamp - self.origin) * self.drift)

    def slew(self, stamp: int) -> None:
        """Come nearer to what is proved, as far as the time since the last message allows."""
        most = round(_SLEW * max(stamp - self.latest, 0))
        step = max(-most, min(self.proved - self.added, most))
        if step:
            self.added += step
            self.offset += step
            self.least -= step
            self.stamps = array("q", (self.times.stamps + step).tobytes())

    @property
    def times(self) -> CameraTimes:
        """The last messages."""
        return CameraTimes(np.array(self.stamps, np.int64), np.array(self.log_times, np.int64))

    @property
    def lag(self) -> float:
        """Usual lag, s."""
        return float(np.median(self.times.lags))

    def add(self, stamp: int, log_time: int) -> None:
        """Remember a message."""
        self.stamps.append(stamp)
        self.log_times.append(log_time)
        if len(self.stamps) % _RENEWED == 0:
            self.period = int(np.median(np.diff(self.stamps[-2 * _RENEWED :])))
        if len(self.stamps) > 2 * _WINDOW:
            del self.stamps[:-_WINDOW], self.log_times[:-_WINDOW]

    def is_odd(self, stamp: int) -> bool:
        """Whether a corrected stamp comes at an unusual time."""
        has_period = self.period > 0
        return has_period and abs(stamp - self.stamps[-1] - self.period) > IRREGULAR * 1e9

    def least_lag(self) -> int:
        """Return the least lag of the last seconds, ns."""
        times = self.times
        return int((times.log_times - times.stamps)[-_RECENT:].min())


class ClockFollower:
    """Corrects messages in the order of the log.

    Parameters
    ----------
    given : seconds that the user adds to the stamps of cameras. faults : what is found goes here.
    reorder : s; a camera that is so much ahead of the others makes their messages too late.
    ahead : gets from which stamp on, ns, which camera's clock is found to be ahead by how many s.
    """

    def __init__(
        self, given: Mapping[str, float], faults: list[ClockFault], reorder: float,
        ahead: list[tuple[int, str, float]] | None = None,
    ) -> None:  # fmt: skip
        self.given, self._reorder = given, max(reorder, _AHEAD / 2)
        self._ahead = [] if ahead is None else ahead
        self._faults = faults
        self._clocks: dict[str, _FollowedClock] = {}
        self._checked = 0

    def compared(self, blocks: Iterable[Block]) -> Iterator[Block]:
        """Yield the blocks as they are, once the clocks are compared by their first messages."""
        rest = iter(blocks)
        yield from chain(self._start(rest), rest)

    def correct(self, block: Block) -> Block:
        """Return a block with right stamps."""
        stamps = block.stamps.copy()
        sizes = block.sizes.tolist()
        for i, (stamp, source, log_time) in enumerate(block.messages()):
            stamps[i] = self._take(stamp, source, log_time, sizes[i])
        return block.restamped(stamps)

    def prove(self, source: str, seconds: float) -> None:
        """Take note that so much is to be added to a camera's stamps; it is, little by little."""
        clock = self._clocks[source]
        more = round(seconds * 1e9) - clock.proved
        clock.proved += more
        self._note(source, OFFSET, -more * 1e-9, clock.stamps[-1])

    def proved(self, source: str) -> float:
        """Seconds that are to be added to the stamps of a camera in all, as proved so far."""
        return self._clocks[source].proved * 1e-9

    def added(self, source: str) -> float:
        """Seconds of it that are added by now."""
        return self._clocks[source].added * 1e-9

    @property
    def lags(self) -> dict[str, float]:
        """Usual time, s, from each camera's corrected stamps to the log times."""
        return {name: clock.lag for name, clock in self._clocks.items() if clock.stamps}

    def _start(self, blocks: Iterator[Block]) -> list[Block]:
        """Compare the clocks by their first messages; return the blocks that were looked at."""
        waiting: list[Block] = []
        lags: dict[str, list[float]] = {}
        until = 0
        for block in blocks:
            waiting.append(block)
            for stamp, source, log_time in block.messages():
                until = until or log_time + _FIRST
                if log_time <= until:
                    stamp += round(self.given.get(source, 0.0) * 1e9)
                    lags.setdefault(source, []).append((log_time - stamp) * 1e-9)
            if block.log_times[-1] > until:
                break
        least = {source: min(some) for source, some in sorted(lags.items())}
        for source, lag in least.items():
            others = {name: other for name, other in least.items() if name != source}
            self._compare(source, until - _FIRST, lag, others)
        return waiting

    def _compare(self, source: str, log_time: int, lag: float, others: Mapping[str, float]) -> None:
        """Start with a camera at a log time; align it if no delivery explains its lag, s."""
        clock = self._clocks[source] = _FollowedClock(round(self.given.get(source, 0.0) * 1e9))
        if not others or source in self.given:
            return
        usual = max(others.values()) if len(others) == 1 else middle_of(others)
        foresees = lag < -_FORESIGHT and usual >= 0.0
        if foresees or lag < usual - self._reorder or lag > usual + LONGEST_DELAY:
            clock.offset += round((lag - usual) * 1e9)
            self._note(source, OFFSET, usual - lag, log_time - round(usual * 1e9))

    def _take(self, stamp: int, source: str, log_time: int, n_people: int) -> int:
        """Return the corrected stamp of a message."""
        if source not in self._clocks:
            lag = (log_time - stamp) * 1e-9 - self.given.get(source, 0.0)
            self._compare(source, log_time, lag, self.lags)
        clock = self._clocks[source]
        clock.slew(stamp)
        right = clock.corrected(stamp)
        if n_people and (not clock.stamps or right != clock.stamps[-1]):
            clock.latest = stamp
            right = self._check(clock, source, right, log_time)
        return right

    def _check(self, clock: _FollowedClock, source: str, stamp: int, log_time: int) -> int:
        """Look for what is wrong with a corrected stamp; return what it shall be."""
        if clock.is_odd(stamp):
            if clock.suspected:
                clock.again = True
            else:
                clock.suspected, clock.least = _CONFIRMED, clock.least_lag()
        clock.add(stamp, log_time)
        if clock.suspected:
            clock.suspected -= 1
            if clock.suspected in (0, _CONFIRMED - LEAST_AFTER):
                stamp += self._find_steps(clock, source)
            elif log_time - stamp < clock.least - round(_AHEAD * 1e9):
                stamp = log_time - clock.least
            if not clock.suspected and clock.again:
                clock.suspected, clock.again = _CONFIRMED, False
        if log_time - self._checked > _EVERY:
            self._checked = log_time
            self._find_drifts()
        return stamp

    def _find_steps(self, clock: _FollowedClock, source: str) -> int:
        """Correct a clock that was set; return by how much, ns.

        What looks like a clock that was set back may be a late delivery, and takes longer to tell.
        """
        others = [other.times for other in self._clocks.values() if other is not clock]
        times, total = clock.times, 0
        for place, seconds in find_steps(times, others):
            if abs(seconds) < _LEAST_STEP or (seconds < 0 and clock.suspected):
                continue
            shift = round(seconds * 1e9)
            times.stamps[place:] -= shift
            total -= shift
            self._note(source, STEP, seconds, int(times.stamps[place]))
        if total:
            clock.offset += total
            clock.suspected = 0
            clock.stamps = array("q", times.stamps.tobytes())
        return total

    def _find_drifts(self) -> None:
        """Follow clocks that run faster or slower than the others."""
        camera_times = {name: clock.times for name, clock in self._clocks.items() if clock.stamps}
        for name, slope in find_drifts(camera_times).items():
            clock, times = self._clocks[name], camera_times[name]
            passed = times.stamps - times.stamps[0]
            followed = times.stamps + np.round(passed * slope).astype(np.int64)
            clock.stamps = array("q", followed.tobytes())
            clock.offset, clock.origin = clock.stamps[-1] - clock.latest, clock.latest
            clock.drift += slope
            if not any(f.kind == DRIFT and f.camera == name for f in self._faults):
                self._note(name, DRIFT, -slope, clock.stamps[0])

    def _note(self, source: str, kind: str, seconds: float, stamp: int) -> None:
        """Note a fault; offsets of a camera are one."""
        now = stamp
        for fault in list(self._faults):
            if kind == OFFSET and (fault.camera, fault.kind) == (source, kind):
                self._faults.remove(fault)
                seconds, stamp = seconds + fault.seconds, fault.at_ns
        if kind == OFFSET:
            self._ahead.append((now, source, seconds))
        self._faults.append(ClockFault(source, kind, seconds, stamp, corrected=True))
