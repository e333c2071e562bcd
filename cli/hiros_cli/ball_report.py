"""What a ball or a board told about a log's cameras, for a person."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from hiros_cli.run_report import listing, page
from hiros_mcap.calibrate.ball import BallReport
from hiros_mcap.calibrate.board import BoardReport
from hiros_mcap.summary import number, quantity

GAUGES = {
    "transforms": "The rig as a whole stays where the log's transforms put it.",
    "first camera": "It is the frame of the first camera.",
}


def show_ball(log: Path, report: BallReport) -> None:
    """Print a line per camera, what the fixed frame is, and notes."""
    calibration, radius = report.calibration, report.radius
    page(
        f"{log}: poses from the ball: {calibration.verdict}",
        listing(
            calibration.cameras,
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
        [f'Fixed frame "{calibration.fixed_frame}": {GAUGES[calibration.gauge]}'],
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
