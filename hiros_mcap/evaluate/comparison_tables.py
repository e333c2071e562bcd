"""Comparisons as rows of text: ranked, and in the layouts of Malaguti 2019 and Lee 2022."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hiros_mcap.evaluate.comparison import Outcome
from hiros_mcap.evaluate.parts import PARTS
from hiros_mcap.evaluate.published import (
    LEE,
    LEE_CAMERAS,
    LEE_RADII,
    MALAGUTI,
    MALAGUTI_COLUMNS,
    MALAGUTI_MS_PER_PERSON,
    Pair,
)
from hiros_mcap.summary import number

Rows = list[tuple[str, ...]]

TRUTH_HEADER = (
    *("System", "Mean", "SD", "Torso", "Upper", "Lower", "Angles", "Limb CV", "Jitter", "Lag"),
    *("Missing", "False", "Switches", "HOTA", "ms/message"),
)
SELF_HEADER = ("System", "Left out", "Limb CV", "Jitter", "ms/message")


def ranked(outcomes: Sequence[Outcome]) -> tuple[tuple[str, ...], Rows]:
    """Header and rows of one log, the best first; against the truth, or without one."""
    ordered = sorted(outcomes, key=lambda o: (np.isnan(o.rank), o.rank, o.name))
    if any(o.scores is None for o in ordered):
        return SELF_HEADER, [
            (
                o.name,
                number(o.distance, 1),
                number(o.limb_variation, 4),
                number(o.jitter, 1),
                number(o.milliseconds, 3),
            )
            for o in ordered
        ]
    return TRUTH_HEADER, [row for o in ordered if (row := _truth_row(o))]


def _truth_row(o: Outcome) -> tuple[str, ...]:
    s = o.scores
    if s is None:
        return ()
    parts = [number(s.parts[p].mean, 1) if p in s.parts else "-" for p in PARTS]
    return (
        o.name,
        number(s.mean, 1),
        number(s.deviation, 1),
        *parts,
        number(s.angle_rmse, 2),
        number(s.limb_variation, 4),
        number(s.jitter, 1),
        number(s.lag, 1),
        str(s.missing),
        str(s.false),
        str(s.switches),
        number(s.tracking.hota, 4),
        number(o.milliseconds, 3),
    )


MALAGUTI_HEADER = ("Sequence", *MALAGUTI_COLUMNS)


def malaguti_rows(outcomes: Sequence[Outcome]) -> Rows:
    """Table I: mean +- SD in cm, a row per log, the paper's rows below."""
    rows: Rows = []
    for log in dict.fromkeys(o.log for o in outcomes):
        mine = {o.name: o.scores for o in outcomes if o.log == log and o.scores is not None}
        cells = [
            _cm((mine[c].mean, mine[c].deviation)) if c in mine else "-" for c in MALAGUTI_COLUMNS
        ]
        rows.append((log, *cells))
    published = np.array(list(MALAGUTI.values()))
    rows += [
        (f"paper: {name}", *(f"{m:.2f} +- {d:.2f}" for m, d in pairs))
        for name, pairs in MALAGUTI.items()
    ]
    rows.append(("paper: mean", *(f"{m:.2f} +- {d:.2f}" for m, d in published.mean(axis=0))))
    return rows


def _cm(pair: Pair) -> str:
    return f"{pair[0] / 10:.2f} +- {pair[1] / 10:.2f}"


TIME_HEADER = ("People", "ms per message", "messages/s", "paper: ms", "paper: frames/s")


def malaguti_times(outcomes: Sequence[Outcome], most: int = 6) -> Rows:
    """Table II: time of malaguti for 1 to 6 people, from what one person costs on average."""
    mine = [o.milliseconds / o.people for o in outcomes if o.name == "malaguti" and o.people >= 1]
    if not mine:
        return []
    each = float(np.mean(mine))
    return [
        (
            str(n),
            f"{n * each:.3f}",
            f"{1000 / (n * each):.0f}",
            f"{n * MALAGUTI_MS_PER_PERSON:.1f}",
            f"{1000 / (n * MALAGUTI_MS_PER_PERSON):.1f}",
        )
        for n in range(1, most + 1)
    ]


def joint_rows(outcomes: Sequence[Outcome]) -> tuple[tuple[str, ...], Rows]:
    """Error (SD) of every joint, mm, a column per system: the layout of Lee's Tables A1 to A6."""
    names = list(dict.fromkeys(o.name for o in outcomes))
    by_name = {n: [o.scores for o in outcomes if o.name == n and o.scores] for n in names}
    joints = dict.fromkeys(j for group in by_name.values() for s in group for j in s.joints)
    rows: Rows = []
    for joint in joints:
        cells = []
        for name in names:
            known = [s.joints[joint] for s in by_name[name] if joint in s.joints]
            pair = (
                float(np.mean([e.mean for e in known])) if known else np.nan,
                float(np.mean([e.deviation for e in known])) if known else np.nan,
            )
            cells.append(_with_paper(pair, None))
        rows.append((joint, *cells))
    return ("Joint", *names), rows


LEE_HEADER = ("Variant", "Torso", "Upper limbs", "Lower limbs")


def lee_rows(outcomes: Sequence[Outcome]) -> Rows:
    """Mean error (SD) by part, mm: variants and radii, the mean over the logs, paper in [ ]."""
    rows: Rows = []
    for name in dict.fromkeys(o.name for o in outcomes):
        beside = LEE.get(name) or next(
            (pairs for r, pairs in LEE_RADII.items() if name.endswith(f"cluster.radius={r:g}")),
            None,
        )
        mine = [o.scores.parts for o in outcomes if o.name == name and o.scores is not None]
        if not mine:
            continue
        cells = []
        for k, part in enumerate(PARTS):
            known = [parts[part] for parts in mine if part in parts]
            ours = (
                float(np.mean([e.mean for e in known])) if known else np.nan,
                float(np.mean([e.deviation for e in known])) if known else np.nan,
            )
            cells.append(_with_paper(ours, None if beside is None else beside[k]))
        rows.append((name, *cells))
    return rows


def _with_paper(ours: Pair, paper: Pair | None) -> str:
    text = f"{number(ours[0], 1)} ({number(ours[1], 1)})"
    return text if paper is None else f"{text} [{paper[0]:.1f} ({paper[1]:.1f})]"


def camera_rows(
    table: Mapping[str, Mapping[int, tuple[float, float]]],
) -> tuple[tuple[str, ...], Rows]:
    """Error (SD), mm, by number of cameras, mean over all subsets; Lee's below."""
    sizes = sorted({size for row in table.values() for size in row})
    header = ("System", *(str(size) for size in sizes))
    rows: Rows = [
        (
            name,
            *(_with_paper(row[size], None) if size in row else "-" for size in sizes),
        )
        for name, row in table.items()
    ]
    for k, part in enumerate(PARTS):
        cells = [
            f"{LEE_CAMERAS[n][k][0]:.1f} ({LEE_CAMERAS[n][k][1]:.1f})" if n in LEE_CAMERAS else "-"
            for n in sizes
        ]
        rows.append((f"Lee's paper: {part}", *cells))
    return header, rows
