"""How long messages have to wait for others that are late, as measured.

A message is late by the time between its stamp and the newest stamp that came before it. Nearly all
messages of a camera, SHARE, are in time if the others wait as long as these were late in the last
seconds. Who waits for all of them waits for a single one that hangs in the network.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

SHARE = 97.0  # %
_MEMORY = 10_000_000_000  # ns
_EVERY = 10  # messages of a camera after which its lateness is found again
_TOLERATED = 40_000_000
"""ns: a camera's messages come every 33 ms, and the stages gather those of one moment. Nobody waits
for what is late by no more."""


@dataclass(slots=True)
class _Camera:
    """The latest messages of a camera."""

    late: deque[tuple[int, int]] = field(default_factory=deque)
    """Log time and lateness of each, ns."""
    count: int = 0
    usual: int = 0
    """ns by which nearly all messages are late at most."""

    def add(self, log_time: int, late: int) -> bool:
        """Remember a message; return whether the lateness was found again."""
        self.late.append((log_time, late))
        while log_time - self.late[0][0] > _MEMORY:
            self.late.popleft()
        self.count += 1
        if self.count % _EVERY:
            return False
        usual = np.percentile([some for _, some in self.late], SHARE, method="higher")
        self.usual = int(usual) if usual > _TOLERATED else 0
        return True


class Lateness:
    """Measures how late the messages of the cameras are, in the order in which they come.

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
        camera = self._cameras.setdefault(source, _Camera())
        if not camera.add(log_time, self._latest - stamp):
            return self.wait
        if camera.usual > self._limit:
            most = max(self.needed.get(source, 0.0), camera.usual * 1e-9)
            self.needed[source] = most
        heard = [c.usual for c in self._cameras.values() if log_time - c.late[-1][0] <= _MEMORY]
        self.wait = max(min(max(heard), self._limit), self._least)
        return self.wait
