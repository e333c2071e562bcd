"""Does a simulated log have the error that ``hiros plan`` expects?

    python benchmarks/planning.py [table | choose] [SEEDS [SECONDS]] [--detector kinect]

``table`` plans six rooms, simulates people who roam through each of them, and compares the mean
joint error, mm, of `hiros process` with the plan's, also by parts of the body: expected, then
measured. ``choose`` does the same in other rooms, whose cameras stand in the middle of walls as
well as where a plan puts them. The one number of the model that does not follow from the noise,
``RIGID`` of hiros_mcap/plan, was chosen on these. It also prints what that number should be.

A plan is told the noise of its detectors, by default that of the ideal one, and expects errors that
average out. So the ideal one is the default here; ``--detector kinect`` shows how far off a plan is
where whole limbs err together.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scenes import DETECTOR

from hiros_mcap.body.rotations import Rigid, from_matrix
from hiros_mcap.evaluate.logs import evaluate_log, find_truth
from hiros_mcap.plan.expected_error import RIGID
from hiros_mcap.plan.planning import RoomPlan, make_plan
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.cameras import aimed
from hiros_mcap.simulate.simulation import write_log

HEIGHT = 2.2
CHANNEL = "/hiros/filtered"


class Case(NamedTuple):
    """A room."""

    width: float
    depth: float
    cameras: int
    people: int
    planned: bool = True
    """Whether cameras stand where the plan puts them, else evenly along the walls."""


TABLE = [
    Case(4.0, 3.5, 2, 1),
    Case(5.5, 4.5, 3, 2),
    Case(6.5, 5.5, 4, 1),
    Case(10.0, 4.0, 5, 2),
    Case(7.5, 6.5, 6, 4),
    Case(8.0, 8.0, 8, 3),
]
CHOOSE = [
    Case(5.0, 4.0, 6, 2, planned=False),
    Case(6.0, 5.0, 4, 1, planned=False),
    Case(7.0, 6.0, 5, 3, planned=False),
    Case(6.0, 4.0, 2, 1),
    Case(7.0, 5.0, 4, 2),
    Case(9.0, 7.0, 6, 1),
]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(parents=[DETECTOR], add_help=False)
    parser.set_defaults(detector="ideal")
    given, arguments = parser.parse_known_args()
    cases = CHOOSE if arguments[:1] == ["choose"] else TABLE
    numbers = [int(text) for text in arguments if text.isdigit()]
    seeds, seconds = (*numbers, *(2, 40)[len(numbers) :])
    print("| room, m | cameras | people | expected | measured | ratio | torso | upper | lower |")
    print("|---|---|---|---|---|---|---|---|---|")
    ratios = []
    for case in cases:
        plan = planned(case)
        parts = [measured(plan.params, seed, seconds, given.detector) for seed in range(seeds)]
        mean = {name: float(np.mean([part[name] for part in parts])) for name in parts[0]}
        expected = {"all": plan.expected.error_mm, **plan.parts_mm}
        ratios.append(expected["all"] / mean["all"])
        of_parts = [f"{expected[name]:.1f} / {mean[name]:.1f}" for name in plan.parts_mm]
        row = [f"{case.width:g} x {case.depth:g}", str(case.cameras), str(case.people)]
        row += [f"{expected['all']:.1f}", f"{mean['all']:.1f}", f"{ratios[-1]:.2f}", *of_parts]
        print(f"| {' | '.join(row)} |", flush=True)
    mean_ratio = float(np.exp(np.mean(np.log(ratios))))
    print(
        f"geometric mean of the ratios {mean_ratio:.3f}; RIGID should be {RIGID / mean_ratio:.3f}"
    )


def planned(case: Case) -> RoomPlan:
    """Return the plan of a room."""
    w, d = case.width / 2, case.depth / 2
    params = SimulateParams(
        people=case.people, cameras=case.cameras, area=(-w, -d, w, d), action="roam"
    )
    return make_plan(params, HEIGHT, None if case.planned else along_the_walls(case))


def along_the_walls(case: Case) -> Mapping[str, Rigid]:
    """Return cameras at equal distances along the walls that look at the middle."""
    w, d = case.width, case.depth
    corners = np.array([[-w, -d], [w, -d], [w, d], [-w, d], [-w, -d]]) / 2
    ends = np.cumsum([0.0, w, d, w, d])
    poses = {}
    for k in range(case.cameras):
        along = (k + 0.5) / case.cameras * ends[-1]
        x, y = (np.interp(along, ends, corners[:, axis]) for axis in range(2))
        place = np.array([x, y, HEIGHT])
        poses[f"camera_{k}"] = Rigid(from_matrix(aimed(np.array([0, 0, 1.0]) - place)), place)
    return poses


def measured(params: SimulateParams, seed: int, seconds: float, kind: str) -> dict[str, float]:
    """Return the mean joint error, mm, of all joints and of each part of the body."""
    with tempfile.TemporaryDirectory() as folder:
        log, out = Path(folder) / "room.mcap", Path(folder) / "out.mcap"
        detector = params.detector.model_copy(update={"kind": kind})
        changes = {"seed": 1000 + seed, "seconds": seconds, "detector": detector}
        write_log(log, params.model_copy(update=changes))
        process(log, out)
        truth = find_truth(log)
        assert truth is not None
        scores = evaluate_log(out, truth, [CHANNEL])[CHANNEL].scores
    return {"all": scores.mean, **{name: part.mean for name, part in scores.parts.items()}}


if __name__ == "__main__":
    main()
