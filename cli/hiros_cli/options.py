"""Options that several commands share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from hiros_cli.completing import parameters, presets, systems, topics
from hiros_mcap.defaults import default_system
from hiros_mcap.errors import ConfigError

PARAMETERS, INPUT, OUTPUT = "Parameters", "Input", "Output"
"""Groups of options in a command's help."""

LOSSES = 3
"""Exit code: a damaged log was recovered, and something is lost."""

Cameras = Annotated[
    list[str] | None,
    typer.Option(
        metavar="GLOB",
        help="Cameras to read; may be repeated. Default: all.",
        autocompletion=topics,
        rich_help_panel=INPUT,
    ),
]
Extrinsics = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Camera poses that replace the log's transforms.",
        rich_help_panel=INPUT,
    ),
]
Html = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="Also write an HTML page with plots.", rich_help_panel=OUTPUT
    ),
]
Preset = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="Start from a preset of hiros: default, realtime, paper or upstream.",
        autocompletion=presets,
        rich_help_panel=PARAMETERS,
    ),
]
ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        help="TOML file with parameters, as `hiros config` prints. Default: hiros.toml in the "
        "folder of the log, if there is one.",
        rich_help_panel=PARAMETERS,
    ),
]
SystemName = Annotated[
    str | None,
    typer.Option(
        "--system",
        metavar="NAME",
        help="System to run; `hiros systems` lists them. Default: fuse, on live input "
        "fuse-realtime; with a preset hiros, on live input hiros-realtime.",
        autocompletion=systems,
        rich_help_panel=PARAMETERS,
    ),
]
Assignments = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="STAGE.PARAM=VALUE",
        help="Change one parameter; may be repeated.",
        autocompletion=parameters,
        rich_help_panel=PARAMETERS,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead.", rich_help_panel=OUTPUT)]
Quiet = Annotated[
    bool,
    typer.Option("--quiet", "-q", help="Print only warnings and errors.", rich_help_panel=OUTPUT),
]
QuietResult = Annotated[
    bool,
    typer.Option(
        "--quiet",
        "-q",
        help="Print only warnings and errors; use the exit code and the files.",
        rich_help_panel=OUTPUT,
    ),
]
Force = Annotated[
    bool,
    typer.Option(
        "--force",
        "-f",
        help="Also overwrite files that hiros did not write.",
        rich_help_panel=OUTPUT,
    ),
]

MANY = "Many logs"
Jobs = Annotated[
    int | None,
    typer.Option(
        min=0,
        metavar="NUMBER",
        help="Logs at once; 0 = one per core. With it, one log is treated as many are.",
        show_default="0",
        rich_help_panel=MANY,
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Run on a Dask cluster: its address, a scheduler file (.json), or local to start one.",
        rich_help_panel=MANY,
    ),
]
Table = Annotated[
    Path | None,
    typer.Option(
        "--csv",
        metavar="FILE",
        help="Also write the table of all logs as CSV.",
        rich_help_panel=MANY,
    ),
]


def config_file(given: Path | None, logs: Sequence[str]) -> Path | None:
    """Return the file with the parameters: the one that is named, or hiros.toml beside the logs.

    Raises ConfigError if that of some logs is not that of others.
    """
    if given is not None:
        return given
    from hiros_mcap.config import SETTINGS, settings_beside

    files = {settings_beside(log) for log in logs}
    if len(files) > 1:
        raise ConfigError(
            f"not all logs have the same {SETTINGS} beside them; name one by --config"
        )
    return files.pop()


def chosen_system(system: str | None, preset: str, *, live: bool = False) -> str:
    """Return the system to run: the one that is named, or the default."""
    return default_system(preset, live=live) if system is None else system


def seconds_range(option: str, text: str) -> tuple[float, float]:
    """Read ``START:END`` in seconds.

    Raises ConfigError if it is not of this form, starts at no finite time, or ends before it
    starts.
    """
    start, _, end = text.partition(":")
    try:
        window = float(start), float(end)
    except ValueError:
        raise ConfigError(f"{option}: {text!r} is not of the form START:END, in s") from None
    if math.isinf(window[0]):
        raise ConfigError(f"{option}: {text!r} must start at a finite time")
    if not window[0] < window[1]:
        raise ConfigError(f"{option}: {text!r} ends before it starts")
    return window
