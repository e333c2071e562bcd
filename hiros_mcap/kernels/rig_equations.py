"""Normal equations of the cameras' poses and clocks, with the people's joints eliminated.

The first camera defines the frame and the time. It has no unknowns.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2, F3
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.skeletons import Floats, Stamps

UNKNOWNS = 8  # of a camera: rotation, shift, clock, drift
CLOCK, DRIFT = 6, 7


class RigResiduals(NamedTuple):
    """How far P points of C cameras are from the joints' means."""

    means: F2
    """(P, 3) common frame, m."""
    offsets: F3
    """(C, P, 3) m; any number where the weight is 0."""
    weights: F2
    """(C, P) robust weights."""
    turned: F3
    """(C, P, 3) R x, m."""
    velocities: F3
    """(C, P, 3) common frame, m/s."""

    @property
    def distances(self) -> Floats:
        """(C, P) m; NaN where the camera does not see the joint."""
        lengths = np.sqrt(np.einsum("cpi,cpi->cp", self.offsets, self.offsets))
        return np.where(self.weights > 0.0, lengths, np.nan)

    @property
    def mean_velocities(self) -> Floats:
        """(P, 3) of all cameras, m/s."""
        sums = np.einsum("cp,cpi->pi", self.weights, self.velocities)
        return np.asarray(sums / self.weights.sum(axis=0)[:, None])

    def against_others(self) -> Iterator[tuple[Stamps, Floats, Floats]]:
        """Yield how each camera differs from the mean of the others.

        (K,) which points others see, too; (K, 3) its distance from them, m; (K,) weights.
        """
        total = self.weights.sum(axis=0)
        for weights, offsets in zip(self.weights, self.offsets, strict=True):
            rest = total - weights
            seen = np.flatnonzero((weights > 0.0) & (rest > 1e-12))
            apart = offsets[seen] * (total[seen] / rest[seen])[:, None]
            yield seen, apart, np.minimum(weights, rest)[seen]


@inlined
def _column(k: int, i: int) -> int:
    """Return the unknown of the ``k``-th number of row ``i`` of :func:`_differentiate`."""
    if k < 2:
        return k if k < i else k + 1
    return 3 + i if k == 2 else k + 3


@kernel
def _differentiate(points: RigResiduals, c: int, p: int, seconds: float, jacobian: Floats) -> None:
    """Write the Jacobian of a point by its camera: ``[-[R x]x, I, -V, -V t]``.

    Without the zeros, (3, 5): two numbers of the rotation, the shift, the clock, the drift.
    """
    x, y, z = points.turned[c, p, 0], points.turned[c, p, 1], points.turned[c, p, 2]
    jacobian[0, 0], jacobian[0, 1] = z, -y
    jacobian[1, 0], jacobian[1, 1] = -z, x
    jacobian[2, 0], jacobian[2, 1] = y, -x
    for i in range(3):
        jacobian[i, 2] = 1.0
        jacobian[i, 3] = -points.velocities[c, p, i]
        jacobian[i, 4] = -points.velocities[c, p, i] * seconds


@inlined
def _add_block(
    hessian: Floats, c: int, d: int, factor: float, jacobians: Floats, first: int, last: int
) -> None:
    """Add ``factor`` times J_c' J_d to a block of the Hessian."""
    for i in range(3):
        for k in range(first, last):
            scaled = factor * jacobians[c, i, k]
            row = hessian[UNKNOWNS * c + _column(k, i)]
            for n in range(first, last):
                row[UNKNOWNS * d + _column(n, i)] += scaled * jacobians[d, i, n]


@entry
def add_points(
    points: RigResiduals, seconds: F1, first: int, last: int, hessian: F2, slope: F1, jacobians: F3
) -> None:
    """Add all points to ``sum w J'J - (sum w J)' (sum w J) / sum w`` and to the gradient.

    Parameters
    ----------
    seconds : (P,) common times.
    first, last : what is added, of the five columns of :func:`_differentiate`: those that are free.
    hessian : (8 (C - 1), 8 (C - 1)); the upper triangle of blocks is written.
    slope : (8 (C - 1),) the gradient.
    jacobians : (C - 1, 3, 5) scratch: Jacobians of a point.
    """
    for p in range(len(seconds)):
        total = points.weights[0, p]
        for c in range(len(jacobians)):
            total += points.weights[c + 1, p]
        for c in range(len(jacobians)):
            w = points.weights[c + 1, p]
            if w <= 0.0:
                continue
            _differentiate(points, c + 1, p, seconds[p], jacobians[c])
            for i in range(3):
                pull = w * points.offsets[c + 1, p, i]
                for k in range(first, last):
                    slope[UNKNOWNS * c + _column(k, i)] += pull * jacobians[c, i, k]
            _add_block(hessian, c, c, w - w * w / total, jacobians, first, last)
            for d in range(c):
                v = points.weights[d + 1, p]
                if v > 0.0:
                    _add_block(hessian, d, c, -w * v / total, jacobians, first, last)
