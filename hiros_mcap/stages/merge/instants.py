"""Gathers the messages of a moment, and merges the views of each person in them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import sub
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.events import SAME_TIME, TOO_LATE, Events
from hiros_mcap.frames import Block, CameraNumbers, together
from hiros_mcap.kernels.averaging import Buffers
from hiros_mcap.skeletons import STATE, UNTRACKED, Ints, People, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.look_ahead import LookAhead
from hiros_mcap.stages.merge.unseen import Unseen

_NEAR = 2 / 3
"""By so much of its camera's interval is a message later than the middle of its instant at most.

Where cameras take turns evenly, the last one is later by half of it."""
_REMEMBERED = 6  # messages of a camera: the median of five intervals counts


@dataclass(frozen=True, slots=True)
class Instant:
    """One message of each camera that sent one."""

    messages: Sequence[int]
    """Their numbers, sorted by source, so that nothing depends on which camera was first."""
    stamp: int  # mean time of the messages, ns
    log_time: int  # log time, ns, of the message that completed the instant


class Instants:
    """Gathers one message per camera (Hi-ROS 2023, section 3.2).

    Times of instants increase: a message that is not younger than the last one is left out. Two
    messages of a camera have one time where stamps are rounded, or where a detector stamps messages
    of nobody when it sends them; of two cameras, where one joins others that are triggered with it.

    Parameters
    ----------
    cameras : messages that complete an instant (third trigger); 0 = as many as sources are known,
        once one of them has sent a second message.
    max_delta_time : s between the oldest and the newest message of an instant (second trigger).
        A second message of the same camera starts a new one, too (first trigger).
    events : counts "too late to be merged", and "stamped as those merged before".
    in_step : whether a message also starts a new instant where its camera's message before, or one
        that was lost, would have been nearer to the others. Without this, a bad start lasts: of
        cameras that are triggered together, each instant has the next message of one, a period
        later.
    """

    def __init__(
        self, cameras: int, max_delta_time: float, events: Events, *, in_step: bool = True
    ) -> None:
        self._cameras, self._span, self._events = cameras, max_delta_time * 1e9, events
        self._near = _NEAR if in_step else math.inf
        self._buffer: dict[str, tuple[int, int]] = {}
        """Source to the stamp and number of its message."""
        self._sources: dict[str, deque[int]] = {}  # source to the stamps of its latest messages
        self._all_known = False
        self._newest = -1
        self._first = self._last = 0  # times of the oldest and the newest message in the buffer
        self._log_time = 0  # of the latest message in the buffer

    def add(self, stamp: int, source: str, log_time: int, number: int) -> list[Instant]:
        """Take a message; return the instants that it completes: none, one or two."""
        done: list[Instant] = []
        self._all_known = self._all_known or source in self._sources
        interval = self._interval(source, stamp)
        buffer = self._buffer
        if (buffer and stamp >= self._newest) and (
            source in buffer
            or max(stamp, self._last) - min(stamp, self._first) > self._span
            or stamp - (self._first + self._last) / 2 > self._near * interval
        ):
            done.append(self._close(log_time))
            buffer = self._buffer
        if stamp <= self._newest:  # than the instant just closed, or one before
            self._events.count(TOO_LATE if stamp < self._newest else SAME_TIME, source)
            return done
        if buffer:
            self._log_time = max(log_time, self._log_time)
            self._first, self._last = min(stamp, self._first), max(stamp, self._last)
        else:
            self._log_time, self._first, self._last = log_time, stamp, stamp
        buffer[source] = stamp, number
        known = len(self._sources) if self._all_known else math.inf
        if len(self._buffer) >= (self._cameras or known):
            done.append(self._close(log_time))
        return done

    def _interval(self, source: str, stamp: int) -> float:
        """Usual time, ns, between messages of a source, of which one is new; inf if not known."""
        if source not in self._sources:
            self._sources[source] = deque(maxlen=_REMEMBERED)
        stamps = self._sources[source]
        if not stamps or stamp > stamps[-1]:
            stamps.append(stamp)
        gaps = sorted(map(sub, [*stamps][1:], stamps))
        return gaps[(len(gaps) - 1) // 2] if gaps else math.inf

    def rest(self) -> list[Instant]:
        """Return the instant that no further message will complete, if there is one."""
        return [self._close(self._log_time)] if self._buffer else []

    def _close(self, log_time: int) -> Instant:
        buffer, self._buffer = self._buffer, {}
        messages = [buffer[source] for source in sorted(buffer)]
        self._newest = sum(stamp for stamp, _ in messages) // len(messages)
        return Instant([number for _, number in messages], self._newest, log_time)


def by_instants(
    blocks: Iterable[Block], cameras: int, max_delta_time: float, *, in_step: bool = True
) -> Iterator[Block]:
    """Gather messages into blocks that end where an instant is complete.

    No merger gives anything before, and every stage costs a call per block. The parameters are
    those of :class:`Instants`.
    """
    gathered, held = Instants(cameras, max_delta_time, Events(), in_step=in_step), list[Block]()
    for block in blocks:
        end = 0
        for n, message in enumerate(block.messages(), 1):
            end = n if gathered.add(*message, 0) else end
        if end:
            yield together([*held, block.select(slice(end))])
            held = []
        if end < len(block):
            held.append(block.select(slice(end, None)))
        del block  # else it lies in memory until the next one is made
    if held:
        yield together(held)


MergeKernel = Callable[[Buffers, People, int, People, Stamps], None]
"""Merges ``buffers`` of messages that show ``people``, at most so many views of one person, into
the people whose ids a third argument holds, and adds to counts (N, C) of N kinds by camera."""


class InstantMerger:
    """Merges what the cameras show of each person at an instant; every merger is one.

    Parameters
    ----------
    model, events, fixed_frame : see :func:`hiros_mcap.stages.merge.merge.merge_blocks`.
    kernel : merges the views of each person.
    bank : what the kernel remembers of people; one row for each.
    counted : names of what the kernel counts by camera.
    unseen : says whom that no message shows is handed to the kernel all the same.
    widths : columns of the merged markers and links.
    """

    # ns of instants that are merged at once. A row that the bank frees meanwhile may be another
    # person's at once, for the bank waits longer.
    _SPAN = 5_000_000_000

    def __init__(
        self, model: SkeletonModel, kernel: MergeKernel, bank: Bank[Any], events: Events,
        fixed_frame: str, counted: tuple[str, ...] = (), unseen: Unseen | None = None,
        widths: tuple[int, int] = (STATE, STATE),
    ) -> None:  # fmt: skip
        self._model, self._kernel, self._bank = model, kernel, bank
        self._events, self._fixed_frame, self._counted = events, fixed_frame, counted
        self._unseen, self._widths = unseen or Unseen(), widths
        self._cameras = CameraNumbers()
        self._ahead = LookAhead()

    @property
    def cameras(self) -> tuple[str, ...]:
        """Sources of the messages, by the index that the kernel knows them by."""
        return tuple(self._cameras)

    def run(
        self, blocks: Iterable[Block], cameras: int, max_delta_time: float, *, in_step: bool = True
    ) -> Iterator[Block]:
        """Yield the merged people of every instant; the parameters are those of Instants."""
        gathered = Instants(cameras, max_delta_time, self._events, in_step=in_step)
        for block in blocks:
            first, ready = self._ahead.first + len(self._ahead), list[Instant]()
            self._ahead.add(block)
            for number, message in enumerate(block.messages(), first):
                ready += gathered.add(*message, number)
            del block  # else it lies in memory until the next one is made
            yield from self._merge_all(ready, first)
        yield from self._merge_all(gathered.rest())

    def _merge_all(self, instants: Sequence[Instant], first: int = 0) -> Iterator[Block]:
        """Merge in batches of a few seconds; ``first`` is the number of the block's first message.

        Messages are copied only where those of an instant lie in several blocks.
        """
        start = instants[0].stamp if instants else 0
        for _, batch in groupby(instants, lambda instant: (instant.stamp - start) // self._SPAN):
            plans = []
            for _, neighbours in groupby(batch, lambda instant: min(instant.messages) < first):
                part = list(neighbours)
                numbers = [number for instant in part for number in instant.messages]
                places = np.array(numbers) - self._ahead.first
                messages = self._ahead.release(int(places.max()) + 1, shared=True)
                plans.append(self._plan(part, messages.select(places)))
            yield self._merge(plans)

    def _merge(self, plans: Sequence[_MergePlan]) -> Block:
        """Merge people as planned."""
        sizes = np.concatenate([np.diff(plan.buffers.people_ends) for plan in plans])
        stamps = np.concatenate([plan.buffers.stamps for plan in plans])
        ends = np.concatenate([[0], np.cumsum(sizes)])
        slots = self._model.n_markers, self._model.n_links
        out = People.allocate(int(ends[-1]), *slots, *self._widths)
        out.stamps[:] = np.repeat(stamps, sizes)
        out.confidences.fill(np.nan)
        out.boxes.fill(np.nan)
        counts = np.zeros((len(self._counted), len(self._cameras)), np.int64)
        first = 0
        for plan in plans:
            part = out.at(slice(first, first + len(plan.ids)))
            part.ids[:] = plan.ids
            self._kernel(plan.buffers, plan.people, plan.most_views, part, counts)
            first += len(plan.ids)
        for kind, by_camera in zip(self._counted, counts.tolist(), strict=True):
            for source, n in zip(self._cameras, by_camera, strict=True):
                self._events.count(kind, source, n)
        names = [name for plan in plans for name in plan.frame_ids]
        numbers = dict[str, int]()
        frames = np.array([numbers.setdefault(name, len(numbers)) for name in names])
        log_times = np.concatenate([plan.log_times for plan in plans])
        rows = np.stack([ends[:-1], ends[1:]], 1)
        return Block(stamps, log_times, frames, frames, tuple(numbers), rows, out)

    def _plan(self, instants: Sequence[Instant], messages: Block) -> _MergePlan:
        """Find out who is merged at each instant: whom its messages show, and who goes on."""
        people = messages.people
        doubts = messages.doubt_columns()
        persons = np.where(doubts.distorted, UNTRACKED, people.ids).astype(np.int32)
        people = people._replace(ids=persons)
        message_ends = np.cumsum([0, *(len(instant.messages) for instant in instants)])
        stamps = np.array([instant.stamp for instant in instants], np.int64)
        of_instant = np.repeat(np.arange(len(instants)), np.diff(message_ends))
        rows, owners = messages.everybody()
        counts = persons[rows] != UNTRACKED
        keys = of_instant[owners[counts]] * (1 << 32) + persons[rows[counts]]
        keys, views = np.unique(keys, return_counts=True)
        bounds = np.searchsorted(keys >> 32, np.arange(1, len(instants)))
        self._unseen.show(messages, stamps[of_instant], doubts.distorted)
        ids: list[int] = []
        past_rows: list[int] = []
        people_ends = [0]
        for k, numbers in enumerate(np.split(keys & (2**32 - 1), bounds)):
            present = self._present(int(stamps[k]), int(message_ends[k + 1]), numbers.tolist())
            ids += present
            past_rows += [self._bank.rows[person] for person in present]
            people_ends.append(len(ids))
        self._unseen.see_all()
        columns = [messages.rows, messages.stamps[:, None], self._cameras.of(messages)[:, None]]
        firsts = messages.frame_ids[message_ends[:-1]].tolist()
        return _MergePlan(
            Buffers(
                stamps,
                np.array(people_ends, np.int64),
                message_ends,
                np.concatenate(columns, axis=1),
                np.array(past_rows, np.int64),
                doubts.variances,
            ),
            people,
            np.array(ids, np.int32),
            int(views.max(initial=0)),
            np.array([instant.log_time for instant in instants], np.int64),
            [self._fixed_frame or messages.names[k] for k in firsts],
        )

    def _present(self, stamp: int, n_messages: int, people: list[int]) -> list[int]:
        """Return who is there at an instant that shows ``people``, sorted; remember them."""
        self._bank.expire(stamp)
        bridged, carried = self._unseen.go_on(stamp, n_messages, people, self._bank.last_seen)
        for person in people:
            self._bank.row(person, stamp)
        if not bridged and not carried:
            return people
        self._events.count("bridged", n=len(bridged))
        self._events.count("carried", n=len(carried))
        return sorted({*people, *bridged, *carried})


class _MergePlan(NamedTuple):
    """Instants whose messages lie in common arrays, written down for a kernel."""

    buffers: Buffers
    people: People  # whom the messages show; distorted views have no id
    ids: Ints  # (P,) Of each merged person
    most_views: int  # most views of one person at an instant
    log_times: Stamps  # (Q,) ns
    frame_ids: Sequence[str]  # Q names of coordinate frames
