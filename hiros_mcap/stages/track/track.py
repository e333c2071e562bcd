"""Skeleton tracker: one id per person over all cameras (Hi-ROS 2023, section 3.1).

:meth:`_Tracker.update` is the paper's algorithm for one camera's message: predict the tracks,
compare them with the detections, assign, correct the tracks, start and delete tracks.

Beyond the paper:

- Messages are first put in order of their times (:class:`TimeOrder`).
- A new track is tentative and has no id. Its support confirms it
  (support.py). A message that shows somebody tentative is held for a moment,
  so that a confirmed person has the id from the first detection on (:class:`Delay`).
- Two tracks of one person are merged. Who comes back gets the old id if it is probable
  (:mod:`~hiros_mcap.stages.track.identity`).
- A detection with left and right swapped is compared, and corrects its track, swapped back.
- A detection that leaps away from its track is left out: a detector distorts people who are about
  to be hidden. The gate of an unseen track grows.
- A camera that shows people elsewhere than the others do brings nobody new
  (:mod:`~hiros_mcap.stages.track.copies`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from operator import itemgetter

import numpy as np

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.kernels.array_types import settings_of
from hiros_mcap.skeletons import POSITION, UNTRACKED, Floats, SkeletonModel, Stamps
from hiros_mcap.stages.delay import Delay
from hiros_mcap.stages.time_order import in_time_order
from hiros_mcap.stages.track import tracking as kernels
from hiros_mcap.stages.track.copies import Copies
from hiros_mcap.stages.track.displaced import DISPLACED
from hiros_mcap.stages.track.identity import Identities
from hiros_mcap.stages.track.support import Confirmation
from hiros_mcap.stages.track.track_params import TrackParams
from hiros_mcap.stages.track.tracked_people import (
    INSISTENCE,
    DetectionGroup,
    PersonTrack,
    Support,
    TrackedPeople,
)

_TENTATIVE_GAP = 0.5  # s; a tentative track that no camera has seen for longer is deleted
_LEAP = "leap"
_REASONS = {
    kernels.USABLE: "",
    kernels.NO_MARKERS: "no markers",
    kernels.LOW_CONFIDENCE: "low confidence",
}

# The steps of one message take arrays that the tracker itself has made.
_screen, _predict = kernels.screen.raw, kernels.predict.raw
_associate, _correct = kernels.associate.raw, kernels.correct.raw

_Message = tuple[Block, int, int]
"""A message that is done: its block, its place there, its log time, ns."""


def track_blocks(
    blocks: Iterable[Block], model: SkeletonModel, params: TrackParams | None = None,
    events: Events | None = None, cameras: Mapping[str, Floats] | None = None,
) -> Iterator[Block]:  # fmt: skip
    """Give every detection the id of its person (section 3.1.2).

    Parameters
    ----------
    blocks : detections of all cameras in the fixed frame, roughly in time order.
    model : names and hierarchy of the skeleton.
    params, events : parameters; where counts and events go.
    cameras : source -> (3,) position of the camera in the fixed frame, m. With it, other cameras
        can contradict a track that only one of them reports.

    Yields
    ------
    The same frames in order of their stamps, with ids (-1 = of nobody who counts) and with the
    tracks' velocities and accelerations where the detector gave none.
    """
    params = params or TrackParams()
    tracker = _Tracker(model, params, events or Events(), cameras or {})
    for block in in_time_order(blocks, params.reorder):
        block.people.ids.fill(UNTRACKED)
        yield from _gather(tracker.take(block))
    yield from _gather(tracker.finish())


def _gather(messages: Iterable[_Message]) -> Iterator[Block]:
    """Make a block of neighbours that lie in the same arrays."""
    for block, group in itertools.groupby(messages, key=itemgetter(0)):
        _, places, log_times = zip(*group, strict=True)
        yield block.select(places).logged_at(log_times)


class _Tracker:
    """The tracks, and the messages whose ids are not decided yet."""

    def __init__(
        self, model: SkeletonModel, params: TrackParams, events: Events,
        cameras: Mapping[str, Floats],
    ) -> None:  # fmt: skip
        self._params, self._events = params, events
        symmetry = symmetry_of(model)
        same = np.arange(model.n_markers, dtype=np.int32)
        ends = model.links if params.reidentify > 0 else np.empty((0, 2), np.int32)
        self._slots = kernels.SlotOrders(same, symmetry.mirror, np.ascontiguousarray(ends))
        flip_aware = params.flip_aware and symmetry.has_sides
        self._settings = settings_of(kernels.TrackSettings, params, flip_aware=flip_aware)
        self._allocate = partial(
            kernels.TrackWork.allocate, n_markers=model.n_markers, n_links=model.n_links
        )
        self._work = self._allocate(8, 8)
        self._delay: Delay[DetectionGroup] = Delay(params.lookahead)
        self._people = TrackedPeople(model)
        link_mirror = symmetry.link_mirror[: len(ends)]
        self._identities = Identities(self._people, params, events, ends, link_mirror)
        self._support = Confirmation(self._people, self._identities, params, events, cameras)
        self._copies = Copies(
            self._people, self._identities, self._places, symmetry.mirror, events,
            withdraws=params.merge_tracks,
        )  # fmt: skip

    def update(self, group: DetectionGroup) -> Iterator[DetectionGroup]:
        """Track the detections of one message (section 3.1.2); yield messages that are decided."""
        self._people.heard[group.source] = group.stamp
        self._delete_unseen(group.stamp)  # after t_m
        self._screen(group)  # by confidence
        self._copies.leave_out(group)  # of a displaced camera
        self._match(self._people.confirmed(), group)  # persons come first
        self._match(self._people.tentative(), group)
        self._start(group)  # tentative tracks
        self._copies.withdraw(group)
        self._support.confirm(group)  # or withdraw the id
        self._delay.push(group.stamp, group)
        return self._delay.release(group.stamp, lambda held: held.decided)

    def _match(self, tracks: list[PersonTrack], group: DetectionGroup) -> None:
        """Match the detections that are left with persons, or with tentative tracks."""
        if not tracks or not group.unmatched:
            return
        wanted, rows = self._work.pairs.wanted, _rows(tracks)
        wanted.fill(False)
        wanted[group.unmatched] = True
        # eq 7: predict; eq 6 and 8 to 11: compare; Munkres: assign
        _associate(
            group.stamp, rows, group.people, self._people.bank.past, self._slots, self._settings,
            self._work,
        )  # fmt: skip
        self._give(tracks, group)
        self._correct(rows, group)  # Kalman filter
        if tracks[0].confirmed:
            self._drop_duplicates(tracks, group)

    def take(self, block: Block) -> Iterator[_Message]:
        """Track messages, and write into them; yield those that are decided."""
        for place, log_time in enumerate(block.log_times.tolist()):
            for group in self.update(DetectionGroup.of(block, place)):
                yield self._finish(group, log_time)

    def finish(self) -> Iterator[_Message]:
        """Yield the messages that are still held, now that nothing more comes."""
        held = list(self._delay.rest())
        for group in held:
            yield self._finish(group, int(held[-1].block.log_times[held[-1].place]))

    def _finish(self, group: DetectionGroup, log_time: int) -> _Message:
        """Write the ids that the tracks have by now."""
        for j, track in enumerate(group.tracks):
            person = UNTRACKED if track is None else track.id
            group.people.ids[j] = person
            if person == UNTRACKED:
                reason = DISPLACED if track is not None and track.is_copy else "not confirmed"
                self._events.count(group.reasons[j] or reason, group.source)
        return group.block, group.place, max(log_time, int(group.block.log_times[group.place]))

    # The steps of update

    def _delete_unseen(self, stamp: int) -> None:
        """Delete tracks that nobody saw for t_m; tentative ones sooner."""
        self._identities.forget_absent(stamp)
        for track in list(self._people.tracks):
            gap = self._params.max_gap if track.confirmed else _TENTATIVE_GAP
            if (stamp - track.seen) * 1e-9 > gap:
                if track.confirmed:
                    self._events.note(track.seen, "track lost", person=track.id)
                    self._identities.leave(track)
                self._people.remove(track)

    def _screen(self, group: DetectionGroup) -> None:
        """Leave out markers and detections of too little confidence."""
        self._make_room(len(group.tracks))
        params, faults = self._params, self._work.faults
        _screen(group.people, params.min_marker_confidence, params.min_skeleton_confidence, faults)
        group.reasons[:] = [_REASONS[fault] for fault in faults[: len(group.tracks)].tolist()]

    def _give(self, tracks: list[PersonTrack], group: DetectionGroup) -> None:
        """Note the tracks that detections were given; leave out detections that leap."""
        pairs = self._work.pairs
        for j, i in enumerate(pairs.match[: len(group.tracks)].tolist()):
            if i < 0:
                continue
            if pairs.broken[j] and tracks[i].confirmed and _is_sudden(tracks[i], group):
                pairs.match[j] = -1
                group.reasons[j] = _LEAP
            else:
                group.give(j, tracks[i])

    def _correct(self, rows: Stamps, group: DetectionGroup) -> None:
        """Correct the tracks by their detections; write their velocities into the message."""
        _correct(
            group.stamp, rows, self._work.pairs, group.people, self._people.bank.past, self._slots,
            self._settings,
        )  # fmt: skip

    def _drop_duplicates(self, tracks: list[PersonTrack], group: DetectionGroup) -> None:
        """Leave out detections on top of a person whom this message already shows."""
        present = set(group.tracks)
        shown = [i for i, track in enumerate(tracks) if track.confirmed and track in present]
        for j in group.unmatched:
            if (self._work.pairs.distances[shown, j] < self._params.min_distance).any():
                group.reasons[j] = "duplicate"

    def _start(self, group: DetectionGroup) -> None:
        """Start a tentative track for each detection that is of nobody known."""
        unmatched, pairs = group.unmatched, self._work.pairs
        if not unmatched:
            return
        new: list[PersonTrack] = []
        pairs.match.fill(UNTRACKED)
        here = group.people.markers[unmatched, :, POSITION]
        enough = np.count_nonzero(~np.isnan(here[..., 0]), axis=1) >= self._params.min_markers
        origins = np.nanmean(here, axis=1)
        for j, origin, is_whole in zip(unmatched, origins, enough.tolist(), strict=True):
            if not is_whole:
                group.reasons[j] = "too few markers"
                continue
            support = Support(group.stamp, origin)
            pairs.match[j] = len(new)
            new.append(self._people.start(group.stamp, support))
            group.give(j, new[-1])
        if new:
            pairs.mirrored.fill(False)
            self._correct(_rows(new), group)

    def _places(self, tracks: list[PersonTrack], group: DetectionGroup) -> Floats:
        """(N, M, 3) where tracks are at the time of a message, m."""
        predicted = self._work.predicted
        if tracks:
            past = self._people.bank.past
            _predict(group.stamp, _rows(tracks), past, self._settings, predicted)
        return predicted.positions[: len(tracks)].copy()

    def _make_room(self, n_people: int) -> None:
        """Enlarge the scratch arrays: so many detections may start as many tracks."""
        size, n_tracks = self._work.pairs.cost.shape, len(self._people.tracks) + n_people
        if n_tracks > size[0] or n_people > size[1]:
            self._work = self._allocate(2 * n_tracks, 2 * n_people)


def _rows(tracks: Sequence[PersonTrack]) -> Stamps:
    """(T,) Rows of tracks in the bank."""
    return np.array([track.row for track in tracks], np.int64)


def _is_sudden(track: PersonTrack, group: DetectionGroup) -> bool:
    """Note a camera's leap away from a track; return whether it has not insisted for long."""
    first, last = track.leaps.get(group.source, (group.stamp, group.stamp))
    if group.stamp - last > INSISTENCE:
        first = group.stamp
    track.leaps[group.source] = first, group.stamp
    return group.stamp - first < INSISTENCE
