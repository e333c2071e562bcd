"""What was lost of a damaged log, as far as that can be known."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from hiros_mcap.io.container.chunks import Table
from hiros_mcap.io.container.records import Channel, Statistics
from hiros_mcap.kernels.record_index import CHANNEL, LOG_TIME, START, STOP
from hiros_mcap.summary import quantity

RECOVERY_METADATA = "hiros.recovery"
"""Name of the metadata record that marks a log with losses."""
_NAMED = 6
Number = TypeVar("Number", int, float)


@dataclass(frozen=True, slots=True)
class Damage:
    """A part of a file that cannot be read."""

    offset: int
    """First byte."""
    end: int
    """First byte after it."""
    fault: str
    counts: Mapping[int, int] | None = None
    """Messages that were there, by channel id; None = unknown."""
    sizes: Mapping[int, int] | None = None
    """Bytes of these messages, uncompressed, by channel id; None = unknown."""
    span: tuple[int, int] | None = None
    """Log times, ns, between which they lay; None = unknown."""
    extra: bool = False
    """Whether an attachment or a metadata record was there."""
    file: str = ""
    """Name of the file, for a recording of several."""


@dataclass(frozen=True, slots=True)
class ChannelLoss:
    """What is left of the channels of a topic, and what is not."""

    topic: str
    recovered: int
    """Messages."""
    lost: int | None
    """Messages; None = unknown."""
    lost_bytes: int | None
    """Of these messages, uncompressed; None = unknown."""
    lost_s: float | None
    """Time, s, from the last message before each damage to the first one after it. Where it is
    unknown which channels lost messages, those of all channels count. None = unknown."""

    def __str__(self) -> str:
        seconds = "an unknown time" if self.lost_s is None else f"{self.lost_s:.2f} s"
        if self.lost is None:
            return f"{self.topic}: an unknown number of messages in {seconds}"
        size = self.lost_bytes
        amount = "an unknown number of bytes" if size is None else quantity(size, "byte")
        return f"{self.topic}: {quantity(self.lost, 'message')}, {amount}, {seconds}"


@dataclass(frozen=True, slots=True)
class Recovery:
    """What a walk through the files of a damaged log found."""

    damages: tuple[Damage, ...] = ()
    """In the order of the files; empty for a healthy log."""
    channels: tuple[ChannelLoss, ...] = ()
    """In the order of their topics."""
    unchecked: int = 0
    """Recovered messages that no checksum covers: damage inside them cannot be noticed."""

    @property
    def complete(self) -> bool:
        """Whether everything was recovered, and checked if there is any damage."""
        lost = self.lost != 0 or any(damage.extra for damage in self.damages)
        return not lost and not (self.damages and self.unchecked)

    @property
    def lost(self) -> int | None:
        """Messages lost, of all channels; None = unknown."""
        unknown = not self.channels and any(damage.counts is None for damage in self.damages)
        return None if unknown else _total(channel.lost for channel in self.channels)

    @property
    def recovered(self) -> int:
        """Messages recovered, of all channels."""
        return sum(channel.recovered for channel in self.channels)

    @property
    def damaged_bytes(self) -> int:
        """Bytes of the files that cannot be read."""
        return sum(damage.end - damage.offset for damage in self.damages)

    @property
    def loss(self) -> str:
        """What is lost, in one line; "" if everything was recovered."""
        if self.complete:
            return ""
        lost = [str(channel) for channel in self.channels if channel.lost != 0]
        more = f" and {len(lost) - _NAMED} more channels" if len(lost) > _NAMED else ""
        parts = [f"lost: {'; '.join(lost[:_NAMED])}{more}"] if lost else []
        parts += [damage.fault for damage in self.damages if damage.extra]
        if self.unchecked:
            parts.append(
                f"{self.unchecked} recovered messages have no checksum, so damage inside them "
                "cannot be noticed"
            )
        return "; ".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; None = unknown."""
        damages = [
            {
                "file": damage.file,
                "byte": damage.offset,
                "bytes": damage.end - damage.offset,
                "fault": damage.fault,
            }
            for damage in self.damages
        ]
        channels = {
            channel.topic: {
                "recovered_messages": channel.recovered,
                "lost_messages": channel.lost,
                "lost_bytes": channel.lost_bytes,
                "lost_seconds": channel.lost_s,
            }
            for channel in self.channels
        }
        return {
            "complete": self.complete,
            "loss": self.loss,
            "recovered_messages": self.recovered,
            "lost_messages": self.lost,
            "damaged_bytes": self.damaged_bytes,
            "unchecked_messages": self.unchecked,
            "channels": channels,
            "damages": damages,
        }

    def metadata(self) -> dict[str, str]:
        """Return :meth:`to_dict` as a metadata record holds it: what is no text is JSON."""
        return {
            key: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
            for key, value in self.to_dict().items()
        }


def merged(channels: Iterable[ChannelLoss]) -> tuple[ChannelLoss, ...]:
    """Add up the channels of each topic."""
    topics: dict[str, list[ChannelLoss]] = {}
    for channel in channels:
        topics.setdefault(channel.topic, []).append(channel)
    return tuple(
        ChannelLoss(
            topic,
            sum(one.recovered for one in same),
            _total(one.lost for one in same),
            _total(one.lost_bytes for one in same),
            _total(one.lost_s for one in same),
        )
        for topic, same in sorted(topics.items())
    )


def joined(parts: Sequence[tuple[str, Recovery]]) -> Recovery:
    """Return the recovery of a recording of several files, which are named."""
    channels = [channel for _, part in parts for channel in part.channels]
    if any(part.lost is None and not part.channels for _, part in parts):
        # A whole file is lost, with messages of any channel.
        channels += [
            ChannelLoss(topic, 0, None, None, None) for topic in {c.topic for c in channels}
        ]
    return Recovery(
        tuple(replace(d, file=name) for name, part in parts for d in part.damages),
        merged(channels),
        sum(part.unchecked for _, part in parts),
    )


def _total(numbers: Iterable[Number | None]) -> Number | int | None:
    """Return the sum of numbers; None if one of them is unknown."""
    numbers = list(numbers)
    counted = [n for n in numbers if n is not None]
    return sum(counted) if len(counted) == len(numbers) else None


class SeenMessages(NamedTuple):
    """Messages of one channel in one chunk."""

    number: int
    size: int
    """Bytes of their data."""
    first: int
    """Earliest log time, ns."""
    last: int
    """Latest log time, ns."""


def seen_in(messages: Table) -> dict[int, SeenMessages]:
    """Return what a chunk holds of each of its channels."""
    return dict(_by_channel(messages))


def _by_channel(messages: Table) -> Iterator[tuple[int, SeenMessages]]:
    for channel in np.unique(messages[:, CHANNEL]).tolist():
        rows = messages[messages[:, CHANNEL] == channel]
        size = int((rows[:, STOP] - rows[:, START]).sum())
        times = rows[:, LOG_TIME]
        yield channel, SeenMessages(len(rows), size, int(times.min()), int(times.max()))


class Remains(NamedTuple):
    """What the walk through a damaged file found."""

    channels: Mapping[int, Channel]
    """Those that are defined."""
    seen: Mapping[int, Mapping[int, SeenMessages]]
    """By offset of the chunk, by channel."""
    damages: Sequence[Damage]
    claimed: Statistics | None
    """What the summary says that there was."""

    def losses(self) -> tuple[ChannelLoss, ...]:
        """Return what is left of every channel that has, or may have had, messages."""
        ids = set(self.channels).union(*self.seen.values())
        ids = ids.union(*(damage.counts or () for damage in self.damages))
        return merged(self._loss(i) for i in sorted(ids))

    def _loss(self, channel: int) -> ChannelLoss:
        seen = [chunk[channel] for chunk in self.seen.values() if channel in chunk]
        kept = sum(s.number for s in seen)
        if channel not in self.channels:
            topic, size = f"channel {channel} without a definition", sum(s.size for s in seen)
            span = max(s.last for s in seen) - min(s.first for s in seen) if seen else None
            return ChannelLoss(topic, 0, kept, size, None if span is None else span * 1e-9)
        topic = self.channels[channel].topic
        suspects = [d for d in self.damages if d.counts is None or d.counts.get(channel)]
        lost = self._lost(channel, kept, suspects)
        if lost == 0:
            return ChannelLoss(topic, kept, 0, 0, 0.0)
        sizes = (None if d.sizes is None else d.sizes.get(channel, 0) for d in suspects)
        gaps = (self._gap(channel, d) for d in suspects)
        return ChannelLoss(topic, kept, lost, _total(sizes), _total(gaps))

    def _lost(self, channel: int, kept: int, suspects: Iterable[Damage]) -> int | None:
        """Messages of a channel that are lost, by the statistics or the message indexes."""
        if self.claimed is not None:
            counts = self.claimed.channel_message_counts
            if sum(counts.values()) == self.claimed.message_count:
                return max(0, counts.get(channel, 0) - kept)
        return _total(None if d.counts is None else d.counts[channel] for d in suspects)

    def _gap(self, channel: int, damage: Damage) -> float | None:
        """Time, s, without messages about some damage, of any channel that it may concern."""
        every = damage.counts is None
        before, after = [], []
        for offset, chunk in self.seen.items():
            some = [s for i, s in chunk.items() if every or i == channel]
            if offset < damage.offset:
                before += [s.last for s in some]
            elif offset >= damage.end:
                after += [s.first for s in some]
        start = max(before, default=damage.span and damage.span[0])
        end = min(after, default=damage.span and damage.span[1])
        return None if start is None or end is None else max(0, end - start) * 1e-9
