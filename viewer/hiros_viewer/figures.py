"""What all plots share, and the plot of joint angles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.body.angles import ANGLES, flexions
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


def angle_figure(
    model: SkeletonModel, seconds: Floats, poses: Floats, true_poses: Floats | None
) -> Figure:
    """Flexion angles, left beside right, truth and result, as in Fig. 5 of the Hi-ROS paper.

    Parameters
    ----------
    seconds : (T,). poses, true_poses : (T, M, 3) m; None without a truth.

    Raises
    ------
    ConfigError
        The markers' names tell no joint.
    """
    bends = np.degrees(flexions(model, poses))
    true = None if true_poses is None else np.degrees(flexions(model, true_poses))
    shown = [k for k in range(len(ANGLES)) if not np.isnan(bends[:, k]).all()]
    if not shown:
        raise ConfigError("the marker names reveal no joint with an angle")
    rows = (len(shown) + 1) // 2
    figure = new_figure(11, 1.6 * rows + 0.5)
    grid = figure.subplots(rows, 2, sharex=True, squeeze=False)
    for axes, k in zip(grid.T.ravel(), shown, strict=False):
        if true is not None:
            axes.plot(*with_gaps(seconds, true[:, k]), color=TRUTH, lw=1.2)
        axes.plot(*with_gaps(seconds, bends[:, k]), color=RESULT, lw=1.2)
        axes.set_title(f"{ANGLES[k]} flexion, degrees", loc="left", fontsize=9)
        axes.margins(x=0.01)
        tidy(axes)
    for axes in grid[-1]:
        axes.set_xlabel("s")
    return figure
