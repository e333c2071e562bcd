"""Numbers as people read them."""

from __future__ import annotations

import math


def number(value: float, digits: int, unit: str = "") -> str:
    """Return a number with its unit, a dash when there is none."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}{unit}"
