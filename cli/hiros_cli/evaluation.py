"""Scores as tables for a person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from hiros_cli.printable import printable
from hiros_cli.report import console, table
from hiros_mcap.evaluate import ErrorStats, Scores, Truth
from hiros_mcap.evaluate.leave_one_out import LeftOut, SelfScores
from hiros_mcap.evaluate.logs import ChannelResult
from hiros_mcap.evaluate.paper import Experiments
from hiros_mcap.evaluate.parts import PARTS
from hiros_mcap.evaluate.tables import (
    ANGLE_HEADER,
    POSITION_HEADER,
    TIME_HEADER,
    angle_rows,
    pair,
    position_rows,
    time_rows,
)
from hiros_mcap.text import number


def show_truth(
    log: Path, truth: Truth, results: Mapping[str, ChannelResult], *, joints: bool
) -> None:
    """Print the scores of every channel, and the angles of the last one."""
    out = console()
    seconds = (truth.stamps[-1] - truth.stamps[0]) / 1e9
    _title(out, f"{log}: against the truth, {len(truth.people)} people, {number(seconds, 1)} s", "")
    scores = {topic: result.scores for topic, result in results.items()}
    for heading, part in (
        ("Joint error, mm", _errors(scores)),
        ("Motion", _motion(scores)),
        ("People", _people(scores)),
    ):
        _title(out, heading)
        out.print(part)
    last, result = list(results.items())[-1]
    _title(out, f"Flexion angles of {last}, degrees: error")
    out.print(_angles(result.scores))
    if joints:
        _title(out, f"Joints of {last}, mm")
        out.print(_joints(result.scores.joints))
    absent = [name for name in result.model.marker_names if name not in result.scores.joints]
    if absent:
        _note(out, f"no truth for {len(absent)} markers: {', '.join(absent)}")
    for topic, result in results.items():
        for reason, count in result.skipped.items():
            _note(out, f"{topic}: {count} messages skipped: {reason}")


def _title(out: Console, text: str, gap: str = "\n") -> None:
    out.print(Text(gap + printable(text, 500), style="bold"), soft_wrap=True)


def _note(out: Console, text: str) -> None:
    out.print(Text(f"note: {printable(text, 500)}", style="yellow"), soft_wrap=True)


def _errors(scores: Mapping[str, Scores]) -> Table:
    parts = [p for p in PARTS if any(p in s.parts for s in scores.values())]
    return table(
        "Channel",
        ">Mean",
        ">SD",
        ">RMSE",
        ">95 %",
        *(f">{part.capitalize()}" for part in parts),
        ">PCK 50",
        ">PCK 100",
        ">First 5",
        rows=[
            (
                topic,
                number(s.mean, 1),
                number(s.deviation, 1),
                number(s.rmse, 1),
                number(s.percentile_95, 1),
                *(number(s.parts[part].mean, 1) for part in parts),
                number(100 * s.pck_at(50), 1, " %"),
                number(100 * s.pck_at(100), 1, " %"),
                number(s.first_frames, 1),
            )
            for topic, s in scores.items()
        ],
    )


def _motion(scores: Mapping[str, Scores]) -> Table:
    return table(
        "Channel",
        ">Angles, deg",
        ">By links, deg",
        ">Turn, deg",
        ">Limbs, mm",
        ">Limb CV",
        ">Jitter, mm",
        ">Lag, ms",
        rows=[
            (
                topic,
                pair(s.angle_rmse, s.angle_deviation),
                pair(s.link_angle_rmse, s.link_angle_deviation),
                number(s.turn_error, 2),
                number(s.limb_error, 1),
                number(s.limb_variation, 4),
                number(s.jitter, 1),
                number(s.lag, 1),
            )
            for topic, s in scores.items()
        ],
    )


def _people(scores: Mapping[str, Scores]) -> Table:
    return table(
        "Channel",
        ">Frames",
        ">Missing",
        ">False",
        ">Switches",
        ">MOTA",
        ">IDF1",
        ">HOTA",
        rows=[
            (
                topic,
                str(s.frames),
                str(s.missing),
                str(s.false),
                str(s.switches),
                number(s.tracking.mota, 4),
                number(s.tracking.idf1, 4),
                number(s.tracking.hota, 4),
            )
            for topic, s in scores.items()
        ],
    )


def _angles(scores: Scores) -> Table:
    return table(
        "Joint",
        ">RMSE",
        ">SD",
        ">Bias",
        ">By links: RMSE",
        ">SD",
        ">Bias",
        rows=[
            (
                name,
                number(own.rmse, 2),
                number(own.deviation, 2),
                number(own.bias, 2),
                number(scores.link_angles[name].rmse, 2),
                number(scores.link_angles[name].deviation, 2),
                number(scores.link_angles[name].bias, 2),
            )
            for name, own in scores.angles.items()
        ],
    )


def _joints(joints: Mapping[str, ErrorStats]) -> Table:
    return table(
        "Joint",
        ">Mean",
        ">SD",
        ">RMSE",
        ">95 %",
        rows=[
            (
                name,
                number(j.mean, 1),
                number(j.deviation, 1),
                number(j.rmse, 1),
                number(j.percentile_95, 1),
            )
            for name, j in joints.items()
        ],
    )


def show_self(log: Path, scores: SelfScores, *, joints: bool) -> None:
    """Print what a log says about itself."""
    out = console()
    _title(out, f"{log}: no truth; each camera against what all others give", "")
    _title(out, "Distance of the camera left out, mm")
    out.print(_cameras(scores.cameras))
    _title(out, "Disagreement between cameras at one time, median mm")
    rows = [(a, b, number(mm, 1)) for (a, b), mm in scores.disagreement.items()]
    out.print(table("Camera", "Camera", ">Median", rows=rows))
    own = scores.consistency
    _title(out, "Result of all cameras")
    people = ", ".join(f"{p.id} ({number(p.seconds, 1)} s)" for p in own.people) or "nobody"
    for line in (
        f"people: {people}",
        f"limb lengths: CV {number(own.limb_variation, 4)}",
        f"jitter: {number(own.jitter, 1, ' mm')}",
    ):
        out.print(Text(printable(line, 500)), soft_wrap=True)
    if joints:
        for camera in scores.cameras:
            _title(out, f"Joints of {camera.topic}, mm")
            out.print(_joints(camera.joints))


def _cameras(cameras: Sequence[LeftOut]) -> Table:
    parts = [p for p in PARTS if any(p in c.parts for c in cameras)]
    return table(
        "Left out",
        ">Median",
        ">Mean",
        ">SD",
        ">95 %",
        *(f">{part.capitalize()}" for part in parts),
        ">Offset",
        ">Detections",
        ">Of nobody",
        ">Mirrored",
        rows=[
            (
                c.topic,
                number(c.median, 1),
                number(c.error.mean, 1),
                number(c.error.deviation, 1),
                number(c.error.percentile_95, 1),
                *(number(c.parts[part].mean, 1) for part in parts),
                number(c.offset, 1),
                str(c.detections),
                str(c.unmatched),
                str(c.mirrored),
            )
            for c in cameras
        ],
    )


def show_paper(results: Experiments) -> None:
    """Print Tables 6, 7 and 8 of the Hi-ROS paper with ours beside, and what it claims."""
    out = console()
    _title(out, f"Simulated logs of {number(results.seconds, 0)} s, beside the paper's numbers", "")
    _note(out, "the paper's come from other data: real people, Azure Kinects, inertial suits")
    for title, several in (("Table 6: one person", False), ("Table 7: several people", True)):
        rows = angle_rows([s for s in results.sequences if (s.people > 1) == several])
        _title(out, f"{title}. Flexion angles by links, RMSE (SD), degrees")
        out.print(_table(ANGLE_HEADER, rows))
    _title(out, "The same sequences by joint positions")
    out.print(_table(POSITION_HEADER, position_rows(results.sequences)))
    _title(out, "Table 8: time per merged frame, ms, mean (SD) [paper]; 5 and 10 people by a line")
    out.print(_table(TIME_HEADER, time_rows(results.sequences)))
    _title(out, "What the paper claims")
    for claim in results.claims:
        verdict = "holds" if claim.holds else "DOES NOT HOLD"
        out.print(Text(f"{verdict}: {claim.text}: {printable(claim.detail, 500)}"), soft_wrap=True)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Table whose columns of numbers, all but the actions, are aligned to the right."""
    return table(*(h if h == "Action" else f">{h}" for h in header), rows=rows)
