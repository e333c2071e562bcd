"""Scores as tables for a person."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from hiros_cli.run_report import page
from hiros_mcap.evaluate import Truth, score_tables
from hiros_mcap.evaluate.leave_one_out import SelfScores
from hiros_mcap.evaluate.logs import ChannelResult
from hiros_mcap.summary import number


def show_truth(
    log: Path,
    truth: Truth,
    results: Mapping[str, ChannelResult],
    notes: Iterable[str],
    *,
    joints: bool,
) -> None:
    """Print the scores of every channel, and the angles of the last one."""
    seconds = number((truth.stamps[-1] - truth.stamps[0]) / 1e9, 1)
    n = len(truth.people)
    people = f"{n} of the people" if truth.partial else "1 person" if n == 1 else f"{n} people"
    scores = {topic: result.scores for topic, result in results.items()}
    last, result = list(results.items())[-1]
    signed = f"Signed joint angles of {last}, degrees: error"
    bending = f"{score_tables.BENDING} of {last}, degrees: error"
    tables = {
        **score_tables.truth_tables(scores),
        bending: score_tables.angle_table(result.scores),
    }
    if joints:
        tables[signed] = score_tables.signed_angle_table(result.scores)
        tables[f"Joints of {last}, mm"] = score_tables.joint_table(result.scores.joints)
    page(
        f"{log}: against the truth, {people}, {seconds} s",
        *tables.items(),
        notes=notes,
    )


def show_self(log: Path, scores: SelfScores, *, joints: bool) -> None:
    """Print what a log says about itself."""
    result, pairs = scores.consistency, scores.disagreement.items()
    people = ", ".join(f"{p.id} ({number(p.seconds, 1)} s)" for p in result.people) or "nobody"
    differences = [(f"{a}, {b}", number(mm, 1)) for (a, b), mm in pairs]
    tables = {f"Joints of {c.topic}, mm": c.joints for c in scores.cameras if joints}
    page(
        f"{log}: each camera against the result of the others, without a truth",
        ("Distance of each left-out camera, mm", score_tables.left_out_table(scores.cameras)),
        (
            "Disagreement between cameras at one time, median mm",
            (("Cameras", "Median"), differences),
        ),
        [
            "Result of all cameras:",
            f"people: {people}",
            *score_tables.lines_of(result),
        ],
        ("Left and right of this result", score_tables.side_table(scores.sides)),
        *((title, score_tables.joint_table(each)) for title, each in tables.items()),
        notes=score_tables.notes_without_truth(scores),
    )
