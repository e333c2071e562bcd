"""Do people keep their ids? Simulated logs of two people from which detections are taken out.

    python benchmarks/identity.py [SEEDS [FIRST_SEED [section.param=value ...]]]

In each scene of 24 s, at 8 s one person is hidden from all cameras for 0.3 to 1 s, or leaves for 2
to 10 s, or both leave, at once or at times that overlap. ``kept`` counts those who come back with
the id that they had, ``new`` those with a new one, ``swapped`` those with another person's.
``false`` counts merged skeletons farther than 0.5 m from everybody, and those of somebody who is
there twice, of ``frames``.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hiros_mcap.config import Config, load_config
from hiros_mcap.events import Events
from hiros_mcap.io.log import open_log
from hiros_mcap.running.preparation import camera_positions
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.simulate.write_log import write_log
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, Stamps
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
        params = SimulateParams.model_validate(
            {"people": 2, "cameras": cameras, "seconds": SECONDS, "seed": seed, "action": action}
        )
        self.start, truth = params.start, list(simulate(params).truth)
        self.stamps: Stamps = np.array([frame.stamp for frame in truth])
        self.truth: Floats = np.stack([f.positions[np.argsort(f.ids)] for f in truth])
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "log.mcap"
            write_log(path, params)
            with open_log(path) as log:
                self.frames = list(log.detections())
                self.model, self.cameras = log.model, camera_positions(log)

    def people_at(self, frame: Frame) -> list[int]:
        """Whom each skeleton of a frame shows, -1 = nobody."""
        true = self.truth[min(np.searchsorted(self.stamps, frame.stamp), len(self.stamps) - 1)]
        if not frame.n_people:
            return []
        apart = np.linalg.norm(frame.positions[:, None] - true[None], axis=-1)
        distances = np.nanmean(apart, axis=-1)
        nearest = distances.argmin(axis=1)
        return [int(p) if d < NEAR else -1 for p, d in zip(nearest, distances.min(1), strict=True)]

    def without(self, away: Mapping[int, tuple[float, float]]) -> list[Frame]:
        """The detections but for those of people who are away from one time to another, s."""
        frames = []
        for frame in self.frames:
            t = (frame.stamp - self.start) * 1e-9
            gone = {person for person, (begin, end) in away.items() if begin <= t < end}
            here = [k for k, p in enumerate(self.people_at(frame)) if p not in gone] if gone else []
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
    from hiros_mcap.frames import by_frame

    stages = SYSTEMS["hiros"].stages(
        Run(scene.model, config, Events(), cameras=scene.cameras, fixed_frame="world")
    )
    tracked = list(by_frame(stages["tracked"])(frames))
    return tracked, list(by_frame(stages["merged"])(tracked))


def main() -> None:
    numbers = [int(a) for a in sys.argv[1:] if "=" not in a]
    seeds, first = numbers[0] if numbers else 20, numbers[1] if len(numbers) > 1 else 0
    config = load_config(overrides=[a for a in sys.argv[1:] if "=" in a], system="hiros")
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
    columns = ("kept", "new", "swapped", "false", "frames")
    print(f"{'':12}" + "".join(f"{name:>9}" for name in columns))
    for kind, result in results.items():
        print(f"{kind:12}" + "".join(f"{result[name]:9d}" for name in columns))


if __name__ == "__main__":
    main()
