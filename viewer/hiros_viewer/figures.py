"""What all plots share, and the plot of joint angles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_mcap.body.anatomy import ANGLE_NAMES, anatomical_angles
from hiros_mcap.body.segments import SIDES
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.errors import ConfigError
from hiros_mcap.skeletons import Floats, SkeletonModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRUTH, RESULT, SPREAD = "#1f5fa8", "#e07b1a", "#9aa4af"
LEFT, RIGHT = "#8a8f98", "#3c56d8"
"""Of the limbs on each side, as in the viewer: pale and strong."""
_LIMB_RANGE_MM = 60.0
PAUSE_S = 0.25
_LIMBS = {
    "upper arm": ("shoulder", "elbow"),
    "forearm": ("elbow", "wrist"),
    "thigh": ("hip", "knee"),
    "shin": ("knee", "ankle"),
}


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure, size in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def new_axes(width: float, height: float) -> tuple[Figure, Axes]:
    """Return a figure of one plot, tidy, size in inches."""
    figure = new_figure(width, height)
    axes = figure.subplots()
    tidy(axes)
    return figure, axes


def tidy(axes: Axes) -> None:
    """Take away what carries no data."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)


def with_gaps(seconds: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Put a NaN into every pause, so that no line is drawn over it."""
    pauses = np.nonzero(np.diff(seconds) > PAUSE_S)[0] + 1
    return np.insert(seconds, pauses, np.nan), np.insert(values, pauses, np.nan, axis=0)


def entitle(figure: Figure, lines: Sequence[str]) -> None:
    """Write a title above all plots: the first line large, what follows small and grey."""
    if lines:
        figure.suptitle("\n".join(filter(None, lines)), fontsize=9, x=0.01, ha="left")


def name_above(axes: Axes, colours: Mapping[str, str]) -> None:
    """Name curves in their colours above the right end of a plot, where no curve is."""
    x = 1.0
    style: dict[str, Any] = {"transform": axes.transAxes, "ha": "right", "va": "bottom"}
    for name, colour in reversed(list(colours.items())):
        axes.text(x, 1.01, name, color=colour, fontsize=9, **style)
        x -= 0.022 * (len(name) + 1)


def name_ends(axes: Axes) -> None:
    """Name every curve at its right end; names keep apart."""
    low, high = axes.get_ylim()
    ends = []
    for line in axes.lines:
        heights = np.asarray(line.get_ydata(), float)
        heights = heights[~np.isnan(heights)]
        if len(heights):
            ends.append(((heights[-1] - low) / (high - low), line))
    height = axes.get_figure(root=True).get_figheight() * axes.get_position().height  # type: ignore[union-attr]
    apart, below = 0.16 / height, -np.inf
    for end, line in sorted(ends, key=lambda pair: pair[0]):
        below = max(end, below + apart)
        axes.annotate(
            str(line.get_label()), (1.01, below), xycoords="axes fraction", va="center", fontsize=9,
            color=line.get_color(), annotation_clip=False,
        )  # fmt: skip


def value_bars(axes: Axes, names: Sequence[str], values: Sequence[float], spread: Any) -> None:
    """Draw horizontal bars, the first one on top, each with its value."""
    axes.barh(list(names), values, xerr=spread, color=TRUTH, ecolor=SPREAD)
    wide = np.nan_to_num(values).max(initial=0.0) / 8
    for row, value in enumerate(values):
        if not np.isnan(value):  # beside a bar that is too short for it
            x, colour = (0.0, "white") if value > wide else (value, "black")
            # The line of the spread may begin left of the value.
            box = {"facecolor": TRUTH if value > wide else "white", "pad": 1.0, "edgecolor": "none"}
            text = f" {value:.1f}"
            axes.text(x, row, text, va="center", fontsize=8, color=colour, bbox=box, zorder=4)
    axes.set_xlim(0, None)
    axes.invert_yaxis()
    axes.margins(y=0.01)


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


def limb_figure(
    seconds: Floats, lengths: Mapping[str, Floats], title: Sequence[str] = ()
) -> Figure:
    """Draw limb lengths, a plot per limb with left and right, of the same range each.

    Parameters
    ----------
    seconds : (T,). lengths : "left shin" -> (T,) mm. title : lines above all plots.
    """
    limbs = list(dict.fromkeys(name.split(" ", 1)[1] for name in lengths))
    figure = new_figure(11, 1.7 * ((len(limbs) + 1) // 2) + 0.5)
    entitle(figure, title)
    grid = figure.subplots((len(limbs) + 1) // 2, 2, sharex=True, squeeze=False)
    for axes in grid.ravel()[len(limbs) :]:
        axes.set_visible(False)
    for limb, axes in zip(limbs, grid.ravel(), strict=False):
        sides = {side: lengths[f"{side} {limb}"] for side in SIDES if f"{side} {limb}" in lengths}
        both = np.concatenate(list(sides.values()))
        for side, values in sides.items():
            colour, width = (LEFT, 1.2) if side == "left" else (RIGHT, 1.8)
            axes.plot(*with_gaps(seconds, values), color=colour, lw=width, label=side)
        axes.set_title(f"{limb}, mm", loc="left", fontsize=9)
        axes.set_ylim(*_limb_range(both))
        axes.margins(x=0.01)
        name_above(axes, {"left": LEFT, "right": RIGHT})
        tidy(axes)
    for axes in grid[-1]:
        axes.set_xlabel("s")
    return figure


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


def angle_figure(
    seconds: Floats, angles: Floats, true_angles: Floats | None, title: Sequence[str] = ()
) -> Figure:
    """Signed joint angles, left beside right, truth and result, as in Fig. 5 of the Hi-ROS paper.

    Parameters
    ----------
    seconds : (T,). angles, true_angles : (T, A) degrees, of
        :data:`hiros_mcap.body.anatomy.ANGLE_NAMES`; None without a truth.
    title : lines above all plots.

    Raises
    ------
    ConfigError
        The markers' names tell no joint.
    """
    column = {name: k for k, name in enumerate(ANGLE_NAMES)}
    shown = [
        joint
        for joint in SHOWN_ANGLES
        if not np.isnan(angles[:, [column[f"{side} {joint}"] for side in SIDES]]).all()
    ]
    if not shown:
        raise ConfigError("the marker names reveal no joint with an angle")
    figure = new_figure(11, 1.6 * len(shown) + 0.5)
    entitle(figure, title)
    grid = figure.subplots(len(shown), 2, sharex=True, sharey="row", squeeze=False)
    for joint, row in zip(shown, grid, strict=True):
        for side, axes in zip(SIDES, row, strict=True):
            k = column[f"{side} {joint}"]
            axes.axhline(0, color=SPREAD, lw=0.8)
            if true_angles is not None:
                true = with_gaps(seconds, true_angles[:, k])
                axes.plot(*true, color=TRUTH, lw=1.2, label="truth")
                name_above(axes, {"truth": TRUTH, "result": RESULT})
            axes.plot(*with_gaps(seconds, angles[:, k]), color=RESULT, lw=1.2, label="result")
            axes.set_title(f"{side} {joint}, degrees", loc="left", fontsize=9)
            axes.margins(x=0.01)
            tidy(axes)
    for axes in grid[-1]:
        axes.set_xlabel("s")
    return figure


def angles_of(model: SkeletonModel, poses: Floats, orientations: Floats | None) -> Floats:
    """(T, A) degrees of one person: poses (T, M, 3) m, orientations (T, L, 4) of the links."""
    return np.degrees(anatomical_angles(model, poses, orientations))
