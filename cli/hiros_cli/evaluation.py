"""Scores as tables for a person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.text import Text

from hiros_cli.printable import printable
from hiros_cli.run_report import console, table
from hiros_mcap.evaluate import Truth, score_tables
from hiros_mcap.evaluate.leave_one_out import SelfScores
from hiros_mcap.evaluate.logs import ChannelResult
from hiros_mcap.evaluate.match import explain_no_match
from hiros_mcap.summary import number


def show_truth(
    log: Path, truth: Truth, results: Mapping[str, ChannelResult], *, joints: bool
) -> None:
    """Print the scores of every channel, and the angles of the last one."""
    out = console()
    seconds = number((truth.stamps[-1] - truth.stamps[0]) / 1e9, 1)
    _title(out, f"{log}: against the truth, {len(truth.people)} people, {seconds} s", "")
    scores = {topic: result.scores for topic, result in results.items()}
    _show(out, "Joint error, mm", score_tables.error_table(scores))
    _show(out, "Motion", score_tables.motion_table(scores))
    _show(out, "People", score_tables.people_table(scores))
    last, result = list(results.items())[-1]
    title = f"Flexion angles of {last}, degrees: error"
    _show(out, title, score_tables.angle_table(result.scores))
    if joints:
        _show(out, f"Joints of {last}, mm", score_tables.joint_table(result.scores.joints))
    absent = [name for name in result.model.marker_names if name not in result.scores.joints]
    if absent:
        _note(out, f"no truth for {len(absent)} markers: {', '.join(absent)}")
    if hint := explain_no_match(result.matches, truth):
        _note(out, hint)
    for topic, result in results.items():
        for reason, count in result.skipped.items():
            _note(out, f"{topic}: {count} messages skipped: {reason}")


def show_self(log: Path, scores: SelfScores, *, joints: bool) -> None:
    """Print what a log says about itself."""
    out = console()
    _title(out, f"{log}: no truth; each camera against the result of the others", "")
    title = "Distance of each left-out camera, mm"
    _show(out, title, score_tables.left_out_table(scores.cameras))
    pairs = [(a, b, number(mm, 1)) for (a, b), mm in scores.disagreement.items()]
    _title(out, "Disagreement between cameras at one time, median mm")
    out.print(table("Camera", "Camera", ">Median", rows=pairs))
    own = scores.consistency
    _title(out, "Result of all cameras")
    people = ", ".join(f"{p.id} ({number(p.seconds, 1)} s)" for p in own.people) or "nobody"
    for line in (
        f"people: {people}",
        f"limb lengths: CV {number(own.limb_variation, 4)}",
        f"jitter: {number(own.jitter, 1, ' mm')}",
    ):
        out.print(Text(printable(line, 500)), soft_wrap=True)
    for camera in scores.cameras if joints else ():
        _show(out, f"Joints of {camera.topic}, mm", score_tables.joint_table(camera.joints))


def _title(out: Console, text: str, gap: str = "\n") -> None:
    out.print(Text(gap + printable(text, 500), style="bold"), soft_wrap=True)


def _note(out: Console, text: str) -> None:
    out.print(Text(f"note: {printable(text, 500)}", style="yellow"), soft_wrap=True)


def _show(out: Console, title: str, content: tuple[Sequence[str], Sequence[Sequence[str]]]) -> None:
    """Print a table: the first column is text, the others are numbers."""
    header, rows = content
    _title(out, title)
    out.print(table(header[0], *(f">{name}" for name in header[1:]), rows=rows))
