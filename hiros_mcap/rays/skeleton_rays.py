"""3D skeletons whose depth is guessed, as keypoints: only the directions of their joints count."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid, from_vector
from hiros_mcap.skeletons import Floats, SkeletonModel

LENS = Intrinsics(
    (2000, 2000), np.array([[1000.0, 0, 1000], [0, 1000, 1000], [0, 0, 1]]), np.zeros(0)
)
"""Of an image that such skeletons could be from: a px is a thousandth of the distance."""


class GuessedDepth(NamedTuple):
    """Channels of 3D skeletons whose depth is guessed."""

    models: dict[str, SkeletonModel]
    """Of the joints on each topic."""
    turns: dict[str, Rigid]
    """Coordinate frame -> how the optical frame is turned in it."""


NONE_GUESSED = GuessedDepth({}, {})


def looking_at(positions: Floats) -> Rigid:
    """Return how an optical frame is turned in a camera's frame, to look at (..., 3) joints, m.

    The camera's frame may have any of its axes forwards.
    """
    ways = positions[np.isfinite(positions[..., 0])]
    mean = (ways / np.linalg.norm(ways, axis=1, keepdims=True)).mean(axis=0)
    mean /= np.linalg.norm(mean)
    axis = np.cross([0.0, 0.0, 1.0], mean)
    sine = np.linalg.norm(axis)
    # Straight backwards, any axis across will do.
    axis = axis / sine if sine > 1e-6 else np.array([1.0, 0.0, 0.0])
    return Rigid(from_vector(np.arctan2(sine, mean[2]) * axis), np.zeros(3))


def keypoints_of(positions: Floats, turn: Rigid) -> Floats:
    """(..., 2) px of :data:`LENS` of (..., 3) joints in a camera's frame, m; NaN stays NaN."""
    return LENS.pixels(turn.inverse().moved(positions))
