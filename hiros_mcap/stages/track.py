"""Skeleton tracker: one id per person over all cameras (Hi-ROS 2023, section 3.1).

:meth:`_Tracker.update` is the paper's algorithm for one camera's message: predict the tracks,
compare them with the detections, assign, correct the tracks, start and delete tracks.

Beyond the paper:

- Messages are first put in order of their times (:class:`TimeOrder`).
- A new track is tentative and has no id. Its support confirms it (:class:`_Support`). A message
  that shows somebody tentative is held for a moment, so that a confirmed person has the id from
  the first detection on (:class:`Delay`).
- A detection with left and right swapped is compared, and corrects its track, swapped back.
- A detection that leaps away from its track is left out: a detector distorts people who are about
  to be hidden. The gate of an unseen track grows.
- A camera that shows people elsewhere than the others do brings nobody new
  (:mod:`~hiros_mcap.stages.displaced`).
- Two tracks of one person are merged. Who comes back gets the old id if it is probable
  (:mod:`~hiros_mcap.stages.reidentify`).
- Where every detection is of a confirmed track, one compiled call takes many messages.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter

import numpy as np
from pydantic import Field

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, Part, frames_of, join
from hiros_mcap.kernels import tracking as kernels
from hiros_mcap.kernels.assignment import solve
from hiros_mcap.kernels.compile import direct
from hiros_mcap.kernels.distance import mean_distances
from hiros_mcap.params import Params, Seconds, advanced
from hiros_mcap.skeletons import (
    ORIENTATION,
    POSITION,
    UNTRACKED,
    Floats,
    Frame,
    People,
    SkeletonModel,
    Stamps,
)
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.coverage import Coverage
from hiros_mcap.stages.delay import Delay
from hiros_mcap.stages.displaced import DISPLACED, DisplacedCameras, LoneTracks, Others
from hiros_mcap.stages.reidentify import OVERLAP, Limbs, PersonCues, Verdict, reidentify
from hiros_mcap.stages.time_order import TimeOrder

_INSISTENCE = 500_000_000  # ns for which a camera's leaps are left out
_DOUBT = 800_000_000  # ns for which a track beside a person may be a second view of that person
_YOUNG = 2_400_000_000  # ns for which a track may be merged into an older one
_DOUBTFUL = 1.5  # gates: cameras whose views of a person differ by more are not calibrated
_NOW = 200_000_000  # ns since the last detection of a person who is there
_PATIENCE = 0.8  # share of the look-ahead for which the evidence of a newcomer is gathered

_LEAP = "leap"
_REASONS = {
    kernels.USABLE: "",
    kernels.NO_MARKERS: "no markers",
    kernels.LOW_CONFIDENCE: "low confidence",
}

# The steps of one message take arrays that the tracker itself has made.
_screen, _predict = direct(kernels.screen), direct(kernels.predict)
_association_cost, _solve = direct(kernels.association_cost), direct(solve)
_correct, _centre = direct(kernels.correct), direct(kernels.centre)
_find_breaks = direct(kernels.find_breaks)


class TrackParams(Params):
    """Parameters of the tracker."""

    max_distance: float = Field(
        0.6,
        gt=0,
        description="Gate, m: largest mean distance of a detection's markers from a track (section "
        "3.1.2). Views of one person differ by 0.05 to 0.35 m. The published code works with 0.8 "
        "m, which also matches a neighbour.",
    )
    max_gap: Seconds = Field(
        1.5,
        gt=0,
        description="t_m, s: a track is deleted when no camera has seen the person for longer "
        "(section 3.1.2).",
    )
    min_marker_confidence: float = Field(
        0.0, ge=0, le=1, description="Markers and links with lower confidence count as absent."
    )
    reorder: Seconds = Field(
        1.0,
        ge=0,
        description="Longest time, s, that a message waits for older messages of slower cameras. "
        "Messages that arrive later are still tracked, at their own time. Recorders stall for up "
        "to a second; 0.1 suits a live system.",
    )
    lookahead: Seconds = Field(
        1.0,
        ge=0,
        description="Time, s, that a message with a tentative track is held. The person then has "
        "the id from the first detection on. 0 = a live system without delay.",
    )
    reidentify: Seconds = Field(
        30.0,
        ge=0,
        description="Longest absence, s, after which a person may get the old id back. Limb "
        "lengths, place, time and the number of people must make it probable (90 %). The "
        "decision waits for 0.8 of track.lookahead. 0 = whoever comes back has a new id.",
    )
    max_jump: float = advanced(
        0.3,
        gt=0,
        description="A detection is left out if its markers are on average farther, m, from their "
        "track than this, although the track was just seen (plus 3 m/s for longer intervals). "
        "Detectors distort people who are about to be hidden. A camera that repeats it for half a "
        "second is believed. inf = off (paper).",
    )
    min_distance: float = advanced(
        0.25,
        ge=0,
        description="A detection is a duplicate and starts no track if it is this near, m, to a "
        "person who is already in the same message (0.1: published code).",
    )
    orientation_weight: float = advanced(
        0.05,
        ge=0,
        description="Weight of eq 9 against eq 8 in eq 6, m per rad. The paper adds metres and "
        "radians one to one; a detection that faces the wrong way then costs as much as 3 m.",
    )
    position_weight: float = advanced(
        1.0,
        ge=0,
        description="Weight of the positions in eq 8. 0 leaves them out: velocities and "
        "orientations then decide between the tracks within the gate. A detection with left and "
        "right swapped has only positions; it costs its distance.",
    )
    velocity_weight: float = advanced(
        0.05, ge=0, description="w_v of eq 8, s. Only detections with velocities use it."
    )
    angular_velocity_weight: float = advanced(
        0.0, ge=0, description="w_omega of eq 9, s. Only detections with velocities use it."
    )
    velocity_decay: float = advanced(
        0.25,
        ge=0,
        le=1,
        description="gamma of eq 11; 0 = fast markers count like slow ones (0.25: published code).",
    )
    exponent: float = advanced(1.0, ge=1, description="alpha of eq 8 and 9 (1: published code).")
    weight_by_confidence: bool = advanced(
        True, description="Use the confidence weight kappa of eq 11."
    )
    weight_by_velocity: bool = advanced(True, description="Use the velocity weight w_v of eq 11.")
    flip_aware: bool = advanced(
        True,
        description="Also compare detections with left and right swapped; needs marker names.",
    )
    merge_tracks: bool = advanced(
        True,
        description="Two tracks that no camera ever showed together, near each other, are one "
        "person of whom cameras disagree for a moment: the second is not confirmed for 0.8 s, or "
        "merged into the first. A track of one camera that moves as a person does elsewhere is "
        "left out: the camera is displaced, or looks into a mirror.",
    )
    min_skeleton_confidence: float = advanced(
        0.0, ge=0, le=1, description="Detections with lower confidence are not tracked."
    )
    min_markers: int = advanced(
        4, ge=1, description="A detection with fewer markers starts no track."
    )
    min_links: int = advanced(
        0, ge=0, description="A detection with fewer link orientations starts no track."
    )
    tentative_gap: Seconds = advanced(
        0.5,
        gt=0,
        description="A tentative track is deleted when no camera has seen it for longer, s.",
    )
    confirm_detections: int = advanced(
        5,
        ge=1,
        description="Number of detections that confirm a track, if two cameras or more report it.",
    )
    confirm_seconds: Seconds = advanced(
        0.5,
        ge=0,
        description="Time, s, after which a track of a single camera is confirmed, unless other "
        "cameras contradict it.",
    )
    confirm_alone: Seconds = advanced(
        1.0,
        ge=0,
        description="The same for a body that stands still where none of the other cameras looks. "
        "If it is longer than the look-ahead, the person's first frames have no id.",
    )
    contradiction: float = advanced(
        0.5,
        ge=0,
        description="Largest number of misses per report. Other cameras that look at a track of a "
        "single camera contradict it when they miss it more often.",
    )
    min_motion: float = advanced(
        0.3,
        ge=0,
        description="A contradicted track still counts once it has moved this far, m, from its "
        "start. A coat on a stand never does.",
    )
    horizon: Seconds = advanced(
        0.2,
        gt=0,
        description="Time, s, for which eq 7 predicts constant velocity. After that velocities "
        "fade.",
    )
    fade: Seconds = advanced(
        0.3,
        ge=0,
        description="Time constant, s, with which velocities fade beyond the horizon. 0 = a track "
        "stands still there.",
    )
    gate_growth: float = advanced(
        0.75,
        ge=0,
        description="Growth of the gate, m/s, while a track is unseen for longer than the horizon, "
        "up to twice the gate. 0 = off (paper).",
    )
    position_noise: float = advanced(
        0.04, gt=0, description="SD, m, of a marker that one camera reports (raw error 57 mm)."
    )
    jerk: float = advanced(
        150.0, gt=0, description="How fast accelerations of markers may change, m/s3/sqrt(Hz)."
    )
    orientation_noise: float = advanced(
        0.15, gt=0, description="SD, rad, of a link that one camera reports."
    )
    angular_jerk: float = advanced(
        500.0,
        gt=0,
        description="How fast angular accelerations of links may change, rad/s3/sqrt(Hz).",
    )
    innovation_gate: float = advanced(
        3.0,
        gt=0,
        description="Gate in SDs: a marker or link farther than this from its prediction corrects "
        "the track less.",
    )
    max_speed: float = advanced(
        12.0, gt=0, description="Largest speed of a marker, m/s (a throwing hand reaches 10)."
    )


@dataclass(slots=True, eq=False)
class _Support:
    """What speaks for and against a track.

    Every report of a camera supports it. A message of another camera that looks at the place, with
    nobody in between, and reports nobody there contradicts it.
    """

    first: int
    """Time of the first report, ns."""
    origin: Floats
    """(3,) mean marker position of the first report, m."""
    reports: dict[str, int] = field(default_factory=dict)
    """Camera to number of reports."""
    misses: int = 0
    travelled: float = 0.0
    """Greatest distance from the origin so far, m."""
    lone: bool = False
    """Whether there are other cameras, none of which has looked at the place."""

    def confirms(self, stamp: int, params: TrackParams) -> bool:
        """Whether a track that was last seen at ``stamp``, ns, has enough support."""
        total = sum(self.reports.values())
        if total < params.confirm_detections:
            return False
        by_others = total - max(self.reports.values())  # than the camera that reports most
        if by_others >= min(2, params.confirm_detections - 1) > 0:
            return True
        still = self.lone and self.travelled <= params.min_motion
        needed = params.confirm_alone if still else params.confirm_seconds
        return (stamp - self.first) * 1e-9 >= needed and not self.refuted(params)

    def refuted(self, params: TrackParams) -> bool:
        """Whether a single camera reports the track, others miss it, and it does not move."""
        total = sum(self.reports.values())
        contradicted = len(self.reports) < 2 and self.misses > params.contradiction * total
        return contradicted and self.travelled <= params.min_motion


@dataclass(slots=True, eq=False)
class _Track:
    """A person, or what may become one."""

    number: int
    """Its name in the bank."""
    row: int
    """Its row in the bank."""
    seen: int
    """Time of the last detection, ns."""
    support: _Support
    id: int = UNTRACKED
    """UNTRACKED while the track is tentative."""
    former_id: int = UNTRACKED
    """The id before it was withdrawn, which the track gets back if it is confirmed again."""
    beside: set[int] = field(default_factory=set)
    """Numbers of the persons whom a message showed beside it, before it was certain."""
    leaps: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Camera to the times, ns, of the first and last of its latest leaps."""
    stranger: bool = False
    """Whether it has a new id although somebody was absent: it may yet be one of them."""
    is_copy: bool = False
    """Whether it was left out as a displaced camera's view of somebody else."""

    @property
    def confirmed(self) -> bool:
        """Whether it counts as a person."""
        return self.id != UNTRACKED

    @property
    def certain(self) -> bool:
        """Whether nothing can contradict it any more: two cameras have reported the person."""
        return self.confirmed and len(self.support.reports) > 1

    def is_lone(self, source: str) -> bool:
        """Whether no camera but one reports it."""
        return self.support.reports.keys() <= {source}


@dataclass(slots=True, eq=False)
class _DetectionGroup:
    """One message of a camera: the detection group of eq 3, with the tracks it was given."""

    block: Block
    place: int
    """Its place in the block."""
    stamp: int
    source: str
    people: People
    """Views of its people in the block."""
    tracks: list[_Track | None]
    reasons: list[str]
    """Why a detection has no track and starts none; "" if there is no reason."""

    @classmethod
    def of(cls, block: Block, place: int) -> _DetectionGroup:
        """Return the message at a place of a block; it shares the block's arrays."""
        people = block.people.at(slice(*block.rows[place].tolist()))
        n = len(people.ids)
        stamp, source = int(block.stamps[place]), block.sources[place]
        return cls(block, place, stamp, source, people, [None] * n, [""] * n)

    @property
    def unmatched(self) -> list[int]:
        """Detections that still need a track."""
        return [j for j, track in enumerate(self.tracks) if track is None and not self.reasons[j]]

    @property
    def decided(self) -> bool:
        """Whether nothing that is still to come can change an id."""
        return all(track is None or track.certain for track in self.tracks)

    def give(self, j: int, track: _Track) -> None:
        """Note that detection ``j`` is of a track."""
        self.tracks[j] = track
        track.seen = max(track.seen, self.stamp)


@dataclass(slots=True, eq=False)
class _Scene:
    """Who is there while a message is weighed."""

    shown: set[_Track | None]
    """Tracks that the message shows."""
    numbers: frozenset[int]
    """Their numbers."""
    persons: list[_Track]
    """The confirmed tracks."""
    centres: Floats | None = None
    """(N, 3) mean marker position of each person, m, once somebody has asked for it."""

    def admit(self, track: _Track) -> None:
        """Note that a track was confirmed."""
        self.persons.append(track)
        self.centres = None

    def dismiss(self, track: _Track) -> None:
        """Note that a track is not confirmed any more."""
        self.persons.remove(track)
        self.centres = None


_Message = tuple[Block, int, int]
"""A message that is done: its block, its place there, its log time, ns."""


def track(
    frames: Iterable[Frame],
    model: SkeletonModel,
    params: TrackParams | None = None,
    events: Events | None = None,
    cameras: Mapping[str, Floats] | None = None,
) -> Iterator[Frame]:
    """Give every detection the id of its person (section 3.1.2).

    Parameters
    ----------
    frames : detections of all cameras in the fixed frame, roughly in time order.
    model : names and hierarchy of the skeleton.
    params, events : parameters; where counts and events go.
    cameras : source -> (3,) position of the camera in the fixed frame, m. With it, other cameras
        can contradict a track that only one of them reports.

    Yields
    ------
    The same frames in order of their stamps, with ids (-1 = of nobody who counts) and with the
    tracks' velocities and accelerations where the detector gave none.
    """
    return frames_of(track_blocks(map(Block.of, frames), model, params, events, cameras))


def track_blocks(
    blocks: Iterable[Block],
    model: SkeletonModel,
    params: TrackParams | None = None,
    events: Events | None = None,
    cameras: Mapping[str, Floats] | None = None,
) -> Iterator[Block]:
    """Do what :func:`track` does, a block at a time."""
    params = params or TrackParams()
    tracker = _Tracker(model, params, events or Events(), cameras or {})
    order: TimeOrder[Part] = TimeOrder(params.reorder)
    for block in blocks:
        ready: list[tuple[Part, int]] = []
        for message in block.messages():
            ready += order.push(*message)
        yield from _gather(tracker.take(ready))
    yield from _gather(tracker.take(order.rest()))
    yield from _gather(tracker.finish())


def _gather(messages: Iterable[_Message]) -> Iterator[Block]:
    """Make a block of neighbours that lie in the same arrays."""
    for block, group in itertools.groupby(messages, key=itemgetter(0)):
        _, places, log_times = zip(*group, strict=True)
        yield block.select(places, log_times)


class _Tracker:
    """The tracks, and the messages whose ids are not decided yet."""

    def __init__(
        self,
        model: SkeletonModel,
        params: TrackParams,
        events: Events,
        cameras: Mapping[str, Floats],
    ) -> None:
        self.params = params
        self.events = events
        self.tracks: list[_Track] = []
        self.bank = Bank(kernels.Tracks.allocate(0, model.n_markers, model.n_links))
        self.coverage = Coverage(cameras)
        self.delay: Delay[_DetectionGroup] = Delay(params.lookahead)
        self.numbers, self.ids = itertools.count(), itertools.count()
        symmetry = symmetry_of(model)
        same = np.arange(model.n_markers, dtype=np.int32)
        ends = model.links if params.reidentify > 0 else np.empty((0, 2), np.int32)
        self.slots = kernels.SlotOrders(same, symmetry.mirror, np.ascontiguousarray(ends))
        self.limbs = Limbs.of(ends, symmetry.link_mirror[: len(ends)])
        self.heard: dict[str, int] = {}
        """Camera to the time of its latest message, ns, where it matters."""
        self.absent: list[PersonCues] = []
        self.patience = round(_PATIENCE * params.lookahead * 1e9)
        self.crowd: set[int] = set()
        """Numbers of the tracks of as many people as were there at once."""
        self.displaced = DisplacedCameras(symmetry.mirror, events)
        self.settings = kernels.TrackSettings._make(
            getattr(params, name) for name in kernels.TrackSettings._fields
        )._replace(flip_aware=params.flip_aware and symmetry.known)
        self._work = partial(
            kernels.TrackWork.allocate, n_markers=model.n_markers, n_links=model.n_links
        )
        self.work = self._work(8, 8)

    def update(self, group: _DetectionGroup) -> Iterator[_DetectionGroup]:
        """Track the detections of one message (section 3.1.2); yield messages that are decided."""
        self.heard[group.source] = group.stamp
        self._delete_unseen(group.stamp)  # after t_m
        self._screen(group)  # by confidence
        self._leave_out_copies(group)  # of a displaced camera
        self._match(self._confirmed(), group)  # persons come first
        self._match(self._tentative(), group)
        self._start(group)  # tentative tracks
        self._withdraw_copies(group)
        self._confirm(group)  # or withdraw the id
        self.delay.push(group.stamp, group)
        return self.delay.release(group.stamp, lambda held: held.decided)

    def _match(self, tracks: list[_Track], group: _DetectionGroup) -> None:
        """Match the detections that are left with persons, or with tentative tracks."""
        if not tracks or not group.unmatched:
            return
        rows = self._predict(tracks, group)  # eq 7
        self._compare(rows, group)  # eq 6 and 8 to 11
        self._assign(tracks, group)  # Munkres
        self._correct(rows, group)  # Kalman filter
        if tracks[0].confirmed:
            self._drop_duplicates(tracks, group)

    def take(self, ready: Sequence[tuple[Part, int]]) -> Iterator[_Message]:
        """Track messages, with their log times; yield those that are decided."""
        if not ready:
            return
        block, log_times = _own_block(ready), [now for _, now in ready]
        place = 0
        while place < len(block):
            end = place + self._follow(block, place)
            yield from ((block, i, log_times[i]) for i in range(place, end))
            if end < len(block):
                for group in self.update(_DetectionGroup.of(block, end)):
                    yield self._finish(group, log_times[end])
            place = end + 1

    def finish(self) -> Iterator[_Message]:
        """Yield the messages that are still held, now that nothing more comes."""
        held = list(self.delay.rest())
        for group in held:
            yield self._finish(group, int(held[-1].block.log_times[held[-1].place]))

    def _finish(self, group: _DetectionGroup, log_time: int) -> _Message:
        """Write the ids that the tracks have by now."""
        for j, track in enumerate(group.tracks):
            person = UNTRACKED if track is None else track.id
            group.people.ids[j] = person
            if person == UNTRACKED:
                reason = DISPLACED if track is not None and track.is_copy else "not confirmed"
                self.events.count(group.reasons[j] or reason, group.source)
        return group.block, group.place, max(log_time, int(group.block.log_times[group.place]))

    # The steps of update

    def _confirmed(self) -> list[_Track]:
        return [track for track in self.tracks if track.confirmed]

    def _tentative(self) -> list[_Track]:
        return [track for track in self.tracks if not track.confirmed]

    def _delete_unseen(self, stamp: int) -> None:
        """Delete tracks that nobody saw for t_m; tentative ones sooner."""
        gone: set[_Track] = set()
        self._forget_absent(stamp)
        for track in self.tracks:
            gap = self.params.max_gap if track.confirmed else self.params.tentative_gap
            if (stamp - track.seen) * 1e-9 > gap:
                gone.add(track)
                self.bank.forget(track.number)
                if track.confirmed:
                    self.events.note(track.seen, "track lost", person=track.id)
                    self.absent.append(self._cues_of(track))
        if gone:
            self.tracks = [track for track in self.tracks if track not in gone]

    def _screen(self, group: _DetectionGroup) -> None:
        """Leave out markers and detections of too little confidence."""
        self._make_room(len(group.tracks))
        params, faults = self.params, self.work.faults
        _screen(group.people, params.min_marker_confidence, params.min_skeleton_confidence, faults)
        group.reasons[:] = [_REASONS[fault] for fault in faults[: len(group.tracks)].tolist()]

    def _predict(self, tracks: list[_Track], group: _DetectionGroup) -> Stamps:
        """Predict the tracks' poses at the time of the message; return their rows (eq 7)."""
        rows = np.array([track.row for track in tracks], np.int64)
        _predict(group.stamp, rows, self.bank.past, self.settings, self.work.predicted)
        return rows

    def _compare(self, rows: Stamps, group: _DetectionGroup) -> None:
        """Work out the cost of every pair of a track and an unmatched detection (eq 6)."""
        wanted = self.work.pairs.wanted
        wanted.fill(False)
        wanted[group.unmatched] = True
        _association_cost(rows, group.people, self.bank.past, self.slots, self.settings, self.work)

    def _assign(self, tracks: list[_Track], group: _DetectionGroup) -> None:
        """Give detections to tracks at the least total cost; leave out those that leap."""
        pairs, n_people = self.work.pairs, len(group.tracks)
        _solve(pairs.cost, len(tracks), n_people, self.work.assignment, pairs.match)
        _find_breaks(n_people, self.work, self.settings)
        for j, i in enumerate(pairs.match[:n_people].tolist()):
            if i < 0:
                continue
            if pairs.broken[j] and tracks[i].confirmed and _is_sudden(tracks[i], group):
                pairs.match[j] = -1
                group.reasons[j] = _LEAP
            else:
                group.give(j, tracks[i])

    def _correct(self, rows: Stamps, group: _DetectionGroup) -> None:
        """Correct the tracks by their detections; write their velocities into the message."""
        _correct(
            group.stamp, rows, self.work.pairs, group.people, self.bank.past, self.slots,
            self.settings,
        )  # fmt: skip

    def _drop_duplicates(self, tracks: list[_Track], group: _DetectionGroup) -> None:
        """Leave out detections on top of a person whom this message already shows."""
        present = set(group.tracks)
        shown = [i for i, track in enumerate(tracks) if track.confirmed and track in present]
        for j in group.unmatched:
            if (self.work.pairs.distances[shown, j] < self.params.min_distance).any():
                group.reasons[j] = "duplicate"

    def _start(self, group: _DetectionGroup) -> None:
        """Start a tentative track for each detection that is of nobody known."""
        unmatched, pairs = group.unmatched, self.work.pairs
        if not unmatched:
            return
        new: list[_Track] = []
        pairs.match.fill(UNTRACKED)
        here = group.people.markers[unmatched, :, POSITION]
        enough = np.count_nonzero(~np.isnan(here[..., 0]), axis=1) >= self.params.min_markers
        origins = np.nanmean(here, axis=1)
        for j, origin, is_whole in zip(unmatched, origins, enough.tolist(), strict=True):
            if not is_whole:
                group.reasons[j] = "too few markers"
                continue
            turned = ~np.isnan(group.people.links[j, :, ORIENTATION.start])
            if np.count_nonzero(turned) < self.params.min_links:
                group.reasons[j] = "too few links"
                continue
            support = _Support(group.stamp, origin)
            pairs.match[j] = len(new)
            new.append(self._new_track(group.stamp, support))
            group.give(j, new[-1])
        if new:
            pairs.mirrored.fill(False)
            self._correct(np.array([track.row for track in new], np.int64), group)

    def _new_track(self, stamp: int, support: _Support) -> _Track:
        number = next(self.numbers)
        row = self.bank.row(number, stamp)
        self.bank.past.positions[row] = self.bank.past.orientations[row] = np.nan
        self.tracks.append(_Track(number, row, stamp, support))
        return self.tracks[-1]

    def _confirm(self, group: _DetectionGroup) -> None:
        """Weigh what the message says about every track that is not certain yet."""
        due = self.coverage.is_due(group.source, group.stamp)
        shown = set(group.tracks)
        numbers = frozenset(track.number for track in shown if track is not None)
        scene = _Scene(shown, numbers, self._confirmed())
        for track in list(self.tracks):
            if track.number not in self.bank.rows:  # merged into another one by now
                continue
            if not track.certain:
                self._weigh(track, group, scene)
                self._decide(track, group, scene)
                self._merge_into_person(track, group, scene)
            elif due and track in scene.shown:
                self.coverage.learn(group.source, self._centre(track), group.stamp)

    def _weigh(self, track: _Track, group: _DetectionGroup, scene: _Scene) -> None:
        """Add the support, or the contradiction, of a camera's message."""
        support, source = track.support, group.source
        if track in scene.shown:
            support.reports[source] = support.reports.get(source, 0) + 1
            moved = float(np.linalg.norm(self._centre(track) - support.origin))
            support.travelled = max(support.travelled, moved)
            support.lone = support.misses == 0 and bool(self._heard_besides(group))
            if group.stamp - support.first < _YOUNG:
                track.beside |= scene.numbers
        elif source not in support.reports and self._ought_to_see(source, track, scene):
            support.misses += 1

    def _decide(self, track: _Track, group: _DetectionGroup, scene: _Scene) -> None:
        """Confirm a track, or withdraw its id."""
        support = track.support
        if track.confirmed and support.refuted(self.params):
            self.events.note(group.stamp, "track withdrawn", person=track.id)
            track.former_id, track.id = track.id, UNTRACKED
            self.crowd.discard(track.number)
            scene.dismiss(track)
        elif (
            not track.confirmed
            and support.confirms(track.seen, self.params)
            and not self._is_duplicate(track, group.stamp, scene)
        ):
            self._name(track, group, scene)

    def _name(self, track: _Track, group: _DetectionGroup, scene: _Scene) -> None:
        """Confirm a track: give it an old or a new id, once enough is known of the person."""
        kind, remark = "track born", ""
        if track.former_id == UNTRACKED and self._somebody_absent(track):
            if group.stamp - track.support.first < self.patience:
                return
            verdict = self._reidentify(track, scene)
            if verdict.accepted:
                kind, remark = "person re-identified", f"; by {verdict}"
                self._restore(track, verdict.person, scene)
            else:
                track.stranger, remark = True, f"; not re-identified ({verdict})"
        track.id = next(self.ids) if track.former_id == UNTRACKED else track.former_id
        scene.admit(track)
        there = self._there(scene, group.stamp)
        self.crowd = max(self.crowd, there, key=len)
        self.events.note(
            group.stamp, kind, person=track.id, source=group.source,
            detail=f"seen by {', '.join(sorted(track.support.reports))}{remark}",
        )  # fmt: skip

    def _there(self, scene: _Scene, stamp: int) -> set[int]:
        """Return the numbers of the persons who are there."""
        return {person.number for person in scene.persons if self._is_there(person, stamp)}

    def _is_duplicate(self, track: _Track, stamp: int, scene: _Scene) -> bool:
        """Whether a tentative track is a second view of a person, nobody new.

        It lies on the person; or it is near one whom no camera has shown beside it: the cameras
        may disagree for a moment.
        """
        distances = self._distances(track, scene)
        if (distances < self.params.min_distance).any():
            return True
        if not self.params.merge_tracks or stamp - track.support.first >= _DOUBT:
            return False
        near = np.flatnonzero(distances < _DOUBTFUL * self.params.max_distance)
        return any(self._hides(scene.persons[i], track, stamp) for i in near.tolist())

    def _heard_besides(self, group: _DetectionGroup) -> list[str]:
        """Return the other cameras that send messages at this time."""
        return [
            source
            for source, stamp in self.heard.items()
            if source != group.source and group.stamp - stamp < _INSISTENCE
        ]

    def _hides(self, person: _Track, track: _Track, stamp: int) -> bool:
        """Whether a person is there whom no camera has shown beside a track."""
        return self._is_there(person, stamp) and person.number not in track.beside

    def _distances(self, track: _Track, scene: _Scene) -> Floats:
        """Mean distance, m, of a track from each person."""
        others = [person.row for person in scene.persons]
        positions, distances = self.bank.past.positions, np.empty((1, len(others)))
        mean_distances(positions[[track.row]], positions[others], distances)
        row: Floats = distances[0]
        return row

    def _merge_into_person(self, track: _Track, group: _DetectionGroup, scene: _Scene) -> None:
        """Merge a young person who is seen no more into the older one who was the same all along.

        Cameras that disagreed now agree, and no camera ever showed both.
        """
        if not (self.params.merge_tracks and track.confirmed):
            return
        if group.stamp - track.support.first >= _YOUNG or self._is_there(track, group.stamp):
            return
        for person, distance in zip(scene.persons, self._distances(track, scene), strict=True):
            is_older = person.support.first < track.support.first
            is_near = distance < _DOUBTFUL * self.params.max_distance
            if is_older and is_near and self._hides(person, track, group.stamp):
                self._remove(track, scene)
                self.crowd.discard(track.number)
                detail = f"was person {track.id}"
                self.events.note(group.stamp, "tracks merged", person=person.id, detail=detail)
                track.id = person.id  # also in messages that are held
                return

    def _is_there(self, track: _Track, stamp: int) -> bool:
        return stamp - track.seen < _NOW

    def _remove(self, track: _Track, scene: _Scene) -> None:
        """Delete a person's track, another one having taken its place."""
        scene.dismiss(track)
        self.tracks.remove(track)
        self.bank.forget(track.number)

    # Re-identification

    def _cues_of(self, track: _Track) -> PersonCues:
        past, row = self.bank.past, track.row
        lengths, counts = past.lengths[row].copy(), past.length_counts[row].copy()
        return PersonCues(track.id, track.seen, self._centre(track), lengths, counts)

    def _forget_absent(self, stamp: int) -> None:
        """Forget people who left too long ago."""
        longest = self.params.reidentify * 1e9
        if self.absent and stamp - self.absent[0].stamp > longest:
            self.absent = [old for old in self.absent if stamp - old.stamp <= longest]

    def _is_unseen_since(self, person: _Track, track: _Track) -> bool:
        """Whether a person was last seen before a track began, and not for a while.

        Where cameras disagree for a moment, the old track may also outlive the beginning of the
        one that goes on; then no camera shows both.
        """
        disagree = self.params.merge_tracks and person.number not in track.beside
        latest = track.support.first + (OVERLAP if disagree else 0)
        return person.seen < latest and not self._is_there(person, track.seen)

    def _somebody_absent(self, track: _Track) -> bool:
        """Whether a newcomer may be anybody known."""
        if not self.params.reidentify:
            return False
        return any(old.stamp < track.support.first for old in self.absent) or any(
            each.confirmed and self._is_unseen_since(each, track) for each in self.tracks
        )

    def _absent_before(self, track: _Track, scene: _Scene) -> list[PersonCues]:
        """Whoever left, or is unseen, since before a track began, oldest first."""
        left = [old for old in self.absent if old.stamp < track.support.first]
        unseen = [each for each in scene.persons if self._is_unseen_since(each, track)]
        return sorted([*left, *map(self._cues_of, unseen)], key=lambda old: old.stamp)

    def _reidentify(self, track: _Track, scene: _Scene) -> Verdict:
        """Weigh whether a newcomer is one of the absent people, with all other newcomers.

        Those who came before, with a new id, are newcomers still: whom they fit best by now is
        less probably this one.
        """
        others = [each for each in self._tentative() if each is not track]
        rivals = [each for each in others if each.support.confirms(each.seen, self.params)]
        rivals += [person for person in scene.persons if person.stranger]
        newcomers = [
            replace(
                self._cues_of(each),
                person=each.number,
                stamp=each.support.first,
                place=each.support.origin,
            )
            for each in [track, *rivals]
        ]
        missing = len(self.crowd) - len(self._there(scene, track.seen))
        absent = self._absent_before(track, scene)
        return reidentify(newcomers, absent, missing, self.limbs)[track.number]

    def _restore(self, track: _Track, person: int, scene: _Scene) -> None:
        """Give a newcomer the id of an absent person; what is known of the limbs is joined."""
        past, row = self.bank.past, track.row
        (old,) = [each for each in self._absent_before(track, scene) if each.person == person]
        counts = old.counts + past.length_counts[row]
        total = old.counts * old.lengths + past.length_counts[row] * past.lengths[row]
        past.lengths[row] = total / np.maximum(counts, 1.0)
        past.length_counts[row] = counts
        track.former_id = person
        self.absent = [each for each in self.absent if each.person != person]
        for each in [each for each in scene.persons if each.id == person]:
            self._remove(each, scene)

    def _ought_to_see(self, source: str, track: _Track, scene: _Scene) -> bool:
        if scene.centres is None:
            centres = [self._centre(person) for person in scene.persons]
            scene.centres = np.reshape(centres, (-1, 3))
        return self.coverage.sees(source, self._centre(track), scene.centres)

    def _centre(self, track: _Track) -> Floats:
        centre = np.empty(3)
        _centre(self.bank.past.positions, track.row, centre)
        return centre

    def _make_room(self, n_people: int) -> None:
        """Enlarge the scratch arrays: so many detections may start as many tracks."""
        size, n_tracks = self.work.pairs.cost.shape, len(self.tracks) + n_people
        if n_tracks > size[0] or n_people > size[1]:
            self.work = self._work(2 * n_tracks, 2 * n_people)

    # Displaced cameras

    def _leave_out_copies(self, group: _DetectionGroup) -> None:
        """Leave out what a displaced camera shows of people whom other cameras see elsewhere."""
        if group.source not in self.displaced or not group.unmatched:
            return
        others = self._others(group)
        poses = group.people.markers[..., POSITION]
        copies = self.displaced.copies(
            group.source, group.stamp, poses, self._places(others, group)
        )
        for j in group.unmatched:
            if copies[j]:
                group.reasons[j] = DISPLACED

    def _withdraw_copies(self, group: _DetectionGroup) -> None:
        """Delete this camera's own tracks that are of people whom others see elsewhere."""
        heard = self._heard_besides(group)
        lone = [
            (j, track)
            for j, track in enumerate(group.tracks)
            if track is not None and track.is_lone(group.source)
        ]
        if not (self.params.merge_tracks and lone and heard):
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
            for track in [each for each in self.tracks if each.number == number]:
                if track.is_lone(group.source):
                    self._withdraw(track, group)

    def _withdraw(self, track: _Track, group: _DetectionGroup) -> None:
        """Delete a copy, also in messages that are held."""
        if track.confirmed:
            self.events.note(group.stamp, "track withdrawn", person=track.id)
        self.crowd.discard(track.number)
        self.tracks.remove(track)
        self.bank.forget(track.number)
        track.id, track.is_copy = UNTRACKED, True
        for j in [j for j, each in enumerate(group.tracks) if each is track]:
            group.tracks[j], group.reasons[j] = None, DISPLACED

    def _others(self, group: _DetectionGroup) -> list[_Track]:
        """Return the people who are there, and whom not only this camera reports."""
        return [
            person
            for person in self._confirmed()
            if self._is_there(person, group.stamp) and not person.is_lone(group.source)
        ]

    def _places(self, tracks: list[_Track], group: _DetectionGroup) -> Floats:
        """(N, M, 3) where tracks are at the time of a message, m."""
        if tracks:
            self._predict(tracks, group)
        return self.work.predicted.positions[: len(tracks)].copy()

    # Many messages at once

    def _follow(self, block: Block, place: int) -> int:
        """Track messages in which everybody is certain, as update would; return how many."""
        if len(self.delay) or not all(track.certain for track in self.tracks):
            return 0
        stamps = block.stamps[place : self._next_stop(block, place)]
        tracks = self.tracks
        confirmed = kernels.ConfirmedTracks(
            np.array([track.row for track in tracks], np.int64),
            np.array([track.id for track in tracks], np.int32),
            np.array([track.seen for track in tracks], np.int64),
        )
        spans, n = block.rows[place:], len(block.people.ids)
        followed = kernels.Followed(np.empty(n, np.int64), np.empty((n, 3)))
        self._make_room(int((spans[:, 1] - spans[:, 0]).max()))
        done: int = kernels.follow(
            stamps, spans, block.people, self.bank.past, confirmed, self.slots, self.settings,
            self.work, followed,
        )  # fmt: skip
        for track, seen in zip(tracks, confirmed.last_seen.tolist(), strict=True):
            track.seen = seen
        for i, stamp in enumerate(stamps[:done].tolist(), place):
            source = block.sources[i]
            if self.coverage.is_due(source, stamp):
                rows = range(*block.rows[i].tolist())
                for row in sorted(rows, key=followed.match.__getitem__):
                    self.coverage.learn(source, followed.centres[row], stamp)
        return done

    def _next_stop(self, block: Block, place: int) -> int:
        """Place of the first message of a displaced camera, or that may delete a track."""
        seen = min((track.seen for track in self.tracks), default=None)
        if seen is None:
            return len(block)
        late = block.stamps[place:] - seen >= int(self.params.max_gap * 1e9)
        if self.displaced:
            late |= [source in self.displaced for source in block.sources[place:]]
        return place + int(late.argmax()) if late.any() else len(block)


def _is_sudden(track: _Track, group: _DetectionGroup) -> bool:
    """Note a camera's leap away from a track; return whether it has not insisted for long."""
    first, last = track.leaps.get(group.source, (group.stamp, group.stamp))
    if group.stamp - last > _INSISTENCE:
        first = group.stamp
    track.leaps[group.source] = first, group.stamp
    return group.stamp - first < _INSISTENCE


def _own_block(ready: Sequence[tuple[Part, int]]) -> Block:
    """Return a copy of messages, for ids and velocities to be written into."""
    block = join([part for part, _ in ready])
    block.people.ids.fill(UNTRACKED)
    return replace(block, log_times=np.array([now for _, now in ready], np.int64))
