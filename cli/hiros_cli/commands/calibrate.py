"""``hiros calibrate``: poses, clocks and parameters measured on a log."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from hiros_cli.help_page import HelpfulCommand
from hiros_cli.options import Force, Json, seconds_range
from hiros_mcap.errors import ConfigError, LogError

if TYPE_CHECKING:
    from hiros_mcap.calibrate.ball import BallReport
    from hiros_mcap.calibrate.board import BoardReport

_Report = TypeVar("_Report", "BallReport", "BoardReport")

STILL_M = 0.1
"""Detections of somebody who stands still scatter by less."""

app = typer.Typer(help="Measure cameras and parameters on a log.")


@app.callback(invoke_without_command=True)
def calibrate(context: typer.Context) -> None:
    """Measure cameras and parameters on a log."""
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(2)


@app.command(cls=HelpfulCommand)
def people(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Recording of people who walk about.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="Write poses and clocks, for --extrinsics."
        ),
    ] = None,
    write_log: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a copy of the log with poses and right stamps."),
    ] = None,
    topic: Annotated[
        list[str] | None,
        typer.Option(metavar="GLOB", help="Cameras to read; may be repeated. Default: all."),
    ] = None,
    joints: Annotated[bool, typer.Option("--joints", help="Also print each joint.")] = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Find the cameras' poses and clocks from the people whom they see.

    No transforms are needed. Where the log has some, the rig as a whole stays where they put it.
    """
    from hiros_cli.compiling import prepare
    from hiros_cli.output import check_outputs, print_json, warn

    log.stat()
    check_outputs((output, "camera file"), (write_log, "log"), inputs=(log,), force=force)
    prepare(quiet=json, everything=True)
    from hiros_cli.calibration_report import show_calibration
    from hiros_mcap.calibrate.cameras_file import save_cameras
    from hiros_mcap.calibrate.corrected_log import write_corrected_log
    from hiros_mcap.calibrate.people import calibrate_people
    from hiros_mcap.io.log import open_log
    from hiros_mcap.running.progress_bar import bar

    with bar(f"calibrating on {log.name}", quiet=False), open_log(log, topics=topic) as opened:
        calibration = calibrate_people(opened)
        if write_log is not None and calibration.verdict != "impossible":
            write_corrected_log(opened, calibration, write_log)
    weak = calibration.verdict in ("usable", "doubtful")
    warnings = [f"{log}: the poses are {calibration.verdict}: {calibration.reason}"] if weak else []
    if calibration.verdict == "impossible":
        raise LogError(f"no poses can be found: {calibration.reason}", path=log)
    if output is not None:
        save_cameras(output, calibration)
    if json:
        print_json("calibrate.people", calibration.to_dict(), warnings)
    else:
        show_calibration(log, calibration, joints=joints)
    for text in warnings:
        warn(text)


@app.command(cls=HelpfulCommand)
def ball(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Recording of a ball, with images.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Write poses, for --extrinsics."),
    ] = None,
    radius: Annotated[
        float, typer.Option(metavar="M", help="Radius of the ball, m.", min=0.01, max=2.0)
    ] = 0.24,
    color: Annotated[
        str,
        typer.Option(
            metavar="H-H:S-S:V-V",
            help="Range of its colour in OpenCV's HSV. A hue may pass 179.",
            show_default="red, 170-10:110-255:50-255",
        ),
    ] = "170-10:110-255:50-255",
    topic: Annotated[
        list[str] | None,
        typer.Option(metavar="GLOB", help="Channels to read; may be repeated. Default: all."),
    ] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Find the cameras' poses from a coloured ball.

    hiros finds it in their colour and depth images. The images may be missing if the log has the
    ball's centres as PointStamped channels.
    """
    from hiros_cli.ball_report import show_ball
    from hiros_cli.output import check_outputs

    log.stat()
    check_outputs((output, "camera file"), inputs=(log,), force=force)
    from hiros_mcap.calibrate.ball import BallOptions, calibrate_ball
    from hiros_mcap.calibrate.ball_image import ColorRange
    from hiros_mcap.calibrate.cameras_file import save_cameras
    from hiros_mcap.running.progress_bar import bar

    options = BallOptions(radius, ColorRange.parse(color), tuple(topic or ()))
    with bar(f"calibrating on {log.name}", quiet=False):
        report = calibrate_ball(log, options)
    if output is not None:
        save_cameras(output, report.calibration)
    _print("calibrate.ball", log, report, None if json else show_ball)


@app.command(cls=HelpfulCommand)
def board(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Recording of a board, with images.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Write poses, for --extrinsics."),
    ] = None,
    extrinsics: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The cameras' poses to each other, as by a ball."),
    ] = None,
    dictionary: Annotated[
        str, typer.Option(metavar="NAME", help="The markers' ArUco dictionary.")
    ] = "DICT_4X4_50",
    topic: Annotated[
        list[str] | None,
        typer.Option(metavar="GLOB", help="Channels to read; may be repeated. Default: all."),
    ] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Put the cameras into the frame of a board of four ArUco markers.

    Marker 1 is the origin, x points to marker 2, y towards marker 0, and z is up.
    """
    from hiros_cli.ball_report import show_board
    from hiros_cli.output import check_outputs

    log.stat()
    check_outputs((output, "camera file"), inputs=(log, extrinsics), force=force)
    from hiros_mcap.calibrate.board import calibrate_board
    from hiros_mcap.calibrate.cameras_file import save_cameras
    from hiros_mcap.running.progress_bar import bar

    with bar(f"calibrating on {log.name}", quiet=False):
        report = calibrate_board(
            log, dictionary=dictionary, extrinsics=extrinsics, topics=tuple(topic or ())
        )
    if output is not None:
        save_cameras(output, report)
    _print("calibrate.board", log, report, None if json else show_board)


def _print(
    command: str, log: Path, report: _Report, show: Callable[[Path, _Report], None] | None
) -> None:
    """Print a report by ``show``, or as JSON without it, and its warnings on stderr."""
    from hiros_cli.output import print_json, warn

    if show is None:
        print_json(command, report.to_dict(), report.warnings)
    else:
        show(log, report)
    for text in report.warnings:
        warn(f"{log}: {text}")


@app.command(cls=HelpfulCommand)
def noise(
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="Recording of people who stand still.")
    ],
    window: Annotated[
        str | None,
        typer.Option(metavar="START:END", help="Only this part, s from the log's start."),
    ] = None,
    json: Json = False,
) -> None:
    """Measure the detectors' noise; print it as TOML for --config.

    --system malaguti uses [kalman]; --system fuse and fuse-realtime use [noise], the white noise by
    camera, joint, range and confidence.
    """
    from hiros_cli.compiling import prepare
    from hiros_cli.output import print_json, warn

    log.stat()
    span = None if window is None else seconds_range("--window", window)
    prepare(quiet=json)
    from hiros_mcap.calibrate.noise import measure_noise, measure_noise_model
    from hiros_mcap.io.log import open_log
    from hiros_mcap.running.progress_bar import bar
    from hiros_mcap.stages.malaguti.associate import associate
    from hiros_mcap.summary import number

    with bar(f"calibrating on {log.name}", quiet=False), open_log(log) as opened:
        start = opened.span[0]
        detections = opened.detections()
        frames = [
            frame
            for frame in associate(detections, opened.model)
            if span is None or span[0] <= (frame.stamp - start) / 1e9 <= span[1]
        ]
        model = measure_noise(frames, opened.model)
        places = {
            name: pose.translation
            for camera in opened.cameras
            if (pose := opened.pose_of(camera)) is not None
            for name in camera.sources.values()
        }
        white = measure_noise_model(frames, opened.model, places)
    if not model.cameras:
        raise ConfigError(f"{log}: no camera sees anybody twice; there is no noise to measure")
    warnings = []
    if model.deviation > STILL_M:
        warnings.append(
            f"joints scatter by {number(100 * model.deviation, 0)} cm about their "
            "mean, so somebody moved; choose a part without motion with --window START:END"
        )
    for text in warnings:
        warn(text)
    if json:
        from hiros_mcap.summary import plain

        print_json("calibrate.noise", {**plain(model), "white": plain(white)}, warnings)
        return
    print(f"# {model.detections} detections; SD per axis of a joint about its mean, mm")
    for kind, table in (("camera", model.cameras), ("joint", model.joints)):
        for name, deviation in table.items():
            print(f"# {kind} {name}: {number(1000 * deviation, 1)}")
    if white.joints:
        print(f"# White noise, which is new in every frame\n{white.toml()}\n")
    if model.deviation > STILL_M:  # stdout may go into a file without the warning
        print("# more than 10 cm: somebody moved; choose a part without motion with --window")
    print(f"[kalman]\nmeasurement_noise = {model.deviation:.5f}")
