"""Lengths and differences of points."""

from __future__ import annotations

import math

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
