"""One least-squares problem for all poses and clocks; the joints of the people are eliminated.

The model: joint j of a person at an instant is where every camera c sees it,
``R_c x_c(t - d_c) + p_c``. With the velocity V of the joint in the common frame, its derivative by
a small rotation, a shift and the clock d_c is ``[-[R x]x, I, -V]``. The best joint is the weighted
mean of what the cameras see. Without it the normal equations are ``sum w J'J - sum (sum w J)'
(sum w J) / sum w``, the latter over the joints of all instants.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import from_vector, to_matrix
from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.registration import jackknife
from hiros_mcap.calibrate.sampling import Rig, group, placed, sample
from hiros_mcap.kernels.grouping import Groups
from hiros_mcap.kernels.rig_equations import (
    CLOCK,
    UNKNOWNS,
    EquationWork,
    RigResiduals,
    add_points,
)
from hiros_mcap.rays.image_tracks import Samples
from hiros_mcap.skeletons import Flags, Floats, Ints, Stamps

GATES_M = (0.35, 0.3, 0.25, 0.25)
"""Who is who is decided anew in each round, within a smaller distance."""
WIDEST_M = 0.75
"""Within this distance people are looked for if the first gate finds nobody. Later gates are as
narrow as ever, so strangers drop out."""
STEPS = 2
"""Gauss-Newton steps in each round."""
CAUCHY = 1.5
"""Scale of the robust weights, in median residuals."""
RIDGE = 1e-9
"""Added to the scaled Hessian, whose diagonal is 1."""
SOME_JOINTS = 500
"""Enough for a mean."""
UNKNOWN = 1.0
"""Standard error, rad, m or s, from which on an unknown is not known at all."""
_LOST = 1e3  # a step that is longer, rad, m or s, is rounding: no data tell the unknown any more
BLOCK_S, BLOCKS = 2.0, 10
"""Errors that are further apart in time are taken for independent; more in a long log."""


class Points(NamedTuple):
    """P joints of people at instants that at least two of C cameras see."""

    seconds: Floats  # (P,) common time
    people: Stamps  # (P,) which skeleton it belongs to: one person at one instant
    joints: Stamps  # (P,) slot of the marker
    positions: Floats  # (C, P, 3) in the cameras' frames, m
    velocities: Floats  # (C, P, 3) in the cameras' frames, m/s
    weights: Floats  # (C, P) 0 where a camera does not see it


class Refinement(NamedTuple):
    """C cameras, refined together."""

    views: Sequence[CameraView]
    start: Rig
    rig: Rig  # the first camera stands at the origin
    instants: Floats
    points: Points
    residuals: RigResiduals
    free: Flags  # (C, 7) which unknowns were refined
    errors: Floats
    """(C, 7) standard errors of the unknowns, see :func:`standard_errors`;
    infinite where too little is seen."""
    people: float
    """How far the poses' errors move the mean of the cameras' joints, m: root mean square."""
    timed: Flags  # (C,) whether motion tells the camera's clock

    @property
    def clocks(self) -> Floats:
        """(C,) s to add to the stamps, against the median clock; NaN if no motion tells it."""
        clocks = self.rig.clocks + np.array([view.shift for view in self.views])
        clocks[~self.timed] = np.nan
        return np.asarray(clocks - (np.nanmedian(clocks) if self.timed.any() else 0.0))


def refine(
    views: Sequence[CameraView],
    rig: Rig,
    instants: Floats,
    mirror: Ints,
    *,
    free: Flags,
    gates: Sequence[float] = GATES_M,
    thinning: int = 1,
) -> tuple[Rig, Points]:
    """Improve poses and clocks until all cameras agree about the people.

    Parameters
    ----------
    instants : (K,) common times, s, increasing; not a multiple of the cameras' period, which
        would bias the clocks.
    mirror : (M,). free : (C, 7) the unknowns that may change, see :func:`free_unknowns`.
    thinning : see :func:`thinned`.

    Returns
    -------
    The rig, and the points on which it was found.
    """
    for k, gate in enumerate(gates):
        points = common_points(views, rig, instants, mirror, gate)
        while not (k or len(points.seconds)) and gate < WIDEST_M:  # the start puts people far off
            gate *= 1.5
            points = common_points(views, rig, instants, mirror, gate)
        rig = solve(thinned(points, thinning), rig, free, rig, STEPS)
    return rig, thinned(common_points(views, rig, instants, mirror, gates[-1]), thinning)


def solve(points: Points, rig: Rig, free: Flags, sampled: Rig, steps: int) -> Rig:
    """Improve poses and clocks by Gauss-Newton steps.

    The points were taken at the clocks of the rig ``sampled``.
    """
    for _ in range(steps if len(points.seconds) else 0):
        residuals = residuals_of(points, rig, sampled)
        hessian, slope = normal_equations(residuals, free)
        step = np.zeros(free.shape)
        step[free] = -_solution(hessian, slope)
        rig = Rig(
            to_matrix(from_vector(step[:, :3])) @ rig.rotations,
            rig.shifts + step[:, 3:6],
            rig.clocks + step[:, CLOCK],
        )
    return rig


def free_unknowns(n_cameras: int, *, clocks: Flags | bool = True) -> Flags:
    """(C, 7) all unknowns but those of camera 0, which defines the common frame and time."""
    free = np.ones((n_cameras, UNKNOWNS), np.bool_)
    free[:, CLOCK] = clocks
    free[0] = False
    return free


def common_points(
    views: Sequence[CameraView], rig: Rig, instants: Floats, mirror: Ints, gate: float
) -> Points:
    """Find the joints that at least two cameras see, by where the rig places them."""
    samples = sample(views, instants, rig)
    groups = group(samples, placed(samples, rig), mirror, gate)
    return _points(samples, groups, instants, mirror, len(views))


def _points(
    samples: Samples, groups: Groups, instants: Floats, mirror: Ints, n_cameras: int
) -> Points:
    _, people, sizes = np.unique(groups.people, return_inverse=True, return_counts=True)
    shared = sizes[people] > 1
    people = np.unique(people[shared], return_inverse=True)[1]
    lines, cameras = samples.lines, samples.cameras[shared]
    n_people, n_markers = int(people.max(initial=-1)) + 1, len(mirror)
    order = np.where(groups.mirrored[shared][:, None], mirror, np.arange(n_markers))
    rows = np.flatnonzero(shared)[:, None]
    dense = []
    for numbers in lines:
        table = np.zeros((n_cameras, n_people, n_markers, *numbers.shape[2:]))
        table[cameras, people] = numbers[rows, order]
        dense.append(table.reshape(n_cameras, n_people * n_markers, *numbers.shape[2:]))
    seconds = np.zeros(n_people)
    seconds[people] = instants[samples.instants[shared]]
    seen = np.flatnonzero((dense[2] > 0.0).sum(axis=0) > 1)
    return Points(
        seconds[seen // n_markers],
        seen // n_markers,
        seen % n_markers,
        *(np.ascontiguousarray(table[:, seen]) for table in dense),
    )


def thinned(points: Points, k: int) -> Points:
    """Return one of ``k`` joints of each person at each instant: others of the next person."""
    return points if k == 1 else part_of(points, (points.people + points.joints) % k == 0)


def part_of(points: Points, chosen: Flags) -> Points:
    """Return the ``chosen`` (P,) points."""
    return Points(
        points.seconds[chosen],
        points.people[chosen],
        points.joints[chosen],
        *(np.ascontiguousarray(table[:, chosen]) for table in points[3:]),
    )


def residuals_of(points: Points, rig: Rig, sampled: Rig | None = None) -> RigResiduals:
    """Return how far the cameras are from each joint's mean, with robust weights.

    ``sampled`` is the rig at which the points were taken, if its clocks were others: the points
    then move with their velocities.
    """
    back = np.ascontiguousarray(np.swapaxes(rig.rotations, 1, 2))
    turned, velocities = points.positions @ back, points.velocities @ back
    if sampled is not None:
        turned = turned - (rig.clocks - sampled.clocks)[:, None, None] * velocities
    places = turned + rig.shifts[:, None]
    means, offsets = _about_mean(places, points.weights)
    lengths = np.sqrt(np.einsum("cpi,cpi->cp", offsets, offsets))
    measured = lengths[points.weights > 0.0]
    scale = CAUCHY * (float(np.median(measured)) if len(measured) else 0.0) + 1e-9
    weights = points.weights / (1.0 + (lengths / scale) ** 2)
    means, offsets = _about_mean(places, weights)
    return RigResiduals(means, offsets, weights, turned, velocities)


def _about_mean(places: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """(P, 3) weighted mean of (C, P, 3) places, and (C, P, 3) offsets from it."""
    means = np.einsum("cp,cpi->pi", weights, places) / weights.sum(axis=0)[:, None]
    return means, places - means


def normal_equations(residuals: RigResiduals, free: Flags) -> tuple[Floats, Floats]:
    """Return the Hessian (F, F) of the free unknowns, and the gradient (F,).

    The joints' means are eliminated. The first camera has no free unknowns.
    """
    n = UNKNOWNS * (len(free) - 1)
    hessian, slope = np.zeros((n, n)), np.zeros(n)
    # A camera's own velocity errs together with its position, above all where somebody re-appears.
    # The mean of all cameras treats them alike; otherwise the first one's clock would be biased.
    velocities = np.broadcast_to(residuals.mean_velocities, residuals.velocities.shape)
    points = residuals._replace(velocities=np.ascontiguousarray(velocities))
    first = 0 if free[:, :CLOCK].any() else CLOCK
    last = UNKNOWNS if free[:, CLOCK].any() else CLOCK
    add_points(points, first, last, hessian, slope, EquationWork.allocate(len(free)))
    upper = np.triu(hessian)
    chosen = free[1:].ravel()
    whole = upper + upper.T - np.diag(np.diag(upper))
    return whole[np.ix_(chosen, chosen)], slope[chosen]


def _solution(hessian: Floats, slope: Floats) -> Floats:
    """Solve the normal equations; nothing changes that no data show.

    The small ridge stands for a pseudo-inverse, which takes 20 times as long with five cameras.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-12))  # ones on the diagonal
    scaled = hessian * np.outer(scale, scale) + RIDGE * np.eye(len(hessian))
    return np.asarray(scale * np.linalg.solve(scaled, scale * slope))


def standard_errors(
    residuals: RigResiduals, points: Points, free: Flags, rig: Rig
) -> tuple[Floats, float]:
    """(C, 7) standard errors of the unknowns, and how far the poses' errors move people, m.

    A standard error is infinite where all that tells an unknown lies in one cluster.

    Poses are against the camera to which the others are known best; its own error is the least of
    them. Clocks are against the first camera; its own is the largest. People are the means of the
    cameras' joints; it is the root mean square.

    A cluster jackknife (Bell and McCaffrey 2002, CR3): one Newton step gives the solution without
    each cluster in turn. The errors of a detector are not independent: those of a joint last for
    seconds, and a part of them, which depends on the view, stays. So the clusters are blocks of
    time, then joints, and both variances are added (Cameron, Gelbach and Miller 2011, without the
    part that both count). The longer the log, the longer the blocks: whoever stands where he is
    keeps the errors of that view.
    """
    seconds = points.seconds - points.seconds.min()
    length = max(BLOCK_S, float(seconds.max()) / BLOCKS)
    blocks = np.floor(seconds / length).astype(np.int64)
    tables = [_without_each(residuals, points, free, each) for each in (blocks, points.joints)]
    errors = np.sqrt(sum(map(jackknife, tables)))
    errors[0] = errors.max(axis=0)
    poses = np.sqrt(sum(jackknife(_against_each(table, rig.shifts)) for table in tables))
    # A camera that is lost without a cluster differs from all others, whichever they are.
    sizes = np.minimum(np.linalg.norm(poses[:, :, :3], axis=2), UNKNOWN)
    reference = int(sizes.sum(axis=1).argmin())
    errors[:, :CLOCK] = poses[reference]
    others = np.delete(np.arange(len(free)), reference)
    errors[reference, :CLOCK] = poses[reference, others[sizes[reference, others].argmin()]]
    shares = (_joint_steps(residuals, table, rig.shifts, reference) for table in tables)
    people = np.sqrt(sum(jackknife(each).sum(axis=1).mean() for each in shares))
    known = np.where(errors < UNKNOWN, errors, np.inf)
    return known, float(people) if people < UNKNOWN else math.inf


def _without_each(residuals: RigResiduals, points: Points, free: Flags, clusters: Stamps) -> Floats:
    """(K, C, 7) how the solutions without each of K clusters of points differ."""
    equations = [
        normal_equations(_part(residuals, rows), free)
        for rows in (np.flatnonzero(clusters == one) for one in np.unique(clusters))
    ]
    hessian = np.sum([part for part, _ in equations], axis=0)
    steps = np.zeros((len(equations), *free.shape))
    steps[:, free] = [_solution(hessian - part, slope) for part, slope in equations]
    return np.clip(steps, -_LOST, _LOST)


def _against_each(steps: Floats, places: Floats) -> Floats:
    """(K, C, C, 6) steps of rotation and shift (K, C, 7) of each camera, against each other one."""
    ones, others = steps[:, :, None], steps[:, None]
    away = places[None] - places[:, None]
    shifts = others[..., 3:6] - ones[..., 3:6] - np.cross(ones[..., :3], away)
    return np.concatenate([others[..., :3] - ones[..., :3], shifts], axis=-1)


def _joint_steps(residuals: RigResiduals, steps: Floats, places: Floats, reference: int) -> Floats:
    """(K, P, 3) how steps of the cameras (K, C, 7) move the joints' means, m, for some joints."""
    every = slice(None, None, 1 + residuals.weights.shape[1] // SOME_JOINTS)
    weights = residuals.weights[:, every] / residuals.weights[:, every].sum(axis=0)
    away = np.concatenate([residuals.turned[:, every], residuals.means[None, every]])
    away[-1] -= places[reference]
    rows = [*range(len(places)), reference]
    turns, shifts = steps[:, rows, None, :3], steps[:, rows, None, 3:6]
    moves = np.cross(turns, away[None]) + shifts
    return np.asarray(np.einsum("cp,kcpi->kpi", weights, moves[:, :-1]) - moves[:, -1])


def _part(residuals: RigResiduals, rows: Stamps) -> RigResiduals:
    """Return the residuals of some points."""
    return RigResiduals(
        residuals.means[rows],
        *(np.ascontiguousarray(table[:, rows]) for table in residuals[1:]),
    )


def common_motion(residuals: RigResiduals) -> Floats:
    """(C,) correlation of each camera's velocities with the mean of the others', -1 to 1.

    Without motion it is about 0: velocities are then noise, and no clock can be read from them.
    """
    velocities, speeds = [], residuals.velocities
    relative = residuals._replace(offsets=speeds - residuals.mean_velocities)
    for speed, (seen, apart, weights) in zip(speeds, relative.against_others(), strict=True):
        ones, others, w = speed[seen], speed[seen] - apart, weights[:, None]
        norm = np.sqrt(np.sum(w * ones**2) * np.sum(w * others**2))
        velocities.append(np.sum(w * ones * others) / norm if norm > 0.0 else 0.0)
    return np.array(velocities)
