"""What the cameras report at about the same time, gathered for a merger."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hiros_mcap.events import TOO_LATE, Events
from hiros_mcap.kernels.averaging import load_views
from hiros_mcap.skeletons import STATE, Floats, Frame, SkeletonModel, Stamps


@dataclass(frozen=True, slots=True)
class Instant:
    """One message of each camera that sent one."""

    frames: Sequence[Frame]
    """Sorted by source, so that nothing depends on which camera was first."""
    stamp: int
    """Mean time of the messages, ns."""
    log_time: int
    """Log time, ns, of the message that completed the instant."""

    @classmethod
    def of(cls, buffer: Mapping[str, Frame], log_time: int) -> Instant:
        """Make an instant of a message per source."""
        frames = tuple(buffer[source] for source in sorted(buffer))
        return cls(frames, sum(frame.stamp for frame in frames) // len(frames), log_time)


def instants(
    frames: Iterable[Frame], cameras: int, max_delta_time: float, events: Events
) -> Iterator[Instant]:
    """Gather one message per camera (Hi-ROS 2023, section 3.2).

    Parameters
    ----------
    frames : of all cameras, roughly in time order.
    cameras : messages that complete an instant (third trigger); 0 = as many as sources are known.
    max_delta_time : s between the oldest and the newest message of an instant (second trigger).
        A second message of the same camera starts a new one, too (first trigger).
    events : counts "too late to be merged".

    Yields
    ------
    Instants whose times never decrease: a frame older than the last one is left out. Two have the
    same time where messages do: cameras triggered together, before all of them are known.
    """
    buffer: dict[str, Frame] = {}
    known: set[str] = set()
    newest = 0
    for frame in frames:
        known.add(frame.source)
        if frame.stamp < newest:
            events.count(TOO_LATE, frame.source)
            continue
        if buffer and _closes(buffer, frame, max_delta_time):
            instant = Instant.of(buffer, frame.log_time)
            newest, buffer = instant.stamp, {}
            yield instant
        buffer[frame.source] = frame
        if len(buffer) >= (cameras or len(known)):
            instant = Instant.of(buffer, frame.log_time)
            newest, buffer = instant.stamp, {}
            yield instant
    if buffer:
        yield Instant.of(buffer, max(f.log_time for f in buffer.values()))


def _closes(buffer: dict[str, Frame], frame: Frame, max_delta_time: float) -> bool:
    """Whether a message belongs to a later instant: same camera again, or too late."""
    if frame.source in buffer:
        return True
    stamps = [f.stamp for f in buffer.values()]
    span = max(*stamps, frame.stamp) - min(*stamps, frame.stamp)
    return span > max_delta_time * 1e9


class Views:
    """The views of an instant in common arrays, which are reused, since new ones cost."""

    def __init__(self, model: SkeletonModel) -> None:
        self._model = model
        self._room = self._make(16)

    def _make(self, views: int) -> tuple[Stamps, Floats, Floats, Floats, Floats, Floats]:
        m, n = self._model.n_markers, self._model.n_links
        return (
            np.empty((3, views), np.int64), np.empty(views), np.empty((views, m, STATE)),
            np.empty((views, m)), np.empty((views, n, STATE)), np.empty((views, n)),
        )  # fmt: skip

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
        most = sum(len(frame.ids) for frame in frames)
        if most > len(self._room[1]):
            self._room = self._make(2 * most)
        n = 0
        for frame, camera in zip(frames, cameras, strict=True):
            n = load_views(
                n, camera, frame.stamp, out.stamp, carry, out.ids, frame.ids, frame.confidences,
                frame.markers, frame.marker_confidences, frame.links, frame.link_confidences,
                *self._room,
            )  # fmt: skip
        return n, *self._room
