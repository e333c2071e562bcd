"""``hiros import``: joint positions from CSV, TRC and JSON files, as a log."""

from __future__ import annotations

from pathlib import Path

from hiros_cli.compiling import prepare
from hiros_cli.options import FORCE, QUIET, argument, option
from hiros_cli.output import check_outputs, warn


def import_(
    sources: list[Path] = argument(
        "FILE", "CSV, TRC or JSON files, or folders of JSON files, one for each camera."
    ),
    output: Path = option("LOG", "MCAP log to write.", "--output", "-o", default=...),
    mapping: Path | None = option(
        "FILE",
        "TOML file with names, units, axes, cameras and clock of FILE; or openpose, "
        "mediapipe, freemocap, pose2sim, opencap.",
    ),
    force: bool = FORCE,
    quiet: bool = QUIET,
) -> None:
    """Turn files of joint positions into a log.

    hiros process, view and info read it like any other.
    """
    for path in sources:
        path.stat()
    check_outputs((output, "log"), inputs=(*sources, mapping), force=force)
    prepare(quiet=quiet)
    from hiros_mcap.io.joints.importing import import_joints

    written = import_joints(sources, output, mapping, warn)
    if not quiet:
        print(f"wrote {sum(written.values())} messages on {len(written)} channels to {output}")
