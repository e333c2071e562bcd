"""Putting the messages of several cameras in the order of their times."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from heapq import heappop, heappush

from hiros_mcap.frames import Block, HeldFrames

SHARE = 0.97  # of the messages of a camera
_MEMORY = 10_000_000_000  # ns
_EVERY = 10  # messages of a camera after which its lateness is found again
_TOLERATED, _FAST = 40_000_000, 30_000_000
"""ns: a camera's messages come every 33 ms, and the stages gather those of one moment. Nobody waits
for what is late by no more. Where a camera's messages come faster than _FAST, its period is the
limit: what is later is older than what the others have shown since."""


def in_time_order(blocks: Iterable[Block], wait: float | Lateness) -> Iterator[Block]:
    """Yield messages sorted by (stamp, source).

    A message leaves when one has come that is younger by ``wait``. What is later still leaves at
    once, out of order. The log time is that of the arrival that let a message leave, so log times
    never run backwards.

    Parameters
    ----------
    wait : s in time of the data; of live messages, what measures it as they come.
    """
    held = HeldFrames()
    waiting: list[tuple[int, str, int]] = []  # a heap: stamp, camera, number of each that is held
    lateness = wait if isinstance(wait, Lateness) else None
    patience = 0 if isinstance(wait, Lateness) else round(wait * 1e9)
    latest = now = 0  # stamp and log time, ns
    for block in blocks:
        first, leaving = held.add(block), list[tuple[int, int]]()
        for number, (stamp, source, log_time) in enumerate(block.messages(), first):
            if lateness is not None:
                patience = lateness.take(stamp, source, log_time)
            latest, now = max(latest, stamp), max(now, log_time)
            heappush(waiting, (stamp, source, number))
            while waiting and waiting[0][0] <= latest - patience:
                leaving.append((heappop(waiting)[2], now))
        del block  # else it lies in memory until the next one is made
        # What waited goes on together with what came: later stages cost a call per block.
        numbers, log_times = zip(*leaving, strict=True) if leaving else ((), ())
        ready = [held.take(numbers).logged_at(log_times)] if leaving else []
        held.keep([number for *_, number in waiting])
        while ready:
            yield ready.pop()
    if waiting:
        yield held.take([n for *_, n in sorted(waiting)]).logged_at([now] * len(waiting))


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
