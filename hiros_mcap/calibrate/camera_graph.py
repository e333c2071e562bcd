"""From pairs of cameras to all cameras: every camera needs one other camera that sees the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.coarse_clock import Landmarks, lag_candidates, signatures_of
from hiros_mcap.calibrate.pair_pose import PairFit, best_lag
from hiros_mcap.calibrate.sampling import Rig
from hiros_mcap.skeletons import Floats, Ints

Pair = tuple[int, int]
Fits = Mapping[Pair, list[PairFit]]
"""Cameras a < b -> poses of b in a that differ, the best first."""

LEAST_SHARE = 0.5
"""A pose that explains less of what two cameras see is no link between them."""
LEAST_FITTING = 10
NEAR_LAGS = np.arange(-3.0, 3.1, 0.2).tolist()
"""s. Whoever walks is off by 12 cm at half the step, and still fits."""
RIVAL = 0.8
"""A pose is ambiguous if another one has more than this share of its quality."""


def usable(fits: list[PairFit]) -> bool:
    """Whether two cameras see enough of the same people."""
    return bool(fits) and fits[0].share >= LEAST_SHARE and len(fits[0].distances) >= LEAST_FITTING


def ambiguous(fits: list[PairFit]) -> bool:
    """Whether a quite different pose explains what two cameras see nearly as well."""
    return len(fits) > 1 and fits[1].quality > RIVAL * fits[0].quality


def spanning_tree(fits: Fits, cameras: list[int]) -> tuple[list[Pair], list[int]]:
    """Return the best links that join cameras, and the cameras of the largest connected part.

    The links lead from the first of these cameras to the others. Ambiguous pairs come last.
    """
    ranked = sorted(
        (pair for pair, each in fits.items() if usable(each)),
        key=lambda pair: (ambiguous(fits[pair]), -fits[pair][0].quality),
    )
    trees = {c: links_from(c, ranked) for c in cameras}
    root = max(trees, key=lambda c: len(trees[c]), default=0)
    return trees.get(root, []), sorted({root, *(b for _, b in trees[root])}) if trees else []


def chained(tree: list[Pair], fits: Fits, n_cameras: int) -> Rig:
    """Return poses and clocks of all cameras; that from which the links lead is at the origin."""
    rig = Rig.alone(n_cameras)
    for a, b in tree:
        link = fits[min(a, b), max(a, b)][0].rig
        if a > b:
            link = link.select([1, 0]).anchored()
        rig.rotations[b] = rig.rotations[a] @ link.rotations[1]
        rig.shifts[b] = rig.rotations[a] @ link.shifts[1] + rig.shifts[a]
        rig.clocks[b] = rig.clocks[a] + link.clocks[1]
    return rig


def coarse_clocks(
    views: Sequence[CameraView], rig: Rig, lags: Sequence[float], landmarks: Landmarks, mirror: Ints
) -> Floats:
    """(C,) s to add to the times of cameras whose poses are about right, to some 100 ms.

    Many people who walk at one pace hide the right lag from the signatures. So all lags of up to
    3 s are tried.

    Parameters
    ----------
    lags : usual time, s, from each camera's stamps to the log times: a hint.
    """
    signatures = [signatures_of(view, landmarks) for view in views]
    fits = {}
    for a, b in combinations(range(len(views)), 2):
        candidates = lag_candidates(signatures[a], signatures[b])
        tried = [0.0, lags[b] - lags[a], *(-one.seconds for one in candidates), *NEAR_LAGS]
        pair = [views[a], views[b]]
        fits[a, b] = [best_lag(pair, rig.select([a, b]).anchored(), tried, mirror)]
    tree, _ = spanning_tree(fits, list(range(len(views))))
    return chained(tree, fits, len(views)).clocks


def links_from(root: int, pairs: Sequence[Pair]) -> list[Pair]:
    """Return the links by which cameras are reached from one of them: from where, and where to.

    Of the spanning tree that prefers the first of ``pairs``; cameras that no pair joins to the root
    are left out.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    ends = np.array(pairs, np.int64).reshape(-1, 2)
    n = 1 + max(root, int(ends.max(initial=0)))
    graph = csr_array((np.arange(1.0, len(ends) + 1.0), (ends[:, 0], ends[:, 1])), shape=(n, n))
    order, before = breadth_first_order(minimum_spanning_tree(graph), root, directed=False)
    return [(int(before[c]), int(c)) for c in order[1:]]
