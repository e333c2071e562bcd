"""Whether positions are in metres: people have a size. And what turns them into metres."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from hiros_mcap.body.units import AXES, METRES, by_camera, is_called
from hiros_mcap.skeletons import Floats

SMALLEST, LARGEST = 0.03, 10.0
"""m; no detector of people sees anybody outside of these, a hand alone included."""
_MILLIMETRES = 300.0  # above this, a size is more likely given in mm than in cm


def factors_of(topic: str, unit: str, negate: str) -> Floats:
    """(3,) factors that turn a topic's positions into metres with right-handed axes.

    ``unit`` and ``negate`` are as :func:`by_camera` reads them; what names the topic counts more.
    """
    factors = np.ones(3)
    for text, values in ((unit, METRES), (negate, AXES)):
        named = by_camera(text, values)
        for camera in sorted(named, key=len, reverse=True):
            if is_called(topic, camera):
                value = named[camera]
                signs = np.where(np.array(AXES) == value, -1.0, 1.0)
                factors *= METRES.get(value, signs)
                break
    return factors


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


def unit_warning(topic: str, size: float, *, alike: bool = True) -> str:
    """Return a warning if people of a channel have a size, m, that nobody has; "" otherwise.

    ``alike`` : whether those of all other channels have it, too.
    """
    unit = unit_of(size)
    if unit == "m":
        return ""
    if unit:
        return (
            f"{topic}: people are {size:.0f} m large, so the positions are in {unit}, not in m; "
            f"read them with --unit {unit if alike else f'{topic}={unit}'}"
        )
    return (
        f"{topic}: people are {1000 * size:.1f} mm large; check the unit of the positions, and "
        "--unit, without which hiros reads m"
    )
