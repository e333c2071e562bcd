"""Options that several commands share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from hiros_cli.completing import parameters, presets, systems, topics
from hiros_mcap.defaults import default_system
from hiros_mcap.errors import ConfigError

PARAMETERS, INPUT, OUTPUT = "Parameters", "Input", "Output"
"""Groups of options in a command's help."""


def option(
    metavar: str, text: str, *names: str, default: Any = None, panel: str | None = None, **more: Any
) -> Any:
    """Return an option that takes a value, as a parameter's default; ``...`` = it is required."""
    more |= {"metavar": metavar, "help": text, "rich_help_panel": panel}
    return typer.Option(default, *names, **more)


def flag(name: str, text: str, *names: str, panel: str | None = None, **more: Any) -> Any:
    """Return an option without a value."""
    return typer.Option(False, name, *names, help=text, rich_help_panel=panel, **more)


def argument(metavar: str, text: str, default: Any = ...) -> Any:
    """Return an argument; ``...`` = it is required."""
    return typer.Argument(default, metavar=metavar, help=text)


LOSSES = 3
"""Exit code: a damaged log was recovered, and something is lost."""

CAMERAS = option(
    "GLOB", "Cameras to read; may be repeated. Default: all.", panel=INPUT, autocompletion=topics
)
EXTRINSICS = option("FILE", "Camera poses that replace the log's transforms.", panel=INPUT)
HTML = option("FILE", "Also write an HTML page with plots.", panel=OUTPUT)
PRESET = option(
    "NAME",
    "Start from a preset of hiros: default, realtime, paper or upstream.",
    default="default",
    panel=PARAMETERS,
    autocompletion=presets,
)
CONFIG = option(
    "FILE",
    "TOML file with parameters, as `hiros config` prints. Default: hiros.toml in the "
    "folder of the log, if there is one.",
    panel=PARAMETERS,
)
SYSTEM = option(
    "NAME",
    "System to run; `hiros systems` lists them. Default: fuse, on live input "
    "fuse-realtime; with a preset hiros, on live input hiros-realtime.",
    panel=PARAMETERS,
    autocompletion=systems,
)
ASSIGNMENTS = option(
    "STAGE.PARAM=VALUE",
    "Change one parameter; may be repeated.",
    "--set",
    panel=PARAMETERS,
    autocompletion=parameters,
)
JSON = flag("--json", "Print JSON instead.", panel=OUTPUT)
QUIET = flag("--quiet", "Print only warnings and errors.", "-q", panel=OUTPUT)
QUIET_RESULT = flag(
    "--quiet",
    "Print only warnings and errors; use the exit code and the files.",
    "-q",
    panel=OUTPUT,
)
FORCE = flag("--force", "Also overwrite files that hiros did not write.", "-f", panel=OUTPUT)

MANY = "Many logs"
JOBS = option(
    "NUMBER",
    "Logs at once; 0 = one per core. With it, one log is treated as many are.",
    min=0,
    show_default="0",
    panel=MANY,
)
CLUSTER = option(
    "ADDRESS",
    "Run on a Dask cluster: its address, a scheduler file (.json), or local to start one.",
    panel=MANY,
)
TABLE = option("FILE", "Also write the table of all logs as CSV.", "--csv", panel=MANY)


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
