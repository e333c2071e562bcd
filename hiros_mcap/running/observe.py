"""Watches a run from the side and tells about it afterwards."""

from __future__ import annotations

import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap import notes
from hiros_mcap.events import TOO_LATE
from hiros_mcap.frames import Block
from hiros_mcap.io.log import Log
from hiros_mcap.skeletons import UNTRACKED
from hiros_mcap.summary import (
    CameraSummary,
    LimbSummary,
    PersonSummary,
    StageTime,
    Summary,
)
from hiros_mcap.systems import Run

DETECTIONS = "detections"
"""Name of what goes into the first stage."""
_GAP = 1_000_000_000  # ns: a pause of a camera that does not count for its rate
_JUMP = 10_000_000_000  # ns: no recorder delays a message by so much more than the one before
_LOOKED_AT = 20  # frames of each camera in which people are looked at
_LAGS = 500  # messages of each camera whose delay is looked at
_LARGE_M = 50.0  # no room is so large


class Stopwatch:
    """Adds up the CPU time of steps, of which each pulls from the one before in the same thread."""

    def __init__(self) -> None:
        self.cpu: defaultdict[str, float] = defaultdict(float)
        """Of each step, s."""
        self.started = time.perf_counter()
        self._running = ""
        self._since = time.thread_time()

    def charge(self, name: str, seconds: float) -> None:
        """Add what another thread did for a step."""
        self.cpu[name] += seconds

    def _switch(self, name: str) -> str:
        """Charge the time since the last switch to what was running; return its name."""
        now = time.thread_time()
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
            before = switch(name)
        switch(before)


@dataclass(slots=True)
class _Rhythm:
    """How often a camera sends."""

    last: int = 0
    intervals: int = 0
    time: int = 0
    lag: int = 0
    jumps: int = 0
    farthest: int = 0
    lags: list[int] = field(default_factory=list)
    """ns between the time and the log time of the first messages."""

    def beat(self, stamp: int, log_time: int) -> None:
        if len(self.lags) < _LAGS:
            self.lags.append(log_time - stamp)
        jump = abs(log_time - stamp - self.lag)
        if self.last and jump > _JUMP:
            self.jumps += 1
            self.farthest = max(self.farthest, jump)
        self.lag = log_time - stamp
        if self.last and 0 < stamp - self.last < _GAP:
            self.intervals += 1
            self.time += stamp - self.last
        self.last = stamp

    @property
    def rate(self) -> float:
        return self.intervals / self.time * 1e9 if self.time else float("nan")


@dataclass(slots=True)
class _Looks:
    """What the first people of every camera look like, to tell why nobody is found."""

    frames: Counter[str] = field(default_factory=Counter)
    sizes: list[float] = field(default_factory=list)
    """Typical absolute coordinate of each frame, m."""
    doubted: bool = True
    """Whether every marker has the confidence 0."""

    def look(self, block: Block) -> None:
        for i, source in enumerate(block.sources):
            if self.frames[source] < _LOOKED_AT and (frame := block.frame(i)).n_people:
                self.frames[source] += 1
                known = frame.positions[~np.isnan(frame.positions)]
                if known.size:
                    self.sizes.append(float(np.median(np.abs(known))))
                    self.doubted &= bool((frame.marker_confidences == 0).all())

    def reasons(self) -> Iterator[str]:
        """Say why nobody was found, where that can be seen."""
        size = float(np.median(self.sizes)) if self.sizes else 0.0
        if size > _LARGE_M:
            yield (
                f"coordinates are typically {size:.0f}, which looks like millimetres; skeletons "
                "and transforms have to be in metres"
            )
        if self.sizes and self.doubted:
            yield (
                "every marker has the confidence 0, so nobody can be believed; a detector that "
                "gives no confidences has to say NaN or -1"
            )


@dataclass(slots=True)
class _Seen:
    """When a person was in the output."""

    first: int
    last: int
    frames: int = 0


class Observer:
    """Counts what goes into the first stage and what comes out of every stage."""

    def __init__(self, log: Log, run: Run, chain: Sequence[str], watch: Stopwatch) -> None:
        self.watch = watch
        self.notes: list[str] = []
        """What the summary tells first."""
        self._log, self._run, self._chain = log, run, tuple(chain)
        self._rhythms: dict[str, _Rhythm] = {}
        self._people: dict[int, _Seen] = {}
        self._seen_by: defaultdict[str, set[int]] = defaultdict(set)
        self._written: Counter[str] = Counter()
        self._looks = _Looks()

    def see(self, channel: str, block: Block) -> None:
        """Note what goes into the first stage, or comes out of any."""
        if channel == DETECTIONS:
            self._see_input(block)
        else:
            self._see_output(channel, block)

    def _see_input(self, block: Block) -> None:
        """Note the rhythm of the cameras, and how their frames look."""
        self._looks.look(block)
        for stamp, source, log_time, _ in block.messages():
            rhythm = self._rhythms.get(source)
            if rhythm is None:
                rhythm = self._rhythms[source] = _Rhythm()
            rhythm.beat(stamp, log_time)

    def _see_output(self, channel: str, block: Block) -> None:
        """Note who is in the frames of a stage."""
        self._written[channel] += len(block)
        if channel != "tracked" and channel != self._chain[-1]:
            return
        ids = block.people.ids.tolist()
        groups = [ids[begin:end] for begin, end in block.rows.tolist()]
        if channel == "tracked":
            for source, group in zip(block.sources, groups, strict=True):
                self._seen_by[source].update(group)
        if channel == self._chain[-1]:
            for stamp, group in zip(block.stamps.tolist(), groups, strict=True):
                self._note(stamp, group)

    def _note(self, stamp: int, people: list[int]) -> None:
        """Note the people of a frame of the last stage."""
        for person in people:
            if person != UNTRACKED:
                seen = self._people.get(person)
                if seen is None:
                    seen = self._people[person] = _Seen(stamp, stamp)
                seen.frames += 1
                seen.first = min(seen.first, stamp)
                seen.last = max(seen.last, stamp)

    def _cameras_of(self, person: int) -> tuple[str, ...]:
        """Names of the cameras whose tracked frames hold a person, sorted."""
        return tuple(source for source, ids in sorted(self._seen_by.items()) if person in ids)

    def summary(self, target: str | None) -> Summary:
        """Everything noted so far."""
        start, end = self._log.span
        return Summary(
            source=str(self._log.path),
            target=target,
            log_s=(end - start) * 1e-9,
            wall_s=time.perf_counter() - self.watch.started,
            cameras=tuple(self.cameras()),
            people=tuple(self._person(i, self._people[i]) for i in sorted(self._people)),
            stages=tuple(
                StageTime(name, self.watch.cpu[name])
                for name in ("read", *self._chain, "write")
                if name in self.watch.cpu
            ),
            written={f"/hiros/{name}": self._written[name] for name in self._chain},
            notes=tuple(self._notes()),
        )

    def cameras(self) -> Iterator[CameraSummary]:
        """Tell what became of every camera's messages."""
        counts = self._run.events.counts
        for camera in self._log.cameras:
            account = self._log.accounts[camera.channel.topic]
            sources = sorted(camera.sources.values())
            rates = [self._rhythms[s].rate for s in sources if s in self._rhythms]
            # Of cameras that share messages, the one that lost most: a part of each was left out.
            late = max(counts[TOO_LATE, source] for source in sources)
            yield CameraSummary(
                name=", ".join(sources),
                topic=camera.channel.topic,
                rate_hz=sum(rates) / len(rates) if rates else float("nan"),
                messages=account.read,
                used=account.used - late,
                skipped={**account.skipped, **({TOO_LATE: late} if late else {})},
                flips=sum(counts["flip", source] for source in sources),
                outliers=sum(counts["outlier", source] for source in sources),
            )

    def _person(self, person: int, seen: _Seen) -> PersonSummary:
        return PersonSummary(
            id=person,
            first_ns=seen.first,
            last_ns=seen.last,
            frames=seen.frames,
            cameras=self._cameras_of(person),
            limbs=self._limbs(person),
        )

    def _limbs(self, person: int) -> LimbSummary | None:
        limbs = self._run.limbs.people.get(person)
        if "optimized" not in self._chain:
            return None
        if limbs:
            spread = {name: limb.deviation / limb.length for name, limb in limbs.items()}
            worst = max(spread, key=lambda name: spread[name])
            frames = max(limb.frames for limb in limbs.values())
            middle = float(np.median(list(spread.values())))
            return LimbSummary(frames, middle, spread[worst], worst, accepted=True)
        for event in reversed(self._run.events.log):
            if event.kind == "calibration rejected" and event.person == person:
                return LimbSummary(0, math.nan, math.nan, "", accepted=False, reason=event.detail)
        return None

    def _notes(self) -> Iterator[str]:
        """Tell what nobody asked for but should know."""
        yield from self.notes
        yield from self._log.remarks
        if not self._people:
            yield from self._looks.reasons()
        for account in self._log.accounts.values():
            if account.stale:
                yield f"{account.topic}: {account.stale} stale repeats of a skeleton left out"
            for kind, n in sorted(account.cleaned.items()):
                yield f"{account.topic}: {notes.cleaned(kind, n)}"
            if account.untimed:
                yield (
                    f"{account.topic}: {account.untimed} messages have no time, or one before "
                    "1970; the time at which they were logged is taken"
                )
            if account.first_error:
                yield f"{account.topic}: first fault of a message: {account.first_error}"
        shown = {"flip", "outlier", "optimizer outlier", TOO_LATE}
        totals: Counter[str] = Counter()
        for (kind, _), n in self._run.events.counts.items():
            totals[kind] += n
        for kind in sorted(totals.keys() - shown):
            yield notes.counted(kind, totals[kind])
        windows = self._run.config.optimize.calibration_windows
        measured = self._run.limbs.people or totals["calibration rejected"]
        if windows and self._people and "optimized" in self._chain and not measured:
            yield "limb lengths: nobody was seen in the calibration windows"
        yield from self._clock_notes()

    def _clock_notes(self) -> Iterator[str]:
        """Cameras whose clocks plainly differ or jump: nothing downstream can mend that."""
        for source, rhythm in sorted(self._rhythms.items()):
            if rhythm.jumps:
                yield (
                    f"the clock of {source} jumps ({rhythm.jumps} times, by up to "
                    f"{notes.duration(rhythm.farthest * 1e-9)}): it was set, or a message has a "
                    "wrong time"
                )
        lags = {s: sorted(r.lags)[len(r.lags) // 2] for s, r in self._rhythms.items()}
        if len(lags) > 1:
            early, late = min(lags, key=lambda s: lags[s]), max(lags, key=lambda s: lags[s])
            apart = (lags[late] - lags[early]) * 1e-9
            if apart > 0.2:
                yield f"the clocks of {early} and {late} seem to differ by {apart:.2f} s"
