"""``hiros calibrate``: parameters measured on a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hiros_cli.options import Json, seconds_range
from hiros_mcap.errors import ConfigError

STILL_M = 0.1
"""Detections of somebody who stands still scatter by less."""

app = typer.Typer(help="Measure parameters on a log.", no_args_is_help=True)


@app.callback()
def calibrate() -> None:
    """Measure parameters on a log."""


@app.command()
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

    Only --system malaguti uses this parameter.
    """
    from hiros_cli.compiling import prepare
    from hiros_cli.output import print_json, warn

    log.stat()
    span = None if window is None else seconds_range("--window", window)
    prepare(quiet=json)
    from hiros_mcap.calibrate.noise import measure_noise
    from hiros_mcap.io.log import open_log
    from hiros_mcap.stages.associate import associate
    from hiros_mcap.summary import number

    with open_log(log) as opened:
        start = opened.span[0]
        detections = opened.detections()
        frames = (
            frame
            for frame in associate(detections, opened.model)
            if span is None or span[0] <= (frame.stamp - start) / 1e9 <= span[1]
        )
        found = measure_noise(frames, opened.model)
    if not found.cameras:
        raise ConfigError(f"{log}: no camera sees anybody twice; there is no noise to measure")
    warnings = []
    if found.deviation > STILL_M:
        warnings.append(
            f"joints scatter by {number(100 * found.deviation, 0)} cm about their "
            "mean, so somebody moved; choose a part without motion with --window START:END"
        )
    for text in warnings:
        warn(text)
    if json:
        from hiros_mcap.summary import plain

        print_json("calibrate.noise", plain(found), warnings)
        return
    print(f"# {found.detections} detections; SD per axis of a joint about its mean, mm")
    for kind, table in (("camera", found.cameras), ("joint", found.joints)):
        for name, deviation in table.items():
            print(f"# {kind} {name}: {number(1000 * deviation, 1)}")
    if found.deviation > STILL_M:  # stdout may go into a file without the warning
        print("# more than 10 cm: somebody moved; choose a part without motion with --window")
    print(f"[kalman]\nmeasurement_noise = {found.deviation:.5f}")
