"""Where the rig as a whole stands. What the cameras see of each other's people cannot tell that."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hiros_mcap.body.rotations import Rigid, from_matrix, from_vector, to_matrix, to_vector
from hiros_mcap.calibrate.floor import Floor
from hiros_mcap.calibrate.sampling import Rig
from hiros_mcap.skeletons import Floats

PRIOR_DEG = 0.3
"""SD of an orientation that the log states, per axis."""
PRIOR_M = 0.006
"""SD of a position that the log states, per axis."""
ROUNDS = 20
STILL = 1e-5
"""A step that changes less, m or radians, is the last."""

Placement = tuple[Floats, Floats]
"""Rotation (3, 3) and shift (3,) of the common frame in the fixed frame."""


def on_transforms(rig: Rig, given: Mapping[int, Rigid]) -> Placement:
    """Return the placement that keeps the rig where the log's transforms put it.

    It minimises the deviations of all cameras from the log's poses in units of the prior, with
    Cauchy weights: a camera that was moved does not carry the others along.
    """
    starts = [_by_camera(rig, c, pose) for c, pose in given.items()]
    best = min(starts, key=lambda start: float(np.log1p(_deviations(rig, given, start)[2]).sum()))
    for _ in range(ROUNDS):
        before, best = best, _improved(rig, given, best)
        if max(np.abs(a - b).max() for a, b in zip(before, best, strict=True)) < STILL:
            break
    return best


def _by_camera(rig: Rig, c: int, pose: Rigid) -> Placement:
    """Return the placement that puts one camera exactly where the log has it."""
    turn = to_matrix(pose.xyzw) @ rig.rotations[c].T
    return turn, pose.translation - turn @ rig.shifts[c]


def _deviations(
    rig: Rig, given: Mapping[int, Rigid], placement: Placement
) -> tuple[Floats, Floats, Floats]:
    """(K, 3) rotation and (K, 3) shift of each camera against the log, and (K,) chi squared."""
    turn, shift = placement
    cameras = list(given)
    turned = turn @ rig.rotations[cameras]
    wanted = to_matrix(np.stack([pose.xyzw for pose in given.values()]))
    angles = to_vector(from_matrix(turned @ np.swapaxes(wanted, 1, 2)))
    places = rig.shifts[cameras] @ turn.T + shift
    shifts = places - np.stack([pose.translation for pose in given.values()])
    chi2 = np.sum((angles / np.radians(PRIOR_DEG)) ** 2, axis=1)
    return angles, shifts, chi2 + np.sum((shifts / PRIOR_M) ** 2, axis=1)


def _improved(rig: Rig, given: Mapping[int, Rigid], placement: Placement) -> Placement:
    """Return the placement after one Gauss-Newton step; it turns about the cameras' middle."""
    angles, shifts, chi2 = _deviations(rig, given, placement)
    # All poses may be worse than the prior says; only those that are worse than most count less.
    weights = 1.0 / (1.0 + chi2 / max(6.0, float(np.median(chi2))))
    turn, shift = placement
    places = rig.shifts[list(given)] @ turn.T + shift
    rows = np.zeros((len(places), 6, 6))
    rows[:, :3, :3] = np.eye(3) / np.radians(PRIOR_DEG)
    rows[:, 3:, :3] = np.cross(places[:, None], np.eye(3)) / PRIOR_M
    rows[:, 3:, 3:] = np.eye(3) / PRIOR_M
    off = np.concatenate([angles / np.radians(PRIOR_DEG), shifts / PRIOR_M], axis=1)
    hessian = np.einsum("k,kia,kib->ab", weights, rows, rows)
    slope = np.einsum("k,kia,ki->a", weights, rows, off)
    step = -np.linalg.solve(hessian, slope)
    small = to_matrix(from_vector(step[:3]))
    return small @ turn, small @ shift + step[3:]


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
    axes = np.concatenate([rig.rotations[0].T, -rig.rotations[0].T])
    towards = people - rig.shifts[0]
    for axis in axes[np.argsort(-(axes @ towards))]:
        level = axis - (axis @ floor.up) * floor.up
        if np.linalg.norm(level) > 0.3:
            break
    x = level / np.linalg.norm(level)
    turn = np.stack([x, np.cross(floor.up, x), floor.up])
    below = rig.shifts[0] - (rig.shifts[0] @ floor.up - floor.height) * floor.up
    return turn, -turn @ below


def moved(rig: Rig, placement: Placement) -> Rig:
    """Return the rig in the fixed frame."""
    turn, shift = placement
    return rig._replace(rotations=turn @ rig.rotations, shifts=rig.shifts @ turn.T + shift)
