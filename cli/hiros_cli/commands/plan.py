"""``hiros plan``: where to put cameras in a room, and what error to expect."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from hiros_cli.commands.simulate import simulate_params
from hiros_cli.compiling import prepare
from hiros_cli.options import FORCE, JSON, OUTPUT, QUIET, flag, option
from hiros_cli.output import check_outputs, print_json
from hiros_mcap.errors import ConfigError
from hiros_mcap.progress import bar

if TYPE_CHECKING:
    from hiros_mcap.outputs import Kind
    from hiros_mcap.plan.planning import RoomPlan


def plan(
    room: str | None = option("WxD", "Width and depth, m, such as 6x5. x is along the width."),
    cameras: str = option(
        "NUMBER|FILE",
        "How many to place. Or a file with the poses of those that stand there, as of `hiros "
        "calibrate people -o`; z must point up from the floor.",
        default="4",
    ),
    people: int = option("NUMBER", "In the room at once, at most 10.", default=1, min=1),
    fov: str | None = option(
        "AxU", "Field of view across and upright, deg. Default: 75x65, or FILE's."
    ),
    reach: str | None = option(
        "NEAR:FAR", "Depths that a camera sees, m. Default: 0.5:5.5, or FILE's.", "--range"
    ),
    height: float = option("M", "Of cameras above the floor, m.", default=2.2, min=0.3, max=10.0),
    noise: float = option("SCALE", "Noise of the detectors, as in `hiros simulate`.", default=1.0),
    joints: bool = flag("--joints", "Also print each joint."),
    output: Path | None = option(
        "FILE",
        "Write the cameras' poses, for --extrinsics and `hiros simulate --cameras`.",
        "-o",
        "--output",
        panel=OUTPUT,
    ),
    picture: Path | None = option("FILE", "Also draw the floor as PNG.", panel=OUTPUT),
    force: bool = FORCE,
    json: bool = JSON,
    quiet: bool = QUIET,
) -> None:
    """Say where to put cameras in a room, and how exact they are.

    The expected error follows from the noise of the detectors and the geometry. Where a file names
    cameras that stand already, nothing is moved.
    """
    placed = None if cameras.isdecimal() and len(cameras) < 10 else Path(cameras)
    if placed is not None:
        placed.stat()
    if picture is not None and picture.suffix != ".png":
        raise ConfigError(f"{picture}: the name of a picture must end in .png")
    outputs: list[tuple[Path | None, Kind]] = [
        (output, "camera file"),
        (picture, "PNG picture"),
    ]
    check_outputs(*outputs, inputs=(placed,), force=force)

    prepare(quiet=json or quiet)
    from hiros_mcap.plan.planning import make_plan
    from hiros_mcap.simulate.cameras import read_rig, room_area, save_rig

    poses, given = (None, {}) if placed is None else read_rig(placed)
    if placed is None:
        given["cameras"] = int(cameras)
    size = None if room is None else _pair("--room", room, "x")
    given["area"] = room_area(size, given.get("area"))
    for name, text, mark in (("fov", fov, "x"), ("range", reach, ":")):
        if text is not None:
            given.setdefault("rig", {})[name] = _pair(f"--{name}", text, mark)
    params = simulate_params({**given, "people": people, "noise": noise})
    with bar("planning", quiet=json or quiet):
        rig_plan = make_plan(params, height, poses)
    if output is not None:
        save_rig(output, rig_plan.params)
    if picture is not None:
        from hiros_viewer.pictures import floor_figure, save_png

        save_png(floor_figure(rig_plan), picture)
    if json:
        print_json("plan", rig_plan.to_dict())
    elif not quiet:
        _show(rig_plan, [path for path, _ in outputs if path is not None], joints=joints)


def _pair(option: str, text: str, mark: str) -> tuple[float, float]:
    """Read two numbers.

    Raises ConfigError naming the option.
    """
    first, _, second = text.partition(mark)
    name = "an x" if mark == "x" else "a colon"
    try:
        numbers = float(first), float(second)
    except ValueError:
        numbers = math.nan, math.nan
    if not all(map(math.isfinite, numbers)):
        raise ConfigError(f"{option}: should be two numbers around {name}, is {text}")
    return numbers


def _show(plan: RoomPlan, written: Iterable[Path], *, joints: bool) -> None:
    """Print the cameras, what is expected with all, with one less and with one more."""
    from hiros_cli.run_report import listing, page
    from hiros_mcap.wording import number, quantity

    x0, y0, x1, y1 = plan.params.area
    people = plan.params.people
    rigs = [
        ("all cameras", plan.expected),
        *((f"without {camera.name}", camera.then) for camera in plan.cameras),
        ("with one more", plan.further.then),
    ]
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
            ("People anywhere on the floor", lambda row: row[0]),
            (">Error, mm", lambda row: number(row[1].error_mm, 1)),
            (">Seen by 1 camera, %", lambda row: number(100 * row[1].one, 0)),
            (">2 cameras", lambda row: number(100 * row[1].two, 0)),
            (">3 cameras", lambda row: number(100 * row[1].three, 0)),
        ),
        listing(
            errors.items(),
            ("Joints", lambda row: row[0]),
            (">Error, mm", lambda row: number(row[1], 1)),
        ),
        [f"wrote {path}" for path in written],
    )
