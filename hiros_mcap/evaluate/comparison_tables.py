"""Compared systems as rows of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hiros_mcap.evaluate.comparison import Outcome
from hiros_mcap.evaluate.parts import PARTS
from hiros_mcap.evaluate.score_tables import Table
from hiros_mcap.evaluate.scores import Scores
from hiros_mcap.summary import number

TRUTH_HEADER = (
    *("System", "Mean", "SD", "Torso", "Upper", "Lower", "Angles", "Limb CV", "Jitter", "Lag"),
    *("Missing", "False", "Switches", "HOTA", "ms/message"),
)
SELF_HEADER = ("System", "Left out", "Limb CV", "Jitter", "ms/message")


def ranked(outcomes: Sequence[Outcome]) -> Table:
    """Header and rows of one log, the best first; against the truth, or without one."""
    ordered = sorted(outcomes, key=lambda o: (np.isnan(o.rank), o.rank, o.name))
    if any(o.scores is None for o in ordered):
        return SELF_HEADER, [
            (o.name, number(o.distance, 1), *_motion(o), number(o.milliseconds, 3)) for o in ordered
        ]
    return TRUTH_HEADER, [_truth_row(o, o.scores) for o in ordered if o.scores is not None]


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
