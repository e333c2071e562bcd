"""Where the rig as a whole stands. What the cameras see of each other's people cannot tell that.

The log's transforms do, or the floor that people stand on. People lean, so up is known to one or
two degrees. A transform or an inertial sensor is better where there is one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import (
    Rigid,
    from_matrix,
    from_vector,
    to_matrix,
    to_vector,
)
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.calibrate.registration import cauchy
from hiros_mcap.calibrate.sampling import Rig
from hiros_mcap.skeletons import Floats, SkeletonModel

WORLD = "world"
"""Fixed frame of a log whose cameras have no transforms."""
PRIOR_DEG = 0.3
"""SD of an orientation that the log states, per axis."""
PRIOR_M = 0.006
"""SD of a position that the log states, per axis."""
CHI2_3_MEDIAN = 2.36597
"""Median of a chi-square distribution with three degrees of freedom."""
_AXES = 3
ROUNDS = 20
_UNKNOWN = 1.0  # standard error, radians or m, from which on a pose tells nothing
STILL = 1e-5
"""A step that changes less, m or radians, is the last."""
_ROUNDING = 1e-9  # by so much a sum may grow and be the same
LEVEL, TILTED = (2.0, 0.1), (4.0, 0.25)
"""Degrees and m by which right poses have the floor elsewhere at most, and wrong ones at least."""

Placement = tuple[Floats, Floats]
"""Rotation (3, 3) and shift (3,) of the common frame in the fixed frame."""


class PlacementError(NamedTuple):
    """How uncertain it is where the rig as a whole stands."""

    middle: Floats  # (3,) of the cameras, m
    turn: Floats  # (3, 3) covariance of a small rotation about the middle, rad2
    shift: float  # variance of the middle along each axis, m2

    def variances(self, positions: Floats) -> Floats:
        """(...) Mean variance along each axis, m2, of positions (..., 3), m."""
        away = positions - self.middle
        # trace([x] S [x]'), with the matrix [x] of the cross product
        across = (away**2).sum(axis=-1) * np.trace(self.turn)
        across -= np.einsum("...i,ij,...j->...", away, self.turn, away)
        return np.asarray(self.shift + across / 3.0)

    @property
    def degrees(self) -> float:
        """Standard deviation of the orientation about an axis."""
        return float(np.degrees(np.sqrt(np.trace(self.turn) / 3.0)))

    @property
    def metres(self) -> float:
        """Standard deviation of the middle along an axis."""
        return float(np.sqrt(self.shift))


def placement_error(
    places: Mapping[str, Floats],
    to_given: Mapping[str, Rigid],
    angle: float = math.radians(PRIOR_DEG),
    shift: float = PRIOR_M,
) -> PlacementError | None:
    """Return how wrong the placement of a rig is that was fitted to the given poses.

    How far the given poses deviate from the refined rig shows how wrong they are. Orientation and
    position are treated apart, by the median over the cameras. The assumption counts as some more
    measured coordinates (scaled inverse chi square, Gelman et al. 2013, section 2.6).

    Parameters
    ----------
    places : camera -> position, m. to_given : camera -> what takes its people back to the pose that
        was given, where it was refined. angle, shift : assumed standard deviations of the given
        poses, rad and m.

    Returns None if no camera's position is known.
    """
    complete = [name for name, place in places.items() if not np.isnan(place).any()]
    if not complete:
        return None
    refined = [name for name in complete if name in to_given]
    if refined:
        turns = np.stack([to_vector(to_given[name].xyzw) for name in refined])
        back = [to_given[name].moved(places[name]) - places[name] for name in refined]
        angle *= math.sqrt(_observed(turns / angle))
        shift *= math.sqrt(_observed(np.stack(back) / shift))
    at = np.stack([places[name] for name in complete])
    middle = at.mean(axis=0)
    arms = at - middle
    # Hessian of the deviations in units of the prior; about the middle it has no mixed part.
    level = (arms**2).sum() * np.eye(3) - arms.T @ arms
    hessian = len(at) * np.eye(3) / angle**2 + level / shift**2
    return PlacementError(middle, np.linalg.inv(hessian), shift**2 / len(at))


def _observed(scaled: Floats) -> float:
    """Return observed over assumed variance of vectors (C, 3) in assumed standard deviations.

    It is at least 1: where all cameras deviate alike, they do not deviate from the rig.
    """
    free = 3 * (len(scaled) - 1)
    middle = float(np.median((scaled**2).sum(axis=1))) / CHI2_3_MEDIAN
    return max(1.0, (_AXES + free * middle) / (_AXES + free))


def on_transforms(rig: Rig, given: Mapping[int, Rigid], errors: Floats | None = None) -> Placement:
    """Return the placement that keeps the rig where the log's transforms put it.

    It minimises the deviations of all cameras from the log's poses in units of their standard
    deviations, with Cauchy weights: a camera that was moved does not carry the others along.

    Parameters
    ----------
    errors : (C, 2) standard errors of the rig's poses, radians and m; None = none. A camera that
        the people hardly place in the rig tells little about where the rig stands.
    """
    cameras = list(given)
    deviations = np.tile([np.radians(PRIOR_DEG), PRIOR_M], (len(cameras), 1))
    if errors is not None:
        deviations = np.hypot(deviations, np.minimum(errors[cameras], _UNKNOWN))
    starts = [_by_camera(rig, c, pose) for c, pose in given.items()]
    best = min(
        starts,
        key=lambda start: float(np.log1p(_deviations(rig, given, deviations, start)[2]).sum()),
    )
    for _ in range(ROUNDS):
        before, best = best, _improved(rig, given, deviations, best)
        if max(np.abs(a - b).max() for a, b in zip(before, best, strict=True)) < STILL:
            break
    return best


def without_tilted(rig: Rig, given: Mapping[int, Rigid], floor: Floor | None) -> dict[int, Rigid]:
    """Return the log's poses but for those by which people do not stand on the floor, z = 0.

    Of two cameras that contradict each other, this tells which one was moved. All stay where none
    confirms that the floor is there.
    """

    def tilt(c: int) -> tuple[float, float]:
        """Return by how many degrees and m a camera's pose puts the floor elsewhere."""
        up, height = floor or (np.zeros(3), 0.0)
        turn, shift = _by_camera(rig, c, given[c])
        degrees = np.degrees(np.arccos(np.clip((turn @ up)[2], -1.0, 1.0)))
        return float(degrees), abs(float((turn @ up * height + shift)[2]))

    tilts = {c: tilt(c) for c in given}
    if not any(degrees < LEVEL[0] and metres < LEVEL[1] for degrees, metres in tilts.values()):
        return dict(given)
    wrong = [c for c, (degrees, m) in tilts.items() if degrees > TILTED[0] or m > TILTED[1]]
    return {c: pose for c, pose in given.items() if c not in wrong}


def _by_camera(rig: Rig, c: int, pose: Rigid) -> Placement:
    """Return the placement that puts one camera exactly where the log has it."""
    turn = to_matrix(pose.xyzw) @ rig.rotations[c].T
    return turn, pose.translation - turn @ rig.shifts[c]


def _deviations(
    rig: Rig, given: Mapping[int, Rigid], deviations: Floats, placement: Placement
) -> tuple[Floats, Floats, Floats]:
    """(K, 3) rotation and (K, 3) shift of each camera against the log, and (K,) chi squared.

    ``deviations`` (K, 2) are standard deviations of both, radians and m.
    """
    turn, shift = placement
    cameras = list(given)
    turned = turn @ rig.rotations[cameras]
    goals = to_matrix(np.stack([pose.xyzw for pose in given.values()]))
    angles = to_vector(from_matrix(turned @ np.swapaxes(goals, 1, 2)))
    places = rig.shifts[cameras] @ turn.T + shift
    shifts = places - np.stack([pose.translation for pose in given.values()])
    angle, metres = deviations.T[:, :, None]
    return angles, shifts, np.sum((angles / angle) ** 2 + (shifts / metres) ** 2, axis=1)


def _improved(
    rig: Rig, given: Mapping[int, Rigid], deviations: Floats, placement: Placement
) -> Placement:
    """Return the placement after one Gauss-Newton step; it turns about the cameras' middle.

    The placement stays if the step makes it worse: poses that contradict the rig may have no end.
    """
    angles, shifts, chi2 = _deviations(rig, given, deviations, placement)
    # All poses may be worse than the prior says; only those that are worse than most count less.
    scale = max(6.0, float(np.median(chi2)))
    weights = 1.0 / (1.0 + chi2 / scale)
    turn, shift = placement
    places = rig.shifts[list(given)] @ turn.T + shift
    angle, metres = deviations.T[:, :, None, None]
    rows = np.zeros((len(places), 6, 6))
    rows[:, :3, :3] = np.eye(3) / angle
    rows[:, 3:, :3] = np.cross(places[:, None], np.eye(3)) / metres
    rows[:, 3:, 3:] = np.eye(3) / metres
    off = np.concatenate([angles / angle[:, 0], shifts / metres[:, 0]], axis=1)
    hessian = np.einsum("k,kia,kib->ab", weights, rows, rows)
    slope = np.einsum("k,kia,ki->a", weights, rows, off)
    step = -np.linalg.solve(hessian, slope)
    small = to_matrix(from_vector(step[:3]))
    after = small @ turn, small @ shift + step[3:]
    cost, less = (
        float(np.log1p(each / scale).sum())
        for each in (chi2, _deviations(rig, given, deviations, after)[2])
    )
    return after if less <= cost * (1.0 + _ROUNDING) else placement


def on_floor(rig: Rig, floor: Floor | None, people: Floats) -> Placement:
    """Return the placement with z up from the floor, below the first camera's position.

    x points from there towards the people: along that axis of the camera which is nearest to the
    direction in which it sees them. Without a floor, the camera's own frame stays.

    Parameters
    ----------
    people : (3,) where people are, in the rig's common frame, m.
    """
    if floor is None:
        return np.eye(3), np.zeros(3)
    up, height = floor
    axes = np.concatenate([rig.rotations[0].T, -rig.rotations[0].T])
    towards = people - rig.shifts[0]
    for axis in axes[np.argsort(-(axes @ towards))]:
        level = axis - (axis @ up) * up
        if np.linalg.norm(level) > 0.3:
            break
    x = level / np.linalg.norm(level)
    turn = np.stack([x, np.cross(up, x), up])
    below = rig.shifts[0] - (rig.shifts[0] @ up - height) * up
    return turn, -turn @ below


def moved(rig: Rig, placement: Placement) -> Rig:
    """Return the rig in the fixed frame."""
    turn, shift = placement
    return rig._replace(rotations=turn @ rig.rotations, shifts=rig.shifts @ turn.T + shift)


LEAN_DEG = 8.0
"""Trunk and legs of somebody who stands upright differ by less."""
SLOW_M_S = 0.2
"""A foot that stands on the floor moves by less."""
NEAR_M = 0.1
"""Feet that are higher above the floor do not stand on it."""
SPREAD_M = 0.4
"""Feet spread so far (SD) in both directions of a floor whose tilt they tell."""
STEEP_DEG = 5.0
"""A floor that is tilted more against people who stand is not believed."""
_PARTS = {
    "ankle": ("ankle",),
    "foot": ("foot", "toe", "bigtoe", "big_toe", "toebase", "heel"),
    "neck": ("neck", "spineshoulder", "spine_shoulder", "spine_chest"),
    "pelvis": ("pelvis", "spinebase", "midhip", "hips", "spine_base", "hip"),
}


Floor = tuple[Floats, float]
"""A horizontal plane: up, a unit vector (3,), and the height of the floor along it, m."""


def find_floor(model: SkeletonModel, poses: Floats, velocities: Floats) -> Floor | None:
    """Find the floor that people stand on; None where nobody stands, or joints have other names.

    Parameters
    ----------
    poses : (G, M, 3) of people in any common frame, m; NaN = absent.
    velocities : (G, M, 3) m/s.
    """
    names = [split_side(name)[0] for name in model.marker_names]
    at = {
        part: [m for m, name in enumerate(names) if name in aliases]
        for part, aliases in _PARTS.items()
    }
    at["neck"] = at["neck"] or [m for m, name in enumerate(names) if name == "shoulder"]
    if not (at["ankle"] and at["neck"] and at["pelvis"]):
        return None
    ankle, pelvis, neck = (poses[:, at[part]].mean(axis=1) for part in ("ankle", "pelvis", "neck"))
    complete = ~np.isnan(ankle + pelvis + neck).any(axis=1)
    up = _upright(ankle[complete], pelvis[complete], neck[complete])
    feet = at["foot"] or at["ankle"]
    places, speeds = poses[:, feet].reshape(-1, 3), velocities[:, feet].reshape(-1, 3)
    slow = np.linalg.norm(speeds, axis=1) < SLOW_M_S  # False for NaN
    points = places[slow & ~np.isnan(places).any(axis=1)]
    if up is None or not len(points):
        return None
    return _plane(points, up)


def _upright(ankle: Floats, pelvis: Floats, neck: Floats) -> Floats | None:
    """Return the direction from ankles to neck of those whose trunk and legs are in line."""
    trunk, legs, whole = _unit(neck - pelvis), _unit(pelvis - ankle), _unit(neck - ankle)
    lean = np.degrees(np.arccos(np.clip(np.sum(trunk * legs, axis=1), -1.0, 1.0)))
    weights = np.exp(-((lean / LEAN_DEG) ** 2))
    if weights.sum() < 1.0:
        return None
    return np.asarray(_unit((weights @ whole)[None])[0])


def _plane(points: Floats, up: Floats) -> Floor:
    """Fit a plane to feet: heights against places, robust; level where they hardly spread."""
    first = _unit(np.cross(up, np.eye(3)[np.argmin(np.abs(up))])[None])[0]
    across = np.stack([first, np.cross(up, first)], axis=1)
    middle = points.mean(axis=0)
    flat, heights = (points - middle) @ across, (points - middle) @ up
    level = float(np.percentile(heights, 20.0))  # feet in the air are higher
    near = np.abs(heights - level) < NEAR_M + np.linalg.norm(flat, axis=1) * np.radians(STEEP_DEG)
    flat, heights = flat[near], heights[near]
    if np.linalg.eigvalsh(np.cov(flat.T))[0] < SPREAD_M**2 if len(flat) > 2 else True:
        return up, level + float(middle @ up)
    design = np.column_stack([flat, np.ones(len(flat))])
    weights = np.ones(len(flat))
    for _ in range(10):
        root = np.sqrt(weights)
        slope = np.linalg.lstsq(design * root[:, None], heights * root, rcond=None)[0]
        errors = heights - design @ slope
        weights = cauchy(errors)
    if np.degrees(np.arctan(np.hypot(*slope[:2]))) > STEEP_DEG:
        return up, level + float(middle @ up)
    normal = _unit((up - across @ slope[:2])[None])[0]
    return normal, float((middle + slope[2] * up) @ normal)


def _unit(vectors: Floats) -> Floats:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-12))
