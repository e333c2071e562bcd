"""Watches a run from the side and tells about it afterwards."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from hiros_mcap.log import Log
from hiros_mcap.skeletons import UNTRACKED, Frame
from hiros_mcap.summary import (
    CameraSummary,
    LimbSummary,
    PersonSummary,
    StageTime,
    Summary,
)
from hiros_mcap.systems import Run

_GAP = 1_000_000_000  # ns: a pause of a camera that does not count for its rate


class Stopwatch:
    """Times nested generators: what a stage costs without the stages that it pulls from."""

    def __init__(self) -> None:
        self.wall: dict[str, float] = {}
        self.started = time.perf_counter()
        self._running = ""
        self._since = self.started

    def _switch(self, name: str) -> str:
        """Charge the time since the last switch to what was running; return its name."""
        now = time.perf_counter()
        before = self._running
        self.wall[before] = self.wall.get(before, 0.0) + now - self._since
        self._running, self._since = name, now
        return before

    @contextmanager
    def timing(self, name: str) -> Iterator[None]:
        """Charge a block to ``name``."""
        before = self._switch(name)
        try:
            yield
        finally:
            self._switch(before)

    def timed(self, name: str, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield ``frames``, charging the making of each to ``name``."""
        switch = self._switch
        before = switch(name)
        for frame in frames:
            switch(before)
            yield frame
            before = switch(name)
        switch(before)


@dataclass(slots=True)
class _Rhythm:
    """How often a camera sends."""

    last: int = 0
    intervals: int = 0
    time: int = 0

    def beat(self, stamp: int) -> None:
        if self.last and 0 < stamp - self.last < _GAP:
            self.intervals += 1
            self.time += stamp - self.last
        self.last = stamp

    @property
    def rate(self) -> float:
        return self.intervals / self.time * 1e9 if self.time else float("nan")


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
        self._seen_by: dict[str, set[bytes]] = {}
        self._written: Counter[str] = Counter()
        self._lag: dict[str, list[int]] = {}

    def watch_input(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield ``frames``, noting the rhythm of each camera."""
        for frame in frames:
            self._rhythms.setdefault(frame.source, _Rhythm()).beat(frame.stamp)
            lag = self._lag.setdefault(frame.source, [])
            if len(lag) < 500:
                lag.append(frame.log_time - frame.stamp)
            yield frame

    def watch_output(self, channel: str, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield ``frames`` of a stage, noting who is in them."""
        final, tracked = channel == self._chain[-1], channel == "tracked"
        for frame in frames:
            self._written[channel] += 1
            if tracked:
                self._seen_by.setdefault(frame.source, set()).add(frame.ids.tobytes())
            if final:
                self._note(frame)
            yield frame

    def _note(self, frame: Frame) -> None:
        """Note the people of a frame of the last stage."""
        for person in frame.ids.tolist():
            if person != UNTRACKED:
                seen = self._people.setdefault(person, _Seen(frame.stamp, frame.stamp))
                seen.frames += 1
                seen.first = min(seen.first, frame.stamp)
                seen.last = max(seen.last, frame.stamp)

    def _cameras_of(self, person: int) -> tuple[str, ...]:
        """Names of the cameras whose tracked frames hold a person, sorted."""
        return tuple(
            source
            for source, groups in sorted(self._seen_by.items())
            if any(person in np.frombuffer(ids, np.int32) for ids in groups)
        )

    def summary(self, target: str | None) -> Summary:
        """Everything noted so far."""
        start, end = self._log.span
        return Summary(
            source=str(self._log.path),
            target=target,
            log_s=(end - start) * 1e-9,
            wall_s=time.perf_counter() - self.watch.started,
            cameras=tuple(self._cameras()),
            people=tuple(self._person(i, self._people[i]) for i in sorted(self._people)),
            stages=tuple(
                StageTime(name, self.watch.wall[name])
                for name in ("read", *self._chain, "write")
                if name in self.watch.wall
            ),
            written={f"/hiros/{name}": self._written[name] for name in self._chain},
            notes=tuple(self._notes()),
        )

    def _cameras(self) -> Iterator[CameraSummary]:
        counts = self._run.events.counts
        for camera in self._log.cameras:
            account = self._log.accounts[camera.channel.topic]
            sources = sorted(camera.sources.values())
            rates = [self._rhythms[s].rate for s in sources if s in self._rhythms]
            yield CameraSummary(
                name=", ".join(sources),
                topic=camera.channel.topic,
                rate_hz=sum(rates) / len(rates) if rates else float("nan"),
                messages=account.read,
                used=account.used,
                skipped=dict(account.skipped),
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
        for account in self._log.accounts.values():
            if account.stale:
                yield f"{account.topic}: {account.stale} stale repeats of a skeleton left out"
            for kind, n in sorted(account.cleaned.items()):
                yield f"{account.topic}: {n} x {kind} taken out"
            if account.first_error:
                yield f"{account.topic}: first fault of a message: {account.first_error}"
        shown = {"flip", "outlier", "optimizer outlier"}
        totals: Counter[str] = Counter()
        for (kind, _), n in self._run.events.counts.items():
            totals[kind] += n
        for kind in sorted(totals.keys() - shown):
            yield f"{kind}: {totals[kind]}"
        windows = self._run.config.optimize.calibration_windows
        measured = self._run.limbs.people or totals["calibration rejected"]
        if windows and self._people and "optimized" in self._chain and not measured:
            yield "limb lengths: nobody was seen in the calibration windows"
        yield from self._clock_notes()

    def _clock_notes(self) -> Iterator[str]:
        """Cameras whose clocks plainly differ: nothing downstream can mend that."""
        lags = {s: sorted(lag)[len(lag) // 2] for s, lag in self._lag.items() if lag}
        if len(lags) > 1:
            early, late = min(lags, key=lambda s: lags[s]), max(lags, key=lambda s: lags[s])
            apart = (lags[late] - lags[early]) * 1e-9
            if apart > 0.2:
                yield f"the clocks of {early} and {late} seem to differ by {apart:.2f} s"
