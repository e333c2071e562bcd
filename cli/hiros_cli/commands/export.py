"""``hiros export``: a result as a file of another program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hiros_cli.completing import topics
from hiros_cli.options import Force, Quiet
from hiros_mcap.errors import ConfigError


def export(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Output of `hiros process`.")],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="Output file: .csv, .parquet, .jsonl, .npz, .trc, .mot, .c3d or .bvh.",
        ),
    ],
    what: Annotated[
        str,
        typer.Option(
            metavar="PART", help="joints, angles or both. Default: all that fits the format."
        ),
    ] = "",
    person: Annotated[
        int | None, typer.Option(metavar="ID", help="One person. Default: everybody.")
    ] = None,
    channel: Annotated[
        str,
        typer.Option(
            metavar="TOPIC",
            help="Channel to export. Default: the last stage.",
            autocompletion=topics,
        ),
    ] = "",
    rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ", help="Resample to this rate. Default: only if the format needs it."
        ),
    ] = None,
    start: Annotated[
        float,
        typer.Option(
            metavar="S", show_default=False, help="Start, s from the log's start. Default: all."
        ),
    ] = float("-inf"),
    end: Annotated[
        float,
        typer.Option(
            metavar="S", show_default=False, help="End, s from the log's start. Default: all."
        ),
    ] = float("inf"),
    marker_set: Annotated[
        str,
        typer.Option(
            metavar="FILE",
            help="For .trc and .c3d: TOML file of marker names, ours = theirs, or rajagopal for "
            "the joint centres of that OpenSim model. Default: our names.",
        ),
    ] = "",
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Write joints and angles as CSV, Parquet, TRC, MOT, C3D, BVH."""
    from hiros_cli.compiling import prepare
    from hiros_cli.output import check_outputs
    from hiros_mcap.io.export.files import export as write
    from hiros_mcap.io.export.files import files_of, format_of
    from hiros_mcap.io.export.marker_set import SUFFIXES, load_marker_set, renamed

    log.stat()
    format_of(output)
    if marker_set and (output.suffix.lower() not in SUFFIXES or what not in ("", "joints")):
        raise ConfigError(f"{output}: --marker-set is for the joints of {' and '.join(SUFFIXES)}")
    prepare(quiet=quiet)
    from hiros_mcap.io.result import open_result

    result = open_result(log, channel).select(person, start, end, rate)
    if marker_set:
        result, what = renamed(result, load_marker_set(marker_set, result.model)), "joints"
    targets = files_of(output, result.people)
    check_outputs(*((path, "export") for path in targets), inputs=(log,), force=force)
    for path in write(result, output, what):
        if not quiet:
            print(f"wrote {path}")
