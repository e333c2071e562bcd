"""The pages of ``hiros eval --html``: the tables of the terminal, with plots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.angles import ANGLES, flexions
from hiros_mcap.evaluate import PCK_MM, ErrorStats, Scores, Truth, tables
from hiros_mcap.evaluate.leave_one_out import SelfScores
from hiros_mcap.evaluate.logs import ChannelResult
from hiros_mcap.evaluate.paper import CONFIGURATIONS, Experiments
from hiros_mcap.skeletons import Floats
from hiros_mcap.text import number
from hiros_viewer.page import Page

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BLUE, _ORANGE = "#1f5fa8", "#e07b1a"
_MOST_PEOPLE = 6


def truth_page(title: str, truth: Truth, results: Mapping[str, ChannelResult]) -> Page:
    """Page of a result against the truth: scores, PCK curves, joints, angles over time."""
    page = Page(f"Evaluation of {title}")
    scores = {topic: result.scores for topic, result in results.items()}
    page.heading("Scores")
    page.table(SCORE_HEADER, [score_row(topic, s) for topic, s in scores.items()], SCORE_CAPTION)
    page.figure(_pck(scores), "Share of joints within a distance of the truth")
    last, result = list(results.items())[-1]
    page.heading(f"Joints of {last}")
    page.figure(_joint_bars(result.scores.joints), "Mean error of each joint; the line is its SD")
    page.heading(f"Flexion angles of {last}")
    page.table(
        ["joint", "RMSE", "SD", "bias", "by links: RMSE", "SD", "bias"],
        [
            [name, *_angle_cells(result.scores, name)]
            for name in ANGLES
            if result.scores.angles[name].count
        ],
        "Error in degrees, from marker positions and from link orientations (Hi-ROS eq. 21)",
    )
    people = sorted(set(result.matches.people))
    for person in people[:_MOST_PEOPLE]:
        caption = f"Person {truth.people[person] if truth.people else person}"
        page.figure(_angle_curves(result, person), f"{caption}: blue truth, orange result")
    if len(people) > _MOST_PEOPLE:
        page.text(f"{len(people) - _MOST_PEOPLE} more people are in the tables only.")
    return page


SCORE_HEADER = [
    "channel",
    "mean",
    "SD",
    "95 %",
    "angles",
    "turn",
    "limb CV",
    "jitter",
    "lag",
    "missing",
    "false",
    "switches",
    "MOTA",
    "IDF1",
    "HOTA",
]
SCORE_CAPTION = (
    "Joint error and jitter in mm, RMSE of the flexions and mean turn of the links in degrees, "
    "lag in ms; missing and false are summed over frames"
)


def score_row(name: str, s: Scores) -> list[str]:
    """Cells under :data:`SCORE_HEADER`."""
    return [
        name,
        number(s.mean, 1),
        number(s.deviation, 1),
        number(s.percentile_95, 1),
        number(s.angle_rmse, 2),
        number(s.turn_error, 2),
        number(s.limb_variation, 4),
        number(s.jitter, 1),
        number(s.lag, 1),
        str(s.missing),
        str(s.false),
        str(s.switches),
        number(s.tracking.mota, 4),
        number(s.tracking.idf1, 4),
        number(s.tracking.hota, 4),
    ]


def _angle_cells(scores: Scores, name: str) -> list[str]:
    stats = (scores.angles[name], scores.link_angles[name])
    return [number(v, 2) for s in stats for v in (s.rmse, s.deviation, s.bias)]


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)


def _pck(scores: Mapping[str, Scores]) -> Figure:
    figure = _figure(7, 3.4)
    axes = figure.subplots()
    for topic, s in scores.items():
        axes.plot(PCK_MM, 100 * np.array(s.pck["all"]), label=topic)
    axes.set(xlabel="distance, mm", ylabel="joints, %", xlim=(0, PCK_MM[-1]), ylim=(0, 101))
    axes.legend(frameon=False)
    _tidy(axes)
    return figure


def _joint_bars(joints: Mapping[str, ErrorStats]) -> Figure:
    figure = _figure(8, 0.22 * len(joints) + 0.8)
    axes = figure.subplots()
    names = list(joints)[::-1]
    axes.barh(
        names,
        [joints[n].mean for n in names],
        xerr=[joints[n].deviation for n in names],
        color=_BLUE,
        ecolor="#9aa4af",
    )
    axes.set(xlabel="mm", xlim=(0, None))
    axes.margins(y=0.01)
    _tidy(axes)
    return figure


def _angle_curves(result: ChannelResult, person: int) -> Figure:
    """Truth and result over time, in the manner of Fig. 5 of the Hi-ROS paper."""
    rows = [k for k, who in enumerate(result.matches.people) if who == person]
    times = np.array([result.matches.stamps[k] for k in rows])
    seconds = (times - times[0]) / 1e9
    curves = [
        np.degrees(flexions(result.model, np.stack([poses[k] for k in rows])))
        for poses in (result.matches.true_poses, result.matches.poses)
    ]
    shown = [k for k in range(len(ANGLES)) if not np.isnan(curves[1][:, k]).all()]
    figure = _figure(11, 1.5 * max(1, (len(shown) + 1) // 2) + 0.5)
    grid = figure.subplots(max(1, (len(shown) + 1) // 2), 2, sharex=True, squeeze=False)
    for axes, k in zip(grid.T.ravel(), shown, strict=False):
        axes.plot(seconds, curves[0][:, k], color=_BLUE, lw=1.2)
        axes.plot(seconds, curves[1][:, k], color=_ORANGE, lw=1.2)
        axes.set_title(f"{ANGLES[k]}, degrees", loc="left", fontsize=9)
        _tidy(axes)
    for axes in grid[-1]:
        axes.set_xlabel("s")
    return figure


def self_page(title: str, scores: SelfScores) -> Page:
    """Page of a log without truth."""
    page = Page(f"{title} without truth")
    page.heading("Each camera against what all others give")
    parts = list(scores.cameras[0].parts)
    page.table(
        [
            *("left out", "median", "mean", "SD", "95 %"),
            *parts,
            *("offset", "detections", "of nobody", "mirrored"),
        ],
        [
            [
                c.topic,
                number(c.median, 1),
                number(c.error.mean, 1),
                number(c.error.deviation, 1),
                number(c.error.percentile_95, 1),
                *(number(c.parts[part].mean, 1) for part in parts),
                number(c.offset, 1),
                *map(str, (c.detections, c.unmatched, c.mirrored)),
            ]
            for c in scores.cameras
        ],
        "Joint distance, mm. The camera's own noise is in it.",
    )
    page.figure(
        _camera_joints({c.topic: c.joints for c in scores.cameras}),
        "Mean distance of each joint of the camera left out, mm",
    )
    page.heading("Disagreement between cameras")
    page.table(
        ["camera", "camera", "median, mm"],
        [[a, b, number(mm, 1)] for (a, b), mm in scores.disagreement.items()],
    )
    own = scores.consistency
    page.heading("Result of all cameras")
    page.table(
        ["person", "s", "frames"],
        [[str(p.id), f"{p.seconds:.1f}", str(p.frames)] for p in own.people],
    )
    page.text(f"Limb lengths vary by {own.limb_variation:.4f} (CV); jitter {own.jitter:.1f} mm.")
    return page


def _camera_joints(cameras: Mapping[str, Mapping[str, ErrorStats]]) -> Figure:
    names = list(dict.fromkeys(name for joints in cameras.values() for name in joints))
    table: Floats = np.array(
        [[joints[n].mean if n in joints else np.nan for n in names] for joints in cameras.values()]
    )
    figure = _figure(0.28 * len(names) + 2.5, 0.35 * len(cameras) + 2.2)
    axes = figure.subplots()
    image = axes.imshow(table, aspect="auto", cmap="viridis", vmin=0)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    axes.set_yticks(range(len(cameras)), list(cameras), fontsize=8)
    figure.colorbar(image, label="mm")
    return figure


def paper_page(results: Experiments) -> Page:
    """Page of the Hi-ROS paper's experiments on simulated logs."""
    page = Page("The experiments of Hi-ROS on simulated logs")
    page.text(
        f"Logs of {results.seconds:g} s. The paper's numbers come from other data: "
        "real people, Azure Kinects, inertial suits."
    )
    for title, several in (("Table 6: one person", False), ("Table 7: several people", True)):
        page.heading(title)
        sequences = [s for s in results.sequences if (s.people > 1) == several]
        page.table(tables.ANGLE_HEADER, tables.angle_rows(sequences), "RMSE (SD), degrees")
    page.figure(_gains(results), "SD of the flexion angles' errors, by configuration")
    page.heading("Joint positions")
    page.table(tables.POSITION_HEADER, tables.position_rows(results.sequences))
    page.heading("Table 8: time per merged frame, ms")
    page.table(tables.TIME_HEADER, tables.time_rows(results.sequences))
    page.heading("What the paper claims")
    page.table(
        ["claim", "", "here"],
        [[c.text, "holds" if c.holds else "does not hold", c.detail] for c in results.claims],
    )
    return page


def _gains(results: Experiments) -> Figure:
    figure = _figure(11, 3.2)
    axes = figure.subplots()
    x = np.arange(len(results.sequences))
    for k, name in enumerate(CONFIGURATIONS):
        values = [s.measures[name].angle_deviation for s in results.sequences]
        axes.bar(x + 0.27 * (k - 1), values, 0.27, label=name)
    axes.set_xticks(
        x, [f"{s.people} {s.action}" for s in results.sequences], rotation=60, ha="right"
    )
    axes.set_ylabel("degrees")
    axes.legend(frameon=False)
    _tidy(axes)
    return figure
