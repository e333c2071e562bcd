"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Preset = Annotated[
    str,
    typer.Option(metavar="NAME", help="Start from a preset: default, realtime, paper or upstream."),
]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", help="TOML file as `hiros config` prints it."),
]
Assignments = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="STAGE.PARAM=VALUE", help="Change one parameter; may be repeated."
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines instead.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
Force = Annotated[
    bool, typer.Option("--force", "-f", help="Replace a file that hiros did not write.")
]
