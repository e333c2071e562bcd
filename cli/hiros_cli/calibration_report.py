"""What was found out about a log's cameras, from people, a ball or a board, for a person."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from rich.table import Table

from hiros_cli.run_report import listing, page, period
from hiros_mcap.calibrate.ball import BallReport
from hiros_mcap.calibrate.board import BoardReport
from hiros_mcap.calibrate.people import PeopleCalibration
from hiros_mcap.calibrate.verdict import CalibratedCamera
from hiros_mcap.summary import number, quantity

GAUGES = {
    "transforms": "The rig as a whole stays where the log's transforms put it.",
    "floor": "z is up from the floor that people stand on; the origin is below the first camera.",
    "first camera": "The first camera gives the fixed frame: nobody stands upright on a floor.",
}
_BALL_GAUGES = {**GAUGES, "first camera": "It is the frame of the first camera."}
DRIFT_PPM = 100.0
"""A smaller drift is not measured reliably."""


def show_calibration(log: Path, people: PeopleCalibration, *, joints: bool) -> None:
    """Print a line per camera, what the fixed frame is, and notes."""
    gauge = people.gauge and [f'Fixed frame "{people.fixed_frame}": {GAUGES[people.gauge]}']
    rows = [(name, number(mm, 0)) for name, mm in people.joints.items()]
    title = "Distance of each joint to the other cameras' mean, median"
    page(
        f"{log}: poses and clocks from the people: {people.verdict}",
        _cameras(people.cameras),
        gauge or None,
        (title, (("Joint", "mm"), rows)) if rows and joints else None,
        notes=_notes(people.cameras),
    )


def _notes(cameras: Sequence[CalibratedCamera]) -> Iterator[str]:
    for camera in cameras:
        if not math.isnan(camera.since_s):
            other = " (or the other camera)" if len(cameras) == 3 else ""
            yield f"{camera.name}{other} was moved {camera.since_s:.1f} s after the start"
        if camera.reason:
            yield f"{camera.name}: {camera.reason}"
        elif math.isnan(camera.clock_s):
            yield f"{camera.name}: no motion tells its clock; the log's stamps are kept"
        if abs(camera.drift_ppm) > DRIFT_PPM:
            yield f"{camera.name}: its clock drifts by {camera.drift_ppm:.0f} us per s"


def _cameras(cameras: Sequence[CalibratedCamera]) -> Table:
    given = any(not math.isnan(camera.moved_deg) for camera in cameras)
    moved: list[tuple[str, Callable[[CalibratedCamera], str]]] = [
        (">Moved mm", lambda c: number(c.moved_mm, 0)),
        (">deg", lambda c: number(c.moved_deg, 2)),
    ]
    return listing(
        cameras,
        ("Camera", lambda c: c.name + period(c.since_s, c.until_s)),
        *(moved if given else ()),
        (">Clock ms", lambda c: number(1000 * c.clock_s, 1)),
        (">SE deg", lambda c: number(c.error_deg, 2)),
        (">mm", lambda c: number(c.error_mm, 0)),
        (">ms", lambda c: number(c.error_ms, 1)),
        (">Residual mm", lambda c: number(c.residual_mm, 0)),
        ("Verdict", lambda c: c.verdict),
    )


def show_ball(log: Path, report: BallReport) -> None:
    """Print a line per camera, what the fixed frame is, and notes."""
    balls, radius = report.calibration, report.radius
    page(
        f"{log}: poses from the ball: {balls.verdict}",
        listing(
            balls.cameras,
            ("Camera", lambda c: c.name),
            (">Seen", lambda c: c.seen),
            ("Against", lambda c: c.against or "-"),
            (">Common", lambda c: c.common if c.against else "-"),
            (">Used", lambda c: c.used if c.against else "-"),
            (">SE deg", lambda c: number(c.error_deg, 2) if c.against else "-"),
            (">mm", lambda c: number(c.error_mm, 1) if c.against else "-"),
            (">Residual mm", lambda c: number(c.residual_mm, 1) if c.against else "-"),
            ("Verdict", lambda c: c.verdict),
        ),
        [f'Fixed frame "{balls.fixed_frame}": {_BALL_GAUGES[balls.gauge]}'],
        notes=[
            *([] if math.isnan(radius) else [f"the ball's radius as measured: {radius:.3f} m"]),
            *_skipped(report.skipped),
        ],
    )


def show_board(log: Path, report: BoardReport) -> None:
    """Print a line per camera, what the fixed frame is, and notes."""
    kept = report.gauge == "transforms"
    page(
        f"{log}: poses from the board: {report.verdict}",
        listing(
            report.cameras,
            ("Camera", lambda c: c.name),
            (">Seen", lambda c: c.seen),
            (">SE deg", lambda c: number(c.error_deg, 2)),
            (">mm", lambda c: number(c.error_mm, 1)),
            (">Residual mm", lambda c: number(c.residual_mm, 1)),
            ("Verdict", lambda c: c.verdict),
        ),
        [f'Fixed frame "{report.fixed_frame}": marker 1 of the board; z is up.'],
        notes=[
            *(["the cameras stay as the transforms have them to each other"] if kept else []),
            *_skipped(report.skipped),
        ],
    )


def _skipped(skipped: Mapping[str, Mapping[str, int]]) -> list[str]:
    return [
        f"{name}: {quantity(count, 'depth image')} {reason}"
        for name, reasons in skipped.items()
        for reason, count in sorted(reasons.items())
        if count
    ]
