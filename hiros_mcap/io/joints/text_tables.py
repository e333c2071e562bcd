"""Tables of text as people and spreadsheets save them: cells, numbers, times and units.

Cells are apart by commas, semicolons, tabs or bars, whichever the first line has most of. European
spreadsheets write decimal commas. A line ``sep=;`` is Excel's, a second line of units the habit of
many. RFC 4180 describes the quotes.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Collection, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from hiros_mcap.body.units import METRES
from hiros_mcap.errors import ConfigError
from hiros_mcap.outside import read_text

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_DELIMITERS = ",;\t|"
_QUOTED = re.compile(r'"[^"]*"')
_MISSING = {"", "-", "--", "na", "n/a", "#n/a", "<na>", "none", "null", "nat"}
"""How R, pandas, Excel and JSON write that there is no number; NaN is one."""
_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_POINT = re.compile(r"[+-]?\d*\.\d+(?:[eE][+-]?\d+)?")
_SINCE = re.compile(r"(?:(-?\d+) days?,? \+?)?(\d+):(\d\d):(\d\d(?:[.,]\d*)?)")
"""Hours, minutes and seconds, as pandas writes a Timedelta."""
_DATE = re.compile(r"\d{4}[-/]\d\d[-/]\d\d")


class Table(NamedTuple):
    """A file of rows."""

    path: Path
    columns: list[str]
    rows: list[tuple[str, dict[str, str]]]
    """File and line, for messages; cell by column."""
    units: dict[str, str]
    """Unit by column, of METRES or SECONDS, if the second line holds units."""

    def unit(self, columns: Iterable[str], known: Collection[str]) -> str:
        """Return the one unit of these columns; "" if the second line names none.

        Raises ConfigError if there are several, or it is none of those that are ``known``.
        """
        units = sorted({unit for name in columns if (unit := self.units.get(name))})
        if len(units) > 1 or not {*units} <= {*known}:
            raise ConfigError(
                f"{self.path}: line 2: has the units {', '.join(units)}, where one of "
                f"{', '.join(known)} should be"
            )
        return "".join(units)


def text_of(path: Path) -> str:
    """Text of a file of joints; raises ConfigError if it cannot be read or is not UTF-8."""
    return read_text(path, 1 << 30)


def read_table(path: Path, *, may_be_short: bool = False) -> Table:
    """Read a CSV file whose first line names the columns; rows without any cell do not count.

    ``may_be_short`` allows rows to lack their last cells.

    Raises ConfigError naming the line: a column is named twice, a row has more or fewer cells.
    """
    lines = text_of(path).splitlines()
    skipped = int(bool(lines) and bool(re.fullmatch(r'"?sep=."?', lines[0])))
    head = _QUOTED.sub("", next(iter(lines[skipped:]), ""))
    delimiter = max(_DELIMITERS, key=head.count)
    reader = csv.reader(lines[skipped:], delimiter=delimiter)
    rows: list[tuple[str, list[str]]] = []
    try:
        columns = [name.strip() for name in next(reader, [])]
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                rows.append((f"{path}: line {reader.line_num + skipped}", cells))
    except csv.Error as error:
        raise ConfigError(f"{path}: not CSV: {error}") from error
    if columns[:1] == ["scorer"]:
        raise ConfigError(
            f"{path}: line 1: is a table of DeepLabCut, whose names are in several lines; write "
            "one line instead: frame,nose_u,nose_v,nose_score,..."
        )
    if twice := sorted({name for name in columns if name and columns.count(name) > 1}):
        raise ConfigError(
            f"{path}: line 1: names the column {twice[0]} twice; one line should name each"
        )
    for where, cells in rows:
        _fit(cells, columns, delimiter, where, may_be_short=may_be_short)
    with_points(rows)
    units = _units(rows[0][1]) if rows else []
    named = [(where, dict(zip(columns, cells, strict=True))) for where, cells in rows]
    return Table(path, columns, named[bool(units) :], dict(zip(columns, units, strict=False)))


def _fit(
    cells: list[str], columns: Sequence[str], delimiter: str, where: str, *, may_be_short: bool
) -> None:
    """Make a row as long as the first line; raises ConfigError if cells are lost by that."""
    lacking = columns[len(cells) :]
    if any(cells[len(columns) :]):
        hint = "; if its commas are decimal ones, separate the cells by semicolons"
        raise ConfigError(
            f"{where}: has not as many cells as the first line ({len(cells)} for {len(columns)})"
            f"{hint if delimiter == ',' else ''}"
        )
    if any(lacking) and not may_be_short:
        raise ConfigError(f"{where}: has not as many cells as the first line; is it cut off?")
    cells[:] = [*cells[: len(columns)], *[""] * len(lacking)]


def with_points(rows: Iterable[tuple[str, list[str]]]) -> None:
    """Replace decimal commas by points, in place.

    Raises ConfigError if a file has both: then a comma may also stand between thousands.
    """
    rows = list(rows)
    commas = [(w, row, k) for w, row in rows for k, c in enumerate(row) if "," in c]
    commas = [(w, row, k) for w, row, k in commas if _COMMA.fullmatch(row[k])]
    if not commas:
        return
    where, row, k = commas[0]
    if point := next((c for _, cells in rows for c in cells if _POINT.fullmatch(c)), ""):
        raise ConfigError(
            f"{where}: has the number {row[k]!r}, and elsewhere there is {point!r}; write decimal "
            "points or decimal commas throughout, and nothing between thousands"
        )
    for _, cells, column in commas:
        cells[column] = cells[column].replace(",", ".")


def unit_of(text: str) -> str:
    """Return a unit as METRES or SECONDS call it, such as mm for [Millimeters]; "" for others."""
    word = text.strip(" ()[]\"'").lower().replace("metre", "meter").replace("µ", "u")
    if word in METRES or word in SECONDS:
        return word
    word = word.removesuffix("s")
    parts = {"": "", "milli": "m", "centi": "c", "micro": "u", "nano": "n"}
    for long, short in parts.items():
        if word == f"{long}meter" and f"{short}m" in METRES:
            return f"{short}m"
        if word in (f"{long}second", f"{short}sec") and f"{short}s" in SECONDS:
            return f"{short}s"
    return ""


def _units(cells: Sequence[str]) -> list[str]:
    """Return the unit of each cell, if all cells are units or say that there is none; else []."""
    units = [unit_of(cell) for cell in cells]
    others = {cell for cell, unit in zip(cells, units, strict=True) if not unit}
    return units if any(units) and others <= {"", "-", "1"} else []


def number_of(text: str | None, where: str) -> float:
    """Return a finite number, NaN for a cell without one; raises ConfigError for anything else."""
    text = (text or "").strip()
    try:
        number = math.nan if text.lower() in _MISSING else float(text)
    except ValueError:
        number = math.inf
    if math.isinf(number) or "_" in text:  # Python reads 1_0 as 10
        raise ConfigError(f"{where}: {text!r} is not a number")
    return number


def seconds_of(text: str | None, where: str, unit: str = "s") -> float:
    """Return a time, s; a number is in ``unit``, a date counts from 1970, and UTC is its zone.

    A date may name another zone. NaN for a cell without a time.

    Raises ConfigError for text that is none of them.
    """
    text = (text or "").strip()
    if since := _SINCE.fullmatch(text):
        days, hours, minutes, seconds = since.groups("0")
        whole = 24 * 3600 * int(days) + 3600 * int(hours) + 60 * int(minutes)
        return whole + float(seconds.replace(",", "."))
    if ":" not in text and not _DATE.match(text):
        return number_of(text, where) * SECONDS[unit]
    try:
        date = _date_of(text)
    except ValueError:
        raise ConfigError(
            f"{where}: {text!r} is no time; write seconds, or a date as "
            "2026-05-01T10:00:00.25+02:00"
        ) from None
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def lacks_zone(text: str | None) -> bool:
    """Whether a text is a date that names no zone."""
    try:
        return bool(_DATE.match(text or "")) and _date_of(text or "").tzinfo is None
    except ValueError:
        return False


def _date_of(text: str) -> datetime:
    return datetime.fromisoformat(re.sub(r" ?(?:UTC|GMT)$", "+00:00", text.replace("/", "-")))
