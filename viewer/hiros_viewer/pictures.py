"""Pictures, drawn by matplotlib: PNG files, and SVG on pages."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_mcap.outputs import replacing
from hiros_viewer.figures import MARKED, SPREAD, TRUTH, CurveGrid, CurvePlot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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


def picture_of(grid: CurveGrid, title: Sequence[str] = ()) -> Figure:
    """Draw plots of curves below lines of a title."""
    n = max(map(len, grid.rows))
    figure = new_figure(11, grid.height)
    if title:
        figure.suptitle("\n".join(filter(None, title)), fontsize=9, x=0.01, ha="left")
    table = figure.subplots(len(grid.rows), n, sharex=True, squeeze=False)
    for row, cells in zip(grid.rows, table, strict=True):
        for plot, axes in zip(row, cells, strict=False):
            _draw(plot, axes)
            for mark in grid.marks:
                colour = MARKED[mark.kind]
                axes.axvspan(mark.start, mark.end, color=colour, alpha=0.25, lw=0, zorder=0)
        for axes in cells[len(row) :]:
            axes.set_visible(False)
    table[0, 0].set_xlim(grid.x_range)
    for axes in table[-1]:
        axes.set_xlabel(grid.x_title)
    return figure


def _draw(plot: CurvePlot, axes: Axes) -> None:
    """Draw one plot; its curves are named in their colours above its right end."""
    if plot.has_zero:
        axes.axhline(0, color=SPREAD, lw=0.8)
    for curve in plot.curves:
        dots = "o" if curve.has_dots else None
        axes.plot(curve.x, curve.y, color=curve.colour, lw=curve.width, marker=dots)
    axes.set_title(plot.title, loc="left", fontsize=9)
    axes.set(ylabel=plot.y_title, ylim=plot.y_range)
    place, style = 1.0, {"transform": axes.transAxes, "ha": "right", "va": "bottom"}
    for curve in reversed(plot.curves) if len(plot.curves) > 1 else ():
        axes.text(place, 1.01, curve.name, color=curve.colour, fontsize=9, **style)  # type: ignore[arg-type]
        place -= 0.022 * (len(curve.name) + 1)
    tidy(axes)


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


def save_png(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all; the same figure gives the same bytes.

    Raises LogError if the file cannot be written.
    """
    with replacing(path) as temporary:
        # Without matplotlib's version; the name is how a later run knows the file.
        figure.savefig(temporary, format="png", dpi=150, metadata={"Software": "hiros"})


def svg_of(figure: Figure, prefix: str) -> str:
    """Return the figure as an SVG element whose ids are unique within the page."""
    import matplotlib as mpl

    buffer = io.StringIO()
    # Without a date and with a fixed salt the bytes depend on the figure alone.
    with mpl.rc_context({"svg.hashsalt": "hiros", "svg.fonttype": "path"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="', f'id="{prefix}-', svg)
    return re.sub(r'(url\(#|xlink:href="#|href="#)(?!f\d+-)', rf"\1{prefix}-", svg)
