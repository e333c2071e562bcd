"""The tracks of people, and one message of a camera with the tracks that it was given."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Set
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.frames import Block, CameraMessages, CameraNumbers, places_of
from hiros_mcap.kernels.array_types import joined
from hiros_mcap.kernels.distance import centre, mean_distances
from hiros_mcap.skeletons import UNTRACKED, Floats, People, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.track.association import Tracks
from hiros_mcap.stages.track.track_params import TrackParams
from hiros_mcap.stages.track.tracking import (
    FAULTS,
    INSISTENCE,
    NEVER,
    Cameras,
    KnownTracks,
)

_PRESENT = 200_000_000  # ns since the last detection of a person who is there
_STANDS = 0.3  # m from its start; a coat on a stand never moves as far

_centre = centre.raw


@dataclass(slots=True, eq=False)
class PersonTrack:
    """A person, or what may become one.

    Every report of a camera supports it. A message of another camera that looks at the place, with
    nobody in between, and reports nobody there contradicts it.
    """

    number: int  # its name in the bank
    row: int  # its row in the bank
    bank: Bank[Tracks]
    first: int  # time of the first report, ns
    origin: Floats  # (3,) mean marker position of the first report, m
    reports: dict[str, int] = field(default_factory=dict)  # camera to number of reports
    misses: int = 0
    travelled: float = 0.0  # greatest distance from the origin so far, m
    unwatched: bool = False
    """Whether there are other cameras, none of which has looked at the place."""
    id: int = UNTRACKED  # UNTRACKED while the track is tentative
    former_id: int = UNTRACKED
    """The id before it was withdrawn, which the track gets back if it is confirmed again."""
    beside: set[int] = field(default_factory=set)
    """Numbers of the persons whom a message showed beside it, before it was certain."""
    seen_before: float = 0.0  # s for which the person was seen before an absence
    may_be: dict[int, float] = field(default_factory=dict)
    """Ids of the people who were absent when it got a new id -> probability that it is each."""
    doubtful: bool = False  # whether the id waits until it is clear which absent person this is
    is_copy: bool = False  # whether it was left out as a displaced camera's view of somebody else

    @property
    def seen(self) -> int:
        """Time of the last detection, ns."""
        return int(self.bank.past.last_seen[self.row])

    @property
    def confirmed(self) -> bool:
        """Whether it counts as a person."""
        return self.id != UNTRACKED

    @property
    def certain(self) -> bool:
        """Whether nothing can contradict it any more: two cameras have reported the person."""
        return self.id != UNTRACKED and len(self.reports) > 1

    def is_there(self, stamp: int) -> bool:
        """Whether a camera has just shown it, at ``stamp``, ns."""
        return stamp - self.seen < _PRESENT

    def is_lone(self, source: str) -> bool:
        """Whether no camera but one reports it."""
        return self.reports.keys() <= {source}

    def is_supported(self, params: TrackParams) -> bool:
        """Whether it has enough support to count."""
        total = sum(self.reports.values())
        if total < params.confirm_detections:
            return False
        by_others = total - max(self.reports.values())  # than the camera that reports most
        if by_others >= min(2, params.confirm_detections - 1) > 0:
            return True
        still = self.unwatched and self.travelled <= _STANDS
        needed = params.confirm_alone if still else params.confirm_seconds
        return (self.seen - self.first) * 1e-9 >= needed and not self.is_refuted(params)

    def is_refuted(self, params: TrackParams) -> bool:
        """Whether a single camera reports it, others miss it, and it does not move."""
        total = sum(self.reports.values())
        contradicted = len(self.reports) < 2 and self.misses > params.contradiction * total
        return contradicted and self.travelled <= _STANDS


@dataclass(slots=True, eq=False)
class DetectionGroup:
    """One message of a camera: the detection group of eq 3, with the tracks it was given."""

    block: Block
    place: int  # its place in the block
    stamp: int
    source: str
    people: People  # views of its people in the block
    tracks: list[PersonTrack | None]
    reasons: list[str]  # why a detection has no track and starts none; "" if there is no reason

    @property
    def unmatched(self) -> list[int]:
        """Detections that still need a track."""
        return [j for j, track in enumerate(self.tracks) if track is None and not self.reasons[j]]

    @property
    def doubtful(self) -> bool:
        """Whether somebody's id waits for more evidence."""
        return any(track is not None and track.doubtful for track in self.tracks)

    @property
    def decided(self) -> bool:
        """Whether nothing that is still to come can change an id."""
        return all(track is None or track.certain for track in self.tracks)


@dataclass(slots=True, eq=False)
class Present:
    """Who is there while a message is weighed."""

    shown: set[PersonTrack | None]  # tracks that the message shows
    numbers: frozenset[int]  # their numbers
    persons: list[PersonTrack]  # the confirmed tracks


class TrackedPeople:
    """All tracks, the states of their filters, and the cameras that send messages."""

    def __init__(
        self, model: SkeletonModel, places: Mapping[str, Floats], misplaced: Set[str] = frozenset()
    ) -> None:
        self._places, self._misplaced = places, misplaced
        self.tracks: list[PersonTrack] = []
        self.bank = Bank(Tracks.allocate(0, model.n_markers, model.n_links))
        self.cameras = Cameras.allocate(0)
        self.names = CameraNumbers()  # camera to its row in ``cameras``
        self._numbers = itertools.count()

    def messages_of(self, block: Block) -> CameraMessages:
        """Return the messages of a block; make room for new cameras."""
        messages = self.names.messages(block)
        if new := len(self.names) - len(self.cameras.heard):
            self.cameras = joined([self.cameras, Cameras.allocate(new)])
            self.cameras.places[:] = places_of(self.names, self._places)
            past = self.bank.past
            leaps = np.pad(past.leaps, ((0, 0), (0, new), (0, 0)), constant_values=NEVER)
            leapt_to = np.pad(past.leapt_to, ((0, 0), (0, new), (0, 0)))
            self.bank.past = past._replace(leaps=leaps, leapt_to=leapt_to)
        return messages

    def known(self, *, certain: bool) -> KnownTracks:
        """Return the tracks; messages may be ``certain`` if these are."""
        ids = np.full(len(self.bank.past.last_seen), UNTRACKED, np.int32)
        persons: list[int] = []
        tentative: list[int] = []
        for track in self.tracks:
            ids[track.row] = track.id
            (persons if track.id != UNTRACKED else tentative).append(track.row)
            certain = certain and track.certain
        rows = np.array(persons, np.int64), np.array(tentative, np.int64)
        return KnownTracks(*rows, ids, certain)

    def group(self, block: Block, place: int, rows: Stamps, faults: Stamps) -> DetectionGroup:
        """Return a message whose detections have these tracks, (P,) rows, and faults, (P,)."""
        people = block.people.at(slice(*block.rows[place].tolist()))
        tracks = {track.row: track for track in self.tracks}
        n = len(people.ids)
        return DetectionGroup(
            block, place, int(block.stamps[place]), block.source(place), people,
            [tracks.get(row) for row in rows[:n].tolist()],
            [FAULTS[fault] for fault in faults[:n].tolist()],
        )  # fmt: skip

    def confirmed(self) -> list[PersonTrack]:
        """Those who count as persons."""
        return [track for track in self.tracks if track.id != UNTRACKED]

    def tentative(self) -> list[PersonTrack]:
        """Those who do not count yet."""
        return [track for track in self.tracks if track.id == UNTRACKED]

    def is_copy(self, track: PersonTrack) -> bool:
        """Whether only cameras whose poses are wrong show a track: the person is elsewhere."""
        return track.is_copy or track.reports.keys() <= self._misplaced

    def may_count(self, track: PersonTrack, params: TrackParams) -> bool:
        """Whether a track has enough support to count, by a camera whose pose may be right."""
        return track.is_supported(params) and not self.is_copy(track)

    def start(self, stamp: int, origin: Floats) -> PersonTrack:
        """Add a tentative track, first reported at ``stamp``, ns, at ``origin`` (3,), m."""
        number = next(self._numbers)
        row, past = self.bank.row(number, stamp), self.bank.past
        past.positions[row] = past.orientations[row] = np.nan
        past.last_seen[row], past.leaps[row] = stamp, NEVER
        self.tracks.append(PersonTrack(number, row, self.bank, stamp, origin))
        return self.tracks[-1]

    def remove(self, track: PersonTrack) -> None:
        """Delete a track."""
        self.tracks.remove(track)
        self.bank.forget(track.number)

    def centre(self, track: PersonTrack) -> Floats:
        """(3,) mean marker position of a track, m."""
        place = np.empty(3)
        _centre(self.bank.past.positions[track.row], place)
        return place

    def distances(self, track: PersonTrack, persons: list[PersonTrack]) -> Floats:
        """Mean distance, m, of a track's markers from each person."""
        others = [person.row for person in persons]
        positions, distances = self.bank.past.positions, np.empty((1, len(others)))
        mean_distances(positions[[track.row]], positions[others], distances)
        return distances[0]

    def heard_besides(self, group: DetectionGroup) -> list[str]:
        """Return the other cameras that send messages at this time."""
        heard = zip(self.names, self.cameras.heard.tolist(), strict=True)
        return [
            name
            for name, stamp in heard
            if name != group.source and group.stamp - stamp < INSISTENCE
        ]
