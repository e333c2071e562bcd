"""What a stage remembers of people, as arrays that kernels take."""

from __future__ import annotations

from typing import ClassVar

import numpy as np


class Bank:
    """Arrays with a row per person; rows are reused, and more are made when none is left.

    A subclass names its arrays in ``ARRAYS`` and makes them, with no rows.
    """

    ARRAYS: ClassVar[tuple[str, ...]]

    def __init__(self) -> None:
        self._free: list[int] = []

    def take(self) -> int:
        """Return a row for a person; it holds zeros, or what was there before."""
        if not self._free:
            self._add_rows()
        return self._free.pop()

    def give_back(self, row: int) -> None:
        """Say that a row is nobody's any more."""
        self._free.append(row)

    def _add_rows(self) -> None:
        old = len(getattr(self, self.ARRAYS[0]))
        size = max(8, 2 * old)
        for name in self.ARRAYS:
            array = getattr(self, name)
            bigger = np.zeros((size, *array.shape[1:]), array.dtype)
            bigger[:old] = array
            setattr(self, name, bigger)
        self._free += range(size - 1, old - 1, -1)
