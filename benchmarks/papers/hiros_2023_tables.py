"""Tables 6, 7 and 8 of the Hi-ROS paper, its numbers below ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from paper_report import Rows, Table
from published import ANGLES, TIMES, Pair

from hiros_mcap.evaluate import Scores
from hiros_mcap.wording import number

CONFIGURATIONS = ("T", "TMF", "TMOF")
STEPS = ("tracked", "merged", "optimized", "filtered")
LINK_NOTE = (
    "Tables 6 and 7 score the orientations of links (eq. 21). The optimizer does not change "
    "them: TMOF equals TMF. It moves the joints, so the tables by "
    "markers and positions show what it does"
)
TIME_NOTE = (
    "Frames/s is what hiros process reaches; side by side, each step has a core of its own, as in "
    "the paper, and the slowest step sets the pace"
)


@dataclass(frozen=True, slots=True)
class ActionRun:
    """One action by some people."""

    people: int
    action: str
    scores: Mapping[str, Scores]
    """By configuration. The angles are those by the links' orientations (eq. 20 and 21)."""
    milliseconds: Mapping[str, float]
    """Time of each step per merged frame."""


def mean_angle_errors(runs: Sequence[ActionRun], configuration: str) -> Pair:
    """Mean RMSE and SD of the angles over sequences, degrees, as the paper's "mean" rows."""
    scores = [run.scores[configuration] for run in runs]
    return (
        float(np.mean([s.link_angle_rmse for s in scores])),
        float(np.mean([s.link_angle_deviation for s in scores])),
    )


def angle_table(title: str, runs: Sequence[ActionRun]) -> Table:
    """Table 6 or 7; after each group of people its mean."""
    rows: Rows = []
    for n in sorted({run.people for run in runs}):
        group = [run for run in runs if run.people == n]
        published = {action: pairs for (people, action), pairs in ANGLES.items() if people == n}
        for run in group:
            scores = [run.scores[c] for c in CONFIGURATIONS]
            ours = [(s.link_angle_rmse, s.link_angle_deviation) for s in scores]
            rows.append((str(n), run.action, *_with_gains(ours)))
            rows.append(("", "paper", *_with_gains(published[run.action])))
        rows.append(
            (str(n), "mean", *_with_gains([mean_angle_errors(group, c) for c in CONFIGURATIONS]))
        )
        means = np.mean(list(published.values()), axis=0).tolist()
        rows.append(("", "paper", *_with_gains([(m, sd) for m, sd in means])))
    header = ("People", "Action", *CONFIGURATIONS, "T-TMF", "T-TMOF")
    return Table(f"{title}. Bending angles by links, RMSE (SD), degrees", header, rows)


def marker_angle_table(runs: Sequence[ActionRun]) -> Table:
    """The same angles from marker positions, which the optimizer moves; the paper has none."""
    rows: Rows = []
    for run in runs:
        scores = [run.scores[c] for c in CONFIGURATIONS]
        pairs = [(s.angle_rmse, s.angle_deviation) for s in scores]
        rows.append((str(run.people), run.action, *_with_gains(pairs)))
    header = ("People", "Action", *CONFIGURATIONS, "T-TMF", "T-TMOF")
    return Table("The same bending angles by marker positions, RMSE (SD), degrees", header, rows)


def _with_gains(pairs: Sequence[Pair]) -> list[str]:
    """T, TMF, TMOF, and by how much RMSE (SD) of the last two differ from the first."""
    changes = [[100 * (late[i] / pairs[0][i] - 1) for i in (0, 1)] for late in pairs[1:]]
    gains = [f"{rmse:.1f}% ({deviation:.1f}%)" for rmse, deviation in changes]
    return [*(f"{number(r, 2)} ({number(sd, 2)})" for r, sd in pairs), *gains]


def position_table(runs: Sequence[ActionRun]) -> Table:
    """Joint error and jitter of the three configurations, and who was lost."""
    rows: Rows = []
    for run in runs:
        scores = [run.scores[c] for c in CONFIGURATIONS]
        last = scores[-1]
        rows.append(
            (
                str(run.people),
                run.action,
                *(f"{number(s.mean, 1)} ({number(s.deviation, 1)})" for s in scores),
                *(number(s.jitter, 1) for s in scores),
                number(last.limb_variation, 4),
                *map(str, (last.missing, last.false, last.switches)),
            )
        )
    header = ("People", "Action", *(f"{name} mm" for name in CONFIGURATIONS))
    header += tuple(f"{name} jitter" for name in CONFIGURATIONS)
    header += ("Limb CV", "Missing", "False", "Switches")
    return Table("The same sequences by joint positions", header, rows)


def time_table(runs: Sequence[ActionRun]) -> Table:
    """Table 8: measured for the people there are, a straight line for 5 and 10."""
    times = step_times(runs)
    rows: Rows = []
    for n in sorted({run.people for run in runs}):
        ours = [times[step][n] for step in STEPS]
        cells = [
            f"{m:.3f} ({sd:.3f}) [{paper:.2f}]"
            for (m, sd), (paper, _) in zip(ours, TIMES[n], strict=True)
        ]
        rows.append((str(n), *cells, *_totals([m for m, _ in ours])))
    if len(rows) > 1:
        means = [{n: m for n, (m, _) in times[step].items()} for step in STEPS]
        for n in (5, 10):
            line = [extrapolate(each, n) for each in means]
            rows.append((str(n), *(f"{m:.3f}" for m in line), *_totals(line)))
    header = ("People", "Tracker", "Merger", "Optimizer", "Filter")
    return Table(
        "Table 8: time per merged frame, ms, mean (SD) [paper]; 5 and 10 people by a line",
        (*header, "Sum", "Frames/s", "Side by side"),
        rows,
    )


def _totals(milliseconds: Sequence[float]) -> tuple[str, str, str]:
    """Sum of the steps, frames per second by it, and when the steps run side by side."""
    total, slowest = sum(milliseconds), max(milliseconds)
    pace, side_by_side = (1000 / max(t, 1e-9) for t in (total, slowest))
    return f"{total:.3f}", f"{pace:.0f}", f"{side_by_side:.0f}"


def extrapolate(times: Mapping[int, float], people: int) -> float:
    """Time for more people by a straight line through the measured ones (section 4.4), ms."""
    slope, offset = np.polyfit(list(times), list(times.values()), 1)
    return float(slope * people + offset)


def step_times(runs: Sequence[ActionRun]) -> dict[str, dict[int, Pair]]:
    """Step -> people -> mean and SD over the sequences of the time per merged frame, ms."""
    counts = sorted({run.people for run in runs})
    return {step: {n: _time(runs, step, n) for n in counts} for step in STEPS}


def _time(runs: Sequence[ActionRun], step: str, people: int) -> Pair:
    values = [run.milliseconds.get(step, np.nan) for run in runs if run.people == people]
    return float(np.mean(values)), float(np.std(values))
