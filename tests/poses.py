"""A person whose joint angles are known by construction."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from hiros_mcap.simulate.body_model import (
    LINK_SEGMENTS,
    PARENT_SEGMENT,
    SEGMENTS,
    UPRIGHT,
    BodyModel,
)
from hiros_mcap.skeletons import Floats

BODY = BodyModel.of(1.75)
SIGN = {"right": 1.0, "left": -1.0}
"""Of abduction and inward rotation."""
Triple = tuple[float, float, float]


def turned(**joints):
    """(S, 3, 3) the segments of a person with these ISB angles z x y, degrees, all others 0."""
    rotations: dict[str, Floats] = {}
    for segment in SEGMENTS:
        part, _, side = segment.rpartition("_")
        if not part or side not in SIGN:
            part, side = segment, ""
        parent = PARENT_SEGMENT.get(part)
        base = UPRIGHT
        if parent is not None:
            base = rotations[parent if parent in rotations else f"{parent}_{side}"]
        turn = Rotation.from_euler("ZXY", joints.get(segment, (0, 0, 0)), degrees=True)
        rotations[segment] = base @ turn.as_matrix()
    return np.stack([rotations[segment] for segment in SEGMENTS])


def posed(**joints):
    """(1, M, 3) the markers of such a person, m."""
    return BODY.markers(np.zeros((1, 3)), turned(**joints)[None])


def links(*convention, **joints):
    """(1, L, 4) x y z w of the person's links, by a detector of its own convention.

    ``convention`` are Euler angles, degrees, from the ISB axes of a segment to those of its link.
    """
    own = Rotation.from_euler("xyz", convention or (0.0, 0.0, 0.0), degrees=True)
    return (Rotation.from_matrix(turned(**joints)[LINK_SEGMENTS]) * own).as_quat()[None]
