"""Messages of chunks that overlap in time, put in the order of their log times."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

Keys = npt.NDArray[np.uint64]
"""(N, 3) log time, ns; first byte of the message's chunk in the file; its first byte in the chunk.
Messages are ordered by the first, those of equal time by the others: as they are in the file."""

T = TypeVar("T")


class LogOrder(Generic[T]):
    """Puts the messages of items, such as chunks, in order as soon as nothing earlier can come."""

    def __init__(self) -> None:
        self._items: dict[int, T] = {}
        self._keys: Keys = np.empty((0, 3), np.uint64)
        self._places = np.empty((0, 2), np.int64)  # number of the item, message in it
        self._added = 0

    def add(self, item: T, keys: Keys) -> None:
        """Add an item of N messages."""
        places = np.stack([np.full(len(keys), self._added), np.arange(len(keys))], axis=1)
        self._items[self._added] = item
        self._added += 1
        self._keys = np.concatenate([self._keys, keys])
        self._places = np.concatenate([self._places, places])

    def before(self, log_time: int | None) -> Iterator[tuple[T, list[int]]]:
        """Hand out the messages before a log time, or all that are left if it is None.

        Yields runs of messages of one item: the item, and which of its messages.
        """
        times = self._keys[:, 0]
        is_all = len(times) > 0 and (log_time is None or bool(times[-1] < log_time))
        if is_all and len(self._items) == 1 and bool((times[1:] > times[:-1]).all()):
            # Nothing overlaps, or one live message comes after the other.
            (item,) = self._items.values()
            self._keys, self._places, self._items = self._keys[:0], self._places[:0], {}
            yield item, list(range(len(times)))
            return
        ready = np.full(len(times), log_time is None) if log_time is None else times < log_time
        chosen = np.flatnonzero(ready)
        order = chosen[np.lexsort(self._keys[chosen].T[::-1])]
        places, items = self._places[order], self._items
        self._keys, self._places = self._keys[~ready], self._places[~ready]
        self._items = {i: items[i] for i in np.unique(self._places[:, 0]).tolist()}
        cuts = np.flatnonzero(np.diff(places[:, 0])) + 1
        for run in np.split(places, cuts) if len(places) else ():
            yield items[int(run[0, 0])], run[:, 1].tolist()
