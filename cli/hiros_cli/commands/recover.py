"""``hiros recover``: what can be read of a damaged recording, as a healthy log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from hiros_cli.compiling import prepare
from hiros_cli.exit_codes import LOSSES
from hiros_cli.options import FORCE, JSON, QUIET, argument, option
from hiros_cli.output import beside, check_outputs, print_json, warn
from hiros_mcap.progress import bar

if TYPE_CHECKING:
    from hiros_mcap.io.container import Recovery

SUFFIX = ".recovered.mcap"


def recover(
    source: Path = argument("LOG", "MCAP file, or folder with the MCAP files of one recording."),
    output: Path | None = option(
        "OUT", f"Output file. Default: LOG's name with {SUFFIX}.", "--output", "-o"
    ),
    force: bool = FORCE,
    json: bool = JSON,
    quiet: bool = QUIET,
) -> None:
    """Save what can be read of a damaged or truncated recording.

    Exits with 0 if nothing was lost, 3 if something was, and 2 if nothing can be read.
    """
    source.stat()
    target = beside(source, SUFFIX) if output is None else output
    check_outputs((target, "log"), inputs=(source,), force=force)
    prepare(quiet=quiet)
    from hiros_mcap.io.joining import recover as write

    with bar(f"recovering {source.name}", quiet=quiet):
        recovery = write(source, target, force=force)
    if not recovery.complete:
        warn(f"{source}: {recovery.loss}")
    if json:
        print_json("recover", recovery.to_dict(), [] if recovery.complete else [recovery.loss])
    elif not quiet:
        _show(recovery, target)
    if not recovery.complete:
        raise typer.Exit(LOSSES)


def _show(recovery: Recovery, target: Path) -> None:
    from hiros_cli.run_report import listing, page
    from hiros_mcap.wording import quantity

    lines = []
    for damage in recovery.damages:
        size = quantity(damage.end - damage.offset, "byte")
        lines.append(f"damage at {damage.place}: {damage.fault} ({size} not readable)")
    if recovery.complete:
        damaged = "the damage cost no message" if recovery.damages else "the log is not damaged"
        lines.append(f"nothing was lost: {damaged}")
    page(
        "",
        listing(
            recovery.channels,
            ("Channel", lambda c: c.topic),
            (">Recovered", lambda c: c.recovered),
            (">Lost", lambda c: "unknown" if c.lost is None else str(c.lost)),
        ),
        [*lines, f"wrote {quantity(recovery.recovered, 'message')} to {target}"],
    )
