"""What was lost of a damaged log, as far as that can be known."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from hiros_mcap.summary import quantity

RECOVERY_METADATA = "hiros.recovery"
"""Name of the metadata record that marks a log with losses."""
_NAMED = 6


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
        known = "an unknown number of bytes" if size is None else quantity(size, "byte")
        return f"{self.topic}: {quantity(self.lost, 'message')}, {known}, {seconds}"


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
            _seconds([one.lost_s for one in same]),
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


def _total(numbers: Iterable[int | None]) -> int | None:
    found = list(numbers)
    known = [n for n in found if n is not None]
    return sum(known) if len(known) == len(found) else None


def _seconds(times: Sequence[float | None]) -> float | None:
    known = [time for time in times if time is not None]
    return sum(known) if len(known) == len(times) else None
