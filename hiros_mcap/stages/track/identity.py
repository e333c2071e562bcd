"""Who is who: a confirmed track gets a new id, or the old one of somebody who comes back."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.skeletons import SECOND, UNTRACKED, Floats, Ints
from hiros_mcap.stages.track.reidentify import (
    OVERLAP,
    LimbScatter,
    PersonCues,
    Verdict,
    reidentify,
)
from hiros_mcap.stages.track.track_params import TrackParams
from hiros_mcap.stages.track.tracked_people import (
    DetectionGroup,
    PersonTrack,
    Present,
    TrackedPeople,
)

_PAUSE, _LONGEST_PAUSE = 1_000_000_000, 60_000_000_000  # ns: all cameras are silent for this long
_AT_ONCE = 200_000_000  # ns from the first camera's last message to the last one's before a pause
_STANDS = 0.3  # m from the place of a second or two before
WAITS = 8  # times the look-ahead: so long the decision on a doubtful newcomer may take
_PATIENCE = 0.8  # share of the look-ahead for which the evidence of a newcomer is gathered


class Identities:
    """Gives ids, and remembers who left.

    Parameters
    ----------
    mirror : (L,) the link on the other side of each whose length is learned.
    """

    def __init__(
        self, people: TrackedPeople, params: TrackParams, events: Events, mirror: Ints
    ) -> None:
        self._people, self._params, self._events = people, params, events
        self._limbs = LimbScatter(mirror)
        self._ids = itertools.count()
        self._absent: list[PersonCues] = []
        self._heard: dict[str, int] = {}  # camera to the time of its latest message, ns
        self._last = self._looked = 0
        """Time of the last message, and of the last look at everybody's limbs, ns."""
        self._pauses: list[tuple[int, int]] = []  # when all cameras were silent: from, to, ns
        self._places: dict[int, tuple[Floats, Floats]] = {}
        """Number of a track to where it was at the last look but one, and at the last, m."""
        self._patience = round(_PATIENCE * params.lookahead * 1e9)

    def name(
        self, track: PersonTrack, group: DetectionGroup, scene: Present, *, at_once: bool = False
    ) -> None:
        """Confirm a track: give it an old or a new id, once enough is known of the person.

        ``at_once`` : no more will be known, since the person has left.
        """
        kind, remark = "track born", ""
        age = math.inf if at_once else group.stamp - track.first
        if track.former_id == UNTRACKED and age < self._patience and self._somebody_goes(track):
            return
        if track.former_id == UNTRACKED and self._somebody_absent(track):
            if age < self._patience:
                return
            verdict = self._reidentify(track, scene)
            # Seen from one camera far away, limbs tell little; a moment later they may.
            track.doubtful = not verdict.is_sure and age < WAITS * self._patience
            if track.doubtful:
                return
            if verdict.accepted:
                kind, remark = "person re-identified", f"; by {verdict}"
                self._join(track, verdict.person, scene)
                track.former_id = verdict.person
                for person in scene.persons:
                    person.may_be.pop(verdict.person, None)
            else:
                track.may_be, remark = dict(verdict.chances), f"; not re-identified ({verdict})"
        track.doubtful = False
        track.id = next(self._ids) if track.former_id == UNTRACKED else track.former_id
        scene.persons.append(track)
        self._events.note(
            track.seen if at_once else group.stamp, kind, person=track.id, source=group.source,
            detail=f"seen by {', '.join(sorted(track.reports))}{remark}",
        )  # fmt: skip

    def leave(self, track: PersonTrack) -> None:
        """Remember a person who was not seen for t_m."""
        self._absent.append(self._cues_of(track))

    def _cues_of(self, track: PersonTrack) -> PersonCues:
        past, row = self._people.bank.past, track.row
        lengths, counts = past.lengths[row].copy(), past.length_counts[row].copy()
        place = self._people.centre(track)
        before, _ = self._places.get(track.number, (np.full(3, np.inf), place))
        stood = bool(np.linalg.norm(place - before) <= _STANDS)
        seconds = track.seen_before + (track.seen - track.first) * 1e-9
        return PersonCues(
            track.id, track.seen, place, lengths, counts, seconds, stood, track=track.number,
            may_be=track.may_be,
        )  # fmt: skip

    def advance(self, stamp: int) -> None:
        """Come to the time, ns, of a message: learn, forget."""
        if self._params.reidentify and stamp - self._looked >= SECOND:
            self._looked = stamp
            self._look()
        longest = round(self._params.reidentify * 1e9) + self._patience
        if self._absent and stamp - self._absent[0].stamp > longest:
            oldest = stamp - longest - _LONGEST_PAUSE
            self._absent = [
                old for old in self._absent if self._watched(old.stamp, stamp) <= longest
            ]
            self._pauses = [(since, until) for since, until in self._pauses if until > oldest]

    def note_pauses(self, block: Block) -> None:
        """Note when all cameras fell silent at once, not one by one because people left."""
        stamps, sources = block.stamps.tolist(), block.sources.tolist()
        gaps = np.flatnonzero(np.diff(block.stamps, prepend=self._last or stamps[0]) > _PAUSE)
        begin = 0
        for end in [*gaps.tolist(), len(stamps)]:
            for k in range(begin, end):
                self._heard[block.names[sources[k]]] = stamps[k]
            last = max(self._heard.values(), default=0)
            silent = [last - heard for heard in self._heard.values()]
            if end < len(stamps) and all(
                silence < _AT_ONCE for silence in silent if silence < _PAUSE
            ):
                self._pauses.append((last, stamps[end]))
            begin = end
        self._last = stamps[-1]

    def _watched(self, begin: int, end: int) -> int:
        """Return the time, ns, within two times in which cameras did not pause."""
        paused = (min(end, until) - max(begin, since) for since, until in self._pauses)
        return end - begin - sum(pause for pause in paused if 0 < pause < _LONGEST_PAUSE)

    def _look(self) -> None:
        """Learn how much everybody's measured limbs vary, and where everybody is."""
        past, scatter, places = self._people.bank.past, self._limbs, self._places
        for track in [track for track in self._people.tracks if track.confirmed or track.doubtful]:
            scatter.learn(track.number, past.lengths[track.row], past.length_counts[track.row])
            if track.is_there(self._looked):
                place = self._people.centre(track)
                places[track.number] = places.get(track.number, (place, place))[1], place
        scatter.keep(self._people.bank.rows)
        self._places = {n: places[n] for n in places if n in self._people.bank.rows}

    def _latest(self, number: int, track: PersonTrack) -> int:
        """Return when a person, by the number of the track, was last seen, who may be a track, ns.

        If cameras disagree for a moment, the old track may still be seen after the new one began.
        No camera then shows both.
        """
        disagree = self._params.merge_tracks and number not in track.beside
        return track.first + (OVERLAP if disagree else 0)

    def _is_unseen_since(self, person: PersonTrack, track: PersonTrack) -> bool:
        """Whether a person was last seen before a track began, and not for a while."""
        return person.seen < self._latest(person.number, track) and not person.is_there(track.seen)

    def _somebody_goes(self, track: PersonTrack) -> bool:
        """Whether a person may be the newcomer, and is unseen in a moment: then it is absent.

        The detector showed the person elsewhere.
        """
        return self._params.reidentify > 0 and any(
            person.confirmed
            and person.seen < min(self._latest(person.number, track), track.seen)
            and person.is_there(track.seen)
            and person.number not in track.beside
            for person in self._people.tracks
        )

    def _somebody_absent(self, track: PersonTrack) -> bool:
        """Whether a newcomer may be anybody known."""
        if not self._params.reidentify:
            return False
        return any(old.stamp < self._latest(old.track, track) for old in self._absent) or any(
            person.confirmed and self._is_unseen_since(person, track)
            for person in self._people.tracks
        )

    def _absent_before(self, track: PersonTrack, scene: Present) -> list[PersonCues]:
        """Whoever left, or is unseen, since before a track began, oldest first."""
        left = [old for old in self._absent if old.stamp < self._latest(old.track, track)]
        unseen = [person for person in scene.persons if self._is_unseen_since(person, track)]
        return sorted([*left, *map(self._cues_of, unseen)], key=lambda old: old.stamp)

    def _reidentify(self, track: PersonTrack, scene: Present) -> Verdict:
        """Weigh whether a newcomer is one of the absent people, with all other newcomers.

        People who got a new id earlier are still newcomers: an absent person whom one of them fits
        best is less probably this one.
        """
        tentative = [rival for rival in self._people.tentative() if rival is not track]
        persons = [person for person in scene.persons if person is not track]
        rivals = [rival for rival in tentative if self._people.may_count(rival, self._params)]
        rivals += [person for person in persons if person.may_be]
        newcomers = [
            replace(self._cues_of(new), person=new.number, stamp=new.first, place=new.origin)
            for new in [track, *rivals]
        ]
        absent = [
            replace(old, watched=self._watched(old.stamp, track.first) * 1e-9)
            for old in self._absent_before(track, scene)
        ]
        # Whoever is there, and may be one of them, is one of them less to come.
        there = [person.may_be for person in persons if person.is_there(track.seen)]
        missing = len(absent) - sum(
            may_be.get(old.person, 0.0) for may_be in there for old in absent
        )
        return reidentify(newcomers, absent, missing, self._limbs)[track.number]

    def _join(self, track: PersonTrack, person: int, scene: Present) -> None:
        """Let a track go on with what is known of an absent person's limbs; forget the latter."""
        past, row = self._people.bank.past, track.row
        (old,) = [old for old in self._absent_before(track, scene) if old.person == person]
        counts = old.counts + past.length_counts[row]
        total = old.counts * old.lengths + past.length_counts[row] * past.lengths[row]
        past.lengths[row] = total / np.maximum(counts, 1.0)
        past.length_counts[row] = counts
        track.seen_before = old.seconds
        self._absent = [left for left in self._absent if left.person != person]
        for former in [former for former in scene.persons if former.id == person]:
            scene.persons.remove(former)
            self._people.remove(former)
