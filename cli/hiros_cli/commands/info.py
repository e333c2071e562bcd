"""``hiros info``: what a log holds, and whether ``hiros process`` can use it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hiros_cli.options import Json

if TYPE_CHECKING:
    from hiros_mcap.io.overview import CameraRow, Overview


def info(
    source: Annotated[Path, typer.Argument(metavar="LOG", help="MCAP file or ROS bag.")],
    topic: Annotated[
        list[str] | None,
        typer.Option(metavar="GLOB", help="Cameras to look at; may be repeated. Default: all."),
    ] = None,
    extrinsics: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Camera poses that replace the log's transforms."),
    ] = None,
    json: Json = False,
) -> None:
    """Show channels, cameras, frames, people, rates and gaps."""
    from hiros_cli.compiling import prepare

    source.stat()
    prepare(quiet=json)
    from hiros_mcap.io.overview import look

    overview = look(source, topics=topic, extrinsics=extrinsics)
    if json:
        from hiros_cli.output import print_json

        print_json(overview.to_dict())
    else:
        _show(overview)


def _show(overview: Overview) -> None:
    from rich.text import Text

    from hiros_cli.printable import printable
    from hiros_cli.run_report import console, say
    from hiros_mcap.summary import number

    out = console()
    out.print(
        Text(
            f"{printable(overview.path, 500)}: {number(overview.seconds, 1)} s, "
            f"{overview.megabytes:.1f} MB",
            style="bold",
        ),
        soft_wrap=True,
    )
    for part in (_channels(overview), _cameras(overview)):
        out.print()
        out.print(part)
    out.print()
    for line in _facts(overview):
        say(out, line)


def _channels(overview: Overview) -> Any:
    from hiros_cli.run_report import table

    rows = [(row.topic, str(row.messages), row.type or "-") for row in overview.channels]
    return table("Channel", ">Messages", "Type", rows=rows)


def _cameras(overview: Overview) -> Any:
    from hiros_cli.run_report import table
    from hiros_mcap.summary import number

    return table(
        "Camera",
        "Channel",
        ">Rate",
        ">Longest gap",
        ">People",
        "Frame",
        rows=[
            (
                row.name,
                row.topic,
                number(row.rate_hz, 1, " Hz"),
                number(row.longest_gap_s, 2, " s"),
                f"{row.least_people} to {row.most_people}, mean {number(row.mean_people, 2)}",
                _frame(row),
            )
            for row in overview.cameras
        ],
    )


def _frame(row: CameraRow) -> str:
    if row.fault:
        return f"{row.frame or 'no name'} ({row.fault})"
    return f"{row.frame} (resolved)" if row.frame else "none named"


def _facts(overview: Overview) -> list[str]:
    lines = [f"skeleton: {len(overview.markers)} markers, {len(overview.links)} links"]
    lines.append(f"markers: {', '.join(overview.markers)}")
    if overview.fixed_frame:
        lines.append(f"fixed frame: {overview.fixed_frame}")
    elif overview.fault:
        lines.append(f"fixed frame: none; {overview.fault}")
    lines += overview.remarks
    lines += overview.clocks
    for topic, reasons in overview.skipped.items():
        lines += [f"{topic}: {n} messages skipped: {reason}" for reason, n in reasons.items()]
    return lines
