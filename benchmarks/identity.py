"""Do people keep their ids? Logs of a few people from which detections are taken out.

    python benchmarks/identity.py [--detector ideal] [SEEDS [FIRST_SEED [section.param=value ...]]]
    python benchmarks/identity.py LOG.mcap ... [section.param=value ...]

Without logs they are simulated, with two people. In each scene of 24 s, at 8 s one person is hidden
from all cameras for 0.3 to 1 s, or leaves for 2 to 10 s, or both leave, at once or at times that
overlap. ``kept`` counts those who come back with the id that they had, ``new`` those with a new
one, ``swapped`` those with another person's.
``false`` counts merged skeletons farther than 0.5 m from everybody, and those of somebody who is
there twice, of ``frames``.

Logs are recordings in which nobody comes or leaves. ``ids`` are those of the whole log. Then, every
3 s of what was recorded, all cameras pause for 5, 10 or 20 s (``pause``), everybody is out of sight
while the cameras go on (``all away``), or one person is (``one away``). Who is who says the whole
log itself: people whose id it keeps over the absence are judged.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import itertools
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from scenes import params_of, use_detector

from hiros_mcap.config import Config, load_config
from hiros_mcap.events import Events
from hiros_mcap.frames import by_frame
from hiros_mcap.io.log import open_log
from hiros_mcap.running.preparation import camera_positions
from hiros_mcap.simulate import simulate
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, Stamps
from hiros_mcap.stages.known_cameras import KnownCameras
from hiros_mcap.systems import SYSTEMS, Run

ACTIONS = ("circle", "walk", "cross", "eight", "wave", "jog", "free_dynamic")
KINDS = ("hidden", "one leaves", "both leave", "overlapping")
BEGIN, SECONDS, NEAR = 8.0, 24.0, 0.5


def absences(kind: str, rng: np.random.Generator) -> dict[int, tuple[float, float]]:
    """Return who is away, and from when to when, s."""
    if kind == "overlapping":
        later = BEGIN + rng.uniform(0.5, 2.0)
        first, second = rng.uniform(3.0, 8.0, 2)
        return {0: (BEGIN, BEGIN + first), 1: (later, later + second)}
    end = BEGIN + (rng.uniform(0.3, 1.0) if kind == "hidden" else rng.uniform(2.0, 10.0))
    away = [0, 1] if kind == "both leave" else [int(rng.integers(2))]
    return dict.fromkeys(away, (BEGIN, end))


class Scene:
    """A simulated log in memory, with the true person of each detection."""

    def __init__(self, seed: int) -> None:
        action = ACTIONS[seed % len(ACTIONS)]
        cameras = 2 + seed % 3
        params = params_of(seed, people=2, cameras=cameras, seconds=SECONDS, action=action)
        self.start, truth = params.start, list(simulate(params).truth)
        self.stamps: Stamps = np.array([frame.stamp for frame in truth])
        self.truth: Floats = np.stack([f.positions[np.argsort(f.ids)] for f in truth])
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "log.mcap"
            write_log(path, params)
            with open_log(path) as log:
                self.frames = list(log.detections())
                self.model, self.cameras = log.model, camera_positions(log)

    def people_at(self, frame: Frame, near: float = NEAR) -> list[int]:
        """Whom each skeleton of a frame shows, -1 = nobody that is so near, m."""
        true = self.truth[min(np.searchsorted(self.stamps, frame.stamp), len(self.stamps) - 1)]
        if not frame.n_people:
            return []
        apart = np.linalg.norm(frame.positions[:, None] - true[None], axis=-1)
        distances = np.nanmean(apart, axis=-1)
        nearest = distances.argmin(axis=1)
        return [int(p) if d < near else -1 for p, d in zip(nearest, distances.min(1), strict=True)]

    def without(self, away: Mapping[int, tuple[float, float]]) -> list[Frame]:
        """The detections but for those of people who are away from one time to another, s.

        Also for those that the detector misplaces.
        """
        frames = []
        for frame in self.frames:
            t = (frame.stamp - self.start) * 1e-9
            gone = {person for person, (begin, end) in away.items() if begin <= t < end}
            shown = self.people_at(frame, near=np.inf) if gone else []
            here = [k for k, person in enumerate(shown) if person not in gone]
            frames.append(frame.select(here) if gone else frame)
        return frames

    def ids(self, tracked: Sequence[Frame], begin: float, end: float) -> dict[int, int]:
        """True person -> the most frequent id within a time, s."""
        first, last = self.start + round(begin * 1e9), self.start + round(end * 1e9)
        votes: dict[int, Counter[int]] = {}
        for frame in tracked:
            if first <= frame.stamp < last:
                for person, ident in zip(self.people_at(frame), frame.ids.tolist(), strict=True):
                    votes.setdefault(person, Counter())[ident] += 1
        return {person: ids.most_common(1)[0][0] for person, ids in votes.items() if person >= 0}

    def false(self, merged: Sequence[Frame]) -> int:
        """Count the merged skeletons that show nobody, or somebody a second time."""
        shown = [[p for p in self.people_at(frame) if p >= 0] for frame in merged]
        people = sum(frame.n_people for frame in merged)
        return people - sum(len(set(some)) for some in shown)


def run(scene: Scene, frames: Sequence[Frame], config: Config) -> tuple[list[Frame], list[Frame]]:
    """Track and merge; return the frames of both."""
    stages = SYSTEMS["hiros"].stages(
        Run(scene.model, config, Events(), known=KnownCameras(scene.cameras), fixed_frame="world")
    )
    tracked = list(by_frame(stages["tracked"])(frames))
    return tracked, list(by_frame(stages["merged"])(tracked))


class Recording:
    """The detections of a log, and the ids that the whole log gives them."""

    def __init__(self, path: Path, config: Config) -> None:
        with open_log(path) as log:
            detections = list(log.detections())
            self.model, self.cameras = log.model, camera_positions(log)
        self._config = config
        whole = self._track(detections)
        self._ids = {(frame.stamp, frame.source): frame.ids for frame in whole}
        self.frames = sorted(detections, key=lambda frame: frame.stamp)
        self.stamps: Stamps = np.array([frame.stamp for frame in self.frames])
        self.people = {int(i) for ids in self._ids.values() for i in ids} - {UNTRACKED}

    def _track(self, frames: Sequence[Frame]) -> list[Frame]:
        """Return the frames with ids."""
        run = Run(self.model, self._config, known=KnownCameras(self.cameras), fixed_frame="world")
        return list(by_frame(SYSTEMS["hiros"].stages(run)["tracked"])(frames))

    def begins(self) -> list[int]:
        """Times, ns, of every 3 s of what was recorded."""
        recorded = np.cumsum(np.minimum(np.diff(self.stamps, prepend=self.stamps[0]), 10**9))
        due = np.arange(4 * 10**9, recorded[-1] - 10**9, 3 * 10**9)
        return [int(t) for t in self.stamps[np.searchsorted(recorded, due)]]

    def present(self, begin: int, end: int) -> set[int]:
        """Return who is there for most of a time, ns."""
        shown = [ids.tolist() for (t, _), ids in self._ids.items() if begin <= t < end]
        counts = Counter(itertools.chain(*shown))
        return {person for person in self.people if counts[person] > 0.3 * len(shown)}

    def without(self, people: Iterable[int], begin: int, end: int) -> list[Frame]:
        """The detections but for those of some people from one time to another, ns."""
        gone = [UNTRACKED, *people]
        frames = []
        for frame in self.frames:
            there = ~np.isin(self._ids[frame.stamp, frame.source], gone)
            away = begin <= frame.stamp < end
            frames.append(frame.select(np.flatnonzero(there)) if away else frame)
        return frames

    def resumes(self, end: int) -> bool:
        """Whether the 2 s that follow a time, ns, were recorded without a pause."""
        later = self.stamps[self.stamps >= end]
        here = later[later < later[0] + 2 * 10**9] if len(later) else later
        return len(here) > 1 and here[-1] - here[0] > 1.8e9 and np.diff(here).max() < 0.5e9

    def outcomes(self, frames: Sequence[Frame], begin: int, end: int) -> Counter[str]:
        """Count what became of the ids of everybody who is there before and after a time, ns."""
        later = int(self.stamps[np.searchsorted(self.stamps, end)])
        spans = (begin - 10**9, begin), (later, later + 2 * 10**9)
        tracked = self._track(frames)
        before, after = (self._names(tracked, *span) for span in spans)
        counts = Counter[str]()
        for person in self.present(*spans[0]) & self.present(*spans[1]):
            old, new = before.get(person, UNTRACKED), after.get(person, UNTRACKED)
            others = {name for other, name in before.items() if other != person} - {UNTRACKED}
            counts["kept" if new == old else "swapped" if new in others else "new"] += 1
        return counts

    def _names(self, tracked: Sequence[Frame], begin: int, end: int) -> dict[int, int]:
        """Id in the whole log -> the most frequent id within a time, ns."""
        votes: dict[int, Counter[int]] = {}
        for frame in tracked:
            if begin <= frame.stamp < end:
                people = self._ids[frame.stamp, frame.source].tolist()
                for person, name in zip(people, frame.ids.tolist(), strict=True):
                    votes.setdefault(person, Counter())[name] += 1
        return {person: names.most_common(1)[0][0] for person, names in votes.items()}


def absences_of(log: Recording, begin: int, end: int) -> Iterator[tuple[str, list[Frame]]]:
    """Yield kinds of absence, and the detections that are left."""
    yield "pause", [frame for frame in log.frames if not begin <= frame.stamp < end]
    yield "all away", log.without(log.people, begin, end)
    for person in sorted(log.present(begin - 10**9, begin)):
        yield "one away", log.without([person], begin, end)


def recordings(paths: Sequence[Path], config: Config) -> None:
    """Print what becomes of the ids in recordings."""
    total: dict[str, Counter[str]] = {}
    for path in paths:
        log = Recording(path, config)
        print(f"{path.name}: {len(log.people)} ids", flush=True)
        for begin, seconds in itertools.product(log.begins(), (5, 10, 20)):
            end = begin + seconds * 10**9
            if not log.resumes(end):
                continue
            for kind, frames in absences_of(log, begin, end):
                outcomes = log.outcomes(frames, begin, end)
                total.setdefault(f"{kind} {seconds} s", Counter()).update(outcomes)
                if outcomes - Counter(kept=outcomes["kept"]):
                    at = (begin - int(log.stamps[0])) * 1e-9
                    print(f"  {kind} {seconds} s from {at:.1f} s: {dict(outcomes)}", flush=True)
    show(dict(sorted(total.items())), ("kept", "new", "swapped"))


def show(results: Mapping[str, Counter[str]], columns: Sequence[str]) -> None:
    """Print a table."""
    print(f"{'':14}" + "".join(f"{name:>9}" for name in columns))
    for kind, result in results.items():
        print(f"{kind:14}" + "".join(f"{result[name]:9d}" for name in columns))


def main() -> None:
    given = use_detector(sys.argv[1:])
    logs = [Path(a) for a in given if a.endswith(".mcap")]
    overrides = [a for a in given if "=" in a]
    if logs:
        recordings(logs, load_config(overrides=overrides, system="hiros"))
        return
    numbers = [int(a) for a in given if "=" not in a]
    seeds, first = numbers[0] if numbers else 20, numbers[1] if len(numbers) > 1 else 0
    config = load_config(overrides=overrides, system="hiros")
    results = {kind: Counter[str]() for kind in KINDS}
    for seed in range(first, first + seeds):
        scene, rng = Scene(seed), np.random.default_rng(seed)
        for kind in KINDS:
            away = absences(kind, rng)
            tracked, merged = run(scene, scene.without(away), config)
            before = scene.ids(tracked, BEGIN - 1.0, BEGIN)
            result = results[kind]
            for person, (_, end) in away.items():
                after = scene.ids(tracked, end, end + 2.0)
                old, new = before.get(person, UNTRACKED), after.get(person, UNTRACKED)
                swapped = new in {i for p, i in before.items() if p != person}
                outcome = "kept" if new == old else "swapped" if swapped else "new"
                result[outcome] += 1
                if outcome != "kept":
                    print(f"seed {seed}, {kind}, {away}: {outcome}", flush=True)
            result["false"] += scene.false(merged)
            result["frames"] += sum(frame.n_people for frame in merged)
    show(results, ("kept", "new", "swapped", "false", "frames"))


if __name__ == "__main__":
    main()
