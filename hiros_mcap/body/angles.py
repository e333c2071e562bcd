"""Joint angles: the eight flexions that the Hi-ROS paper reports (section 4)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hiros_mcap.body.rotations import to_matrix
from hiros_mcap.body.segments import NECK, PELVIS, SIDES, between, finder, zxy
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.skeletons import Floats, SkeletonModel

_CHAINS = ("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")
"""Markers of the limbs of each side, towards the extremity."""
JOINTS = ("shoulder", "elbow", "hip", "knee")
ANGLES = tuple(f"{side} {joint}" for side in SIDES for joint in JOINTS)
"""Names of the columns of :func:`flexions`."""


def flexions(model: SkeletonModel, positions: Floats) -> Floats:
    """(T, 8) flexion angles, rad: left then right shoulder, elbow, hip, knee.

    ``positions`` is (T, M, 3), m. A flexion is the angle between a link and the next one towards
    the trunk, or the trunk itself: 0 is straight. Marker positions need no convention of link
    frames, in which detectors differ. NaN where a marker is missing.
    """
    at, angles = finder(model, positions), list[Floats]()
    for side in SIDES:
        for chain in _CHAINS:
            first, joint, end = (at(name, side=side) for name in chain)
            angles.append(between(at(*PELVIS) - at(*NECK), joint - first))
            angles.append(between(joint - first, end - joint))
    return np.stack(angles, axis=-1)


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
    root = next((slots[(name, "")] for name in PELVIS if (name, "") in slots), -2)
    middle = {slot for (_, side), slot in slots.items() if not side}
    lower = next((k for k, (p, c) in enumerate(ends) if p == root and c in middle), -1)
    pairs = []
    for side in SIDES:
        for above, chain in zip((upper, lower), _CHAINS, strict=True):
            near, far = (link((a, side), (b, side)) for a, b in pairwise(chain))
            pairs += [(above, near), (near, far)]
    return tuple(pairs)


def link_angles(model: SkeletonModel, orientations: Floats) -> Floats:
    """(..., 8, 3) Angles z, x, y, rad, of link ``orientations`` (..., L, 4) x y z w, by joint.

    Hi-ROS eq 21: the distal link in the frame of the proximal one, by the sequence of the ISB
    recommendation that Hi-ROS follows (section 4). z is flexion and extension, x abduction and
    adduction, y internal and external rotation. At the ends of x, z and y have one axis. They
    depend on a detector's convention of link frames. NaN where a link or its orientation is
    missing.
    """
    angles = []
    for proximal, distal in joint_links(model):
        if min(proximal, distal) < 0:
            angles.append(np.full((*orientations.shape[:-2], 3), np.nan))
            continue
        frames = (to_matrix(orientations[..., link, :]) for link in (proximal, distal))
        angles.append(np.stack(zxy(*frames), axis=-1))  # eq 21
    return np.stack(angles, axis=-2)
