"""Who counts as a person: the support of a track confirms it, or withdraws its id.

Every report of a camera supports a track. A message of another camera that looks at the place, with
nobody in between, and reports nobody there contradicts it. A track that does not even sway is
contradicted in a wider cone, which any picture shows. A second view of a person is nobody new.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.frames import CameraNumbers
from hiros_mcap.skeletons import UNTRACKED, Floats
from hiros_mcap.stages.track.coverage import PICTURE, Coverage
from hiros_mcap.stages.track.identity import Identities
from hiros_mcap.stages.track.reidentify import OVERLAP
from hiros_mcap.stages.track.track_params import TrackParams
from hiros_mcap.stages.track.tracked_people import (
    DetectionGroup,
    PersonTrack,
    Present,
    TrackedPeople,
)

_MERGEABLE = 2_400_000_000  # ns for which a track may be merged into an older one
_STATUE = 0.05  # m; a living body sways farther from its first place
_DOUBTFUL = 1.5  # gates: cameras whose views of a person differ by more are not calibrated


class Confirmation:
    """Decides message by message which tracks count.

    Parameters
    ----------
    cameras : source -> (3,) position in the fixed frame, m.
    """

    def __init__(
        self, people: TrackedPeople, identities: Identities, params: TrackParams, events: Events,
        cameras: Mapping[str, Floats],
    ) -> None:  # fmt: skip
        self._people, self._identities = people, identities
        self._params, self._events = params, events
        self._coverage = Coverage(cameras)

    def note_due(self, names: CameraNumbers) -> None:
        """Note from which time on the next message of each camera is learned from."""
        self._people.cameras.due[:] = [self._coverage.due(name) for name in names]

    def confirm(self, group: DetectionGroup) -> None:
        """Weigh what the message says about every track that is not certain yet."""
        shown = set(group.tracks)
        numbers = frozenset([track.number for track in shown if track is not None])
        scene = Present(shown, numbers, self._people.confirmed())
        certain = [track for track in self._people.tracks if track.certain]
        if group.stamp >= self._coverage.due(group.source):
            places = [self._people.centre(track) for track in certain if track in shown]
            self._coverage.learn(group.source, places, group.stamp)
            due = self._coverage.due(group.source)
            self._people.cameras.due[self._people.names[group.source]] = due
        for track in [track for track in self._people.tracks if not track.certain]:
            if track.number not in self._people.bank.rows:  # merged into another one by now
                continue
            self._add_report(track, group, scene)
            self._decide(track, group, scene)
            self._merge_into_person(track, group, scene)

    def conclude(self, track: PersonTrack, group: DetectionGroup) -> None:
        """Name a doubtful track at once: no message tells more about it."""
        scene = Present(set(), frozenset(), self._people.confirmed())
        self._identities.name(track, group, scene, at_once=True)

    def _add_report(self, track: PersonTrack, group: DetectionGroup, scene: Present) -> None:
        """Add the support, or the contradiction, of a camera's message."""
        source = group.source
        if track in scene.shown:
            track.reports[source] = track.reports.get(source, 0) + 1
            moved = float(np.linalg.norm(self._people.centre(track) - track.origin))
            track.travelled = max(track.travelled, moved)
            track.unwatched = track.misses == 0 and bool(self._people.heard_besides(group))
            if group.stamp - track.first < _MERGEABLE:
                track.beside |= scene.numbers
        elif source not in track.reports and self._ought_to_see(source, track, scene):
            track.misses += 1

    def _decide(self, track: PersonTrack, group: DetectionGroup, scene: Present) -> None:
        """Confirm a track that is still there, or withdraw its id."""
        if track.confirmed and track.is_refuted(self._params):
            self._events.note(group.stamp, "track withdrawn", person=track.id)
            track.former_id, track.id = track.id, UNTRACKED
            scene.persons.remove(track)
        elif (
            not track.confirmed
            and track.is_there(group.stamp)
            and self._people.may_count(track, self._params)
            and not self._is_duplicate(track, group.stamp, scene)
        ):
            self._identities.name(track, group, scene)

    def _is_duplicate(self, track: PersonTrack, stamp: int, scene: Present) -> bool:
        """Whether a tentative track is a second view of a person, nobody new.

        It lies on the person, or near one whom no camera has shown beside it: cameras may disagree
        for a moment.
        """
        distances = self._people.distances(track, scene.persons)
        if (distances < self._params.min_distance).any():
            return True
        if not self._params.merge_tracks or stamp - track.first >= OVERLAP:
            return False
        near = np.flatnonzero(distances < _DOUBTFUL * self._params.max_distance)
        return any(self._may_be_same(scene.persons[i], track, stamp) for i in near.tolist())

    def _may_be_same(self, person: PersonTrack, track: PersonTrack, stamp: int) -> bool:
        """Whether a person is there whom no camera has shown beside a track."""
        return person.is_there(stamp) and person.number not in track.beside

    def _merge_into_person(self, track: PersonTrack, group: DetectionGroup, scene: Present) -> None:
        """Merge a young track that is seen no more into the person who was the same all along.

        Cameras that disagreed now agree, and no camera ever showed both.
        """
        counts = track.confirmed or self._people.may_count(track, self._params)
        if not (self._params.merge_tracks and counts):
            return
        if group.stamp - track.first >= _MERGEABLE or track.is_there(group.stamp):
            return
        distances = self._people.distances(track, scene.persons)
        for person, distance in zip(scene.persons, distances, strict=True):
            is_older = person.first < track.first
            is_near = distance < _DOUBTFUL * self._params.max_distance
            if is_older and is_near and self._may_be_same(person, track, group.stamp):
                if track.confirmed:
                    scene.persons.remove(track)
                self._people.remove(track)
                detail = f"was person {track.id}" if track.confirmed else "for a moment"
                self._events.note(group.stamp, "tracks merged", person=person.id, detail=detail)
                track.id = person.id  # also in messages that are held
                return

    def _ought_to_see(self, source: str, track: PersonTrack, scene: Present) -> bool:
        centres = [self._people.centre(person) for person in scene.persons]
        widest = PICTURE if track.travelled <= _STATUE else 1.0
        return self._coverage.sees(source, self._people.centre(track), centres, widest)
