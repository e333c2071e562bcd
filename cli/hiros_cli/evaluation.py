"""Scores as tables for a person."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from hiros_cli.run_report import console, note, page, say, show_table, table
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
    of_joints = (
        (signed, score_tables.signed_angle_table(result.scores)),
        (f"Joints of {last}, mm", score_tables.joint_table(result.scores.joints)),
    )
    page(
        f"{log}: against the truth, {people}, {seconds} s",
        ("Joint error, mm", score_tables.error_table(scores)),
        ("Motion", score_tables.motion_table(scores)),
        ("People", score_tables.people_table(scores)),
        (
            f"{score_tables.BENDING} of {last}, degrees: error",
            score_tables.angle_table(result.scores),
        ),
        *(of_joints if joints else ()),
        notes=notes,
    )


def show_self(log: Path, scores: SelfScores, *, joints: bool) -> None:
    """Print what a log says about itself."""
    out = console()
    say(out, f"{log}: each camera against the result of the others, without a truth", "bold")
    title = "Distance of each left-out camera, mm"
    show_table(out, title, score_tables.left_out_table(scores.cameras))
    for text in score_tables.notes_without_truth(scores):
        note(out, text)
    pairs = [(a, b, number(mm, 1)) for (a, b), mm in scores.disagreement.items()]
    say(out, "Disagreement between cameras at one time, median mm", "bold", "\n")
    out.print(table("Camera", "Camera", ">Median", rows=pairs))
    own = scores.consistency
    say(out, "Result of all cameras", "bold", "\n")
    people = ", ".join(f"{p.id} ({number(p.seconds, 1)} s)" for p in own.people) or "nobody"
    for line in (
        f"people: {people}",
        f"limb lengths: CV {number(own.limb_variation, 4)}",
        f"jitter: {number(own.jitter, 1, ' mm')}",
    ):
        say(out, line)
    show_table(out, "Left and right of this result", score_tables.side_table(scores.sides))
    for camera in scores.cameras if joints else ():
        show_table(out, f"Joints of {camera.topic}, mm", score_tables.joint_table(camera.joints))
