"""Scores as a page, as JSON, or as tables for a person."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hiros_cli.output import print_json, warn
from hiros_cli.run_report import page
from hiros_mcap.evaluate import Scores, Truth, score_tables
from hiros_mcap.evaluate.leave_one_out import SelfScores
from hiros_mcap.evaluate.logs import ChannelResult
from hiros_mcap.evaluate.measures import text_of, write_table
from hiros_mcap.evaluate.remarks import notes_of
from hiros_mcap.evaluate.truth import Alignment
from hiros_mcap.wording import number, plain


@dataclass(frozen=True, slots=True)
class Output:
    """Where the scores of a log go."""

    log: Path
    html: Path | None
    table: Path | None
    json: bool
    quiet: bool
    joints: bool  # whether a table of every joint is printed, too


def show_truth(
    output: Output, truth: Truth, results: Mapping[str, ChannelResult], warnings: Sequence[str]
) -> None:
    """Write the page and the table; print the scores of all channels, the angles of the last."""
    notes = notes_of(truth, results)
    if output.html is not None:
        from hiros_viewer.score_pages import truth_page

        truth_page(output.log, truth, results, [*warnings, *notes]).write(output.html)
    if output.table is not None:
        write_table(output.table, score_tables.truth_sheets(_scores_of(results)))
    if output.json:
        data = {
            "log": str(output.log),
            "true_people": list(truth.people),
            "truth_covers": "partial" if truth.partial else "all",
            "alignment": _alignment(truth.alignment),
            "channels": {topic: plain(result.scores) for topic, result in results.items()},
            "warnings": warnings,
            "notes": notes,
        }
        print_json("eval", data)
    elif not output.quiet:
        _print_truth(output, truth, results, notes)
    for text in warnings:
        warn(text)


def _scores_of(results: Mapping[str, ChannelResult]) -> dict[str, Scores]:
    return {topic: result.scores for topic, result in results.items()}


def _alignment(found: Alignment | None) -> dict[str, Any] | None:
    """Return what brought the truth to the result, for JSON."""
    if found is None:
        return None
    translation, xyzw = found.pose.translation.tolist(), found.pose.xyzw.tolist()
    return {"translation": translation, "quaternion_xyzw": xyzw, "seconds": found.seconds}


def _print_truth(
    output: Output, truth: Truth, results: Mapping[str, ChannelResult], notes: Iterable[str]
) -> None:
    seconds = number((truth.stamps[-1] - truth.stamps[0]) / 1e9, 1)
    n = len(truth.people)
    people = f"{n} of the people" if truth.partial else "1 person" if n == 1 else f"{n} people"
    scores = _scores_of(results)
    last, result = list(results.items())[-1]
    signed = f"Signed joint angles of {last}, degrees: error"
    bending = f"{score_tables.BENDING} of {last}, degrees: error"
    tables = {**score_tables.truth_tables(scores), bending: score_tables.angle_table(result.scores)}
    if output.joints:
        tables[signed] = score_tables.signed_angle_table(result.scores)
        tables[f"Joints of {last}, mm"] = score_tables.joint_table(result.scores.joints)
    page(f"{output.log}: against the truth, {people}, {seconds} s", *tables.items(), notes=notes)


def show_self(output: Output, scores: SelfScores) -> None:
    """Write the page and the table, and print what a log says about itself."""
    if output.html is not None:
        from hiros_viewer.score_pages import self_page

        self_page(output.log, scores).write(output.html)
    notes = score_tables.notes_without_truth(scores)
    if output.table is not None:
        write_table(output.table, score_tables.self_sheets(scores))
    if output.json:
        print_json("eval.self", {"log": str(output.log), **plain(scores), "notes": notes})
    elif not output.quiet:
        _print_self(output, scores, notes)


def _print_self(output: Output, scores: SelfScores, notes: Iterable[str]) -> None:
    result = scores.consistency
    people = ", ".join(f"{p.id} ({number(p.seconds, 1)} s)" for p in result.people) or "nobody"
    joints = {
        **{f"Joints of {c.topic}, mm": score_tables.joint_table(c.joints) for c in scores.cameras},
        **{f"Joints of {c.topic}, px": score_tables.pixel_table(c) for c in scores.images},
    }
    page(
        f"{output.log}: each camera against the result of the others, without a truth",
        *((sheet.title, text_of(sheet)) for sheet in score_tables.self_sheets(scores)),
        ["Result of all cameras:", f"people: {people}", *score_tables.lines_of(result)],
        *(joints.items() if output.joints else ()),
        notes=notes,
    )
