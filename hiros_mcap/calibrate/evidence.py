"""The joint refinement of some cameras, and what speaks for and against its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hiros_mcap.calibrate.agreement import (
    Bodies,
    SharedView,
    camera_distances,
    compare_bodies,
    shared_view,
)
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
from hiros_mcap.calibrate.pair_pose import LEAST_MOTION
from hiros_mcap.calibrate.repetition import closest_repetition, path_distances
from hiros_mcap.calibrate.sampling import Rig, instants_of
from hiros_mcap.calibrate.verdict import Evidence
from hiros_mcap.skeletons import Flags, Floats, Ints

INSTANTS = 400
"""Of the joint refinement."""
DRIFT_S = 120.0
"""In a shorter log the drift of a clock cannot be told from its offset."""
LEAST_POINTS = 100


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
    shared = shared_view(views, rig, instants, mirror)
    bodies = compare_bodies(residuals, points)
    paths = path_distances(residuals, points)
    late = [
        float(np.abs(np.delete(rig.clocks, c) - rig.clocks[c]).min()) for c in range(len(views))
    ]
    evidence = []
    for c, rival in enumerate(rivals):
        error = float(np.degrees(np.linalg.norm(errors[c, :3])))
        one = _evidence(c, shared, residuals, bodies)
        one = replace(one, rival=rival, error_deg=error, halves_deg=float(halves[c]))
        one = replace(one, path=float(paths[c]), repetition=closest_repetition(views[c]))
        one = replace(one, late=late[c] if timed[c] else 0.0)
        evidence.append(one if timed[c] else replace(one, limbs=1.0))
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


def _evidence(c: int, shared: SharedView, residuals: RigResiduals, bodies: Bodies) -> Evidence:
    """Gather what the agreement of the cameras tells about one of them."""
    others = np.arange(len(shared.seconds)) != c
    common = shared.common[c, others].sum()
    distances = camera_distances(residuals)[c]
    known = distances[~np.isnan(distances)]
    return Evidence(
        share=float(shared.fitting[c, others].sum() / common) if common else 0.0,
        residual=float(np.median(known)) if len(known) else np.inf,
        seconds=float(shared.seconds[c]),
        spread=float(shared.spread[c]),
        people=float(shared.people[c]),
        size=float(bodies.sizes[c]),
        wander=float(bodies.wander[c]),
        limbs=float(bodies.limbs[c]),
    )
