"""Plots of curves: joint angles, limb lengths and errors over time, and others.

``pictures.py`` draws a :class:`CurveGrid`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.anatomy import ANGLE_NAMES, anatomical_angles
from hiros_mcap.body.segments import SIDES
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.errors import ConfigError
from hiros_mcap.events import Event, hidden_times
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel
from hiros_mcap.wording import number

MARKED = {"hidden": "#f0b429", "predicted": "#d64545", "gap": "#9aa4af"}
"""Of the bands, which lie below the curves."""
_WORDS = {
    "hidden": "Yellow: hidden",
    "predicted": "Red: no camera sees the person, who is predicted",
    "gap": "Grey: not in the result",
}
PAUSE_S = 0.25
"""A longer time without frames is a gap."""


class Mark(NamedTuple):
    """A span of one person's curves."""

    kind: str  # a key of :data:`MARKED`
    start: float  # s since the channel's first frame
    end: float
    remark: str = ""


def hidden_marks(events: Sequence[Event], person: int, start: int) -> Iterator[Mark]:
    """Yield when somebody was hidden from a camera, and behind whom; ``start`` in ns."""
    for begin, end, behind, source in hidden_times(events, person, start):
        yield Mark("hidden", begin, end, f"{behind} for {source}")


def marks_of(seconds: Floats, is_predicted: Flags) -> Iterator[Mark]:
    """Yield spans without frames, and those whose frames (T,) nobody saw."""
    for k in np.flatnonzero(np.diff(seconds) > PAUSE_S).tolist():
        yield Mark("gap", float(seconds[k]), float(seconds[k + 1]))
    breaks = (np.diff(is_predicted.astype(int)) != 0) | (np.diff(seconds) > PAUSE_S)
    for run in np.split(np.arange(len(seconds)), np.flatnonzero(breaks) + 1):
        if len(run) and is_predicted[run[0]]:
            yield Mark("predicted", float(seconds[run[0]]), float(seconds[run[-1]]))


def in_words(marks: Sequence[Mark]) -> list[str]:
    """Return a line for each kind of mark: what its colour means, and when it is."""
    lines = []
    for kind, words in _WORDS.items():
        spans = [
            f"{number(mark.start, 1)} to {number(mark.end, 1)} s"
            + (f" ({mark.remark})" if mark.remark else "")
            for mark in marks
            if mark.kind == kind
        ]
        if spans:
            lines.append(f"{words}: {', '.join(spans)}.")
    return lines


TRUTH, RESULT, SPREAD = "#1f5fa8", "#e07b1a", "#6f7985"
LEFT, RIGHT = "#6f747d", "#3c56d8"
"""Of the limbs on each side, as in the viewer: pale and strong."""
OTHERS = ("#0072b2", "#e07b1a", "#000000", "#8c564b", "#66ccee", "#332288", "#a04000", "#cc79a7")
"""Of curves of channels and systems, in their order: colour-blind people tell them apart, too."""
_LIMB_RANGE_MM = 60.0
_LIMBS = {
    "upper arm": ("shoulder", "elbow"),
    "forearm": ("elbow", "wrist"),
    "thigh": ("hip", "knee"),
    "shin": ("knee", "ankle"),
}


class Curve(NamedTuple):
    """A curve with a name."""

    name: str
    colour: str
    x: Floats  # (T,)
    y: Floats  # (T,); NaN where the line is interrupted
    width: float = 1.2
    has_dots: bool = False  # whether its points are shown


@dataclass(frozen=True, slots=True)
class CurvePlot:
    """Curves in one pair of axes."""

    curves: Sequence[Curve]
    y_range: tuple[float, float]
    title: str = ""
    y_title: str = ""
    has_zero: bool = False  # whether a line marks 0


@dataclass(frozen=True, slots=True)
class CurveGrid:
    """Plots beside and below each other that share their x axis."""

    rows: Sequence[Sequence[CurvePlot]]
    height: float  # of all plots, inches
    x_range: tuple[float, float]
    x_title: str = "time, s"
    marks: Sequence[Mark] = ()  # spans of x that are shown as bands in all plots


def around(values: Floats, margin: float) -> tuple[float, float]:
    """Return the range of values, wider by a share of it at both ends; (0, 1) if there are none."""
    present = values[np.isfinite(values)]
    if not present.size:
        return 0.0, 1.0
    low, high = float(present.min()), float(present.max())
    beside = margin * (high - low) or 0.5
    return low - beside, high + beside


def from_zero(curves: Sequence[Curve]) -> tuple[float, float]:
    """Return a range of y that begins at 0."""
    return 0.0, around(np.concatenate([curve.y for curve in curves]), 0.05)[1]


def over_time(
    rows: Sequence[Sequence[CurvePlot]], height: float, seconds: Floats, marks: Sequence[Mark] = ()
) -> CurveGrid:
    """Return plots over all of some times (T,), s."""
    return CurveGrid(rows, height, around(seconds, 0.01), marks=marks)


def with_gaps(seconds: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Put a NaN into every pause, so that no line is drawn over it."""
    pauses = np.nonzero(np.diff(seconds) > PAUSE_S)[0] + 1
    return np.insert(seconds, pauses, np.nan), np.insert(values, pauses, np.nan, axis=0)


def limb_links(model: SkeletonModel) -> dict[str, int]:
    """Name -> link slot of upper arms, forearms, thighs and shins, as far as the model has them."""
    slots = {split_side(name): slot for slot, name in enumerate(model.marker_names)}
    ends = {p: k for k, p in enumerate(zip(model.link_parents, model.link_children, strict=True))}
    links = {}
    for side in ("left", "right"):
        for name, (upper, lower) in _LIMBS.items():
            link = ends.get((slots.get((upper, side), -2), slots.get((lower, side), -2)))
            if link is not None:
                links[f"{side} {name}"] = link
    return links


def limb_grid(
    seconds: Floats, lengths: Mapping[str, Floats], marks: Sequence[Mark] = ()
) -> CurveGrid:
    """Plot limb lengths, a plot per limb with left and right, of the same range each.

    Parameters
    ----------
    seconds : (T,). lengths : "left shin" -> (T,) mm.
    """
    plots = []
    for limb in dict.fromkeys(name.split(" ", 1)[1] for name in lengths):
        sides = {side: lengths[f"{side} {limb}"] for side in SIDES if f"{side} {limb}" in lengths}
        curves = [
            Curve(side, *((LEFT, RIGHT)[side == "right"], *with_gaps(seconds, values)),
                  width=1.8 if side == "right" else 1.2)
            for side, values in sides.items()
        ]  # fmt: skip
        y_range = _limb_range(np.concatenate(list(sides.values())))
        plots.append(CurvePlot(curves, y_range, f"{limb}, mm"))
    rows = [plots[k : k + 2] for k in range(0, len(plots), 2)]
    return over_time(rows, 1.7 * len(rows) + 0.5, seconds, marks)


def _limb_range(lengths: Floats) -> tuple[float, float]:
    """Return a range around the median: the usual one, or that of all but a few lengths."""
    if np.isnan(lengths).all():
        return 0.0, _LIMB_RANGE_MM
    middle = float(np.nanmedian(lengths))
    half = max(_LIMB_RANGE_MM, 1.2 * float(np.nanpercentile(np.abs(lengths - middle), 99)))
    return middle - half, middle + half


SHOWN_ANGLES = (
    *("hip flexion", "hip abduction", "knee flexion", "ankle dorsiflexion"),
    *("shoulder flexion", "shoulder abduction", "elbow flexion"),
)
"""Of each side, from top to bottom."""


def angle_grid(
    seconds: Floats, angles: Floats, true_angles: Floats | None, marks: Sequence[Mark] = ()
) -> CurveGrid:
    """Signed joint angles, left beside right, truth and result, as in Fig. 5 of the Hi-ROS paper.

    Parameters
    ----------
    seconds : (T,). angles, true_angles : (T, A) degrees, of
        :data:`hiros_mcap.body.anatomy.ANGLE_NAMES`; None without a truth.

    Raises
    ------
    ConfigError
        The markers' names tell no joint.
    """
    drawn = {"truth": (TRUTH, true_angles), "result": (RESULT, angles)}
    rows = []
    for joint in SHOWN_ANGLES:
        columns = [ANGLE_NAMES.index(f"{side} {joint}") for side in SIDES]
        if np.isnan(angles[:, columns]).all():
            continue
        both = [values[:, columns].ravel() for _, values in drawn.values() if values is not None]
        y_range = around(np.concatenate([*both, [0.0]]), 0.05)  # of left and right
        row = []
        for side, k in zip(SIDES, columns, strict=True):
            curves = [
                Curve(name, colour, *with_gaps(seconds, values[:, k]))
                for name, (colour, values) in drawn.items()
                if values is not None
            ]
            row.append(CurvePlot(curves, y_range, f"{side} {joint}, degrees", has_zero=True))
        rows.append(row)
    if not rows:
        raise ConfigError("no joint with an angle was seen, or the marker names reveal none")
    return over_time(rows, 1.6 * len(rows) + 0.5, seconds, marks)


def angles_of(model: SkeletonModel, poses: Floats, orientations: Floats | None) -> Floats:
    """(T, A) degrees of one person: poses (T, M, 3) m, orientations (T, L, 4) of the links."""
    return np.degrees(anatomical_angles(model, poses, orientations))
