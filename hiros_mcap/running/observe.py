"""Follows a run: what each camera sent, who was in the output, and the CPU time of its steps."""

from __future__ import annotations

import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.defaults import LEAST_CONFIDENCE
from hiros_mcap.frames import Block
from hiros_mcap.skeletons import UNTRACKED, Flags, Stamps
from hiros_mcap.threads import cpu_time

DETECTIONS = "detections"
"""Name of what goes into the first stage."""
_GAP = 1_000_000_000  # ns: a longer pause of a camera does not count for its rate
_SAMPLED_FRAMES = 20  # of each camera
_TOO_LARGE = 50.0  # m: no laboratory is so large


@dataclass(slots=True)
class MessageRate:
    """How often a camera sends messages."""

    last: int = 0
    intervals: int = 0
    time: int = 0  # ns

    def add(self, stamps: Stamps) -> None:
        """Take note of messages, in order."""
        intervals = np.diff(stamps, prepend=self.last or stamps[0])
        regular = intervals[(intervals > 0) & (intervals < _GAP)]
        self.intervals += len(regular)
        self.time += int(regular.sum())
        self.last = int(stamps[-1])

    @property
    def hertz(self) -> float:
        """Messages per second of the camera's own time, Hz; NaN below two messages."""
        return self.intervals / self.time * 1e9 if self.time else float("nan")


@dataclass(slots=True)
class DetectionSample:
    """The first detections of every camera, which may tell why nobody is found."""

    frames: Counter[str] = field(default_factory=Counter)
    sizes: list[float] = field(default_factory=list)  # median absolute coordinate of each frame, m
    all_zero: bool = True  # whether every marker has the confidence 0

    def add(self, block: Block) -> None:
        """Take note of the frames of cameras that are not yet known well enough."""
        for i, (_, source, _) in enumerate(block.messages()):
            if self.frames[source] < _SAMPLED_FRAMES and (frame := block.frame(i)).n_people:
                self.frames[source] += 1
                present = frame.positions[~np.isnan(frame.positions)]
                if present.size:
                    self.sizes.append(float(np.median(np.abs(present))))
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

    def add(self, stamps: Stamps, predicted: Flags) -> None:
        """Take note of frames."""
        self.frames += len(stamps)
        self.predicted += int(predicted.sum())
        self.first = min(self.first, int(stamps.min()))
        self.last = max(self.last, int(stamps.max()))


class Observer:
    """Counts what goes into the first stage and what comes out of every stage.

    Attributes
    ----------
    rates : by source. people : by id. seen_by : ids that the tracker gave, by source.
    written : frames by channel. sample : the first detections.
    delays : how long after their time results of the last stage were known, in ms.

    ``prompt`` : see McapReader. Later messages lay in a queue while the run was busy.
    """

    def __init__(
        self, chain: Sequence[str], prompt: Callable[[], tuple[float, int]] = lambda: (math.inf, 0)
    ) -> None:
        self.chain, self._prompt = tuple(chain), prompt
        self.rates: defaultdict[str, MessageRate] = defaultdict(MessageRate)
        self.people: dict[int, Presence] = {}
        self.seen_by: defaultdict[str, set[int]] = defaultdict(set)
        self.written: Counter[str] = Counter()
        self.sample = DetectionSample()
        self.delays: Counter[int] = Counter()

    def see(self, channel: str, block: Block) -> None:
        """Take note of what goes into the first stage, or comes out of any."""
        if channel == DETECTIONS:
            self.sample.add(block)
            for code in np.unique(block.sources).tolist():
                self.rates[block.names[code]].add(block.stamps[block.sources == code])
            return
        self.written[channel] += len(block)
        if channel == "tracked":
            rows, owners = block.everybody()
            for code in np.unique(block.sources).tolist():
                ids = block.people.ids[rows[block.sources[owners] == code]]
                self.seen_by[block.names[code]].update(np.unique(ids).tolist())
        if channel == self.chain[-1]:
            (at, log_time), logged = self._prompt(), block.log_times
            passed = int(max(time.perf_counter() - at, 0.0) * 1e9)
            known = logged + np.maximum(passed - np.maximum(logged - log_time, 0), 0)
            self.delays.update(((known - block.stamps) // 1_000_000).tolist())
            self._count(block)

    def _count(self, block: Block) -> None:
        """Take note of who is in the frames of the last stage."""
        rows, owners = block.everybody()
        ids, unseen = block.people.ids[rows], block.people.confidences[rows] < LEAST_CONFIDENCE
        _, firsts = np.unique(ids, return_index=True)
        for person in ids[np.sort(firsts)].tolist():
            if person != UNTRACKED:
                is_theirs = ids == person
                stamps = block.stamps[owners[is_theirs]]
                presence = self.people.setdefault(person, Presence(int(stamps[0]), int(stamps[0])))
                presence.add(stamps, unseen[is_theirs])

    def delay(self, share: float) -> float:
        """Return the delay, s, that a share of the results, %, have at most; there are some."""
        values, counts = zip(*sorted(self.delays.items()), strict=True)
        below = np.cumsum(counts) >= share / 100 * sum(counts)
        return 0.001 * float(values[int(np.argmax(below))])

    def cameras_of(self, person: int) -> tuple[str, ...]:
        """Return the sorted names of the cameras that saw a person."""
        return tuple(source for source, ids in sorted(self.seen_by.items()) if person in ids)


class Stopwatch:
    """Adds up the CPU time of steps that pull from each other in one thread."""

    def __init__(self) -> None:
        self.cpu: defaultdict[str, float] = defaultdict(float)  # of each step, s
        self.started = time.perf_counter()
        self._running = ""
        self._since = cpu_time()

    def charge(self, name: str, seconds: float) -> None:
        """Add what another thread did for a step."""
        self.cpu[name] += seconds

    def _switch(self, name: str) -> str:
        """Charge the time since the last switch to what was running; return its name."""
        now = cpu_time()
        before = self._running
        self.cpu[before] += now - self._since
        self._running, self._since = name, now
        return before

    @contextmanager
    def timing(self, name: str) -> Iterator[None]:
        """Charge a block of statements to ``name``."""
        before = self._switch(name)
        try:
            yield
        finally:
            self._switch(before)

    def timed(
        self, name: str, blocks: Iterable[Block], sink: Callable[[Block], None]
    ) -> Iterator[Block]:
        """Yield ``blocks``, charging the making of each to ``name`` and its sink to "write"."""
        switch = self._switch
        before = switch(name)
        for block in blocks:
            switch("write")
            sink(block)
            switch(before)
            yield block
            del block  # else it would lie in memory until the next one is made
            before = switch(name)
        switch(before)
