"""What a ball or a board told about a log's cameras, for a person."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from hiros_cli.printable import printable
from hiros_cli.run_report import console, note, say, table
from hiros_mcap.calibrate.ball import BallReport
from hiros_mcap.calibrate.ball_poses import BallCamera
from hiros_mcap.calibrate.board import BoardReport
from hiros_mcap.summary import number, quantity

GAUGES = {
    "transforms": "The rig as a whole stays where the log's transforms put it.",
    "first camera": "It is the frame of the first camera.",
}


def show_ball(log: Path, report: BallReport) -> None:
    """Print a line per camera, what the fixed frame is, and notes."""
    out, found = console(), report.found
    say(out, f"{log}: poses from the ball: {found.verdict}", "bold")
    out.print()
    columns = ("Camera", ">Seen", "Against", ">Common", ">Used", ">SE deg", ">mm", ">Residual mm")
    out.print(table(*columns, "Verdict", rows=map(_row, found.cameras)))
    say(out, f'Fixed frame "{found.fixed_frame}": {GAUGES[found.gauge]}', before="\n")
    if not math.isnan(report.radius):
        note(out, f"the ball's radius as measured: {report.radius:.3f} m")
    _show_skipped(report.skipped)


def show_board(log: Path, report: BoardReport) -> None:
    """Print a line per camera, what the fixed frame is, and notes."""
    out = console()
    say(out, f"{log}: poses from the board: {report.verdict}", "bold")
    out.print()
    rows = [
        (
            printable(camera.name),
            str(camera.seen),
            number(camera.error_deg, 2),
            number(camera.error_mm, 1),
            number(camera.residual_mm, 1),
            camera.verdict,
        )
        for camera in report.cameras
    ]
    columns = ("Camera", ">Seen", ">SE deg", ">mm", ">Residual mm", "Verdict")
    out.print(table(*columns, rows=rows))
    say(out, f'Fixed frame "{report.fixed_frame}": marker 1 of the board; z is up.', before="\n")
    if report.gauge == "transforms":
        note(out, "the cameras stay as the transforms have them to each other")
    _show_skipped(report.skipped)


def _show_skipped(skipped: Mapping[str, Mapping[str, int]]) -> None:
    out = console()
    for name, reasons in skipped.items():
        for reason, count in sorted(reasons.items()):
            if count:
                note(out, f"{name}: {quantity(count, 'depth image')} {reason}")


def _row(camera: BallCamera) -> tuple[str, ...]:
    name, seen = printable(camera.name), str(camera.seen)
    if not camera.against:
        return (name, seen, *"------", camera.verdict)
    return (
        name,
        seen,
        printable(camera.against),
        str(camera.common),
        str(camera.used),
        number(camera.error_deg, 2),
        number(camera.error_mm, 1),
        number(camera.residual_mm, 1),
        camera.verdict,
    )
