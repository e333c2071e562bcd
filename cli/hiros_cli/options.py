"""Options that several commands share, and how ``--help`` shows them: in groups, with examples."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

import typer
from typer.core import TyperCommand

from hiros_mcap.defaults import default_system
from hiros_mcap.errors import ConfigError

if TYPE_CHECKING:
    from hiros_mcap.config import Settings, Table


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


GROUP: Any = None
"""Stands for the value of a parameter that is a group of options."""


def grouped(command: Callable[..., Any]) -> Callable[..., Any]:
    """Let a command take groups of options: a dataclass whose fields are the options."""
    hints = get_type_hints(command)
    groups: dict[str, Any] = {n: hint for n, hint in hints.items() if is_dataclass(hint)}
    flat: list[Parameter] = []
    for parameter in signature(command).parameters.values():
        group = groups.get(parameter.name)
        types = hints if group is None else get_type_hints(group)
        for member in (parameter,) if group is None else fields(group):
            kinds = {"default": member.default, "annotation": types[member.name]}
            flat.append(Parameter(member.name, Parameter.KEYWORD_ONLY, **kinds))

    @wraps(command)
    def run(**values: Any) -> Any:
        for name, group in groups.items():
            values[name] = group(**{field.name: values.pop(field.name) for field in fields(group)})
        return command(**values)

    run.__signature__ = signature(command).replace(parameters=flat)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in flat}
    return run


CAMERAS = option("GLOB", "Cameras to read; may be repeated. Default: all.", panel=INPUT)
EXTRINSICS = option("FILE", "Camera poses that replace the log's transforms.", panel=INPUT)
HTML = option("FILE", "Also write an HTML page with plots.", panel=OUTPUT)


def _table(path: Path | None) -> Path | None:
    """Refuse a table of another suffix before anything is run; raises ConfigError."""
    if path is not None:
        from hiros_mcap.evaluate.measures import check_table

        check_table(path)
    return path


TABLE = option(
    "FILE",
    "Also write the table as .csv, with units and 95 % intervals.",
    panel=OUTPUT,
    callback=_table,
)
CONFIG = option(
    "FILE",
    "TOML file with parameters, as `hiros config` prints. Default: hiros.toml in the "
    "folder of the log, or the nearest one above.",
    panel=PARAMETERS,
)
JSON = flag("--json", "Print JSON instead.", panel=OUTPUT)
QUIET = flag("--quiet", "Print only warnings and errors.", "-q", panel=OUTPUT)
FORCE = flag("--force", "Also overwrite files that hiros did not write.", "-f", panel=OUTPUT)
MANY = "Many logs"


@dataclass(frozen=True, slots=True)
class Parameters:
    """The system, and the sources of its parameters."""

    system: str | None = option(
        "NAME",
        "System to run; `hiros systems` lists them. Default: fuse, on live input "
        "fuse-realtime; with a preset hiros, on live input hiros-realtime.",
        panel=PARAMETERS,
    )
    preset: str = option(
        "NAME",
        "Start from a preset of hiros: default, realtime, paper or upstream.",
        default="default",
        panel=PARAMETERS,
    )
    config: Path | None = CONFIG
    assignments: list[str] | None = option(
        "STAGE.PARAM=VALUE",
        "Change one parameter; may be repeated.",
        "--set",
        panel=PARAMETERS,
    )

    def settings(self, named: Mapping[str, Table] | None = None, *, live: bool = False) -> Settings:
        """Return where the parameters come from; ``named`` are those of options of their own."""
        from hiros_mcap.config import Settings

        system = self.system or default_system(self.preset, live=live)
        return Settings(
            system, self.preset, self.config, tuple(self.assignments or ()), dict(named or {})
        )

    @property
    def asked(self) -> bool:
        """Whether the user named any."""
        return any((self.config, self.assignments, self.system, self.preset != "default"))


def settings_of(log: str | Path, settings: Settings | None = None) -> Settings:
    """Return the settings of a log, and say on stderr if it has a file of its own."""
    from hiros_mcap.config import Settings

    asked = settings or Settings()
    chosen = asked.of(log)
    if chosen.file != asked.file:
        print(f"hiros: parameters of {chosen.file}", file=sys.stderr, flush=True)
    return chosen


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


def by_camera(option: str, texts: Iterable[str] | None, form: str) -> dict[str, float]:
    """Read ``CAMERA=NUMBER``s, or a number alone, of "", if the ``form`` allows it.

    Raises ConfigError for another form.
    """
    numbers = {}
    for text in texts or ():
        camera, _, number = text.rpartition("=")
        try:
            numbers[camera] = float(number)
        except ValueError:
            numbers[camera] = math.nan
        if not math.isfinite(numbers[camera]) or not (camera or "or" in form):
            raise ConfigError(f"{option}: {text!r} is not of the form {form}")
    return numbers


EXAMPLES: Mapping[str, tuple[str, ...]] = {
    "process": (
        "hiros process lab.mcap",
        "hiros process lab.mcap -o clean.mcap --set track.max_gap=3",
        "hiros process lab.mcap --system malaguti --extrinsics cameras.toml",
        "hiros process recordings/ -o results/ --jobs 4",
    ),
    "view": (
        "hiros view lab.hiros.mcap",
        "hiros view lab.hiros.mcap --layout stages --time-range 2:8",
        "hiros view lab.hiros.mcap --save lab.rrd",
    ),
    "plot": ("hiros plot lab.hiros.mcap", "hiros plot lab.hiros.mcap -o knees.png"),
    "export": (
        "hiros export lab.hiros.mcap -o lab.csv",
        "hiros export lab.hiros.mcap -o lab.trc --person 0 --rate 100",
        "hiros export results/ -o tables/ --format parquet",
    ),
    "eval": (
        "hiros eval lab.hiros.mcap",
        "hiros eval lab.hiros.mcap --truth mocap.trc --up y",
        "hiros eval lab.mcap --leave-one-out",
        "hiros eval results/ --truth mocap/ --csv scores.csv",
    ),
    "check": (
        "hiros check lab.hiros.mcap --golden golden/lab.mcap --bless",
        "hiros check suite.toml --junit suite.xml",
    ),
    "compare": (
        "hiros compare lab.mcap",
        "hiros compare lab.mcap --system hiros --system lee,cluster.radius=0.2",
    ),
    "info": ("hiros info lab.mcap", "hiros info recordings/"),
    "recover": ("hiros recover lab.mcap -o readable.mcap",),
    "demo": ("hiros demo", "hiros process demo.mcap", "hiros view demo.hiros.mcap"),
    "simulate": ("hiros simulate lab.mcap --people 2 --action cross --seconds 10",),
    "plan": (
        "hiros plan --room 6x5 --cameras 4 --people 2 --picture floor.png",
        "hiros plan --room 6x5 --cameras cameras.toml",
    ),
    "config": ("hiros config --system lee > lee.toml",),
    "people": ("hiros calibrate people lab.mcap -o cameras.toml",),
    "ball": ("hiros calibrate ball lab.mcap -o cameras.toml",),
    "board": ("hiros calibrate board board.mcap --extrinsics cameras.toml -o room.toml",),
    "noise": ("hiros calibrate noise still.mcap --window 2:10",),
}
"""By command."""


class HelpfulCommand(TyperCommand):
    """A command whose help shows options by their ``rich_help_panel``, then examples."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write one section per group: the command's own options come before shared ones."""
        from hiros_mcap.plugins import SYSTEMS, names

        groups: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                name, text = record
                if parameter.name == "system" and (brought := names(SYSTEMS)):
                    text += f" Packages bring {', '.join(brought)}."
                groups.setdefault(_group_of(parameter), []).append((name, _plain(text)))
        titles = sorted(groups, key=lambda title: title != "Arguments")
        titles.remove(_REST)
        titles.insert(1 if len(groups[_REST]) > 1 else len(titles), _REST)  # all have --help
        for title in titles:
            with formatter.section(title):
                formatter.write_dl(groups[title])

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples."""
        if examples := EXAMPLES.get(str(self.name)):
            with formatter.section("Examples"):
                for line in examples:
                    formatter.write(f"{'':>{formatter.current_indent}}{line}\n")


_REST = "Options"
_RANGE = re.compile(r"; [^;]*x[<>]=?[^;]*\]$")
_BRACKETS = re.compile(r"\[default: \((.*)\)\]$")


def _plain(text: str) -> str:
    """Put click's remark plainly: ``[default: (0); x>=0]`` becomes ``[default: 0]``."""
    return _BRACKETS.sub(r"[default: \1]", _RANGE.sub("]", text))


def _group_of(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return "Arguments"
    return getattr(parameter, "rich_help_panel", None) or _REST
