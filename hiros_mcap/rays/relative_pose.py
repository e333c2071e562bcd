"""Poses and lags of RGB cameras from nothing but their lenses and the people whom they film.

1. Two cameras: at each lag of their clocks, a person of one and a person of the other are taken for
   the same. All their joints give an essential matrix (five points within RANSAC, Nister 2004).
   The other people tell how good it is. Where lag, people and pose are right, all rays meet.
2. Every other camera: the people whom the placed cameras see have joints in space. Resection (three
   points within RANSAC), at the lags that its pairs with placed cameras like, places the camera.
3. After each, poses and lags are refined together.

The size of the rig is not told: the first pair is one unit apart.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.intrinsics import opencv
from hiros_mcap.body.rotations import Rigid, from_matrix, from_vector
from hiros_mcap.kernels.ray_equations import RayCameras
from hiros_mcap.rays.bundle import cameras_at, poses_of, triangulated
from hiros_mcap.rays.image_tracks import ImageView, Samples, instants_of, sample_images
from hiros_mcap.rays.matching import joints_of, match, ray_distances
from hiros_mcap.rays.rig_refinement import GATES, RigFit, fit_rig, free_unknowns
from hiros_mcap.skeletons import Flags, Floats, Stamps

LONGEST_LAG_S, STEP_S = 2.4, 0.1
"""Lags that are tried, of two cameras; a pose is hardly worse half a step away."""
CANDIDATES, APART_S = 4, 0.3
"""Lags that are kept of each pair; closer ones are the same."""
SEEDS = 3
"""Pairs to begin with that are tried."""
INSTANTS, ENOUGH = 150, 250
"""Instants that are looked at, and joints that are enough for a first pose."""
NEAR = 0.012
"""Distance, as x / z, at which a ray still speaks for a pose in RANSAC."""
CLOSE = 0.006
"""Distance, as x / z, at which a ray counts half in the score of a pose."""
PEOPLE, OTHERS = 2, 5
"""Tracklets of a camera, and of another one, that are tried as the same person."""
LEAST_JOINTS = 60
LEAST_ANGLE = np.radians(4.0)
"""Angle between the rays of two cameras, in the median, below which they tell no depth."""


class PairPose(NamedTuple):
    """Two cameras, one unit apart."""

    score: float
    """How many joints agree, less for rays at small angles."""
    second: Rigid
    """Pose of the second camera in the first one's optical frame."""
    lag: float
    """Time on the second camera's clock less that on the first one's, s."""
    who: Flags
    """(T, U) which tracklets of both are the same person."""


Pairs = dict[tuple[int, int], list[PairPose]]
"""Pair of cameras -> its poses, the best first."""


class FoundRig(NamedTuple):
    """Cameras that see the same people; the first one stands at the origin."""

    cameras: list[int]
    """Which of the views they are."""
    fit: RigFit
    rivalry: float
    """Share of a camera's rays that would agree as well at another lag; 1 = nothing tells which."""


def rig_from_people(views: Sequence[ImageView]) -> FoundRig | None:
    """Find poses and lags of cameras that see the same people; None if no two do."""
    cv2 = opencv()

    cv2.setRNGSeed(0)
    pairs = {pair: _pair_poses(views, pair) for pair in combinations(range(len(views)), 2)}
    seeds = [
        (found.score, pair, k) for pair, every in pairs.items() for k, found in enumerate(every)
    ]
    best: FoundRig | None = None
    for _, pair, k in sorted(seeds, reverse=True)[:SEEDS]:
        rig = _grown(views, pairs, pair, pairs[pair][k])
        if rig and (best is None or _rank(rig) > _rank(best)):
            best = rig
    if best is None:
        return None
    return best._replace(rivalry=max(_rivalry(views, pairs, best, c) for c in best.cameras))


def _rank(rig: FoundRig) -> tuple[int, float]:
    return len(rig.cameras), rig.fit.fitting


def _pair_poses(views: Sequence[ImageView], pair: tuple[int, int]) -> list[PairPose]:
    """Return the best poses of the second camera of a pair before the first one, by lag."""
    two, every = [views[c] for c in pair], list[PairPose]()
    for lag in np.arange(-LONGEST_LAG_S, LONGEST_LAG_S + STEP_S / 2, STEP_S).tolist():
        common = _common_rays(two, np.array([0.0, lag]))
        trials = [_essential(common, who) for who in _alone(common)]
        if found := max(filter(None, trials), default=None, key=lambda trial: trial[0]):
            again = _essential(common, found[2])
            pose = _pose_of(common, *max(found, again or found, key=lambda trial: trial[0]), lag)
            every += [pose] if pose else []
    every.sort(key=lambda pose: -pose.score)
    kept = list[PairPose]()
    for pose in every:
        if all(abs(pose.lag - other.lag) > APART_S for other in kept):
            kept.append(pose)
    return kept[:CANDIDATES]


class _CommonRays(NamedTuple):
    """N joints that two cameras see at the same instants, of all pairs of tracklets."""

    ones: Floats
    """(N, 2)"""
    others: Floats
    """(N, 2)"""
    tracks: Stamps
    """(N, 2) tracklet in the first and in the second camera."""


def _common_rays(views: Sequence[ImageView], lags: Floats) -> _CommonRays:
    samples = sample_images(views, instants_of(views, INSTANTS, lags), lags)
    rays, known = samples.lines.positions[..., :2], samples.lines.weights > 0.0
    left, right = (np.flatnonzero(samples.cameras == c) for c in (0, 1))
    same = samples.instants[left][:, None] == samples.instants[right]
    at, to = np.nonzero(same)
    ones, others = left[at], right[to]
    both = known[ones] & known[others]
    tracks = np.stack([samples.tracks[ones], samples.tracks[others] - len(views[0].tracks)], axis=1)
    joints = np.broadcast_to(tracks[:, None], (*both.shape, 2))[both]
    return _CommonRays(rays[ones][both], rays[others][both], joints)


def _alone(common: _CommonRays) -> Iterator[Flags]:
    """Yield who may be who, (T, U): people whom one camera sees for long, and one of the other."""
    if not len(common.tracks):
        return
    counts = np.zeros(common.tracks.max(axis=0) + 1)
    np.add.at(counts, tuple(common.tracks.T), 1.0)
    for one in np.argsort(-counts.sum(axis=1), kind="stable")[:PEOPLE]:
        for other in np.argsort(-counts[one], kind="stable")[:OTHERS]:
            if counts[one, other] >= LEAST_JOINTS:
                who = np.zeros(counts.shape, np.bool_)
                who[one, other] = True
                yield who


def _mutual(scores: Floats) -> Flags:
    """Say who are best for each other, of (T, U) scores."""
    best = (scores >= scores.max(axis=0)) & (scores >= scores.max(axis=1, keepdims=True))
    return np.asarray(best & (scores > 0.0))


def _essential(common: _CommonRays, who: Flags) -> tuple[float, Floats, Flags] | None:
    """Find the essential matrix of two cameras by some people.

    Returns its score, the matrix, and who then is who.
    """
    cv2 = opencv()

    ones, others = _some(common, who)
    if len(ones) < LEAST_JOINTS:
        return None
    solved, _ = cv2.findEssentialMat(
        ones, others, np.eye(3), cv2.USAC_MAGSAC, 0.999, NEAR, maxIters=100
    )
    if solved is None or solved.shape != (3, 3):
        return None
    matrix = np.asarray(solved, np.float64)
    far = ray_distances(_whole(common.ones), _whole(common.others), matrix)
    scores = np.zeros(who.shape)
    np.add.at(scores, tuple(common.tracks.T), 1.0 / (1.0 + (far / CLOSE) ** 2))
    best = _mutual(scores)
    return float(scores[best].sum()), matrix, best


def _pose_of(
    common: _CommonRays, score: float, matrix: Floats, who: Flags, lag: float
) -> PairPose | None:
    """Return the one of the four poses of an essential matrix that has people before both cameras.

    None if the rays of both meet at so small angles that nothing tells where.
    """
    cv2 = opencv()

    ones, others = _some(common, who)
    near = np.flatnonzero(ray_distances(_whole(ones), _whole(others), matrix) < NEAR)
    if len(near) < LEAST_JOINTS:
        return None
    ones, others = ones[near], others[near]
    _, turn, shift, mask = cv2.recoverPose(matrix, ones, others, np.eye(3))
    good = mask.ravel() > 0
    rays, seen = _whole(ones[good]) @ turn.T, _whole(others[good])
    lengths = np.linalg.norm(rays, axis=1) * np.linalg.norm(seen, axis=1)
    angles = np.arccos(np.clip((rays * seen).sum(axis=1) / lengths, -1.0, 1.0))
    if np.count_nonzero(good) < LEAST_JOINTS or (angle := float(np.median(angles))) < LEAST_ANGLE:
        return None
    pose = Rigid(
        from_matrix(np.asarray(turn, np.float64)), np.ravel(shift).astype(np.float64)
    ).inverse()
    return PairPose(score * min(math.sin(angle), 0.5), pose, lag, who)


def _some(common: _CommonRays, who: Flags) -> tuple[Floats, Floats]:
    """(N, 2) rays of joints of some people in both cameras."""
    rows = np.flatnonzero(who[common.tracks[:, 0], common.tracks[:, 1]])
    rows = rows[:: 1 + len(rows) // ENOUGH]
    return np.ascontiguousarray(common.ones[rows]), np.ascontiguousarray(common.others[rows])


def _whole(rays: Floats) -> Floats:
    return np.concatenate([rays, np.ones((len(rays), 1))], axis=1)


def _grown(
    views: Sequence[ImageView], pairs: Pairs, pair: tuple[int, int], start: PairPose
) -> FoundRig | None:
    """Begin with two cameras, and place the others one after the other."""
    chosen = list(pair)
    fit = _fitted(views, chosen, [Rigid.identity(), start.second], [0.0, start.lag])
    while fit:
        rig = FoundRig(chosen, fit, 0.0)
        left = [c for c in range(len(views)) if c not in chosen]
        trials = [(trial, c) for c in left for trial in _resections(views, pairs, rig, c)]
        if not trials:
            return rig
        best, c = max(trials, key=lambda trial: trial[0].score)
        poses, lags = [*poses_of(fit.bundle.cameras), best.pose], [*fit.lags, best.lag]
        chosen, fit = [*chosen, c], _fitted(views, [*chosen, c], poses, lags)
    return None


def _rivalry(views: Sequence[ImageView], pairs: Pairs, rig: FoundRig, c: int) -> float:
    """Return how well a camera fits at another lag than the one it got, as a share."""
    kept = [k for k, camera in enumerate(rig.cameras) if camera != c]
    if len(kept) < 2:
        return 0.0
    bundle, lags = rig.fit.bundle, rig.fit.lags
    cameras = RayCameras(*(np.ascontiguousarray(table[kept]) for table in bundle.cameras))
    fit = rig.fit._replace(bundle=bundle._replace(cameras=cameras), lags=lags[kept])
    others = FoundRig([rig.cameras[k] for k in kept], fit, 0.0)
    trials = _resections(views, pairs, others, c)
    lag = lags[rig.cameras.index(c)]
    near, far = (
        max((t.score for t in trials if (abs(t.lag - lag) > APART_S) == apart), default=0.0)
        for apart in (False, True)
    )
    return far / near if near > 0.0 else 1.0


def _fitted(
    views: Sequence[ImageView],
    cameras: Sequence[int],
    poses: Sequence[Rigid],
    lags: Sequence[float],
) -> RigFit | None:
    """Refine some cameras together."""
    some = [views[c] for c in cameras]
    free = free_unknowns(some, clocks=True)
    return fit_rig(some, cameras_at(poses), np.array(lags), free)


class _Resection(NamedTuple):
    score: float
    """How many rays agree with the joints."""
    pose: Rigid
    lag: float
    """s."""


def _resections(
    views: Sequence[ImageView], pairs: Pairs, rig: FoundRig, c: int
) -> list[_Resection]:
    """Return poses and lags of one more camera, by each pair with a camera that is placed."""
    some, cameras, lags = [views[k] for k in rig.cameras], rig.fit.bundle.cameras, rig.fit.lags
    instants = instants_of(some, INSTANTS, lags)
    samples = sample_images(some, instants, lags)
    people = match(samples, cameras, GATES[-1])
    points, rows = joints_of(samples, people, len(some))
    numbers = np.unique(people)
    joints = np.full((len(instants), len(numbers), samples.lines.weights.shape[1], 3), np.nan)
    joints[rows[:, 0], np.searchsorted(numbers, rows[:, 1]), rows[:, 2]] = triangulated(
        points, cameras._replace(lags=np.zeros(len(some)))
    )
    owner = np.full(sum(len(view.tracks) for view in some), -1)
    owner[samples.tracks] = np.searchsorted(numbers, people)
    trials, begin = list[_Resection](), 0
    for k, lag in zip(rig.cameras, lags.tolist(), strict=True):
        owners = owner[begin : begin + len(views[k].tracks)]
        begin += len(owners)
        for pair in pairs[min(k, c), max(k, c)]:
            late = lag + (pair.lag if k < c else -pair.lag)
            seen = sample_images([views[c]], instants, np.array([late]))
            who = np.zeros((len(numbers), len(views[c].tracks)), np.bool_)
            for one, other in np.argwhere(pair.who if k < c else pair.who.T).tolist():
                who[owners[one], other] |= owners[one] >= 0
            found = _resection(seen, joints, who)
            if found := found and (_resection(seen, joints, found[2]) or found):
                trials.append(_Resection(found[0], found[1], late))
    return trials


def _resection(samples: Samples, joints: Floats, who: Flags) -> tuple[float, Rigid, Flags] | None:
    """Find the pose of a camera by some people, whose joints are known in space.

    Returns its score, the pose, and who then is who.

    Parameters
    ----------
    joints : (K, P, J, 3) at instants, NaN = unknown. who : (P, U) which tracklets are whose.
    """
    cv2 = opencv()

    at, people = np.nonzero(who.T[samples.tracks])
    places, rays = joints[samples.instants[at], people], samples.lines.positions[at][..., :2]
    known = (samples.lines.weights[at] > 0.0) & np.isfinite(places[..., 0])
    places, rays = places[known], rays[known]
    step = 1 + len(places) // ENOUGH
    places, rays = np.ascontiguousarray(places[::step]), np.ascontiguousarray(rays[::step])
    if len(places) < LEAST_JOINTS:
        return None
    fine, turn, shift, inliers = cv2.solvePnPRansac(
        places, rays, np.eye(3), None, iterationsCount=200, reprojectionError=NEAR,
        confidence=0.999, flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not fine or inliers is None or len(inliers) < LEAST_JOINTS:
        return None
    vector, place = np.array([turn, shift], np.float64)[:, :, 0]
    pose = Rigid(from_vector(vector), place)
    before = pose.moved(joints[samples.instants])  # (N, P, J, 3)
    away = before[..., :2] / before[..., 2:] - samples.lines.positions[:, None, :, :2]
    close = 1.0 / (1.0 + (away**2).sum(axis=-1) / CLOSE**2)
    close[(before[..., 2] <= 0.0) | (samples.lines.weights[:, None] <= 0.0)] = 0.0
    scores = np.zeros(who.shape)
    np.add.at(scores.T, samples.tracks, np.nansum(close, axis=2))
    best = _mutual(scores)
    return float(scores[best].sum()), pose.inverse(), best
