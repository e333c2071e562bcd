"""How well the cameras agree about the people, once their poses and clocks are known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.joint_refinement import (
    BLOCK_S,
    CAUCHY,
    Points,
    RigResiduals,
    common_motion,
)
from hiros_mcap.calibrate.pair_pose import FIT_M
from hiros_mcap.calibrate.robust import robust_kabsch
from hiros_mcap.calibrate.sampling import Rig, group, placed, sample
from hiros_mcap.skeletons import Floats, Ints, Stamps

WHOLE = 8
"""Bodies are compared by at least so many joints."""


class Bodies(NamedTuple):
    """How each camera's people compare with the same people in the other cameras, (C,) each."""

    sizes: Floats
    """Ratio of their sizes, the root mean square distance of joints from the body's middle."""
    wander: Floats
    """Median distance of the bodies' middles, m."""
    limbs: Floats
    """Correlation of the joints' velocities against the body's middle, -1 to 1."""
    postures: Floats
    """The same of the joints' places, less their means over time; 0 if nobody moves."""
    mirrors: Floats
    """By how many standard errors the best mirror fits worse than the pose."""


class SharedView(NamedTuple):
    """What C cameras have in common."""

    common: Floats
    """(C, C) skeletons that could be the same: the fewer of both cameras, over all instants."""
    fitting: Floats
    """(C, C) those that are."""
    seconds: Floats
    """(C,) s in which another camera sees the same people."""
    spread: Floats
    """(C,) how far these people move about, m."""
    people: Floats
    """(C,) how many of them there are at a time."""


def shared_view(
    views: Sequence[CameraView], rig: Rig, instants: Floats, mirror: Ints
) -> SharedView:
    """Count what the cameras could have in common, and what they have, at (K,) instants, s."""
    samples = sample(views, instants, rig)
    places = placed(samples, rig)
    groups = group(samples, places, mirror, FIT_M)
    n = len(views)
    seen = np.zeros((n, len(instants)))
    np.add.at(seen, (samples.cameras, samples.instants), 1.0)
    people = np.zeros((n, len(samples.cameras)), np.bool_)  # camera, first row of a person
    people[samples.cameras, groups.people] = True
    fitting = people.astype(np.float64) @ people.T
    common = np.array([[np.minimum(a, b).sum() for b in seen] for a in seen])
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
    return SharedView(common, fitting, seconds, spread, company)


def compare_bodies(residuals: RigResiduals, points: Points, mirror: Ints) -> Bodies:
    """Compare whole bodies, where :func:`camera_distances` compares joints.

    Two people who walk alike at the same time may fit each other joint by joint. But they are not
    of one size, their middles drift apart, or their limbs swing out of step. Somebody seen in a
    mirror fits himself if he stays in place and moves left and right alike, but then a reflection
    fits as well.
    """
    n = len(residuals.weights)
    total = residuals.weights.sum(axis=0)
    sizes, wander, inside = np.ones(n), np.full(n, np.inf), residuals.velocities.copy()
    postures, mirrors = np.zeros(n), np.zeros(n)
    for c, weights in enumerate(residuals.weights):
        rest = total - weights
        seen = np.flatnonzero((weights > 0.0) & (rest > 1e-12))
        whole = np.bincount(points.people[seen], minlength=1) >= WHOLE
        kept = seen[whole[points.people[seen]]]
        if not len(kept):
            continue
        people = np.unique(points.people[kept], return_inverse=True)[1]
        apart = residuals.offsets[c, kept] * (total[kept] / rest[kept])[:, None]
        own = residuals.means[kept] + residuals.offsets[c, kept]
        other = own - apart
        sure = np.minimum(weights, rest)[kept, None]
        spans = [np.sum(sure * (one - _middles(one, people)[people]) ** 2) for one in (own, other)]
        sizes[c] = np.sqrt(spans[0] / spans[1])
        wander[c] = np.median(np.linalg.norm(_middles(apart, people), axis=1))
        speeds = residuals.velocities[c, kept]
        inside[c, kept] = speeds - _middles(speeds, people)[people]
        inner, outer = (one - _middles(one, people)[people] for one in (own, other))
        # Robust weights would favour the pose that they are from.
        plain = points.weights[:, kept]
        plain = np.minimum(plain[c], plain.sum(axis=0) - plain[c])
        postures[c] = _correlation(inner, outer, plain[:, None], points.joints[kept])
        cells = people * len(mirror) + points.joints[kept], points.seconds[kept]
        mirrors[c] = _mirror_margin(own, other, plain, cells, mirror)
    limbs = common_motion(residuals._replace(velocities=inside))
    return Bodies(sizes, wander, limbs, postures, mirrors)


def _correlation(ones: Floats, others: Floats, weights: Floats, joints: Stamps) -> float:
    """Correlation of (P, 3) places of joints, less the mean of each joint, -1 to 1."""
    mass = np.maximum(np.bincount(joints, weights[:, 0]), 1e-12)[:, None]
    moves = []
    for places in (ones, others):
        sums = np.zeros((len(mass), 3))
        np.add.at(sums, joints, weights * places)
        moves.append(places - (sums / mass)[joints])
    norm = np.sqrt(np.prod([np.sum(weights * each**2) for each in moves]))
    return float(np.sum(weights * moves[0] * moves[1]) / norm) if norm > 0.0 else 0.0


def _mirror_margin(
    own: Floats, other: Floats, weights: Floats, cells: tuple[Stamps, Floats], mirror: Ints
) -> float:
    """Return by how many standard errors the best reflection of a camera fits worse than its pose.

    A detector labels the sides of a mirror image as it sees them, or as they are: both are tried.
    The errors of a detector belong to joints and last for seconds, so the losses are compared by
    pairs of joints, and by blocks of time.

    Parameters
    ----------
    own, other : (P, 3) joints by this camera and by the others, m. weights : (P,).
    cells : (P,) person times the number of joints plus joint, and time, s.
    """
    places, seconds = cells
    joints = places % len(mirror)
    rows = np.full(places.max() + len(mirror), -1)
    rows[places] = np.arange(len(places))
    swapped = rows[places - joints + mirror[joints]]
    both = swapped >= 0
    turn, shift = robust_kabsch(own, other, weights)
    errors = other - own @ turn.T - shift
    scale = CAUCHY * float(np.median(np.linalg.norm(errors, axis=1)))
    loss = np.log1p(np.sum(errors**2, axis=1) / scale**2)
    pairs = np.unique(np.minimum(joints, mirror[joints]), return_inverse=True)[1]
    blocks = np.unique(np.floor(seconds / BLOCK_S), return_inverse=True)[1]
    margins = []
    for source in (own, own[swapped]):
        turn, shift = robust_kabsch(source[both], other[both], weights[both], mirrors=True)
        errors = other[both] - source[both] @ turn.T - shift
        worse = weights[both] * (np.log1p(np.sum(errors**2, axis=1) / scale**2) - loss[both])
        for clusters in (pairs[both], blocks[both]):
            sums = np.bincount(clusters, worse)
            error = float(np.std(sums, ddof=1) * np.sqrt(len(sums))) if len(sums) > 1 else np.inf
            margins.append(float(sums.sum()) / max(error, 1e-12))
    return min(margins)


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
