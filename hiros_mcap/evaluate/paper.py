"""The experiments of the Hi-ROS paper (section 4) on simulated logs with truth.

Sixteen actions, one to four people, five cameras; three configurations: tracker (T), tracker,
merger and filter (TMF), and all four (TMOF).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from hiros_mcap.config import Config
from hiros_mcap.evaluate.logs import evaluate_log
from hiros_mcap.evaluate.published import ANGLES
from hiros_mcap.evaluate.scores import Scores
from hiros_mcap.evaluate.truth import load_truth
from hiros_mcap.running.pipeline import ProcessOptions, Progress, Silent, process
from hiros_mcap.workers import run_tasks

CONFIGURATIONS = ("T", "TMF", "TMOF")
STEPS = ("tracked", "merged", "optimized", "filtered")
LEAST_GAIN = 0.20
"""By how much the SD of the angles falls from T to TMF at least (section 4.2 reports 20.5 %)."""


@dataclass(frozen=True, slots=True)
class Measure:
    """One configuration on one sequence."""

    angle_rmse: float
    """Of the eight flexions by the links' orientations (eq. 20 and 21), degrees."""
    angle_deviation: float
    """SD of the angles' errors, degrees."""
    position_angle_rmse: float
    """Of the same flexions by marker positions, degrees."""
    error: float
    """Mean joint error, mm."""
    deviation: float
    """SD of the joint error, mm."""
    jitter: float
    limb_variation: float
    first_frames: float
    switches: int
    missing: int
    false: int

    @classmethod
    def of(cls, scores: Scores) -> Measure:
        """Take what the paper's tables need."""
        return cls(
            angle_rmse=scores.link_angle_rmse,
            angle_deviation=scores.link_angle_deviation,
            position_angle_rmse=scores.angle_rmse,
            error=scores.mean,
            deviation=scores.deviation,
            jitter=scores.jitter,
            limb_variation=scores.limb_variation,
            first_frames=scores.first_frames,
            switches=scores.switches,
            missing=scores.missing,
            false=scores.false,
        )


@dataclass(frozen=True, slots=True)
class ActionRun:
    """One action by some people."""

    people: int
    action: str
    measures: Mapping[str, Measure]
    """By configuration."""
    milliseconds: Mapping[str, float]
    """Time of each step per merged frame."""


@dataclass(frozen=True, slots=True)
class Claim:
    """Something that the paper says, and whether it holds here."""

    text: str
    holds: bool
    detail: str


@dataclass(frozen=True, slots=True)
class Experiments:
    """All sequences, in the order of Tables 6 and 7."""

    seconds: float
    sequences: tuple[ActionRun, ...]
    claims: tuple[Claim, ...]


def run_experiments(
    config: Config | None = None,
    *,
    seconds: float = 15.0,
    seed: int = 0,
    jobs: int = 0,
    progress: Progress | None = None,
) -> Experiments:
    """Simulate, process and score every sequence of Tables 6 and 7.

    Parameters
    ----------
    config : of the processing. seconds : length of each log. seed : of the simulation.
    jobs : processes at once; 0 = one per core. With one, times per step are the most exact.
    """
    config, progress = config or Config(), progress or Silent()
    tasks = [(people, action, config, seconds, seed) for people, action in ANGLES]
    done: dict[tuple[int, str], ActionRun] = {}
    for _, sequence in run_tasks(run_experiment, tasks, jobs):
        done[sequence.people, sequence.action] = sequence
        progress.update(len(done), len(tasks))
    sequences = tuple(done[key] for key in ANGLES)
    return Experiments(seconds, sequences, tuple(check_claims(sequences)))


def run_experiment(
    people: int, action: str, config: Config, seconds: float, seed: int
) -> ActionRun:
    """Simulate one sequence, process it with and without the optimizer, score it."""
    from hiros_mcap.simulate import SimulateParams
    from hiros_mcap.simulate.write_log import write_log

    with tempfile.TemporaryDirectory() as folder:
        log, out = Path(folder) / "log.mcap", Path(folder) / "out.mcap"
        params = {"people": people, "action": action, "seconds": seconds, "seed": seed + people}
        write_log(log, SimulateParams.model_validate(params))
        truth = load_truth(log)
        summary = process(log, out, config=config, options=ProcessOptions(keep=()))
        full = evaluate_log(out, truth, ["/hiros/tracked", "/hiros/filtered"])
        process(log, out, config=config, options=ProcessOptions(stages="TMF", keep=()))
        short = evaluate_log(out, truth, ["/hiros/filtered"])
    scores = (full["/hiros/tracked"], short["/hiros/filtered"], full["/hiros/filtered"])
    frames = max(summary.written["/hiros/merged"], 1)
    return ActionRun(
        people,
        action,
        {name: Measure.of(s.scores) for name, s in zip(CONFIGURATIONS, scores, strict=True)},
        {s.name: 1000 * s.cpu_s / frames for s in summary.stages if s.name in STEPS},
    )


def mean_pair(sequences: Sequence[ActionRun], configuration: str) -> tuple[float, float]:
    """Mean RMSE and SD of the angles over sequences, degrees, as the "mean" rows of the paper."""
    measures = [s.measures[configuration] for s in sequences]
    return (
        float(np.mean([m.angle_rmse for m in measures])),
        float(np.mean([m.angle_deviation for m in measures])),
    )


def check_claims(sequences: Sequence[ActionRun]) -> Iterator[Claim]:
    """Compare with what section 4 says in words."""
    counts = sorted({s.people for s in sequences})
    by_people = {n: [s for s in sequences if s.people == n] for n in counts}
    gains = {
        n: 1 - mean_pair(group, "TMF")[1] / mean_pair(group, "T")[1]
        for n, group in by_people.items()
    }
    yield Claim(
        "the SD of the angles falls by at least 20 % from T to TMF (4.2)",
        all(gain >= LEAST_GAIN for gain in gains.values()),
        ", ".join(f"{n} people {gain:.0%}" for n, gain in gains.items()),
    )
    several = [gains[n] for n in counts if n > 1]
    yield Claim(
        "that gain gets smaller with more people, from 2 on (4.2)",
        all(a > b for a, b in pairwise(several)),
        ", ".join(f"{n} people {gain:.1%}" for n, gain in gains.items() if n > 1),
    )
    worse = [s for s in sequences if s.measures["TMF"].jitter >= s.measures["T"].jitter]
    yield Claim(
        "the merger and the filter take the flicker out (3.2, 4.1)",
        not worse,
        "every sequence" if not worse else f"not in {_names(worse)}",
    )
    crossing = [s for s in sequences if s.action in ("cross", "eight")]
    switched = [s for s in crossing if s.measures["TMOF"].switches]
    yield Claim(
        "nobody's id switches in cross and eight (4.3)",
        bool(crossing) and not switched,
        f"{len(crossing)} sequences" if not switched else f"switches in {_names(switched)}",
    )
    yield from _order_claims(sequences)


def _order_claims(sequences: Sequence[ActionRun]) -> Iterator[Claim]:
    """Which actions are the easy and the hard ones."""
    for configuration, action, who in (
        ("T", "free_static", "people who stand still are"),
        ("TMF", "in_out", "in_out is"),
    ):
        worst = _least_accurate(sequences, configuration)
        yield Claim(
            f"with {configuration}, {who} the least accurate of several people's actions (4.2)",
            bool(worst) and set(worst.values()) == {action},
            ", ".join(f"{n} people: {name}" for n, name in worst.items()),
        )
    single = sorted(
        (s for s in sequences if s.people == 1), key=lambda s: s.measures["TMF"].angle_deviation
    )
    names = [s.action for s in single]
    yield Claim(
        "walk and wave have the smallest SD, point the largest (4.1)",
        set(names[:2]) == {"walk", "wave"} and names[-1:] == ["point"],
        f"from the smallest: {', '.join(names)}",
    )


def _least_accurate(sequences: Sequence[ActionRun], configuration: str) -> dict[int, str]:
    """For each number of people from 2 on, the action with the largest RMSE of the angles."""
    ordered = sorted(sequences, key=lambda s: (s.people, s.measures[configuration].angle_rmse))
    return {s.people: s.action for s in ordered if s.people > 1}


def _names(sequences: Sequence[ActionRun]) -> str:
    return ", ".join(f"{s.action} of {s.people}" for s in sequences)


def extrapolate(times: Mapping[int, float], people: int) -> float:
    """Time for more people by a straight line through the measured ones (section 4.4), ms."""
    slope, offset = np.polyfit(list(times), list(times.values()), 1)
    return float(slope * people + offset)


def step_times(sequences: Sequence[ActionRun]) -> dict[str, dict[int, tuple[float, float]]]:
    """Step -> people -> mean and SD over the sequences of the time per merged frame, ms."""
    table: dict[str, dict[int, tuple[float, float]]] = {}
    for step in STEPS:
        for n in sorted({s.people for s in sequences}):
            values = [s.milliseconds.get(step, np.nan) for s in sequences if s.people == n]
            table.setdefault(step, {})[n] = (float(np.mean(values)), float(np.std(values)))
    return table
