"""The pages of ``hiros eval --html``: the tables of the terminal, with plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.evaluate import PCK_MM, ErrorStats, Scores, Truth, score_tables
from hiros_mcap.evaluate.leave_one_out import SelfScores
from hiros_mcap.evaluate.logs import ChannelResult
from hiros_mcap.evaluate.measures import text_of
from hiros_mcap.skeletons import Floats
from hiros_mcap.summary import number
from hiros_viewer.figures import (
    angle_figure,
    angles_of,
    name_ends,
    new_axes,
    new_figure,
    value_bars,
)
from hiros_viewer.headline import about
from hiros_viewer.page import Page

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
    page.figure(_joint_bars(result.scores.joints), "Mean error of each joint; the line is its SD")
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
    figure, axes = new_axes(7, 3.4)
    for topic, s in scores.items():
        axes.plot(PCK_MM, 100 * np.array(s.pck["all"]), label=topic)
    axes.set(xlabel="mm", ylabel="joints, %", xlim=(0, PCK_MM[-1]), ylim=(0, 101))
    name_ends(axes)
    return figure


def _joint_bars(joints: Mapping[str, ErrorStats]) -> Figure:
    figure, axes = new_axes(8, 0.22 * len(joints) + 0.8)
    each = joints.values()
    value_bars(axes, list(joints), [e.mean for e in each], [e.deviation for e in each])
    axes.set_xlabel("mm")
    return figure


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
    return angle_figure((times - times[0]) / 1e9, angles, true_angles)


def self_page(log: Path, scores: SelfScores) -> Page:
    """Page of a log without truth."""
    result = scores.consistency
    lines = about(log, *score_tables.lines_of(result))
    page = Page(f"{log} without truth", lines)
    page.heading("Each camera against the result of the others")
    title = "Joint distance, mm, including the camera's own noise"
    page.table(*text_of(score_tables.left_out_sheet(scores.cameras)), title)
    for text in score_tables.notes_without_truth(scores):
        page.text(text)
    page.figure(
        _camera_joints({c.topic: c.joints for c in scores.cameras}),
        "Mean distance of each joint of the left-out camera, mm",
    )
    page.heading("Disagreement between cameras")
    page.table(
        ["camera", "camera", "median, mm"],
        [[a, b, number(mm, 1)] for (a, b), mm in scores.disagreement.items()],
    )
    page.heading("Result of all cameras")
    page.table(
        ["person", "s", "frames"],
        [[str(p.id), f"{p.seconds:.1f}", str(p.frames)] for p in result.people],
    )
    page.text("; ".join(score_tables.lines_of(result)))
    page.heading("Left and right of this result")
    page.table(*score_tables.side_table(scores.sides))
    return page


def _camera_joints(cameras: Mapping[str, Mapping[str, ErrorStats]]) -> Figure:
    names = list(dict.fromkeys(name for joints in cameras.values() for name in joints))
    table: Floats = np.array(
        [[joints[n].mean if n in joints else np.nan for n in names] for joints in cameras.values()]
    )
    figure = new_figure(0.28 * len(names) + 2.5, 0.35 * len(cameras) + 2.2)
    axes = figure.subplots()
    image = axes.imshow(table, aspect="auto", cmap="viridis", vmin=0)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    axes.set_yticks(range(len(cameras)), list(cameras), fontsize=8)
    figure.colorbar(image, label="mm")
    bright = np.nanmax(table, initial=0.0) / 2
    for (row, column), value in np.ndenumerate(table):
        if not np.isnan(value):
            colour = "black" if value > bright else "white"
            axes.text(
                column, row, f"{value:.0f}", ha="center", va="center", fontsize=7, color=colour
            )
    return figure
