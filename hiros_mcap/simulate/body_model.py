"""An articulated body with the Azure Kinect's 32 joints: constant limb lengths by construction.

Frames follow the recommendation of the International Society of Biomechanics (Wu 2002, 2005), which
equation 21 of the Hi-ROS paper presumes: every segment has x forward, y up (from the distal end to
the proximal one, along the bone), z to the right. In the neutral pose (standing, arms hanging,
palms towards the thighs) all segments share one orientation, so every joint angle is zero there.
The rotation of a joint is ``Rz(flexion) Rx(adduction) Ry(internal rotation)`` of the distal segment
in the proximal one: hip, shoulder and elbow flexion are positive about z, knee flexion negative.

A link carries the orientation of the segment that it lies in: the link called ELBOW_LEFT, from
SHOULDER_LEFT to ELBOW_LEFT, is the left upper arm; links that only join a segment to the next joint
(HIP_LEFT, CLAVICLE_LEFT, SHOULDER_LEFT, ...) rotate with the pelvis or the thorax.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.skeletons import Floats, SkeletonModel

SIDES = ("LEFT", "RIGHT")
SEGMENTS = (
    "pelvis",
    "abdomen",
    "thorax",
    "neck",
    "head",
    *(f"{part}_{side}" for part in ("upper_arm", "forearm", "hand") for side in ("left", "right")),
    *(f"{part}_{side}" for part in ("thigh", "shank", "foot") for side in ("left", "right")),
)
PARENT_SEGMENT = {
    "abdomen": "pelvis",
    "thorax": "abdomen",
    "neck": "thorax",
    "head": "neck",
    "upper_arm": "thorax",
    "forearm": "upper_arm",
    "hand": "forearm",
    "thigh": "pelvis",
    "shank": "thigh",
    "foot": "shank",
}
UPRIGHT: Floats = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation of a neutral segment facing the world's +x: its y is the world's up, z."""

ADULT_HEIGHT = 1.75
_ANKLE_HEIGHT = 0.075

# child marker -> (parent marker, segment, offset in the segment's frame at 1.75 m of height, m).
# Lengths after Drillis and Contini's proportions and the Azure Kinect's joint placement. The
# right side is written down; the left is its mirror image.
_MIDDLE = {
    "SPINE_NAVAL": ("PELVIS", "pelvis", (0.0, 0.170, 0.0)),
    "SPINE_CHEST": ("SPINE_NAVAL", "abdomen", (0.0, 0.140, 0.0)),
    "NECK": ("SPINE_CHEST", "thorax", (-0.010, 0.205, 0.0)),
    "HEAD": ("NECK", "neck", (0.015, 0.095, 0.0)),
    "NOSE": ("HEAD", "head", (0.125, -0.010, 0.0)),
}
_RIGHT = {
    "CLAVICLE": ("SPINE_CHEST", "thorax", (0.0, 0.165, 0.035)),
    "SHOULDER": ("CLAVICLE", "thorax", (0.0, -0.020, 0.145)),
    "ELBOW": ("SHOULDER", "upper_arm", (0.0, -0.290, 0.0)),
    "WRIST": ("ELBOW", "forearm", (0.0, -0.255, 0.0)),
    "HAND": ("WRIST", "hand", (0.0, -0.075, 0.0)),
    "HANDTIP": ("HAND", "hand", (0.0, -0.100, 0.0)),
    "THUMB": ("WRIST", "hand", (0.050, -0.070, 0.0)),
    "HIP": ("PELVIS", "pelvis", (0.0, -0.070, 0.095)),
    "KNEE": ("HIP", "thigh", (0.0, -0.430, 0.0)),
    "ANKLE": ("KNEE", "shank", (0.0, -0.430, 0.0)),
    "FOOT": ("ANKLE", "foot", (0.160, -0.050, 0.0)),
    "EYE": ("HEAD", "head", (0.090, 0.030, 0.033)),
    "EAR": ("HEAD", "head", (0.0, 0.0, 0.075)),
}
_ARM = ("CLAVICLE", "SHOULDER", "ELBOW", "WRIST", "HAND", "HANDTIP", "THUMB")
_LEG = ("HIP", "KNEE", "ANKLE", "FOOT")
MARKERS = (
    "PELVIS",
    "SPINE_NAVAL",
    "SPINE_CHEST",
    "NECK",
    *(f"{part}_{side}" for side in SIDES for part in _ARM),
    *(f"{part}_{side}" for side in SIDES for part in _LEG),
    "HEAD",
    "NOSE",
    *(f"{part}_{side}" for side in SIDES for part in ("EYE", "EAR")),
)
SLOT = {name: slot for slot, name in enumerate(MARKERS)}


def _bone(child: str) -> tuple[str, str, tuple[float, float, float]]:
    """Parent marker, segment and reference offset of the bone that ends at ``child``."""
    if child in _MIDDLE:
        return _MIDDLE[child]
    part, side = child.rsplit("_", 1)
    parent, segment, (x, y, z) = _RIGHT[part]
    if parent in _RIGHT:
        parent = f"{parent}_{side}"
    if f"{segment}_{side.lower()}" in SEGMENTS:
        segment = f"{segment}_{side.lower()}"
    return parent, segment, (x, y, z if side == "RIGHT" else -z)


_BONES = tuple(_bone(child) for child in MARKERS[1:])
MODEL = SkeletonModel.of(
    MARKERS,
    (
        (child, SLOT[parent], SLOT[child])
        for child, (parent, _, _) in zip(MARKERS[1:], _BONES, strict=True)
    ),
)
LINK_SEGMENTS = np.array([SEGMENTS.index(segment) for _, segment, _ in _BONES])
"""(L,) segment that each link rotates with."""

SYMMETRY = symmetry_of(MODEL)


@dataclass(frozen=True, slots=True)
class BodyModel:
    """One person's proportions: ``offsets`` (L, 3), m, of each link in its segment's frame."""

    height: float
    offsets: Floats

    @classmethod
    def of(
        cls, height: float, deviation: float = 0.0, rng: np.random.Generator | None = None
    ) -> BodyModel:
        """Draw a body of ``height`` metres. Left and right are equal.

        The lengths of trunk, arms and legs have the relative SD ``deviation``.
        """
        regions = {"trunk": 1.0, "arm": 1.0, "leg": 1.0}
        if rng is not None:
            regions = {name: 1 + deviation * rng.standard_normal() for name in regions}
        rows = []
        for child, (_, _, offset) in zip(MARKERS[1:], _BONES, strict=True):
            part = child.rsplit("_", 1)[0]
            region = "arm" if part in _ARM[2:] else "leg" if part in _LEG[1:] else "trunk"
            rows.append(np.array(offset) * (height / ADULT_HEIGHT * regions[region]))
        return cls(height, np.array(rows))

    def offset(self, link: str) -> Floats:
        """Offset (3,) of the link named ``link``, m."""
        offset: Floats = self.offsets[SLOT[link] - 1]
        return offset

    @property
    def lengths(self) -> Floats:
        """(L,) limb lengths, m."""
        lengths: Floats = np.linalg.norm(self.offsets, axis=1)
        return lengths

    @property
    def leg(self) -> float:
        """Length of a straight leg from hip to ankle, m."""
        return float(self.lengths[SLOT["KNEE_LEFT"] - 1] + self.lengths[SLOT["ANKLE_LEFT"] - 1])

    @property
    def ankle_height(self) -> float:
        """Height of the ankle above the ground when the foot is flat, m."""
        return _ANKLE_HEIGHT * self.height / ADULT_HEIGHT

    @property
    def toe_height(self) -> float:
        """Height of the FOOT marker above the ground when the foot is flat, m."""
        return self.ankle_height + float(self.offset("FOOT_LEFT")[1])

    @property
    def standing(self) -> float:
        """Height of the pelvis, m, when standing with knees nearly straight."""
        return self.ankle_height + 0.993 * self.leg - float(self.offset("HIP_LEFT")[1])

    def markers(self, root: Floats, rotations: Floats) -> Floats:
        """Forward kinematics: (n, 3) pelvis and (n, S, 3, 3) segments to (n, M, 3) positions."""
        positions = np.empty((len(root), len(MARKERS), 3))
        positions[:, 0] = root
        bones = np.einsum("nlij,lj->nli", rotations[:, LINK_SEGMENTS], self.offsets)
        for link, parent in enumerate(MODEL.link_parents):  # parents come first in the list
            positions[:, link + 1] = positions[:, parent] + bones[:, link]
        return positions
