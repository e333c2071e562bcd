"""Which person of a camera's last frames each person of its next frame is."""

from __future__ import annotations

import math

import numpy as np

from hiros_mcap.kernels.array_types import B1, B2, F2, F3, I1, J1
from hiros_mcap.kernels.compile import entry, inlined
from hiros_mcap.kernels.points import point_distance
from hiros_mcap.skeletons import Floats, Ints


@inlined
def _mean_distances(pose: Floats, other: Floats, mirror: Ints) -> tuple[float, float]:
    """Mean distance, m, of the markers that both have: as the pose is, and with swapped sides."""
    straight, swapped, n, n_swapped = 0.0, 0.0, 0, 0
    for m in range(len(mirror)):
        distance = point_distance(pose[m], other[m])
        if not math.isnan(distance):
            straight += distance
            n += 1
        distance = point_distance(pose[mirror[m]], other[m])
        if not math.isnan(distance):
            swapped += distance
            n_swapped += 1
    return straight / n if n else np.inf, swapped / n_swapped if n_swapped else np.inf


@entry
def follow_people(
    poses: F3, last: F3, mirror: J1, swap: float, gate: float,
    distances: F2, swaps: B2, owners: I1, swapped: B1,
) -> None:  # fmt: skip
    """Find out which of Q people each of P poses continues: the nearest to each other, mutually.

    Parameters
    ----------
    poses, last : (P, M, 3) and (Q, M, 3) m; NaN = absent. mirror : (M,) slots of counterparts.
    swap : share of the distance below which swapped sides are nearer. gate : largest distance, m.
    distances, swaps : (P, Q) scratch.
    owners, swapped : (P,) get whom a pose continues, -1 = nobody, and whether its sides are
        swapped.
    """
    for p in range(len(poses)):
        for q in range(len(last)):
            straight, mirrored = _mean_distances(poses[p], last[q], mirror)
            swaps[p, q] = mirrored < swap * straight
            distances[p, q] = mirrored if swaps[p, q] else straight
    for p in range(len(poses)):
        q = 0
        for other in range(1, len(last)):
            q = other if distances[p, other] < distances[p, q] else q
        is_mutual = distances[p, q] <= gate
        for other in range(len(poses)):
            is_nearer = distances[other, q] < distances[p, q]
            is_first = distances[other, q] == distances[p, q] and other < p
            is_mutual &= not (is_nearer or is_first)
        owners[p] = q if is_mutual else -1
        swapped[p] = is_mutual and swaps[p, q]
