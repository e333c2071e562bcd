"""Normal equations of the cameras' poses and clocks, with the people's joints eliminated.

The first camera defines the frame and the time. It has no unknowns.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2, F3, arrays
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.skeletons import Floats, Stamps

UNKNOWNS = 7  # of a camera: rotation, shift, clock
CLOCK = 6


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


class EquationWork(NamedTuple):
    """Scratch for one point of C cameras. Zeros at first."""

    jacobians: F2
    """(3, 7 (C - 1)) those of the cameras but the first, side by side."""
    factors: F1
    """(7 (C - 1),) of each column's camera: what a product of Jacobians counts."""

    @classmethod
    def allocate(cls, n_cameras: int) -> EquationWork:
        """Allocate the arrays."""
        n = UNKNOWNS * (n_cameras - 1)
        return arrays(cls, (3, n), n)


@kernel
def _differentiate(points: RigResiduals, c: int, p: int, jacobian: Floats) -> None:
    """Write the Jacobian (3, 7) of a point by its camera: ``[-[R x]x, I, -V]``.

    What is 0 in every Jacobian is left alone.
    """
    x, y, z = points.turned[c, p, 0], points.turned[c, p, 1], points.turned[c, p, 2]
    jacobian[0, 1], jacobian[0, 2] = z, -y
    jacobian[1, 0], jacobian[1, 2] = -z, x
    jacobian[2, 0], jacobian[2, 1] = y, -x
    for i in range(3):
        jacobian[i, 3 + i] = 1.0
        jacobian[i, CLOCK] = -points.velocities[c, p, i]


@inlined
def _add_row(row: Floats, number: float, factors: Floats, numbers: Floats) -> None:
    """Add the products of a number of one Jacobian with those of a row of all: many at a time."""
    for n in range(len(row)):
        row[n] += factors[n] * number * numbers[n]


@entry
def add_points(
    points: RigResiduals, first: int, last: int, hessian: F2, slope: F1, work: EquationWork
) -> None:
    """Add all points to ``sum w J'J - (sum w J)' (sum w J) / sum w`` and to the gradient.

    Parameters
    ----------
    first, last : which rows are added, of the seven unknowns of a camera: those that are free.
    hessian : (7 (C - 1), 7 (C - 1)); the upper triangle of blocks is written.
    slope : (7 (C - 1),) the gradient.
    """
    n_cameras = len(slope) // UNKNOWNS
    for p in range(len(points.means)):
        total = points.weights[0, p]
        for c in range(n_cameras):
            total += points.weights[c + 1, p]
        for c in range(n_cameras):
            w, begin = points.weights[c + 1, p], UNKNOWNS * c
            if w > 0.0:
                jacobian = work.jacobians[:, begin : begin + UNKNOWNS]
                _differentiate(points, c + 1, p, jacobian)
            for i in range(3 if w > 0.0 else 0):
                pull = w * points.offsets[c + 1, p, i]
                for k in range(first, last):
                    slope[begin + k] += pull * work.jacobians[i, begin + k]
        for d in range(n_cameras):
            v, begin = points.weights[d + 1, p], UNKNOWNS * d
            if v <= 0.0:
                continue
            for c in range(d, n_cameras):
                w = points.weights[c + 1, p]
                factor = w - w * w / total if c == d else -w * v / total
                for n in range(UNKNOWNS):
                    work.factors[UNKNOWNS * c + n] = factor if w > 0.0 else 0.0
            for i in range(3):
                for k in range(first, last):
                    number = work.jacobians[i, begin + k]
                    if number != 0.0:
                        row, rest = hessian[begin + k, begin:], work.jacobians[i, begin:]
                        _add_row(row, number, work.factors[begin:], rest)
