"""Whether positions are in metres: people have a size."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from hiros_mcap.skeletons import Floats

METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0}
"""Units in which people are measured."""
SMALLEST, LARGEST = 0.03, 10.0
"""m; no detector of people sees anybody outside of these, a hand alone included."""
_MILLIMETRES = 300.0
"""Above this, a size is more likely given in mm than in cm."""


def body_size(positions: Iterable[Floats]) -> float:
    """Median size of people, each (M, 3): the diagonal of the box around their joints.

    NaN if nobody has two joints.
    """
    sizes = []
    for points in positions:
        points = points[np.isfinite(points).all(axis=-1)]
        if len(points) > 1:
            sizes.append(float(np.linalg.norm(np.ptp(points, axis=0))))
    return float(np.median(sizes)) if sizes else math.nan


def unit_of(size: float) -> str:
    """Return the unit, "m", "cm" or "mm", in which a size makes sense; "" if none does."""
    if not math.isfinite(size) or SMALLEST <= size <= LARGEST:
        return "m"
    if size < SMALLEST:
        return ""
    return "mm" if size > _MILLIMETRES else "cm"


def unit_warning(topic: str, size: float) -> str:
    """Return a warning if people of a channel have a size, m, that nobody has; "" otherwise."""
    unit = unit_of(size)
    if unit == "m":
        return ""
    if unit:
        return (
            f"{topic}: people are {size:.0f} m large, so the positions are in {unit}, not in m; "
            f"read them with --unit {unit}"
        )
    return (
        f"{topic}: people are {1000 * size:.1f} mm large; check the unit of the positions, and "
        "--unit, without which hiros reads m"
    )
