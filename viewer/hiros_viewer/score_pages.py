"""The pages of ``hiros eval --html`` and ``hiros compare --html``: tables and plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap._version import __version__
from hiros_mcap.evaluate import PCK_MM, Scores, Truth, score_tables
from hiros_mcap.evaluate.comparison import Outcome, by_number_of_cameras
from hiros_mcap.evaluate.leave_one_out import SelfScores
from hiros_mcap.evaluate.logs import ChannelResult
from hiros_mcap.evaluate.measures import text_of
from hiros_mcap.evaluate.score_tables import (
    best_first,
    camera_sheet,
    has_truth,
    notes_on,
    system_sheets,
    with_differences,
)
from hiros_mcap.io.channels import OUTPUT_PREFIX
from hiros_mcap.wording import number
from hiros_viewer.curves import about, add_images
from hiros_viewer.figures import (
    OTHERS,
    Curve,
    CurveGrid,
    CurvePlot,
    angle_grid,
    angles_of,
    around,
    from_zero,
)
from hiros_viewer.page import Page
from hiros_viewer.pictures import joint_map, picture_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_PEOPLE = 6


def truth_page(
    log: Path, truth: Truth, results: Mapping[str, ChannelResult], remarks: Sequence[str] = ()
) -> Page:
    """Page of a result against the truth: scores, PCK curves, joints, angles over time."""
    last, result = list(results.items())[-1]
    error = number(result.scores.mean, 1, " mm")
    lines = about(log, f"{last}: mean joint error {error}")
    page = Page(f"Evaluation of {log}", lines)
    scores = {topic: result.scores for topic, result in results.items()}
    page.heading("Scores")
    for title, table in score_tables.truth_tables(scores).items():
        page.table(*table, title)
    for text in remarks:
        page.text(text)
    page.figure(_pck(scores), "Share of true joints within a distance of the truth")
    page.heading(f"Joints of {last}")
    page.table(*score_tables.joint_table(result.scores.joints), "Error of each joint, mm")
    page.heading(f"{score_tables.BENDING} of {last}")
    title = "Error in degrees, by marker positions and by link orientations (Hi-ROS eq. 21)"
    page.table(*score_tables.angle_table(result.scores), title)
    signed = score_tables.signed_angle_table(result.scores)
    page.table(*signed, "Signed joint angles by marker positions (docs/angles.md): error, degrees")
    people = np.unique(result.matches.people).tolist()
    for person in people[:_MOST_PEOPLE]:
        caption = f"Person {truth.people[person] if truth.people else person}"
        page.figure(_angle_curves(result, person), f"{caption}, degrees")
    if len(people) > _MOST_PEOPLE:
        page.text(f"{len(people) - _MOST_PEOPLE} more people are only in the tables.")
    return page


def _pck(scores: Mapping[str, Scores]) -> Figure:
    within = np.array(PCK_MM, float)
    short = {topic.removeprefix(f"{OUTPUT_PREFIX}/"): s for topic, s in scores.items()}
    curves = [
        Curve(name, colour, within, 100 * np.array(s.pck["all"]), 1.5)
        for (name, s), colour in zip(short.items(), cycle(OTHERS))
    ]
    plot = CurvePlot(curves, (0.0, 101.0), y_title="joints, %")
    return picture_of(CurveGrid([[plot]], 3.4, (0.0, float(PCK_MM[-1])), "mm"))


def _angle_curves(result: ChannelResult, person: int) -> Figure:
    """Truth and result of one true person over time."""
    matches = result.matches
    rows = matches.people == person
    times = matches.stamps[rows]
    angles, true_angles = (
        angles_of(result.model, *(each[rows] for each in pair))
        for pair in (
            (matches.poses, matches.orientations),
            (matches.true_poses, matches.true_orientations),
        )
    )
    return picture_of(angle_grid((times - times[0]) / 1e9, angles, true_angles))


def self_page(log: Path, scores: SelfScores) -> Page:
    """Page of a log without truth."""
    result = scores.consistency
    lines = about(log, *score_tables.lines_of(result))
    page = Page(f"{log} without truth", lines)
    if scores.cameras:
        page.heading("Each camera against the result of the others")
        title = "Joint distance, mm, including the camera's own noise"
        page.table(*text_of(score_tables.left_out_sheet(scores.cameras)), title)
        for text in score_tables.notes_without_truth(scores):
            page.text(text)
        means = {c.topic: {n: e.mean for n, e in c.joints.items()} for c in scores.cameras}
        caption = "Mean distance of each joint of the left-out camera, mm"
        page.figure(joint_map(means, "mm"), caption)
    add_images(page, scores.images)
    page.heading("Result of all cameras")
    page.table(
        ["person", "s", "frames"],
        [[str(p.id), f"{p.seconds:.1f}", str(p.frames)] for p in result.people],
    )
    page.text("; ".join(score_tables.lines_of(result)))
    return page


def comparison_page(outcomes: Sequence[Outcome], study: str | None) -> Page:
    """Page with the systems on every log, or their errors by number of cameras."""
    page = Page("Systems compared", [f"hiros {__version__}"])
    if study == "cameras":
        errors = by_number_of_cameras(outcomes)
        page.heading("Number of cameras")
        sheet = camera_sheet(errors)
        page.table(*text_of(sheet), sheet.title)
        page.figure(_camera_plot(errors), "Mean joint error by number of cameras")
        return page
    for log in dict.fromkeys(o.log for o in outcomes):
        group = [o for o in outcomes if o.log == log]
        (sheet,) = system_sheets(group)
        compared = with_differences(sheet)
        page.heading(log)
        if has_truth(group):
            best = best_first(group)[0]
            page.text(f"Least error: {best.name}, {number(best.error, 1, ' mm')}.")
            page.table(*compared, "Least error first; mm, degrees, ms")
        else:
            page.table(*compared, "Distances and jitter in mm")
            for text in notes_on(group):
                page.text(text)
    return page


def _camera_plot(table: dict[str, dict[int, tuple[float, float]]]) -> Figure:
    curves = []
    for (name, row), colour in zip(table.items(), cycle(OTHERS)):
        sizes = sorted(row)
        errors = np.array([row[size][0] for size in sizes])
        curves.append(Curve(name, colour, np.array(sizes, float), errors, 1.5, has_dots=True))
    x_range = around(np.concatenate([curve.x for curve in curves]), 0.05)
    plot = CurvePlot(curves, from_zero(curves), y_title="mm")
    return picture_of(CurveGrid([[plot]], 3.4, x_range, "cameras"))
