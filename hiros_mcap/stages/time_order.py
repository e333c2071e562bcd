"""Putting the messages of several cameras in the order of their times."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush

from hiros_mcap.frames import Block, HeldFrames

_USUAL_DELAY = 100_000_000  # ns: how late cameras are taken to be before any was late
# Of Lateness.
SHARE = 0.97  # of the messages of a camera
_MEMORY = 10_000_000_000  # ns
_EVERY = 10  # messages of a camera after which its lateness is found again
_TOLERATED, _FAST = 40_000_000, 30_000_000
"""ns: a camera's messages come every 33 ms, and the stages gather those of one moment. Nobody waits
for what is late by no more. Where a camera's messages come faster than _FAST, its period is the
limit: what is later is older than what the others have shown since."""


def in_time_order(
    blocks: Iterable[Block],
    delay: float = 0.0,
    *,
    patient: bool = False,
    lateness: Lateness | None = None,
) -> Iterator[Block]:
    """Yield messages sorted by (stamp, source).

    A message leaves when every camera has sent a younger one, and when as much time has passed as
    the latest message so far would have needed. It waits ``delay`` seconds at most, and nobody
    waits for a camera that has been silent for so long. A message that is later still leaves at
    once, out of order. Its log time is that of the arrival that let it leave, so log times never
    run backwards.

    Parameters
    ----------
    delay : longest wait, s in time of the data.
    patient : every message waits so long. Messages of a file may be late without a warning.
    lateness : measures how long every message waits, in place of ``delay``.
    """
    order = _TimeOrder(delay, lateness, patient=patient)
    for block in blocks:
        ready = order.push(block)
        del block  # else it lies in memory until the next one is made
        while ready:
            yield ready.pop(0)
    yield from order.rest()


class _TimeOrder:
    """The queue of :func:`in_time_order`, which has the same parameters."""

    def __init__(self, delay: float, lateness: Lateness | None, *, patient: bool) -> None:
        self._lateness = lateness
        self._held = HeldFrames()
        self._waiting: list[tuple[int, str, int]] = []
        """A heap: stamp, camera and number of each message that is held."""
        self._latest_of: dict[str, int] = {}  # camera -> its latest stamp, ns
        self._latest = self._now = self._begin = 0
        """Latest stamp and log time, and the first stamp, ns."""
        self._patience = round(delay * 1e9)
        self._delay = self._patience if patient else min(self._patience, _USUAL_DELAY)
        """How late the latest message was, ns."""

    def push(self, block: Block) -> list[Block]:
        """Take messages; return those that leave now, with their log times."""
        first, leaving = self._held.add(block), list[tuple[int, int]]()
        for number, (stamp, source, log_time) in enumerate(block.messages(), first):
            if self._lateness:
                self._patience = self._delay = self._lateness.take(stamp, source, log_time)
            self._latest, self._now = max(self._latest, stamp), max(self._now, log_time)
            self._begin = self._begin or stamp
            self._delay = max(self._delay, min(self._latest - stamp, self._patience))
            self._latest_of[source] = max(self._latest_of.get(source, 0), stamp)
            heappush(self._waiting, (stamp, source, number))
            while self._waiting and self._leaves(*self._waiting[0][:2]):
                leaving.append((heappop(self._waiting)[2], self._now))
        # What waited goes on together with what came: later stages cost a call per block.
        ready = [self._logged(*zip(*leaving, strict=True))] if leaving else []
        self._held.keep([number for *_, number in self._waiting])
        return ready

    def rest(self) -> Iterator[Block]:
        """Yield what is left, now that nothing more comes."""
        if n := len(self._waiting):
            yield self._logged([number for *_, number in sorted(self._waiting)], [self._now] * n)

    def _logged(self, numbers: Sequence[int], log_times: Sequence[int]) -> Block:
        return self._held.take(numbers).logged_at(log_times)

    def _leaves(self, stamp: int, source: str) -> bool:
        """Whether a message waits no longer: it waited enough, or no camera sends an older one."""
        oldest = self._latest - self._patience
        if stamp <= oldest:
            return True
        if stamp > self._latest - self._delay or stamp == self._latest or self._begin >= oldest:
            return False  # or there may be cameras that have not sent anything yet
        latest_of = self._latest_of.items()
        return all(last <= oldest or (last, name) >= (stamp, source) for name, last in latest_of)


@dataclass(slots=True)
class _Camera:
    """The latest messages of a camera."""

    late: deque[tuple[int, int]] = field(default_factory=deque)  # log time and lateness of each, ns
    count: int = 0
    usual: int = 0  # ns by which nearly all messages are late at most
    period: float = _TOLERATED  # ns from one message to the next; long until it is known

    def add(self, log_time: int, late: int) -> bool:
        """Remember a message; return whether the lateness was found again."""
        self.late.append((log_time, late))
        while log_time - self.late[0][0] > _MEMORY:
            self.late.popleft()
        self.count += 1
        if self.count % _EVERY:
            return False
        ordered = sorted([some for _, some in self.late])
        self.usual = ordered[math.ceil((len(ordered) - 1) * SHARE)]
        self.period = (log_time - self.late[0][0]) / max(len(self.late) - 1, 1)
        return True


class Lateness:
    """Measures how late the messages of the cameras are, in the order in which they come.

    A message is late by the time between its stamp and the newest stamp that came before it. Nearly
    all messages of a camera, SHARE, are in time if the others wait as long as these were late in
    the last seconds. Who waits for all of them waits for a single one that hangs in the network.

    Parameters
    ----------
    limit : longest wait, s. least : shortest wait, s.
    """

    def __init__(self, limit: float, least: float = 0.0) -> None:
        self._limit, self._least = round(limit * 1e9), round(least * 1e9)
        self._cameras: dict[str, _Camera] = {}
        self._latest = 0
        self.wait = max(self._limit, self._least)
        """ns that messages wait from now on: as long as they may until their lateness is known."""
        self.needed: dict[str, float] = {}
        """Camera -> longest wait, s, that it would have needed, if that is over the limit."""

    def take(self, stamp: int, source: str, log_time: int) -> int:
        """Take note of a message; return how long messages wait from now on, ns."""
        self._latest = max(self._latest, stamp)
        if source not in self._cameras:
            self._cameras[source] = _Camera()
        camera = self._cameras[source]
        if not camera.add(log_time, self._latest - stamp):
            return self.wait
        heard = [c for c in self._cameras.values() if log_time - c.late[-1][0] <= _MEMORY]
        period = min(c.period for c in heard)
        tolerated = period if period < _FAST else _TOLERATED
        if camera.usual > max(self._limit, tolerated):
            most = max(self.needed.get(source, 0.0), camera.usual * 1e-9)
            self.needed[source] = most
        usual = max(c.usual for c in heard)
        self.wait = max(min(usual if usual > tolerated else 0, self._limit), self._least)
        return self.wait
