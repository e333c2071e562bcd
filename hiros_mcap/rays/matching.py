"""Who is who across RGB cameras, by poses that are about right: the distances of their rays.

Tracklets are compared, not images: whom a camera sees for a second or two is one person. Those of
different cameras are joined as long as their rays meet, the nearest first (average linkage), so a
pair of cameras that face each other and meet anywhere is outvoted by the others.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from hiros_mcap.kernels.ray_equations import RayCameras, RayPoints
from hiros_mcap.rays.image_tracks import Samples
from hiros_mcap.skeletons import Floats, Stamps

LEAST_COMMON = 3
"""Instants at which both cameras see a person, before they are compared."""
_NEVER = 1e6


def essential(cameras: RayCameras, a: int, b: int) -> Floats:
    """(3, 3) the matrix E of two cameras: x_b' E x_a = 0 for both rays of a joint."""
    turn = cameras.rotations[b] @ cameras.rotations[a].T
    x, y, z = cameras.shifts[b] - turn @ cameras.shifts[a]
    return np.asarray(np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ turn)


def ray_distances(ones: Floats, others: Floats, matrix: Floats) -> Floats:
    """(...) how far rays (..., 3) of two cameras are from meeting (Sampson), in units of a ray."""
    left, right = ones @ matrix.T, others @ matrix
    squares = (left[..., :2] ** 2).sum(axis=-1) + (right[..., :2] ** 2).sum(axis=-1)
    return np.asarray(np.abs((others * left).sum(axis=-1)) / np.sqrt(squares + 1e-18))


def track_costs(samples: Samples, cameras: RayCameras) -> tuple[Floats, Floats]:
    """(T, T) mean distance of the rays of two tracklets, and the instants that they have in common.

    Of an instant, it is the median over the joints.
    """
    n = int(samples.tracks.max(initial=-1)) + 1
    sums, counts = np.zeros((n, n)), np.zeros((n, n))
    by_camera = [np.flatnonzero(samples.cameras == c) for c in range(len(cameras.scales))]
    for a, b in combinations(range(len(by_camera)), 2):
        ones, others = by_camera[a], by_camera[b]
        same = samples.instants[ones][:, None] == samples.instants[others]
        left, right = np.nonzero(same)
        i, j = ones[left], others[right]
        positions, weights = samples.lines.positions, samples.lines.weights
        far = ray_distances(positions[i], positions[j], essential(cameras, a, b))
        far[(weights[i] <= 0.0) | (weights[j] <= 0.0)] = np.nan
        enough = np.isfinite(far).sum(axis=1) >= 3
        i, j, medians = i[enough], j[enough], np.nanmedian(far[enough], axis=1)
        pair = samples.tracks[i], samples.tracks[j]
        np.add.at(sums, pair, medians)
        np.add.at(counts, pair, 1.0)
    counts = counts + counts.T
    return (sums + sums.T) / np.maximum(counts, 1.0), counts


def match(samples: Samples, cameras: RayCameras, gate: float) -> Stamps:
    """(N,) number of each sample's person: joined tracklets of all cameras.

    Parameters
    ----------
    gate : largest mean distance of rays, as x / z.
    """
    costs, counts = track_costs(samples, cameras)
    n = len(costs)
    person = np.arange(n)
    clash = np.zeros((n, n), np.bool_)  # two people in one image
    key = samples.cameras * (int(samples.instants.max(initial=0)) + 1) + samples.instants
    order = np.argsort(key, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        tracks = samples.tracks[rows]
        clash[np.ix_(tracks, tracks)] = True
    np.fill_diagonal(clash, False)
    totals = np.where(counts >= LEAST_COMMON, costs * counts, 0.0)
    counts = np.where(counts >= LEAST_COMMON, counts, 0.0)
    while n:
        means = np.where((counts > 0.0) & ~clash, totals / np.maximum(counts, 1.0), _NEVER)
        i, j = divmod(int(means.argmin()), n)
        if means[i, j] > gate:
            break
        person[person == j] = i
        for table in (totals, counts):
            table[i] += table[j]
            table[:, i] += table[:, j]
            table[j] = table[:, j] = table[i, i] = 0.0
        clash[i] |= clash[j]
        clash[:, i] |= clash[:, j]
    return person[samples.tracks]


def joints_of(samples: Samples, people: Stamps, n_cameras: int) -> tuple[RayPoints, Stamps]:
    """Return joints that two cameras see, and (P, 3) instant, person and joint of each."""
    keys = np.stack([samples.instants, people], axis=1)
    groups, rows = np.unique(keys, axis=0, return_inverse=True)
    joints = samples.lines.weights.shape[1]
    rays = np.zeros((len(groups), joints, n_cameras, 2))
    velocities, weights = np.zeros_like(rays), np.zeros(rays.shape[:3])
    at = rows.ravel(), slice(None), samples.cameras
    rays[at] = samples.lines.positions[..., :2]
    velocities[at] = samples.lines.velocities[..., :2]
    information = samples.lines.weights
    usual = np.median(information[information > 0.0]) if len(rows) else 1.0
    weights[at] = np.minimum(information / usual, 1.0)
    group, joint = np.nonzero(np.count_nonzero(weights > 0.0, axis=2) > 1)
    seen, moving, known = (table[group, joint] for table in (rays, velocities, weights))
    points = RayPoints(seen, moving, known)
    return points, np.column_stack([groups[group], joint])
