"""``hiros plan``: where to put cameras in a room, and what error to expect."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hiros_cli.commands.simulate import simulate_params
from hiros_cli.options import FORCE, JSON, OUTPUT, QUIET, flag, option
from hiros_mcap.errors import ConfigError


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
    from hiros_cli.output import check_outputs, print_json

    placed = None if cameras.isdigit() else Path(cameras)
    if placed is not None:
        placed.stat()
    if picture is not None and picture.suffix != ".png":
        raise ConfigError(f"{picture}: the name of a picture must end in .png")
    check_outputs((output, "camera file"), (picture, "PNG picture"), inputs=(placed,), force=force)
    from hiros_cli.compiling import prepare
    from hiros_cli.plan_report import show_plan

    prepare(quiet=json or quiet)
    from hiros_mcap.plan.planning import make_plan
    from hiros_mcap.simulate.rig_file import read_rig, room_area, save_rig

    rig = None if placed is None else read_rig(placed)
    given: dict[str, Any] = {"cameras": int(cameras)} if rig is None else rig.settings
    size = None if room is None else _pair("--room", room, "x")
    given["area"] = room_area(size, given.get("area"))
    for name, text, mark in (("fov", fov, "x"), ("range", reach, ":")):
        if text is not None:
            given.setdefault("rig", {})[name] = _pair(f"--{name}", text, mark)
    params = simulate_params({**given, "people": people, "noise": noise})
    found = make_plan(params, height, None if rig is None else rig.poses)
    if output is not None:
        save_rig(output, found.params)
    if picture is not None:
        from hiros_viewer.curves import save_png
        from hiros_viewer.floor_picture import floor_figure

        save_png(floor_figure(found), picture)
    if json:
        print_json("plan", found.to_dict())
    elif not quiet:
        show_plan(found, [path for path in (output, picture) if path is not None], joints=joints)


def _pair(option: str, text: str, mark: str) -> tuple[float, float]:
    """Read two numbers.

    Raises ConfigError naming the option.
    """
    first, _, second = text.partition(mark)
    name = "an x" if mark == "x" else "a colon"
    try:
        return float(first), float(second)
    except ValueError:
        raise ConfigError(f"{option}: should be two numbers around {name}, is {text}") from None
