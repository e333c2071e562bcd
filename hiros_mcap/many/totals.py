"""What came of many logs: one row each, and totals."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median
from typing import Any

from hiros_mcap.many.jobs import Job
from hiros_mcap.many.manifest import LogRecord
from hiros_mcap.summary import plain

_TEXT = ("log", "verdict")
_LAST = ("seconds", "warnings", "error")


@dataclass(frozen=True, slots=True)
class ColumnTotal:
    """A column of numbers over all logs that have it."""

    logs: int
    mean: float
    median: float
    least: float
    most: float
    sum: float | None
    """None where adding makes no sense, as for errors."""


def columns_of(records: Sequence[LogRecord]) -> list[str]:
    """Return the names of all values that a log has, in their order."""
    return list(dict.fromkeys(name for record in records for name in record.values))


def verdicts(records: Sequence[LogRecord]) -> dict[str, int]:
    """Return how many logs got each verdict."""
    return dict(Counter(record.verdict for record in records))


def column_totals(records: Sequence[LogRecord], job: Job) -> dict[str, ColumnTotal]:
    """Return the totals of every column of numbers."""
    totals = {}
    for name in columns_of(records):
        values = [record.values.get(name) for record in records]
        numbers = [float(x) for x in values if isinstance(x, int | float) and math.isfinite(x)]
        if numbers:
            added = math.fsum(numbers) if name in job.counted else None
            middle = fmean(numbers), median(numbers)
            totals[name] = ColumnTotal(len(numbers), *middle, min(numbers), max(numbers), added)
    return totals


def as_csv(records: Sequence[LogRecord]) -> str:
    """Return the table of all logs as CSV: log, verdict, what was measured, time, error."""
    columns, text = columns_of(records), io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_TEXT, *columns, *_LAST])
    for r in records:
        values = [r.values.get(name, "") for name in columns]
        last = f"{r.seconds:.3f}", "; ".join(r.warnings), r.error
        writer.writerow([r.log, r.verdict, *values, *last])
    return text.getvalue()


def to_dict(records: Sequence[LogRecord], job: Job) -> Mapping[str, Any]:
    """Plain data for JSON."""
    return {
        "command": job.command,
        "verdicts": verdicts(records),
        "totals": {name: plain(total) for name, total in column_totals(records, job).items()},
        "logs": [plain(record) for record in records],
    }
