"""The pose of one camera in another, and the lag of their clocks, from the people both see.

From pairs to all cameras: every camera needs one other camera that sees the same.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.coarse_clock import LagCandidate, Landmarks, lag_candidates, signatures_of
from hiros_mcap.calibrate.joint_refinement import (
    GATES_M,
    common_motion,
    free_unknowns,
    refine,
    residuals_of,
)
from hiros_mcap.calibrate.registration import robust_kabsch
from hiros_mcap.calibrate.sampling import Rig, group, instants_of, placed, sample
from hiros_mcap.calibrate.verdict import WRONG_M
from hiros_mcap.rays.image_tracks import Samples
from hiros_mcap.skeletons import Floats, Ints

FIT_M = 0.25
"""Two skeletons fit if their mean joint distance is below."""
BLIND_LAGS = (0.0, -0.1, 0.1)
"""s, where no motion tells the lag."""
LEAST_INSTANTS = 3
COARSE_INSTANTS = 50
"""Enough to choose among poses."""
SHARP, SHARPEST_M = 2.5, 0.06
"""Poses are compared at this many times the residual of the best, but at least 6 cm."""
HOPELESS = 0.4
"""A pose that has less of the best one's quality is not refined."""
REFINED = 3
"""So many of the best poses that differ are refined."""
CLEARLY = 1.2
"""Another lag has to have this many times the quality of none."""
LEAST_MOTION = 0.3
"""Correlation of the cameras' velocities from which on they tell the clocks."""
SAME_DEG, SAME_M, SAME_S = 20.0, 0.4, 0.3
"""Poses, and lags, that are nearer to each other count as one."""


class PairFit(NamedTuple):
    """How well one pose and lag of two cameras explain what both see."""

    rig: Rig  # the first camera stands at the origin
    distances: Floats  # distances, m, of the skeletons that fit
    common: int
    """Skeletons that could fit: the fewer people of both cameras, summed over the instants."""
    motion: float = 0.0  # correlation of the cameras' velocities
    quality: float = 0.0  # sum over the skeletons that fit of max(0, 1 - (distance / scale)^2)

    @property
    def share(self) -> float:
        """Share of the skeletons that fit."""
        return len(self.distances) / self.common if self.common else 0.0

    @property
    def residual(self) -> float:
        """Median distance of the skeletons that fit, m; NaN if none does."""
        return float(np.median(self.distances)) if len(self.distances) else float("nan")


def register_pair(
    pair: Sequence[CameraView],
    candidates: Sequence[LagCandidate],
    instants: Floats,
    mirror: Ints,
    given: Rig | None = None,
) -> list[PairFit]:
    """Return poses of the second camera in the first that differ, the best first.

    Every candidate for "the same person at this lag" gives a pose by a robust rigid fit, as the
    camera shows them and mirrored. A pose is scored by all people at all instants. The best ones
    are refined together with the lag.

    Parameters
    ----------
    candidates : of :func:`lag_candidates`. instants : (K,) times of the first camera, s.
    given : poses of both cameras that the log claims, to be tried, too.
    """
    sparse = instants[:: max(1, len(instants) // COARSE_INSTANTS)]
    tried = list(_coarse_fits(pair, candidates, sparse, mirror))
    if given is not None:
        tried.append(_fit(sample(pair, sparse, given), given, mirror))
    best = ranked(tried)[:REFINED]
    hopeful = [fit for fit in best if fit.quality > HOPELESS * best[0].quality]
    return ranked([_refined(pair, fit, instants, mirror) for fit in hopeful])


def best_lag(pair: Sequence[CameraView], rig: Rig, lags: Sequence[float], mirror: Ints) -> PairFit:
    """Return how well two cameras at given poses fit at the best of some lags.

    The first lag is the best one unless another one is clearly better.

    Parameters
    ----------
    rig : poses of both, the first camera at the origin. lags : s to add to the second one's times.
    """
    instants = instants_of(pair[:1], COARSE_INSTANTS)
    tried = []
    for lag in lags:
        late = rig._replace(clocks=np.array([0.0, lag]))
        tried.append(_scored(_fit(sample(pair, instants, late), late, mirror), FIT_M))
    best = max(tried, key=lambda fit: fit.quality)
    return best if best.quality > CLEARLY * tried[0].quality else tried[0]


def ranked(fits: Sequence[PairFit]) -> list[PairFit]:
    """Return the fits with their qualities, the best first, without those near to a better one.

    Who repeats a movement fits at several lags in one pose. As in :func:`best_lag`, the lag that is
    nearest to the stamps counts, unless another one is clearly better.

    The best pose that explains much of what both see sets the scale. If only the noise of the
    detectors is left in it, a pose that leaves twice as much does not fit.
    """
    scored = [_scored(fit, FIT_M) for fit in fits if len(fit.distances)]
    largest = max((fit.quality for fit in scored), default=0.0)
    nearest = min((fit.residual for fit in scored if fit.quality >= 0.5 * largest), default=FIT_M)
    scale = float(np.clip(SHARP * nearest, SHARPEST_M, FIT_M))
    kept: list[PairFit] = []
    for fit in sorted((_scored(one, scale) for one in scored), key=lambda one: -one.quality):
        near = next((k for k, better in enumerate(kept) if alike(fit.rig, better.rig)), len(kept))
        if near == len(kept):
            kept.append(fit)
        elif _is_nearer(fit, kept[near]):
            kept[near] = fit
    return kept


def _is_nearer(fit: PairFit, better: PairFit) -> bool:
    """Whether a fit counts in place of one of the same pose because of its lag."""
    one, other = abs(fit.rig.clocks[1]), abs(better.rig.clocks[1])
    return bool(one < other - SAME_S and CLEARLY * fit.quality > better.quality)


def _scored(fit: PairFit, scale: float) -> PairFit:
    quality = np.sum(np.maximum(0.0, 1.0 - (fit.distances / scale) ** 2))
    return fit._replace(quality=float(quality))


def _coarse_fits(
    pair: Sequence[CameraView],
    candidates: Sequence[LagCandidate],
    instants: Floats,
    mirror: Ints,
) -> Iterator[PairFit]:
    """Yield a fit for each lag, each pair of tracklets that may be the same person, each side.

    At the likeliest lag, or where no motion tells one, all long pairs are tried.
    """
    likely = candidates or [(lag, []) for lag in BLIND_LAGS]
    for k, (lag, pairs) in enumerate(likely):
        start = Rig.alone(2)._replace(clocks=np.array([0.0, -lag]))
        samples = sample(pair, instants, start)
        blind = _longest_together(samples) if k == 0 or not pairs else []
        for tracks, swapped in product(dict.fromkeys([*pairs, *blind]), (False, True)):
            rig = _rigid(samples, tracks, start, mirror if swapped else None)
            if rig is not None:
                yield _fit(samples, rig, mirror)


def _longest_together(samples: Samples) -> list[tuple[int, int]]:
    """Return the pairs of tracklets that overlap most."""
    tracks = [samples.tracks[samples.cameras == c] for c in (0, 1)]
    instants = [samples.instants[samples.cameras == c] for c in (0, 1)]
    counts = {
        (int(i), int(j)): len(
            np.intersect1d(instants[0][tracks[0] == i], instants[1][tracks[1] == j])
        )
        for i in np.unique(tracks[0])
        for j in np.unique(tracks[1])
    }
    together = [pair for pair, n in counts.items() if n >= LEAST_INSTANTS]
    return sorted(together, key=lambda pair: -counts[pair])[:6]


def _rigid(
    samples: Samples, tracks: tuple[int, int], start: Rig, mirror: Ints | None
) -> Rig | None:
    """Return the rig that brings one tracklet onto the other; None for too few instants."""
    rows = [
        np.flatnonzero((samples.cameras == c) & (samples.tracks == track))
        for c, track in enumerate(tracks)
    ]
    _, first, second = np.intersect1d(
        samples.instants[rows[0]], samples.instants[rows[1]], return_indices=True
    )
    if len(first) < LEAST_INSTANTS:
        return None
    a, b = rows[0][first], rows[1][second]
    order = slice(None) if mirror is None else mirror
    weights = np.minimum(samples.lines.weights[a], samples.lines.weights[b][:, order])
    shared = weights > 0.0
    goal = samples.lines.positions[a][shared]
    source = samples.lines.positions[b][:, order][shared]
    if np.count_nonzero(shared) < LEAST_INSTANTS:
        return None
    rotation, shift = robust_kabsch(source, goal, weights[shared])
    return start._replace(
        rotations=np.stack([np.eye(3), rotation]), shifts=np.stack([np.zeros(3), shift])
    )


def _fit(samples: Samples, rig: Rig, mirror: Ints) -> PairFit:
    groups = group(samples, placed(samples, rig), mirror, FIT_M)
    n = int(samples.instants.max(initial=-1)) + 1
    counts = [np.bincount(samples.instants[samples.cameras == c], minlength=n) for c in (0, 1)]
    fitting = groups.distances[np.isfinite(groups.distances)]
    return PairFit(rig, fitting, int(np.minimum(*counts).sum()))


def _refined(pair: Sequence[CameraView], start: PairFit, instants: Floats, mirror: Ints) -> PairFit:
    """Refine pose and lag; the lag of people who do not move is that of the log's stamps."""
    rig, points = refine(
        pair, start.rig, instants, mirror, free=free_unknowns(2), gates=GATES_M[1:]
    )
    motion = 0.0
    if len(points.seconds):
        motion = float(common_motion(residuals_of(points, rig))[1])
    if motion < LEAST_MOTION:
        rig = rig._replace(clocks=np.zeros(2))
        free = free_unknowns(2, clocks=False)
        rig, _ = refine(pair, rig, instants, mirror, free=free, gates=GATES_M[1:])
    return _fit(sample(pair, instants, rig), rig, mirror)._replace(motion=motion)


def alike(one: Rig, other: Rig, most_deg: float = SAME_DEG, most_m: float = SAME_M) -> bool:
    """Whether two poses of the second camera in the first are near to each other."""
    metres, degrees = one.pose(1).apart(other.pose(1))
    return degrees < most_deg and metres < most_m


Pair = tuple[int, int]
Fits = Mapping[Pair, list[PairFit]]
"""Cameras a < b -> poses of b in a that differ, the best first."""

LEAST_SHARE = 0.5
"""A pose that explains less of what two cameras see is no link between them."""
LEAST_FITTING = 10
NEAR_LAGS = np.arange(-3.0, 3.1, 0.2).tolist()
"""s. Whoever walks is off by 12 cm at half the step, and still fits."""
PAIR_INSTANTS = 100
"""Instants at which two cameras are compared."""
SAME_SHARE, SAME_FITTING, SAME_MOTION = 0.6, 20, 0.65
"""The best pose that strangers give: at most .59 of what two cameras see fits, or it fits for a
few instants. The same people: .6 to 1, with velocities that correlate by .7 to .98."""
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
        (pair for pair, tried in fits.items() if usable(tried)),
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
        tried = [0.0, lags[b] - lags[a], *(-lag for lag, _ in candidates), *NEAR_LAGS]
        pair = [views[a], views[b]]
        fits[a, b] = [best_lag(pair, rig.select([a, b]).anchored(), tried, mirror)]
    tree, _ = spanning_tree(fits, list(range(len(views))))
    return chained(tree, fits, len(views)).clocks


def seen_elsewhere(
    camera: int, group: Collection[int], views: Sequence[CameraView], given: Rig,
    landmarks: Landmarks, mirror: Ints,
) -> str:  # fmt: skip
    """Return the camera that shows the same people as ``camera``, if this stood elsewhere.

    Cameras that see different people have none ("" then): no pose makes strangers fit for long.

    Parameters
    ----------
    group : cameras that are not asked. views : of all cameras, whose clocks are about right.
    given : their poses.
    """
    signatures = [signatures_of(view, landmarks) for view in views]
    for partner, view in enumerate(views):
        lags = (
            lag_candidates(signatures[partner], signatures[camera]) if partner not in group else []
        )
        at_once = [(lag, pairs) for lag, pairs in lags if abs(lag) < SAME_S]
        if not at_once:
            continue
        pair = [view, views[camera]]
        fits = register_pair(pair, at_once, instants_of(pair[:1], PAIR_INSTANTS), mirror)
        there = given.select([partner, camera]).anchored()
        if fits and _proves(fits[0]) and not alike(fits[0].rig, there):
            return view.name
    return ""


def _proves(fit: PairFit) -> bool:
    """Whether two cameras see the same people for so long that strangers would not fit."""
    return (
        fit.share >= SAME_SHARE
        and len(fit.distances) >= SAME_FITTING
        and fit.motion >= SAME_MOTION
        and fit.residual <= WRONG_M
    )


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
