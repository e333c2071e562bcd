"""Which person of a camera's last frames each person of its next frame is."""

from __future__ import annotations

from hiros_mcap.kernels.array_types import B1, B2, F2, F3, I1
from hiros_mcap.kernels.compile import entry
from hiros_mcap.kernels.distance import mean_distance


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
