"""Follows a run: what each camera sent, and who was in the output."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.defaults import LEAST_CONFIDENCE
from hiros_mcap.frames import Block
from hiros_mcap.skeletons import UNTRACKED, Stamps

DETECTIONS = "detections"
"""Name of what goes into the first stage."""
_GAP = 1_000_000_000  # ns: a longer pause of a camera does not count for its rate
_PAUSES_PER_MESSAGE = 0.1
_SAMPLED_FRAMES = 20  # of each camera
_TOO_LARGE = 50.0  # m: no laboratory is so large


@dataclass(slots=True)
class MessageRate:
    """How often a camera sends messages."""

    last: int = 0
    intervals: int = 0
    time: int = 0
    """ns."""

    def add(self, stamp: int) -> None:
        """Take note of a message."""
        if self.last and 0 < stamp - self.last < _GAP:
            self.intervals += 1
            self.time += stamp - self.last
        self.last = stamp

    @property
    def hertz(self) -> float:
        """Messages per second of the camera's own time, Hz; NaN below two messages."""
        return self.intervals / self.time * 1e9 if self.time else float("nan")


@dataclass(slots=True)
class CommonPauses:
    """When no camera sent anything, although they usually do."""

    latest: int = 0
    messages: int = 0
    found: list[tuple[int, int]] = field(default_factory=list)
    """Start and end of each step of more than a second, ns."""

    def add(self, stamps: Stamps) -> None:
        """Take note of the times of messages, in the order in which they are read."""
        if not self.messages and len(stamps):
            self.latest = int(stamps[0])
        before = np.maximum.accumulate(np.concatenate([[self.latest], stamps]))
        starts = np.flatnonzero(stamps - before[:-1] > _GAP)
        self.found += zip(before[starts].tolist(), stamps[starts].tolist(), strict=True)
        self.latest, self.messages = int(before[-1]), self.messages + len(stamps)

    def notes(self, start: int) -> Iterator[str]:
        """Yield when nobody sent anything, in seconds from ``start``, ns."""
        # Cameras that send once in some seconds do not pause.
        if not self.found or len(self.found) > _PAUSES_PER_MESSAGE * self.messages:
            return
        first, last = max(self.found, key=lambda span: span[1] - span[0])
        when = f"from {(first - start) * 1e-9:.1f} to {(last - start) * 1e-9:.1f} s"
        if len(self.found) == 1:
            yield f"all cameras pause {when}"
        else:
            seconds = sum(b - a for a, b in self.found) * 1e-9
            yield (
                f"all cameras pause {len(self.found)} times, {seconds:.1f} s in all; the longest "
                f"pause is {when}"
            )


@dataclass(slots=True)
class DetectionSample:
    """The first detections of every camera, which may tell why nobody is found."""

    frames: Counter[str] = field(default_factory=Counter)
    sizes: list[float] = field(default_factory=list)
    """Median absolute coordinate of each frame, m."""
    all_zero: bool = True
    """Whether every marker has the confidence 0."""

    def add(self, block: Block) -> None:
        """Take note of the frames of cameras that are not yet known well enough."""
        for i, (_, source, _) in enumerate(block.messages()):
            if self.frames[source] < _SAMPLED_FRAMES and (frame := block.frame(i)).n_people:
                self.frames[source] += 1
                known = frame.positions[~np.isnan(frame.positions)]
                if known.size:
                    self.sizes.append(float(np.median(np.abs(known))))
                    self.all_zero &= bool((frame.marker_confidences == 0).all())

    def reasons(self) -> Iterator[str]:
        """Yield what may explain that nobody was found."""
        size = float(np.median(self.sizes)) if self.sizes else 0.0
        if size > _TOO_LARGE:
            yield (
                f"coordinates are typically {size:.0f}, which looks like millimetres; hiros needs "
                "skeletons and transforms in metres"
            )
        if self.sizes and self.all_zero:
            yield (
                "every marker has confidence 0, so all were ignored; a detector without "
                "confidences must write NaN or -1"
            )


@dataclass(slots=True)
class Presence:
    """When a person was in the output."""

    first: int
    last: int
    frames: int = 0
    predicted: int = 0

    def add(self, stamp: int, *, is_predicted: bool) -> None:
        """Take note of a frame."""
        self.frames += 1
        self.predicted += is_predicted
        self.first = min(self.first, stamp)
        self.last = max(self.last, stamp)


class Observer:
    """Counts what goes into the first stage and what comes out of every stage.

    Attributes
    ----------
    rates : by source. people : by id. seen_by : ids that the tracker gave, by source.
    written : frames by channel. sample : the first detections. pauses : of all cameras at once.
    """

    def __init__(self, chain: Sequence[str]) -> None:
        self.chain = tuple(chain)
        self.rates: defaultdict[str, MessageRate] = defaultdict(MessageRate)
        self.people: dict[int, Presence] = {}
        self.seen_by: defaultdict[str, set[int]] = defaultdict(set)
        self.written: Counter[str] = Counter()
        self.sample = DetectionSample()
        self.pauses = CommonPauses()

    def see(self, channel: str, block: Block) -> None:
        """Take note of what goes into the first stage, or comes out of any."""
        if channel == DETECTIONS:
            self.sample.add(block)
            self.pauses.add(block.stamps)
            for stamp, source, _ in block.messages():
                self.rates[source].add(stamp)
            return
        self.written[channel] += len(block)
        if channel == "tracked":
            for (_, source, _), ids in zip(block.messages(), _ids(block), strict=True):
                self.seen_by[source].update(ids)
        if channel == self.chain[-1]:
            self._count(block)

    def _count(self, block: Block) -> None:
        """Take note of who is in the frames of the last stage."""
        ids, unseen = block.people.ids.tolist(), block.people.confidences < LEAST_CONFIDENCE
        for stamp, (begin, end) in zip(block.stamps.tolist(), block.rows.tolist(), strict=True):
            for row in range(begin, end):
                if ids[row] != UNTRACKED:
                    presence = self.people.setdefault(ids[row], Presence(stamp, stamp))
                    presence.add(stamp, is_predicted=bool(unseen[row]))

    def cameras_of(self, person: int) -> tuple[str, ...]:
        """Return the sorted names of the cameras that saw a person."""
        return tuple(source for source, ids in sorted(self.seen_by.items()) if person in ids)


def _ids(block: Block) -> list[list[int]]:
    """Return the ids of the people of each frame."""
    ids = block.people.ids.tolist()
    return [ids[begin:end] for begin, end in block.rows.tolist()]
