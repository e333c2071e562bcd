"""The measures: what each number is called, its unit, where it stands.

``hiros eval``, ``compare``, ``check``, many logs, ``--json``, pages and docs read this table.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.statistics import PARTS
from hiros_mcap.outputs import write_text
from hiros_mcap.wording import number

Rows = list[tuple[str, ...]]
Table = tuple[tuple[str, ...], Rows]
"""Header and rows; the first column is text, the others are numbers."""


@dataclass(frozen=True, slots=True)
class Measure:
    """A number that says how good something is."""

    name: str  # in golden files, thresholds and tables of many logs
    title: str  # of its column
    unit: str
    text: str  # definition, for a legend
    digits: int = 1
    is_signed: bool = False  # whether its size is what counts
    at: str = ""
    """Path in the scores, and in JSON below them, of attributes or keys; "" is the name."""
    sd: str = ""  # path of its standard deviation, if the column shows that beside it
    interval: tuple[str, str] = ("", "")
    """Paths of the ends of its 95 % interval, which files of tables have."""
    scale: float = 1.0  # number in the scores -> number in the unit
    is_optional: bool = False  # whether there is no column if no row has it

    @property
    def field(self) -> str:
        """Path in the scores."""
        return self.at or self.name

    def of(self, scores: object) -> float:
        """Return the number; NaN if the scores lack it."""
        return self.scale * _at(scores, self.field)

    def figures(self, scores: object) -> dict[str, float]:
        """Return the number, its standard deviation and the ends of its interval, by their names.

        The name of the number itself is empty.
        """
        paths = {"": self.field, "SD": self.sd}
        paths |= dict(zip(("95 % low", "95 % high"), self.interval, strict=True))
        return {name: self.scale * _at(scores, path) for name, path in paths.items() if path}

    def compared(self, scores: object) -> float:
        """Return the number that a check compares: less or more of it is better."""
        return abs(self.of(scores)) if self.is_signed else self.of(scores)

    def cell(self, scores: object) -> str:
        """Return the number as text."""
        text = number(self.of(scores), self.digits)
        sd = text != "-" and self.sd and number(self.scale * _at(scores, self.sd), self.digits)
        return f"{text} ({sd})" if sd else text

    def shown(self, value: float) -> str:
        """Return a value of the measure with its unit."""
        return f"{value:.4g} {self.unit}".rstrip()

    def header(self, stated: str = "") -> str:
        """Return the title of its column, with the unit unless that is ``stated`` for all."""
        return self.title if self.unit in ("", stated) else f"{self.title}, {self.unit}"


def _at(record: object, path: str) -> float:
    """Return the number at a path of attributes and keys; NaN if there is none."""
    value: object = record
    for part in path.split("."):
        value = value.get(part) if isinstance(value, Mapping) else getattr(value, part, None)
    return float(value) if isinstance(value, int | float) else math.nan


def _of_parts() -> tuple[Measure, ...]:
    """Return the mean distance by part of the body."""
    joints = "neither of the limbs", "elbows and beyond", "knees and beyond"
    text = "mean distance of the joints of this part"
    return tuple(
        Measure(
            *(part.replace(" ", "_"), part.capitalize(), "mm", f"{text}: {which}"),
            at=f"parts.{part}.mean",
            is_optional=True,
        )
        for part, which in zip(PARTS, joints, strict=True)
    )


# fmt: off
CONSISTENCY = (
    Measure("people", "People", "", "ids in the result", 0, at="n_people"),
    Measure("frames", "Frames", "", "frames of the result; against a truth, those that it covers",
            0),
    Measure("limb_cv", "Limb CV", "",
            "coefficient of variation of a link's length, mean over people and links",
            4, at="limb_variation"),
    Measure("jitter", "Jitter", "mm",
            "mean norm of the second difference of a joint's positions between frames"),
)
"""Measures that need no truth."""
_PEOPLE, _FRAMES, _LIMB_CV, _JITTER = CONSISTENCY

ERRORS = (
    Measure("mpjpe", "Mean", "mm",
            "distance of a joint from the true one, mean over joints, people and frames",
            at="mean", interval=("mean_low", "mean_high")),
    Measure("mpjpe_sd", "SD", "mm", "its standard deviation", at="deviation"),
    Measure("mpjpe_rms", "RMSE", "mm", "its root mean square", at="rmse"),
    Measure("mpjpe_95", "95 %", "mm", "95 % of the distances are less", at="percentile_95"),
    Measure("mpjpe_99", "99 %", "mm", "99 % of the distances are less", at="percentile_99"),
    *_of_parts(),
    *(Measure(f"pck_{mm}", f"PCK {mm}", "%", "share of true joints that the result has within "
              f"{mm} mm; joints of missing people count as not there", 1, scale=100)
      for mm in (50, 100)),
    Measure("first_frames", "First 5", "mm",
            "mean distance in the first five frames of an id that appears after the log's start"),
)
MOTION = (
    Measure("angle_rmse", "Bending", "deg", "RMSE (SD) of eight unsigned bending angles: "
            "shoulders, elbows, hips, knees, from marker positions (Hi-ROS eq. 20)",
            2, sd="angle_deviation"),
    Measure("link_angle_rmse", "By links", "deg",
            "the same angles from link orientations (Hi-ROS eq. 21)", 2, sd="link_angle_deviation"),
    Measure("orientation_error", "Orientation", "deg",
            "mean angle between a link's orientation and the true one", 2),
    Measure("limb_error", "Limbs", "mm",
            "mean difference of a link's length from the true one"),
    _LIMB_CV,
    _JITTER,
    Measure("lag", "Lag", "ms", "delay of the result: the shift of the truth with the least "
            "squared error, at most 180 ms either way", is_signed=True),
    Measure("mean_at_lag", "Mean at lag", "mm", "mean distance if all stamps are moved by the lag. "
            "Where clocks are wrong, no stamp shows the time base that they have in common: read "
            "this one beside the mean"),
)
PEOPLE = (
    _FRAMES,
    Measure("silent", "Silent", "", "instants of the truth without a frame of the result", 0),
    Measure("missing", "Missing", "",
            "true people without a skeleton; sum over frames and silent instants", 0),
    Measure("false", "False", "", "skeletons of nobody, or of somebody twice; sum over frames; "
            "blank if the truth is partial", 0),
    Measure("id_switches", "Switches", "",
            "how often the nearest skeleton of a true person changed its id", 0, at="switches"),
    *(Measure(name, name.upper(), "", "as TrackEval computes it, with the similarity 1 - distance "
              "/ `--match-distance`", 3, at=f"tracking.{name}")
      for name in ("mota", "idf1", "hota")),
)
MEASURES: Mapping[str, Measure] = {m.name: m for m in (_PEOPLE, *ERRORS, *MOTION, *PEOPLE)}
"""By name: what golden files and thresholds may have."""
BRIEF = ("mpjpe", "jitter", "limb_cv", "id_switches", "idf1")
"""Those in tables that have little room."""

LEFT_OUT = (
    Measure("median", "Median", "mm",
            "distance of the left-out camera's joints from the result of the others, median",
            at="distance.median"),
    Measure("mean", "Mean", "mm", "its mean", at="distance.mean"),
    Measure("sd", "SD", "mm", "its standard deviation", at="distance.deviation"),
    Measure("rms", "RMSE", "mm", "its root mean square", at="distance.rmse"),
    Measure("p95", "95 %", "mm", "95 % of them are less", at="distance.percentile_95"),
    Measure("spread", "Spread", "mm", "its mean without what is constant: the median displacement "
            "of each joint of a person"),
    *_of_parts(),
    Measure("offset", "Offset", "mm", "norm of the mean displacement over all joints: mostly the "
            "error of the camera's pose"),
    Measure("detections", "Detections", "", "skeletons that the camera reports", 0),
    Measure("unmatched", "Of nobody", "", "those that match nobody", 0),
    Measure("mirrored", "Mirrored", "", "those that fit better with left and right swapped; they "
            "are in the distances, too", 0),
)
"""Of a camera that was left out (``hiros eval`` without a truth)."""

REPROJECTION = (
    Measure("median", "Median", "px", "distance of a keypoint from the result's joint in the "
            "image, median", at="result.distance.median"),
    Measure("p95", "95 %", "px", "95 % of them are less", at="result.distance.percentile_95"),
    *(Measure(f"left_out_{name}", f"Left out: {title}", "px", "the same against the result of the "
              "other cameras", at=f"left_out.distance.{path}", is_optional=True)
      for name, title, path in (("median", "median", "median"), ("p95", "95 %", "percentile_95"))),
    Measure("detections", "Detections", "", "people whom the detector found in the images", 0,
            at="result.detections"),
    Measure("unmatched", "Of nobody", "", "those who are nobody in the result", 0,
            at="result.unmatched"),
)
"""Of an RGB camera, in its image."""

DIFFERENCE = Measure("difference", "Difference from the first", "mm",
    "mean distance less that of the first system, on what both have", at="difference.mm",
    interval=("difference.low", "difference.high"), is_optional=True)
"""Of a system from the first one, which stands below the table on a terminal."""
_TIME = Measure("milliseconds", "ms/message", "", "CPU time of the stages per message", 3)
SELF = (
    Measure("mean", "Mean", "mm", "distance of a left-out camera from the result of the others, "
            "mean, on the same detections and joints for all systems, mirrored ones included",
            at="distance.mean"),
    Measure("median", "Median", "mm", "its median", at="distance.median"),
    Measure("p95", "95 %", "mm", "95 % of them are less", at="distance.percentile_95"),
    Measure("spread", "Spread", "mm",
            "its mean without the median displacement of each joint of a person"),
    Measure("misses", "Misses", "", "detections at which this system has nobody, but another one "
            "has. They are in nobody's distances: a system gains nothing by having nobody where it "
            "is hard", 0),
    Measure("detections", "Of", "", "detections at which some system has somebody", 0),
    Measure("coverage", "Coverage", "%", "share of the left-out cameras' skeletons near somebody "
            "whom the others see", scale=100),
    Measure("ids", "Ids", "", "number of different ids in the result", 0),
    _LIMB_CV,
    _JITTER,
    _TIME,
)
"""Of a system (``hiros compare``) without a truth."""
# fmt: on
_RANKING = (
    *("mpjpe", "mpjpe_sd", *(part.replace(" ", "_") for part in PARTS), "angle_rmse", "limb_cv"),
    *("jitter", "lag", "missing", "false", "id_switches", "hota"),
)


def _of_outcome(measure: Measure) -> Measure:
    low, high = (path and f"scores.{path}" for path in measure.interval)
    return replace(measure, at=f"scores.{measure.field}", sd="", interval=(low, high))


RANKED = (*(_of_outcome(MEASURES[name]) for name in _RANKING), _TIME)
"""Of a system with a truth."""


class Sheet(NamedTuple):
    """A table before its numbers become text."""

    title: str
    first: str  # title of the column of names
    rows: Sequence[tuple[str, object]]
    """Names and the scores from which the measures take their numbers."""
    measures: Sequence[Measure]
    unit: str = ""  # of all measures that have one of this kind, which the title states
    log: str = ""  # which log it is of, if there are sheets of several

    @property
    def columns(self) -> list[Measure]:
        """The measures without optional ones that no row has."""
        absent = (m for m in self.measures if m.is_optional)
        left_out = {m.name for m in absent if all(math.isnan(m.of(row)) for _, row in self.rows)}
        return [m for m in self.measures if m.name not in left_out]


def table_of(
    first: str, rows: Iterable[tuple[str, object]], measures: Sequence[Measure], unit: str = ""
) -> Table:
    """Return a row per name and scores: the measures of these.

    ``first`` is the title of the column of names; the title of the table states the ``unit``.
    """
    return text_of(Sheet("", first, list(rows), measures, unit))


def text_of(sheet: Sheet) -> Table:
    """Return a sheet as text."""
    columns = sheet.columns
    header = (sheet.first, *(m.header(sheet.unit) for m in columns))
    return header, [(name, *(m.cell(scores) for m in columns)) for name, scores in sheet.rows]


def write_table(path: Path, sheets: Sequence[Sheet]) -> None:
    """Write sheets as CSV, one table for programs; whole or not at all.

    It has a row per name, a column per number with its unit, and columns of their own for a
    standard deviation and the ends of a 95 % interval.

    Raises ConfigError for another suffix, and LogError if the file cannot be written.
    """
    check_table(path)
    several = any(sheet.log for sheet in sheets)
    rows: dict[tuple[str, str], dict[str, float]] = {}
    for sheet in sheets:
        for name, scores in sheet.rows:
            row = rows.setdefault((sheet.log, name), {})
            for measure in sheet.columns:
                unit = f" ({measure.unit})" if measure.unit else ""
                for part, value in measure.figures(scores).items():
                    row[f"{' '.join(filter(None, (measure.title, part)))}{unit}"] = value
    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*(["Log"] if several else []), sheets[0].first, *columns])
    for (log, name), row in rows.items():
        values = (row.get(column, math.nan) for column in columns)
        cells = ("" if math.isnan(value) else f"{value:.6g}" for value in values)
        writer.writerow([*([log] if several else []), name, *cells])
    write_text(path, text.getvalue())


def check_table(path: Path) -> None:
    """Raise ConfigError unless a table can have this name."""
    if path.suffix.lower() != ".csv":
        raise ConfigError(f"{path}: a table ends in .csv")


def markdown_text(text: str) -> str:
    """Return text in one line that shows as it is, also in a cell of a table."""
    return re.sub(r"([\\`*\[\]|])", r"\\\1", " ".join(text.split())).replace("<", "&lt;")
