"""Bundle adjustment: poses and lags of RGB cameras, and the places of people's joints, at once.

A camera sees a joint along a ray. The poses, lags and places that leave the least distances between
joints and rays, in the images, are found by Levenberg's and Marquardt's steps with a robust loss
(Cauchy). The joints' places are eliminated from each step (Schur's complement), so a step solves 7
unknowns per camera, however many joints there are (Triggs et al. 2000, section 6). Four cameras and
14 000 rays take 0.1 s; 7 s with pyceres, whose residuals are Python's, and 14 s with scipy's sparse
least squares (``benchmarks/rgb_rig.py solvers``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import (
    Rigid,
    angle,
    from_matrix,
    from_vector,
    nearest_rotation,
    to_matrix,
    to_vector,
)
from hiros_mcap.kernels.array_types import chosen
from hiros_mcap.kernels.ray_equations import (
    LAG,
    UNKNOWNS,
    RayCameras,
    RayPoints,
    RayWork,
    add_rays,
    move_places,
    ray_loss,
)
from hiros_mcap.skeletons import Flags, Floats, Stamps

STEPS = 12
"""Most steps in each round."""
ENOUGH = 1e-3
"""A step that lowers the loss by a smaller share is the last of a round."""
FIRST_PX, LEAST_PX = 10.0, 0.5
"""Noise before it is measured, and the least."""
RAYLEIGH = 1.17741
"""Median length of a vector of two errors with standard deviation 1."""
PRIOR_RAD, PRIOR_M = np.radians(1.0), 0.05
"""How wrong a given pose usually is; how large the errors of a log are is found from it."""
WRONG = np.geomspace(0.01, 30.0, 60)
"""Errors of given poses that are tried, in units of the usual ones."""
WEIGHINGS, TAILS = 10, 3.0
"""Rounds in which given poses are weighed; degrees of freedom of their errors (Student's t)."""
_DAMPING, _MOST_DAMPING = 1e-4, 1e4
_NO_STEP = 1e-9
"""Share of the largest eigenvalue below which no data tell an unknown: the frame of the rig."""


class Bundle(NamedTuple):
    """C cameras and the P joints at instants whose rays fit them best."""

    points: RayPoints
    cameras: RayCameras
    """Their scales are of the noise that was measured."""
    places: Floats
    """(P, 3) m, in the frame of the given poses."""
    focals: Floats
    """(C,) px."""
    distances: Floats
    """(P, C) px from joint to keypoint; NaN where a camera does not see it."""
    free: Flags
    """(C, 7) which unknowns were refined."""


def triangulated(points: RayPoints, cameras: RayCameras) -> Floats:
    """(P, 3) the places nearest to the rays in space, m; where these are parallel, near them."""
    rays = points.rays + cameras.lags[:, None] * points.velocities
    ones = np.ones((*rays.shape[:2], 1))
    directions = np.einsum("cji,pcj->pci", cameras.rotations, np.concatenate([rays, ones], axis=2))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    weighted = np.where(points.weights > 0.0, points.weights, 0.0)[..., None, None] * across
    centres = -np.einsum("cji,cj->ci", cameras.rotations, cameras.shifts)
    left = weighted.sum(axis=1) + 1e-9 * np.eye(3)
    right = np.einsum("pcij,cj->pi", weighted, centres)
    return np.asarray(np.linalg.solve(left, right[..., None])[..., 0])


def with_common_velocities(points: RayPoints, cameras: RayCameras) -> RayPoints:
    """Replace the velocities in the images by those of the joints' velocities in the room.

    These are the same for all cameras, so they have less noise, which makes steps of lags short.
    """
    places = triangulated(points, cameras)
    before = np.einsum("cij,pj->pci", cameras.rotations, places) + cameras.shifts
    x, y, z = np.moveaxis(before, -1, 0)
    by_place = np.zeros((*z.shape, 2, 3))
    by_place[..., 0, 0] = by_place[..., 1, 1] = 1.0 / z
    by_place[..., 0, 2], by_place[..., 1, 2] = -x / z**2, -y / z**2
    by_place = np.einsum("pcki,cij->pckj", by_place, cameras.rotations)
    weighted = by_place * points.weights[..., None, None]
    left = np.einsum("pcki,pckj->pij", weighted, by_place)
    right = np.einsum("pcki,pck->pi", weighted, points.velocities)
    left += 1e-3 * np.trace(left, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    common = np.linalg.solve(left, right[..., None])[..., 0]
    return points._replace(velocities=np.einsum("pcki,pi->pck", by_place, common))


def adjust(
    points: RayPoints, cameras: RayCameras, focals: Floats, free: Flags, rounds: int = 4
) -> Bundle:
    """Refine poses, lags and places together.

    Parameters
    ----------
    cameras : about right; the scales are not used. focals : (C,) px.
    free : (C, 7) the unknowns that may change: rotation, shift, lag. The frame, the scale and the
        common time of cameras that are all free stay about where they are; see
        :func:`placed`. rounds : how often the noise of keypoints is measured anew.
    """
    places = triangulated(points, cameras)
    squares, noise = np.zeros(points.weights.shape), FIRST_PX
    for _ in range(rounds):
        cameras = cameras._replace(scales=focals / noise)
        cameras, places = _descend(points, cameras, places, free)
        ray_loss(points, cameras, places, squares)
        distances = np.sqrt(squares) * noise
        noise = _noise(distances)
    return Bundle(points, cameras, places, focals, distances, free)


def _noise(distances: Floats) -> float:
    """Return the standard deviation of the keypoints along an axis, px, by the median distance.

    It is one for all cameras: each by its own, the best one would draw all joints onto its rays,
    and be better still. Distances are smaller than errors, since a joint has a place of its own.
    """
    seen = np.count_nonzero(np.isfinite(distances))
    if not seen:
        return FIRST_PX
    spare = max(1.0 - 1.5 * len(distances) / seen, 0.1)
    median = float(np.median(distances[np.isfinite(distances)]))
    return max(median / RAYLEIGH / math.sqrt(spare), LEAST_PX)


def _descend(
    points: RayPoints, cameras: RayCameras, places: Floats, free: Flags
) -> tuple[RayCameras, Floats]:
    """Make steps while they lower the loss."""
    work, squares = RayWork.allocate(len(free)), np.zeros(points.weights.shape)
    loss, damping = ray_loss(points, cameras, places, squares), _DAMPING
    for _ in range(STEPS):
        while damping <= _MOST_DAMPING:
            hessian, slope = equations(points, cameras, places, damping, work)
            steps = _solution(hessian, slope, free, damping)
            moved = np.empty_like(places)
            move_places(points, cameras, places, damping, steps, moved, work)
            trial = _moved(cameras, steps)
            after = ray_loss(points, trial, moved, squares)
            if after < loss:
                break
            damping *= 10.0
        else:
            break
        gain, loss = 1.0 - after / loss, after
        cameras, places, damping = trial, moved, max(damping / 10.0, 1e-7)
        if gain < ENOUGH:
            break
    return cameras, places


def equations(
    points: RayPoints, cameras: RayCameras, places: Floats, damping: float, work: RayWork
) -> tuple[Floats, Floats]:
    """Return the Hessian (7 C, 7 C) and the gradient (7 C,) of all cameras."""
    n = UNKNOWNS * len(cameras.scales)
    hessian, slope = np.zeros((n, n)), np.zeros(n)
    add_rays(points, cameras, places, damping, hessian, slope, work)
    return hessian, slope


def _solution(hessian: Floats, slope: Floats, free: Flags, damping: float) -> Floats:
    """(C, 7) the step against the slope; what no data show hardly changes."""
    chosen = np.flatnonzero(free.ravel())
    steps = np.zeros(free.size)
    some = hessian[np.ix_(chosen, chosen)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(some), 1e-12))
    scaled = some * np.outer(scale, scale) + damping * np.eye(len(chosen))
    steps[chosen] = -scale * np.linalg.solve(scaled, scale * slope[chosen])
    return steps.reshape(free.shape)


def _moved(cameras: RayCameras, steps: Floats) -> RayCameras:
    turns = to_matrix(from_vector(steps[:, :3]))
    return RayCameras(
        np.ascontiguousarray(turns @ cameras.rotations),
        np.einsum("cij,cj->ci", turns, cameras.shifts) + steps[:, 3:LAG],
        cameras.lags + steps[:, LAG],
        cameras.scales,
    )


def standard_errors(bundle: Bundle, *clusters: Stamps) -> Floats:
    """(C, 7) standard errors of rotations, rad, positions, m, and lags, s, along their axes.

    They are those about the rig that fits best: an error of its frame or its scale is in none. What
    one cluster alone tells has a very large one: by a jackknife, one Newton step gives the solution
    without each cluster in turn (Bell and McCaffrey 2002, CR3).

    Parameters
    ----------
    clusters : (P,) each a way to divide the joints into parts whose errors are independent: the
        errors of a keypoint last for seconds. The variances of all ways are added (Cameron, Gelbach
        and Miller 2011, without the part that both count).
    """
    free = bundle.free.ravel()
    variances = np.zeros(free.size)
    for numbers in clusters:
        parts = [_equations_of(bundle, numbers == each, free) for each in np.unique(numbers)]
        hessian = np.sum([part for part, _ in parts], axis=0)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-12))
        sizes, axes = np.linalg.eigh(hessian * np.outer(scale, scale))
        axes = scale[:, None] * axes[:, sizes > _NO_STEP * sizes[-1]]  # not the frame of the rig
        ridge = _NO_STEP * np.eye(axes.shape[1])
        steps = [
            axes @ np.linalg.solve(axes.T @ (hessian - part) @ axes + ridge, axes.T @ slope)
            for part, slope in parts
        ]
        variances[free] += (len(parts) - 1) / len(parts) * (np.array(steps) ** 2).sum(axis=0)
    return np.sqrt(variances).reshape(bundle.free.shape)


def _equations_of(bundle: Bundle, some: Flags, free: Flags) -> tuple[Floats, Floats]:
    """Return the Hessian and the gradient of the free unknowns by some of the joints."""
    points, work = chosen(bundle.points, some), RayWork.allocate(len(bundle.free))
    hessian, slope = equations(points, bundle.cameras, bundle.places[some], 0.0, work)
    return hessian[np.ix_(free, free)], slope[free]


def placed(bundle: Bundle, given: RayCameras, held: Flags, known: Flags | None = None) -> Bundle:
    """Put the rig where the given poses are: their place, direction, size, and median lag.

    The size is the mean distance between the cameras. One camera that is far off does not carry the
    others along (Cauchy weights).

    Parameters
    ----------
    held : (C,) cameras whose pose was not refined. One keeps its place; with two there is nothing
        left to do. known : (C,) cameras that are given, at least two; None = all.
    """
    known = np.ones(len(held), np.bool_) if known is None else known
    if np.count_nonzero(held) > 1:
        return bundle
    cameras = bundle.cameras
    centres, goals = centres_of(cameras), centres_of(given)
    scale = spread_of(goals[known]) / spread_of(centres[known])
    weights = np.where(held if held.any() else known, 1.0, 0.0)
    for _ in range(1 if held.any() else 10):
        share = weights / weights.sum()
        middle, goal = scale * share @ centres, share @ goals
        turns = np.einsum("c,cki,ckj->ij", share, cameras.rotations, given.rotations)
        arms = np.einsum("c,ci,cj->ij", share, scale * centres - middle, goals - goal)
        # The square of an angle is 3 less a trace, that of a distance has twice the trace.
        turn = nearest_rotation(turns / PRIOR_RAD**2 + 2.0 * arms / PRIOR_M**2)
        shift = goal - turn @ middle
        rotations = cameras.rotations @ turn.T
        apart = np.linalg.norm(scale * centres @ turn.T + shift - goals, axis=1) / PRIOR_M
        turned = angle(from_matrix(rotations), from_matrix(given.rotations)) / PRIOR_RAD
        weights = known / (1.0 + apart**2 + turned**2)
    moved = cameras._replace(
        rotations=np.ascontiguousarray(rotations),
        shifts=scale * cameras.shifts - np.einsum("cij,j->ci", rotations, shift),
    )
    places = scale * bundle.places @ turn.T + shift
    return bundle._replace(cameras=moved, places=np.ascontiguousarray(places))


def weighed(bundle: Bundle, given: RayCameras, errors: Floats) -> RayCameras:
    """Weigh the poses that fit the people best against the given ones.

    What people tell well is theirs; what they hardly tell, such as a turn of all cameras that
    shifts the whole room, stays as it is given. How wrong the given poses are is found where people
    do tell it: the errors that make the poses found most likely (empirical Bayes, Morris 1983).
    One camera may be much more wrong than the others (Student's t).

    Parameters
    ----------
    bundle : in the frame of the given poses. errors : (C, 7) :func:`standard_errors`.
    """
    n, free = len(given.lags), bundle.free.ravel()
    posed = np.flatnonzero(free & (np.arange(free.size) % UNKNOWNS != LAG))
    if not posed.size:
        return bundle.cameras
    known, apart = _known_poses(bundle, posed), _between(given, bundle.cameras).ravel()[posed]
    usual = np.tile(np.repeat([PRIOR_RAD, PRIOR_M, 1.0], (3, 3, 1)), n)[posed]
    corrections, worse, cameras = apart, np.ones(n), posed // UNKNOWNS
    for _ in range(WEIGHINGS):
        unit = usual * worse[cameras]
        told, variances, axes = _modes(known * np.outer(unit, unit), errors.ravel()[posed] / unit)
        found = axes.T @ (apart / unit)
        spreads = WRONG[:, None] ** 2 + variances[told]
        fits = (np.log(spreads) + found[told] ** 2 / spreads).sum(axis=1)
        size = WRONG[np.argmin(fits)]
        corrections = unit * (axes @ (found / (1.0 + variances / size**2)))
        squares = np.bincount(cameras, (corrections / (size * usual)) ** 2, n)
        worse = np.sqrt((TAILS + squares) / (TAILS + LAG))
    back = np.zeros(free.size)
    back[posed] = corrections - apart
    return _moved(bundle.cameras, back.reshape(bundle.free.shape))


def _known_poses(bundle: Bundle, posed: Stamps) -> Floats:
    """(N, N) what the rays tell of some unknowns of poses, whatever the lags are."""
    work = RayWork.allocate(len(bundle.free))
    hessian, _ = equations(bundle.points, bundle.cameras, bundle.places, 0.0, work)
    timed = np.flatnonzero(bundle.free[:, LAG]) * UNKNOWNS + LAG
    tied = hessian[np.ix_(posed, timed)]
    lags = np.linalg.pinv(hessian[np.ix_(timed, timed)], hermitian=True) @ tied.T
    return np.asarray(hessian[np.ix_(posed, posed)] - tied @ lags)


def _modes(known: Floats, errors: Floats) -> tuple[Flags, Floats, Floats]:
    """Return which axes the rays tell, the variances along all, and the axes (N, N) as columns.

    Rays err together, so variances are larger than those of independent rays: by the one factor
    that brings these to the standard errors.
    """
    sizes, axes = np.linalg.eigh(known)
    told = sizes > _NO_STEP * sizes[-1]
    alone = (axes[:, told] ** 2 / sizes[told]).sum(axis=1)
    factor = np.median(errors**2 / np.maximum(alone, np.finfo(np.float64).tiny))
    return told, np.where(told, factor / np.where(told, sizes, 1.0), np.inf), axes


def _between(cameras: RayCameras, others: RayCameras) -> Floats:
    """(C, 7) the steps from cameras to others, as :func:`_moved` takes them, without lags."""
    steps = np.zeros((len(cameras.lags), UNKNOWNS))
    turns = others.rotations @ np.swapaxes(cameras.rotations, 1, 2)
    steps[:, :3] = to_vector(from_matrix(turns))
    apart = centres_of(others) - centres_of(cameras)
    steps[:, 3:LAG] = -np.einsum("cij,cj->ci", others.rotations, apart)
    return steps


def centres_of(cameras: RayCameras) -> Floats:
    """(C, 3) where the cameras stand, m."""
    return np.asarray(-np.einsum("cji,cj->ci", cameras.rotations, cameras.shifts))


def spread_of(centres: Floats) -> float:
    """Return the mean distance between cameras (C, 3), m."""
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    return float(apart.sum() / max(len(centres) * (len(centres) - 1), 1))


def cameras_at(poses: Sequence[Rigid], lags: Floats | None = None) -> RayCameras:
    """Return cameras at poses in the room, as the equations take them; the scales are 1."""
    into = [pose.inverse() for pose in poses]
    return RayCameras(
        to_matrix(np.stack([pose.xyzw for pose in into])),
        np.stack([pose.translation for pose in into]),
        np.zeros(len(into)) if lags is None else np.array(lags, np.float64),
        np.ones(len(into)),
    )


def poses_of(cameras: RayCameras) -> list[Rigid]:
    """Return the cameras' poses in the room."""
    turns = from_matrix(cameras.rotations)
    return [Rigid(*pose).inverse() for pose in zip(turns, cameras.shifts, strict=True)]
