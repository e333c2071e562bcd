"""Compared systems as rows of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hiros_mcap.evaluate.comparison import Outcome
from hiros_mcap.evaluate.parts import PARTS
from hiros_mcap.evaluate.same_detections import MeanDifference
from hiros_mcap.evaluate.score_tables import TWO_CAMERAS, Table
from hiros_mcap.evaluate.scores import Scores
from hiros_mcap.evaluate.statistics import ErrorStats
from hiros_mcap.summary import number

TRUTH_HEADER = (
    *("System", "Mean", "SD", "Torso", "Upper", "Lower", "Angles", "Limb CV", "Jitter", "Lag"),
    *("Missing", "False", "Switches", "HOTA", "ms/message"),
)
SELF_HEADER = (
    *("System", "Mean", "Median", "95 %", "Spread", "Misses", "Coverage", "Ids", "Limb CV"),
    *("Jitter", "ms/message"),
)
WITHOUT_TRUTH = (
    "Not ranked, since there is no truth. Mean, Median, 95 %: distance, mm, of a camera left out "
    "from the result of the others, where all systems have the joint. This is neither the error "
    "nor a bound on it: it adds the camera's noise and misses errors that all cameras share. "
    "Spread: without what is constant for a joint. Misses: detections where only others have "
    "somebody. Coverage: share of skeletons near somebody whom the others see."
)


def table_of(outcomes: Sequence[Outcome]) -> Table:
    """Header and rows of one log.

    With a truth, the system with the least error comes first. Without one, the systems stay in the
    order in which they were named: no number tells which is best.
    """
    ordered = best_first(outcomes)
    if has_truth(outcomes):
        return TRUTH_HEADER, [_truth_row(o, o.scores) for o in ordered if o.scores is not None]
    return SELF_HEADER, [_self_row(o) for o in ordered]


def has_truth(outcomes: Sequence[Outcome]) -> bool:
    """Whether all outcomes were compared with a truth."""
    return all(o.scores is not None for o in outcomes)


def best_first(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Order outcomes by their error, or leave them in their order without a truth."""
    if not has_truth(outcomes):
        return list(outcomes)
    return sorted(outcomes, key=lambda o: (np.isnan(o.error), o.error, o.name))


def differences_of(outcomes: Sequence[Outcome]) -> list[str]:
    """Return a line per system of one log: whether it is nearer than the first one."""
    return [f"{o.name}: {_against(o.difference)}" for o in outcomes if o.difference is not None]


def _against(difference: MeanDifference) -> str:
    if difference.seconds < 2:
        return f"not compared with {difference.against}: less than two seconds in common"
    return f"against {difference.against}, mm: {difference} in {difference.seconds} s"


def notes_on(outcomes: Sequence[Outcome]) -> list[str]:
    """Return what a reader of tables without a truth has to know."""
    if has_truth(outcomes):
        return []
    two = any(o.scores is None and len(o.cameras) == 2 for o in outcomes)
    return [WITHOUT_TRUTH, *([TWO_CAMERAS] if two else [])]


def _self_row(o: Outcome) -> tuple[str, ...]:
    distance = o.distance or ErrorStats.of(np.zeros(0))
    return (
        o.name,
        number(distance.mean, 1),
        number(o.disagreement, 1),
        number(distance.percentile_95, 1),
        number(o.spread, 1),
        f"{o.misses}/{o.detections}",
        number(100 * o.coverage, 1, " %"),
        str(o.ids),
        *_motion(o),
        number(o.milliseconds, 3),
    )


def _motion(o: Outcome) -> tuple[str, str]:
    return number(o.limb_variation, 4), number(o.jitter, 1)


def _truth_row(o: Outcome, s: Scores) -> tuple[str, ...]:
    return (
        o.name,
        number(s.mean, 1),
        number(s.deviation, 1),
        *(number(s.parts[p].mean, 1) if p in s.parts else "-" for p in PARTS),
        number(s.angle_rmse, 2),
        *_motion(o),
        number(s.lag, 1),
        *map(str, (s.missing, s.false, s.switches)),
        number(s.tracking.hota, 4),
        number(o.milliseconds, 3),
    )


def camera_table(errors: Mapping[str, Mapping[int, tuple[float, float]]]) -> Table:
    """Error (SD), mm, by number of cameras, mean over all subsets."""
    sizes = sorted({size for row in errors.values() for size in row})
    rows = [
        (name, *(f"{row[n][0]:.1f} ({row[n][1]:.1f})" if n in row else "-" for n in sizes))
        for name, row in errors.items()
    ]
    return ("System", *map(str, sizes)), rows
