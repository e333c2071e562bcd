"""Putting the messages of several cameras in the order of their times."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.frames import Block, CameraNumbers, HeldFrames
from hiros_mcap.kernels.array_types import I1, I2
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import Stamps

_USUAL_DELAY = 100_000_000  # ns: how late cameras are taken to be before any was late
# Of Lateness.
SHARE = 0.97  # of the messages of a camera
_MEMORY = 10_000_000_000  # ns
_EVERY = 10  # messages of a camera after which its lateness is found again
_TOLERATED, _FAST = 40_000_000, 30_000_000
"""ns: a camera's messages come every 33 ms, and the stages gather those of one moment. Nobody waits
for what is late by no more. Where a camera's messages come faster than _FAST, its period is the
limit: what is later is older than what the others have shown since."""

# Places of what is known of all messages so far, ns.
_LATEST, _NOW, _BEGIN, _DELAY, _PATIENCE = range(5)


def in_time_order(
    blocks: Iterable[Block],
    delay: float = 0.0,
    *,
    patient: bool = False,
    lateness: Lateness | None = None,
) -> Iterator[Block]:
    """Yield the frames sorted as :class:`TimeOrder` does."""
    order = TimeOrder(delay, patient=patient, lateness=lateness)
    for block in blocks:
        ready = order.push(block)
        del block  # else it lies in memory until the next one is made
        while ready:
            yield ready.pop(0)
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
    lateness : measures how long every message waits, in place of ``delay``.
    """

    def __init__(
        self, delay: float = 0.0, *, patient: bool = False, lateness: Lateness | None = None
    ) -> None:
        self._lateness = lateness
        self._held = HeldFrames()
        self._waiting = np.empty((0, 3), np.int64)
        """Stamp, camera and number of each message that is held, in order."""
        self._cameras = CameraNumbers()
        self._latest_of = np.empty(0, np.int64)
        """Latest stamp of each camera, ns."""
        self._ranks = np.empty(0, np.int64)
        """Of each camera, by its name."""
        patience = round(delay * 1e9)
        # The delay is how late the latest message was.
        usual = patience if patient else min(patience, _USUAL_DELAY)
        self._times = np.array([0, 0, 0, usual, patience])

    def push(self, block: Block) -> list[Block]:
        """Take messages; return those that leave now, with their log times."""
        cameras, first = self._cameras.of(block), self._held.add(block)
        if new := len(self._cameras) - len(self._latest_of):
            self._latest_of = np.concatenate([self._latest_of, np.zeros(new, np.int64)])
            self._ranks = np.argsort(np.argsort(list(self._cameras)))
        queue = np.concatenate([self._waiting, np.empty((len(block), 3), np.int64)])
        leaving = np.empty((len(queue), 2), np.int64)
        messages = np.stack([block.stamps, cameras, block.log_times, self._waits(block)], axis=1)
        n = sort_messages(
            messages, first, self._ranks, self._latest_of, self._times, queue, leaving
        )
        self._waiting = queue[: len(queue) - n].copy()
        numbers, log_times = leaving[:n].T.copy()
        # What waited goes on together with what came: later stages cost a call per block.
        ready = [self._held.take(numbers).logged_at(log_times)] if n else []
        self._held.keep(self._waiting[:, 2])
        return ready

    def _waits(self, block: Block) -> Stamps:
        """(N,) How long messages wait from each on, ns, as measured; -1 = as before."""
        if self._lateness is None:
            return np.full(len(block), -1)
        return np.array([self._lateness.take(*message) for message in block.messages()])

    def rest(self) -> Iterator[Block]:
        """Yield what is left, now that nothing more comes."""
        if n := len(self._waiting):
            yield self._held.take(self._waiting[:, 2]).logged_at([int(self._times[_NOW])] * n)


@kernel
def _is_complete(
    stamp: int, rank: int, camera: int, ranks: Stamps, latest_of: Stamps, times: Stamps
) -> bool:
    """Whether every camera has sent what is before a time and a rank; ``camera`` sent the last."""
    oldest = times[_LATEST] - times[_PATIENCE]
    if times[_BEGIN] >= oldest:  # there may be cameras that have not sent anything yet
        return bool(stamp < oldest or (stamp == oldest and rank <= ranks[camera]))
    if stamp >= times[_LATEST]:
        return False
    for k in range(len(latest_of)):
        if latest_of[k] > oldest and (
            latest_of[k] < stamp or (latest_of[k] == stamp and ranks[k] < rank)
        ):
            return False
    return True


@kernel
def _move(queue: Stamps, source: int, target: int) -> None:
    """Copy a row of the queue (n, 3)."""
    for c in range(3):
        queue[target, c] = queue[source, c]


@entry
def sort_messages(
    messages: I2, first: int, ranks: I1, latest_of: I1, times: I1, queue: I2, leaving: I2
) -> int:
    """Take messages one after the other; find out which leave.

    Parameters
    ----------
    messages : (N, 4) stamp, ns, camera, log time and wait, ns. ``first`` is the number of the first
        one. A wait of -1 leaves that in ``times``.
    ranks : (C,) which of two cameras comes first if the stamps are equal.
    latest_of, times : of each camera, and of all; they go on.
    queue : (W + N, 3) W messages that wait, in order, and room for the others; afterwards, those
        that wait are in front.
    leaving : (W + N, 2) gets numbers and log times.

    Returns
    -------
    How many leave.
    """
    begin, end, n = 0, len(queue) - len(messages), 0
    for i in range(len(messages)):
        stamp, camera, log_time = messages[i, 0], messages[i, 1], messages[i, 2]
        times[_LATEST], times[_NOW] = max(times[_LATEST], stamp), max(times[_NOW], log_time)
        times[_BEGIN] = times[_BEGIN] or stamp
        if messages[i, 3] >= 0:
            times[_PATIENCE] = times[_DELAY] = messages[i, 3]
        late = min(times[_LATEST] - stamp, times[_PATIENCE])
        times[_DELAY] = max(times[_DELAY], late)
        latest_of[camera] = max(latest_of[camera], stamp)
        k = end
        while k > begin and (
            queue[k - 1, 0] > stamp
            or (queue[k - 1, 0] == stamp and ranks[queue[k - 1, 1]] > ranks[camera])
        ):
            _move(queue, k - 1, k)
            k -= 1
        queue[k, 0], queue[k, 1], queue[k, 2] = stamp, camera, first + i
        end += 1
        oldest, recent = times[_LATEST] - times[_PATIENCE], times[_LATEST] - times[_DELAY]
        while begin < end:
            due, rank = queue[begin, 0], ranks[queue[begin, 1]]
            if due > oldest and (
                due > recent or not _is_complete(due, rank, camera, ranks, latest_of, times)
            ):
                break
            leaving[n, 0], leaving[n, 1] = queue[begin, 2], times[_NOW]
            n, begin = n + 1, begin + 1
    for k in range(begin, end):
        _move(queue, k, k - begin)
    return n


@dataclass(slots=True)
class _Camera:
    """The latest messages of a camera."""

    late: deque[tuple[int, int]] = field(default_factory=deque)
    """Log time and lateness of each, ns."""
    count: int = 0
    usual: int = 0
    """ns by which nearly all messages are late at most."""
    period: float = _TOLERATED
    """ns from one message to the next; long until it is known."""

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
