"""The summary of a run, for a person."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from hiros_cli.printable import printable
from hiros_mcap.summary import (
    CameraSummary,
    LimbSummary,
    PersonSummary,
    Summary,
    number,
)

PIPE_WIDTH = 1000
_SPACE = 2
"""Between columns."""


def console() -> Console:
    """Return a console on stdout: as wide as the terminal, wide enough for every row in a pipe."""
    return Console(width=None if sys.stdout.isatty() else PIPE_WIDTH, highlight=False)


def show(summary: Summary) -> None:
    """Print cameras, people, times and what was written."""
    out = console()
    out.print(Text(_headline(summary), style="bold"), soft_wrap=True)
    parts = (_cameras(summary.cameras), _poses(summary), _people(summary.people))
    for part in (*filter(None, parts), _times(summary)):
        out.print()
        out.print(part)
    out.print()
    for channel, messages in summary.written.items():
        say(out, f"wrote {messages} messages to {channel}")
    for text in summary.notes:
        note(out, text)


def say(out: Console, text: object, style: str = "", before: str = "") -> None:
    """Print a line that may hold anything from outside, behind ``before``."""
    out.print(Text(before + printable(text, 500), style=style), soft_wrap=True)


def note(out: Console, text: str) -> None:
    """Print a note."""
    say(out, text, "yellow", "note: ")


def show_table(
    out: Console, title: str, content: tuple[Sequence[str], Sequence[Sequence[str]]]
) -> None:
    """Print a title and a table, header and rows: the first column is text, the others numbers.

    Columns for which the terminal is too narrow follow below, beside the first column again.
    """
    header, rows = content
    say(out, title, "bold", "\n")
    for chosen in _fitting([header, *rows], out.width):
        shown = [[row[column] for column in chosen] for row in rows]
        names = [header[column] for column in chosen[1:]]
        out.print(table(header[0], *(f">{name}" for name in names), rows=shown))


def _fitting(rows: Sequence[Sequence[str]], width: int) -> list[list[int]]:
    """Return the columns of each part of a table whose parts are at most ``width`` wide."""
    first, *others = (max(map(len, column)) for column in zip(*rows, strict=True))
    parts, used = [[0]], first
    for column, size in enumerate(others, start=1):
        if len(parts[-1]) > 1 and used + _SPACE + size > width:
            parts, used = [*parts, [0]], first
        parts[-1].append(column)
        used += _SPACE + size
    return parts


def table(*columns: str, rows: Iterable[Sequence[str]]) -> Table:
    """Plain table; a column whose header starts with ">" is aligned to the right."""
    result = Table(box=None, pad_edge=False, padding=(0, _SPACE, 0, 0), header_style="bold")
    for column in columns:
        side = "right" if column.startswith(">") else "left"
        result.add_column(column.lstrip(">"), justify=side, overflow="fold")  # type: ignore[arg-type]
    for row in rows:
        result.add_row(*(Text(printable(cell)) for cell in row))
    return result


def _headline(summary: Summary) -> str:
    target = "" if summary.target is None else f" -> {printable(summary.target, 500)}"
    speed = number(summary.times_real_time, 1)
    system = f" with {summary.system}" if summary.system else ""
    return (
        f"{printable(summary.source, 500)}{target}\n"
        f"{number(summary.log_s, 1)} s of log in {number(summary.wall_s, 2)} s{system}: "
        f"{speed} times real time"
    )


def _cameras(cameras: Sequence[CameraSummary]) -> Table:
    return table(
        "Camera",
        ">Rate",
        ">Messages",
        ">Used",
        ">Flips",
        ">Outliers",
        "Skipped",
        rows=[
            (
                camera.topic,
                number(camera.rate_hz, 1, " Hz"),
                str(camera.messages),
                str(camera.used),
                str(camera.flips),
                str(camera.outliers),
                ", ".join(f"{n} {reason}" for reason, n in camera.skipped.items()) or "-",
            )
            for camera in cameras
        ],
    )


def _poses(summary: Summary) -> Table | None:
    """Return what the people say about the poses of two or more cameras, and what they cannot."""
    if len(summary.poses) < 2:
        return None
    columns = (">Moved mm", ">deg", ">Clock ms", ">SE mm", ">deg", ">ms", "Verdict")
    rows = []
    for pose in summary.poses:
        numbers = [number(pose.moved_mm, 0), number(pose.moved_deg, 2), number(pose.clock_ms, 0)]
        errors = [number(pose.error_mm, 0), number(pose.error_deg, 2), number(pose.error_ms, 1)]
        verdict = f"{pose.verdict}: {pose.reason}" if pose.reason else pose.verdict
        rows.append((pose.name + period(pose.since_s, pose.until_s), *numbers, *errors, verdict))
    rig = summary.placement
    if rig is not None:
        errors = [number(rig.error_mm, 0), number(rig.error_deg, 2), "-"]
        rows.append(("whole rig", "-", "-", "-", *errors, "its placement: people cannot show it"))
    return table("Camera pose", *columns, rows=rows)


def period(since_s: float, until_s: float) -> str:
    """Return in words from when or until when a camera stood at a pose; "" if it never moved."""
    if not math.isnan(until_s):
        return f" to {until_s:.1f} s"
    return "" if math.isnan(since_s) else f" from {since_s:.1f} s"


def _people(people: Sequence[PersonSummary]) -> Table | Text:
    if not people:
        return Text("Nobody was seen.")
    return table(
        ">Person",
        ">Seconds",
        ">Frames",
        ">Predicted",
        ">Cameras",
        "Limb lengths",
        rows=[
            (
                str(person.id),
                number(person.seconds, 1),
                str(person.frames),
                str(person.predicted),
                str(len(person.cameras)),
                _limbs(person.limbs),
            )
            for person in people
        ],
    )


def _limbs(limbs: LimbSummary | None) -> str:
    if limbs is None:
        return "-"
    if not limbs.accepted:
        return f"not calibrated, skeletons unchanged: {limbs.reason}"
    if not limbs.worst_link:
        return f"{limbs.frames} frames"
    return (
        f"{limbs.frames} frames; raw lengths varied by {_percent(limbs.median_cv)} "
        f"(worst: {limbs.worst_link}, {_percent(limbs.worst_cv)})"
    )


def _percent(ratio: float) -> str:
    return number(100 * ratio, 0, " %")


def _times(summary: Summary) -> Table:
    """Return the steps in the order in which a frame passes them."""
    rows = [(step.name, number(step.cpu_s, 3, " s")) for step in summary.stages]
    return table("Step", ">CPU time", rows=rows)
