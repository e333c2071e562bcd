"""What ``--help`` of a command shows: its options in groups, and examples."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from typer.core import TyperCommand

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
        "hiros plan --room 6x5 --cameras 4 --people 2 -o cameras.toml --picture floor.png",
        "hiros plan --room 6x5 --cameras cameras.toml",
    ),
    "config": ("hiros config --system lee > lee.toml",),
    "people": ("hiros calibrate people lab.mcap -o cameras.toml",),
    "ball": ("hiros calibrate ball lab.mcap -o cameras.toml",),
    "board": ("hiros calibrate board board.mcap --extrinsics cameras.toml -o room.toml",),
    "noise": ("hiros calibrate noise still.mcap --window 2:10",),
    "completion": ('eval "$(hiros completion bash)"',),
}
"""By command."""


class HelpfulCommand(TyperCommand):
    """A command whose help shows options by their ``rich_help_panel``, then examples."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write one section per group: the command's own options come before shared ones."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                name, text = record
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
