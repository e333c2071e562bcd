"""Lengths, differences and means of points.

These are apart from the distance of skeletons, since nearly all kernels need them: modules that
import each other's kernels are compiled by one core.
"""

from __future__ import annotations

import math

import numpy as np

from hiros_mcap.kernels.compile import inlined
from hiros_mcap.skeletons import Floats


@inlined
def norm3(x: float, y: float, z: float) -> float:
    """Length of a vector."""
    return math.sqrt(x * x + y * y + z * z)


@inlined
def point_distance(a: Floats, b: Floats) -> float:
    """Distance between two points, m, the first three numbers of each; NaN if one is absent."""
    return norm3(a[0] - b[0], a[1] - b[1], a[2] - b[2])


@inlined
def step_between(points: Floats, a: int, b: int) -> tuple[float, float, float]:
    """Vector from one of the points (N, >= 3) to another, m; NaN if one is absent."""
    return points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]


@inlined
def mean_position(positions: Floats) -> tuple[float, float, float]:
    """Mean of those of some positions (M, >= 3) that are known, m; NaN if none is."""
    n, x, y, z = 0, 0.0, 0.0, 0.0
    for m in range(len(positions)):
        if not math.isnan(positions[m, 0]):
            n += 1
            x, y, z = x + positions[m, 0], y + positions[m, 1], z + positions[m, 2]
    return (x / n, y / n, z / n) if n > 0 else (np.nan, np.nan, np.nan)
