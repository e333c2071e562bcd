"""Corrects the stamps of a live system: each message by those before it.

Every second, :func:`hiros_mcap.io.camera_clock.corrections_of` says what the clocks did in the last
20 s. Until then, stamps far in the future are replaced, so that no camera takes the others with it;
a clock that was set back only loses its own messages. What the people prove
(:mod:`hiros_mcap.running.pose_follower`) comes in slowly, so that nobody jumps.
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
    LONGEST_DELAY,
    OFFSET,
    CameraTimes,
    ClockCorrection,
    ClockFault,
    corrections_of,
    median,
    middle_of,
)

_EVERY = 1_000_000_000  # ns between two looks; the first compares all clocks
_WINDOW = 600  # messages of each camera that are kept: 20 s at 30 Hz
_AHEAD_NS = 300_000_000  # ns: no delivery becomes so much faster
_FORESIGHT = 0.005  # s: nobody logs a message so long before its time
_SLEW = 0.1
"""s/s: so fast stamps follow what is proved while results go out. People then seem to be a tenth
faster or slower for a moment."""


@dataclass(slots=True)
class _FollowedClock:
    """One camera: how its stamps are corrected, and its last messages."""

    offset: int = 0  # ns, added to stamps
    drift: float = 0.0  # added per unit of time since ``origin``
    origin: int = 0  # stamp, ns, before the correction
    latest: int = 0  # stamp of the last message, ns, before the correction
    proved: int = 0  # ns that are to be added to the stamps
    added: int = 0  # ns of it that are in ``offset`` already
    stamps: array[int] = field(default_factory=partial(array, "q"))
    """Corrected stamps of the last messages, ns."""
    log_times: array[int] = field(default_factory=partial(array, "q"))
    floor: int | None = None  # least lag of corrected messages, ns

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
            self.floor = None if self.floor is None else self.floor - step
            self.stamps = array("q", (self.times.stamps + step).tobytes())

    @property
    def times(self) -> CameraTimes:
        """The last messages."""
        return CameraTimes(np.array(self.stamps, np.int64), np.array(self.log_times, np.int64))

    @property
    def lag(self) -> float:
        """Usual lag, s."""
        return median(self.times.lags)

    def add(self, stamp: int, log_time: int) -> None:
        """Remember a message."""
        self.stamps.append(stamp)
        self.log_times.append(log_time)
        if len(self.stamps) > 2 * _WINDOW:
            del self.stamps[:-_WINDOW], self.log_times[:-_WINDOW]

    def follow(self, correction: ClockCorrection) -> None:
        """Take over what a clock did in the window, whose first stamp is right."""
        before = self.times
        right = correction.follow(before.stamps, before.log_times)
        right += before.stamps[0] - right[0]
        if (right != before.stamps).any():
            self.stamps = array("q", right.tobytes())
            self.offset, self.origin = self.stamps[-1] - self.latest, self.latest
            self.drift += correction.drift
        lags = before.log_times - right
        usual = lags[lags > median(lags) - _AHEAD_NS]
        place = int(0.05 * (len(usual) - 1))
        self.floor = int(np.partition(usual, place)[place])


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
        self.given, self._reorder = given, max(reorder, _AHEAD_NS / 2e9)
        self._ahead = [] if ahead is None else ahead
        self._faults = faults
        self._clocks: dict[str, _FollowedClock] = {}
        self._asked = 0

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
        self._note(source, -more * 1e-9, clock.stamps[-1])

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
                until = until or log_time + _EVERY
                if log_time <= until:
                    stamp += round(self.given.get(source, 0.0) * 1e9)
                    lags.setdefault(source, []).append((log_time - stamp) * 1e-9)
            if block.log_times[-1] > until:
                break
        least = {source: min(some) for source, some in sorted(lags.items())}
        for source, lag in least.items():
            others = {name: other for name, other in least.items() if name != source}
            self._compare(source, until - _EVERY, lag, others)
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
            self._note(source, usual - lag, log_time - round(usual * 1e9))

    def _take(self, stamp: int, source: str, log_time: int, n_people: int) -> int:
        """Return the corrected stamp of a message."""
        if source not in self._clocks:
            lag = (log_time - stamp) * 1e-9 - self.given.get(source, 0.0)
            self._compare(source, log_time, lag, self.lags)
        if log_time - self._asked > _EVERY:
            self._asked = log_time
            self._ask()
        clock = self._clocks[source]
        clock.slew(stamp)
        right = clock.corrected(stamp)
        if n_people and (not clock.stamps or right != clock.stamps[-1]):
            clock.latest = stamp
            clock.add(right, log_time)
        if clock.floor is not None and log_time - right < clock.floor - _AHEAD_NS:
            right = log_time - clock.floor
        return right

    def _ask(self) -> None:
        """Follow what the clocks did in the last seconds: steps and drifts."""
        camera_times = {name: clock.times for name, clock in self._clocks.items() if clock.stamps}
        corrections, faults = corrections_of(camera_times, set(camera_times))
        for name, correction in corrections.items():
            self._clocks[name].follow(correction)
        drifting = {fault.camera for fault in self._faults if fault.kind == DRIFT}
        for fault in faults:
            if fault.kind != DRIFT or fault.camera not in drifting:
                self._faults.append(fault)

    def _note(self, source: str, seconds: float, stamp: int) -> None:
        """Note by how much a clock is ahead; all that is found of a camera is one fault."""
        now = stamp
        for fault in list(self._faults):
            if (fault.camera, fault.kind) == (source, OFFSET):
                self._faults.remove(fault)
                seconds, stamp = seconds + fault.seconds, fault.at_ns
        self._ahead.append((now, source, seconds))
        self._faults.append(ClockFault(source, OFFSET, seconds, stamp, corrected=True))
