"""Putting the messages of several cameras in the order of their times."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator

from hiros_mcap.frames import Block, HeldFrames
from hiros_mcap.skeletons import STATE

_USUAL_DELAY = 100_000_000  # ns: how late cameras are taken to be before any was late


def in_time_order(
    blocks: Iterable[Block], delay: float, *, patient: bool = False
) -> Iterator[Block]:
    """Yield copies of the frames, sorted as :class:`TimeOrder` does."""
    order = TimeOrder(delay, patient=patient)
    for block in blocks:
        yield from order.push(block)
    yield from order.rest()


class TimeOrder:
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
        self._held = HeldFrames()
        self._waiting: list[tuple[int, str, int]] = []
        """A heap: stamp, source, and number of each message that is held."""
        self._latest_of: dict[str, int] = {}
        """Camera to its latest stamp, ns."""
        self._latest = self._now = self._begin = 0
        self._patience = round(delay * 1e9)
        self._delay = self._patience if patient else min(self._patience, _USUAL_DELAY)
        """ns: how late the latest message was."""

    def push(self, block: Block) -> Iterator[Block]:
        """Take messages; yield those that leave now, with their log times."""
        order: list[int] = []
        log_times: list[int] = []
        for number, message in enumerate(block.messages(), self._held.add(block)):
            stamp, source, log_time = message
            self._add(stamp, source, log_time)
            heapq.heappush(self._waiting, (stamp, source, number))
            oldest, recent = self._latest - self._patience, self._latest - self._delay
            complete = self._complete(source)
            while self._waiting:
                first = self._waiting[0]
                if first[0] > oldest and (first[0] > recent or first[:2] > complete):
                    break
                order.append(heapq.heappop(self._waiting)[2])
                log_times.append(self._now)
        yield from self._leave(order, log_times)

    def rest(self) -> Iterator[Block]:
        """Yield what is left, now that nothing more comes."""
        order = [number for *_, number in sorted(self._waiting)]
        self._waiting.clear()
        yield from self._leave(order, [self._now] * len(order))

    def _add(self, stamp: int, source: str, log_time: int) -> None:
        """Take note of a message's times."""
        self._latest, self._now = max(self._latest, stamp), max(self._now, log_time)
        self._begin = self._begin or stamp
        self._delay = max(self._delay, min(self._latest - stamp, self._patience))
        self._latest_of[source] = max(self._latest_of.get(source, 0), stamp)

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

    def _leave(self, order: list[int], log_times: list[int]) -> Iterator[Block]:
        """Yield the messages with these numbers; keep those that wait."""
        if order:
            yield self._held.copies(order, STATE).logged_at(log_times)
            self._held.keep([number for *_, number in self._waiting])
