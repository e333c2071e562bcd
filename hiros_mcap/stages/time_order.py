"""Putting the messages of several cameras in the order of their times."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np

from hiros_mcap.frames import Block, Part, join
from hiros_mcap.skeletons import Frame

_USUAL_DELAY = 100_000_000  # ns: how late cameras are taken to be before any was late

T = TypeVar("T")


class TimeOrder(Generic[T]):
    """A queue that sorts messages by (stamp, source).

    A message leaves when every camera has sent a younger one, and when as much time has passed as
    the latest message so far would have needed. It waits ``delay`` seconds at most, and nobody
    waits for a camera that has been silent for so long. A message that is later still leaves at
    once, out of order. Its log time is that of the arrival that let it leave, so log times never
    run backwards.

    Parameters
    ----------
    delay : longest wait, s in time of the data.
    patient : every message waits so long. Messages of a file may be late without a warning.
    """

    def __init__(self, delay: float, *, patient: bool = False) -> None:
        self._waiting: list[tuple[int, str, int, T]] = []
        self._latest_of: dict[str, int] = {}
        """Camera to its latest stamp, ns."""
        self._latest = self._now = self._begin = 0
        self._patience = round(delay * 1e9)
        self._delay = self._patience if patient else min(self._patience, _USUAL_DELAY)
        """ns: how late the latest message was."""
        self._count = itertools.count()

    def push(self, stamp: int, source: str, log_time: int, item: T) -> list[tuple[T, int]]:
        """Take a message; return those that leave now, with their log times, ns."""
        latest = self._latest = max(self._latest, stamp)
        self._now = max(self._now, log_time)
        self._begin = self._begin or stamp
        self._delay = max(self._delay, min(latest - stamp, self._patience))
        self._latest_of[source] = max(self._latest_of.get(source, 0), stamp)
        heapq.heappush(self._waiting, (stamp, source, next(self._count), item))
        oldest, recent = latest - self._patience, latest - self._delay
        complete, ready = self._complete(source), []
        while self._waiting:
            first = self._waiting[0]
            if first[0] > oldest and (first[0] > recent or first[:2] > complete):
                break
            ready.append((heapq.heappop(self._waiting)[3], self._now))
        return ready

    def rest(self) -> list[tuple[T, int]]:
        """Return what is left, now that nothing more comes."""
        return [(heapq.heappop(self._waiting)[3], self._now) for _ in range(len(self._waiting))]

    def _complete(self, source: str) -> tuple[int, str]:
        """Stamp and source up to which every camera has sent its messages."""
        oldest = self._latest - self._patience
        if self._begin >= oldest:  # there may be cameras that have not sent anything yet
            return oldest, source
        complete = self._latest, ""
        for name, stamp in self._latest_of.items():
            if stamp > oldest and (stamp, name) < complete:
                complete = stamp, name
        return complete


def in_time_order(frames: Iterable[Frame], delay: float) -> Iterator[Frame]:
    """Sort frames as :class:`TimeOrder` does."""
    order: TimeOrder[Frame] = TimeOrder(delay)
    for frame in frames:
        for ready, now in order.push(frame.stamp, frame.source, frame.log_time, frame):
            yield ready.replace(log_time=now)
    for ready, now in order.rest():
        yield ready.replace(log_time=now)


def late_in_order(blocks: Iterable[Block], delay: float) -> Iterator[Block]:
    """Sort the frames of a file in which some are up to ``delay``, s, older than the one before."""
    order: TimeOrder[Part] = TimeOrder(delay, patient=True)
    for block in blocks:
        ready = [pair for message in block.messages() for pair in order.push(*message)]
        yield from _joined(ready)
    yield from _joined(order.rest())


def _joined(ready: list[tuple[Part, int]]) -> Iterator[Block]:
    if ready:
        block = join([part for part, _ in ready])
        yield replace(block, log_times=np.array([now for _, now in ready], np.int64))
