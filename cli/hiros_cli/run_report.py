"""The printer of all reports: headline, tables, lines, notes.

And by it, the summary of a run, and what people, a ball or a board have shown of the cameras.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console
from rich.table import Table
from rich.text import Text

from hiros_cli.output import LINE_LIMIT, printable
from hiros_mcap.running.summary import (
    CameraSummary,
    DelaySummary,
    LimbSummary,
    PersonSummary,
    Summary,
)
from hiros_mcap.wording import number, quantity

if TYPE_CHECKING:
    from hiros_mcap.calibrate.people import PeopleCalibration
    from hiros_mcap.calibrate.verdict import CalibratedCamera, TargetCalibration, TargetCamera

Item = TypeVar("Item")
Content = tuple[Sequence[str], Sequence[Sequence[str]]]
"""Header and rows: the first column is text, the others are numbers."""

_SPACE = 2  # between columns


def console() -> Console:
    """Return a console on stdout: as wide as the terminal, wide enough for every row in a pipe."""
    width = None if sys.stdout.isatty() else 1000
    plain = bool(os.environ.get("NO_COLOR"))  # neither colours nor bold type
    return Console(width=width, highlight=False, color_system=None if plain else "auto")


def page(
    headline: str | Sequence[str],
    *parts: Table | Sequence[str | Text] | tuple[str, Content] | None,
    notes: Iterable[str] = (),
) -> None:
    """Print a report: tables, lines and tables with a title, an empty line before each; notes.

    It is the printer of all commands. Strings may hold anything from outside, a Text may not.
    """
    out = console()
    for line in [headline] if isinstance(headline, str) and headline else headline:
        say(out, line, "bold")
    for part in parts:
        if isinstance(part, tuple):
            show_table(out, *part)
        elif part is not None:
            if headline or part is not parts[0]:
                out.print()
            if isinstance(part, Table):
                out.print(part)
                continue
            for text in part:
                say(out, text)
    for text in notes:
        say(out, f"note: {text}", "yellow")


def say(out: Console, text: str | Text, style: str = "", before: str = "") -> None:
    """Print a line that may hold anything from outside, behind ``before``."""
    if not isinstance(text, Text):
        text = Text(before + printable(text, LINE_LIMIT), style=style)
    out.print(text, soft_wrap=True)


def show_table(out: Console, title: str, content: Content) -> None:
    """Print a title and a table.

    Columns for which the terminal is too narrow follow below, beside the first column again.
    """
    header, rows = content
    say(out, title, "bold", "\n")
    for chosen in _fitting([header, *rows], out.width):
        cells = [[row[column] for column in chosen] for row in rows]
        names = [header[column] for column in chosen[1:]]
        out.print(table(header[0], *(f">{name}" for name in names), rows=cells))


def _fitting(rows: Sequence[Sequence[str]], width: int) -> list[list[int]]:
    """Return the columns of each part of a table whose parts are at most ``width`` wide."""
    first, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    parts, used = [[0]], first
    for column, size in enumerate(widths, start=1):
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


def listing(items: Iterable[Item], *columns: tuple[str, Callable[[Item], object]]) -> Table:
    """Return a table with a row per item, by each column's title and what it shows of an item."""
    titles, cells = zip(*columns, strict=True)
    return table(*titles, rows=[[str(cell(item)) for cell in cells] for item in items])


def show(summary: Summary) -> None:
    """Print cameras, people, times and what was written."""
    page(
        _headline(summary),
        _cameras(summary.cameras),
        _poses(summary),
        _people(summary.people) or ["Nobody was seen."],
        listing(  # in the order in which a frame passes them
            summary.stages,
            ("Step", lambda step: step.name),
            (">CPU time", lambda step: number(step.cpu_s, 3, " s")),
        ),
        [f"wrote {n} messages to {channel}" for channel, n in summary.written.items()]
        + _delay(summary.delay),
        notes=summary.notes,
    )


def _headline(summary: Summary) -> tuple[str, str]:
    target = "" if summary.target is None else f" -> {summary.target}"
    speed = number(summary.times_real_time, 1)
    system = f" with {summary.system}" if summary.system else ""
    times = f"{number(summary.log_s, 1)} s of log in {number(summary.wall_s, 2)} s"
    if summary.waited_s:
        times += f", {number(summary.waited_s, 2)} s of them waiting for the input,"
    settings = f"; parameters of {summary.settings}" if summary.settings else ""
    return f"{summary.source}{target}", f"{times}{system}: {speed} times real time{settings}"


def _delay(delay: DelaySummary | None) -> list[str]:
    """Return how late results were; nothing if the run looked ahead."""
    if delay is None:
        return []
    times = f"{delay.median_s:.3f} s (median), {delay.most_s:.3f} s (95 %)"
    return [f"results were known {times} after their time"]


def _cameras(cameras: Sequence[CameraSummary]) -> Table:
    return listing(
        cameras,
        ("Camera", lambda c: c.topic),
        (">Rate", lambda c: number(c.rate_hz, 1, " Hz")),
        (">Messages", lambda c: c.messages),
        (">Used", lambda c: c.used),
        (">Flips", lambda c: c.flips),
        (">Outliers", lambda c: c.outliers),
        ("Skipped", lambda c: ", ".join(f"{n} {why}" for why, n in c.skipped.items()) or "-"),
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


def _people(people: Sequence[PersonSummary]) -> Table | None:
    if not people:
        return None
    return listing(
        people,
        (">Person", lambda p: p.id),
        (">Seconds", lambda p: number(p.seconds, 1)),
        (">Frames", lambda p: p.frames),
        (">Predicted", lambda p: p.predicted),
        (">Cameras", lambda p: len(p.cameras)),
        ("Limb lengths", lambda p: _limbs(p.limbs)),
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


GAUGES = {
    "transforms": "The rig as a whole stays where the log's transforms put it.",
    "floor": "z is up from the floor that people stand on; the origin is below the first camera.",
    "first camera": "The first camera gives the fixed frame: nobody stands upright on a floor.",
}
_BOARD = "marker 1 of the board; z is up."
_TARGET_GAUGES = {
    ("ball", "transforms"): GAUGES["transforms"],
    ("ball", "first camera"): "It is the frame of the first camera.",
    ("board", "board"): _BOARD,
    (
        "board",
        "transforms",
    ): f"{_BOARD} The cameras stay as the transforms have them to each other.",
}


def show_calibration(log: Path, people: PeopleCalibration, *, joints: bool) -> None:
    """Print a line per camera, what the fixed frame is, and notes."""
    gauge = people.gauge and [f'Fixed frame "{people.fixed_frame}": {GAUGES[people.gauge]}']
    rows = [(name, number(mm, 0)) for name, mm in people.joints.items()]
    title = "Distance of each joint to the other cameras' mean, median"
    page(
        f"{log}: poses and clocks from the people: {people.verdict}",
        _calibrated(people.cameras),
        gauge or None,
        (title, (("Joint", "mm"), rows)) if rows and joints else None,
        notes=_notes(people.cameras),
    )


def _notes(cameras: Sequence[CalibratedCamera]) -> Iterator[str]:
    for camera in cameras:
        if camera.reason:
            yield f"{camera.name}: {camera.reason}"
        elif math.isnan(camera.clock_s):
            yield f"{camera.name}: no motion tells its clock; the log's stamps are kept"


def _calibrated(cameras: Sequence[CalibratedCamera]) -> Table:
    has_given = any(not math.isnan(camera.moved_deg) for camera in cameras)
    moved: list[tuple[str, Callable[[CalibratedCamera], str]]] = [
        (">Moved mm", lambda c: number(c.moved_mm, 0)),
        (">deg", lambda c: number(c.moved_deg, 2)),
    ]
    return listing(
        cameras,
        ("Camera", lambda c: c.name),
        *(moved if has_given else ()),
        (">Clock ms", lambda c: number(1000 * c.clock_s, 1)),
        (">SE deg", lambda c: number(c.error_deg, 2)),
        (">mm", lambda c: number(c.error_mm, 0)),
        (">ms", lambda c: number(c.error_ms, 1)),
        (">Residual mm", lambda c: number(c.residual_mm, 0)),
        ("Verdict", lambda c: c.verdict),
    )


def show_target(log: Path, target: str, report: TargetCalibration) -> None:
    """Print a line per camera, what the fixed frame is, and notes; ``target`` is ball or board."""
    pairs: list[tuple[str, Callable[[TargetCamera], object]]] = [
        ("Against", lambda c: c.against or "-"),
        (">Common", lambda c: c.common if c.against else "-"),
        (">Used", lambda c: c.used if c.against else "-"),
    ]
    has_pairs, radius = any(camera.against for camera in report.cameras), report.radius
    page(
        f"{log}: poses from the {target}: {report.verdict}",
        listing(
            report.cameras,
            ("Camera", lambda c: c.name),
            (">Seen", lambda c: c.seen),
            *(pairs if has_pairs else ()),
            (">SE deg", lambda c: number(c.error_deg, 2)),
            (">mm", lambda c: number(c.error_mm, 1)),
            (">Residual mm", lambda c: number(c.residual_mm, 1)),
            ("Verdict", lambda c: c.verdict),
        ),
        [f'Fixed frame "{report.fixed_frame}": {_TARGET_GAUGES[target, report.gauge]}'],
        notes=[
            *([] if math.isnan(radius) else [f"the ball's radius as measured: {radius:.3f} m"]),
            *_skipped(report.skipped),
        ],
    )


def _skipped(skipped: Mapping[str, Mapping[str, int]]) -> list[str]:
    return [
        f"{name}: {quantity(count, 'depth image')} {reason}"
        for name, reasons in skipped.items()
        for reason, count in sorted(reasons.items())
        if count
    ]
