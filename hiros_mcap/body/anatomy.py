"""Signed joint angles as clinicians name them, from marker positions.

Every segment gets the frame of the ISB recommendations (Wu et al. 2002 and 2005): x forward, y up,
z to the right, all parallel in a person who stands with hanging arms. A joint's angles are those of
its distal segment in its proximal one, by the sequence z (flexion), x (abduction), y (axial
rotation).

Markers give a limb's long axis. They give its axial rotation only while the next joint is bent,
because then the plane of the two bones shows where the hinge points. So:

- flexion and abduction of hip and shoulder need the long axis only, and are always known;
- their axial rotation is NaN while knee or elbow are bent by less than :data:`HINGE_DEG`;
- the plane in which an arm is lifted is NaN while it hangs, within :data:`HANGING_DEG`;
- knee and elbow are hinges: the angle between the bones. A knee may be
  overextended by up to 10 degrees, an elbow not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from hiros_mcap.body.symmetry import split_side
from hiros_mcap.skeletons import Floats, SkeletonModel

HINGE_DEG = 20.0
"""A knee or elbow that is bent less does not show where its hinge points."""

HANGING_DEG = 10.0

SIDES = ("left", "right")
ANGLE_NAMES: tuple[str, ...] = (
    *("pelvis tilt", "pelvis obliquity", "pelvis rotation"),
    *("trunk flexion", "trunk side bend", "trunk rotation"),
    *("neck flexion", "neck side bend"),
    *(
        f"{side} {angle}"
        for side in SIDES
        for angle in (
            *("hip flexion", "hip abduction", "hip rotation", "knee flexion"),
            *("ankle dorsiflexion", "shoulder flexion", "shoulder abduction"),
            *("shoulder rotation", "shoulder elevation", "shoulder plane", "elbow flexion"),
        )
    ),
)
"""Columns of :func:`anatomical_angles`."""

_PELVIS = ("pelvis", "spinebase", "midhip", "hips", "spine_base")
_NECK = ("neck", "spineshoulder", "spine_shoulder", "spine_chest")
_LOWER_SPINE = ("spine_naval", "spinemid", "spine_mid", "spine", "naval")
HEAD = ("head", "nose")
_TOE = ("foot", "toe", "bigtoe", "big_toe", "toebase")
_AXES = {"x": 0, "y": 1, "z": 2}


def anatomical_angles(
    model: SkeletonModel, positions: Floats, up: str = "z", *, unwrapped: bool = True
) -> Floats:
    """(T, A) angles over time, rad; the columns are :data:`ANGLE_NAMES`.

    Signs: flexion lifts the thigh or the arm forwards, and bends knee, elbow, trunk and neck
    forwards or shut; dorsiflexion lifts the toes; abduction leads away from the middle; hip and
    shoulder rotation are positive inwards; side bend and rotation of trunk and pelvis are positive
    to the right and to the left; pelvis tilt is positive forwards, its obliquity where the right
    side is lower. Shoulder elevation is the angle between arm and trunk, and its plane is 0 where
    the arm is lifted sideways, 90 degrees forwards (Wu et al. 2005, 2.4.7). Flexion and abduction
    of a shoulder are ill-defined near 90 degrees of abduction; elevation and plane are not.

    Parameters
    ----------
    model : names the markers. positions : (T, M, 3) of one person, m; NaN where absent.
    up : axis of the fixed frame that points up, for the pelvis: "x", "y" or "z".
    unwrapped : continue angles over 180 degrees instead of jumping by 360.

    Returns
    -------
    NaN where a marker is missing, or where the angle cannot be known.
    """
    at = _finder(model, positions)
    columns = dict.fromkeys(ANGLE_NAMES, np.full(len(positions), np.nan))
    pelvis, thorax = _pelvis(at), _thorax(at)
    columns |= _pelvis_angles(pelvis, _AXES[up])
    columns |= _trunk_angles(pelvis, thorax)
    columns |= _neck_angles(at, thorax)
    for side in SIDES:
        sign = 1.0 if side == "right" else -1.0
        columns |= _leg_angles(at, pelvis, side, sign)
        columns |= _arm_angles(at, thorax, side, sign)
    angles = np.stack([columns[name] for name in ANGLE_NAMES], axis=-1)
    return _unwrap(angles) if unwrapped else angles


Finder = Callable[..., Floats]
"""``at("knee", side="left")``: (T, 3) the first marker of these names, NaN where there is none."""

Columns = Mapping[str, Floats]


def _finder(model: SkeletonModel, positions: Floats) -> Finder:
    slots = {split_side(name): slot for slot, name in enumerate(model.marker_names)}
    absent = np.full((len(positions), 3), np.nan)

    def at(*names: str, side: str = "") -> Floats:
        slot = next((slots[name, side] for name in names if (name, side) in slots), None)
        return absent if slot is None else np.asarray(positions[:, slot])

    return at


# -- segments: (T, 3, 3), whose columns are the axes x y z -----------------------------------------


def _pelvis(at: Finder) -> Floats:
    """Frame of the pelvis: z from hip to hip, y towards the lower spine."""
    left, right = at("hip", side="left"), at("hip", side="right")
    return _frame(z=right - left, y=at(*_LOWER_SPINE, *_NECK) - (left + right) / 2)


def _thorax(at: Finder) -> Floats:
    """Frame of the thorax: y from the pelvis to the neck, z from shoulder to shoulder."""
    lateral = at("shoulder", side="right") - at("shoulder", side="left")
    return _frame(y=at(*_NECK) - at(*_PELVIS), z=lateral, keep="y")


def _frame(*, y: Floats, z: Floats, keep: str = "z") -> Floats:
    """Right-handed frames of two directions, of which ``keep`` is kept exactly."""
    x = _unit(np.cross(y, z))
    if keep == "z":
        z = _unit(z)
        y = np.cross(z, x)
    else:
        y = _unit(y)
        z = np.cross(x, y)
    return np.stack([x, y, z], axis=-1)


def _unit(vectors: Floats) -> Floats:
    """Vectors of length 1; NaN for those of length 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 1e-9, length, np.nan))


def _inside(frame: Floats, vectors: Floats) -> tuple[Floats, Floats, Floats]:
    """Components x, y, z of vectors (T, 3) in frames (T, 3, 3)."""
    x, y, z = np.moveaxis(np.einsum("tij,ti->tj", frame, vectors), -1, 0)
    return x, y, z


# -- joints ----------------------------------------------------------------------------------------


def _pelvis_angles(pelvis: Floats, up: int) -> Columns:
    """Tilt, obliquity and rotation against the fixed frame, by the sequence y x z."""
    vertical = np.eye(3)[up]
    forward = np.eye(3)[(up + 1) % 3]
    world = np.stack([forward, vertical, np.cross(forward, vertical)], axis=-1)
    r = world.T @ pelvis
    return {
        "pelvis tilt": -np.arctan2(r[:, 1, 0], r[:, 1, 1]),
        "pelvis obliquity": np.arcsin(np.clip(-r[:, 1, 2], -1, 1)),
        "pelvis rotation": np.arctan2(r[:, 0, 2], r[:, 2, 2]),
    }


def _trunk_angles(pelvis: Floats, thorax: Floats) -> Columns:
    """Thorax in pelvis, by the sequence z x y."""
    r = np.swapaxes(pelvis, -1, -2) @ thorax
    return {
        "trunk flexion": -np.arctan2(-r[:, 0, 1], r[:, 1, 1]),
        "trunk side bend": np.arcsin(np.clip(r[:, 2, 1], -1, 1)),
        "trunk rotation": np.arctan2(-r[:, 2, 0], r[:, 2, 2]),
    }


def _neck_angles(at: Finder, thorax: Floats) -> Columns:
    """Direction of the head's long axis in the thorax; markers do not show its rotation."""
    x, y, z = _inside(thorax, _unit(at(*HEAD) - at(*_NECK)))
    return {"neck flexion": np.arctan2(x, y), "neck side bend": np.arcsin(np.clip(z, -1, 1))}


def _leg_angles(at: Finder, pelvis: Floats, side: str, sign: float) -> Columns:
    hip, knee, ankle = (at(name, side=side) for name in ("hip", "knee", "ankle"))
    thigh, shank = _unit(hip - knee), _unit(knee - ankle)
    flexion, abduction = _swing(pelvis, thigh, sign)
    hinge = _frame(y=thigh, z=_frame_z(pelvis, thigh), keep="y")
    ahead, along, _ = _inside(hinge, shank)
    bend = _between(thigh, shank)
    # A nearly straight knee shows no hinge: what bends sideways then is noise, not flexion.
    certain = np.clip(2.0 * bend / np.radians(HINGE_DEG) - 1.0, 0.0, 1.0)
    knee_flexion = certain * bend + (1.0 - certain) * np.arctan2(ahead, along)
    # The shank bends backwards: the axis of the hinge is shank x thigh, to the right.
    axis = np.cross(shank, thigh)
    toes = _unit(at(*_TOE, side=side) - ankle)
    # Ankle: toes against the shank in its own plane; 0 where they stand at right angles.
    dorsiflexion = np.pi / 2 - _between(toes, shank)
    return {
        f"{side} hip flexion": flexion,
        f"{side} hip abduction": abduction,
        f"{side} hip rotation": _twist(pelvis, thigh, axis, bend, sign),
        f"{side} knee flexion": knee_flexion,
        f"{side} ankle dorsiflexion": dorsiflexion,
    }


def _arm_angles(at: Finder, thorax: Floats, side: str, sign: float) -> Columns:
    shoulder, elbow, wrist = (at(name, side=side) for name in ("shoulder", "elbow", "wrist"))
    upper, fore = _unit(shoulder - elbow), _unit(elbow - wrist)
    flexion, abduction = _swing(thorax, upper, sign)
    bend = _between(upper, fore)
    # The forearm bends forwards: the axis of the hinge is upper arm x forearm, to the right.
    axis = np.cross(upper, fore)
    x, y, z = _inside(thorax, -upper)
    elevation = np.arccos(np.clip(-y, -1, 1))
    plane = np.where(elevation > np.radians(HANGING_DEG), np.arctan2(x, sign * z), np.nan)
    return {
        f"{side} shoulder flexion": flexion,
        f"{side} shoulder abduction": abduction,
        f"{side} shoulder rotation": _twist(thorax, upper, axis, bend, sign),
        f"{side} shoulder elevation": elevation,
        f"{side} shoulder plane": plane,
        f"{side} elbow flexion": bend,
    }


def _swing(proximal: Floats, axis: Floats, sign: float) -> tuple[Floats, Floats]:
    """Flexion and abduction of a limb whose long axis (T, 3) points up to its joint.

    The second column of Rz(a) Rx(b) Ry(c) is (-sin a cos b, cos a cos b, sin b): a is flexion, b
    adduction of the right side.
    """
    x, y, z = _inside(proximal, axis)
    return np.arctan2(-x, y), -sign * np.arcsin(np.clip(z, -1, 1))


def _twist(proximal: Floats, axis: Floats, hinge: Floats, bend: Floats, sign: float) -> Floats:
    """Axial rotation of a limb, positive inwards, by the axis of the hinge at its far end.

    It is the angle c of Rz(a) Rx(b) Ry(c): between the hinge and the axis z of Rz(a) Rx(b).
    """
    x, y, z = _inside(proximal, axis)
    flexion, adduction = np.arctan2(-x, y), np.arcsin(np.clip(z, -1, 1))
    sa, ca, sb, cb = np.sin(flexion), np.cos(flexion), np.sin(adduction), np.cos(adduction)
    straight_z = np.stack([sa * sb, -ca * sb, cb], axis=-1)
    straight_x = np.stack([ca, sa, np.zeros_like(ca)], axis=-1)
    u = np.stack(_inside(proximal, _unit(hinge)), axis=-1)
    rotation = np.arctan2(np.sum(u * straight_x, axis=-1), np.sum(u * straight_z, axis=-1))
    return np.where(bend >= np.radians(HINGE_DEG), sign * rotation, np.nan)


def _frame_z(proximal: Floats, axis: Floats) -> Floats:
    """Axis z of a limb that does not rotate about its long axis."""
    z = proximal[:, :, 2]
    return np.asarray(z - np.sum(z * axis, axis=-1, keepdims=True) * axis)


def _between(u: Floats, v: Floats) -> Floats:
    """Angle between vectors, rad; by its tangent, which is exact for small angles, too."""
    cross = np.linalg.norm(np.cross(u, v), axis=-1)
    return np.asarray(np.arctan2(cross, np.sum(u * v, axis=-1)))


def _unwrap(angles: Floats) -> Floats:
    """Continue each column over jumps of 360 degrees; gaps stay."""
    out = angles.copy()
    for column in out.T:
        known: npt.NDArray[np.bool_] = ~np.isnan(column)
        column[known] = np.unwrap(column[known])
    return out
