"""How well cameras fit each other, and what speaks against poses found without a first guess.

Cameras are joined by motion: whoever moves alike at the same time is taken for the same person.
That tells people apart only if they do not all move alike. The motion of the people themselves
shows it. Somebody who walks round and round at one pace fits himself at another time, after a
rotation and a shift. A stranger who does the same would fit him as closely. Then only the paths can
tell: the same person's differ by no more than the joints' errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hiros_mcap.body.rotations import angle, from_matrix
from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.joint_refinement import (
    GATES_M,
    Points,
    Refinement,
    common_motion,
    refine,
)
from hiros_mcap.calibrate.pair_pose import FIT_M
from hiros_mcap.calibrate.registration import robust_kabsch
from hiros_mcap.calibrate.sampling import Rig, group, placed, sample
from hiros_mcap.calibrate.verdict import SHARE_VARIANCE, Evidence
from hiros_mcap.kernels.rig_equations import RigResiduals
from hiros_mcap.rays.image_tracks import lines_at
from hiros_mcap.skeletons import Flags, Floats, Ints, Stamps

WHOLE = 8
"""Bodies are compared by at least so many joints."""
NEARBY_M = 0.75
"""A camera that showed somebody within this looks at a place: people go so far between two of the
instants that are compared."""
_REACH = 3  # cells that it reaches: places are rounded to cells of a third of it, 25 cm


def shared_view(
    views: Sequence[CameraView], rig: Rig, instants: Floats, mirror: Ints, *, known: bool = False
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Count what C cameras could have in common, and what they have, at (K,) instants, s.

    Parameters
    ----------
    known : whether somebody measured where the cameras stand. Then these have in common only whom
        both look at. Poses that are to be found would choose for themselves what counts.

    Returns
    -------
    (C, C) skeletons that could be the same, over all instants.
    (C, C) those that are.
    (C,) s in which another camera sees the same people.
    (C,) how far these people move about, m.
    (C,) how many of them there are at a time.
    """
    samples = sample(views, instants, rig)
    places = placed(samples, rig)
    groups = group(samples, places, mirror, FIT_M)
    n = len(views)
    people = np.zeros((n, len(samples.cameras)), np.bool_)  # camera, first row of a person
    people[samples.cameras, groups.people] = True
    fitting = people.astype(np.float64) @ people.T
    weights = samples.lines.weights > 0.0
    middles = (places * weights[:, :, None]).sum(axis=1) / weights.sum(axis=1)[:, None]
    looks = _looks_at(middles, samples.cameras, n) if known else np.ones_like(people)
    common = fitting + _could_fit(people, samples.instants, looks)
    cell = float(np.median(np.diff(instants))) if len(instants) > 1 else 0.0
    seconds, spread, company = np.zeros(n), np.zeros(n), np.zeros(n)
    for c in range(n):
        both = people[c] & (people.sum(axis=0) > 1)
        together = len(np.unique(samples.instants[both]))
        seconds[c] = cell * together
        company[c] = np.count_nonzero(both) / max(together, 1)
        spread[c] = np.sqrt(middles[both].var(axis=0).sum()) if both.any() else 0.0
    return common, fitting, seconds, spread, company


def _looks_at(middles: Floats, cameras: Stamps, n_cameras: int) -> Flags:
    """(C, N) Whether a camera looks at a place: it has shown somebody there, at any time.

    Parameters
    ----------
    middles : (N, 3) of the skeletons in the common frame, m. cameras : (N,) that show them.

    Places are compared by cells: to import scipy's tree takes longer than all of this.
    """
    cells = np.clip(np.rint(middles * (_REACH / NEARBY_M)), -(2**18), 2**18).astype(np.int64)
    away = np.arange(-_REACH, _REACH + 1)
    steps = np.stack(np.meshgrid(away, away, away), axis=-1).reshape(-1, 3)
    steps = steps[(steps**2).sum(axis=1) <= _REACH**2]
    keys, further = (c @ np.array([2**40, 2**20, 1]) for c in (cells, steps))
    looks = np.zeros((n_cameras, len(middles)), np.bool_)
    for c in np.unique(cameras).tolist():
        reached = np.unique(keys[cameras == c])[:, None] + further
        looks[c] = np.isin(keys, reached)
    return looks


def _could_fit(people: Flags, instants: Stamps, looks: Flags) -> Floats:
    """(C, C) Skeletons of two cameras that do not fit, and could be the same person.

    Two people are different if a third camera sees both, or if one of the cameras does not look
    where the other one sees its person. Otherwise the fewer of both cameras count.

    Parameters
    ----------
    people : (C, N) which cameras see a person, at the person's first row; none at other rows.
    instants : (N,) of the rows, never decreasing.
    looks : (C, N) whether a camera looks where a row's person is.
    """
    left = np.zeros((len(people), len(people)))
    rows = np.flatnonzero(people.any(axis=0))
    starts = np.flatnonzero(np.diff(instants[rows], prepend=-1))
    for at_once in np.split(rows, starts[1:]):
        seen = people[:, at_once].astype(np.float64)
        # (C, C, G) who is seen by the first, not by the second, which looks there
        alone = seen[:, None] * (1.0 - seen) * looks[:, at_once]
        perhaps_same = (seen.T @ seen == 0.0).astype(np.float64)
        partners = np.swapaxes(alone, 0, 1) @ perhaps_same
        count = (alone * (partners > 0.0)).sum(axis=2)
        left += np.minimum(count, count.T)
    return left


def compare_bodies(residuals: RigResiduals, points: Points) -> tuple[Floats, Floats, Floats]:
    """Compare whole bodies, where :func:`camera_distances` compares joints.

    Two people who walk alike at the same time may fit each other joint by joint. But they are not
    of one size, their middles drift apart, or their limbs swing out of step.

    Returns, (C,) each, how every camera's people compare with the same people in the others: the
    ratio of their sizes, the root mean square distance of joints from the body's middle; the median
    distance of the bodies' middles, m; the correlation of the joints' velocities against the body's
    middle, -1 to 1.
    """
    n = len(residuals.weights)
    sizes, wander, inside = np.ones(n), np.full(n, np.inf), residuals.velocities.copy()
    for c, (seen, apart, sure) in enumerate(residuals.against_others()):
        whole = (np.bincount(points.people[seen], minlength=1) >= WHOLE)[points.people[seen]]
        kept, apart, sure = seen[whole], apart[whole], sure[whole, None]
        if not len(kept):
            continue
        people = np.unique(points.people[kept], return_inverse=True)[1]
        n_people = int(people.max()) + 1
        here = residuals.means[kept] + residuals.offsets[c, kept]
        other = here - apart
        middles = (_means(p, people, n_people)[people] for p in (here, other))
        spans = [np.sum(sure * (p - m) ** 2) for p, m in zip((here, other), middles, strict=True)]
        sizes[c] = np.sqrt(spans[0] / spans[1])
        wander[c] = np.median(np.linalg.norm(_means(apart, people, n_people), axis=1))
        speeds = residuals.velocities[c, kept]
        inside[c, kept] = speeds - _means(speeds, people, n_people)[people]
    limbs = common_motion(residuals._replace(velocities=inside))
    return sizes, wander, limbs


def _means(vectors: Floats, groups: Stamps, n: int) -> Floats:
    """(n, 3) mean of the vectors of each group; NaN without any."""
    sums, counts = np.zeros((n, 3)), np.bincount(groups, minlength=n)
    np.add.at(sums, groups, vectors)
    with np.errstate(invalid="ignore"):
        return np.asarray(sums / counts[:, None])


def camera_distances(residuals: RigResiduals) -> Floats:
    """(C, P) distance of each camera's joint to the mean of the other cameras', m; NaN unseen."""
    total = residuals.weights.sum(axis=0)
    rest = np.maximum(total - residuals.weights, 1e-12)
    return np.asarray(residuals.distances * total / rest)


STEP_S = 0.05
LAGS_S = 0.6, 5.0
"""A shorter lag is the same moment; strangers are not searched at a longer one."""
MOVING_M_S = 0.3
"""Of the body's middle. Who stands still fits himself at any time."""
LEAST_S = 4.0
"""Of motion."""
MOST_INSTANTS = 40
"""Enough to compare paths."""
ROUNDS = 2
WINDOW_S = 1.0
"""Paths are compared by their means over it: most of the joints' noise is gone then."""


def evidence_of(refined: Refinement, mirror: Ints, *, known: bool = False) -> list[Evidence]:
    """Gather how well each camera fits the others.

    ``known`` : as in :func:`shared_view`.
    """
    common, fitting, seconds, spread, people = shared_view(
        refined.views, refined.rig, refined.instants, mirror, known=known
    )
    distances = camera_distances(refined.residuals)
    evidence = []
    unknowns = refined.errors
    for c in range(len(refined.views)):
        others = np.arange(len(refined.views)) != c
        most = common[c, others].sum()
        apart = distances[c][~np.isnan(distances[c])]
        evidence.append(
            Evidence(
                share=float(fitting[c, others].sum() / most) if most else 0.0,
                share_error=float(np.sqrt(SHARE_VARIANCE / most)) if most and known else 0.0,
                residual=float(np.median(apart)) if len(apart) else np.inf,
                seconds=float(seconds[c]),
                spread=float(spread[c]),
                people=float(people[c]),
                error_deg=float(np.degrees(np.linalg.norm(unknowns[c, :3]))),
                error_m=float(np.linalg.norm(unknowns[c, 3:6])),
                partner=refined.views[int(np.where(others, common[c], -1.0).argmax())].name,
            )
        )
    return evidence


def full_evidence(refined: Refinement, mirror: Ints, rivals: Sequence[bool]) -> list[Evidence]:
    """Gather all evidence, also that strangers might pass for the same person.

    Parameters
    ----------
    rivals : whether the pose by which each camera was found is ambiguous.
    """
    halves = _halves(refined, mirror)
    sizes, wander, limbs = compare_bodies(refined.residuals, refined.points)
    paths = path_distances(refined.residuals, refined.points)
    clocks = refined.rig.clocks
    return [
        replace(
            one,
            rival=rivals[c],
            halves_deg=float(halves[c]),
            size=float(sizes[c]),
            wander=float(wander[c]),
            limbs=float(limbs[c]) if refined.timed[c] else 1.0,
            path=float(paths[c]),
            repetition=closest_repetition(refined.views[c]),
            late=float(np.abs(np.delete(clocks, c) - clocks[c]).min()) * bool(refined.timed[c]),
        )
        for c, one in enumerate(evidence_of(refined, mirror))
    ]


def _halves(refined: Refinement, mirror: Ints) -> Floats:
    """(C,) angle, degrees, between the orientations that the halves of the log give.

    They are compared with that camera to which the others keep their orientations best.
    """
    middle = len(refined.instants) // 2
    first, second = (
        refine(refined.views, refined.rig, part, mirror, free=refined.free, gates=GATES_M[2:])[
            0
        ].rotations
        for part in (refined.instants[:middle], refined.instants[middle:])
    )
    angles = np.array(
        [
            angle(from_matrix(one.T @ first), from_matrix(other.T @ second))
            for one, other in zip(first, second, strict=True)
        ]
    )
    return np.asarray(np.degrees(angles[int(angles.sum(axis=1).argmin())]))


def closest_repetition(view: CameraView) -> float:
    """Return how closely the people of a camera fit themselves at another time, m.

    All of them are moved by one rotation and one shift, as another camera would see them. The
    distance is the median of the bodies' middles while they move, at the lag where it is least;
    infinite if they move too little to tell.
    """
    series = [_poses(view, k) for k in range(len(view.tracks))]
    first, last = (round(lag / STEP_S) for lag in LAGS_S)
    coarse = {lag: _distance(series, lag) for lag in range(first, last + 1, 2)}
    best = min(coarse, key=lambda lag: coarse[lag])
    return min(coarse[best], *(_distance(series, lag) for lag in (best - 1, best + 1)))


def _poses(view: CameraView, track: int) -> Floats:
    """(K, M, 3) of a tracklet at 20 Hz; NaN where it stands still, or a joint is not seen."""
    seconds = view.tracks[track].seconds
    times: Floats = np.arange(seconds[0], seconds[-1], STEP_S)
    lines = lines_at(view.tracks[track], times, view.half_width)
    seen = lines.weights > 0.0
    total = np.maximum(seen.sum(axis=1), 1)[:, None]
    speed = np.linalg.norm((lines.velocities * seen[:, :, None]).sum(axis=1) / total, axis=1)
    kept = seen & (speed > MOVING_M_S)[:, None]
    return np.where(kept[:, :, None], lines.positions, np.nan)


def _distance(series: list[Floats], lag: int) -> float:
    """Return how far the people are from themselves ``lag`` steps later."""
    long = [poses for poses in series if len(poses) > lag]
    if not long:
        return np.inf
    now = np.concatenate([poses[:-lag] for poses in long])
    later = np.concatenate([poses[lag:] for poses in long])
    present = ~np.isnan(now[:, :, 0] + later[:, :, 0])
    moving = np.flatnonzero(present.any(axis=1))
    if STEP_S * len(moving) < LEAST_S:
        return np.inf
    some = moving[:: -(-len(moving) // MOST_INSTANTS)]
    now, later, present = now[some], later[some], present[some]
    source, goal = now[present], later[present]
    rotation, shift = robust_kabsch(source, goal, np.ones(len(source)), ROUNDS)
    errors = goal - source @ rotation.T - shift
    middles = _means(errors, np.nonzero(present)[0], len(now))
    return float(np.median(np.linalg.norm(middles, axis=1)))


def path_distances(residuals: RigResiduals, points: Points) -> Floats:
    """Return how far each camera's people walk beside the same people in the others, (C,) m.

    It is the median over windows of 1 s in which they move, less what the joints' errors explain:
    these differ from joint to joint, but another path moves all joints alike.
    """
    moving = np.linalg.norm(residuals.mean_velocities, axis=1) > MOVING_M_S
    windows = np.floor((points.seconds - points.seconds.min(initial=0.0)) / WINDOW_S)
    n_markers = int(points.joints.max(initial=0)) + 1
    n_windows = int(windows.max(initial=0)) + 1
    cells = windows.astype(np.int64) * n_markers + points.joints
    distances = []
    for seen, apart, _ in residuals.against_others():
        kept = moving[seen]
        means = _means(apart[kept], cells[seen[kept]], n_markers * n_windows)
        distances.append(_common_part(means.reshape(-1, n_markers, 3)))
    return np.array(distances)


def _common_part(means: Floats) -> float:
    """Length of what (W, M, 3) offsets of joints have in common beyond their scatter, m."""
    n = (~np.isnan(means[:, :, 0])).sum(axis=1)
    means, n = means[n >= WHOLE], n[n >= WHOLE]
    if not len(n):
        return 0.0
    middles = np.nanmean(means, axis=1)
    scatter = np.nansum((means - middles[:, None]) ** 2, axis=(1, 2)) / (n * (n - 1))
    return float(np.sqrt(max(0.0, np.median(np.sum(middles**2, axis=1) - scatter))))
