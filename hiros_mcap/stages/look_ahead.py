"""Frames that wait until what comes after them is known: how every stage looks ahead."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np

from hiros_mcap.frames import Block, join
from hiros_mcap.skeletons import Stamps


class LookAhead:
    """Frames that wait, in the order in which they came.

    Parameters
    ----------
    seconds : how far a stage looks ahead, s in time of the data; a stage that decides by something
        else does not need it.

    Attributes
    ----------
    stamps : (N,) times of the frames that wait, ns.
    first : number of the oldest of them, counted through all frames.
    """

    def __init__(self, seconds: float = 0.0) -> None:
        self._ahead = round(seconds * 1e9)
        self._blocks: deque[Block] = deque()
        self.stamps: Stamps = np.empty(0, np.int64)
        self.first = 0

    def __len__(self) -> int:
        """N."""
        return len(self.stamps)

    def add(self, block: Block) -> Stamps:
        """Let the frames of a block wait, too.

        Returns which frame of the block completes the look-ahead of each of the oldest that wait,
        (K,); a frame's own look-ahead is not complete before it comes.
        """
        n = len(self.stamps)
        if len(block):
            self._blocks.append(block)
            self.stamps = np.concatenate([self.stamps, block.stamps])
        completing = np.searchsorted(block.stamps, self.stamps + self._ahead)
        completing[n:] = np.maximum(completing[n:], np.arange(len(block)))
        completing = np.maximum.accumulate(completing)
        return completing[: np.searchsorted(completing, len(block))]

    def windows(self, block: Block) -> Iterator[Block]:
        """Let the frames of a block wait, too; release windows that end with the look-ahead.

        A window begins behind the one before it, and ends with the first frame that is ``seconds``
        after its first one.
        """
        self.add(block)
        while len(self):
            last = int(np.searchsorted(self.stamps, self.stamps[0] + self._ahead))
            if last == len(self):
                return
            yield self.release(last + 1)

    def release(self, n: int, width: int = 0, *, shared: bool = False) -> Block:
        """Return copies of the oldest ``n`` frames, which do not wait any more; at least one.

        ``width`` : columns that markers and links get at least. ``shared`` : frames that lie in one
        block share its arrays.
        """
        self.stamps, self.first, parts = self.stamps[n:], self.first + n, list[Block]()
        while n > 0:
            block = self._blocks.popleft()
            if len(block) > n:
                self._blocks.appendleft(block.select(slice(n, None)))
                block = block.select(slice(n))
            parts.append(block)
            n -= len(block)
        return parts[0] if shared and len(parts) == 1 else join(parts, widths=(width, width))
