"""What becomes of every message that is read: its frames, without what was sent before."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from hiros_mcap.io.channels import CameraChannel
from hiros_mcap.io.codec import Decoded, MessagePart
from hiros_mcap.skeletons import People, widened

STALE = "repeat the one before"
DAMAGED = "cannot be decoded"
FAR_FUTURE = "log time after the year 2262"
"""Frames count ns in 63 bits; MCAP has 64."""
LATEST = 2**63 - 1


@dataclass(slots=True)
class Account:
    """What became of every message of a topic: read = used + skipped."""

    topic: str
    read: int = 0
    used: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    """Messages that gave no frame, by reason."""
    stale: int = 0
    """Skeletons left out of used messages because the camera had sent exactly them before."""
    cleaned: Counter[str] = field(default_factory=Counter)
    """Numbers taken out because they cannot be true, by kind (see kernels.cleaning)."""
    untimed: int = 0
    """Frames without a time of their own, to which the log time was given."""
    first_error: str = ""
    """What was wrong with the first message that could not be decoded."""


class Row(NamedTuple):
    """A frame of a block."""

    topic: str
    stamp: int
    log_time: int
    source: str
    frame_id: str
    begin: int
    end: int


class _LastMessage(NamedTuple):
    """The people of a camera's previous message."""

    times: Sequence[int]
    """Source time of each, ns; 0 = not given."""
    people: People
    begin: int
    """Row of the first of them."""


class CameraInput:
    """One channel being read: its account, and the last message of each of its cameras."""

    def __init__(self, camera: CameraChannel, account: Account) -> None:
        self.topic = camera.channel.topic
        self._names = dict(camera.sources)
        self._only = next(iter(self._names)) if len(self._names) == 1 else ""
        self._account = account
        self._previous: dict[str, _LastMessage] = {}

    def take(
        self, decoded: Decoded, i: int, log_times: Sequence[int], times: Sequence[int]
    ) -> list[Row]:
        """Account for message ``i``; return its frames, named, stamped and without repeats.

        ``log_times`` are of all messages, ``times`` of all people, ns.
        """
        account = self._account
        account.read += 1
        if log_times[i] > LATEST:
            account.skipped[FAR_FUTURE] += 1
            return []
        if i in decoded.faults:
            account.skipped[DAMAGED] += 1
            account.first_error = account.first_error or decoded.faults[i]
            return []
        if i in decoded.cleaned:
            account.cleaned.update(decoded.cleaned[i])
        rows: list[Row] = []
        for part in decoded.parts[i]:
            rows += self._fresh(decoded, i, part, log_times[i], times[part.begin : part.end])
        if rows:
            account.used += 1
            n_people = sum(part.end - part.begin for part in decoded.parts[i])
            account.stale += n_people - sum(row.end - row.begin for row in rows)
        else:
            account.skipped[STALE] += 1
        return rows

    def _fresh(
        self, decoded: Decoded, i: int, part: MessagePart, log_time: int, times: Sequence[int]
    ) -> Iterator[Row]:
        """Yield the frame of a part unless all of its people are repeats."""
        people, begin, end = decoded.people, part.begin, part.end
        # A message without people does not name its camera.
        source = part.source if times else self._only or part.source
        stamp = max(times, default=0) or max(0, decoded.stamps[i])
        if not stamp:
            self._account.untimed += 1
        last = self._previous.get(source)
        n_fresh = end - begin
        if last is not None and not (set(times) - {0}).isdisjoint(last.times):
            n_fresh = _repeats_last(people, begin, times, last)
            times = people.stamps[begin:end].tolist()
        self._previous[source] = _LastMessage(times, people, begin)
        if n_fresh or not times:
            name = self._names.get(source, source or self.topic)
            frame_id = part.frame_id.lstrip("/")
            yield Row(
                self.topic, stamp or log_time, log_time, name, frame_id, begin, begin + n_fresh
            )


def _repeats_last(people: People, begin: int, times: Sequence[int], last: _LastMessage) -> int:
    """Put people who repeat one of the last message behind the others; return how many do not.

    A repeat has the same source time, and the same bits in every number of markers and links.
    """
    before = {_bits(last.people, row, time) for row, time in enumerate(last.times, last.begin)}
    here = [_bits(people, row, time) for row, time in enumerate(times, begin)]
    repeated = [bits[0] != 0 and bits in before for bits in here]
    people.reorder(begin, sorted(range(len(here)), key=lambda p: repeated[p]))
    return repeated.count(False)


def _bits(people: People, row: int, time: int) -> tuple[int, bytes, bytes]:
    return time, widened(people.markers[row]).tobytes(), widened(people.links[row]).tobytes()
