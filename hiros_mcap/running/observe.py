"""Follows a run: what each camera sent, and who was in the output."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.frames import Block
from hiros_mcap.skeletons import UNTRACKED
from hiros_mcap.summary import duration, quantity

DETECTIONS = "detections"
"""Name of what goes into the first stage."""
_GAP = 1_000_000_000  # ns: a longer pause of a camera does not count for its rate
_JUMP = 10_000_000_000  # ns: no recorder delays one message so much more than the one before
_SAMPLED_FRAMES = 20  # of each camera
_SAMPLED_LAGS = 500  # messages of each camera
_CLOCKS_DIFFER = 0.2  # s
_TOO_LARGE = 50.0  # m: no laboratory is so large


@dataclass(slots=True)
class CameraClock:
    """When the messages of a camera were stamped and logged."""

    last: int = 0
    intervals: int = 0
    time: int = 0
    lag: int = 0
    jumps: int = 0
    longest_jump: int = 0
    """ns."""
    lags: list[int] = field(default_factory=list)
    """ns from the stamp to the log time of the first messages."""

    def add(self, stamp: int, log_time: int) -> None:
        """Take note of a message."""
        lag = log_time - stamp
        if len(self.lags) < _SAMPLED_LAGS:
            self.lags.append(lag)
        if self.last and abs(lag - self.lag) > _JUMP:
            self.jumps += 1
            self.longest_jump = max(self.longest_jump, abs(lag - self.lag))
        if self.last and 0 < stamp - self.last < _GAP:
            self.intervals += 1
            self.time += stamp - self.last
        self.lag, self.last = lag, stamp

    @property
    def rate(self) -> float:
        """Messages per second of the camera's own time, Hz; NaN below two messages."""
        return self.intervals / self.time * 1e9 if self.time else float("nan")


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
        for i, source in enumerate(block.sources):
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

    def add(self, stamp: int) -> None:
        """Take note of a frame."""
        self.frames += 1
        self.first = min(self.first, stamp)
        self.last = max(self.last, stamp)


class Observer:
    """Counts what goes into the first stage and what comes out of every stage.

    Attributes
    ----------
    clocks : by source. people : by id. seen_by : ids that the tracker gave, by source.
    written : frames by channel. sample : the first detections.
    """

    def __init__(self, chain: Sequence[str]) -> None:
        self.chain = tuple(chain)
        self.clocks: defaultdict[str, CameraClock] = defaultdict(CameraClock)
        self.people: dict[int, Presence] = {}
        self.seen_by: defaultdict[str, set[int]] = defaultdict(set)
        self.written: Counter[str] = Counter()
        self.sample = DetectionSample()

    def see(self, channel: str, block: Block) -> None:
        """Take note of what goes into the first stage, or comes out of any."""
        if channel == DETECTIONS:
            self.sample.add(block)
            for stamp, source, log_time, _ in block.messages():
                self.clocks[source].add(stamp, log_time)
            return
        self.written[channel] += len(block)
        if channel == "tracked":
            for source, ids in zip(block.sources, _ids(block), strict=True):
                self.seen_by[source].update(ids)
        if channel == self.chain[-1]:
            for stamp, ids in zip(block.stamps.tolist(), _ids(block), strict=True):
                for person in ids:
                    if person != UNTRACKED:
                        self.people.setdefault(person, Presence(stamp, stamp)).add(stamp)

    def cameras_of(self, person: int) -> tuple[str, ...]:
        """Return the sorted names of the cameras that saw a person."""
        return tuple(source for source, ids in sorted(self.seen_by.items()) if person in ids)


def _ids(block: Block) -> list[list[int]]:
    """Return the ids of the people of each frame."""
    ids = block.people.ids.tolist()
    return [ids[begin:end] for begin, end in block.rows.tolist()]


def clock_notes(clocks: Mapping[str, CameraClock]) -> Iterator[str]:
    """Yield what is plainly wrong with the cameras' clocks, which no stage can correct."""
    for source, clock in sorted(clocks.items()):
        if clock.jumps:
            yield (
                f"the clock of {source} jumps ({quantity(clock.jumps, 'time')}, by up to "
                f"{duration(clock.longest_jump * 1e-9)}); the clock was set, or messages have a "
                "wrong time"
            )
    lags = {source: sorted(clock.lags)[len(clock.lags) // 2] for source, clock in clocks.items()}
    if len(lags) > 1:
        early, late = min(lags, key=lambda s: lags[s]), max(lags, key=lambda s: lags[s])
        difference = (lags[late] - lags[early]) * 1e-9
        if difference > _CLOCKS_DIFFER:
            yield f"the clocks of {early} and {late} seem to differ by {difference:.2f} s"
