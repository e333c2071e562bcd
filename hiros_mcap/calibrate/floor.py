"""Where up is, and the floor, from people who stand and walk.

People lean, so up is known to one or two degrees. A transform or an inertial sensor is better where
there is one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.body.symmetry import split_side
from hiros_mcap.calibrate.registration import cauchy
from hiros_mcap.skeletons import Floats, SkeletonModel

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
ROUNDS = 10
_PARTS = {
    "ankle": ("ankle",),
    "foot": ("foot", "toe", "bigtoe", "big_toe", "toebase", "heel"),
    "neck": ("neck", "spineshoulder", "spine_shoulder", "spine_chest"),
    "pelvis": ("pelvis", "spinebase", "midhip", "hips", "spine_base", "hip"),
}


class Floor(NamedTuple):
    """A horizontal plane."""

    up: Floats
    """(3,) unit vector."""
    height: float
    """Of the floor along ``up``, m."""


def find_floor(model: SkeletonModel, poses: Floats, velocities: Floats) -> Floor | None:
    """Find the floor that people stand on; None where nobody stands, or joints have other names.

    Parameters
    ----------
    poses : (G, M, 3) of people in any common frame, m; NaN = absent.
    velocities : (G, M, 3) m/s.
    """
    names = [split_side(name)[0] for name in model.marker_names]
    at = {
        part: [m for m, name in enumerate(names) if name in some] for part, some in _PARTS.items()
    }
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
        return Floor(up, level + float(middle @ up))
    design = np.column_stack([flat, np.ones(len(flat))])
    weights = np.ones(len(flat))
    for _ in range(ROUNDS):
        root = np.sqrt(weights)
        slope = np.linalg.lstsq(design * root[:, None], heights * root, rcond=None)[0]
        errors = heights - design @ slope
        weights = cauchy(errors)
    if np.degrees(np.arctan(np.hypot(*slope[:2]))) > STEEP_DEG:
        return Floor(up, level + float(middle @ up))
    normal = _unit((up - across @ slope[:2])[None])[0]
    return Floor(normal, float((middle + slope[2] * up) @ normal))


def _unit(vectors: Floats) -> Floats:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-12))
