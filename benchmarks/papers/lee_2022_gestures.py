"""Tables A1 to A4 of Lee et al. (2022): six gestures in four directions, sixteen joints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from paper_report import Claim, Rows, Table
from published import LEE_COLUMNS, LEE_GESTURES, Pair, lee_appendix

from hiros_mcap.evaluate.comparison import Entry, Outcome, Task, comparison
from hiros_mcap.evaluate.statistics import PARTS, part_of
from hiros_mcap.wording import number

DIRECTIONS = (0, 90, 180, 270)
"""Of facing, deg; four cameras stand in the corners (Fig. 8)."""
SHOWN = ("A1", "A3_10", "A4_10", "A5_10")
LEAST_GAIN = 15.0
"""mm, from A1 to A5 in the upper limbs of every gesture (section 4)."""

Errors = Mapping[tuple[str, str], Mapping[str, Pair]]
"""(gesture, joint) -> column -> mean error and SD, mm."""


def gesture_scenes() -> Iterator[dict[str, object]]:
    """Parameters of the 24 simulations: each gesture in every direction, synchronised cameras."""
    rig = {"synchronised": True}
    for gesture in LEE_GESTURES:
        for facing in DIRECTIONS:
            scene: dict[str, object] = {"people": 1, "cameras": 4, "seed": 3, "rig": rig}
            yield {**scene, "action": gesture, "facing": facing}


def entry_of(column: str) -> Entry:
    """Return the system of a column: "A4_5" is lee-a4 with a radius of 5 cm, and A5 is lee."""
    variant, _, cm = column.partition("_")
    radius = f",cluster.radius={int(cm) / 100:g}" if cm else ""
    name = "lee" if variant == "A5" else f"lee-{variant.lower()}"
    return Entry.parse(f"{name}{radius}")


def gesture_errors(logs: Mapping[Path, str], jobs: int) -> Errors:
    """Run every column's system on the logs, and average over those of a gesture.

    ``logs`` gives the gesture of each log.
    """
    tasks = [Task(log, entry_of(column)) for log in logs for column in LEE_COLUMNS]
    outcomes = iter(comparison(tasks, jobs=jobs))
    found: dict[tuple[str, str], dict[str, list[Pair]]] = {}
    for gesture in logs.values():
        for column in LEE_COLUMNS:
            for joint, pair in _joints(next(outcomes)).items():
                found.setdefault((gesture, joint), {}).setdefault(column, []).append(pair)
    return {
        key: {column: _mean(pairs) for column, pairs in columns.items()}
        for key, columns in found.items()
    }


def _joints(outcome: Outcome) -> dict[str, Pair]:
    """Errors of the sixteen joints that the paper has."""
    wanted = {joint for _, joint in lee_appendix()}
    joints = {} if outcome.scores is None else outcome.scores.joints
    return {name: (s.mean, s.deviation) for name, s in joints.items() if name in wanted}


def _mean(pairs: Sequence[Pair]) -> Pair:
    error, deviation = np.mean(pairs, axis=0).tolist()
    return error, deviation


def part_errors(errors: Errors, column: str) -> dict[tuple[str, str], Pair]:
    """(gesture, part of the body) -> mean error and SD, mm."""
    groups: dict[tuple[str, str], list[Pair]] = {}
    for (gesture, joint), row in errors.items():
        if column in row:
            groups.setdefault((gesture, part_of(joint)), []).append(row[column])
    return {key: _mean(pairs) for key, pairs in groups.items()}


def gesture_table(errors: Errors) -> Table:
    """By gesture, variant and part; the paper's in [ ]."""
    rows: Rows = []
    ours = {column: part_errors(errors, column) for column in SHOWN}
    paper = {column: part_errors(lee_appendix(), column) for column in SHOWN}
    for gesture in LEE_GESTURES:
        for column in SHOWN:
            cells = [
                f"{_cell(ours[column].get((gesture, part)))} "
                f"[{_cell(paper[column][gesture, part])}]"
                for part in PARTS
            ]
            rows.append((gesture, column, *cells))
    header = ("Gesture", "Variant", *(part.capitalize() for part in PARTS))
    return Table("By gesture, radius 10 cm: error (SD), mm [paper]", header, rows)


def _cell(pair: Pair | None) -> str:
    return "-" if pair is None else f"{number(pair[0], 1)} ({number(pair[1], 1)})"


def appendix_tables(errors: Errors) -> list[Table]:
    """Tables A1 and A2 (error) and A3 and A4 (SD): the paper's row below each of ours."""
    titles = ("Tables A1 and A2: error, mm", "Tables A3 and A4: SD of the error, mm")
    return [_appendix(title, errors, k) for k, title in enumerate(titles)]


def _appendix(title: str, errors: Errors, k: int) -> Table:
    rows: Rows = []
    for (gesture, joint), paper in lee_appendix().items():
        ours = errors.get((gesture, joint), {})
        cells = (number(ours[c][k], 2) if c in ours else "-" for c in LEE_COLUMNS)
        rows.append((gesture, joint, *cells))
        rows.append(("", "paper", *(number(paper[c][k], 2) for c in LEE_COLUMNS)))
    return Table(title, ("Gesture", "Joint", *LEE_COLUMNS), rows)


def check_gestures(errors: Errors) -> Iterator[Claim]:
    """Check what section 4 says of the gestures, from A1 to A5 at 10 cm."""
    before, after = part_errors(errors, "A1"), part_errors(errors, "A5_10")
    gains = {key: before[key][0] - after[key][0] for key in before if key in after}
    for part, best in (("upper limbs", "squat"), ("lower limbs", "lunge")):
        by_gesture = {gesture: gain for (gesture, own), gain in gains.items() if own == part}
        if len(by_gesture) < len(LEE_GESTURES):
            continue
        detail = ", ".join(f"{gesture} {gain:.1f} mm" for gesture, gain in by_gesture.items())
        if part == "upper limbs":
            least = min(by_gesture.values()) >= LEAST_GAIN
            yield Claim(f"{part}: A5 gains at least 15 mm in every gesture (4)", least, detail)
        most = max(by_gesture, key=lambda gesture: by_gesture[gesture])
        yield Claim(f"{part}: A5 gains most in {best} (4)", most == best, detail)
