"""What speaks for and against poses that the people gave without a first guess.

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
from hiros_mcap.calibrate.agreement import WHOLE, compare_bodies
from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.joint_refinement import GATES_M, Points, RigResiduals, refine
from hiros_mcap.calibrate.refinement import Refinement, evidence_of
from hiros_mcap.calibrate.registration import robust_kabsch
from hiros_mcap.calibrate.sampling import lines_of
from hiros_mcap.calibrate.verdict import Evidence
from hiros_mcap.skeletons import Floats, Ints, Stamps

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
    lines = lines_of(view, track, times)
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
    sums = np.zeros((len(now), 3))
    np.add.at(sums, np.nonzero(present)[0], errors)
    middles = sums / present.sum(axis=1)[:, None]
    return float(np.median(np.linalg.norm(middles, axis=1)))


def path_distances(residuals: RigResiduals, points: Points) -> Floats:
    """Return how far each camera's people walk beside the same people in the others, (C,) m.

    It is the median over windows of 1 s in which they move, less what the joints' errors explain:
    these differ from joint to joint, but another path moves all joints alike.
    """
    moving = np.linalg.norm(residuals.mean_velocities, axis=1) > MOVING_M_S
    windows = np.floor((points.seconds - points.seconds.min(initial=0.0)) / WINDOW_S)
    n_markers = int(points.joints.max(initial=0)) + 1
    cells = windows.astype(np.int64) * n_markers + points.joints
    distances = []
    for seen, apart, _ in residuals.against_others():
        kept = moving[seen]
        distances.append(_common_part(_cell_means(cells[seen[kept]], apart[kept], n_markers)))
    return np.array(distances)


def _cell_means(cells: Stamps, vectors: Floats, n_markers: int) -> Floats:
    """(W, M, 3) mean in each window of each joint; NaN without any."""
    rows = n_markers * (int(cells.max(initial=-1)) // n_markers + 1)
    counts = np.bincount(cells, minlength=rows)
    sums = np.zeros((rows, 3))
    np.add.at(sums, cells, vectors)
    sums[counts == 0] = np.nan
    return np.asarray((sums / np.maximum(counts, 1)[:, None]).reshape(-1, n_markers, 3))


def _common_part(means: Floats) -> float:
    """Length of what (W, M, 3) offsets of joints have in common beyond their scatter, m."""
    n = (~np.isnan(means[:, :, 0])).sum(axis=1)
    means, n = means[n >= WHOLE], n[n >= WHOLE]
    if not len(n):
        return 0.0
    middles = np.nanmean(means, axis=1)
    scatter = np.nansum((means - middles[:, None]) ** 2, axis=(1, 2)) / (n * (n - 1))
    return float(np.sqrt(max(0.0, np.median(np.sum(middles**2, axis=1) - scatter))))
