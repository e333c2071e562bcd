"""Who goes on without being seen: people whom a camera skips, and people whom others hide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hiros_mcap.frames import Block
from hiros_mcap.kernels.distance import centre
from hiros_mcap.skeletons import UNTRACKED, Flags, Floats, People, Stamps
from hiros_mcap.stages.track.coverage import Coverage
from hiros_mcap.stages.track.reidentify import is_near

_RECENT = 1_000_000_000  # ns: a camera that was silent for longer did not see the person anyway


class Unseen:
    """Says who goes on at an instant that does not show them.

    Everybody does for ``bridge`` s. Up to ``carry`` s, those do who are hidden: somebody else
    stands in front of every camera that reported them in the last second and looks at the place
    where they were seen last. Whom such a camera should see is gone until seen again. A camera that
    showed a person distorted need not see him; ``carry`` then begins anew. Whoever comes meanwhile
    to where the person may have gone is probably the person, with a new id: nobody goes on beside.

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
        self._shown: Block  # the messages, of which ``_done`` are noted; see :meth:`show`
        self._came: dict[int, int] = {}  # person to the time of the first view, ns
        self._hidden: dict[int, tuple[int, str]] = {}
        """Person to the time, ns, and camera of the latest view left out as distorted since."""

    def show(self, messages: Block, stamps: Stamps, distorted: Flags) -> None:
        """Take messages, each at the time (N,), ns, of its instant, whose people go on from there.

        ``distorted`` : (P,) by row of the people: whether a view is left out.
        """
        self._shown, self._stamps, self._distorted, self._done = messages, stamps, distorted, 0

    def go_on(
        self, stamp: int, n_messages: int, people: Sequence[int], last_seen: Mapping[int, int]
    ) -> tuple[set[int], set[int]]:
        """Return who is bridged and who is carried at ``stamp``, ns, besides the ``people`` shown.

        ``n_messages`` are up to then. ``last_seen`` : person -> ns, as remembered before.
        """
        bridged, carried = set[int](), set[int]()
        absent = self._places or self._gone or self._hidden or self._distorted.any()
        left = self._views.keys() - last_seen.keys()
        present = set(people)
        if not absent and not left and last_seen.keys() <= present:
            return bridged, carried
        self._see(n_messages)
        for person, last in last_seen.items():
            if person in present or stamp < last:
                continue
            if stamp - last <= self._bridge:
                bridged.add(person)
            elif self._is_carried(person, stamp, last, present):
                carried.add(person)
        self._tidy(present, last_seen)
        return bridged, carried

    def see_all(self) -> None:
        """Note whom the rest of the messages show."""
        self._see(len(self._shown))

    def _see(self, end: int) -> None:
        """Note whom the messages before ``end`` show, and what their cameras look at."""
        begin, self._done = self._done, end
        if not self._sources or begin == end:
            return
        block, stamps = self._shown.select(slice(begin, end)), self._stamps[begin:end]
        rows, owners = block.everybody()
        tracked = block.people.ids[rows] != UNTRACKED
        rows, owners = rows[tracked], owners[tracked]
        people, whole = block.people.ids[rows], ~self._distorted[rows]
        self._learn(block, stamps, rows[whole], owners[whole])
        latest = dict(zip(people[whole].tolist(), rows[whole].tolist(), strict=True))
        self._views.update({person: (block.people, row) for person, row in latest.items()})
        views = zip(people.tolist(), block.sources[owners].tolist(), strict=True)
        for (person, code), stamp in dict(zip(views, stamps[owners].tolist(), strict=True)).items():
            self._reported.setdefault(person, {})[block.names[code]] = stamp
            self._came.setdefault(person, stamp)
        for k in np.flatnonzero(~whole).tolist():
            self._hidden[int(people[k])] = int(stamps[owners[k]]), block.source(owners[k])

    def _learn(self, block: Block, stamps: Stamps, rows: Stamps, owners: Stamps) -> None:
        """Learn what cameras look at from the people in ``rows``, each of one message."""
        ends = np.searchsorted(owners, np.arange(len(block) + 1)).tolist()
        for i, (_, source, _) in enumerate(block.messages()):
            if stamps[i] >= self._coverage.due(source):
                centres = [
                    _centre(block.people, row) for row in rows[ends[i] : ends[i + 1]].tolist()
                ]
                self._coverage.learn(source, centres, int(stamps[i]))

    def _is_carried(self, person: int, stamp: int, last: int, present: set[int]) -> bool:
        """Whether a person who was seen at ``last``, ns, is hidden, and not for long."""
        hidden, _ = self._hidden.get(person, (-1, ""))
        if hidden == stamp:
            return True
        return stamp - max(last, hidden) < self._carry and self._is_hidden(person, present)

    def _is_hidden(self, person: int, present: set[int]) -> bool:
        """Whether others hide a person from every camera that looks at the place."""
        if person in self._gone or person not in self._views:
            return False
        if person not in self._places:
            self._places[person] = _centre(*self._views[person])
        place = self._places[person]
        if self._has_come_back(person, place, present):
            self._gone.add(person)
            return False
        bystanders = [_centre(*self._views[k]) for k in present if k in self._views]
        reported = self._reported[person]
        recent = [s for s, t in reported.items() if max(reported.values()) - t < _RECENT]
        _, hiding = self._hidden.get(person, (0, ""))
        looking = [s for s in recent if s == hiding or self._coverage.covers(s, place)]
        sees = (self._coverage.sees(s, place, bystanders) for s in looking if s != hiding)
        if not looking or any(sees):
            self._gone.add(person)
            return False
        return True

    def _has_come_back(self, person: int, place: Floats, present: set[int]) -> bool:
        """Whether somebody came, after a person was seen last, who may be the person."""
        last = max(self._reported[person].values())
        for other in present & self._views.keys():
            seconds = (self._came[other] - last) * 1e-9
            way = float(np.hypot(*(_centre(*self._views[other]) - place)[:2]))
            if seconds > 0 and is_near(way, seconds):
                return True
        return False

    def _tidy(self, present: set[int], last_seen: Mapping[int, int]) -> None:
        """Forget the absences that are over, and people whom nobody remembers."""
        self._gone -= present
        for person in self._hidden.keys() & (present | (self._hidden.keys() - last_seen.keys())):
            del self._hidden[person]
        for person in present & self._places.keys():
            del self._places[person]
        for person in self._views.keys() - last_seen.keys() - present:
            del self._views[person], self._reported[person], self._came[person]
            self._places.pop(person, None)
            self._gone.discard(person)


def _centre(people: People, row: int) -> Floats:
    """Mean marker position (3,) of a person, m; NaN if no marker was seen."""
    place = np.empty(3)
    centre(people.markers[row], place)
    return place
