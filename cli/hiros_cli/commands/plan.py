"""``hiros plan``: where to put cameras in a room, and what error to expect."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from hiros_cli.commands.simulate import simulate_params
from hiros_cli.options import OUTPUT, Force, Json, Quiet
from hiros_mcap.errors import ConfigError


def plan(
    room: Annotated[
        str | None,
        typer.Option(metavar="WxD", help="Width and depth, m, such as 6x5. x is along the width."),
    ] = None,
    cameras: Annotated[
        str,
        typer.Option(
            metavar="NUMBER|FILE",
            help="How many to place. Or a file with the poses of those that stand "
            "there, as of `hiros calibrate people -o`; z must point up from the floor.",
        ),
    ] = "4",
    people: Annotated[
        int, typer.Option(metavar="NUMBER", help="In the room at once, at most 10.", min=1)
    ] = 1,
    fov: Annotated[
        str | None,
        typer.Option(
            metavar="AxU", help="Field of view across and upright, deg. Default: 75x65, or FILE's."
        ),
    ] = None,
    reach: Annotated[
        str | None,
        typer.Option(
            "--range",
            metavar="NEAR:FAR",
            help="Depths that a camera sees, m. Default: 0.5:5.5, or FILE's.",
        ),
    ] = None,
    height: Annotated[
        float,
        typer.Option(metavar="M", help="Of cameras above the floor, m.", min=0.3, max=10.0),
    ] = 2.2,
    noise: Annotated[
        float,
        typer.Option(metavar="SCALE", help="Noise of the detectors, as in `hiros simulate`."),
    ] = 1.0,
    joints: Annotated[bool, typer.Option("--joints", help="Also print each joint.")] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="Write the cameras' poses, for --extrinsics and `hiros simulate --cameras`.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also draw the floor as PNG.", rich_help_panel=OUTPUT),
    ] = None,
    force: Force = False,
    json: Json = False,
    quiet: Quiet = False,
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
    for name, option, text, mark in (("fov", "--fov", fov, "x"), ("range", "--range", reach, ":")):
        if text is not None:
            given.setdefault("rig", {})[name] = _pair(option, text, mark)
    params = simulate_params({**given, "people": people, "noise": noise})
    rig_plan = make_plan(params, height, None if rig is None else rig.poses)
    if output is not None:
        save_rig(output, rig_plan.params)
    if picture is not None:
        from hiros_viewer.curves import save_png
        from hiros_viewer.floor_picture import floor_figure

        save_png(floor_figure(rig_plan), picture)
    if json:
        print_json("plan", rig_plan.to_dict())
    elif not quiet:
        show_plan(rig_plan, [path for path in (output, picture) if path is not None], joints=joints)


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
