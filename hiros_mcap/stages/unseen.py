"""Who goes on without being seen: people whom a camera skips, and people whom others hide."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from hiros_mcap.skeletons import POSITION, UNTRACKED, Floats, People
from hiros_mcap.stages.coverage import Coverage

_RECENT = 1_000_000_000  # ns: a camera that was silent for longer did not see the person anyway


class Unseen:
    """Says who goes on at an instant that does not show them.

    Everybody does for ``bridge`` s. Up to ``carry`` s, those do who are hidden: somebody else
    stands in front of every camera that reported them in the last second and looks at the place
    where they were seen last. Whom such a camera should see is gone until seen again. A camera that
    showed a person distorted (:meth:`hide`) need not see him; ``carry`` then begins anew.

    Parameters
    ----------
    bridge, carry : s; 0 = off.
    cameras : source -> (3,) position in the fixed frame, m. Without it nobody is carried.
    """

    def __init__(
        self, bridge: float = 0.0, carry: float = 0.0, cameras: Mapping[str, Floats] | None = None
    ) -> None:
        self._bridge = bridge * 1e9 or -1.0
        self._carry = carry * 1e9
        self._sources = dict(cameras or {}) if carry > 0 else {}
        self._coverage = Coverage(self._sources)
        self._views: dict[int, tuple[People, int]] = {}
        """Person to the latest view: some people and a row of them."""
        self._reported: dict[int, dict[str, int]] = {}
        """Person to the cameras, and when each reported the person last, ns."""
        self._places: dict[int, Floats] = {}
        """Person who is not seen to the place of the latest view, (3,) m."""
        self._gone: set[int] = set()
        self._hidden: dict[int, tuple[int, str]] = {}
        """Person to the time, ns, and camera of the latest view left out as distorted since."""

    def see(self, stamp: int, source: str, people: People, rows: range) -> None:
        """Note that a camera's message of ``stamp``, ns, shows the people in ``rows``."""
        if not self._sources:
            return
        due = self._coverage.is_due(source, stamp)
        for row, person in enumerate(people.ids[rows.start : rows.stop].tolist(), rows.start):
            if person == UNTRACKED:
                continue
            self._views[person] = people, row
            self._reported.setdefault(person, {})[source] = stamp
            if due:
                self._coverage.learn(source, _centre(people, row), stamp)

    def hide(self, stamp: int, source: str, people: Iterable[int]) -> None:
        """Note that a camera's views of people at ``stamp``, ns, were left out as distorted."""
        if not self._sources:
            return
        for person in people:
            self._hidden[person] = stamp, source
            self._reported.setdefault(person, {})[source] = stamp

    def go_on(
        self, stamp: int, seen: Iterable[int], last_seen: Mapping[int, int]
    ) -> tuple[set[int], set[int]]:
        """Return who is bridged and who is carried at ``stamp``, ns; nobody of those ``seen``."""
        shown = set(seen)
        bridged, carried = set(), set()
        for person, last in last_seen.items():
            if person in shown or stamp < last:
                continue
            if stamp - last <= self._bridge:
                bridged.add(person)
            elif self._is_carried(person, stamp, last, shown):
                carried.add(person)
        if self._places or self._gone or self._hidden or len(self._views) > len(last_seen):
            self._tidy(shown, last_seen)
        return bridged, carried

    def _is_carried(self, person: int, stamp: int, last: int, shown: set[int]) -> bool:
        """Whether a person who was seen at ``last``, ns, is hidden, and not for long."""
        hidden, _ = self._hidden.get(person, (-1, ""))
        if hidden == stamp:
            return True
        return stamp - max(last, hidden) < self._carry and self._is_hidden(person, shown)

    def _is_hidden(self, person: int, shown: set[int]) -> bool:
        """Whether others hide a person from every camera that looks at the place."""
        if person in self._gone or person not in self._views:
            return False
        if person not in self._places:
            self._places[person] = _centre(*self._views[person])
        place = self._places[person]
        others = [_centre(*self._views[other]) for other in shown if other in self._views]
        reported = self._reported[person]
        recent = [s for s, t in reported.items() if max(reported.values()) - t < _RECENT]
        _, hiding = self._hidden.get(person, (0, ""))
        looking = [s for s in recent if s == hiding or self._coverage.covers(s, place)]
        sees = (self._coverage.sees(each, place, others) for each in looking if each != hiding)
        if not looking or any(sees):
            self._gone.add(person)
            return False
        return True

    def _tidy(self, shown: set[int], last_seen: Mapping[int, int]) -> None:
        """Forget the absences that are over, and people whom nobody remembers."""
        self._gone -= shown
        for person in self._hidden.keys() & (shown | (self._hidden.keys() - last_seen.keys())):
            del self._hidden[person]
        for person in shown & self._places.keys():
            del self._places[person]
        for person in self._views.keys() - last_seen.keys() - shown:
            del self._views[person], self._reported[person]
            self._places.pop(person, None)
            self._gone.discard(person)


def _centre(people: People, row: int) -> Floats:
    """Mean marker position (3,) of a person, m; NaN if no marker was seen."""
    places = people.markers[row, :, POSITION]
    known = places[~np.isnan(places[:, 0])]
    return np.asarray(known.sum(axis=0) / (len(known) or np.nan))
