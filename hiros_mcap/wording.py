"""Numbers and wrong names in words, and records as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from typing import Any


def quantity(n: int, noun: str) -> str:
    """Return a number of things: 1 detection, 14 detections."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def number(value: float, digits: int, unit: str = "") -> str:
    """Return a number with its unit, a dash for what is unknown; what rounds to 0 has no sign."""
    return f"{value:z.{digits}f}{unit}" if math.isfinite(value) else "-"


def duration(seconds: float) -> str:
    """Return a time in the unit that fits: 3.2 s, 100.0 s, 1.0 hours, 3.2 years."""
    for unit, length in (("years", 31_557_600.0), ("days", 86_400.0), ("hours", 3_600.0)):
        if seconds >= length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.1f} s"


def instead(name: str, there: Iterable[str], prefix: str = "") -> str:
    """Return what a wrong name may have meant, with a prefix, and all the names that there are."""
    names = list(there)
    near = get_close_matches(name, names, n=1)
    guess = f"; did you mean {prefix}{near[0]}?" if near else ""
    return f"{guess} (there are: {', '.join(names)})"


def plain(record: Any) -> dict[str, Any]:
    """Return a dataclass as JSON data; tuples become lists, what is not finite becomes None."""
    return {item.name: plain_value(getattr(record, item.name)) for item in fields(record)}


def plain_value(value: object) -> object:
    """Return one value as JSON data; see :func:`plain`."""
    if is_dataclass(value):
        return plain(value)
    if isinstance(value, Mapping):
        return {str(key): plain_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_value(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
