"""Cameras that show people elsewhere than the others do: a second view of a person is nobody new.

A camera that was moved, stands on its head, has another camera's pose or looks into a mirror shows
copies of people. Nobody but a copy moves as the person does. The model, with its numbers below:

- Only a track that one camera alone reports may be a copy, and only of a person whom another camera
  knows. Both are compared at the same instants, over a second and a half.
- A copy: one rotation and one shift, or one reflection, takes the track onto the person, with
  sides as they are or swapped. The distance that remains is far less than the person moved, so a
  person who stands still is no evidence.
- A displaced camera does not also show the person in place. A mirror does, but it only reflects:
  somebody who walks half a step behind the person is also turned or shifted.
- The displacement is the camera's, so it applies to everybody whom the camera shows. It is
  remembered and made more precise. It then finds copies at once, also of people who stand still,
  and copies so near to the person that they would be taken for the person. It is forgotten once
  the camera shows people in place, or no copy for a while.

Of two cameras without a third, nobody can know which is displaced. Each then shows copies of the
people whom the other one knows: whoever came first stays.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from hiros_mcap.events import CAMERA_BACK, MIRROR_SEEN, Event, Events, camera_displaced
from hiros_mcap.skeletons import POSITION, UNTRACKED, Flags, Floats, Ints
from hiros_mcap.stages.track.likeness import (
    ALIKE,
    ALIKE_IF_DISPLACED,
    DISPLACED,
    FEWEST,
    UNSEEN,
    Displacement,
    Likeness,
    fit,
    likeness,
    mean_marker_distances,
    median_distance,
)
from hiros_mcap.stages.track.tracked_people import DetectionGroup, PersonTrack, TrackedPeople

_INTERVAL = 45_000_000  # ns between two samples of a track
_PATIENCE, _LATER = 90_000_000, 500_000_000  # ns between two comparisons of a track: at first, and
_SHARE = 8  # at most; in between, its age divided by this
_SHORTEST, _LONGEST = 350_000_000, 1_500_000_000  # ns that are compared
_CROWD = 100  # pairs of a track and a person; of more, too slow to compare, none is
_NEAR = 0.3  # m from the person, once the displacement is undone
_BACK = 500_000_000  # ns for which a camera that shows people in place is believed to be back
_FORGET = 60_000_000_000  # ns since the last copy
_SAMPLES, _REFIT = 90, 10  # samples that make a displacement more precise; new ones for a new fit


class LoneTracks(NamedTuple):
    """One message of a camera: what it alone shows, beside the P people whom others know."""

    source: str
    stamp: int  # ns
    tracks: Sequence[int]  # numbers of tracks that no other camera reports
    poses: Floats  # (N, M, 3) their detections, m
    persons: Sequence[int]  # numbers of the tracks of the people
    places: Floats  # (P, M, 3) their markers, m
    since: Ints  # (P,) time of the first detection, ns; 0 if two cameras agree on the person
    shown: Flags  # (P,) whether the message shows the person in place
    heard: Sequence[str]  # the other cameras that send messages at this time


class _Pairs(NamedTuple):
    """A track beside a person at K instants."""

    track: Floats  # (K, M, 3) m
    person: Floats  # (K, M, 3) m
    unseen: float  # share of the instants at which the camera did not show the person in place
    agreed: bool  # whether two cameras agree on the person


@dataclass(slots=True)
class _History:
    """The latest samples of a track that one camera reports, and of the people known elsewhere."""

    first: int  # time of the first sample, ns
    due: int  # time of the next comparison, ns
    samples: deque[tuple[Floats, LoneTracks]] = field(default_factory=deque)
    """(M, 3) markers, m; the message."""

    @property
    def last(self) -> int:
        """Time of the last sample, ns."""
        return self.samples[-1][1].stamp

    def add(self, pose: Floats, lone: LoneTracks) -> None:
        """Add a sample, if the last one is old enough; forget old ones."""
        if self.samples and lone.stamp - self.last < _INTERVAL:
            return
        self.samples.append((pose, lone))
        while lone.stamp - self.samples[0][1].stamp > _LONGEST:
            self.samples.popleft()

    def pairs(self) -> Iterator[_Pairs]:
        """Yield the track beside each person who was known before it, or is beyond question."""
        last = self.samples[-1][1]
        for number, since in zip(last.persons, last.since.tolist(), strict=True):
            rows = [
                (pose, lone, lone.persons.index(number))
                for pose, lone in self.samples
                if number in lone.persons
            ]
            long_enough = last.stamp - rows[0][1].stamp >= _SHORTEST and len(rows) >= FEWEST
            if long_enough and since <= self.first:
                yield _Pairs(
                    np.stack([pose for pose, _, _ in rows]),
                    np.stack([lone.places[i] for _, lone, i in rows]),
                    1.0 - float(np.mean([lone.shown[i] for _, lone, i in rows])),
                    since == 0,
                )


@dataclass(slots=True)
class _State:
    """A camera that is displaced."""

    by: Displacement
    last: int  # time of its last copy, ns
    pairs: deque[tuple[Floats, Floats]] = field(default_factory=lambda: deque(maxlen=_SAMPLES))
    """(M, 3) markers of a copy and of its person, m."""
    new: int = 0  # pairs since the last fit
    sampled: int = 0  # time of the latest pair, ns
    in_place: int = 0  # time since which it has shown people in place, ns; 0 = it does not

    def learn(self, track: Floats, person: Floats, stamp: int, mirror: Ints) -> None:
        """Make the displacement more precise by one more copy."""
        if stamp - self.sampled < _INTERVAL:
            return
        self.sampled = stamp
        self.pairs.append((track, person))
        self.new += 1
        if self.new >= _REFIT:
            self.new = 0
            source, target = map(np.stack, zip(*self.pairs, strict=True))
            by, distance = fit(source, target, mirror, self.by.mirrors, self.by.swaps)
            self.by = by if distance < ALIKE else self.by

    def take_copy(self, pairs: _Pairs, mirror: Ints) -> bool:
        """Learn from a track if the displacement explains it; return whether it does."""
        by = self._explanation(pairs, mirror)
        if by is not None and by is not self.by:
            self.by = by
            self.pairs.extend(zip(pairs.track, pairs.person, strict=True))
        return by is not None

    def _explanation(self, pairs: _Pairs, mirror: Ints) -> Displacement | None:
        """Return the displacement that puts the person, who is not in place, where a track is.

        A displacement that is known from one place is not precise elsewhere. So another one will
        do that fits this track and the copies so far.
        """
        if not self.by.mirrors and pairs.unseen < UNSEEN:
            return None
        if median_distance(self.by, pairs.track, pairs.person, mirror) < _NEAR:
            return self.by
        track, person = map(np.stack, zip(*self.pairs, strict=True))
        together = np.concatenate([track, pairs.track]), np.concatenate([person, pairs.person])
        by, _ = fit(*together, mirror, self.by.mirrors, self.by.swaps)
        before = median_distance(by, track, person, mirror)
        if max(before, median_distance(by, pairs.track, pairs.person, mirror)) > ALIKE_IF_DISPLACED:
            return None
        return by


class DisplacedCameras:
    """Finds the copies of people, and remembers what displaces the cameras that show them.

    Parameters
    ----------
    mirror : (M,) slot of the marker on the other side.
    events : where a camera's first copy is noted.
    """

    def __init__(self, mirror: Ints, events: Events) -> None:
        self._mirror = mirror
        self._events = events
        self._cameras: dict[str, _State] = {}
        self._histories: dict[str, dict[int, _History]] = {}
        self._named: dict[tuple[str, bool], Event] = {}
        """Camera, and whether it looks into a mirror -> what was noted of it."""

    @property
    def sources(self) -> Collection[str]:
        """The cameras that are displaced."""
        return self._cameras.keys()

    def copies(self, source: str, stamp: int, poses: Floats, places: Floats) -> Flags:
        """Return which detections of a displaced camera are copies of people known elsewhere.

        A detection is a copy if it lies on a person once the displacement is undone, and nearer
        than it does as it is; nobody has a copy who is shown in place, but for a mirror's.

        Parameters
        ----------
        stamp : ns. poses : (N, M, 3) detections, m. places : (P, M, 3) the people, m.
        """
        state = self._cameras[source]
        if stamp - state.last > _FORGET:
            del self._cameras[source]
        if source not in self._cameras or not len(poses) or not len(places):
            return np.zeros(len(poses), np.bool_)
        back = state.by.undo(poses, self._mirror)
        measured, undone = (
            mean_marker_distances(markers[:, None], places[None]) for markers in (poses, back)
        )
        in_place = (measured < _NEAR) & (measured < undone)
        free = state.by.mirrors | ~in_place.any(axis=0)
        undone = np.where(free, undone, np.inf)
        is_copy = np.asarray(undone.min(axis=1) < np.minimum(measured.min(axis=1), _NEAR))
        for j in np.flatnonzero(is_copy).tolist():
            i = int(undone[j].argmin())
            state.last = stamp
            state.learn(poses[j].copy(), places[i].copy(), stamp, self._mirror)
        self._notice_return(source, stamp, bool(in_place.any()) and not is_copy.any())
        return is_copy

    def _notice_return(self, source: str, stamp: int, in_place: bool) -> None:
        """Forget a displacement if the camera has shown people in place for a while."""
        state = self._cameras[source]
        if not in_place or state.by.mirrors:
            state.in_place = 0
        elif not state.in_place:
            state.in_place = stamp
        elif stamp - state.in_place > _BACK:
            del self._cameras[source]
            self._note_return(source, state.in_place)

    def _note_return(self, source: str, stamp: int) -> None:
        """Note that a displaced camera shows people in place again."""
        event = self._named.get((source, False))
        if event is not None:
            self._named = {key: other for key, other in self._named.items() if other is not event}
            seconds = (stamp - event.stamp) / 1e9
            detail = f"{event.detail.replace('shows', 'showed')} for {seconds:.1f} s"
            # In its place: a live run publishes what is behind the events that it knows.
            place = self._events.log.index(event)
            self._events.log[place] = replace(event, kind=CAMERA_BACK, source=source, detail=detail)

    def compare(self, lone: LoneTracks) -> list[int]:
        """Compare what a camera alone shows with the people known elsewhere.

        Returns
        -------
        Numbers of the tracks that are copies, of this camera, also of some not in the message.
        """
        histories = self._remembered(lone)
        if not lone.persons:
            return []
        copies = []
        for number, history in histories.items():
            if lone.stamp < history.due or history.last != lone.stamp:
                continue
            age = lone.stamp - history.first
            history.due = lone.stamp + min(max(_PATIENCE, age // _SHARE), _LATER)
            if self._take_copy(history, lone):
                copies.append(number)
        if copies:
            state = self._cameras[lone.source]
            copies += [
                number
                for number, history in histories.items()
                if number not in copies
                and any(state.take_copy(pairs, self._mirror) for pairs in history.pairs())
            ]
        for number in copies:
            del histories[number]
        return copies

    def _remembered(self, lone: LoneTracks) -> dict[int, _History]:
        """Add a message to the histories of the camera's tracks; return them."""
        old = self._histories.get(lone.source, {})
        recent = {
            number: history
            for number, history in old.items()
            if lone.stamp - history.last < _SHORTEST
        }
        histories = self._histories[lone.source] = recent
        if len(lone.tracks) * len(lone.persons) > _CROWD:
            return histories
        for number, pose in zip(lone.tracks, lone.poses, strict=True):
            new = _History(lone.stamp, lone.stamp + _SHORTEST)
            histories.setdefault(number, new).add(pose, lone)
        return histories

    def _take_copy(self, history: _History, lone: LoneTracks) -> bool:
        """Learn from a track if it is a copy, so that its camera is displaced; return whether."""
        state = self._cameras.get(lone.source)
        if not (state or self._right_ones(lone)):
            return False
        copies = []
        for pairs in history.pairs():
            if state and state.take_copy(pairs, self._mirror):
                state.last = lone.stamp
                return True
            like = likeness(pairs.track, pairs.person, self._mirror)
            same_kind = state and like and state.by.mirrors == like.by.mirrors
            limit = ALIKE_IF_DISPLACED if same_kind else ALIKE
            if like and like.is_copy(limit, pairs.unseen):
                copies.append((like, pairs))
        if copies:
            like, pairs = min(copies, key=lambda copy: copy[0].distance)
            if like.distance < ALIKE:
                self._declare(like, pairs, history.first, lone)
        return bool(copies)

    def _right_ones(self, lone: LoneTracks) -> list[str]:
        """Return the other cameras that show people where they are."""
        return [
            source
            for source in lone.heard
            if source not in self._cameras or self._cameras[source].by.mirrors
        ]

    def _declare(self, like: Likeness, pairs: _Pairs, since: int, lone: LoneTracks) -> None:
        """Note that a camera is displaced, or displaced anew."""
        right = sorted(self._right_ones(lone))
        state = self._cameras[lone.source] = _State(like.by, lone.stamp)
        state.pairs.extend(zip(pairs.track, pairs.person, strict=True))
        if not like.by.mirrors and len(lone.heard) == 1:
            (other,) = lone.heard
            state = self._cameras[other] = _State(like.by.inverse(), lone.stamp)
            state.pairs.extend(zip(pairs.person, pairs.track, strict=True))
        if (lone.source, like.by.mirrors) in self._named:
            return
        both = len(lone.heard) == 1
        if like.by.mirrors:
            detail = f"shows mirror images of people, {like.apart:.2f} m away"
            event = Event(since, MIRROR_SEEN, -1, lone.source, detail)
        else:
            certain = pairs.agreed and len(right) > 1
            event = camera_displaced(since, lone.source, like.apart, [] if certain else right)
        self._events.log.append(event)
        for name in (lone.source, *lone.heard[:both]):
            self._named[name, like.by.mirrors] = event


# Here the tracks follow.


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
        self, people: TrackedPeople, places: Places, mirror: Ints,
        events: Events, *, withdraws: bool,
    ) -> None:  # fmt: skip
        self._people, self._places = people, places
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
        message = LoneTracks(
            group.source,
            group.stamp,
            [track.number for track in tracks],
            group.people.markers[list(rows), :, POSITION],
            [person.number for person in persons],
            self._places(persons, group),
            np.array([0 if p.certain else p.first for p in persons], np.int64),
            np.array([person in group.tracks for person in persons], np.bool_),
            heard,
        )
        for number in self.displaced.compare(message):
            for track in [t for t in self._people.tracks if t.number == number]:
                if track.is_lone(group.source):
                    self._withdraw(track, group)

    def _withdraw(self, track: PersonTrack, group: DetectionGroup) -> None:
        """Delete a copy, also in messages that are held."""
        if track.confirmed:
            self._events.note(group.stamp, "track withdrawn", person=track.id)
        self._people.remove(track)
        track.id, track.is_copy = UNTRACKED, True
        for j in [j for j, shown in enumerate(group.tracks) if shown is track]:
            group.tracks[j], group.reasons[j] = None, DISPLACED

    def _others(self, group: DetectionGroup) -> list[PersonTrack]:
        """Return the people who are there, and whom not only this camera reports."""
        return [
            person
            for person in self._people.confirmed()
            if person.is_there(group.stamp) and not person.is_lone(group.source)
        ]
