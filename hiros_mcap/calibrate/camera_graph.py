"""From pairs of cameras to all cameras: every camera needs one other camera that sees the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

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

    The maximum spanning forest of the pairs' qualities (Kruskal 1956), ambiguous pairs last.
    """
    part = {c: c for c in cameras}
    tree: list[Pair] = []
    ranked = sorted(
        (pair for pair, each in fits.items() if usable(each)),
        key=lambda pair: (ambiguous(fits[pair]), -fits[pair][0].quality),
    )
    for a, b in ranked:
        if part[a] != part[b]:
            tree.append((a, b))
            joined = part[b]
            part = {c: part[a] if each == joined else each for c, each in part.items()}
    parts = [[c for c in cameras if part[c] == one] for one in sorted(set(part.values()))]
    largest = max(parts, key=len, default=[])
    return [pair for pair in tree if pair[0] in largest], largest


def chained(tree: list[Pair], fits: Fits, cameras: list[int], n_cameras: int) -> Rig:
    """Return poses and clocks of all cameras, the first of ``cameras`` at the origin."""
    rig = Rig.alone(n_cameras)
    known = {cameras[0]}
    waiting = list(tree)
    while waiting:
        a, b = next(pair for pair in waiting if (pair[0] in known) != (pair[1] in known))
        waiting.remove((a, b))
        turn, shift = fits[a, b][0].rig.rotations[1], fits[a, b][0].rig.shifts[1]
        clock = fits[a, b][0].rig.clocks[1]
        if a in known:
            _place(rig, a, b, turn, shift, clock)
            known.add(b)
        else:
            _place(rig, b, a, turn.T, -turn.T @ shift, -clock)
            known.add(a)
    return rig


def _place(rig: Rig, known: int, new: int, turn: Floats, shift: Floats, clock: float) -> None:
    rig.rotations[new] = rig.rotations[known] @ turn
    rig.shifts[new] = rig.rotations[known] @ shift + rig.shifts[known]
    rig.clocks[new] = rig.clocks[known] + clock


def coarse_clocks(
    views: Sequence[CameraView], rig: Rig, lags: Sequence[float], landmarks: Landmarks, mirror: Ints
) -> Floats:
    """(C,) s to add to the times of cameras whose poses are about right, to some 50 ms.

    Parameters
    ----------
    lags : usual time, s, from each camera's stamps to the log times: a hint.
    """
    signatures = [signatures_of(view, landmarks) for view in views]
    fits = {}
    for a, b in combinations(range(len(views)), 2):
        candidates = lag_candidates(signatures[a], signatures[b])
        tried = [0.0, lags[b] - lags[a], *(-one.seconds for one in candidates)]
        pair = [views[a], views[b]]
        fits[a, b] = [best_lag(pair, rig.select([a, b]).anchored(), tried, mirror)]
    tree, cameras = spanning_tree(fits, list(range(len(views))))
    return chained(tree, fits, cameras, len(views)).clocks
