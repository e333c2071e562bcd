"""Skeleton tracker: one id per person over all cameras (Hi-ROS 2023, section 3.1).

The paper's algorithm for one camera's message: predict the tracks, compare them with the
detections, assign, correct the tracks (:func:`~hiros_mcap.stages.track.tracking.update`); start and
delete tracks (:class:`_Tracker`). The first four take one message after the other without Python,
until one leaves something to decide.

Beyond the paper:

- A new track is tentative and has no id. Its support confirms it
  (support.py). A message that shows somebody tentative is held for a moment,
  so that a confirmed person has the id from the first detection on.
- Two tracks of one person are merged. Who comes back gets the old id if it is probable. Where it
  is not clear who came, messages are held for longer (:mod:`~hiros_mcap.stages.track.identity`).
- A detection with left and right swapped is compared, and corrects its track, swapped back.
- A detection that leaps away from its track is left out: a detector distorts people who are about
  to be hidden. What two cameras show at once is no leap. The gate of an unseen track grows.
- A detection behind somebody else corrects its track little: what its camera cannot see, the
  detector invents.
- A camera that shows people elsewhere than the others do brings nobody new
  (:mod:`~hiros_mcap.stages.track.displaced`).
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from functools import partial
from operator import itemgetter

import numpy as np

from hiros_mcap.body.limb_thickness import capsules_of
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, join
from hiros_mcap.kernels.array_types import settings_of
from hiros_mcap.skeletons import POSITION, STATE, UNTRACKED, Floats, SkeletonModel, Stamps
from hiros_mcap.stages.track import tracking as kernels
from hiros_mcap.stages.track.association import TrackSettings, TrackWork, predict
from hiros_mcap.stages.track.correction import correct
from hiros_mcap.stages.track.displaced import Copies
from hiros_mcap.stages.track.identity import WAITS, Identities
from hiros_mcap.stages.track.likeness import DISPLACED
from hiros_mcap.stages.track.support import Confirmation
from hiros_mcap.stages.track.track_params import TrackParams
from hiros_mcap.stages.track.tracked_people import DetectionGroup, PersonTrack, TrackedPeople
from hiros_mcap.stages.track.tracking import KnownTracks

_TENTATIVE_GAP = 0.5  # s; a tentative track that no camera has seen for longer is deleted

_Messages = tuple[Block, Sequence[int], Sequence[int]]
"""Messages that are done: their block, their places there, their log times, ns."""


def track_blocks(
    blocks: Iterable[Block], model: SkeletonModel, params: TrackParams | None = None,
    events: Events | None = None, cameras: Mapping[str, Floats] | None = None,
    widths: tuple[int, int] = (STATE, STATE),
    misplaced: Set[str] = frozenset(),
) -> Iterator[Block]:  # fmt: skip
    """Give every detection the id of its person (section 3.1.2).

    Parameters
    ----------
    blocks : detections of all cameras in the fixed frame, in time order.
    model : names and hierarchy of the skeleton.
    params, events : parameters; where counts and events go.
    cameras : source -> (3,) position of the camera in the fixed frame, m. With it, other cameras
        can contradict a track that only one of them reports.
    widths : columns of a KinematicState that markers, and links, get at least. The tracks fill in
        the velocities and accelerations among them.
    misplaced : cameras whose poses are known to be wrong. Whom they alone show is nobody.

    Yields
    ------
    The same frames in the same order, with ids (-1 = of nobody who counts) and with the
    tracks' velocities and accelerations where the detector gave none.
    """
    params = params or TrackParams()
    tracker = _Tracker(model, params, events or Events(), cameras or {}, misplaced)
    for block in blocks:
        copy = join([block], widths=widths)
        del block  # else it lies in memory until the next one is made
        copy.people.ids.fill(UNTRACKED)
        yield from _gather(tracker.take(copy))
    yield from _gather(tracker.finish())


def _gather(messages: Iterable[_Messages]) -> Iterator[Block]:
    """Make a block of neighbours that lie in the same arrays."""
    for block, group in itertools.groupby(messages, key=itemgetter(0)):
        _, places, log_times = zip(*group, strict=True)
        chosen = np.concatenate([np.array(numbers, np.int64) for numbers in places])
        yield block.select(chosen).logged_at(np.concatenate(log_times))


class _Tracker:
    """The tracks, and the messages whose ids are not decided yet."""

    def __init__(
        self, model: SkeletonModel, params: TrackParams, events: Events,
        cameras: Mapping[str, Floats], misplaced: Set[str] = frozenset(),
    ) -> None:  # fmt: skip
        self._params, self._events = params, events
        symmetry = symmetry_of(model)
        same = np.arange(model.n_markers, dtype=np.int32)
        ends = model.links if params.reidentify > 0 else np.empty((0, 2), np.int32)
        flip_aware = params.flip_aware and symmetry.has_sides
        self._settings = settings_of(
            TrackSettings, params, flip_aware=flip_aware, same=same, mirror=symmetry.mirror,
            ends=np.ascontiguousarray(ends), capsules=capsules_of(model),
        )  # fmt: skip
        self._allocate = partial(
            TrackWork.allocate, n_markers=model.n_markers, n_links=model.n_links
        )
        self._work = self._allocate(8, 8)
        self._patience = round(params.lookahead * 1e9)
        """ns that a message that stays undecided is held, in time of the data."""
        self._held = deque[DetectionGroup]()
        self._people = TrackedPeople(model, cameras, misplaced)
        link_mirror = symmetry.link_mirror[: len(ends)]
        self._identities = Identities(self._people, params, events, link_mirror)
        self._support = Confirmation(self._people, self._identities, params, events, cameras)
        self._copies = Copies(
            self._people, self._places, symmetry.mirror, events,
            withdraws=params.merge_tracks,
        )  # fmt: skip

    def take(self, block: Block) -> Iterator[_Messages]:
        """Track messages, and write into them; yield those that are decided."""
        messages, log_times = self._people.messages_of(block), block.log_times.tolist()
        n_detections, place = int(block.sizes.max(initial=0)), 0
        self._support.note_due(self._people.names)
        self._identities.note_pauses(block)
        while place < len(block):
            known = self._prepare(block, place, n_detections)  # delete, leave out copies
            done, is_open = kernels.update.raw(  # predict, compare, assign, correct
                messages, place, block.people, known, self._people.bank.past, self._people.cameras,
                self._settings, self._work,
            )  # fmt: skip
            if done > place:
                yield block, range(place, done), log_times[place:done]
            if is_open:
                for group in self._decide(self._group(block, done)):
                    yield self._finish(group, log_times[done])
            place = done + is_open
        self._count_faults()

    def _prepare(self, block: Block, place: int, n_detections: int) -> KnownTracks:
        """Decide who is lost, and which detections of a displaced camera are copies.

        ``n_detections`` : largest number of detections of a message.
        """
        self._delete_unseen(int(block.stamps[place]))  # after t_m
        self._make_room(n_detections)
        names, displaced = self._people.names, self._copies.displaced.sources
        self._people.cameras.displaced[:] = [name in displaced for name in names]
        if block.source(place) in displaced:
            self._leave_out_copies(block, place)
        return self._people.known(certain=not self._held)

    def _decide(self, group: DetectionGroup) -> Iterator[DetectionGroup]:
        """Decide who is new, who counts, who is who; yield messages that are decided."""
        self._start(group)  # tentative tracks
        self._copies.withdraw(group)
        self._support.confirm(group)  # or withdraw the id
        self._held.append(group)
        while self._held:
            oldest = self._held[0]
            patience = WAITS * self._patience if oldest.doubtful else self._patience
            if group.stamp - oldest.stamp < patience and not oldest.decided:
                return
            yield self._held.popleft()

    def finish(self) -> Iterator[_Messages]:
        """Yield the messages that are still held, now that nothing more comes."""
        for track in [track for track in self._people.tracks if track.doubtful]:
            self._support.conclude(track, self._held[-1])
        held = [*self._held]
        self._held.clear()
        for group in held:
            yield self._finish(group, int(held[-1].block.log_times[held[-1].place]))

    def _finish(self, group: DetectionGroup, log_time: int) -> _Messages:
        """Write the ids that the tracks have by now."""
        for j, track in enumerate(group.tracks):
            person = UNTRACKED if track is None else track.id
            group.people.ids[j] = person
            if person == UNTRACKED:
                is_copy = track is not None and self._people.is_copy(track)
                reason = group.reasons[j] or (DISPLACED if is_copy else "not confirmed")
                self._events.count(reason, group.source)
        log_time = max(log_time, int(group.block.log_times[group.place]))
        return group.block, (group.place,), (log_time,)

    def _group(self, block: Block, place: int) -> DetectionGroup:
        return self._people.group(block, place, self._work.track_rows, self._work.faults)

    def _count_faults(self) -> None:
        """Count the detections that were left out of messages without anything to decide."""
        names, faults = list(self._people.names), self._people.cameras.faults
        for camera, fault in np.argwhere(faults).tolist():
            self._events.count(kernels.FAULTS[fault], names[camera], int(faults[camera, fault]))
        faults.fill(0)

    # The decisions

    def _delete_unseen(self, stamp: int) -> None:
        """Delete tracks that nobody saw for t_m; tentative ones sooner."""
        self._identities.advance(stamp)
        for track in list(self._people.tracks):
            unseen = (stamp - track.seen) * 1e-9
            if track.doubtful and unseen > _TENTATIVE_GAP:
                self._support.conclude(track, self._held[-1])
            if unseen > (self._params.max_gap if track.confirmed else _TENTATIVE_GAP):
                if track.confirmed:
                    self._events.note(track.seen, "track lost", person=track.id)
                    self._identities.leave(track)
                self._people.remove(track)

    def _leave_out_copies(self, block: Block, place: int) -> None:
        """Leave out what a displaced camera shows of people whom other cameras see elsewhere."""
        people, faults = block.people.at(slice(*block.rows[place].tolist())), self._work.faults
        least = self._params.min_marker_confidence, self._params.min_skeleton_confidence
        kernels.screen(people, *least, faults)
        self._work.track_rows.fill(-1)
        self._copies.leave_out(group := self._group(block, place))
        faults[: len(people.ids)] = [kernels.FAULTS.index(reason) for reason in group.reasons]

    def _start(self, group: DetectionGroup) -> None:
        """Start a tentative track for each detection that is of nobody known."""
        unmatched, work = group.unmatched, self._work
        if not unmatched:
            return
        new: list[PersonTrack] = []
        work.match.fill(UNTRACKED)
        here = group.people.markers[unmatched, :, POSITION]
        enough = np.count_nonzero(~np.isnan(here[..., 0]), axis=1) >= self._params.min_markers
        origins = np.nanmean(here, axis=1)
        for j, origin, is_whole in zip(unmatched, origins, enough.tolist(), strict=True):
            if not is_whole:
                group.reasons[j] = "too few markers"
                continue
            work.match[j] = len(new)
            new.append(self._people.start(group.stamp, origin))
            group.tracks[j] = new[-1]
        if new:
            work.mirrored.fill(False)
            correct(
                group.stamp, _rows(new), work, group.people, self._people.bank.past,
                self._settings,
            )  # fmt: skip

    def _places(self, tracks: list[PersonTrack], group: DetectionGroup) -> Floats:
        """(N, M, 3) where tracks are at the time of a message, m."""
        if tracks:
            past = self._people.bank.past
            predict(group.stamp, _rows(tracks), past, self._settings, self._work)
        return self._work.positions[: len(tracks)].copy()

    def _make_room(self, n_people: int) -> None:
        """Enlarge the scratch arrays: so many detections may start as many tracks."""
        size, n_tracks = self._work.cost.shape, len(self._people.tracks) + n_people
        if n_tracks > size[0] or n_people > size[1]:
            self._work = self._allocate(2 * n_tracks, 2 * n_people)


def _rows(tracks: Sequence[PersonTrack]) -> Stamps:
    """(T,) Rows of tracks in the bank."""
    return np.array([track.row for track in tracks], np.int64)
