"""Print a plan of ``hiros plan``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from hiros_cli.run_report import listing, page
from hiros_mcap.plan.planning import Outlook, RoomPlan
from hiros_mcap.summary import number, quantity


def show_plan(plan: RoomPlan, written: Iterable[Path], *, joints: bool) -> None:
    """Print the cameras, what is expected with all, with one less and with one more."""
    x0, y0, x1, y1 = plan.params.area
    people = plan.params.people
    rigs: list[tuple[str, Outlook]] = [("all cameras", plan.expected)]
    rigs += [(f"without {camera.name}", camera.then) for camera in plan.cameras]
    rigs += [("with one more", plan.further.then)]
    errors = {**plan.parts_mm, **(plan.joints_mm if joints else {})}
    page(
        f"{x1 - x0:.1f} m x {y1 - y0:.1f} m, {quantity(len(plan.cameras), 'camera')}, "
        f"{people} {'person' if people == 1 else 'people'}: "
        f"expected error {number(plan.expected.error_mm, 1, ' mm')}",
        listing(
            [*plan.cameras, plan.further],
            ("Camera", lambda camera: camera.name),
            (">x, m", lambda camera: number(camera.x, 2)),
            (">y, m", lambda camera: number(camera.y, 2)),
            (">Height, m", lambda camera: number(camera.height, 2)),
            (">Bearing, deg", lambda camera: number(camera.bearing_deg, 0)),
            (">Tilt, deg", lambda camera: number(camera.tilt_deg, 0)),
        ),
        listing(
            rigs,
            ("People anywhere on the floor", lambda rig: rig[0]),
            (">Error, mm", lambda rig: number(rig[1].error_mm, 1)),
            (">1 camera", lambda rig: number(100 * rig[1].one, 1, " %")),
            (">2 cameras", lambda rig: number(100 * rig[1].two, 1, " %")),
            (">3 cameras", lambda rig: number(100 * rig[1].three, 1, " %")),
        ),
        listing(
            errors.items(),
            ("Joints", lambda row: row[0]),
            (">Error, mm", lambda row: number(row[1], 1)),
        ),
        [f"wrote {path}" for path in written],
    )
