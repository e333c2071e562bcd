"""Leaves out what a displaced camera, or a mirror, shows of people whom other cameras know.

:mod:`~hiros_mcap.stages.track.displaced` decides who is a copy; here the tracks follow.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.skeletons import POSITION, UNTRACKED, Floats, Ints
from hiros_mcap.stages.track.displaced import DisplacedCameras, LoneTracks, Others
from hiros_mcap.stages.track.identity import Identities
from hiros_mcap.stages.track.likeness import DISPLACED
from hiros_mcap.stages.track.tracked_people import DetectionGroup, PersonTrack, TrackedPeople

Places = Callable[[list[PersonTrack], DetectionGroup], Floats]
"""(N, M, 3) where tracks are at the time of a message, m."""


class Copies:
    """The tracks that are copies of other people.

    Parameters
    ----------
    places : predicts tracks. mirror : (M,) slot of the marker on the other side.
    withdraws : whether tracks of one camera are compared with people known elsewhere.
    """

    def __init__(
        self, people: TrackedPeople, identities: Identities, places: Places, mirror: Ints,
        events: Events, *, withdraws: bool,
    ) -> None:  # fmt: skip
        self._people, self._identities, self._places = people, identities, places
        self._events, self._withdraws = events, withdraws
        self.displaced = DisplacedCameras(mirror, events)

    def leave_out(self, group: DetectionGroup) -> None:
        """Leave out what a displaced camera shows of people whom other cameras see elsewhere."""
        if not group.unmatched:
            return
        others = self._others(group)
        poses = group.people.markers[..., POSITION]
        copies = self.displaced.copies(
            group.source, group.stamp, poses, self._places(others, group)
        )
        for j in group.unmatched:
            if copies[j]:
                group.reasons[j] = DISPLACED

    def withdraw(self, group: DetectionGroup) -> None:
        """Delete this camera's own tracks that are of people whom others see elsewhere."""
        heard = self._people.heard_besides(group)
        lone = [
            (j, track)
            for j, track in enumerate(group.tracks)
            if track is not None and track.is_lone(group.source)
        ]
        if not (self._withdraws and lone and heard):
            return
        rows, tracks = zip(*lone, strict=True)
        persons = self._others(group)
        others = Others(
            [person.number for person in persons],
            self._places(persons, group),
            np.array([0 if p.certain else p.support.first for p in persons], np.int64),
            np.array([person in group.tracks for person in persons], np.bool_),
        )
        poses = group.people.markers[list(rows), :, POSITION]
        numbers = [track.number for track in tracks]
        shown = LoneTracks(group.source, group.stamp, numbers, poses, others, heard)
        for number in self.displaced.compare(shown):
            for track in [each for each in self._people.tracks if each.number == number]:
                if track.is_lone(group.source):
                    self._withdraw(track, group)

    def _withdraw(self, track: PersonTrack, group: DetectionGroup) -> None:
        """Delete a copy, also in messages that are held."""
        if track.confirmed:
            self._events.note(group.stamp, "track withdrawn", person=track.id)
        self._identities.leave_crowd(track)
        self._people.remove(track)
        track.id, track.is_copy = UNTRACKED, True
        for j in [j for j, each in enumerate(group.tracks) if each is track]:
            group.tracks[j], group.reasons[j] = None, DISPLACED

    def _others(self, group: DetectionGroup) -> list[PersonTrack]:
        """Return the people who are there, and whom not only this camera reports."""
        return [
            person
            for person in self._people.confirmed()
            if person.is_there(group.stamp) and not person.is_lone(group.source)
        ]
