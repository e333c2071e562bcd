"""Scores as rows of text, for the terminal and for pages: a header, and rows under it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hiros_mcap.evaluate.leave_one_out import LeftOut, SelfScores
from hiros_mcap.evaluate.parts import PARTS
from hiros_mcap.evaluate.scores import Scores
from hiros_mcap.evaluate.side_scores import SideScores
from hiros_mcap.evaluate.statistics import ErrorStats
from hiros_mcap.summary import number

Rows = list[tuple[str, ...]]
Table = tuple[tuple[str, ...], Rows]
"""Header and rows; the first column is text, the others are numbers."""

TWO_CAMERAS = (
    "With two cameras, a camera left out is compared with the result of a single one: this tests "
    "smoothing, not fusion."
)


def error_table(scores: Mapping[str, Scores]) -> Table:
    """Joint errors, mm, and PCK, a row per channel."""
    parts = [p for p in PARTS if any(p in s.parts for s in scores.values())]
    header = ("Channel", "Mean", "SD", "RMSE", "95 %", "99 %", *(p.capitalize() for p in parts))
    rows = [
        (
            topic,
            *_millimetres(s),
            number(s.percentile_99, 1),
            *(number(s.parts[part].mean, 1) for part in parts),
            number(100 * s.pck_at(50), 1, " %"),
            number(100 * s.pck_at(100), 1, " %"),
            number(s.first_frames, 1),
        )
        for topic, s in scores.items()
    ]
    return (*header, "PCK 50", "PCK 100", "First 5"), rows


def _millimetres(error: ErrorStats | Scores) -> tuple[str, str, str, str]:
    numbers = (error.mean, error.deviation, error.rmse, error.percentile_95)
    mean, deviation, rmse, percentile = (number(value, 1) for value in numbers)
    return mean, deviation, rmse, percentile


def motion_table(scores: Mapping[str, Scores]) -> Table:
    """Angles, limbs, jitter and lag, a row per channel."""
    header = ("Channel", "Bending, deg", "By links, deg", "Orientation, deg")
    rows: Rows = [
        (
            topic,
            pair(s.angle_rmse, s.angle_deviation),
            pair(s.link_angle_rmse, s.link_angle_deviation),
            number(s.orientation_error, 2),
            number(s.limb_error, 1),
            number(s.limb_variation, 4),
            number(s.jitter, 1),
            number(s.lag, 1),
            number(s.mean_at_lag, 1),
        )
        for topic, s in scores.items()
    ]
    return (*header, "Limbs, mm", "Limb CV", "Jitter, mm", "Lag, ms", "Mean at lag"), rows


def people_table(scores: Mapping[str, Scores]) -> Table:
    """Who was missed, invented or renamed, a row per channel."""
    header = ("Channel", "Frames", "Silent", "Missing", "False", "Switches")
    rows = [
        (
            topic,
            *map(str, (s.frames, s.silent, s.missing)),
            "-" if s.false is None else str(s.false),
            str(s.switches),
            *(number(v, 3) for v in (s.tracking.mota, s.tracking.idf1, s.tracking.hota)),
        )
        for topic, s in scores.items()
    ]
    return (*header, "MOTA", "IDF1", "HOTA"), rows


BENDING = "Unsigned bending angles"
"""The eight angles of Hi-ROS 2023, section 4; the signed ones are in body.anatomy."""


def angle_table(scores: Scores) -> Table:
    """Errors of the eight bending angles, degrees, by joint positions and by links."""
    header = ("Joint", "RMSE", "SD", "Bias", "By links: RMSE", "SD", "Bias", "Left out")
    rows = []
    for name, own in scores.angles.items():
        link = scores.link_angles[name]
        cells = (number(v, 2) for s in (own, link) for v in (s.rmse, s.deviation, s.bias))
        rows.append((name, *cells, str(link.singular)))
    return header, rows


def signed_angle_table(scores: Scores) -> Table:
    """Errors of the signed joint angles (docs/angles.md), degrees."""
    rows: Rows = [
        (name, *(number(v, 2) for v in (s.rmse, s.deviation, s.bias)), str(s.singular))
        for name, s in scores.signed_angles.items()
    ]
    return ("Angle", "RMSE", "SD", "Bias", "Left out"), rows


def joint_table(joints: Mapping[str, ErrorStats]) -> Table:
    """Error of every joint, mm."""
    rows: Rows = [(name, *_millimetres(joint)) for name, joint in joints.items()]
    return ("Joint", "Mean", "SD", "RMSE", "95 %"), rows


def left_out_table(cameras: Sequence[LeftOut]) -> Table:
    """Distance of each camera left out from what the others give, mm."""
    parts = [p for p in PARTS if any(p in c.parts for c in cameras)]
    header = (
        "Left out",
        "Median",
        "Mean",
        "SD",
        "RMSE",
        "95 %",
        "Spread",
        *(p.capitalize() for p in parts),
    )
    rows = [
        (
            c.topic,
            number(c.median, 1),
            *_millimetres(c.distance),
            number(c.spread, 1),
            *(number(c.parts[part].mean, 1) for part in parts),
            number(c.offset, 1),
            *map(str, (c.detections, c.unmatched, c.mirrored)),
        )
        for c in cameras
    ]
    return (*header, "Offset", "Detections", "Of nobody", "Mirrored"), rows


def notes_without_truth(scores: SelfScores) -> list[str]:
    """Return what a reader of scores without a truth has to know."""
    return [TWO_CAMERAS] if len(scores.cameras) == 2 else []


def side_table(sides: SideScores) -> Table:
    """Signs that left and right of a result are wrong, a row each."""
    walking = max(sides.walking, 1)
    rows: Rows = [
        (f"{camera}: mirrored detections", str(n), "") for camera, n in sides.mirrored.items()
    ]
    share = number(100 * sides.backwards / walking, 1, " %")
    rows += [
        ("frames that walk backwards", str(sides.backwards), f"{share} of {sides.walking}"),
        ("turns by more than 100 degrees between frames", str(sides.jumps), ""),
    ]
    rows += [
        (f"{cue} against the facing", "", number(100 * value, 1, " %"))
        for cue, value in sides.contradicting.items()
    ]
    return ("Sign", "Number", "Share"), rows


def pair(rmse: float, deviation: float) -> str:
    """Return RMSE (SD) as the papers print them."""
    return f"{number(rmse, 2)} ({number(deviation, 2)})"
