"""Curves on a page that can be zoomed and read under the pointer, drawn by Bokeh."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_viewer.marks import BAND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

MOST_POINTS = 5000
"""Of a curve: five minutes at 15 Hz, finer than a screen shows and small enough to send."""
_PIXELS = 84
"""Per inch of a figure."""
_LEGEND_PX = 24


def library() -> str:
    """Return BokehJS as a script; it loads nothing from elsewhere."""
    from bokeh.resources import Resources

    return "\n".join(Resources(mode="inline", components=["bokeh"]).js_raw)


def has_curves(figure: Figure) -> bool:
    """Whether a figure has curves with names: others are pictures."""
    return any(list(_named(axes)) for axes in figure.axes)


def thinned(figure: Figure) -> int:
    """Return n where every n-th point of the figure's curves is drawn."""
    longest = max(len(np.asarray(line.get_xdata())) for axes in figure.axes for line in axes.lines)
    return -(-longest // MOST_POINTS)


def curves_json(figure: Figure, target: str) -> str:
    """Return the figure's plots for ``Bokeh.embed.embed_item``, into the element ``target``.

    All plots of a figure share their zoom along x and the cursor; those of the first row have the
    legend. The same figure gives the same text.
    """
    from bokeh.embed import json_item
    from bokeh.layouts import gridplot
    from bokeh.models import CrosshairTool, Span

    step = thinned(figure)
    height = figure.get_size_inches()[1] * _PIXELS
    rows: dict[int, list[Any]] = {}
    cursor = Span(dimension="height", line_color="#57606a")
    table, first = _Table(step), None
    for axes in figure.axes:
        if axes.get_visible():
            spec = axes.get_subplotspec()
            row = 0 if spec is None else spec.rowspan.start
            n_rows = 1 if spec is None else spec.get_gridspec().nrows
            taller = _LEGEND_PX * (row == 0)
            plot = _plot(axes, table, int(height / n_rows) + taller, first)
            plot.add_tools(CrosshairTool(overlay=cursor, dimensions="height", visible=False))
            plot.legend.visible = row == 0
            first = first or plot.x_range
            rows.setdefault(row, []).append(plot)
    grid = gridplot(
        [rows[row] for row in sorted(rows)], sizing_mode="stretch_width",
        toolbar_location="right", toolbar_options={"logo": None}, merge_tools=True,
    )  # fmt: skip
    return _renumbered(json.dumps(json_item(grid, target), separators=(",", ":")))


class _Table:
    """The numbers of a figure's curves: those at the same times have these once."""

    def __init__(self, step: int) -> None:
        self._step = step
        self._sources: dict[bytes, Any] = {}

    def add(self, line: Line2D) -> dict[str, Any]:
        """Return source and columns of a curve; single precision, which halves the page."""
        from bokeh.models import ColumnDataSource

        data = (line.get_xdata(), line.get_ydata())
        x, y = (np.asarray(values, np.float32)[:: self._step] for values in data)
        source = self._sources.setdefault(x.tobytes(), ColumnDataSource())
        source.data.setdefault("x", x)
        name = f"y{len(source.data)}"
        source.add(y, name)
        return {"x": "x", "y": name, "source": source}


def _plot(axes: Axes, table: _Table, height: int, shared: Any) -> Any:
    """Return one plot with the curves, the ranges and the titles of matplotlib's."""
    from bokeh.models import BoxAnnotation, HoverTool, Range1d, Span
    from bokeh.plotting import figure as new_plot
    from matplotlib.colors import to_hex

    plot = new_plot(
        title=axes.get_title(loc="left") or None, height=height, x_axis_label=axes.get_xlabel(),
        y_axis_label=axes.get_ylabel(), x_range=shared or Range1d(*axes.get_xlim()),
        y_range=Range1d(*axes.get_ylim()), tools="xwheel_zoom,box_zoom,pan,reset",
        active_drag="box_zoom", min_border=8,
    )  # fmt: skip
    plot.axis.minor_tick_line_color = None
    for line in set(axes.lines) - set(_named(axes)):  # a level, such as zero
        plot.add_layout(
            Span(location=float(np.asarray(line.get_ydata())[0]), line_color=_colour(line))
        )
    for band in axes.patches:
        if band.get_gid() == BAND:
            left, right = band.get_extents().transformed(axes.transData.inverted()).intervalx
            plot.add_layout(
                BoxAnnotation(
                    left=float(left), right=float(right), level="underlay", line_color=None,
                    fill_color=to_hex(band.get_facecolor()), fill_alpha=0.25,
                )
            )  # fmt: skip
    unit = axes.get_xlabel() or "s"
    for line in _named(axes):
        data, colour = table.add(line), _colour(line)
        drawn = plot.line(
            **data, color=colour, line_width=line.get_linewidth(),
            legend_label=str(line.get_label()),
        )  # fmt: skip
        if line.get_marker() not in ("None", None, ""):
            plot.scatter(**data, color=colour, size=6)
        tips = [(str(line.get_label()), f"@{data['y']}{{0.[00]}}"), (unit, "@x{0.[00]}")]
        plot.add_tools(HoverTool(renderers=[drawn], tooltips=tips, mode="vline", visible=False))
    if plot.legend:
        legend = plot.legend[0]
        plot.center.remove(legend)  # where it would cover curves
        plot.add_layout(legend, "above")
        legend.orientation, legend.location, legend.click_policy = "horizontal", "right", "hide"
        legend.padding = legend.margin = 2
        legend.label_text_font_size, legend.border_line_alpha = "11px", 0.0
    return plot


def _named(axes: Axes) -> Iterator[Line2D]:
    return (line for line in axes.lines if not str(line.get_label()).startswith("_"))


def _colour(line: Line2D) -> str:
    from matplotlib.colors import to_hex

    return to_hex(line.get_color())


def _renumbered(text: str) -> str:
    """Return the text with objects numbered from 1: Bokeh counts through the process."""
    numbers: dict[str, int] = {}
    return re.sub(
        r'"p(\d+)"', lambda hit: f'"p{numbers.setdefault(hit[1], len(numbers) + 1)}"', text
    )
