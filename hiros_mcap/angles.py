"""Joint angles: the eight flexions that the Hi-ROS paper reports (section 4)."""

from __future__ import annotations

import numpy as np

from hiros_mcap.skeletons import Floats, SkeletonModel
from hiros_mcap.symmetry import split_side

# Markers of a joint's limbs, towards the extremity; two of them are compared with the trunk.
_CHAINS = (
    ("shoulder", "elbow"),
    ("shoulder", "elbow", "wrist"),
    ("hip", "knee"),
    ("hip", "knee", "ankle"),
)
# From neck to pelvis, by the names that detectors use.
_TRUNKS = (("neck", "pelvis"), ("neck", "spinebase"), ("neck", "midhip"), ("neck", "hips"))

JOINTS = ("shoulder", "elbow", "hip", "knee")
ANGLES = tuple(f"{side} {joint}" for side in ("left", "right") for joint in JOINTS)
"""Names of the columns of :func:`flexions`."""


def flexions(model: SkeletonModel, positions: Floats) -> Floats:
    """(..., 8) flexion angles, rad: left then right shoulder, elbow, hip, knee.

    ``positions`` (..., M, 3). The angle between a limb's bone and the next one towards the trunk,
    or the trunk itself, from the marker positions: 0 is straight. It needs no convention of link
    frames, in which detectors differ. NaN where a marker is missing.
    """
    slots = {split_side(name): slot for slot, name in enumerate(model.marker_names)}
    names = {part for part, _ in slots}
    trunk = next(((a, b) for a, b in _TRUNKS if a in names and b in names), ("", ""))
    angles = []
    for side in ("left", "right"):
        for chain in _CHAINS:
            ends = [slots.get((name, side)) for name in chain]
            ends = [slots.get((name, "")) for name in trunk] * (len(chain) == 2) + ends
            if None in ends or len(ends) < 3:
                angles.append(np.full(positions.shape[:-2], np.nan))
                continue
            points = [positions[..., slot, :] for slot in ends]
            angles.append(_between(points[1] - points[0], points[-1] - points[-2]))
    return np.stack(angles, axis=-1)


def _between(u: Floats, v: Floats) -> Floats:
    """Angle between vectors, rad; by its tangent, which is exact for small angles, too."""
    cross = np.linalg.norm(np.cross(u, v), axis=-1)
    angle: Floats = np.arctan2(cross, np.sum(u * v, axis=-1))
    return angle
