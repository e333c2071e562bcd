"""``hiros import``: joint positions from CSV, TRC and JSON files, as a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hiros_cli.options import Force, Quiet


def import_(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE",
            help="CSV, TRC or JSON files, or folders of JSON files, one for each camera.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="LOG", help="MCAP log to write.")
    ],
    mapping: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="TOML file with names, units, axes, cameras and clock of FILE; or openpose, "
            "mediapipe, freemocap, pose2sim, opencap.",
        ),
    ] = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Turn files of joint positions into a log.

    hiros process, view and info read it like any other.
    """
    from hiros_cli.compiling import prepare
    from hiros_cli.output import check_outputs, warn

    for path in sources:
        path.stat()
    check_outputs((output, "log"), inputs=(*sources, mapping), force=force)
    prepare(quiet=quiet)
    from hiros_mcap.io.joints.importing import import_joints

    written = import_joints(sources, output, mapping, warn)
    if not quiet:
        print(f"wrote {sum(written.values())} messages on {len(written)} channels to {output}")
