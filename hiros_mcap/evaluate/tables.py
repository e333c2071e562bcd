"""The tables of the Hi-ROS paper as text, for the terminal and for pages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from hiros_mcap.evaluate.paper import (
    CONFIGURATIONS,
    STEPS,
    ActionRun,
    extrapolate,
    mean_pair,
    step_times,
)
from hiros_mcap.evaluate.published import ANGLES, TIMES
from hiros_mcap.evaluate.score_tables import pair
from hiros_mcap.summary import number

ANGLE_HEADER = ("People", "Action", *CONFIGURATIONS, "T-TMF", "T-TMOF")
POSITION_HEADER = (
    "People",
    "Action",
    *(f"{name} {what}" for what in ("mm", "jitter") for name in CONFIGURATIONS),
    "Limb CV",
    "Missing",
    "False",
    "Switches",
)
TIME_HEADER = (
    "People",
    "Tracker",
    "Merger",
    "Optimizer",
    "Filter",
    "Sum",
    "Frames/s",
    "Side by side",
)

TIME_NOTE = (
    "frames/s by the sum is what hiros process does; side by side, if each step had a core of its "
    "own as in the paper, the slowest one sets the pace"
)


def angle_rows(sequences: Sequence[ActionRun]) -> list[tuple[str, ...]]:
    """Rows of Tables 6 and 7, the paper's below ours; a mean after each group of people."""
    rows = []
    for n in sorted({s.people for s in sequences}):
        group = [s for s in sequences if s.people == n]
        theirs = {key: value for key, value in ANGLES.items() if key[0] == n}
        for s in group:
            ours = [
                (s.measures[c].angle_rmse, s.measures[c].angle_deviation) for c in CONFIGURATIONS
            ]
            rows.append((str(n), s.action, *_with_gains(ours)))
            rows.append(("", "paper", *_with_gains(theirs[n, s.action])))
        means = [mean_pair(group, c) for c in CONFIGURATIONS]
        published = [
            (_mean(v[k][0] for v in theirs.values()), _mean(v[k][1] for v in theirs.values()))
            for k in range(len(CONFIGURATIONS))
        ]
        rows.append((str(n), "mean", *_with_gains(means)))
        rows.append(("", "paper", *_with_gains(published)))
    return rows


def _mean(values: Iterable[float]) -> float:
    numbers = list(values)
    return float(sum(numbers) / len(numbers))


def _with_gains(pairs: Sequence[tuple[float, float]]) -> list[str]:
    """T, TMF, TMOF, and by how much RMSE (SD) of the last two differ from the first."""
    changes = [[100 * (late[i] / pairs[0][i] - 1) for i in (0, 1)] for late in pairs[1:]]
    gains = [f"{rmse:.1f}% ({deviation:.1f}%)" for rmse, deviation in changes]
    return [*(pair(*p) for p in pairs), *gains]


def position_rows(sequences: Sequence[ActionRun]) -> list[tuple[str, ...]]:
    """Joint error and jitter of the three configurations, and who was lost."""
    rows = []
    for s in sequences:
        measures = [s.measures[c] for c in CONFIGURATIONS]
        last = measures[-1]
        rows.append(
            (
                str(s.people),
                s.action,
                *(f"{number(m.error, 1)} ({number(m.deviation, 1)})" for m in measures),
                *(number(m.jitter, 1) for m in measures),
                number(last.limb_variation, 4),
                str(last.missing),
                str(last.false),
                str(last.switches),
            )
        )
    return rows


def time_rows(sequences: Sequence[ActionRun]) -> list[tuple[str, ...]]:
    """Table 8: measured for the people there are, a straight line for 5 and 10."""
    times = step_times(sequences)
    rows = []
    for n in sorted({s.people for s in sequences}):
        cells = [times[step][n] for step in STEPS]
        published = TIMES[n]
        text = [
            f"{m:.3f} ({sd:.3f}) [{p:.2f}]"
            for (m, sd), (p, _) in zip(cells, published, strict=True)
        ]
        rows.append((str(n), *text, *_totals([m for m, _ in cells])))
    means = {step: {n: m for n, (m, _) in times[step].items()} for step in STEPS}
    if len(means[STEPS[0]]) > 1:
        for n in (5, 10):
            line = [extrapolate(means[step], n) for step in STEPS]
            rows.append((str(n), *(f"{m:.3f}" for m in line), *_totals(line)))
    return rows


def _totals(milliseconds: Sequence[float]) -> tuple[str, str, str]:
    """Sum of the steps, frames per second by it, and when the steps run side by side.

    Side by side, as the nodes of the paper run, the slowest step sets the pace.
    """
    total = sum(milliseconds)
    pace = 1000 / max(*milliseconds, 1e-9)
    return f"{total:.3f}", f"{1000 / max(total, 1e-9):.0f}", f"{pace:.0f}"
