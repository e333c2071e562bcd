"""What was found out about a log's cameras, for a person."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from hiros_cli.printable import printable
from hiros_cli.run_report import console, note, period, say, table
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


def show_calibration(log: Path, found: PeopleCalibration, *, joints: bool) -> None:
    """Print a line per camera, what the fixed frame is, and notes."""
    out = console()
    say(out, f"{log}: poses and clocks from the people: {found.verdict}", "bold")
    out.print()
    out.print(_cameras(found.cameras))
    if found.gauge:
        say(out, f'Fixed frame "{found.fixed_frame}": {GAUGES[found.gauge]}', before="\n")
    if found.joints and joints:
        rows = [(printable(name), number(mm, 0)) for name, mm in found.joints.items()]
        say(out, "Distance of each joint to the other cameras' mean, median", "bold", "\n")
        out.print(table("Joint", ">mm", rows=rows))
    for camera in found.cameras:
        if not math.isnan(camera.since_s):
            other = " (or the other camera)" if len(found.cameras) == 3 else ""
            note(out, f"{camera.name}{other} was moved {camera.since_s:.1f} s after the start")
        if camera.reason:
            note(out, f"{camera.name}: {camera.reason}")
        elif math.isnan(camera.clock_s):
            note(out, f"{camera.name}: no motion tells its clock; the log's stamps are kept")
        if abs(camera.drift_ppm) > DRIFT_PPM:
            note(out, f"{camera.name}: its clock drifts by {camera.drift_ppm:.0f} us per s")


def _cameras(cameras: Sequence[CalibratedCamera]) -> object:
    given = any(not math.isnan(camera.moved_deg) for camera in cameras)
    moved = (">Moved mm", ">deg") if given else ()
    columns = ("Camera", *moved, ">Clock ms", ">SE deg", ">mm", ">ms", ">Residual mm", "Verdict")
    rows = []
    for camera in cameras:
        row = [printable(camera.name) + period(camera.since_s, camera.until_s)]
        if given:
            row += [number(camera.moved_mm, 0), number(camera.moved_deg, 2)]
        row += [number(1000 * camera.clock_s, 1)]
        row += [number(camera.error_deg, 2), number(camera.error_mm, 0), number(camera.error_ms, 1)]
        rows.append((*row, number(camera.residual_mm, 0), camera.verdict))
    return table(*columns, rows=rows)
