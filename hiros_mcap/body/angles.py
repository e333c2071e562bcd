"""Joint angles: the eight flexions that the Hi-ROS paper reports (section 4)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hiros_mcap.body.rotations import conjugate, multiply
from hiros_mcap.body.segments import SIDES, between
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.skeletons import Floats, SkeletonModel

# Markers of a joint's limbs, towards the extremity; chains of two are compared with the trunk.
_CHAINS = (
    ("shoulder", "elbow"),
    ("shoulder", "elbow", "wrist"),
    ("hip", "knee"),
    ("hip", "knee", "ankle"),
)
# From neck to pelvis, by the names that detectors use.
_TRUNKS = (("neck", "pelvis"), ("neck", "spinebase"), ("neck", "midhip"), ("neck", "hips"))

JOINTS = ("shoulder", "elbow", "hip", "knee")
ANGLES = tuple(f"{side} {joint}" for side in SIDES for joint in JOINTS)
"""Names of the columns of :func:`flexions`."""


def flexions(model: SkeletonModel, positions: Floats) -> Floats:
    """(..., 8) flexion angles, rad: left then right shoulder, elbow, hip, knee.

    ``positions`` is (..., M, 3), m. A flexion is the angle between a link and the next one towards
    the trunk, or the trunk itself: 0 is straight. Marker positions need no convention of link
    frames, in which detectors differ. NaN where a marker is missing.
    """
    slots = {split_side(name): slot for slot, name in enumerate(model.marker_names)}
    names = {part for part, _ in slots}
    trunk = next(((a, b) for a, b in _TRUNKS if a in names and b in names), ("", ""))
    angles = []
    for side in SIDES:
        for chain in _CHAINS:
            ends = [slots.get((name, side)) for name in chain]
            ends = [slots.get((name, "")) for name in trunk] * (len(chain) == 2) + ends
            if None in ends or len(ends) < 3:
                angles.append(np.full(positions.shape[:-2], np.nan))
                continue
            points = [positions[..., slot, :] for slot in ends]
            angles.append(between(points[1] - points[0], points[-1] - points[-2]))
    return np.stack(angles, axis=-1)


def euler_zxy(xyzw: Floats) -> Floats:
    """(..., 3) Angles about z, x', y'' of rotations (..., 4), rad: R = Rz Rx Ry.

    The sequence of the ISB recommendation that Hi-ROS follows (section 4): z is flexion and
    extension, x abduction and adduction, y internal and external rotation. z and y lie in
    -pi..pi, x in -pi/2..pi/2; at the ends of x, the axes of z and y coincide. NaN gives NaN, which
    scipy's Rotation refuses.
    """
    x, y, z, w = np.moveaxis(np.asarray(xyzw, np.float64), -1, 0)
    return np.stack(
        [
            np.arctan2(2 * (w * z - x * y), 1 - 2 * (x * x + z * z)),
            np.arcsin(np.clip(2 * (y * z + w * x), -1.0, 1.0)),
            np.arctan2(2 * (w * y - x * z), 1 - 2 * (x * x + y * y)),
        ],
        axis=-1,
    )


def wrapped(angles: Floats) -> Floats:
    """Angles, rad, wrapped to -pi..pi: the difference of 179 and -179 degrees becomes -2."""
    return np.asarray((np.asarray(angles) + np.pi) % (2 * np.pi) - np.pi)


def joint_links(model: SkeletonModel) -> tuple[tuple[int, int], ...]:
    """(proximal, distal) link slots of each of :data:`ANGLES`, -1 where the model lacks one.

    A limb's link joins two of its markers. The trunk's link is the one that ends at the neck for
    the shoulders, and the first one that leaves the pelvis upwards for the hips.
    """
    slots = {split_side(name): slot for slot, name in enumerate(model.marker_names)}
    ends = list(zip(model.link_parents, model.link_children, strict=True))

    def link(parent: tuple[str, str], child: tuple[str, str]) -> int:
        pair = (slots.get(parent, -2), slots.get(child, -2))
        return ends.index(pair) if pair in ends else -1

    neck = slots.get(("neck", ""), -2)
    upper = next((k for k, (_, child) in enumerate(ends) if child == neck), -1)
    root = next((slots[(name, "")] for _, name in _TRUNKS if (name, "") in slots), -2)
    middle = {slot for (_, side), slot in slots.items() if not side}
    lower = next((k for k, (p, c) in enumerate(ends) if p == root and c in middle), -1)
    pairs = []
    for side in SIDES:
        for above, *joints in ((upper, *_CHAINS[1]), (lower, *_CHAINS[3])):
            near, far = (link((a, side), (b, side)) for a, b in pairwise(joints))
            pairs += [(above, near), (near, far)]
    return tuple(pairs)


def link_angles(model: SkeletonModel, orientations: Floats) -> Floats:
    """(..., 8, 3) Angles z, x, y, rad, of link ``orientations`` (..., L, 4) x y z w, by joint.

    Hi-ROS eq 21: the distal link in the frame of the proximal one, by :func:`euler_zxy`. They
    depend on a detector's convention of link frames. NaN where a link or its orientation is
    missing.
    """
    angles = []
    for proximal, distal in joint_links(model):
        if min(proximal, distal) < 0:
            angles.append(np.full((*orientations.shape[:-2], 3), np.nan))
            continue
        back = conjugate(orientations[..., proximal, :])
        angles.append(euler_zxy(multiply(back, orientations[..., distal, :])))  # eq 21
    return np.stack(angles, axis=-2)
