"""The joint refinement of some cameras, and what speaks for and against its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.joint_refinement import (
    GATES_M,
    Points,
    RigResiduals,
    common_motion,
    free_unknowns,
    refine,
    residuals_of,
    standard_errors,
)
from hiros_mcap.calibrate.pair_pose import FIT_M, LEAST_MOTION
from hiros_mcap.calibrate.sampling import Rig, group, instants_of, placed, sample
from hiros_mcap.calibrate.verdict import Evidence
from hiros_mcap.skeletons import Flags, Floats, Ints, Stamps

INSTANTS = 400
"""Of the joint refinement."""
DRIFT_S = 120.0
"""In a shorter log the drift of a clock cannot be told from its offset."""
LEAST_POINTS = 100
WHOLE = 8
"""Bodies are compared by at least so many joints."""


class Found(NamedTuple):
    """Poses and clocks of C cameras, refined together; the first one is at the origin."""

    rig: Rig
    points: Points
    residuals: RigResiduals
    errors: Floats
    """(C, 8) standard errors, see :func:`standard_errors`."""
    timed: Flags
    """(C,) whether motion tells the camera's clock."""
    evidence: list[Evidence]


class Bodies(NamedTuple):
    """How each camera's people compare with the same people in the other cameras, (C,) each."""

    sizes: Floats
    """Ratio of their sizes, the root mean square distance of joints from the body's middle."""
    wander: Floats
    """Median distance of the bodies' middles, m."""
    limbs: Floats
    """Correlation of the joints' velocities against the body's middle, -1 to 1."""


class _Shared(NamedTuple):
    """What C cameras have in common."""

    common: Floats
    """(C, C) skeletons that could be the same: the fewer of both cameras, over all instants."""
    fitting: Floats
    """(C, C) those that are."""
    seconds: Floats
    """(C,) s in which another camera sees the same people."""
    spread: Floats
    """(C,) how far these people move about, m."""


def refine_together(
    views: Sequence[CameraView], start: Rig, mirror: Ints, rivals: Sequence[bool]
) -> Found:
    """Refine all cameras, find the standard errors, and gather the evidence.

    Parameters
    ----------
    rivals : whether the pose by which each camera was found is ambiguous.
    """
    rig = anchored(start)
    instants = instants_of(views, INSTANTS, rig)
    drifts = float(np.ptp(instants)) > DRIFT_S
    free = free_unknowns(len(views))
    rig, points = refine(views, rig, instants, mirror, free=free)
    timed = common_motion(residuals_of(points, rig)) >= LEAST_MOTION
    if drifts or not timed.all():
        free = free_unknowns(len(views), clocks=timed, drifts=drifts)
        rig = rig._replace(clocks=np.where(timed, rig.clocks, 0.0))
        rig, points = refine(views, rig, instants, mirror, free=free, gates=GATES_M[1:])
    residuals = residuals_of(points, rig)
    if len(points.seconds) < LEAST_POINTS:
        errors = np.full(free.shape, np.inf)
    else:
        errors = standard_errors(residuals, points, free)
    halves = _halves(views, rig, instants, mirror, free)
    shared = _shared(views, rig, instants, mirror)
    bodies = compare_bodies(residuals, points)
    evidence = [_evidence(c, shared, residuals, bodies, rival) for c, rival in enumerate(rivals)]
    evidence = [
        replace(
            one,
            error_deg=float(np.degrees(np.linalg.norm(errors[c, :3]))),
            halves_deg=float(halves[c]),
            limbs=float(bodies.limbs[c]) if timed[c] else 1.0,
        )
        for c, one in enumerate(evidence)
    ]
    return Found(rig, points, residuals, errors, timed, evidence)


def anchored(rig: Rig) -> Rig:
    """Return the rig in the frame and the time of its first camera."""
    turn = rig.rotations[0].T
    return Rig(
        turn @ rig.rotations,
        (rig.shifts - rig.shifts[0]) @ turn.T,
        rig.clocks - rig.clocks[0],
        rig.drifts - rig.drifts[0],
    )


def _halves(
    views: Sequence[CameraView], rig: Rig, instants: Floats, mirror: Ints, free: Flags
) -> Floats:
    """(C,) angle, degrees, between the orientations that the halves of the log give."""
    middle = len(instants) // 2
    found = [
        refine(views, rig, part, mirror, free=free, gates=GATES_M[2:])[0].rotations
        for part in (instants[:middle], instants[middle:])
    ]
    return angles_between(*found)


def angles_between(ones: Floats, others: Floats) -> Floats:
    """(C,) angles, degrees, between rotations (C, 3, 3)."""
    from scipy.spatial.transform import Rotation

    relative = Rotation.from_matrix(ones @ np.swapaxes(others, 1, 2))
    return np.asarray(np.degrees(relative.magnitude()))


def _shared(views: Sequence[CameraView], rig: Rig, instants: Floats, mirror: Ints) -> _Shared:
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
    seconds, spread = np.zeros(n), np.zeros(n)
    for c in range(n):
        both = people[c] & (people.sum(axis=0) > 1)
        seconds[c] = cell * len(np.unique(samples.instants[both]))
        spread[c] = np.sqrt(middles[both].var(axis=0).sum()) if both.any() else 0.0
    return _Shared(common, fitting, seconds, spread)


def _evidence(
    c: int, shared: _Shared, residuals: RigResiduals, bodies: Bodies, rival: bool
) -> Evidence:
    others = np.arange(len(shared.seconds)) != c
    common = shared.common[c, others].sum()
    distances = camera_distances(residuals)[c]
    known = distances[~np.isnan(distances)]
    return Evidence(
        share=float(shared.fitting[c, others].sum() / common) if common else 0.0,
        residual=float(np.median(known)) if len(known) else np.inf,
        rival=rival,
        seconds=float(shared.seconds[c]),
        spread=float(shared.spread[c]),
        size=float(bodies.sizes[c]),
        wander=float(bodies.wander[c]),
    )


def compare_bodies(residuals: RigResiduals, points: Points) -> Bodies:
    """Compare whole bodies, where :func:`camera_distances` compares joints.

    Two people who walk alike at the same time may fit each other joint by joint. But they are not
    of one size, their middles drift apart, or their limbs swing out of step.
    """
    n, n_people = len(residuals.weights), int(points.people.max(initial=-1)) + 1
    total = residuals.weights.sum(axis=0)
    sizes, wander, inside = np.ones(n), np.full(n, np.inf), residuals.velocities.copy()
    for c, weights in enumerate(residuals.weights):
        rest = total - weights
        seen = (weights > 0.0) & (rest > 1e-12)
        counts = np.bincount(points.people[seen], minlength=n_people)
        whole = counts >= WHOLE
        kept = np.flatnonzero(seen)[whole[points.people[seen]]]
        if not len(kept):
            continue
        people = points.people[kept]

        def middle(numbers: Floats, people: Stamps = people) -> Floats:
            sums = np.zeros((n_people, 3))
            np.add.at(sums, people, numbers)
            return np.asarray(
                sums / np.maximum(np.bincount(people, minlength=n_people), 1)[:, None]
            )

        apart = residuals.offsets[c, kept] * (total / np.maximum(rest, 1e-12))[kept, None]
        own = residuals.means[kept] + residuals.offsets[c, kept]
        other = own - apart
        sure = np.minimum(weights, rest)[kept, None]
        spans = [np.sum(sure * (one - middle(one)[people]) ** 2) for one in (own, other)]
        sizes[c] = np.sqrt(spans[0] / spans[1])
        wander[c] = np.median(np.linalg.norm(middle(apart)[np.unique(people)], axis=1))
        inside[c, kept] -= middle(residuals.velocities[c, kept])[people]
    return Bodies(sizes, wander, common_motion(residuals._replace(velocities=inside)))


def camera_distances(residuals: RigResiduals) -> Floats:
    """(C, P) distance of each camera's joint to the mean of the other cameras', m; NaN unseen."""
    total = residuals.weights.sum(axis=0)
    rest = np.maximum(total - residuals.weights, 1e-12)
    return np.asarray(residuals.distances * total / rest)
