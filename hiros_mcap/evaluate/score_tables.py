"""Scores as rows of text, for the terminal and for pages: a header, and rows under it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hiros_mcap.evaluate import measures
from hiros_mcap.evaluate.comparison import Outcome
from hiros_mcap.evaluate.leave_one_out import LeftOut, SelfScores
from hiros_mcap.evaluate.logs import Consistency
from hiros_mcap.evaluate.measures import SELF, Measure, Sheet, Table, table_of, text_of
from hiros_mcap.evaluate.remarks import other_clock
from hiros_mcap.evaluate.reprojection import ImageScores
from hiros_mcap.evaluate.scores import Scores
from hiros_mcap.evaluate.statistics import AngleStats, ErrorStats
from hiros_mcap.wording import number

TWO_CAMERAS = (
    "With two cameras, a camera left out is compared with the result of a single one: this tests "
    "smoothing, not fusion."
)
WITHOUT_TRUTH = " ".join(
    (
        "Not ranked, since there is no truth: the distance of a camera left out is neither the "
        "error nor a bound on it. It adds the camera's noise and misses errors that all cameras "
        "share.",
        *(
            f"{m.title}: {m.text}."
            for m in SELF
            if m.name in ("mean", "spread", "misses", "coverage")
        ),
    )
)


def truth_sheets(scores: Mapping[str, Scores]) -> list[Sheet]:
    """Return the measures against a truth, a row per channel."""
    rows, people = list(scores.items()), "People: sums over frames and silent instants"
    return [
        Sheet("Joint error, mm", "Channel", rows, measures.ERRORS, "mm"),
        Sheet("Motion", "Channel", rows, measures.MOTION),
        Sheet(people, "Channel", rows, measures.PEOPLE),
    ]


def truth_tables(scores: Mapping[str, Scores]) -> dict[str, Table]:
    """Title -> table of the measures against a truth, a row per channel."""
    return {sheet.title: text_of(sheet) for sheet in truth_sheets(scores)}


BENDING = "Unsigned bending angles"
"""The eight angles of Hi-ROS 2023, section 4; the signed ones are in body.anatomy."""


def angle_table(scores: Scores) -> Table:
    """Errors of the eight bending angles, degrees, by joint positions and by links."""
    header = ("Joint", "RMSE", "SD", "Bias", "By links: RMSE", "SD", "Bias", "Left out")
    links = scores.link_angles
    return header, [(name, *_cells(s, links[name])) for name, s in scores.angles.items()]


def signed_angle_table(scores: Scores) -> Table:
    """Errors of the signed joint angles (docs/angles.md), degrees."""
    rows = [(name, *_cells(s)) for name, s in scores.signed_angles.items()]
    return ("Angle", "RMSE", "SD", "Bias", "Left out"), rows


def _cells(*stats: AngleStats) -> list[str]:
    numbers = [number(v, 2) for s in stats for v in (s.rmse, s.deviation, s.bias)]
    return [*numbers, str(stats[-1].singular)]


def joint_table(joints: Mapping[str, ErrorStats]) -> Table:
    """Error of every joint, mm."""
    return table_of("Joint", joints.items(), measures.ERRORS[:4], "mm")


def self_sheets(scores: SelfScores) -> list[Sheet]:
    """Return the measures of cameras without a truth: of their skeletons and of their images."""
    sheets = [left_out_sheet(scores.cameras), image_sheet(scores.images)]
    return [sheet for sheet in sheets if sheet.rows]


def left_out_sheet(cameras: Sequence[LeftOut]) -> Sheet:
    """Distance of each camera left out from what the others give, mm."""
    rows = [(camera.topic, camera) for camera in cameras]
    title = "Distance of each left-out camera, mm"
    return Sheet(title, "Left out", rows, measures.LEFT_OUT, "mm")


def image_sheet(cameras: Sequence[ImageScores]) -> Sheet:
    """Distance of the keypoints of each RGB camera from the result in its image, px."""
    rows = [(camera.topic, camera) for camera in cameras]
    title = "Reprojection into each RGB camera, px"
    return Sheet(title, "Camera", rows, measures.REPROJECTION, "px")


def pixel_table(camera: ImageScores) -> Table:
    """Reprojection of every joint, px."""
    result = camera.result
    rows = [
        (name, replace(camera, result=replace(result, distance=errors)))
        for name, errors in result.joints.items()
    ]
    return table_of("Joint", rows, measures.REPROJECTION[:2], "px")


def lines_of(result: Consistency) -> list[str]:
    """Return limb constancy and jitter of a result, a line each."""
    shown = [m for m in measures.CONSISTENCY if m.digits]
    return [f"{m.title}: {m.cell(result)} {m.unit}".rstrip() for m in shown]


def notes_without_truth(scores: SelfScores) -> list[str]:
    """Return what a reader of scores without a truth has to know."""
    return [TWO_CAMERAS] if len(scores.cameras) == 2 else []


def system_sheets(outcomes: Sequence[Outcome]) -> list[Sheet]:
    """Return a sheet per log, whose name is its title.

    With a truth, the system with the least error comes first. Without one, the systems stay in the
    order in which they were named: no number tells which is best.
    """
    groups: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault(outcome.log, []).append(outcome)
    return [
        Sheet(log, "System", [(o.name, o) for o in best_first(group)], columns, "mm", log)
        for log, group in groups.items()
        for columns in (measures.RANKED if has_truth(group) else SELF,)
    ]


def has_truth(outcomes: Sequence[Outcome]) -> bool:
    """Whether all outcomes were compared with a truth."""
    return all(o.scores is not None for o in outcomes)


def best_first(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Order outcomes by their error, or leave them in their order without a truth."""
    if not has_truth(outcomes):
        return list(outcomes)
    return sorted(outcomes, key=lambda o: (np.isnan(o.error), o.error, o.name))


def comparison_sheets(outcomes: Sequence[Outcome]) -> list[Sheet]:
    """Return the sheets of all logs, with the difference of each system from the first one."""
    return [
        sheet._replace(measures=(*sheet.measures, measures.DIFFERENCE))
        for sheet in system_sheets(outcomes)
    ]


def with_differences(sheet: Sheet) -> Table:
    """Header and rows of one log, and in words whether a system is nearer than the first one."""
    titles, rows = text_of(sheet)
    found = [outcome.difference for _, outcome in sheet.rows if isinstance(outcome, Outcome)]
    first = next((difference.against for difference in found if difference is not None), None)
    if first is None:
        return titles, rows
    cells = ["-" if difference is None else difference.line for difference in found]
    longer = [(*row, cell) for row, cell in zip(rows, cells, strict=True)]
    return (*titles, f"Against {first}, mm"), longer


def notes_on(outcomes: Sequence[Outcome]) -> list[str]:
    """Return what a reader of the tables has to know."""
    if has_truth(outcomes):
        logs: dict[str, list[Scores]] = {}
        for o in outcomes:
            logs.setdefault(o.log, []).extend([o.scores] if o.scores else [])
        hints = {log: other_clock(scores) for log, scores in logs.items()}
        return [f"{log}: {hint}" for log, hint in hints.items() if hint]
    two = any(o.scores is None and len(o.cameras) == 2 for o in outcomes)
    return [WITHOUT_TRUTH, *([TWO_CAMERAS] if two else [])]


def camera_sheet(errors: Mapping[str, Mapping[int, tuple[float, float]]]) -> Sheet:
    """Error (SD), mm, by number of cameras, mean over all subsets."""
    sizes = sorted({size for row in errors.values() for size in row})
    columns = [
        Measure(f"cameras_{n}", str(n), "mm", "", at=f"{n}.mean", sd=f"{n}.sd") for n in sizes
    ]
    rows = [
        (name, {str(n): {"mean": mean, "sd": sd} for n, (mean, sd) in row.items()})
        for name, row in errors.items()
    ]
    title = "Mean joint error (SD), mm, by number of cameras, over all subsets"
    return Sheet(title, "System", rows, columns, "mm")
