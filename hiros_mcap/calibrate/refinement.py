"""Poses and clocks of cameras that see the same people, refined together.

The joint refinement starts near the right poses: at those that pairs of cameras gave
(:mod:`hiros_mcap.calibrate.people`), or at the log's. While a camera does not fit, the worst is
left out. New poses replace the log's only if they also fit better what they were not estimated on:
other joints at other times. Both have to be others, because an error of a detector belongs to a
joint and lasts for seconds.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.calibrate.camera_change import SecondPose, second_poses
from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.evidence import evidence_of
from hiros_mcap.calibrate.gauge import moved, on_transforms
from hiros_mcap.calibrate.joint_refinement import (
    BLOCK_S,
    CAUCHY,
    GATES_M,
    Points,
    Refinement,
    common_motion,
    common_points,
    free_unknowns,
    part_of,
    refine,
    residuals_of,
    solve,
    standard_errors,
)
from hiros_mcap.calibrate.pair_pose import LEAST_MOTION
from hiros_mcap.calibrate.sampling import Rig, instants_of
from hiros_mcap.calibrate.verdict import (
    MOVED,
    NO_VIEW,
    PROVEN,
    UNLINKED,
    CalibratedCamera,
    Evidence,
    misfit,
    verdict_of,
    weakness_of,
)
from hiros_mcap.kernels.rig_equations import CLOCK
from hiros_mcap.rays.keypoints import TRIANGULATED
from hiros_mcap.skeletons import Flags, Floats, Ints

LEAST_POINTS = 100
"""Fewer joints tell no standard error."""
LEAST_LINK = 200
"""Cameras with fewer joints in common tell nothing about each other."""
HELD_OUT_STEPS = 2
"""Gauss-Newton steps from the result for all data to that for a part of them."""
CERTAIN = 3.0
"""Poses are better if they are so by this many standard errors on what was held out."""
LEAST_BLOCKS = 3
"""Fewer blocks tell no standard error of that."""
SHORT_BLOCKS = 5
"""Where less is enough for a proof, the blocks are shorter, so that there are as many."""


class Effort(NamedTuple):
    """How much cameras are refined on."""

    instants: int
    points: int  # joints at instants that are enough; more people need fewer instants
    gates: tuple[float, ...]  # within which distance, m, people are the same, round by round
    cameras: int = sys.maxsize
    """Of more cameras fewer joints count: all pairs of cameras that see a joint cost time."""


FROM_PAIRS = Effort(400, sys.maxsize, GATES_M)
FROM_GIVEN = Effort(60, 6000, (0.5, 0.25))
"""Who is who, by poses that are about right, and by better ones."""


def refine_together(
    views: Sequence[CameraView],
    start: Rig,
    mirror: Ints,
    effort: Effort,
    movable: Flags | bool = True,
) -> Refinement:
    """Refine the poses and clocks of cameras that see the same people.

    Parameters
    ----------
    start : about right. mirror : (M,) slot of each joint's counterpart.
    movable : (C,) whether the pose of a camera may change; that of the first one defines the frame.
    """
    start = start.anchored()
    instants = instants_of(views, effort.instants, start)
    seen = common_points(views, start, instants, mirror, effort.gates[0])
    instants = instants[:: 1 + len(seen.seconds) // effort.points]
    thinning = -(-len(views) // effort.cameras)
    timed = common_motion(residuals_of(seen, start)) >= LEAST_MOTION
    rig, gates = start, effort.gates
    for _ in range(2):
        free = free_unknowns(len(views), clocks=timed)
        free[~np.broadcast_to(movable, len(views)), :CLOCK] = False
        rig = rig._replace(clocks=np.where(timed, rig.clocks, 0.0))
        rig, points = refine(
            views, rig, instants, mirror, free=free, gates=gates, thinning=thinning
        )
        residuals = residuals_of(points, rig)
        before, timed = timed, common_motion(residuals) >= LEAST_MOTION
        if (timed == before).all():
            break
        gates = effort.gates[1:]
    errors, people = np.full(free.shape, np.inf), np.inf
    if len(points.seconds) >= LEAST_POINTS:
        errors, people = standard_errors(residuals, points, free, rig)
    return Refinement(views, start, rig, instants, points, residuals, free, errors, people, timed)


class FittingRig(NamedTuple):
    """Cameras that fit each other."""

    cameras: list[int]
    refined: Refinement
    evidence: list[Evidence]


def fit_together(
    cameras: Sequence[int],
    refined: Callable[[list[int]], FittingRig | None],
    fault: Callable[[Evidence], str],
) -> tuple[FittingRig | None, dict[int, tuple[str, FittingRig]]]:
    """Refine cameras; while one of them does not fit, leave out the worst.

    Parameters
    ----------
    refined : of some cameras, refines those that are linked; None if there are none.
    fault : what speaks against a camera, "" if nothing does.

    Returns the fit, and of each camera that was left out the reason and the last fit with it.
    """
    left: dict[int, tuple[str, FittingRig]] = {}
    while True:
        fit = refined([c for c in cameras if c not in left])
        if fit is None:
            return None, left
        bad = {k: text for k, one in enumerate(fit.evidence) if (text := fault(one))}
        if not bad:
            return fit, left
        worst = min(bad, key=lambda k: _rank(fit.evidence[k]))
        out = fit.cameras if len(fit.cameras) == 2 else [fit.cameras[worst]]
        left |= dict.fromkeys(out, (bad[worst], fit))


def _rank(one: Evidence) -> tuple[bool, float, float]:
    """Sorts cameras that do not fit: the worst first."""
    if misfit(one):
        return False, one.share, -one.residual
    return True, -one.halves_deg, -one.error_deg


def cameras_of(
    fit: FittingRig, rig: Rig, given: Sequence[Rigid | None], *, proven: bool = True
) -> list[CalibratedCamera]:
    """Return what is known of cameras that fit each other.

    Parameters
    ----------
    rig : their poses in the fixed frame. given : the log's.
    proven : whether poses that differ significantly from the log's are better.
    """
    refined, clocks = fit.refined, fit.refined.clocks
    cameras = []
    for k, (view, evidence) in enumerate(zip(refined.views, fit.evidence, strict=True)):
        pose, before = rig.pose(k), given[k]
        metres, degrees = (np.nan, np.nan) if before is None else pose.apart(before)
        significant = degrees > MOVED * evidence.error_deg or metres > MOVED * evidence.error_m
        verdict, reason = verdict_of(evidence, moved=proven and significant)
        cameras.append(
            CalibratedCamera(
                view.name,
                view.frame,
                verdict,
                reason,
                pose,
                clock_s=float(clocks[k]),
                error_deg=evidence.error_deg,
                error_mm=1000.0 * evidence.error_m,
                error_ms=1000.0 * float(refined.errors[k, CLOCK]),
                residual_mm=1000.0 * evidence.residual,
                seconds=evidence.seconds,
                moved_deg=degrees,
                moved_mm=1000.0 * metres,
                partner=evidence.partner,
                evidence=evidence,
            )
        )
    return cameras


def refine_poses(
    views: Sequence[CameraView],
    given: Sequence[Rigid],
    mirror: Ints,
    anchor: int | None = None,
    movable: Sequence[bool] | None = None,
    *,
    moves: bool = True,
    proven_s: float = PROVEN.seconds,
    effort: Effort = FROM_GIVEN,
) -> tuple[list[CalibratedCamera], list[SecondPose]]:
    """Find out whether the people know better poses than the given ones, and how the clocks go.

    The rig as a whole stays where the given poses put it. Cameras that see nobody in common with
    others keep their poses, and so do those about which the data leave a doubt.

    Parameters
    ----------
    given : pose of each camera. mirror : (M,) slot of each joint's counterpart.
    anchor : the camera whose frame is the fixed frame, so that its pose is right by definition.
    movable : of which cameras the pose may change; None = all. The clocks of all may.
    moves : whether to look for cameras that were moved; otherwise nothing is gained.
    proven_s : shortest common view, s, that proves a pose.
    effort : on how many joints at how many instants.

    Returns the cameras, and the gain of each by a second pose: it may have been moved.
    """
    movable = [True] * len(views) if movable is None else movable
    cameras = [
        CalibratedCamera(v.name, v.frame, reason=UNLINKED if v.tracks else NO_VIEW, pose=pose)
        for v, pose in zip(views, given, strict=True)
    ]
    gains = [SecondPose()] * len(views)

    def refined(some: list[int]) -> FittingRig | None:
        if len(some) < 2:
            return None
        start = Rig.of([given[c] for c in some])
        free = np.array([movable[c] for c in some])
        rig = refine_together([views[c] for c in some], start, mirror, effort, free)
        return FittingRig(some, rig, evidence_of(rig, mirror, known=True))

    for part in linked(views, given, mirror, effort):
        # The first camera defines the common frame.
        fit, left = fit_together(sorted(part, key=lambda c: movable[c]), refined, misfit)
        for c, (reason, _) in left.items():
            cameras[c] = replace(cameras[c], reason=reason)
        if fit is not None:
            kept = [k for k, c in enumerate(fit.cameras) if c == anchor or not movable[c]]
            better = _better(fit, [given[c] for c in fit.cameras], kept, mirror, proven_s)
            for c, one in zip(fit.cameras, better, strict=True):
                cameras[c] = one
            if not moves:
                continue
            some, rig = fit.refined, fit.refined.rig
            wide = common_points(some.views, rig, some.instants, mirror, effort.gates[0])
            second = second_poses(residuals_of(wide, rig), wide)
            for c, gain in zip(fit.cameras, second, strict=True):
                gains[c] = gain
    return cameras, gains


def linked(
    views: Sequence[CameraView], poses: Sequence[Rigid], mirror: Ints, effort: Effort = FROM_GIVEN
) -> list[list[int]]:
    """Return the groups of cameras that see the same people; those that are alone are in none."""
    instants = instants_of(views, effort.instants)
    points = common_points(views, Rig.of(poses), instants, mirror, effort.gates[0])
    seen = (points.weights > 0.0).astype(np.float64)
    links = seen @ seen.T >= LEAST_LINK
    for _ in links:
        links = links @ links  # of booleans: who is linked by way of another camera
    groups = {tuple(np.flatnonzero(row).tolist()) for row in links}
    return [list(group) for group in sorted(groups) if len(group) > 1]


def _better(
    fit: FittingRig, given: Sequence[Rigid], kept: Sequence[int], mirror: Ints, proven_s: float
) -> list[CalibratedCamera]:
    """Return cameras at their better poses, where these are proven, and at the given ones.

    The poses of the cameras ``kept`` are right. A common view of ``proven_s`` seconds is enough.
    """
    rig = fit.refined.rig
    poses = {k: given[k] for k in kept or range(len(given))}
    errors = np.array([(math.radians(e.error_deg), e.error_m) for e in fit.evidence])
    errors[[view.name == TRIANGULATED for view in fit.refined.views]] = np.inf  # stands nowhere
    rig = moved(rig, on_transforms(rig, poses, errors))
    better = _certainty(fit.refined, mirror, proven_s) > CERTAIN
    limits = PROVEN._replace(seconds=proven_s)
    cameras = cameras_of(fit, rig, given, proven=better)
    for k, camera in enumerate(cameras):
        weak = bool(weakness_of(fit.evidence[k], limits))
        if not better or weak or k in kept:
            camera = replace(camera, pose=given[k], moved_deg=np.nan, moved_mm=np.nan)
        cameras[k] = camera
    return cameras


def _certainty(refined: Refinement, mirror: Ints, proven_s: float) -> float:
    """Return by how many standard errors the loss is smaller on what was held out.

    ``proven_s`` seconds are to be enough for that.
    """
    points, rig, free = refined.points, refined.rig, refined.free
    if len(points.seconds) < LEAST_LINK or not free[:, :CLOCK].any():
        return 0.0
    scale = CAUCHY * float(np.nanmedian(refined.residuals.distances))
    least = BLOCK_S * min(proven_s / PROVEN.seconds, 1.0)
    length = float(np.clip(np.ptp(points.seconds) / SHORT_BLOCKS, least, BLOCK_S))
    numbers = np.floor(points.seconds / length)
    late = numbers.astype(np.int64) % 2 == 1
    differences = _held_out(points, late, scale, rig, refined.start, free, mirror)
    blocks = np.unique(numbers, return_inverse=True)[1]
    sums = np.bincount(blocks, differences)
    if len(sums) < LEAST_BLOCKS:
        return 0.0
    error = float(np.std(sums, ddof=1) * np.sqrt(len(sums)))
    return float(sums.sum()) / error if error > 0.0 else 0.0


def _held_out(
    points: Points, late: Flags, scale: float, rig: Rig, given: Rig, free: Flags, mirror: Ints
) -> Floats:
    """(P,) loss of the given poses less that of poses found without the point.

    The clocks are free in both: this is about the poses. ``late`` are the points in every other
    block of time, ``scale`` is that of the loss, m.
    """
    clocks = free.copy()
    clocks[:, :6] = False
    differences = np.zeros(len(points.seconds))
    for train, test in _folds(points, late, mirror):
        some, rest = part_of(points, train), part_of(points, test)
        refined = solve(some, rig, free, rig, HELD_OUT_STEPS)
        kept = solve(some, given._replace(clocks=rig.clocks), clocks, rig, HELD_OUT_STEPS)
        differences[test] = _loss(rest, kept, rig, scale) - _loss(rest, refined, rig, scale)
    return differences


def _folds(points: Points, late: Flags, mirror: Ints) -> Iterator[tuple[Flags, Flags]]:
    """Yield the points to learn from and those to test on: other times and other joints."""
    pairs = np.unique(np.minimum(np.arange(len(mirror)), mirror), return_inverse=True)[1]
    odd = pairs[points.joints] % 2 == 1
    for time in (late, ~late):
        for joint in (odd, ~odd):
            yield time & joint, ~time & ~joint


def _loss(points: Points, rig: Rig, sampled: Rig, scale: float) -> Floats:
    """(P,) Cauchy loss of each point."""
    distances = np.nan_to_num(residuals_of(points, rig, sampled).distances)
    return np.asarray((points.weights * np.log1p((distances / scale) ** 2)).sum(axis=0))
