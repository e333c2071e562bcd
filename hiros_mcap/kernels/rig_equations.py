"""Normal equations of the cameras' poses and clocks, with the people's joints eliminated.

The first camera defines the frame and the time. It has no unknowns.
"""

from __future__ import annotations

from typing import NamedTuple

from hiros_mcap.kernels.array_types import F1, F2, F3, I1, arrays
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import Floats

UNKNOWNS = 8  # of a camera: rotation, shift, clock, drift
CLOCK, DRIFT = 6, 7


class SeenPoints(NamedTuple):
    """P joints that at least two of C cameras see."""

    seconds: F1  # (P,) common time
    offsets: F3  # (C, P, 3) from the joint's mean, m
    weights: F2  # (C, P) 0 where the camera does not see it
    turned: F3  # (C, P, 3) R x, m
    velocities: F3  # (C, P, 3) common frame, m/s


class RigEquations(NamedTuple):
    """What is summed over all points."""

    hessian: F2  # (8 (C - 1), 8 (C - 1)); the upper triangle of blocks is written
    slopes: F2  # (K, 8 (C - 1)) gradient, summed over each of K clusters of points
    jacobians: F3  # (C - 1, 3, 8) scratch: Jacobians of a point

    @classmethod
    def zeros(cls, n_cameras: int, n_clusters: int) -> RigEquations:
        """Allocate the sums."""
        c, n = n_cameras - 1, UNKNOWNS * (n_cameras - 1)
        return arrays(cls, (n, n), (n_clusters, n), (c, 3, UNKNOWNS))


@kernel
def _differentiate(points: SeenPoints, c: int, p: int, jacobian: Floats) -> None:
    """Write the Jacobian (3, 8) of a point by its camera: ``[-[R x]x, I, -V, -V t]``."""
    x, y, z = points.turned[c, p, 0], points.turned[c, p, 1], points.turned[c, p, 2]
    jacobian[:] = 0.0
    jacobian[0, 1], jacobian[0, 2] = z, -y
    jacobian[1, 0], jacobian[1, 2] = -z, x
    jacobian[2, 0], jacobian[2, 1] = y, -x
    for i in range(3):
        jacobian[i, 3 + i] = 1.0
        jacobian[i, CLOCK] = -points.velocities[c, p, i]
        jacobian[i, DRIFT] = -points.velocities[c, p, i] * points.seconds[p]


@kernel
def _add_block(hessian: Floats, c: int, d: int, factor: float, jacobians: Floats) -> None:
    """Add ``factor`` times J_c' J_d to a block of the Hessian."""
    for i in range(3):
        for a in range(UNKNOWNS):
            scaled = factor * jacobians[c, i, a]
            if scaled != 0.0:
                row = hessian[UNKNOWNS * c + a, UNKNOWNS * d : UNKNOWNS * d + UNKNOWNS]
                for b in range(UNKNOWNS):
                    row[b] += scaled * jacobians[d, i, b]


@entry
def add_points(points: SeenPoints, clusters: I1, equations: RigEquations) -> None:
    """Add all points to ``sum w J'J - (sum w J)' (sum w J) / sum w`` and to the gradient.

    Parameters
    ----------
    clusters : (P,) row of ``equations.slopes`` that each point adds to.
    """
    hessian, slopes, jacobians = equations
    for p in range(len(points.seconds)):
        total = points.weights[0, p]
        for c in range(len(jacobians)):
            total += points.weights[c + 1, p]
        for c in range(len(jacobians)):
            w = points.weights[c + 1, p]
            if w <= 0.0:
                continue
            _differentiate(points, c + 1, p, jacobians[c])
            for i in range(3):
                pull = w * points.offsets[c + 1, p, i]
                for a in range(UNKNOWNS):
                    slopes[clusters[p], UNKNOWNS * c + a] += pull * jacobians[c, i, a]
            _add_block(hessian, c, c, w - w * w / total, jacobians)
            for d in range(c):
                v = points.weights[d + 1, p]
                if v > 0.0:
                    _add_block(hessian, d, c, -w * v / total, jacobians)
