"""The memory of a stage: a row per person, in arrays that kernels take."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import numpy as np

from hiros_mcap.skeletons import UNTRACKED, Ints, Stamps

P = TypeVar("P", bound=tuple[Any, ...])


class Bank(Generic[P]):
    """The memory of a stage: a tuple of arrays, named or not, with a row per person.

    Kernels take ``past`` and rows. Rows are reused, and more are made when none is left; whoever
    was not seen for a while is forgotten.

    Parameters
    ----------
    empty : the arrays with no rows.
    forget_after : s without a sighting after which :meth:`expire` forgets a person.
    """

    def __init__(self, empty: P, forget_after: float = 10.0) -> None:
        self.past = empty
        self.rows: dict[int, int] = {}  # person to row
        self.last_seen: dict[int, int] = {}  # person to the latest time of a sighting, ns
        self._patience = round(forget_after * 1e9)
        self._free: list[int] = []

    def row(self, person: int, stamp: int) -> int:
        """Row of a person who is seen at ``stamp``, ns; a new person's holds zeros."""
        if person not in self.rows:
            if not self._free:
                self._add_rows()
            self.rows[person] = self._free.pop()
            for array in self.past:
                array[self.rows[person]] = 0
        self.last_seen[person] = max(stamp, self.last_seen.get(person, stamp))
        return self.rows[person]

    def rows_of(self, people: Ints, stamps: Stamps) -> Stamps:
        """(P,) Rows of people who are seen at these times, ns, in order; -1 where UNTRACKED.

        Somebody who comes back after having been forgotten starts anew.
        """
        rows = np.full(len(people), -1, np.int64)
        for person in np.unique(people[people != UNTRACKED]).tolist():
            theirs = np.flatnonzero(people == person)
            times = stamps[theirs]
            before, last = self.last_seen.get(person, times[0]), int(times.max())
            if last - before > self._patience < np.diff(times, prepend=before).max():
                self.forget(person)
            rows[theirs] = self.row(person, last)
        if len(stamps):
            self.expire(int(stamps.max()))
        return rows

    def expire(self, now: int) -> list[int]:
        """Forget those who were not seen for long enough at ``now``, ns; return who they were."""
        gone = [p for p, stamp in self.last_seen.items() if now - stamp > self._patience]
        for person in gone:
            self.forget(person)
        return gone

    def forget(self, person: int) -> None:
        """Free the row of a person, if there is one."""
        if person in self.rows:
            self._free.append(self.rows.pop(person))
            del self.last_seen[person]

    def _add_rows(self) -> None:
        old = len(self.past[0])
        size = max(2, 2 * old)
        grown = []
        for array in self.past:
            grown.append(np.zeros((size, *array.shape[1:]), array.dtype))
            grown[-1][:old] = array
        kind = type(self.past)
        self.past = kind(*grown) if hasattr(kind, "_fields") else kind(grown)
        self._free += range(size - 1, old - 1, -1)
