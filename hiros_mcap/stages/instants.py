"""What the cameras report at about the same time, gathered for a merger."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from hiros_mcap.events import TOO_LATE, Events
from hiros_mcap.kernels.averaging import load_views
from hiros_mcap.skeletons import STATE, Floats, Frame, SkeletonModel, Stamps

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


def instants(
    frames: Iterable[Frame], cameras: int, max_delta_time: float, events: Events
) -> Iterator[Instant[Frame]]:
    """Yield what :class:`Instants` gathers from frames of all cameras, roughly in time order."""
    gathered: Instants[Frame] = Instants(cameras, max_delta_time, events)
    for frame in frames:
        yield from gathered.add(frame.stamp, frame.source, frame.log_time, frame)
    yield from gathered.rest()


Room = tuple[Stamps, Floats, Floats, Floats, Floats, Floats]
"""Of N views: (3, N) row in the output, camera and time, ns; confidences, markers, their
confidences, links, their confidences."""


class Views:
    """The views of an instant in common arrays, which are reused, since new ones cost."""

    def __init__(self, model: SkeletonModel) -> None:
        self._model = model
        self._room = self._make(16)

    def _make(self, views: int) -> Room:
        m, n = self._model.n_markers, self._model.n_links
        return (
            np.empty((3, views), np.int64), np.empty(views), np.empty((views, m, STATE)),
            np.empty((views, m)), np.empty((views, n, STATE)), np.empty((views, n)),
        )  # fmt: skip

    def room(self, views: int) -> Room:
        """Arrays for so many views or more; their contents are lost."""
        if views > len(self._room[1]):
            self._room = self._make(2 * views)
        return self._room

    def load(
        self, out: Frame, frames: Sequence[Frame], cameras: Sequence[int], *, carry: bool
    ) -> tuple[int, Stamps, Floats, Floats, Floats, Floats, Floats]:
        """Gather the views of the people of ``out``; valid until the next call.

        Parameters
        ----------
        out : says whom, and the merged time. frames, cameras : messages, and a number of each.
        carry : the views to the merged time, by their velocities.

        Returns
        -------
        How many views, and arrays with room for them or more: (3, N) row in ``out``, camera and
        time, ns, of each; confidences, markers, their confidences, links, their confidences.
        """
        room, n = self.room(sum(len(frame.ids) for frame in frames)), 0
        for frame, camera in zip(frames, cameras, strict=True):
            n = load_views(
                n, camera, frame.stamp, out.stamp, carry, out.ids, frame.ids, frame.confidences,
                frame.markers, frame.marker_confidences, frame.links, frame.link_confidences,
                *room,
            )  # fmt: skip
        return n, *room
