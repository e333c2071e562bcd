"""The distance between two skeletons, the mean over the markers that both have, and who is who."""

from __future__ import annotations

import math

import numpy as np

from hiros_mcap.kernels.array_types import B1, B2, F1, F2, F3, I1, I2
from hiros_mcap.kernels.compile import entry, inlined
from hiros_mcap.kernels.points import mean_position, point_distance
from hiros_mcap.skeletons import Floats, Ints


@entry
def centre(positions: F2, out: F1) -> None:
    """Write the :func:`mean_position` of some positions."""
    out[0], out[1], out[2] = mean_position(positions)


@inlined
def mean_distance(pose: Floats, other: Floats) -> float:
    """Mean distance, m, of the markers that both poses (M, >= 3) have; inf if there are none."""
    total, common = 0.0, 0
    for m in range(len(pose)):
        distance = point_distance(pose[m], other[m])
        if not math.isnan(distance):
            total += distance
            common += 1
    return total / common if common else np.inf


@inlined
def weighted_mean_distance(
    pose: Floats, other: Floats, slots: Ints, weights: Floats, other_weights: Floats, limit: float
) -> float:
    """As :func:`mean_distance`, where each marker counts with the product of its weights.

    Parameters
    ----------
    pose, other : (M, >= 3), m. weights, other_weights : (M,), not negative;
        ``weights`` at most 1.
    slots : (M,) marker of ``other`` that each marker of ``pose`` is compared with.
    limit : the result is infinite as soon as it is known to be greater, m.
    """
    heaviest = 1.0
    for m in range(len(pose)):
        heaviest = max(heaviest, other_weights[m])
    total = norm = 0.0
    for m in range(len(pose)):
        slot = slots[m]
        distance = point_distance(pose[m], other[slot])
        if not math.isnan(distance):
            weight = weights[m] * other_weights[slot]
            norm += weight
            total += weight * distance
        if (m & 7) == 7 and total > limit * (norm + (len(pose) - 1 - m) * heaviest):
            return np.inf
    return total / norm if norm > 0.0 else np.inf


@entry
def mean_distances(poses: F3, others: F3, out: F2) -> None:
    """Write the :func:`mean_distance` of each pair of ``poses`` (P, M, 3) and ``others`` (Q, M, 3).

    ``out`` is (P, Q), m.
    """
    for p in range(len(poses)):
        for q in range(len(others)):
            out[p, q] = mean_distance(poses[p], others[q])


@entry
def nearest(poses: F3, others: F3, rows: I2, out: F1) -> None:
    """Write each pose's mean distance, m, to the nearest of some of the others (Q, M, 3).

    ``rows`` (P, 2) are the first of the others that a pose is compared with, and the one after the
    last. ``out`` is (P,), infinite where there are none.
    """
    for p in range(len(poses)):
        out[p] = np.inf
        for q in range(rows[p, 0], rows[p, 1]):
            out[p] = min(out[p], mean_distance(poses[p], others[q]))


@entry
def follow_people(
    poses: F3, mirrored: F3, last: F3, swap: float, gate: float,
    distances: F2, swaps: B2, owners: I1, swapped: B1,
) -> None:  # fmt: skip
    """Find out which of Q people each of P poses continues: the nearest to each other, mutually.

    Parameters
    ----------
    poses, last : (P, M, 3) and (Q, M, 3) m; NaN = absent. mirrored : poses with swapped sides.
    swap : share of the distance below which swapped sides are nearer. gate : largest distance, m.
    distances, swaps : (P, Q) scratch.
    owners, swapped : (P,) get whom a pose continues, -1 = nobody, and whether its sides are
        swapped.
    """
    for p in range(len(poses)):
        for q in range(len(last)):
            straight = mean_distance(poses[p], last[q])
            crossed = mean_distance(mirrored[p], last[q])
            swaps[p, q] = crossed < swap * straight
            distances[p, q] = crossed if swaps[p, q] else straight
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
