"""Damages of a log, and the messages that were lost and recovered."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

from hiros_mcap.wording import quantity

RECOVERY_METADATA = "hiros.recovery"
"""Name of the metadata record that marks a log with losses."""
_NAMED = 6


class Lost(StrEnum):
    """Worst loss by a damage; REST: everything that followed in the file."""

    NOTHING = "nothing"
    EXTRA = "attachment or metadata"
    MESSAGES = "messages"
    REST = "everything"


@dataclass(frozen=True, slots=True)
class Damage:
    """A part of a file that cannot be read."""

    offset: int  # first byte
    end: int  # first byte after it
    fault: str
    lost: Lost
    file: str = ""  # name of the file, for a recording of several

    @property
    def place(self) -> str:
        """Where it begins."""
        return f"{self.file}, byte {self.offset}" if self.file else f"byte {self.offset}"


@dataclass(frozen=True, slots=True)
class ChannelLoss:
    """How many messages are left of the channels of a topic, and how many are not."""

    topic: str
    recovered: int
    lost: int | None  # none = unknown

    def __str__(self) -> str:
        number = "an unknown number of messages"
        return f"{self.topic}: {number if self.lost is None else quantity(self.lost, 'message')}"


@dataclass(frozen=True, slots=True)
class Recovery:
    """Damages and losses that a walk through the files of a log found."""

    damages: tuple[Damage, ...] = ()  # in the order of the files; empty for a healthy log
    channels: tuple[ChannelLoss, ...] = ()  # in the order of their topics
    unchecked: int = 0
    """Recovered messages that no checksum covers: damage inside them cannot be noticed."""

    @property
    def complete(self) -> bool:
        """Whether everything was recovered, and checked if there is any damage."""
        lost = self.lost != 0 or any(damage.lost == Lost.EXTRA for damage in self.damages)
        return not lost and not (self.damages and self.unchecked)

    @property
    def lost(self) -> int | None:
        """Messages lost, of all channels; None = unknown."""
        unknown = not self.channels and any(damage.lost == Lost.REST for damage in self.damages)
        return None if unknown else _total(channel.lost for channel in self.channels)

    @property
    def recovered(self) -> int:
        """Messages recovered, of all channels."""
        return sum(channel.recovered for channel in self.channels)

    @property
    def loss(self) -> str:
        """The losses in one line; "" if everything was recovered."""
        if self.complete:
            return ""
        lost = [str(channel) for channel in self.channels if channel.lost != 0]
        more = f" and {len(lost) - _NAMED} more channels" if len(lost) > _NAMED else ""
        parts = [f"lost: {'; '.join(lost[:_NAMED])}{more}"] if lost else []
        parts += [f"all from {d.place} on" for d in self.damages if lost and d.lost == Lost.REST]
        parts += [damage.fault for damage in self.damages if damage.lost == Lost.EXTRA]
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
                "lost": damage.lost,
            }
            for damage in self.damages
        ]
        channels = {
            channel.topic: {
                "recovered_messages": channel.recovered,
                "lost_messages": channel.lost,
            }
            for channel in self.channels
        }
        return {
            "complete": self.complete,
            "loss": self.loss,
            "recovered_messages": self.recovered,
            "lost_messages": self.lost,
            "damaged_bytes": sum(damage.end - damage.offset for damage in self.damages),
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
        ChannelLoss(topic, sum(one.recovered for one in same), _total(one.lost for one in same))
        for topic, same in sorted(topics.items())
    )


def joined(parts: Sequence[tuple[str, Recovery]]) -> Recovery:
    """Return the recovery of a recording of several files, which are named."""
    channels = [channel for _, part in parts for channel in part.channels]
    if any(part.lost is None and not part.channels for _, part in parts):
        # A whole file is lost, with messages of any channel.
        channels += [ChannelLoss(topic, 0, None) for topic in {c.topic for c in channels}]
    return Recovery(
        tuple(replace(d, file=name) for name, part in parts for d in part.damages),
        merged(channels),
        sum(part.unchecked for _, part in parts),
    )


def _total(numbers: Iterable[int | None]) -> int | None:
    """Return the sum of numbers; None if one of them is unknown."""
    counted = list(numbers)
    return None if None in counted else sum(number or 0 for number in counted)
