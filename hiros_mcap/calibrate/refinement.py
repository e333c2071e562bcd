"""Better poses and clocks of cameras that stand about where the log says.

The joint refinement starts at the given poses. Its result counts if it also fits what it has not
seen: it is estimated on some joints at some times, and compared with the given poses on the other
joints at the other times. Errors of a detector last for seconds and belong to a joint, so that
neither may be the same in both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid, angle, from_matrix, to_matrix
from hiros_mcap.calibrate.agreement import camera_distances, shared_view
from hiros_mcap.calibrate.camera_change import two_pose_gains
from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.evidence import anchored
from hiros_mcap.calibrate.gauge import moved, on_transforms
from hiros_mcap.calibrate.joint_refinement import (
    BLOCK_S,
    CAUCHY,
    Points,
    RigResiduals,
    common_motion,
    common_points,
    free_unknowns,
    refine,
    residuals_of,
    solve,
    standard_errors,
)
from hiros_mcap.calibrate.pair_pose import LEAST_MOTION
from hiros_mcap.calibrate.sampling import Rig, instants_of
from hiros_mcap.calibrate.verdict import (
    LEAST_SHARE,
    MOVED,
    NO_VIEW,
    UNLINKED,
    WRONG_M,
    Evidence,
    Verdict,
    judge,
)
from hiros_mcap.kernels.rig_equations import CLOCK
from hiros_mcap.skeletons import Flags, Floats, Ints

INSTANTS = 60
POINTS = 6000
"""Joints at instants that are enough; more people need fewer instants."""
GATES_M = (0.5, 0.25)
"""Who is who, by poses that are about right, and by better ones."""
LEAST_POINTS = 200
"""Cameras with fewer joints in common tell nothing about each other."""
HELD_OUT_STEPS = 2
"""Gauss-Newton steps from the result for all data to that for a part of them."""
CERTAIN = 3.0
"""Poses are better if they are so by this many standard errors on what was held out."""
LEAST_BLOCKS = 3
"""Fewer blocks of 2 s tell no standard error of that."""


class RefinedPose(NamedTuple):
    """What the people tell about the pose and the clock of one camera."""

    verdict: Verdict
    reason: str
    """Why it is doubtful or impossible, "" otherwise."""
    fits: bool = True
    """False if its people are not where the other cameras see them, whatever pose it gets."""
    pose: Rigid | None = None
    """The better pose; None where the given one stays."""
    clock_s: float = np.nan
    """s to add to its stamps, against most of the cameras; NaN if no motion tells it."""
    error_deg: float = np.nan
    """Standard error of the orientation against the other cameras."""
    error_m: float = np.nan
    error_s: float = np.nan
    gain: float = 0.0
    """By which share its misfit falls if it may have been moved once."""


class Refinement(NamedTuple):
    """C cameras, refined together."""

    rig: Rig
    """The first camera stands at the origin."""
    errors: Floats
    """(C, 8) standard errors; those of the first camera are the largest of the others."""
    timed: Flags
    """(C,) whether motion tells the camera's clock."""
    evidence: list[Evidence]
    certainty: float
    """By how many standard errors it fits better than the given poses what was held out."""
    gains: Floats
    """(C,) see :func:`two_pose_gains`."""


def refine_poses(
    views: Sequence[CameraView],
    given: Sequence[Rigid],
    mirror: Ints,
    anchor: int | None = None,
    movable: Sequence[bool] | None = None,
) -> list[RefinedPose]:
    """Find out whether the people know better poses than the given ones, and how the clocks go.

    The rig as a whole stays where the given poses put it. Cameras that see nobody in common with
    others keep their poses, and so do those about which the data leave a doubt.

    Parameters
    ----------
    given : pose of each camera. mirror : (M,) slot of each joint's counterpart.
    anchor : the camera whose frame is the fixed frame, so that its pose is right by definition.
    movable : of which cameras the pose may change; None = all. The clocks of all may.
    """
    movable = [True] * len(views) if movable is None else movable
    found = {
        c: RefinedPose("impossible", NO_VIEW if not v.tracks else UNLINKED)
        for c, v in enumerate(views)
    }
    for part in _linked(views, rig_of(given), mirror):
        # The first camera defines the common frame.
        part = sorted(part, key=lambda c: movable[c])
        found |= _refine_part(part, views, given, mirror, anchor, movable)
    return [found[c] for c in range(len(views))]


def rig_of(poses: Sequence[Rigid]) -> Rig:
    """Return cameras at known poses, whose clocks are right."""
    rig = Rig.alone(len(poses))
    for c, pose in enumerate(poses):
        rig.rotations[c], rig.shifts[c] = to_matrix(pose.xyzw), pose.translation
    return rig


def _linked(views: Sequence[CameraView], given: Rig, mirror: Ints) -> list[list[int]]:
    """Return the groups of cameras that are linked by people whom they see in common."""
    points = common_points(views, given, instants_of(views, INSTANTS), mirror, GATES_M[0])
    seen = (points.weights > 0.0).astype(np.float64)
    links = seen @ seen.T >= LEAST_POINTS
    for _ in views:
        links = links @ links  # of booleans: who is linked by way of another camera
    groups = {tuple(np.flatnonzero(row).tolist()) for row in links}
    return [list(group) for group in sorted(groups) if len(group) > 1]


def _refine_part(
    part: list[int],
    views: Sequence[CameraView],
    given: Sequence[Rigid],
    mirror: Ints,
    anchor: int | None,
    movable: Sequence[bool],
) -> dict[int, RefinedPose]:
    """Refine linked cameras; while one of them does not fit, leave out the worst."""
    found: dict[int, RefinedPose] = {}
    while len(part) > 1:
        refined = refine_together(
            [views[c] for c in part],
            [given[c] for c in part],
            mirror,
            np.array([movable[c] for c in part]),
        )
        bad = [k for k, each in enumerate(refined.evidence) if not _fits(each)]
        if not bad:
            poses, shifts = [given[c] for c in part], [views[c].shift for c in part]
            kept = [k for k, c in enumerate(part) if c == anchor or not movable[c]]
            every = _judged(refined, poses, kept, shifts)
            return found | dict(zip(part, every, strict=True))
        worst = min(bad, key=lambda k: (refined.evidence[k].share, -refined.evidence[k].residual))
        fault = RefinedPose(*judge(refined.evidence[worst], moved=False), fits=False)
        if len(part) == 2:
            return found | dict.fromkeys(part, fault)
        found[part[worst]] = fault
        part = part[:worst] + part[worst + 1 :]
    return found


def _fits(evidence: Evidence) -> bool:
    """Whether a camera sees the people where the others see them."""
    return evidence.share >= LEAST_SHARE and evidence.residual <= WRONG_M


def _judged(
    refined: Refinement, given: Sequence[Rigid], kept: Sequence[int], shifts: Sequence[float]
) -> list[RefinedPose]:
    """Return the poses in the fixed frame, with the verdicts, of cameras that all fit.

    The poses of the cameras ``kept`` are right.
    """
    known = {k: given[k] for k in kept or range(len(given))}
    rig = moved(refined.rig, on_transforms(refined.rig, known))
    clocks = rig.clocks + np.array(shifts)
    usual = float(np.median(clocks[refined.timed])) if refined.timed.any() else 0.0
    better = refined.certainty > CERTAIN
    found = []
    for k, evidence in enumerate(refined.evidence):
        turn = from_matrix(rig.rotations[k])
        pose, errors = Rigid(turn, rig.shifts[k]), refined.errors[k]
        degrees, metres = np.linalg.norm(errors[:3]), np.linalg.norm(errors[3:6])
        far = angle(pose.xyzw, given[k].xyzw) > MOVED * degrees or (
            np.linalg.norm(pose.translation - given[k].translation) > MOVED * metres
        )
        verdict, reason = judge(evidence, moved=better and bool(far))
        if verdict == "impossible":  # too little is known for a pose, but nothing contradicts
            verdict = "doubtful"
        used = better and verdict in ("good", "improved") and k not in kept
        found.append(
            RefinedPose(
                verdict,
                reason,
                pose=pose if used else None,
                clock_s=float(clocks[k] - usual) if refined.timed[k] else np.nan,
                error_deg=float(np.degrees(degrees)),
                error_m=float(metres),
                error_s=float(errors[CLOCK]),
                gain=float(refined.gains[k]),
            )
        )
    return found


def refine_together(
    views: Sequence[CameraView], given: Sequence[Rigid], mirror: Ints, movable: Flags
) -> Refinement:
    """Refine the poses of cameras that see the same people, and compare them with the given ones.

    Parameters
    ----------
    given : poses that are about right. mirror : (M,) slot of each joint's counterpart.
    movable : (C,) whether the pose of a camera may change; that of the first one defines the frame.
    """
    start = anchored(rig_of(given))
    instants = instants_of(views, INSTANTS)
    seen = common_points(views, start, instants, mirror, GATES_M[0])
    step = 1 + len(seen.seconds) // POINTS
    instants = instants[::step]
    timed = common_motion(residuals_of(seen, start)) >= LEAST_MOTION
    free = free_unknowns(len(views), clocks=timed)
    free[~movable, :CLOCK] = False
    known = seen if step == 1 else None
    rig, points = refine(views, start, instants, mirror, free=free, gates=GATES_M, points=known)
    residuals = residuals_of(points, rig)
    if len(points.seconds) < LEAST_POINTS:
        errors, certainty = np.full(free.shape, np.inf), 0.0
    else:
        errors = standard_errors(residuals, points, free)
        certainty = _certainty(points, residuals, rig, start, free, mirror)
    errors[0] = errors.max(axis=0)
    evidence = _evidence(views, rig, residuals, instants, mirror)
    degrees = np.degrees(np.linalg.norm(errors[:, :3], axis=1))
    evidence = [replace(e, error_deg=float(d)) for e, d in zip(evidence, degrees, strict=True)]
    gains = two_pose_gains(residuals, points)
    return Refinement(rig, errors, timed, evidence, certainty, gains)


def _evidence(
    views: Sequence[CameraView],
    rig: Rig,
    residuals: RigResiduals,
    instants: Floats,
    mirror: Ints,
) -> list[Evidence]:
    """Gather how well each camera fits the others."""
    shared = shared_view(views, rig, instants, mirror)
    distances = camera_distances(residuals)
    found = []
    for c in range(len(views)):
        others = np.arange(len(views)) != c
        common = shared.common[c, others].sum()
        known = distances[c][~np.isnan(distances[c])]
        found.append(
            Evidence(
                share=float(shared.fitting[c, others].sum() / common) if common else 0.0,
                residual=float(np.median(known)) if len(known) else np.inf,
                seconds=float(shared.seconds[c]),
                spread=float(shared.spread[c]),
            )
        )
    return found


def _certainty(
    points: Points, residuals: RigResiduals, rig: Rig, given: Rig, free: Flags, mirror: Ints
) -> float:
    """Return by how many standard errors the loss is smaller on what was held out."""
    if not free[:, :CLOCK].any():
        return 0.0
    scale = CAUCHY * float(np.nanmedian(residuals.distances))
    differences = _held_out(points, scale, rig, given, free, mirror)
    blocks = np.unique(np.floor(points.seconds / BLOCK_S), return_inverse=True)[1]
    sums = np.bincount(blocks, differences)
    if len(sums) < LEAST_BLOCKS:
        return 0.0
    error = float(np.std(sums, ddof=1) * np.sqrt(len(sums)))
    return float(sums.sum()) / error if error > 0.0 else 0.0


def _held_out(
    points: Points, scale: float, rig: Rig, given: Rig, free: Flags, mirror: Ints
) -> Floats:
    """(P,) loss of the given poses less that of poses found without the point.

    The clocks are free in both: this is about the poses. ``scale`` is that of the loss, m.
    """
    clocks = free.copy()
    clocks[:, :6] = False
    differences = np.zeros(len(points.seconds))
    for train, test in _folds(points, mirror):
        some, rest = _part(points, train), _part(points, test)
        found = solve(some, rig, free, rig, HELD_OUT_STEPS)
        kept = solve(some, given._replace(clocks=rig.clocks), clocks, rig, HELD_OUT_STEPS)
        differences[test] = _loss(rest, kept, rig, scale) - _loss(rest, found, rig, scale)
    return differences


def _folds(points: Points, mirror: Ints) -> Iterator[tuple[Flags, Flags]]:
    """Yield the points to learn from and those to test on: other times and other joints."""
    late = np.floor(points.seconds / BLOCK_S).astype(np.int64) % 2 == 1
    pairs = np.unique(np.minimum(np.arange(len(mirror)), mirror), return_inverse=True)[1]
    odd = pairs[points.joints] % 2 == 1
    for time in (late, ~late):
        for joint in (odd, ~odd):
            yield time & joint, ~time & ~joint


def _part(points: Points, chosen: Flags) -> Points:
    return Points(
        points.seconds[chosen],
        points.people[chosen],
        points.joints[chosen],
        *(np.ascontiguousarray(table[:, chosen]) for table in points[3:]),
    )


def _loss(points: Points, rig: Rig, sampled: Rig, scale: float) -> Floats:
    """(P,) Cauchy loss of each point."""
    distances = np.nan_to_num(residuals_of(points, rig, sampled).distances)
    return np.asarray((points.weights * np.log1p((distances / scale) ** 2)).sum(axis=0))
