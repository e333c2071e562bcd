"""What the cameras report at about the same time, gathered for a merger."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.kernels.averaging import mean_people
from hiros_mcap.skeletons import UNTRACKED, Frame, Stamps


@dataclass(frozen=True, slots=True)
class Instant:
    """One message of each camera that sent one."""

    frames: Sequence[Frame]
    """Sorted by source, so that nothing depends on which camera was first."""
    stamp: int
    """Mean time of the messages, ns (H21)."""
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
    Instants whose times increase: a frame that is older than the last one is left out.
    """
    buffer: dict[str, Frame] = {}
    known: set[str] = set()
    newest = 0
    for frame in frames:
        known.add(frame.source)
        if frame.stamp < newest:
            events.count("too late to be merged", frame.source)
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
    """Whether a message belongs to a later instant: same camera again, or too late (H26, H27)."""
    if frame.source in buffer:
        return True
    stamps = [f.stamp for f in buffer.values()]
    span = max(*stamps, frame.stamp) - min(*stamps, frame.stamp)
    return span > max_delta_time * 1e9


def tracked_only(frame: Frame) -> Frame:
    """Return the frame without people who have no id."""
    if UNTRACKED not in frame.ids.tolist():
        return frame
    return frame.select(frame.ids != UNTRACKED)


def summarize(
    out: Frame, person_of: Stamps, stamps: Stamps, frames: Sequence[Frame], *, carried: bool
) -> None:
    """Fill in source time and confidence of each merged person: the means over the views.

    Parameters
    ----------
    out : merged frame. person_of, stamps : (N,) its row and the source time, ns, of each view.
    frames : that the views come from, in order.
    carried : every pose has been carried to the merged time, which so is the source time.
    """
    trust = np.concatenate([f.confidences for f in frames])
    mean_people(out.stamp, person_of, stamps, trust, carried, out.stamps, out.confidences)
