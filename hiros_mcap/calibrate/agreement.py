"""How well the cameras agree about the people, once their poses and clocks are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.joint_refinement import Points, RigResiduals, common_motion
from hiros_mcap.calibrate.pair_pose import FIT_M
from hiros_mcap.calibrate.sampling import Rig, group, placed, sample
from hiros_mcap.skeletons import Flags, Floats, Ints, Stamps

WHOLE = 8
"""Bodies are compared by at least so many joints."""


def shared_view(
    views: Sequence[CameraView], rig: Rig, instants: Floats, mirror: Ints
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Count what C cameras could have in common, and what they have, at (K,) instants, s.

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
    common = fitting + _could_fit(people, samples.instants)
    cell = float(np.median(np.diff(instants))) if len(instants) > 1 else 0.0
    weights = samples.lines.weights > 0.0
    middles = (places * weights[:, :, None]).sum(axis=1) / weights.sum(axis=1)[:, None]
    seconds, spread, company = np.zeros(n), np.zeros(n), np.zeros(n)
    for c in range(n):
        both = people[c] & (people.sum(axis=0) > 1)
        together = len(np.unique(samples.instants[both]))
        seconds[c] = cell * together
        company[c] = np.count_nonzero(both) / max(together, 1)
        spread[c] = np.sqrt(middles[both].var(axis=0).sum()) if both.any() else 0.0
    return common, fitting, seconds, spread, company


def _could_fit(people: Flags, instants: Stamps) -> Floats:
    """(C, C) Skeletons of two cameras that do not fit, and could be the same person.

    Two people are different if a third camera sees both. Otherwise the fewer of both cameras count.

    Parameters
    ----------
    people : (C, N) which cameras see a person, at the person's first row; none at other rows.
    instants : (N,) of the rows, never decreasing.
    """
    left = np.zeros((len(people), len(people)))
    rows = np.flatnonzero(people.any(axis=0))
    starts = np.flatnonzero(np.diff(instants[rows], prepend=-1))
    for at_once in np.split(rows, starts[1:]):
        seen = people[:, at_once].astype(np.float64)
        alone = seen[:, None] * (1.0 - seen)  # (C, C, G) who is seen by the first, not the second
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
        here = residuals.means[kept] + residuals.offsets[c, kept]
        other = here - apart
        spans = [np.sum(sure * (p - _middles(p, people)[people]) ** 2) for p in (here, other)]
        sizes[c] = np.sqrt(spans[0] / spans[1])
        wander[c] = np.median(np.linalg.norm(_middles(apart, people), axis=1))
        speeds = residuals.velocities[c, kept]
        inside[c, kept] = speeds - _middles(speeds, people)[people]
    limbs = common_motion(residuals._replace(velocities=inside))
    return sizes, wander, limbs


def _middles(numbers: Floats, people: Stamps) -> Floats:
    """(G, 3) mean of each person's points."""
    sums = np.zeros((int(people.max()) + 1, 3))
    np.add.at(sums, people, numbers)
    return np.asarray(sums / np.bincount(people)[:, None])


def camera_distances(residuals: RigResiduals) -> Floats:
    """(C, P) distance of each camera's joint to the mean of the other cameras', m; NaN unseen."""
    total = residuals.weights.sum(axis=0)
    rest = np.maximum(total - residuals.weights, 1e-12)
    return np.asarray(residuals.distances * total / rest)
