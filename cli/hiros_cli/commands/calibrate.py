"""``hiros calibrate``: poses, clocks and parameters measured on a log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from hiros_cli.compiling import prepare
from hiros_cli.options import (
    FORCE,
    JSON,
    HelpfulCommand,
    argument,
    flag,
    option,
    seconds_range,
    settings_of,
)
from hiros_cli.output import check_outputs, print_json, warn
from hiros_mcap.errors import ConfigError, LogError, naming
from hiros_mcap.progress import bar

if TYPE_CHECKING:
    from hiros_mcap.calibrate.verdict import TargetCalibration

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
    log: Path = argument("LOG", "Recording of people who walk about."),
    output: Path | None = option(
        "FILE", "Write poses and clocks, for --extrinsics.", "--output", "-o"
    ),
    topic: list[str] | None = option("GLOB", "Cameras to read; may be repeated. Default: all."),
    joints: bool = flag("--joints", "Also print each joint."),
    height: float | None = option(
        "M",
        "Stature of the people, in the mean: RGB cameras do not tell sizes.",
        min=0.5,
        max=2.5,
        show_default="adults'",
    ),
    force: bool = FORCE,
    json: bool = JSON,
) -> None:
    """Find the cameras' poses and clocks from the people whom they see.

    No transforms are needed. Where the log has some, the rig as a whole stays where they put it.
    RGB cameras need their lenses, as CameraInfo.
    """
    log.stat()
    check_outputs((output, "camera file"), inputs=(log,), force=force)
    prepare(quiet=json)
    from hiros_cli.run_report import show_calibration
    from hiros_mcap.calibrate.calibration_files import save_cameras
    from hiros_mcap.calibrate.filmed_people import calibrate_filmed
    from hiros_mcap.calibrate.people import calibrate_people
    from hiros_mcap.io.log import open_reader
    from hiros_mcap.running.pipeline import ProcessOptions, open_input

    config, options = settings_of(log).load(), ProcessOptions(topics=tuple(topic or ()))
    with bar(f"calibrating on {log.name}", quiet=False):
        with open_reader(log) as reader, naming(log):
            calibration = calibrate_filmed(reader, topic, height)
        if calibration is None and height is not None:
            raise ConfigError("--height is for RGB cameras alone; depth cameras tell sizes")
        if calibration is None:
            with open_input(log, config, options) as opened:
                calibration = calibrate_people(opened)
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
    log: Path = argument("LOG", "Recording of a ball, with images."),
    output: Path | None = option("FILE", "Write poses, for --extrinsics.", "--output", "-o"),
    radius: float = option("M", "Radius of the ball, m.", default=0.24, min=0.01, max=2.0),
    color: str = option(
        "H-H:S-S:V-V",
        "Range of its colour in OpenCV's HSV. A hue may pass 179.",
        default="170-10:110-255:50-255",
        show_default="red, 170-10:110-255:50-255",
    ),
    topic: list[str] | None = option("GLOB", "Channels to read; may be repeated. Default: all."),
    force: bool = FORCE,
    json: bool = JSON,
) -> None:
    """Find the cameras' poses from a coloured ball.

    hiros finds it in their colour and depth images. The images may be missing if the log has the
    ball's centres as PointStamped channels.
    """
    log.stat()
    check_outputs((output, "camera file"), inputs=(log,), force=force)
    from hiros_mcap.calibrate.ball import calibrate_ball
    from hiros_mcap.calibrate.ball_image import ColorRange
    from hiros_mcap.calibrate.calibration_files import save_cameras

    colours = ColorRange.parse(color)
    with bar(f"calibrating on {log.name}", quiet=False):
        report = calibrate_ball(log, radius, colours, topic or ())
    if output is not None:
        save_cameras(output, report)
    _print("ball", log, report, json=json)


@app.command(cls=HelpfulCommand)
def board(
    log: Path = argument("LOG", "Recording of a board, with images."),
    output: Path | None = option("FILE", "Write poses, for --extrinsics.", "--output", "-o"),
    extrinsics: Path | None = option("FILE", "The cameras' poses to each other, as by a ball."),
    dictionary: str = option("NAME", "The markers' ArUco dictionary.", default="DICT_4X4_50"),
    topic: list[str] | None = option("GLOB", "Channels to read; may be repeated. Default: all."),
    force: bool = FORCE,
    json: bool = JSON,
) -> None:
    """Put the cameras into the frame of a board of four ArUco markers.

    Marker 1 is the origin, x points to marker 2, y towards marker 0, and z is up.
    """
    log.stat()
    check_outputs((output, "camera file"), inputs=(log, extrinsics), force=force)
    from hiros_mcap.calibrate.board import calibrate_board
    from hiros_mcap.calibrate.calibration_files import save_cameras

    with bar(f"calibrating on {log.name}", quiet=False):
        report = calibrate_board(
            log, dictionary=dictionary, extrinsics=extrinsics, topics=tuple(topic or ())
        )
    if output is not None:
        save_cameras(output, report)
    _print("board", log, report, json=json)


def _print(target: str, log: Path, report: TargetCalibration, *, json: bool) -> None:
    """Print what a ball or a board gave, and warnings on stderr."""
    from hiros_cli.run_report import show_target

    if json:
        print_json(f"calibrate.{target}", report.to_dict(), report.warnings)
    else:
        show_target(log, target, report)
    for text in report.warnings:
        warn(f"{log}: {text}")


@app.command(cls=HelpfulCommand)
def noise(
    log: Path = argument("LOG", "Recording of people who stand still."),
    window: str | None = option("START:END", "Only this part, s from the log's start."),
    json: bool = JSON,
) -> None:
    """Measure the detectors' noise; print it as TOML for --config, for --system malaguti."""
    log.stat()
    span = None if window is None else seconds_range("--window", window)
    prepare(quiet=json)
    from hiros_mcap.calibrate.noise import measure_noise
    from hiros_mcap.running.pipeline import ProcessOptions, open_input
    from hiros_mcap.stages.malaguti.associate import associate
    from hiros_mcap.wording import number

    config = settings_of(log).load()
    with (
        bar(f"calibrating on {log.name}", quiet=False),
        open_input(log, config, ProcessOptions()) as opened,
    ):
        start = opened.span[0]
        detections = opened.detections()
        frames = [
            frame
            for frame in associate(detections, opened.model)
            if span is None or span[0] <= (frame.stamp - start) / 1e9 <= span[1]
        ]
        scatter = measure_noise(frames, opened.model)
    if not scatter.cameras:
        raise ConfigError(f"{log}: no camera sees anybody twice; there is no noise to measure")
    warnings = []
    if scatter.deviation > STILL_M:
        warnings.append(
            f"joints scatter by {number(100 * scatter.deviation, 0)} cm about their "
            "mean, so somebody moved; choose a part without motion with --window START:END"
        )
    for text in warnings:
        warn(text)
    if json:
        from hiros_mcap.wording import plain

        print_json("calibrate.noise", plain(scatter), warnings)
        return
    print(f"# {scatter.detections} detections; SD per axis of a joint about its mean, mm")
    for kind, table in (("camera", scatter.cameras), ("joint", scatter.joints)):
        for name, deviation in table.items():
            print(f"# {kind} {name}: {number(1000 * deviation, 1)}")
    if scatter.deviation > STILL_M:  # stdout may go into a file without the warning
        print("# more than 10 cm: somebody moved; choose a part without motion with --window")
    print(f"[kalman]\nmeasurement_noise = {scatter.deviation:.5f}")
