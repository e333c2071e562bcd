"""What was found out about a log's cameras, for a person."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from rich.table import Table

from hiros_cli.run_report import listing, page, period
from hiros_mcap.calibrate.camera_result import CalibratedCamera
from hiros_mcap.calibrate.people import PeopleCalibration
from hiros_mcap.summary import number

GAUGES = {
    "transforms": "The rig as a whole stays where the log's transforms put it.",
    "floor": "z is up from the floor that people stand on; the origin is below the first camera.",
    "first camera": "The first camera gives the fixed frame: nobody stands upright on a floor.",
}
DRIFT_PPM = 100.0
"""A smaller drift is not measured reliably."""


def show_calibration(log: Path, calibration: PeopleCalibration, *, joints: bool) -> None:
    """Print a line per camera, what the fixed frame is, and notes."""
    gauge = calibration.gauge and [
        f'Fixed frame "{calibration.fixed_frame}": {GAUGES[calibration.gauge]}'
    ]
    rows = [(name, number(mm, 0)) for name, mm in calibration.joints.items()]
    title = "Distance of each joint to the other cameras' mean, median"
    page(
        f"{log}: poses and clocks from the people: {calibration.verdict}",
        _cameras(calibration.cameras),
        gauge or None,
        (title, (("Joint", "mm"), rows)) if rows and joints else None,
        notes=_notes(calibration.cameras),
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
