"""Which joints of a view bend as no body does: its detector has them wrong.

Where an angle is beyond its limit by x, its markers, and those farther out, are wrong with the
probability 1 - exp(-(x / BLUR)^2 / 2). The limits are the ends of what textbooks give for active
motion, or, where people squat and kneel, for passive motion (American Academy of Orthopaedic
Surgeons, Joint motion, 1965; Kapandji, The physiology of the joints).

Hips and shoulders are judged by flexion, which needs left and right, and only where the limb is not
lifted sideways; hips also by how far the thigh points to the other side; neck, elbows and knees by
how far they bend to whatever side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.segments import HEAD, LOWER_SPINE, NECK, PELVIS, SIDES
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.kernels.array_types import B2, F1, F2, J2
from hiros_mcap.kernels.compile import inlined, kernel
from hiros_mcap.kernels.points import norm3
from hiros_mcap.kernels.quaternions import Vector
from hiros_mcap.skeletons import Flags, Floats, Ints, SkeletonModel

_BLUR = math.radians(8.0)  # of a limb of 30 cm whose ends are 3 cm off
_SIDEWAYS = math.sin(math.radians(60.0))  # share of a limb beyond which its flexion is ill-defined
_NECK, _ELBOW, _KNEE = (math.radians(degrees) for degrees in (80.0, 150.0, 160.0))
_INWARDS = math.radians(45.0)  # of a thigh: 30 degrees, more in somebody who sits cross-legged
_HIP, _SHOULDER = np.radians([-30.0, 145.0]), np.radians([-60.0, 180.0])


class PostureLimits(NamedTuple):
    """How far K joints bend between two bones, and J limbs swing about the trunk."""

    bends: J2  # (K, 4) marker slots: from, to of the inner bone, and of the outer one
    most: F1  # (K,) rad between them
    bent: B2  # (K, M) markers that are wrong where it is more
    swings: J2  # (J, 6): from, to of the trunk upwards; left, right; from, to of the limb
    ranges: F2  # (J, 2) rad of flexion
    inwards: F2  # (J, 2) 1 = a right limb, -1 = a left one; the most, rad, to the other side
    swung: B2  # (J, M)


def limits_of(model: SkeletonModel) -> PostureLimits:
    """Return the limits of the joints whose markers a skeleton has."""
    slots = {split_side(name): slot for slot, name in enumerate(model.marker_names)}

    def at(*names: str, side: str = "") -> int:
        return next((slots[name, side] for name in names if (name, side) in slots), -1)

    pelvis, neck, hips, shoulders = (
        at(*PELVIS), at(*NECK), [at("hip", side=side) for side in SIDES],
        [at("shoulder", side=side) for side in SIDES],
    )  # fmt: skip
    bends, swings = [((pelvis, neck, neck, at(*HEAD)), _NECK)], []
    for k, side in enumerate(SIDES):
        knee, elbow = at("knee", side=side), at("elbow", side=side)
        ankle, wrist = at("ankle", side=side), at("wrist", side=side)
        bends += [((hips[k], knee, knee, ankle), _KNEE)]
        bends += [((shoulders[k], elbow, elbow, wrist), _ELBOW)]
        trunk = pelvis, at(*LOWER_SPINE, *NECK)
        outwards = 2.0 * k - 1.0
        swings += [((*trunk, *hips, hips[k], knee), (*_HIP, outwards, _INWARDS))]
        arm = pelvis, neck, *shoulders, shoulders[k], elbow
        swings += [(arm, (*_SHOULDER, outwards, math.pi))]
    bends = [row for row in bends if min(row[0]) >= 0]
    swings = [row for row in swings if min(row[0]) >= 0]
    return PostureLimits(
        np.array([ends for ends, _ in bends], np.int32).reshape(-1, 4),
        np.array([most for _, most in bends], np.float64),
        _wrong(model, [ends[1:] for ends, _ in bends]),
        np.array([ends for ends, _ in swings], np.int32).reshape(-1, 6),
        np.array([limits[:2] for _, limits in swings], np.float64).reshape(-1, 2),
        np.array([limits[2:] for _, limits in swings], np.float64).reshape(-1, 2),
        _wrong(model, [ends for ends, _ in swings]),
    )


def _wrong(model: SkeletonModel, joints: Sequence[Sequence[int]]) -> B2:
    """(K, M) Markers of each joint, and those farther out than its last one."""
    wrong = np.zeros((len(joints), model.n_markers), bool)
    links = [(a, b) for a, b in model.links.tolist() if min(a, b) >= 0]
    for row, markers in zip(wrong, joints, strict=True):
        row[list(markers)] = True
        out = [markers[-1]]
        for _ in range(model.n_markers):
            out += [b for a, b in links if a in out and b not in out]
        row[out] = True
    return wrong


@inlined
def _bone(view: Floats, a: int, b: int) -> Vector:
    """Direction from one marker to another; NaN if one is absent."""
    x, y, z = view[b, 0] - view[a, 0], view[b, 1] - view[a, 1], view[b, 2] - view[a, 2]
    length = norm3(x, y, z)
    return x / length, y / length, z / length


@inlined
def _dot(u: Vector, v: Vector) -> float:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@inlined
def _across(u: Vector, v: Vector) -> Vector:
    """Direction at right angles to two others."""
    x, y, z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
    length = norm3(x, y, z) + 1e-12
    return x / length, y / length, z / length


@inlined
def _swing(view: Floats, ends: Ints) -> tuple[float, float]:
    """Return how far a limb is lifted forwards, and to the right, from where it hangs; both rad.

    The first is NaN where the limb is lifted too far sideways. Both are where a marker is absent.
    """
    up, right = _bone(view, ends[0], ends[1]), _bone(view, ends[2], ends[3])
    limb = _bone(view, ends[4], ends[5])
    forward = _across(up, right)
    up = _across(right, forward)
    sideways = _dot(limb, right)
    if math.isnan(sideways):
        return np.nan, np.nan
    sideways = min(max(sideways, -1.0), 1.0)
    flexion = math.atan2(_dot(limb, forward), -_dot(limb, up))
    return np.nan if abs(sideways) > _SIDEWAYS else flexion, math.asin(sideways)


@inlined
def _doubt(excess: float, wrong: Flags, shares: Floats) -> None:
    """Raise the probability that the markers of an angle are wrong."""
    if not excess > 0.0:
        return
    share = 1.0 - math.exp(-0.5 * (excess / _BLUR) ** 2)
    for m in range(len(shares)):
        if wrong[m]:
            shares[m] = max(shares[m], share)


@kernel
def doubt_posture(view: Floats, limits: PostureLimits, shares: Floats) -> None:
    """Write the probability (M,) that markers of a view (M, >= 3) are wrong, by its angles."""
    shares[:] = 0.0
    for k in range(len(limits.bends)):
        ends = limits.bends[k]
        cosine = _dot(_bone(view, ends[0], ends[1]), _bone(view, ends[2], ends[3]))
        if not math.isnan(cosine):
            bend = math.acos(min(max(cosine, -1.0), 1.0))
            _doubt(bend - limits.most[k], limits.bent[k], shares)
    for k in range(len(limits.swings)):
        middle = (limits.ranges[k, 0] + limits.ranges[k, 1]) / 2.0
        half = (limits.ranges[k, 1] - limits.ranges[k, 0]) / 2.0
        flexion, sideways = _swing(view, limits.swings[k])
        inwards = -limits.inwards[k, 0] * sideways
        if not math.isnan(sideways):
            _doubt(inwards - limits.inwards[k, 1], limits.swung[k], shares)
        off = (flexion - middle) % (2.0 * math.pi)
        off = min(off, 2.0 * math.pi - off)
        _doubt(off - half, limits.swung[k], shares)
