"""Which skeletons of two sets are of the same person: their distances, and the best pairs."""

from __future__ import annotations

import numpy as np

from hiros_mcap.evaluate.statistics import nan_mean
from hiros_mcap.skeletons import Floats


def skeleton_distances(a: Floats, b: Floats) -> Floats:
    """Mean distance over the markers that both skeletons have.

    Parameters
    ----------
    a, b : (A, M, 3) and (B, M, 3) marker positions, m; NaN where a marker is absent.

    Returns
    -------
    (A, B) distances, m; infinite where two skeletons share no marker.
    """
    if not (len(a) and len(b)):
        return np.zeros((len(a), len(b)))  # nobody was seen: b may have no markers at all
    mean = nan_mean(np.linalg.norm(a[:, None] - b[None], axis=-1), -1)
    return np.where(np.isnan(mean), np.inf, mean)


def best_pairs(cost: Floats) -> list[tuple[int, int]]:
    """Assign rows to columns: as many pairs as possible, of these the ones with the least sum.

    ``cost`` is (R, C); pairs of infinite cost are not allowed. Returns pairs (row, column) by row.
    """
    allowed = np.isfinite(cost)
    rows, columns = (each.tolist() for each in np.nonzero(allowed))
    if len(set(rows)) == len(rows) == len(set(columns)):
        return list(zip(rows, columns, strict=True))  # nobody has a choice
    from scipy.optimize import linear_sum_assignment

    # One forbidden pair costs more than all allowed ones together can save.
    forbidden = (2 * np.abs(cost[allowed]).max() + 1) * (max(cost.shape) + 1)
    best = np.transpose(linear_sum_assignment(np.where(allowed, cost, forbidden))).tolist()
    return [(row, column) for row, column in best if allowed[row, column]]
