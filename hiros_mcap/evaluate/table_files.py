"""Tables of measures as files for papers and spreadsheets: CSV, Markdown and LaTeX.

CSV is one table for programs: a row per name, a column per number with its unit, and columns of
their own for a standard deviation and the ends of a 95 % interval. Markdown and LaTeX have a table
per sheet for readers, with the interval in the cell.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path

from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.measures import Measure, Sheet
from hiros_mcap.outputs import EXPORT_MARK, write_text
from hiros_mcap.summary import number

_TEX = {c: f"\\{c}" for c in "&%$#_{}"} | {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
}  # fmt: skip


def write_table(path: Path, sheets: Sequence[Sheet]) -> None:
    """Write sheets, in the format of the suffix; whole or not at all.

    Raises ConfigError as :func:`check_table` does, and LogError if the file cannot be written.
    """
    write_text(path, check_table(path)(sheets))


def check_table(path: Path) -> Callable[[Sequence[Sheet]], str]:
    """Return what makes the text of a file of this name; raises ConfigError for another suffix."""
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise ConfigError(f"{path}: a table ends in one of {', '.join(_WRITERS)}")
    return writer


def _csv(sheets: Sequence[Sheet]) -> str:
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
    return text.getvalue()


def _markdown(sheets: Sequence[Sheet]) -> str:
    def line(cells: Sequence[str]) -> str:
        return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"

    parts = [f"<!-- {EXPORT_MARK} -->"]
    for sheet in sheets:
        header, *rows = _readable(sheet)
        rule = line(["---", *["---:"] * (len(header) - 1)])
        parts.append("\n".join([f"**{sheet.title}**", "", line(header), rule, *map(line, rows)]))
    return "\n\n".join(parts) + "\n"


def _latex(sheets: Sequence[Sheet]) -> str:
    def line(cells: Sequence[str]) -> str:
        return " & ".join("".join(_TEX.get(c, c) for c in cell) for cell in cells) + r" \\"

    parts = [f"% {EXPORT_MARK}"]
    for sheet in sheets:
        header, *rows = _readable(sheet)
        body = [line(header), r"\hline", *map(line, rows)]
        columns = "l" + "r" * (len(header) - 1)
        begin, end = rf"\begin{{tabular}}{{{columns}}}", r"\end{tabular}"
        parts.append("\n".join([f"% {sheet.title}", begin, r"\hline", *body, r"\hline", end]))
    return "\n\n".join(parts) + "\n"


def _readable(sheet: Sheet) -> list[list[str]]:
    """Header and rows; an interval stands behind its number."""
    columns = sheet.columns
    header = [
        m.header() + (" (SD)" if m.sd else " (95 % interval)" if m.interval[0] else "")
        for m in columns
    ]
    rows = [[name, *(_cell(m, scores) for m in columns)] for name, scores in sheet.rows]
    return [[sheet.first, *header], *rows]


def _cell(measure: Measure, scores: object) -> str:
    figures = measure.figures(scores)
    low, high = (figures.get(name, math.nan) for name in ("95 % low", "95 % high"))
    if math.isnan(low):
        return measure.cell(scores)
    ends = (number(end, measure.digits) for end in (low, high))
    return f"{measure.cell(scores)} ({' to '.join(ends)})"


_WRITERS = {".csv": _csv, ".md": _markdown, ".tex": _latex}
