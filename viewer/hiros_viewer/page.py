"""A report as one self-contained HTML file: text, tables and plots, nothing loaded from elsewhere.

::

    page = Page("Evaluation of lab.hiros.mcap")
    page.table(["joint", "mean, mm"], [["wrist", "18.2"]], caption="Error per joint")
    page.figure(figure, "Error over time")
    page.write(Path("report.html"))

Plots are pictures: ``hiros view`` has curves to zoom, ``hiros export`` their values.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from hiros_mcap.outputs import HTML_MARK, write_text
from hiros_viewer.pictures import png_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
figure > img { width: 100%; min-width: 40rem; max-width: 62rem; height: auto; }
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
  figure > img { filter: invert(.92) hue-rotate(180deg); }
}
"""


class Page:
    """Collects sections in order; :meth:`write` makes the file."""

    def __init__(self, title: str, about: Sequence[str] = ()) -> None:
        self.title = title
        self.about = about  # lines below the title: of which log, when, how, and the verdict
        self._parts: list[str] = []

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

    def figure(self, figure: Figure, caption: str = "") -> None:
        """Add a picture of matplotlib's; the same figure gives the same bytes."""
        text, data = escape(caption), b64encode(png_of(figure)).decode()
        below = f"<figcaption>{text}</figcaption>" if caption else ""
        image = f'<img src="data:image/png;base64,{data}" alt="{text}">'
        self._parts.append(f"<figure>{image}{below}</figure>")

    def html(self) -> str:
        """Return the page."""
        parts = "\n".join(self._parts)
        about = "".join(f'<p class="about">{escape(line)}</p>\n' for line in self.about if line)
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"{HTML_MARK}\n<title>{escape(self.title)}</title>\n<style>{_STYLE}</style>"
            f"</head>\n<body><h1>{breakable(self.title)}</h1>\n{about}{parts}\n</body></html>\n"
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
