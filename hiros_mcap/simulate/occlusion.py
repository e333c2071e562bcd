"""Occlusion: the field of view, and bodies (capsules) in the line of sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hiros_mcap.simulate.body_model import MARKERS, SLOT
from hiros_mcap.simulate.settings import RigParams
from hiros_mcap.skeletons import Floats

Mask = npt.NDArray[np.bool_]

_BEHIND = 0.08  # m; a limb hides what is at least this much farther from the camera
_NEAREST = 0.10  # m; nearer points cannot be projected
_PASSING = 1.3  # m; people whose pelvises look farther from each other than this hide nothing
_CHUNK = 128  # frames at a time: temporary arrays stay in the processor's cache

_CORE = (
    *("PELVIS", "SPINE_NAVAL", "SPINE_CHEST", "NECK"),
    *("CLAVICLE_LEFT", "CLAVICLE_RIGHT", "HIP_LEFT", "HIP_RIGHT"),
)
_ARM = ("ELBOW", "WRIST")
_CAPSULES: list[tuple[str, str, float, tuple[str, ...]]] = [
    # ends, radius in m, joints that are within it and therefore never hidden by it
    ("PELVIS", "NECK", 0.13, _CORE),
    ("HIP_LEFT", "HIP_RIGHT", 0.09, ("HIP_LEFT", "HIP_RIGHT", "PELVIS", "SPINE_NAVAL")),
    ("HEAD", "NECK", 0.08, ("HEAD", "NECK")),
]
for _side in ("LEFT", "RIGHT"):
    for _a, _b, _radius in (
        ("SHOULDER", "ELBOW", 0.05),
        ("ELBOW", "WRIST", 0.04),
        ("HIP", "KNEE", 0.075),
        ("KNEE", "ANKLE", 0.055),
    ):
        _ends = (f"{_a}_{_side}", f"{_b}_{_side}")
        # One's own arm does not hide the trunk: a joint within so large a volume is still located.
        _CAPSULES.append((*_ends, _radius, (*_ends, *_CORE) if _b in _ARM else _ends))

_FIRST = np.array([SLOT[a] for a, _, _, _ in _CAPSULES])
_SECOND = np.array([SLOT[b] for _, b, _, _ in _CAPSULES])
_RADIUS = np.array([radius for _, _, radius, _ in _CAPSULES])
_INSIDE = np.array([[marker in inside for *_, inside in _CAPSULES] for marker in MARKERS])


@dataclass(frozen=True, slots=True)
class Sight:
    """The visible markers of P people in n frames; each (n, P, M)."""

    framed: Mask  # the joint is within the field of view and the range
    covered: Mask  # another person is in front of the joint
    hidden: Mask  # another person or the person's own body is in front of the joint


def sight_of(points: Floats, rig: RigParams, *, solid: bool = True) -> Sight:
    """Tell what a camera sees of joints (n, P, M, 3) in its own coordinates, m.

    Bodies that are not ``solid`` hide nothing.
    """
    depth = np.maximum(points[..., 2], _NEAREST)
    image = points[..., :2] / depth[..., None]
    half = np.tan(np.radians(rig.fov) / 2)
    framed = (np.abs(image) <= half).all(axis=-1)
    framed &= (points[..., 2] >= rig.range[0]) & (points[..., 2] <= rig.range[1])
    covered, by_self = np.zeros_like(framed), np.zeros_like(framed)
    for start in range(0, len(points) if solid else 0, _CHUNK):
        part = slice(start, start + _CHUNK)
        _cover(image[part], depth[part], covered[part], by_self[part])
    return Sight(framed=framed, covered=covered, hidden=covered | by_self)


def _cover(image: Floats, depth: Floats, covered: Mask, by_self: Mask) -> None:
    """Fill in which joints people hide from the camera, their own and each other's."""
    people = range(depth.shape[1])
    for person in people:
        by_self[:, person] = (_in_front(image, depth, person, person) & ~_INSIDE).any(axis=-1)
        for other in people:
            if other == person:
                continue
            gap = np.linalg.norm(image[:, person, 0] - image[:, other, 0], axis=-1)
            near = (gap * depth[:, other, 0] < _PASSING) & (
                depth[:, other, 0] < depth[:, person, 0] + 0.5
            )
            if near.any():
                covered[near, person] |= _in_front(image[near], depth[near], person, other).any(-1)


def _in_front(image: Floats, depth: Floats, person: int, other: int) -> Mask:
    """(n, M, C) whether each capsule of ``other`` is before each joint of ``person``.

    The test is in the picture: the distance of the joint's image from the capsule's axis.
    """
    a, b = image[:, other, _FIRST], image[:, other, _SECOND]
    axis = b - a
    squared = np.maximum((axis**2).sum(-1), 1e-12)
    to_joint = image[:, person, :, None] - a[:, None]
    along = (to_joint * axis[:, None]).sum(-1) / squared[:, None]
    along = np.clip(along, 0.0, 1.0)
    inverse_a, inverse_b = 1 / depth[:, other, _FIRST], 1 / depth[:, other, _SECOND]
    inverse = inverse_a[:, None] + along * (inverse_b - inverse_a)[:, None]
    off_x = to_joint[..., 0] - along * axis[:, None, :, 0]
    off_y = to_joint[..., 1] - along * axis[:, None, :, 1]
    hits = off_x**2 + off_y**2 < (_RADIUS * inverse) ** 2
    before: Mask = hits & (inverse * (depth[:, person, :, None] - _BEHIND) > 1.0)
    return before
