"""Completion in the shell, by Tab: systems, presets, parameters, topics of a log.

A completion must not take longer than a key stroke, so nothing here imports the library's stages,
which load compiled code. A completion never fails. At worst it offers nothing, and the shell falls
back on file names.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import typer

from hiros_cli.common_options import environment
from hiros_mcap.defaults import SYSTEM_NAMES

VARIABLE = "_HIROS_COMPLETE"
"""The shell asks for completions by this environment variable, as typer defines it."""
SHELLS = ("bash", "zsh", "fish")


def script_of(shell: str, command: Any) -> int:
    """Print the script that makes a shell ask for completions; return the exit code."""
    with environment({VARIABLE: f"source_{shell}"}):
        return answer(command)


def answer(command: Any) -> int:
    """Answer the request of a shell, by what is in the environment."""
    from typer.completion import completion_init  # type: ignore[attr-defined]

    completion_init()
    # In a narrow terminal typer breaks descriptions, and fish offers the rest of the lines, too.
    with environment({"COLUMNS": "10000"}):
        try:
            command.main(args=[], prog_name="hiros", complete_var=VARIABLE, standalone_mode=False)
        except SystemExit as end:  # always: typer ends the program when it has answered
            return int(end.code or 0)
    return 0


def systems(incomplete: str) -> list[str]:
    """Names for --system."""
    from hiros_mcap.plugins import SYSTEMS, names

    return _starting(incomplete, (*SYSTEM_NAMES, *names(SYSTEMS)))


def presets(incomplete: str) -> list[str]:
    """Names for --preset."""
    from hiros_mcap.config import PRESETS

    return _starting(incomplete, PRESETS)


def parameters(incomplete: str) -> list[str]:
    """Names for --set, each with its equals sign."""
    from hiros_mcap.config import Config, settable

    names = [f"{name}.{param}=" for name, params in Config() for param in settable(params)]
    return _starting(incomplete, names)


def topics(context: typer.Context, incomplete: str) -> list[str]:
    """Topics of skeletons of the log that the command line names."""
    arguments = [one.name for one in context.command.params if one.param_type_name == "argument"]
    given = [context.params.get(name or "") for name in arguments]
    # What stands before an option without a value was not yet told apart.
    given += context.args
    paths = [path for one in given for path in (one if isinstance(one, list | tuple) else [one])]
    logs = [Path(path) for path in paths if path and Path(path).exists()]
    return _starting(incomplete, _skeleton_topics(logs[0]) if logs else [])


def _skeleton_topics(path: Path) -> list[str]:
    """Topics of skeletons in an MCAP file; none if it cannot be read at a glance."""
    from mcap.reader import make_reader

    inside = sorted(path.glob("*.mcap"))[:1] if path.is_dir() else [path]
    try:
        with inside[0].open("rb") as file:
            summary = make_reader(file).get_summary()
    except Exception:  # noqa: BLE001 - no completion is the answer to any fault
        return []
    if summary is None:
        return []
    skeletons = {i for i, s in summary.schemas.items() if s.name.endswith("/SkeletonGroup")}
    return sorted({c.topic for c in summary.channels.values() if c.schema_id in skeletons})


def _starting(incomplete: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
