"""Frames of a log as arrays, channel by channel: as much of them as is drawn.

A log is in the order of its messages, and what a stage that looks ahead says of an instant comes
later. So frames wait in a :class:`Gatherer` until little that is earlier can come, and are drawn
many at a time, in the order of their stamps.

A viewer shows the newest row of an entity, so somebody who left has to be hidden: there are rows
for the frames that people are in, and an empty one after each visit.

:class:`Uncertainties` has how well the joints of a result are known.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from hiros_mcap.defaults import LEAST_CONFIDENCE
from hiros_mcap.errors import ConfigError
from hiros_mcap.frames import Block, rows_between
from hiros_mcap.io.marker_uncertainty import UNCERTAIN_TOPIC, Deviations, read_uncertainty
from hiros_mcap.skeletons import POSITION, UNTRACKED, Flags, Floats, Frame, SkeletonModel, Stamps
from hiros_viewer.columns import GONE_NS, after_pauses

HORIZON_NS = 3_000_000_000
"""Frames wait for others of their time; most are at most this much later in a log."""
BATCH = 4000
"""Frames that are drawn at once, about."""
_FIRST_BATCH = 400  # before anything was drawn: the first picture comes soon

Channel = tuple[str, str]
"""A stage, or that these are detections; and their camera, "" for a stage."""


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """P people in N frames of a channel, in the order of their stamps."""

    times: Stamps  # (N, 2) stamp and log time of each frame, ns
    counts: Stamps  # (N,) people in each frame; theirs are the next rows of the other arrays
    ids: npt.NDArray[np.integer[Any]]  # (P,)
    positions: Floats  # (P, M, 3) m, C-contiguous
    confidences: Floats  # (P, M) of the markers

    @classmethod
    def of(cls, frame: Frame) -> Poses:
        """Copy what is drawn of a frame."""
        return cls.of_block(Block.of(frame), np.zeros(1, np.int64))

    @classmethod
    def of_block(cls, block: Block, frames: Stamps) -> Poses:
        """Copy what is drawn of some frames of a block, by their numbers."""
        rows = block.rows[frames]
        indices, people = rows_between(rows), block.people
        positions = people.markers[indices, :, POSITION]
        confidences = people.marker_confidences[indices]
        times = np.stack([block.stamps[frames], block.log_times[frames]], axis=1)
        return cls(times, rows[:, 1] - rows[:, 0], people.ids[indices], positions, confidences)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the frames of one or more in the order of their stamps; equal ones stay."""
        whole = parts[0]
        if len(parts) > 1:
            columns = zip(*(p._columns() for p in parts), strict=True)
            whole = cls(*map(np.concatenate, columns))
        if (np.diff(whole.stamps) >= 0).all():
            return whole
        return whole.select(np.argsort(whole.stamps, kind="stable"))

    def __len__(self) -> int:
        """N."""
        return len(self.counts)

    @property
    def stamps(self) -> Stamps:
        """(N,) ns."""
        return self.times[:, 0]

    @property
    def is_predicted(self) -> Flags:
        """(P,) whether no camera saw the person, as the summary counts it."""
        present = ~np.isnan(self.confidences)
        total = np.where(present, self.confidences, 0.0).sum(axis=1)
        return np.asarray(present.any(axis=1) & (total < LEAST_CONFIDENCE * present.sum(axis=1)))

    @property
    def rows(self) -> Stamps:
        """(N, 2) first row of each frame's people, and the row after the last."""
        ends = np.cumsum(self.counts)
        return np.stack([ends - self.counts, ends], axis=1)

    @property
    def frames(self) -> Stamps:
        """(P,) the frame that each person is in."""
        return np.repeat(np.arange(len(self)), self.counts)

    def select(self, frames: Stamps) -> Self:
        """Return some frames by their numbers."""
        people = rows_between(self.rows[frames])
        rows = (column[people] for column in self._columns()[2:])
        return type(self)(self.times[frames], self.counts[frames], *rows)

    def split(self, stamp: int) -> tuple[Self, Self]:
        """Return the frames before a stamp, ns, and the others."""
        n = int(np.searchsorted(self.stamps, stamp))
        p = int(self.counts[:n].sum())
        ends = [n, n] + [p] * (len(self._columns()) - 2)
        columns = list(zip(self._columns(), ends, strict=True))
        early = type(self)(*(column[:end] for column, end in columns))
        return early, type(self)(*(column[end:] for column, end in columns))

    def only(self, people: Flags) -> Self:
        """Return all frames with some of their people."""
        counts = np.bincount(self.frames[people], minlength=len(self))
        rows = (column[people] for column in self._columns()[2:])
        return type(self)(self.times, counts, *rows)

    def _columns(self) -> tuple[Any, ...]:
        return self.times, self.counts, self.ids, self.positions, self.confidences


class Gatherer:
    """Frames of all channels that wait for others of their time."""

    def __init__(self) -> None:
        self.size = 0  # frames that came since some were taken
        self._parts = defaultdict[Channel, list[Poses]](list)
        self._newest = 0
        self._is_first = True

    def add(self, channels: Sequence[Channel | None], block: Block) -> None:
        """Add the frames of a block, each to its channel; None leaves a frame out."""
        frames = defaultdict[Channel, list[int]](list)
        for k, channel in enumerate(channels):
            if channel is not None:
                frames[channel].append(k)
        for channel, held in frames.items():
            self._parts[channel].append(Poses.of_block(block, np.array(held)))
            self.size += len(held)
        self._newest = max(self._newest, int(block.log_times.max(initial=0)))

    @property
    def is_due(self) -> bool:
        """Whether enough frames came to draw some."""
        return self.size >= (_FIRST_BATCH if self._is_first else BATCH)

    def ready(self) -> Mapping[Channel, Poses]:
        """Take out the frames that hardly any earlier one will follow."""
        poses = self._before(self._newest - HORIZON_NS)
        self._is_first &= not poses
        return poses

    def rest(self) -> Mapping[Channel, Poses]:
        """Take out all frames."""
        return self._before(2**63 - 1)

    def _before(self, stamp: int) -> Mapping[Channel, Poses]:
        poses: dict[Channel, Poses] = {}
        for channel, parts in self._parts.items():
            if parts:
                early, late = Poses.joined(parts).split(stamp)
                self._parts[channel] = [late] if len(late) else []
                if len(early):
                    poses[channel] = early
        self.size = 0
        return poses


class Thinner:
    """Leaves frames out of a long log: a viewer has no room for an hour at 30 Hz.

    Parameters
    ----------
    step : ns; of each channel and camera, the first frame of each such interval is kept; 0 = all.
    """

    def __init__(self, step: int) -> None:
        self._step = step
        self._last: dict[object, int] = {}

    def chosen(self, keys: Sequence[object], stamps: Stamps) -> Iterator[bool]:
        """Say of each frame, with a key per channel and camera, whether it is kept."""
        if not self._step:
            yield from [True] * len(keys)
            return
        for key, cell in zip(keys, (stamps // self._step).tolist(), strict=True):
            yield self._last.get(key) != cell
            self._last[key] = cell


HIDDEN = -1


class Visit(NamedTuple):
    """Rows of one person."""

    person: int
    times: Stamps  # (R, 2) stamp and log time, ns
    people: Stamps  # (R,) which of the poses is shown, or HIDDEN
    begins: Flags  # (R,) where somebody is shown who was not before


@dataclass(slots=True)
class Visits:
    """Who of a stage is shown.

    Parameters
    ----------
    patience : ns; somebody whom frames lack for this long is hidden.
    """

    patience: int
    last: Stamps | None = None  # (2,) times of the newest frame
    shown: dict[int, Stamps] = field(default_factory=dict)
    """Whoever is not hidden -> (2,) times of their newest row."""

    def of(self, poses: Poses) -> Iterator[Visit]:
        """Yield the rows of everybody with an id, in the order of ids.

        Somebody is hidden at the first frame that lacks them for long enough, and all are hidden
        soon after the last frame before a pause: nobody knows where they are.
        """
        pauses = after_pauses(poses.times, self.last)
        self.last = poses.times[-1]
        frames = poses.frames
        order = np.argsort(poses.ids, kind="stable")
        ids, starts = np.unique(poses.ids[order], return_index=True)
        ends = np.append(starts, len(order))[1:]
        of_person = {i: order[a:b] for i, a, b in zip(ids.tolist(), starts, ends, strict=True)}
        nobody = np.zeros(0, np.int64)
        for person in sorted({*of_person, *self.shown} - {UNTRACKED}):
            people = of_person.get(person, nobody)
            visit = self._visit(person, poses.times, (frames[people], people), pauses)
            if len(visit.times):
                yield visit

    def _visit(
        self, person: int, times: Stamps, seen: tuple[Stamps, Stamps], pauses: tuple[Stamps, Stamps]
    ) -> Visit:
        """Return the rows of one person, who is in the frames ``seen`` with these poses."""
        frames, people = seen
        stamps = times[frames]
        earlier = self.shown.pop(person, None)
        if earlier is not None:  # as if shown in a frame before the first
            frames, people = np.insert(frames, 0, -1), np.insert(people, 0, 0)
            stamps = np.insert(stamps, 0, earlier, axis=0)
        n = len(times)
        following = np.append(frames[1:], n)
        lacking = np.searchsorted(times[:, 0], stamps[:, 0] + self.patience)
        lacking = np.maximum(lacking, frames + 1)
        pause = np.searchsorted(pauses[0], frames, side="right")
        paused = np.append(pauses[0], n + 1)[pause]
        at_pause = paused <= np.minimum(following, lacking)
        hidden = at_pause | (lacking < following)
        when = times[np.minimum(lacking, n - 1)]
        when[at_pause] = pauses[1][pause[at_pause]] + GONE_NS
        if not hidden[-1]:
            self.shown[person] = stamps[-1]
        after = np.flatnonzero(hidden) + 1
        people = np.insert(people, after, HIDDEN)
        begins = (people != HIDDEN) & (np.append(HIDDEN, people[:-1]) == HIDDEN)
        new = slice(earlier is not None, None)
        rows = np.insert(stamps, after, when[hidden], axis=0)
        return Visit(person, rows[new], people[new], begins[new])

    def finish(self) -> Iterator[Visit]:
        """Hide everybody soon after the last frame."""
        for person, last in sorted(self.shown.items()):
            yield Visit(person, last[None] + GONE_NS, np.array([HIDDEN]), np.array([False]))
        self.shown.clear()


@dataclass(slots=True)
class Crowd:
    """Whether anybody is shown of an entity for everybody whom a camera sees."""

    _last: Stamps | None = None  # (2,) times of the newest row
    _shown: bool = False

    def rows(self, poses: Poses) -> tuple[Stamps, Stamps]:
        """Return times (R, 2) and counts (R,) of rows: one per frame, one of nobody in a pause."""
        shown = np.append(self._shown, poses.counts > 0)
        places, before = after_pauses(poses.times, self._last)
        hides = shown[places]
        self._last, self._shown = poses.times[-1], bool(shown[-1])
        times = np.insert(poses.times, places[hides], before[hides] + GONE_NS, axis=0)
        return times, np.insert(poses.counts, places[hides], 0)

    def finish(self) -> Stamps:
        """Return the time (1, 2) at which whoever is shown is hidden; (0, 2) if nobody is."""
        if self._last is None or not self._shown:
            return np.zeros((0, 2), np.int64)
        self._shown = False
        return self._last[None] + GONE_NS


UNCERTAIN_STAGE = UNCERTAIN_TOPIC.rsplit("/", 1)[-1]
"""The stage whose joints are told of."""
HALF_SIZE = 3.5059**0.5
"""Half axis, in standard deviations, of an ellipsoid that holds the true joint with 68 %: quantile
of chi square with three degrees of freedom."""


class Uncertainties:
    """Standard deviations of everybody's markers over time.

    Parameters
    ----------
    deviations : what a result says. model : of its skeletons.
    """

    def __init__(self, deviations: Deviations, model: SkeletonModel) -> None:
        stamps: dict[int, list[int]] = {}
        for stamp, person in sorted(deviations):
            stamps.setdefault(person, []).append(stamp)
        self._stamps = {person: np.array(times, np.int64) for person, times in stamps.items()}
        self._deviations = {
            person: np.array(
                [[deviations[t, person].get(i, np.nan) for i in model.marker_ids] for t in times]
            )
            for person, times in stamps.items()
        }

    @classmethod
    def of_result(cls, path: Path, model: SkeletonModel) -> Self:
        """Read what a result says; raises ConfigError if it says nothing, LogError if damaged."""
        if not (deviations := read_uncertainty(path)):
            raise ConfigError(
                f"{path}: does not say how well its markers are known; results of `hiros process "
                "--system fuse` do"
            )
        return cls(deviations, model)

    def at(self, person: int, stamps: Stamps) -> Floats:
        """(T, M) standard deviations along each axis, m, at some times; NaN = unknown."""
        if person not in self._stamps:
            return np.full((len(stamps), 1), np.nan)
        times, deviations = self._stamps[person], self._deviations[person]
        rows = np.minimum(np.searchsorted(times, stamps), len(times) - 1)
        return np.where((times[rows] == stamps)[:, None], deviations[rows], np.nan)
