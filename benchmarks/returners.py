"""Who comes back through the one door of a room: five people who come and go, and never meet.

    PYTHONPATH=.:cli:schemas:viewer python benchmarks/returners.py [--detector ideal] [--rate 30]
        [--minutes 6] [--system fuse] [SEEDS [FIRST_SEED]]

Each has a place of his own, walks about in it for 12 to 40 s, and leaves for 4 to 25 s, one through
the door at a time. Three cameras, none of which sees beyond the door. ``kept`` counts returns with
the id of before, ``new`` those with a new one, ``others'`` those with an id that somebody else had.
``lost`` are returns of whom nothing is seen for 3 s. ``ids`` are those of the whole log.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scenes import DETECTOR, Scene, params_of, use_detector

from hiros_mcap.config import load_config
from hiros_mcap.evaluate.logs import read_results
from hiros_mcap.running.pipeline import process
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.simulate import simulate
from hiros_mcap.simulate.body_model import BodyModel
from hiros_mcap.simulate.motion import WALK, Person, Walker
from hiros_mcap.skeletons import Floats, Frame

PEOPLE, CAMERAS = 5, 3
DOOR, OUTSIDE = np.array([2.4, 0.0]), np.array([14.0, 0.0])
BAY_M, ROUND_M, ROUND_S = 2.9, 0.3, 9.0
"""From the door to the places, and the rounds that people walk in them."""
STAYS_S, AWAY_S, APART_S = (12.0, 40.0), (4.0, 25.0), 4.0
"""``APART_S`` : from one passage of the door to the next."""
SPEED, OUT_S = 1.2, 4.0
BEFORE_S, AFTER_S, NEAR_M = 2.0, 3.0, 0.5


@dataclass(frozen=True)
class Table:
    """A path that is tabulated; see :data:`hiros_mcap.simulate.paths.Path`."""

    times: Floats
    places: Floats
    headings: Floats

    @classmethod
    def of(cls, visits: Sequence[tuple[float, float]], bay: Floats, end: float) -> Table:
        """Return the path of somebody who goes through the door at both ends of each visit, s."""
        way = float(np.linalg.norm(bay - DOOR)) / SPEED
        knots = [(-1.0, OUTSIDE)]
        for enters, leaves in visits:
            knots += [(enters - OUT_S, OUTSIDE), (enters, DOOR), (enters + way, bay)]
            knots += [(leaves - way, bay), (leaves, DOOR), (leaves + OUT_S, OUTSIDE)]
        knots.append((max(end, knots[-1][0]) + 1.0, knots[-1][1]))
        at, where = np.array([t for t, _ in knots]), np.array([place for _, place in knots])
        times: Floats = np.arange(-1.0, end + 1.0, 0.05)
        places = np.stack([np.interp(times, at, where[:, k]) for k in range(2)], axis=1)
        inside = np.linalg.norm(places - bay, axis=1) < 1e-6
        share = _smooth(inside.astype(float), 20)
        angle = 2 * np.pi * times / ROUND_S
        round_ = ROUND_M * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        places = np.stack([_smooth(c, 12) for c in (places + share[:, None] * round_).T], axis=1)
        ways = np.gradient(places, times, axis=0)
        turns = np.unwrap(np.arctan2(*ways.T[::-1]))
        return cls(times, places, _smooth(turns, 12))

    def position(self, t: Floats) -> Floats:
        return np.stack([np.interp(t, self.times, c) for c in self.places.T], axis=-1)

    def heading(self, t: Floats) -> Floats:
        return np.interp(t, self.times, self.headings)


def _smooth(values: Floats, n: int) -> Floats:
    return np.asarray(
        np.convolve(np.pad(values, n, mode="edge"), np.hanning(2 * n + 1) / n, "valid")
    )


def visits_of(seconds: float, rng: np.random.Generator) -> list[list[tuple[float, float]]]:
    """Return when each person comes and goes, s: nobody passes the door while another does."""
    passages = np.zeros(0)

    def free(t: float) -> float:
        nonlocal passages
        while len(passages) and np.abs(passages - t).min() < APART_S:
            t += 0.5
        passages = np.append(passages, t)
        return t

    people: list[list[tuple[float, float]]] = [[] for _ in range(PEOPLE)]
    comes = [(free(2.0 + 5.0 * p), p) for p in range(PEOPLE)]
    while comes:
        enters, p = min(comes)
        comes.remove((enters, p))
        leaves = free(enters + rng.uniform(*STAYS_S))
        people[p].append((enters, leaves))
        back = free(leaves + rng.uniform(*AWAY_S))
        if back < seconds - 8.0:
            comes.append((back, p))
    return people


def scene(seed: int, seconds: float, rate: float) -> tuple[Scene, list[list[tuple[float, float]]]]:
    """Return a log, and the visits of each person."""
    rng = np.random.default_rng(seed)
    params = params_of(
        seed, people=PEOPLE, cameras=CAMERAS, seconds=seconds, rig={"rate": rate}, truth_rate=10.0
    )
    simulation, visits = simulate(params), visits_of(seconds, rng)
    bearings = np.pi + np.radians(26.0) * (np.arange(PEOPLE) - PEOPLE // 2)
    people = []
    for person, bearing in zip(visits, rng.permutation(bearings).tolist(), strict=True):
        bay = DOOR + BAY_M * np.array([np.cos(bearing), np.sin(bearing)])
        body = BodyModel.of(rng.uniform(*params.heights), params.proportions, rng)
        walker = Walker(body, Table.of(person, bay, seconds), WALK, rng.random())  # type: ignore[arg-type]
        people.append(Person(body, walker.posture))
    simulation.__dict__["people"] = people  # before anything asks for it
    places = {camera.name: camera.pose for camera in simulation.cameras}
    frames, truth = list[Frame](), list(simulation.truth)
    for frame in simulation.detections:
        middles = np.nanmean(places[frame.source].moved(frame.positions), axis=1)
        frames.append(frame.select(np.flatnonzero(middles[:, 0] < DOOR[0])))
    clocks = dict.fromkeys(simulation.transforms, 0.0)
    return Scene(simulation.model, frames, simulation.transforms, clocks, truth), visits


def names(
    results: Sequence[Frame], truth: Sequence[Frame], span: tuple[float, float], person: int
) -> int:
    """Return the most frequent id of a person within a time, s; -1 if nobody is there."""
    start, votes = truth[0].stamp, Counter[int]()
    stamps = np.array([frame.stamp for frame in truth])
    for frame in results:
        seconds = (frame.stamp - start) * 1e-9
        if span[0] <= seconds < span[1] and frame.n_people:
            true = truth[int(np.abs(stamps - frame.stamp).argmin())]
            here = true.positions[int(np.flatnonzero(true.ids == person)[0])]
            off = np.nanmean(np.linalg.norm(frame.positions - here, axis=2), axis=1)
            if off.min() < NEAR_M:
                votes[int(frame.ids[off.argmin()])] += 1
    return votes.most_common(1)[0][0] if votes else -1


def outcomes(
    results: Sequence[Frame],
    truth: Sequence[Frame],
    visits: Sequence[Sequence[tuple[float, float]]],
) -> Iterator[str]:
    """Yield what became of each return."""
    owners: dict[int, int] = {}
    events = sorted(
        (enters, p, k) for p, times in enumerate(visits) for k, (enters, _) in enumerate(times)
    )
    for enters, p, k in events:
        now = names(results, truth, (enters + 1.0, enters + 1.0 + AFTER_S), p)
        if k:
            leaves = visits[p][k - 1][1]
            before = names(results, truth, (leaves - 1.0 - BEFORE_S, leaves - 1.0), p)
            if now < 0 or before < 0:
                yield "lost"
            elif now == before:
                yield "kept"
            else:
                yield "new" if owners.get(now, p) == p else "others'"
        if now >= 0:
            owners.setdefault(now, p)


def main() -> None:
    parser = argparse.ArgumentParser(parents=[DETECTOR])
    parser.add_argument("--rate", type=float, default=10.0, help="Hz")
    parser.add_argument("--minutes", type=float, default=6.0)
    parser.add_argument("--system", default="fuse")
    parser.add_argument("seeds", type=int, nargs="?", default=2)
    parser.add_argument("first", type=int, nargs="?", default=4100)
    given = parser.parse_args(use_detector(sys.argv[1:]))
    kinds = ("kept", "new", "others'", "lost")
    print(f"| seed | {' | '.join(kinds)} | ids |\n|{'---|' * 6}")
    total = Counter[str]()
    for seed in range(given.first, given.first + given.seeds):
        made, visits = scene(seed, 60.0 * given.minutes, given.rate)
        with tempfile.TemporaryDirectory() as folder:
            log, out = Path(folder) / "log.mcap", Path(folder) / "out.mcap"
            made.write(log, transforms=True)
            config = load_config(None, (), system=given.system)
            process(log, out, config=config, options=ProcessOptions(system=given.system, keep=()))
            (results,) = read_results(out, ["/hiros/filtered"]).values()
        counts = Counter(outcomes(results.frames, made.truth, visits))
        ids = {int(i) for frame in results.frames for i in frame.ids}
        print(f"| {seed} | {' | '.join(str(counts[k]) for k in kinds)} | {len(ids)} |", flush=True)
        total += counts
    print(f"| all | {' | '.join(str(total[k]) for k in kinds)} | |")


if __name__ == "__main__":
    main()
