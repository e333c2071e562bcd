"""The point with the least sum of distances from others: who is far off hardly moves it.

Unlike a median along each axis, it does not depend on the axes.
"""

from __future__ import annotations

from hiros_mcap.kernels.compile import kernel
from hiros_mcap.kernels.points import point_distance
from hiros_mcap.skeletons import Floats

_ROUNDS, _SMALL = 8, 0.003  # of Weiszfeld's iteration; m


@kernel
def geometric_median(points: Floats, n: int, out: Floats) -> None:
    """Write nearly the geometric median of the first ``n`` points (N, 3), m: Weiszfeld (1937)."""
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
