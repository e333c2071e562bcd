"""Lengths, differences and means of points.

These are apart from the distance of skeletons, since nearly all kernels need them: modules that
import each other's kernels are compiled by one core.
"""

from __future__ import annotations

import math

import numpy as np

from hiros_mcap.kernels.compile import inlined, kernel
from hiros_mcap.skeletons import Floats

_ROUNDS, _SMALL = 8, 0.003  # of Weiszfeld's iteration; m


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


@kernel
def geometric_median(points: Floats, n: int, out: Floats) -> None:
    """Write nearly the geometric median of the first ``n`` points (N, 3), m: Weiszfeld (1937).

    It has the least sum of distances from the points: who is far off hardly moves it. Unlike a
    median along each axis, it does not depend on the axes.
    """
    out[0], out[1], out[2] = 0.0, 0.0, 0.0
    for k in range(n):
        for c in range(3):
            out[c] += points[k, c] / n
    for _ in range(_ROUNDS):
        x, y, z, total = 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            weight = 1.0 / (point_distance(points[k], out) + _SMALL)
            total += weight
            x += weight * points[k, 0]
            y += weight * points[k, 1]
            z += weight * points[k, 2]
        out[0], out[1], out[2] = x / total, y / total, z / total
