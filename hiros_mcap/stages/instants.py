"""What the cameras show at about the same time, gathered and merged person by person."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from hiros_mcap.events import TOO_LATE, Events
from hiros_mcap.frames import Block, Part, join, most_often
from hiros_mcap.kernels.averaging import Buffers
from hiros_mcap.skeletons import UNTRACKED, People, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.unseen import Unseen

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Instant(Generic[T]):
    """One message of each camera that sent one."""

    messages: Sequence[T]
    """Sorted by source, so that nothing depends on which camera was first."""
    stamp: int
    """Mean time of the messages, ns."""
    log_time: int
    """Log time, ns, of the message that completed the instant."""


class Instants(Generic[T]):
    """Gathers one message per camera (Hi-ROS 2023, section 3.2).

    Times of instants never decrease: a message older than the last one is left out. Two have the
    same time where messages do: cameras triggered together, before all of them are known.

    Parameters
    ----------
    cameras : messages that complete an instant (third trigger); 0 = as many as sources are known.
    max_delta_time : s between the oldest and the newest message of an instant (second trigger).
        A second message of the same camera starts a new one, too (first trigger).
    events : counts "too late to be merged".
    """

    def __init__(self, cameras: int, max_delta_time: float, events: Events) -> None:
        self._cameras, self._span, self._events = cameras, max_delta_time * 1e9, events
        self._buffer: dict[str, tuple[int, T]] = {}
        self._known: set[str] = set()
        self._newest = 0
        self._first = self._last = 0
        """Times of the oldest and the newest message in the buffer."""
        self._log_time = 0
        """Of the latest message in the buffer."""

    def add(self, stamp: int, source: str, log_time: int, message: T) -> list[Instant[T]]:
        """Take a message; return the instants that it completes: none, one or two."""
        done: list[Instant[T]] = []
        self._known.add(source)
        if stamp < self._newest:
            self._events.count(TOO_LATE, source)
            return done
        buffer = self._buffer
        if buffer and (
            source in buffer or max(stamp, self._last) - min(stamp, self._first) > self._span
        ):
            done.append(self._close(log_time))
            buffer = self._buffer
        if buffer:
            self._log_time = max(log_time, self._log_time)
            self._first, self._last = min(stamp, self._first), max(stamp, self._last)
        else:
            self._log_time, self._first, self._last = log_time, stamp, stamp
        buffer[source] = stamp, message
        if len(self._buffer) >= (self._cameras or len(self._known)):
            done.append(self._close(log_time))
        return done

    def rest(self) -> list[Instant[T]]:
        """Return the instant that no further message will complete, if there is one."""
        return [self._close(self._log_time)] if self._buffer else []

    def _close(self, log_time: int) -> Instant[T]:
        buffer, self._buffer = self._buffer, {}
        messages = [buffer[source] for source in sorted(buffer)]
        self._newest = sum(stamp for stamp, _ in messages) // len(messages)
        return Instant([message for _, message in messages], self._newest, log_time)


MergeKernel = Callable[[Buffers, People, int, People, Stamps], None]
"""Merges ``buffers`` of messages that show ``people``, at most so many views of one person, into
the people whose ids a third argument holds, and adds to (2, C) counts by camera."""


class InstantMerger:
    """Merges what the cameras show of each person at an instant; every merger is one.

    Parameters
    ----------
    model, events, fixed_frame : see :func:`hiros_mcap.stages.merge.merge_blocks`.
    kernel : merges the views of each person.
    bank : what the kernel remembers of people; one row for each.
    counted : names of what the kernel counts by camera.
    unseen : says whom that no message shows is handed to the kernel all the same.
    """

    # ns of instants that are merged at once. A row that the bank frees meanwhile may be another
    # person's at once, for the bank waits longer.
    _SPAN = 5_000_000_000

    def __init__(
        self,
        model: SkeletonModel,
        kernel: MergeKernel,
        bank: Bank[Any],
        events: Events,
        fixed_frame: str,
        counted: tuple[str, str],
        unseen: Unseen | None = None,
    ) -> None:
        self._model, self._kernel, self._bank = model, kernel, bank
        self._events, self._fixed_frame, self._counted = events, fixed_frame, counted
        self._unseen = unseen or Unseen()
        self._cameras: dict[str, int] = {}

    @property
    def cameras(self) -> tuple[str, ...]:
        """Sources of the messages, by the index that the kernel knows them by."""
        return tuple(self._cameras)

    def run(self, blocks: Iterable[Block], cameras: int, max_delta_time: float) -> Iterator[Block]:
        """Yield the merged people of every instant; the parameters are those of Instants."""
        gathered: Instants[Part] = Instants(cameras, max_delta_time, self._events)
        for block in blocks:
            ready: list[Instant[Part]] = []
            for message in block.messages():
                ready += gathered.add(*message)
            yield from self._merge_all(ready)
        yield from self._merge_all(gathered.rest())

    def _merge_all(self, instants: Sequence[Instant[Part]]) -> Iterator[Block]:
        """Merge in batches of a few seconds."""
        batch: list[Instant[Part]] = []
        for instant in instants:
            if batch and instant.stamp - batch[0].stamp > self._SPAN:
                yield self._merge(batch)
                batch = []
            batch.append(instant)
        if batch:
            yield self._merge(batch)

    def _merge(self, instants: Sequence[Instant[Part]]) -> Block:
        plans: list[_MergePlan] = []
        for instant in instants:
            block, places = _one_block(instant)
            if not plans or block is not plans[-1].block:
                plans.append(_MergePlan(block))
            self._plan(plans[-1], instant.stamp, places)
        stamps = np.array([instant.stamp for instant in instants], np.int64)
        sizes = np.concatenate([np.diff(plan.people_ends) for plan in plans])
        ends = np.concatenate([[0], np.cumsum(sizes)])
        out = People.allocate(int(ends[-1]), self._model.n_markers, self._model.n_links)
        out.stamps[:] = np.repeat(stamps, sizes)
        out.confidences.fill(np.nan)
        out.boxes.fill(np.nan)
        counts = np.zeros((2, len(self._cameras)), np.int64)
        first = 0
        for plan in plans:
            part = out.at(slice(first, first + len(plan.ids)))
            part.ids[:] = plan.ids
            self._kernel(plan.buffers(), plan.people, plan.max_views, part, counts)
            first += len(plan.ids)
        for kind, by_camera in zip(self._counted, counts.tolist(), strict=True):
            for source, n in zip(self._cameras, by_camera, strict=True):
                self._events.count(kind, source, n)
        firsts = [instant.messages[0] for instant in instants]
        names = [self._fixed_frame or block.frame_ids[i] for block, i in firsts]
        log_times = np.array([instant.log_time for instant in instants], np.int64)
        return Block(stamps, log_times, names, names, np.stack([ends[:-1], ends[1:]], 1), out)

    def _plan(self, plan: _MergePlan, stamp: int, places: Sequence[int]) -> None:
        """Add the messages at ``places`` of the plan's block, merged at ``stamp``."""
        seen: set[int] = set()
        views = 0
        for i in places:
            people = plan.add_message(
                i, self._cameras.setdefault(plan.block.sources[i], len(self._cameras))
            )
            seen.update(people)
            here, source = plan.people_rows(i), plan.block.sources[i]
            self._unseen.see(stamp, source, plan.people, here)
            if plan.blank:
                hidden = [plan.blank[row] for row in here if row in plan.blank]
                self._unseen.hide(stamp, source, hidden)
            views += most_often([person for person in people if person != UNTRACKED])
        seen.discard(UNTRACKED)
        self._bank.expire(stamp)
        last = self._bank.last_seen
        bridged, carried = self._unseen.go_on(stamp, seen, last)
        people = sorted(seen | bridged | carried)
        rows = [self._bank.row(p, stamp) if p in seen else self._bank.rows[p] for p in people]
        plan.end_instant(stamp, people, rows, views)
        self._events.count("bridged", n=len(bridged))
        self._events.count("carried", n=len(carried))


def _one_block(instant: Instant[Part]) -> tuple[Block, list[int]]:
    """Return a block that holds the messages of an instant, and where."""
    block, places = instant.messages[0][0], [i for _, i in instant.messages]
    if all(other is block for other, _ in instant.messages):
        return block, places
    return join(instant.messages), list(range(len(places)))


class _MergePlan:
    """Instants whose messages lie in one block, written down for a kernel."""

    def __init__(self, block: Block) -> None:
        self.block = block
        ids, markers = block.people.ids, block.people.markers
        blank = np.isnan(markers[:, :, 0]).all(axis=1) & (ids != UNTRACKED)
        self.blank = {int(row): int(ids[row]) for row in np.flatnonzero(blank)}
        """Row to person, where no marker is left."""
        self.people = block.people._replace(ids=np.where(blank, UNTRACKED, ids).astype(np.int32))
        """Those of the block; who is blank has no id."""
        self.ids: list[int] = []
        """Of each merged person."""
        self.people_ends = [0]
        self.max_views = 0
        """Most views of one person at an instant."""
        self._rows, self._ids = block.rows.tolist(), self.people.ids.tolist()
        self._times = block.stamps.tolist()
        self._past_rows: list[int] = []
        self._stamps: list[int] = []
        self._message_ends = [0]
        self._messages: list[tuple[int, int, int, int]] = []

    def add_message(self, i: int, camera: int) -> list[int]:
        """Add message ``i`` of the block; return the ids of its people."""
        begin, end = self._rows[i]
        self._messages.append((begin, end, self._times[i], camera))
        people: list[int] = self._ids[begin:end]
        return people

    def people_rows(self, i: int) -> range:
        """Rows of the people of message ``i`` of the block."""
        return range(*self._rows[i])

    def end_instant(self, stamp: int, people: list[int], past_rows: list[int], views: int) -> None:
        """Say whom the messages since the last instant make, and when."""
        self._stamps.append(stamp)
        self.ids += people
        self._past_rows += past_rows
        self.people_ends.append(len(self.ids))
        self._message_ends.append(len(self._messages))
        self.max_views = max(self.max_views, views)

    def buffers(self) -> Buffers:
        """Return the plan as arrays."""
        return Buffers(
            np.array(self._stamps, np.int64),
            np.array(self.people_ends, np.int64),
            np.array(self._message_ends, np.int64),
            np.array(self._messages, np.int64).reshape(-1, 4),
            np.array(self._past_rows, np.int64),
        )
