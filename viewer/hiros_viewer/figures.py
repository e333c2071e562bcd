"""What all plots share, and the plot of joint angles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.body.anatomy import ANGLE_NAMES, anatomical_angles
from hiros_mcap.body.segments import SIDES
from hiros_mcap.errors import ConfigError
from hiros_mcap.skeletons import Floats, SkeletonModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRUTH, RESULT, SPREAD = "#1f5fa8", "#e07b1a", "#9aa4af"
_PAUSE_S = 0.25


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
    pauses = np.nonzero(np.diff(seconds) > _PAUSE_S)[0] + 1
    return np.insert(seconds, pauses, np.nan), np.insert(values, pauses, np.nan, axis=0)


SHOWN_ANGLES = (
    *("hip flexion", "hip abduction", "knee flexion", "ankle dorsiflexion"),
    *("shoulder flexion", "shoulder abduction", "elbow flexion"),
)
"""Of each side, from top to bottom."""


def angle_figure(
    seconds: Floats, angles: Floats, true_angles: Floats | None, title: str = ""
) -> Figure:
    """Signed joint angles, left beside right, truth and result, as in Fig. 5 of the Hi-ROS paper.

    Parameters
    ----------
    seconds : (T,). angles, true_angles : (T, A) degrees, of
        :data:`hiros_mcap.body.anatomy.ANGLE_NAMES`; None without a truth.
    title : above all plots.

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
    if title:
        figure.suptitle(title, fontsize=11)
    grid = figure.subplots(len(shown), 2, sharex=True, sharey="row", squeeze=False)
    for joint, row in zip(shown, grid, strict=True):
        for side, axes in zip(SIDES, row, strict=True):
            k = column[f"{side} {joint}"]
            axes.axhline(0, color=SPREAD, lw=0.8)
            if true_angles is not None:
                axes.plot(*with_gaps(seconds, true_angles[:, k]), color=TRUTH, lw=1.2)
            axes.plot(*with_gaps(seconds, angles[:, k]), color=RESULT, lw=1.2)
            axes.set_title(f"{side} {joint}, degrees", loc="left", fontsize=9)
            axes.margins(x=0.01)
            tidy(axes)
    for axes in grid[-1]:
        axes.set_xlabel("s")
    return figure


def angles_of(model: SkeletonModel, poses: Floats, orientations: Floats | None) -> Floats:
    """(T, A) degrees of one person: poses (T, M, 3) m, orientations (T, L, 4) of the links."""
    return np.degrees(anatomical_angles(model, poses, orientations))
