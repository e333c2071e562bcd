"""A report as one self-contained HTML file: text, tables and plots, nothing loaded from elsewhere.

::

    page = Page("Evaluation of lab.hiros.mcap")
    page.table(["joint", "mean, mm"], [["wrist", "18.2"]], caption="Error per joint")
    page.figure(figure, "Error over time")
    page.write(Path("report.html"))
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from hiros_mcap.outputs import HTML_MARK, write_text
from hiros_viewer.interactive import curves_json, has_curves, library, thinned

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = """
:root { color-scheme: light dark; } .about { color: #57606a; margin: .2rem 0; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 80rem; padding: 0 1rem;
       color: #1b1f24; background: #fff; }
h1 { font-size: clamp(1.1rem, 5vw, 1.6rem); overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin-top: 2.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: .6rem 0; }
th, td { padding: .2rem .45rem; text-align: right; border-bottom: 1px solid #e3e6ea; }
th:first-child, td:first-child { text-align: left; } td + td { white-space: nowrap; }
th { border-bottom: 2px solid #9aa4af; font-weight: 600; }
caption, figcaption { text-align: left; color: #57606a; font-size: .9rem; padding: .3rem 0; }
caption span { display: inline-block; position: sticky; left: 0; max-width: calc(100vw - 3rem); }
figure { margin: 1rem 0; overflow-x: auto; } figcaption { position: sticky; left: 0; }
.curves, figure > svg { min-width: 40rem; }
figure > svg { width: 100%; max-width: 62rem; height: auto; }
.wide { overflow-x: auto; }
@media (prefers-color-scheme: dark) {
  body { color: #dde3ea; background: #141414; } /* as white inverted, below */
  .about, caption, figcaption { color: #9aa4af; }
  th, td { border-color: #2c333b; } th { border-color: #57606a; }
  figure > svg, .curves { filter: invert(.92) hue-rotate(180deg); }
}
"""


class Page:
    """Collects sections in order; :meth:`write` makes the file."""

    def __init__(self, title: str, about: Sequence[str] = ()) -> None:
        self.title = title
        self.about = about
        """Lines below the title: of which log, when, how, and the verdict."""
        self._parts: list[str] = []
        self._figures = 0
        self._curves: dict[str, str] = {}
        """Element -> its plots."""

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
        body = "".join(
            "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n" for row in rows
        )
        title = f"<caption><span>{escape(caption)}</span></caption>" if caption else ""
        self._parts.append(
            f'<div class="wide"><table>{title}<thead><tr>{head}</tr></thead>\n'
            f"<tbody>{body}</tbody></table></div>"
        )

    def figure(self, figure: Figure, caption: str = "") -> None:
        """Add a matplotlib figure; the same figure gives the same bytes.

        Where curves have names the plot can be zoomed and read; others are SVG pictures.
        """
        self._figures += 1
        name = f"f{self._figures}"
        if has_curves(figure):
            if (step := thinned(figure)) > 1:
                caption = f"{caption} 1 of {step} instants is drawn.".strip()
            self._curves[name] = curves_json(figure, name)
            drawn = f'<div class="curves" id="{name}"></div>'
        else:
            drawn = _svg(figure, name)
        below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
        self._parts.append(f"<figure>{drawn}{below}</figure>")

    def html(self) -> str:
        """Return the page."""
        parts = "\n".join(self._parts)
        about = "".join(f'<p class="about">{escape(line)}</p>\n' for line in self.about if line)
        script = ""
        if self._curves:
            plots = "".join(f"Bokeh.embed.embed_item({each});\n" for each in self._curves.values())
            script = _script(library()) + _script(plots.replace("</", "<\\/"))
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


def _script(text: str) -> str:
    return f"<script>{text}</script>\n"


def _svg(figure: Figure, prefix: str) -> str:
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
