"""Skeleton tracker: one id per person over all cameras (Hi-ROS 2023, section 3.1).

Each camera's message is compared with the tracks as they are predicted for its time, assigned,
and moves them. Beyond the paper: frames pass a small buffer that puts cameras' clocks in order; a
track must earn its id before it counts (see :class:`_Evidence`); frames are held for a moment so
that it has its id from its first detection on; a body with swapped sides is compared, and moves
its track, with the sides swapped back.
"""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import Field

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, Part, frames_of, join
from hiros_mcap.kernels import tracking as kernels
from hiros_mcap.params import Params
from hiros_mcap.skeletons import UNTRACKED, Flags, Floats, Frame, Ints, SkeletonModel, Stamps
from hiros_mcap.stages.bank import ArrayBank
from hiros_mcap.stages.coverage import Coverage

Indices = npt.NDArray[np.intp]

_REASONS = {kernels.USABLE: "", kernels.EMPTY: "no markers", kernels.DOUBTFUL: "low confidence"}
_AT_ONCE = 64  # messages that one call follows at most: after each stop the rest is looked at anew
_MARGIN = 100_000_000  # ns by which frames are late that are not late


class TrackParams(Params):
    """Parameters of the tracker."""

    max_distance: float = Field(
        0.6,
        gt=0,
        description="Gate, m: a detection whose markers are on average farther than this from a "
        "track is not of that person (section 3.1.2). Views of one person differ by 0.05 to "
        "0.35 m; 0.8 m, a workable launch value of the published code, also swallows a "
        "neighbour.",
    )
    min_distance: float = Field(
        0.25,
        ge=0,
        description="m: a body this near to a tracked person is a second detection of that person "
        "and starts no track (0.1: published code).",
    )
    max_gap: float = Field(
        1.5,
        gt=0,
        description="t_m, s: a person that nobody sees for longer is forgotten (section 3.1.2).",
    )
    orientation_weight: float = Field(
        0.05,
        ge=0,
        description="m per rad: what eq 9 weighs against eq 8 in eq 6. The paper adds metres and "
        "radians one to one, so that a turned-round detection outweighs 3 m of distance.",
    )
    velocity_weight: float = Field(
        0.05, ge=0, description="w_v of eq 8, s, used where detections carry velocities."
    )
    angular_velocity_weight: float = Field(
        0.0, ge=0, description="w_omega of eq 9, s, used where detections carry velocities."
    )
    velocity_decay: float = Field(
        0.25, ge=0, le=1, description="gamma of eq 11; 0 = speed has no say (0.25: published code)."
    )
    exponent: float = Field(1.0, ge=1, description="alpha of eq 8 and 9 (1: published code).")
    weight_by_confidence: bool = Field(True, description="kappa of eq 11.")
    weight_by_velocity: bool = Field(True, description="w_v of eq 11.")
    flip_aware: bool = Field(
        True,
        description="Compare detections with left and right swapped, too; needs marker names.",
    )
    min_skeleton_confidence: float = Field(
        0.0, ge=0, le=1, description="Detections below are not tracked."
    )
    min_marker_confidence: float = Field(
        0.0, ge=0, le=1, description="Markers and links below count as absent."
    )
    min_markers: int = Field(4, ge=1, description="A detection with fewer markers starts no track.")
    tentative_gap: float = Field(
        0.5, gt=0, description="s: as max_gap, for a body that is not a person yet."
    )
    reorder: float = Field(
        1.0,
        ge=0,
        description="s: frames wait at most this long for older ones of slower cameras; later "
        "ones are still tracked, at their own time. Recorders stall for up to a second; a live "
        "system takes 0.1.",
    )
    lookahead: float = Field(
        1.0,
        ge=0,
        description="s: a frame with somebody who may or may not be a person is held this long, "
        "so that who is confirmed meanwhile has the id from the first detection. 0 = a live system "
        "without delay.",
    )
    confirm_detections: int = Field(
        5, ge=1, description="Detections, by two cameras or more, that make a body a person."
    )
    confirm_seconds: float = Field(
        0.5,
        ge=0,
        description="s during which a body that only one camera reports must last to count, "
        "provided that no other camera ought to see it.",
    )
    contradiction: float = Field(
        0.5,
        ge=0,
        description="A body that one camera reports, while others look there and see nobody, is "
        "doubted once they have missed it this many times per report.",
    )
    min_motion: float = Field(
        0.3,
        ge=0,
        description="m: a doubted body counts after all when it has walked this far; a coat on a "
        "stand never does.",
    )
    horizon: float = Field(
        0.2, gt=0, description="s: constant velocity is trusted this long (eq 7), then standstill."
    )
    position_noise: float = Field(
        0.04, gt=0, description="m: SD of one camera's marker, for velocities (57 mm raw error)."
    )
    jerk: float = Field(
        150.0, gt=0, description="m/s3/sqrt(Hz): how fast markers' accelerations may change."
    )
    orientation_noise: float = Field(0.15, gt=0, description="rad: SD of one camera's link.")
    angular_jerk: float = Field(500.0, gt=0, description="rad/s3/sqrt(Hz), as jerk.")
    innovation_gate: float = Field(
        3.0, gt=0, description="SDs from which a marker counts less in its track's motion."
    )
    max_speed: float = Field(
        12.0, gt=0, description="m/s: no marker of a person is faster (a thrown hand reaches 10)."
    )


@dataclass(slots=True, eq=False)
class _Evidence:
    """What speaks for and against a body being a person.

    For: a report by a camera. Against: a message of another camera that looks at that place,
    with nobody in between, and reports nobody. Two cameras that agree confirm at once (after
    ``confirm_detections``); one camera confirms by lasting, unless contradicted; a contradicted
    body has to walk.
    """

    first: int
    birthplace: Floats
    reports: dict[str, int] = field(default_factory=dict)
    misses: int = 0
    travelled: float = 0.0

    def confirms(self, stamp: int, params: TrackParams) -> bool:
        """Whether the evidence is enough for a body that was last seen at ``stamp``."""
        total = sum(self.reports.values())
        if total < params.confirm_detections:
            return False
        strongest = max(self.reports.values())
        if total - strongest >= min(2, params.confirm_detections - 1) > 0:
            return True
        lasted = (stamp - self.first) * 1e-9 >= params.confirm_seconds
        return lasted and (not self.doubted(params) or self.travelled > params.min_motion)

    def doubted(self, params: TrackParams) -> bool:
        """Whether only one camera ever saw the body while others ought to."""
        return len(self.reports) < 2 and self.misses > params.contradiction * sum(
            self.reports.values()
        )


@dataclass(slots=True, eq=False)
class _Track:
    """A person, or what may become one."""

    row: int
    seen: int
    evidence: _Evidence
    person: int = UNTRACKED
    former: int = UNTRACKED
    """The id before it was doubted; it gets it back if it is a person after all."""

    @property
    def settled(self) -> bool:
        """Whether it is a person for good: nobody doubts whom two cameras saw."""
        return self.person != UNTRACKED and len(self.evidence.reports) > 1


class _Bank(ArrayBank):
    """Motion of all tracks."""

    ARRAYS = ("motion", "spread", "turn", "spin", "turn_spread", "seen", "turn_seen")

    def __init__(self, model: SkeletonModel) -> None:
        super().__init__()
        m, n = model.n_markers, model.n_links
        self.motion: Floats = np.zeros((0, m, 3, 3))
        self.spread: Floats = np.zeros((0, m, 6))
        self.turn: Floats = np.zeros((0, n, 4))
        self.spin: Floats = np.zeros((0, n, 2, 3))
        self.turn_spread: Floats = np.zeros((0, n, 6))
        self.seen: Stamps = np.zeros((0, m), np.int64)
        self.turn_seen: Stamps = np.zeros((0, n), np.int64)

    def take(self) -> int:
        """Return a row for a person whom nobody has seen yet."""
        row = super().take()
        self.seen[row] = self.turn_seen[row] = 0
        return row


class _Passage:
    """Messages on their way through the tracker, as its own copy, which gets ids and velocities."""

    def __init__(self, ready: Sequence[tuple[Part, int]]) -> None:
        block = join([part for part, _ in ready])
        block.people.ids.fill(UNTRACKED)
        self.block = replace(block, log_times=np.array([now for _, now in ready], np.int64))
        self.stamps, self.log_times = block.stamps.tolist(), [now for _, now in ready]
        self.match, self.fault = np.empty((2, len(block.people.ids)), np.int64)
        self.sizes = (block.rows[:, 1] - block.rows[:, 0]).tolist()
        self.most = max(self.sizes)
        """People of the largest message."""
        self.teaches = np.zeros(len(ready), np.bool_)
        """Which messages tell what their camera looks at."""
        self.centres = np.empty((len(block.people.ids), 3))


_Ready = tuple[_Passage, int, int]
"""A message that need not be held any more: where it is, its place there, its log time."""


@dataclass(slots=True, eq=False)
class _Held:
    """A message that waits for its people to be confirmed."""

    passage: _Passage
    place: int
    log_time: int
    stamp: int
    source: str
    begin: int
    end: int
    """Rows of its people."""
    tracks: list[_Track | None]
    reasons: list[str]
    """Why a detection is of nobody; "" where it is of a track."""

    @property
    def settled(self) -> bool:
        """Whether no evidence that is still to come can change an id."""
        return all(body is None or body.settled for body in self.tracks)

    @property
    def markers(self) -> Floats:
        """States with the tracks' velocities."""
        return self.passage.block.people.markers[self.begin : self.end]

    @property
    def links(self) -> Floats:
        """As markers."""
        return self.passage.block.people.links[self.begin : self.end]

    @property
    def marker_confidences(self) -> Floats:
        """As the detector gave them."""
        return self.passage.block.people.marker_confidences[self.begin : self.end]

    @property
    def link_confidences(self) -> Floats:
        """As the detector gave them."""
        return self.passage.block.people.link_confidences[self.begin : self.end]

    def give(self, bodies: list[_Track | None]) -> None:
        """Note of which track each person is, and that it was seen."""
        for j, body in enumerate(bodies):
            if body is not None:
                self.tracks[j] = body
                body.seen = max(body.seen, self.stamp)


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
    cameras : source -> (3,) position of the camera in the fixed frame, m. With it, a body that one
        camera reports and others ought to see but do not is doubted.

    Yields
    ------
    The same frames in order of their stamps, with ids (-1 = of nobody that counts) and with the
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
        if ready:
            yield from _grouped(tracker.take(_Passage(ready)))
    if ready := order.rest():
        yield from _grouped(tracker.take(_Passage(ready)))
    yield from _grouped(tracker.finish())


def _grouped(done: Iterable[_Ready]) -> Iterator[Block]:
    """Gather neighbours that lie in common arrays into blocks."""
    for passage, group in itertools.groupby(done, key=itemgetter(0)):
        _, places, log_times = zip(*group, strict=True)
        yield passage.block.select(places, log_times)


T = TypeVar("T")


class TimeOrder(Generic[T]):
    """Sorts messages by (stamp, source), holding each ``delay`` seconds at most for older ones.

    A message goes on when every camera has sent a younger one (a camera that has been silent for
    ``delay`` is not waited for), and no sooner than the latest message so far would have wanted.
    One that is later still goes on at once: it is used, out of order, and not dropped. Log times
    become those of the arrivals that let the messages go, so they never run backwards.
    """

    def __init__(self, delay: float) -> None:
        self._waiting: list[tuple[int, str, int, T]] = []
        self._newest_of: dict[str, int] = {}
        self._newest = self._now = self._begin = 0
        self._patience = round(delay * 1e9)
        self._margin = min(self._patience, _MARGIN)
        self._count = itertools.count()

    def push(self, stamp: int, source: str, log_time: int, item: T) -> list[tuple[T, int]]:
        """Take a message; return those that go on now, with their log times."""
        waiting, newest_of, patience = self._waiting, self._newest_of, self._patience
        heapq.heappush(waiting, (stamp, source, next(self._count), item))
        newest = self._newest = max(self._newest, stamp)
        now = self._now = max(self._now, log_time)
        self._begin = self._begin or stamp
        self._margin = max(self._margin, min(newest - stamp, patience))
        newest_of[source] = max(newest_of.get(source, 0), stamp)
        horizon, everybody = newest - patience, (newest, "")
        if self._begin >= horizon:  # there may be cameras that have not sent yet
            everybody = (horizon, source)
        else:
            for name, last in newest_of.items():
                if last > horizon and (last, name) < everybody:
                    everybody = (last, name)
        recent = newest - self._margin
        ready = []
        while waiting:
            first = waiting[0]
            if first[0] > horizon and (first[0] > recent or first[:2] > everybody):
                break
            ready.append((heapq.heappop(waiting)[3], now))
        return ready

    def rest(self) -> list[tuple[T, int]]:
        """Return what is left, now that nothing more comes."""
        return [(heapq.heappop(self._waiting)[3], self._now) for _ in range(len(self._waiting))]


def in_time_order(frames: Iterable[Frame], delay: float) -> Iterator[Frame]:
    """Sort frames as :class:`TimeOrder` does."""
    order: TimeOrder[Frame] = TimeOrder(delay)
    for frame in frames:
        for ready, now in order.push(frame.stamp, frame.source, frame.log_time, frame):
            yield ready.replace(log_time=now)
    for ready, now in order.rest():
        yield ready.replace(log_time=now)


class _Tracker:
    """The tracks of a run, the paper's loop, and the messages that wait for it to be sure."""

    def __init__(
        self,
        model: SkeletonModel,
        params: TrackParams,
        events: Events,
        cameras: Mapping[str, Floats],
    ) -> None:
        self.params = params
        self.events = events
        self.bank = _Bank(model)
        self.coverage = Coverage(cameras)
        self.tracks: list[_Track] = []
        self.known: list[_Track] | None = None
        self.known_rows: Stamps = np.empty(0, np.int64)
        """The tracks that are persons, their rows in the bank and ids; None = to be looked up."""
        self.known_ids: Ints = np.empty(0, np.int32)
        self.calm = False
        """Whether every track is a person for good."""
        self.expiry = 0
        """No track is to be forgotten before this stamp."""
        self.people = itertools.count()
        self.held: deque[_Held] = deque()
        self.patience = round(params.lookahead * 1e9)
        symmetry = symmetry_of(model)
        self.flip_aware = params.flip_aware and symmetry.known
        self.mirror: Ints = symmetry.mirror
        self.association = np.array([
            params.horizon, params.max_distance, params.orientation_weight,
            params.weight_by_confidence, params.weight_by_velocity, params.velocity_decay,
            params.velocity_weight, params.angular_velocity_weight, params.exponent,
            self.flip_aware, params.min_distance,
        ], np.float64)  # fmt: skip
        self.least = np.array([params.min_skeleton_confidence, params.min_marker_confidence])
        self.dynamics = np.array([
            params.horizon, params.position_noise, params.jerk, params.orientation_noise,
            params.angular_jerk, params.innovation_gate, params.max_speed,
        ])  # fmt: skip

    def take(self, passage: _Passage) -> Iterator[_Ready]:
        """Associate, update, add and remove (the three parts of section 3.1.2).

        Yields the messages, of this passage or an earlier one, that need not be held any more.
        """
        stamps, at = passage.stamps, 0
        while at < len(stamps):
            if stamps[at] >= self.expiry:
                self._forget(stamps[at])
            if self.known is None:
                self._look_up()
            plain = self.calm and not self.held
            stop = min(len(stamps), at + (_AT_ONCE if plain else 1))
            n, stopped, gap = self._follow(passage, at, stop)
            special = stopped or not plain
            if special:
                n -= 1
            self._learn(passage, range(at, at + n))
            for place in range(at, at + n):
                yield passage, place, passage.log_times[place]
            at += n
            if special:
                yield from self._ponder(passage, at, gap)
                at += 1

    def finish(self) -> Iterator[_Ready]:
        """Yield the messages that are still held, now that nothing more comes."""
        last = self.held[-1].log_time if self.held else 0
        while self.held:
            yield self._release(self.held.popleft(), last)

    def _look_up(self) -> None:
        """Find out anew which tracks are persons."""
        self.known = [t for t in self.tracks if t.person != UNTRACKED]
        self.known_rows = np.array([t.row for t in self.known], np.int64)
        self.known_ids = np.array([t.person for t in self.known], np.int32)
        self.calm = all(t.settled for t in self.tracks)

    def _follow(self, passage: _Passage, at: int, stop: int) -> tuple[int, bool, Floats]:
        """Give people of messages to the tracks of persons.

        Returns how many messages were taken over, whether the last of them needs more than that,
        and the kernel's gaps of it.
        """
        bank, block, people = self.bank, passage.block, passage.block.people
        known = self.known or []
        passage.teaches[at:stop] = self.coverage.lessons(
            block.sources[at:stop], passage.stamps[at:stop], passage.sizes[at:stop]
        )
        latest = np.zeros(len(known), np.int64)
        gap = np.empty(len(known) * passage.most)
        n, stopped = kernels.follow(
            block.stamps[at:stop], block.rows[at:stop], passage.teaches[at:stop], self.expiry,
            self.known_rows, self.known_ids, bank.motion, bank.spread, bank.seen, bank.turn,
            bank.spin, bank.turn_spread, bank.turn_seen, people.confidences, people.markers,
            people.marker_confidences, people.links, people.link_confidences, self.mirror,
            self.association, self.dynamics, self.least, people.ids, latest, passage.centres,
            gap, passage.match, passage.fault,
        )  # fmt: skip
        for body, stamp in zip(known, latest.tolist(), strict=True):
            body.seen = max(body.seen, stamp)
        return n, bool(stopped), gap

    def _learn(self, passage: _Passage, places: range) -> None:
        """Learn what cameras look at from messages of which everybody is a person."""
        for i in places:
            if passage.teaches[i]:
                begin, end = passage.block.rows[i].tolist()
                source, stamp = passage.block.sources[i], passage.stamps[i]
                for row in sorted(range(begin, end), key=passage.match.__getitem__):
                    self.coverage.learn(source, passage.centres[row], stamp)

    def _ponder(self, passage: _Passage, place: int, gap: Floats) -> Iterator[_Ready]:
        """Do what is to be done about people who may be somebody new; let go who is settled."""
        known = self.known or []
        begin, end = passage.block.rows[place].tolist()
        found = passage.match[begin:end].tolist()
        held = _Held(
            passage,
            place,
            passage.log_times[place],
            passage.stamps[place],
            passage.block.sources[place],
            begin,
            end,
            [known[i] if i >= 0 else None for i in found],
            [_REASONS[code] for code in passage.fault[begin:end].tolist()],
        )
        rest = [j for j, body in enumerate(held.tracks) if body is None and not held.reasons[j]]
        if rest:
            gaps = gap[: len(known) * len(found)].reshape(len(known), len(found))
            tentative = [t for t in self.tracks if t.person == UNTRACKED]
            rest = self._drop_second_bodies(held, known, gaps, rest)
            self._match(held, tentative, rest)
            self._add(held, [j for j in rest if held.tracks[j] is None])
        self._judge(held)
        self.held.append(held)
        while self.held and (
            self.held[0].stamp + self.patience <= held.stamp or self.held[0].settled
        ):
            yield self._release(self.held.popleft(), held.log_time)

    def _release(self, held: _Held, log_time: int) -> _Ready:
        """Write the ids that the tracks have by now."""
        ids = [UNTRACKED if body is None else body.person for body in held.tracks]
        held.passage.block.people.ids[held.begin : held.end] = ids
        for person, reason in zip(ids, held.reasons, strict=True):
            if person == UNTRACKED:
                self.events.count(reason or "not confirmed", held.source)
        return held.passage, held.place, max(log_time, held.log_time)

    def _match(self, held: _Held, tracks: list[_Track], people: list[int]) -> None:
        """Associate ``people`` with ``tracks`` (eq 6-11, Munkres) and update."""
        bank, n = self.bank, len(held.tracks)
        if not tracks or not people:
            return
        gap = np.empty((len(tracks), n))
        rows = np.array([t.row for t in tracks], np.int64)
        wanted = np.zeros(n, np.bool_)
        wanted[people] = True
        match = np.empty(n, np.int64)
        flipped = np.empty(n, np.bool_)
        kernels.associate(
            held.stamp, rows, bank.motion, bank.seen, bank.turn, bank.spin, bank.turn_seen,
            held.markers, held.marker_confidences, held.links, held.link_confidences,
            self.mirror, self.association, wanted, gap, match, flipped,
        )  # fmt: skip
        self._update(held, [tracks[i] if i >= 0 else None for i in match.tolist()], flipped)

    def _update(self, held: _Held, bodies: list[_Track | None], flipped: Flags) -> None:
        """Give people to their tracks, move these, and fill the people's velocities."""
        bank = self.bank
        row_of = np.array([UNTRACKED if t is None else t.row for t in bodies], np.int64)
        kernels.update(
            held.stamp, row_of, bank.motion, bank.spread, bank.seen, bank.turn, bank.spin,
            bank.turn_spread, bank.turn_seen, held.markers, held.marker_confidences,
            held.links, flipped, self.mirror, self.dynamics,
        )  # fmt: skip
        held.give(bodies)

    def _drop_second_bodies(
        self, held: _Held, known: list[_Track], gap: Floats, rest: list[int]
    ) -> list[int]:
        """Leave out detections on top of a person whom this camera has reported already."""
        left = []
        for j in rest:
            near = [t for i, t in enumerate(known) if gap[i, j] < self.params.min_distance]
            if any(t in held.tracks for t in near):
                held.reasons[j] = "second body"
            else:
                left.append(j)
        return left

    def _add(self, held: _Held, people: list[int]) -> None:
        """Start tracks of bodies that are of nobody known."""
        stamp = held.stamp
        born: list[_Track | None] = [None] * len(held.tracks)
        for j in people:
            here = held.markers[j, :, :3]
            if np.count_nonzero(~np.isnan(here[:, 0])) < self.params.min_markers:
                held.reasons[j] = "too few markers"
                continue
            body = _Track(self.bank.take(), stamp, _Evidence(stamp, np.nanmean(here, axis=0)))
            self.tracks.append(body)
            self._changed()
            born[j] = body
        self._update(held, born, np.zeros(len(born), np.bool_))

    def _judge(self, held: _Held) -> None:
        """Weigh the evidence that this message adds to bodies that are not people yet."""
        source, found = held.source, held.tracks
        teaches = self.coverage.is_due(source, held.stamp)
        if self.calm and not teaches:
            return
        for body in self.tracks:
            if body.settled:
                if teaches and body in found:
                    self.coverage.learn(source, self._centre(body), held.stamp)
                continue
            evidence = body.evidence
            if body in found:
                evidence.reports[source] = evidence.reports.get(source, 0) + 1
                step = self._centre(body) - evidence.birthplace
                evidence.travelled = max(evidence.travelled, float(np.linalg.norm(step)))
            elif source not in evidence.reports and self._ought_to_see(source, body):
                evidence.misses += 1
            self._settle(body, held)
            self._changed()

    def _changed(self) -> None:
        """Say that the tracks are others, or what is known of them."""
        self.known, self.calm, self.expiry = None, False, 0

    def _settle(self, body: _Track, held: _Held) -> None:
        """Make a body a person, or take that back, as the evidence now says."""
        confirmed = body.evidence.confirms(body.seen, self.params)
        if body.person == UNTRACKED and confirmed and not self._shadows(body):
            body.person = next(self.people) if body.former == UNTRACKED else body.former
            self.events.note(
                held.stamp, "track born", person=body.person, source=held.source,
                detail=f"seen by {', '.join(sorted(body.evidence.reports))}",
            )  # fmt: skip
        elif body.person != UNTRACKED and self._refuted(body):
            self.events.note(held.stamp, "track doubted", person=body.person)
            body.former, body.person = body.person, UNTRACKED

    def _refuted(self, body: _Track) -> bool:
        evidence = body.evidence
        return evidence.doubted(self.params) and evidence.travelled <= self.params.min_motion

    def _shadows(self, body: _Track) -> bool:
        """Whether the body lies on a person: a second view of that person, not somebody new."""
        here = self.bank.motion[body.row, :, 0]
        for other in self.tracks:
            if other.person != UNTRACKED and other is not body:
                there = self.bank.motion[other.row, :, 0]
                common = (self.bank.seen[body.row] > 0) & (self.bank.seen[other.row] > 0)
                if not common.any():
                    continue
                distance = np.linalg.norm(here[common] - there[common], axis=1).mean()
                if distance < self.params.min_distance:
                    return True
        return False

    def _ought_to_see(self, source: str, body: _Track) -> bool:
        others = [self._centre(t) for t in self.tracks if t is not body and t.person != UNTRACKED]
        return self.coverage.sees(source, self._centre(body), others)

    def _centre(self, body: _Track) -> Floats:
        centre = np.empty(3)
        kernels.centre(self.bank.motion, self.bank.seen, body.row, centre)
        return centre

    def _forget(self, stamp: int) -> None:
        """Remove tracks that nobody saw for t_m; bodies that were nobody yet go sooner."""
        kept = []
        self.expiry = stamp + round(self.params.max_gap * 1e9)
        for body in self.tracks:
            person = body.person != UNTRACKED
            gap = self.params.max_gap if person else self.params.tentative_gap
            if (stamp - body.seen) * 1e-9 <= gap:
                kept.append(body)
                self.expiry = min(self.expiry, body.seen + int(gap * 1e9))
                continue
            self.bank.give_back(body.row)
            if person:
                self.events.note(body.seen, "track lost", person=body.person)
        if len(kept) < len(self.tracks):
            self.tracks = kept
            self.known = None
