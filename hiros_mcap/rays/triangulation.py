"""Where a person's joints are, from the rays of several images at one instant.

A joint takes the largest set of cameras that agree: each pair of rays gives a point, and the
cameras whose rays pass near it agree with the pair. The point of the set has the least sum of
squared distances from its rays, weighted by the noise of each; the weights give its variance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import B1, B2, F1, F2, F3, arrays
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.kernels.points import norm3
from hiros_mcap.skeletons import Floats

GATE = 3.5
"""Standard deviations of its own noise by which a ray may pass a point that it agrees with."""
_LARGEST = 0.3
"""m; standard deviation beyond which cameras that look from one side do not tell a place."""
_NEAREST = 0.2  # m before a camera, where nobody can be
_EXPECTED = 0.05  # m; standard deviation of what is expected


class Rays(NamedTuple):
    """The rays of J joints of a person in K images."""

    centres: F2
    """(K, 3) where the cameras are, m."""
    directions: F3
    """(K, J, 3) of the rays, unit vectors in the fixed frame; NaN = not seen."""
    noises: F2
    """(K, J) standard deviation of the distance at which a ray passes the joint, m."""

    @classmethod
    def allocate(cls, images: int, joints: int) -> Rays:
        """Return arrays of zeros."""
        return arrays(cls, (images, 3), (images, joints, 3), (images, joints))


class Triangulated(NamedTuple):
    """The J joints of a person, and which of K rays count."""

    points: F2
    """(J, 3) m; NaN where no two rays agree."""
    deviations: F1
    """(J,) standard deviation along an axis, m."""
    distances: F2
    """(K, J) at which a ray passes the point, m; NaN where there is none."""
    agrees: B2
    """(K, J) whether a ray is one of the set."""
    weights: F1
    normal: F2
    chosen: B1
    best: B1
    point: F1
    """Scratch: (K,), (3, 4), (K,), (K,) and (3,)."""

    @classmethod
    def allocate(cls, images: int, joints: int) -> Triangulated:
        """Return arrays of zeros."""
        k, j = images, joints
        return arrays(cls, (j, 3), j, (k, j), (k, j), k, (3, 4), k, k, 3)


@inlined
def _miss(rays: Rays, k: int, j: int, point: Floats) -> tuple[float, float]:
    """Distance at which a ray passes a point, and how far before the camera that is."""
    x = point[0] - rays.centres[k, 0]
    y = point[1] - rays.centres[k, 1]
    z = point[2] - rays.centres[k, 2]
    d = rays.directions[k, j]
    along = x * d[0] + y * d[1] + z * d[2]
    return norm3(x - along * d[0], y - along * d[1], z - along * d[2]), along


@kernel
def _meet(rays: Rays, j: int, out: Triangulated) -> float:
    """Write the point nearest to the chosen rays; return its deviation along an axis.

    NaN if the rays are parallel.
    """
    a = out.normal
    a[:, :] = 0.0
    for k in range(len(rays.centres)):
        if not out.chosen[k]:
            continue
        d, c = rays.directions[k, j], rays.centres[k]
        weight = 1.0 / (rays.noises[k, j] * rays.noises[k, j])
        for r in range(3):
            for s in range(3):
                part = ((1.0 if r == s else 0.0) - d[r] * d[s]) * weight
                a[r, s] += part
                a[r, 3] += part * c[s]
    # The inverse of a symmetric matrix by its cofactors.
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2]
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    c11 = a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2]
    c12 = a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2]
    c22 = a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]
    determinant = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    trace = (a[0, 0] + a[1, 1] + a[2, 2]) / 3.0
    if not determinant > 1e-9 * trace * trace * trace:
        return np.nan
    x, y, z = a[0, 3], a[1, 3], a[2, 3]
    out.point[0] = (c00 * x + c01 * y + c02 * z) / determinant
    out.point[1] = (c01 * x + c11 * y + c12 * z) / determinant
    out.point[2] = (c02 * x + c12 * y + c22 * z) / determinant
    return math.sqrt((c00 + c11 + c22) / (3.0 * determinant))


@kernel
def _choose(rays: Rays, j: int, out: Triangulated) -> tuple[int, float]:
    """Choose the rays that pass near the point; return how many, and their sum of squares."""
    n, total = 0, 0.0
    for k in range(len(rays.centres)):
        out.chosen[k] = False
        if math.isnan(rays.directions[k, j, 0]):
            continue
        miss, along = _miss(rays, k, j, out.point)
        square = miss * miss / (rays.noises[k, j] * rays.noises[k, j])
        if along > _NEAREST and square < GATE * GATE:
            out.chosen[k] = True
            n, total = n + 1, total + square
    return n, total


@kernel
def _search(rays: Rays, j: int, expected: Floats, out: Triangulated) -> bool:
    """Choose the largest set of rays that agree with a pair of them; False if there is none.

    Of sets of one size, the one that fits best; what is far from the expected place fits less.
    """
    most, least = 0, np.inf
    for i in range(len(rays.centres)):
        for k in range(i + 1, len(rays.centres)):
            if math.isnan(rays.directions[i, j, 0]) or math.isnan(rays.directions[k, j, 0]):
                continue
            for c in range(len(rays.centres)):
                out.chosen[c] = c in (i, k)
            deviation = _meet(rays, j, out)
            if math.isnan(deviation):
                continue
            n, misfit = _choose(rays, j, out)
            if not (out.chosen[i] and out.chosen[k]):
                continue
            if not math.isnan(expected[0]):
                x = out.point[0] - expected[0]
                y = out.point[1] - expected[1]
                z = out.point[2] - expected[2]
                spread = deviation * deviation + _EXPECTED * _EXPECTED
                misfit += (x * x + y * y + z * z) / spread
            if n > most or (n == most and misfit < least):
                most, least = n, misfit
                for c in range(len(rays.centres)):
                    out.best[c] = out.chosen[c]
    for c in range(len(rays.centres)):
        out.chosen[c] = out.best[c]
    return most >= 2


@kernel
def _joint(rays: Rays, j: int, expected: Floats, out: Triangulated) -> None:
    """Triangulate one joint."""
    n = 0
    for k in range(len(rays.centres)):
        out.chosen[k] = not math.isnan(rays.directions[k, j, 0])
        n += out.chosen[k]
    if n < 2:
        return
    deviation = _meet(rays, j, out)
    all_agree = not math.isnan(deviation) and _choose(rays, j, out)[0] == n
    if not all_agree:
        if not _search(rays, j, expected, out):
            return
        deviation = _meet(rays, j, out)
    if not deviation < _LARGEST:
        return
    for k in range(len(rays.centres)):
        out.agrees[k, j] = out.chosen[k]
        if not math.isnan(rays.directions[k, j, 0]):
            out.distances[k, j] = _miss(rays, k, j, out.point)[0]
    for r in range(3):
        out.points[j, r] = out.point[r]
    out.deviations[j] = deviation


# For Python.


@entry
def triangulate(rays: Rays, expected: F2, out: Triangulated) -> None:
    """Triangulate the joints of a person.

    Parameters
    ----------
    rays : of K images. expected : (J, 3) where the joints should be, m; NaN = not known.
    out : of the same K and J, is written.
    """
    out.points[:, :] = np.nan
    out.deviations[:] = np.nan
    out.distances[:, :] = np.nan
    out.agrees[:, :] = False
    for j in range(rays.directions.shape[1]):
        _joint(rays, j, expected[j], out)
