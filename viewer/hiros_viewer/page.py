"""A report as one self-contained HTML file: text, tables and plots, nothing loaded from elsewhere.

::

    page = Page("Evaluation of lab.hiros.mcap")
    page.table(["joint", "mean, mm"], [["wrist", "18.2"]], caption="Error per joint")
    page.figure(figure, "Error over time")
    page.write(Path("report.html"))

Curves are drawn by Bokeh, so that a reader can zoom them and read their values; other plots are
pictures.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_mcap.outputs import HTML_MARK, write_text
from hiros_viewer.figures import MARKED, SPREAD, Curve, CurveGrid, CurvePlot
from hiros_viewer.pictures import svg_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_POINTS = 5000
"""Of a curve: five minutes at 15 Hz, finer than a screen shows and small enough to send."""
_PIXELS = 84  # per inch of a figure
_LEGEND_PX = 24
_STYLE = """
:root { color-scheme: light dark; --page: #fff; --edge: #0003; }
.about { color: #57606a; margin: .2rem 0; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 80rem; padding: 0 1rem;
       color: #1b1f24; background: var(--page); }
h1 { font-size: clamp(1.1rem, 5vw, 1.6rem); overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin-top: 2.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: .6rem 0; }
th, td { padding: .2rem .45rem; text-align: right; border-bottom: 1px solid #e3e6ea; }
th:first-child, td:first-child { text-align: left; background: var(--page);
                                 position: sticky; left: 0; }
td + td { white-space: nowrap; } td.long { white-space: normal; min-width: 8em; }
th { border-bottom: 2px solid #9aa4af; font-weight: 600; }
caption, figcaption { text-align: left; color: #57606a; font-size: .9rem; padding: .3rem 0; }
caption span { display: inline-block; position: sticky; left: 0; max-width: calc(100vw - 3rem); }
figure { margin: 1rem 0; overflow-x: auto; } figcaption { position: sticky; left: 0; }
figure > svg { width: 100%; min-width: 40rem; max-width: 62rem; height: auto; }
.wide { overflow-x: auto; background: /* an edge where more of a table is beside the screen */
        linear-gradient(to left, var(--page) 30%, transparent) right / 3rem 100% no-repeat local,
        linear-gradient(to left, var(--edge), transparent) right / .8rem 100% no-repeat scroll; }
@media (max-width: 40rem) {
  body { margin: 1rem auto; } table { font-size: .87rem; } th, td { padding: .2rem .3rem; }
}
@media (prefers-color-scheme: dark) {
  :root { --page: #141414; --edge: #fff3; } body { color: #dde3ea; } /* as white inverted, below */
  .about, caption, figcaption { color: #9aa4af; }
  th, td { border-color: #2c333b; } th { border-color: #57606a; }
  figure > svg, .curves { filter: invert(.92) hue-rotate(180deg); }
}
"""

_DRAW = """
function draw(item) {
  if (innerWidth < 640)  // a plot per row: nobody finds those beside the screen of a telephone
    item.doc.roots[0].attributes.children.forEach((cell, k) => { [cell[1], cell[2]] = [k, 0]; });
  Bokeh.embed.embed_item(item);
}
"""


class Page:
    """Collects sections in order; :meth:`write` makes the file."""

    def __init__(self, title: str, about: Sequence[str] = ()) -> None:
        self.title = title
        self.about = about  # lines below the title: of which log, when, how, and the verdict
        self._parts: list[str] = []
        self._figures = 0
        self._curves: dict[str, str] = {}  # element -> its plots

    def heading(self, text: str) -> None:
        """Start a section."""
        self._parts.append(f"<h2>{escape(text)}</h2>")

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._parts.append(f"<p>{escape(text)}</p>")

    def table(
        self, header: Sequence[str], rows: Iterable[Sequence[str]], caption: str = ""
    ) -> None:
        """Add a table; the first column is aligned left, the others right."""
        head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
        body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>\n" for row in rows)
        title = f"<caption><span>{escape(caption)}</span></caption>" if caption else ""
        self._parts.append(
            f'<div class="wide"><table>{title}<thead><tr>{head}</tr></thead>\n'
            f"<tbody>{body}</tbody></table></div>"
        )

    def figure(self, figure: CurveGrid | Figure, caption: str = "") -> None:
        """Add curves, which can be zoomed and read, or a picture of matplotlib's as SVG.

        The same figure gives the same bytes.
        """
        self._figures += 1
        name = f"f{self._figures}"
        if isinstance(figure, CurveGrid):
            if (step := thinned(figure)) > 1:
                caption = f"{caption} 1 of {step} instants is drawn.".strip()
            self._curves[name] = curves_json(figure, name)
            drawn = f'<div class="curves" id="{name}"></div>'
        else:
            drawn = svg_of(figure, name)
        below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
        self._parts.append(f"<figure>{drawn}{below}</figure>")

    def html(self) -> str:
        """Return the page."""
        parts = "\n".join(self._parts)
        about = "".join(f'<p class="about">{escape(line)}</p>\n' for line in self.about if line)
        script = ""
        if self._curves:
            plots = "".join(f"draw({each});\n" for each in self._curves.values())
            script = _script(library()) + _script(_DRAW + plots.replace("</", "<\\/"))
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"{HTML_MARK}\n<title>{escape(self.title)}</title>\n<style>{_STYLE}</style>"
            f"</head>\n<body><h1>{breakable(self.title)}</h1>\n{about}{parts}\n{script}</body></html>\n"
        )

    def write(self, path: Path) -> None:
        """Write the file; whole or not at all.

        Raises LogError if the file cannot be written.
        """
        write_text(path, self.html())


def breakable(text: str) -> str:
    """Return a text as HTML that may wrap behind the signs inside names of files and channels."""
    return re.sub(r"(?<=[\w.])([_./:]+)(?=\w)", r"\1<wbr>", escape(text))


def _cell(text: str) -> str:
    """Return a cell of a table: numbers stay on one line, sentences and long names may wrap."""
    return (
        f'<td class="long">{breakable(text)}</td>' if len(text) > 16 else f"<td>{escape(text)}</td>"
    )


def _script(text: str) -> str:
    return f"<script>{text}</script>\n"


def library() -> str:
    """Return BokehJS as a script; it loads nothing from elsewhere."""
    from bokeh.resources import Resources

    return "\n".join(Resources(mode="inline", components=["bokeh"]).js_raw)


def thinned(grid: CurveGrid) -> int:
    """Return n where every n-th point of the curves is drawn."""
    longest = max(len(curve.x) for row in grid.rows for plot in row for curve in plot.curves)
    return -(-longest // MOST_POINTS)


def curves_json(grid: CurveGrid, target: str) -> str:
    """Return the plots for ``Bokeh.embed.embed_item``, into the element ``target``.

    All plots share their zoom along x and the cursor; those of the first row have the legend. The
    same plots give the same text.
    """
    from bokeh.embed import json_item
    from bokeh.layouts import gridplot
    from bokeh.models import CrosshairTool, Range1d, Span

    height, step = int(grid.height * _PIXELS / len(grid.rows)), thinned(grid)
    x_range, sources = Range1d(*grid.x_range), dict[bytes, Any]()
    cursor = Span(dimension="height", line_color="#57606a")
    rows: list[list[Any]] = []
    for row in grid.rows:
        taller = 0 if rows else _LEGEND_PX
        drawn = [_plot(plot, grid, height + taller, x_range) for plot in row]
        for shown, plot in zip(drawn, row, strict=True):
            for curve in plot.curves:
                _add(shown, curve, sources, step, grid.x_title)
            _place_legend(shown, is_visible=not rows)
            cross = CrosshairTool(overlay=cursor, dimensions="height", visible=False)
            shown.add_tools(cross)
            shown.xaxis.axis_label = grid.x_title if row is grid.rows[-1] else ""
        rows.append(drawn)
    layout = gridplot(
        rows, sizing_mode="stretch_width", toolbar_location="right",
        toolbar_options={"logo": None}, merge_tools=True,
    )  # fmt: skip
    return _renumbered(json.dumps(json_item(layout, target), separators=(",", ":")))


def _plot(plot: CurvePlot, grid: CurveGrid, height: int, x_range: Any) -> Any:
    """Return one plot without its curves."""
    from bokeh.models import BoxAnnotation, Range1d, Span
    from bokeh.plotting import figure

    shown = figure(
        title=plot.title or None, height=height, y_axis_label=plot.y_title, x_range=x_range,
        y_range=Range1d(*plot.y_range), tools="xwheel_zoom,box_zoom,pan,reset",
        active_drag="box_zoom", min_border=8,
    )  # fmt: skip
    shown.axis.minor_tick_line_color = None
    if plot.has_zero:
        shown.add_layout(Span(location=0.0, line_color=SPREAD))
    for mark in grid.marks:
        colour = MARKED[mark.kind]
        style = {"level": "underlay", "line_color": None, "fill_alpha": 0.25}
        shown.add_layout(BoxAnnotation(left=mark.start, right=mark.end, fill_color=colour, **style))
    return shown


def _add(shown: Any, curve: Curve, sources: dict[bytes, Any], step: int, unit: str) -> None:
    """Add a curve to a plot.

    Curves at the same times have these once: ``sources`` has the columns by the bytes of x, in
    single precision, which halves the page.
    """
    from bokeh.models import ColumnDataSource, HoverTool

    x, y = (np.asarray(values, np.float32)[::step] for values in (curve.x, curve.y))
    source = sources.setdefault(x.tobytes(), ColumnDataSource())
    source.data.setdefault("x", x)
    name = f"y{len(source.data)}"
    source.add(y, name)
    data = {"x": "x", "y": name, "source": source, "color": curve.colour}
    line = shown.line(**data, line_width=curve.width, legend_label=curve.name)
    if curve.has_dots:
        shown.scatter(**data, size=6)
    tips = [(curve.name, f"@{name}{{0.[00]}}"), (unit or "s", "@x{0.[00]}")]
    shown.add_tools(HoverTool(renderers=[line], tooltips=tips, mode="vline", visible=False))


def _place_legend(shown: Any, *, is_visible: bool) -> None:
    """Put the names of curves above a plot, where they cover none."""
    legend = shown.legend[0]
    shown.center.remove(legend)
    shown.add_layout(legend, "above")
    legend.orientation, legend.location, legend.click_policy = "horizontal", "right", "hide"
    legend.padding = legend.margin = 2
    legend.label_text_font_size, legend.border_line_alpha = "11px", 0.0
    legend.visible = is_visible


def _renumbered(text: str) -> str:
    """Return the text with objects numbered from 1: Bokeh counts through the process."""
    numbers: dict[str, int] = {}
    return re.sub(
        r'"p(\d+)"', lambda hit: f'"p{numbers.setdefault(hit[1], len(numbers) + 1)}"', text
    )
