"""Poses between what was measured and what a person does: the compiled part of the prior."""

from __future__ import annotations

import math
from typing import NamedTuple

from hiros_mcap.kernels.array_types import F1, F2, F3, arrays
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.kernels.points import norm3
from hiros_mcap.skeletons import Floats

_ABSENT = 1.0  # m2; variance of a marker that is missing
_FREE = 0.003  # m; what each marker may do by itself


class PoseSpace(NamedTuple):
    """In which directions the poses of a window vary by more than noise does; N = 3 M."""

    mean: F1  # (N,) mean pose, m
    basis: F2
    """(N, R) directions times the standard deviation along each, m; P = B B' + free variance."""


class EstimateWork(NamedTuple):
    """Scratch for one pose."""

    off: F1  # (N,) the pose against the mean, m
    variances: F1  # (N,) of the pose, with the free one, m2
    inner: F2  # (R, R) B' D^-1 B + 1, then its Cholesky factor
    share: F1  # (R,) of each direction in the estimate

    @classmethod
    def of(cls, space: PoseSpace) -> EstimateWork:
        """Make room."""
        n, rank = space.basis.shape
        return arrays(cls, n, n, (rank, rank), rank)


@kernel
def _compare(pose: Floats, variances: Floats, space: PoseSpace, work: EstimateWork) -> None:
    """Measure the pose (M, 3) against the mean; nothing is known of absent markers."""
    for i in range(len(space.mean)):
        m, c = i // 3, i % 3
        absent = math.isnan(pose[m, c])
        work.off[i] = 0.0 if absent else pose[m, c] - space.mean[i]
        work.variances[i] = _FREE**2 + (_ABSENT if absent else variances[m])


@kernel
def _solve(basis: Floats, work: EstimateWork) -> None:
    """Find the shares s of the directions, (B' D^-1 B + 1) s = B' D^-1 (y - mu)."""
    inner, share, (n, rank) = work.inner, work.share, basis.shape
    inner[:] = 0.0
    share[:] = 0.0
    for i in range(n):
        for r in range(rank):
            weighted = basis[i, r] / work.variances[i]
            share[r] += weighted * work.off[i]
            for q in range(r + 1):
                inner[r, q] += weighted * basis[i, q]
    for r in range(rank):
        inner[r, r] += 1.0
        for q in range(r + 1):
            total = inner[r, q]
            for k in range(q):
                total -= inner[r, k] * inner[q, k]
            inner[r, q] = math.sqrt(total) if q == r else total / inner[q, q]
        for q in range(r):
            share[r] -= inner[r, q] * share[q]
        share[r] /= inner[r, r]
    for r in range(rank - 1, -1, -1):
        for k in range(r + 1, rank):
            share[r] -= inner[k, r] * share[k]
        share[r] /= inner[r, r]


@entry
def estimate_poses(
    poses: F3, variances: F2, space: PoseSpace, largest: float, work: EstimateWork
) -> None:
    """Replace poses y by the estimates mu + P (P + V)^-1 (y - mu).

    Parameters
    ----------
    poses : (T, M, 3) local poses, m; NaN = absent, and stays so. variances : (T, M) V, m2.
    largest : no marker moves by more, in standard deviations.
    """
    for t in range(len(poses)):
        pose = poses[t]
        _compare(pose, variances[t], space, work)
        # (B B' + D)^-1 by Woodbury's identity; then B B' (B B' + D)^-1 (y - mu) = B s.
        _solve(space.basis, work)
        for i in range(len(space.mean)):
            along = 0.0
            for r in range(len(work.share)):
                along += space.basis[i, r] * work.share[r]
            free = _FREE**2 * (work.off[i] - along) / work.variances[i]
            work.off[i] = along + free - work.off[i]
        for m in range(len(pose)):
            step = work.off[3 * m : 3 * m + 3]
            size = norm3(step[0], step[1], step[2])
            most = largest * math.sqrt(3 * variances[t, m])
            scale = most / size if size > most else 1.0
            for c in range(3):
                pose[m, c] += scale * step[c]
