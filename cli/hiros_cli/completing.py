"""What the shell offers when Tab is pressed: systems, presets, parameters, topics of a log.

A completion must not take longer than a key stroke, so nothing here imports the library's stages,
which load compiled code: names are read from their sources. A completion never fails. At worst it
offers nothing, and the shell falls back on file names.
"""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

import hiros_mcap

VARIABLE = "_HIROS_COMPLETE"
"""The shell asks for completions by this environment variable, as typer defines it."""
SHELLS = ("bash", "zsh", "fish")
_LIBRARY = Path(hiros_mcap.__file__).parent


def script_of(shell: str, command: Any) -> int:
    """Print the script that makes a shell ask for completions; return the exit code."""
    with _environment(**{VARIABLE: f"source_{shell}"}):
        return answer(command)


def answer(command: Any) -> int:
    """Answer the request of a shell, by what is in the environment."""
    from typer.completion import completion_init  # type: ignore[attr-defined]

    completion_init()
    # In a narrow terminal typer breaks descriptions, and fish offers the rest of the lines, too.
    with _environment(COLUMNS="10000"):
        try:
            command.main(args=[], prog_name="hiros", complete_var=VARIABLE, standalone_mode=False)
        except SystemExit as end:  # always: typer ends the program when it has answered
            return int(end.code or 0)
    return 0


@contextmanager
def _environment(**values: str) -> Iterator[None]:
    """Set variables of the environment for a while."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def systems(incomplete: str) -> list[str]:
    """Names for --system."""
    return _starting(incomplete, _keys("systems/__init__.py", "SYSTEMS"))


def presets(incomplete: str) -> list[str]:
    """Names for --preset."""
    return _starting(incomplete, _keys("config.py", "PRESETS"))


def parameters(incomplete: str) -> list[str]:
    """Names for --set, each with its equals sign."""
    names = [f"{section}.{name}=" for section, name in parameter_names()]
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


def parameter_names() -> Iterator[tuple[str, str]]:
    """Yield section and name of every parameter, from the sources of their classes."""
    classes = {
        node.name: node
        for path in (_LIBRARY / "config.py", *sorted((_LIBRARY / "stages").glob("*.py")))
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    }
    for section, kind in _fields("Config", classes):
        yield from ((section, name) for name, _ in _fields(kind, classes))


def _fields(name: str, classes: Mapping[str, ast.ClassDef]) -> Iterator[tuple[str, str]]:
    """Yield name and type of each field of a class and of those that it extends."""
    if name not in classes:
        return
    for base in classes[name].bases:
        yield from _fields(ast.unparse(base), classes)
    for line in classes[name].body:
        if not (isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name)):
            continue
        if not line.target.id.startswith("__"):
            yield line.target.id, ast.unparse(line.annotation)


def _keys(path: str, name: str) -> list[str]:
    """Return the keys of a table in a source."""
    for node in ast.parse((_LIBRARY / path).read_text(encoding="utf-8")).body:
        targets = [node.target] if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [])
        if any(isinstance(t, ast.Name) and t.id == name for t in targets):
            value = getattr(node, "value", None)
            keys = value.keys if isinstance(value, ast.Dict) else []
            return [key.value for key in keys if isinstance(key, ast.Constant)]  # type: ignore[misc]
    return []


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


def _starting(incomplete: str, names: list[str]) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
