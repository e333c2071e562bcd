"""Holding messages back until what they say is decided."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class Delay(Generic[T]):
    """A queue whose items leave in order, each when it is decided or has waited long enough.

    Parameters
    ----------
    seconds : how long an item that stays undecided is held, in time of the data.
    """

    def __init__(self, seconds: float) -> None:
        self._patience = round(seconds * 1e9)
        self._held: deque[tuple[int, T]] = deque()

    def __len__(self) -> int:
        """Items that are held."""
        return len(self._held)

    def push(self, stamp: int, item: T) -> None:
        """Hold an item of that time, ns."""
        self._held.append((stamp, item))

    def release(self, now: int, decided: Callable[[T], bool]) -> Iterator[T]:
        """Yield, oldest first, what need not be held any more at ``now``, ns."""
        while self._held:
            stamp, item = self._held[0]
            if now - stamp < self._patience and not decided(item):
                return
            self._held.popleft()
            yield item

    def rest(self) -> Iterator[T]:
        """Yield everything that is still held."""
        while self._held:
            yield self._held.popleft()[1]
