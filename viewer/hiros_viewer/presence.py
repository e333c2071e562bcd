"""When people are shown: rows for the frames that they are in, and an empty one after each visit.

A viewer shows the newest row of an entity, so somebody who left has to be hidden.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hiros_mcap.skeletons import UNTRACKED, Flags, Stamps
from hiros_viewer.columns import GONE_NS, after_pauses
from hiros_viewer.poses import Poses

HIDDEN = -1


class Visit(NamedTuple):
    """Rows of one person."""

    person: int
    times: Stamps
    """(R, 2) stamp and log time, ns."""
    people: Stamps
    """(R,) which of the poses is shown, or HIDDEN."""
    begins: Flags
    """(R,) where somebody is shown who was not before."""


@dataclass(slots=True)
class Visits:
    """Who of a stage is shown.

    Parameters
    ----------
    patience : ns; somebody whom frames lack for this long is hidden.
    """

    patience: int
    last: Stamps | None = None
    """(2,) times of the newest frame."""
    shown: dict[int, Stamps] = field(default_factory=dict)
    """Whoever is not hidden -> (2,) times of their newest row."""

    def of(self, poses: Poses) -> Iterator[Visit]:
        """Yield the rows of everybody with an id, in the order of ids.

        Somebody is hidden at the first frame that lacks them for long enough, and all are hidden
        soon after the last frame before a pause: nobody knows where they are.
        """
        pauses = after_pauses(poses.times, self.last)
        self.last = poses.times[-1]
        frames = poses.frames
        order = np.argsort(poses.ids, kind="stable")
        ids, starts = np.unique(poses.ids[order], return_index=True)
        ends = np.append(starts, len(order))[1:]
        of_person = {i: order[a:b] for i, a, b in zip(ids.tolist(), starts, ends, strict=True)}
        nobody = np.zeros(0, np.int64)
        for person in sorted({*of_person, *self.shown} - {UNTRACKED}):
            people = of_person.get(person, nobody)
            visit = self._visit(person, poses.times, (frames[people], people), pauses)
            if len(visit.times):
                yield visit

    def _visit(
        self, person: int, times: Stamps, seen: tuple[Stamps, Stamps], pauses: tuple[Stamps, Stamps]
    ) -> Visit:
        """Return the rows of one person, who is in the frames ``seen`` with these poses."""
        frames, people = seen
        stamps = times[frames]
        earlier = self.shown.pop(person, None)
        if earlier is not None:  # as if shown in a frame before the first
            frames, people = np.insert(frames, 0, -1), np.insert(people, 0, 0)
            stamps = np.insert(stamps, 0, earlier, axis=0)
        n = len(times)
        following = np.append(frames[1:], n)
        lacking = np.searchsorted(times[:, 0], stamps[:, 0] + self.patience)
        lacking = np.maximum(lacking, frames + 1)
        pause = np.searchsorted(pauses[0], frames, side="right")
        paused = np.append(pauses[0], n + 1)[pause]
        at_pause = paused <= np.minimum(following, lacking)
        hidden = at_pause | (lacking < following)
        when = times[np.minimum(lacking, n - 1)]
        when[at_pause] = pauses[1][pause[at_pause]] + GONE_NS
        if not hidden[-1]:
            self.shown[person] = stamps[-1]
        after = np.flatnonzero(hidden) + 1
        people = np.insert(people, after, HIDDEN)
        begins = (people != HIDDEN) & (np.append(HIDDEN, people[:-1]) == HIDDEN)
        new = slice(earlier is not None, None)
        rows = np.insert(stamps, after, when[hidden], axis=0)
        return Visit(person, rows[new], people[new], begins[new])

    def finish(self) -> Iterator[Visit]:
        """Hide everybody soon after the last frame."""
        for person, last in sorted(self.shown.items()):
            yield Visit(person, last[None] + GONE_NS, np.array([HIDDEN]), np.array([False]))
        self.shown.clear()


@dataclass(slots=True)
class Crowd:
    """Whether anybody is shown of an entity for everybody whom a camera sees."""

    _last: Stamps | None = None
    """(2,) times of the newest row."""
    _shown: bool = False

    def rows(self, poses: Poses) -> tuple[Stamps, Stamps]:
        """Return times (R, 2) and counts (R,) of rows: one per frame, one of nobody in a pause."""
        shown = np.append(self._shown, poses.counts > 0)
        places, before = after_pauses(poses.times, self._last)
        hides = shown[places]
        self._last, self._shown = poses.times[-1], bool(shown[-1])
        times = np.insert(poses.times, places[hides], before[hides] + GONE_NS, axis=0)
        return times, np.insert(poses.counts, places[hides], 0)

    def changes(self, poses: Poses) -> Flags:
        """(N,) whether a frame shows anybody, or is the first that hides them."""
        shown = poses.counts > 0
        return np.asarray(shown | np.append(self._shown, shown[:-1]))

    def finish(self) -> Stamps:
        """Return the time (1, 2) at which whoever is shown is hidden; (0, 2) if nobody is."""
        if self._last is None or not self._shown:
            return np.zeros((0, 2), np.int64)
        self._shown = False
        return self._last[None] + GONE_NS
