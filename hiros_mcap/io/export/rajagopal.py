"""Poses of OpenSim's full-body model of Rajagopal et al. (IEEE TBME 63, 2016, 2068-2079).

The model's joints are put where the person's joints are, as far as its bones allow: every bone of
the model gets the direction of the person's. That determines all coordinates of trunk, hips, knees,
shoulders and elbows in closed form, since a thigh and a shank, or an upper arm and a forearm, show
the three rotations of their upper joint and the angle of the hinge between them.

The dimensions below are those of Rajagopal2016.osim, right side, m. Axes: x forward, y up, z right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hiros_mcap.body.anatomy import continued
from hiros_mcap.body.angles import wrapped
from hiros_mcap.body.rotations import Y_UP, from_vector, to_matrix
from hiros_mcap.body.segments import (
    SIDES,
    Finder,
    between,
    finder,
    frame,
    marker_segments,
    segments_of,
    toes,
    unit,
    zxy,
)
from hiros_mcap.io.result import Motion
from hiros_mcap.skeletons import Floats, SkeletonModel

HIPS = np.array([-0.056276, -0.07849, 0.0])
"""The middle of the hips, from the origin of the pelvis."""
_X, _Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
BACK = np.array([-0.1007, 0.0815, 0.0]) - HIPS
"""The joint of pelvis and torso, from the middle of the hips."""
SHOULDERS = np.array([0.003155, 0.3715, 0.0])
"""The middle of the shoulders in the torso, whose origin is that joint."""
SLACK_DEG = 2.4
"""How far a shank or forearm may deviate for a steady rotation of the limb about its long axis.

A nearly straight limb shows that rotation badly. Chosen so that no bone deviates by 3 degrees in a
pose that the model can take.
"""


@dataclass(frozen=True)
class Hinge:
    """Two bones and the hinge between them, in the frame of the first bone's body."""

    bone: Floats  # (3,) from the upper joint to the hinge
    axis: Floats  # (3,) of the hinge
    next: Floats  # (3,) the second bone where the coordinate is 0
    range_deg: tuple[float, float]
    """Of the coordinate; beyond that of the model where people go beyond it."""
    twist_deg: float = 0.0
    """How far people rotate the first bone about its long axis, to either side."""

    def turned(self, angles: Floats) -> Floats:
        """(T, 3) the second bone at the angles (T,), rad."""
        return np.asarray(rotations(self.axis, angles) @ self.next)

    def bent(self, bend: Floats) -> Floats:
        """(T,) coordinate, rad, at which the bones are at the angle ``bend``, rad."""
        steps, bends = self._bends()
        return np.asarray(np.interp(bend, bends, steps))

    @property
    def straightest(self) -> float:
        """The least angle between the bones, rad."""
        return float(self._bends()[1].min())

    def _bends(self) -> tuple[Floats, Floats]:
        """Coordinates over the range, and the angles between the bones there, rad."""
        steps = np.radians(np.arange(self.range_deg[0], self.range_deg[1] + 1))
        first = np.broadcast_to(self.bone, (len(steps), 3))
        return steps, np.asarray(between(first, self.turned(steps)))

    def towards(self, second: Floats) -> Floats:
        """(T,) coordinate, rad, that brings the second bone nearest to a direction (T, 3)."""
        axis = self.axis / np.linalg.norm(self.axis)
        along = second @ self.next - (second @ axis) * (self.next @ axis)
        angles = np.arctan2(second @ np.cross(axis, self.next), along)
        return np.clip(angles, *np.radians(self.range_deg))


_SHANK = np.array([-0.00191, -0.396465, 0.001485])
# The model's knee also slides and twists. This hinge was fitted to it: the shanks of both have the
# same direction within 0.5 degrees, from 0 to 120 degrees.
KNEE = Hinge(
    np.array([-0.00809, -0.40796, -0.00275]),
    np.array([0.0203, -0.0279, -0.9994]),
    np.array([-0.0131, -0.9999, 0.0007]),
    (0, 160),
    60,
)
ANKLE = Hinge(
    _SHANK, np.array([-0.10501, -0.17402, 0.97913]), np.array([0.13003, -0.04395, 0.009]), (-70, 70)
)
ELBOW = Hinge(
    np.array([0.013144, -0.286273, -0.009595]),
    np.array([0.22605, 0.02227, 0.97386]),
    np.array([-0.015524, -0.248848, 0.039693]),
    (0, 160),
    110,
)
PELVIS = ("pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz")
LUMBAR = ("lumbar_extension", "lumbar_bending", "lumbar_rotation")
LEG = ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle", "ankle_angle")
ARM = ("arm_flex", "arm_add", "arm_rot", "elbow_flex")
NEEDS = {
    PELVIS: "both hips, and a spine, a neck or both shoulders",
    LUMBAR: "both shoulders",
    LEG[:4]: "hip, knee and ankle",
    LEG[4:]: "the toes",
    ARM: "shoulder, elbow and wrist",
}
"""Coordinates -> the joints that show them."""


def coordinates(
    model: SkeletonModel, motion: Motion
) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Pose the model.

    Parameters
    ----------
    model : names the markers. motion : in a fixed frame whose z axis points up.

    Returns
    -------
    (T,) each coordinate, degrees and m; NaN where joints are missing.
    (T,) angle between the model's shanks and forearms and the person's, degrees; NaN as above, and
    0 for an arm that is straighter than the model's can be.
    """
    at = finder(model, motion.positions)
    shown = segments_of(model, motion.positions, motion.orientations, motion.axes)
    # Of the markers alone: the line between the hips then is the model's.
    pelvis = marker_segments(model, motion.positions)["pelvis"]
    middle = (at("hip", side="left") + at("hip", side="right")) / 2
    torso = pelvis @ _torso(at, pelvis, middle)
    origin = (middle - pelvis @ HIPS) @ Y_UP.T
    values = [*zxy(Y_UP.T, pelvis), *zxy(pelvis, torso)]
    names = [*PELVIS[:3], *LUMBAR]
    deviations: dict[str, Floats] = {}
    for side in SIDES:
        names += [f"{name}_{side[0]}" for name in (*LEG, *ARM)]
        joints = [at(name, side=side) for name in ("hip", "knee", "ankle")]
        leg, last, shank = _limb(side, pelvis, KNEE, joints, shown[f"{side} thigh"][:, :, 0])
        values += [*leg, ANKLE.towards(into(last, toes(at, side)))]
        joints = [at(name, side=side) for name in ("shoulder", "elbow", "wrist")]
        arm, _, forearm = _limb(side, torso, ELBOW, joints, shown[f"{side} upper arm"][:, :, 0])
        values += arm
        deviations |= {f"{side} shank": shank, f"{side} forearm": forearm}
    # Only a whole person turns round and round.
    most = np.where([name in PELVIS for name in names], np.inf, 1.5 * np.pi)
    angles = np.degrees(continued(np.stack(values, axis=-1), most=most))
    columns = dict(zip(names, angles.T, strict=True))
    return columns | dict(zip(PELVIS[3:], origin.T, strict=True)), deviations


def _torso(at: Finder, pelvis: Floats, hips: Floats) -> Floats:
    """(T, 3, 3) the torso in the pelvis: from hips to shoulders as the person's."""
    left, right = at("shoulder", side="left"), at("shoulder", side="right")
    trunk = unit(into(pelvis, (left + right) / 2 - hips))
    along = trunk @ BACK
    # How far above the hips the model's shoulders are: its torso has a given length.
    far = along + np.sqrt(along**2 - BACK @ BACK + SHOULDERS @ SHOULDERS)
    spine = far[:, None] * trunk - BACK
    across = into(pelvis, right - left)
    rest = frame(y=SHOULDERS[None], z=_Z[None], keep="y")
    return np.asarray(frame(y=spine, z=across, keep="y") @ np.swapaxes(rest, -1, -2))


def _limb(
    side: str, body: Floats, hinge: Hinge, joints: Sequence[Floats], forward: Floats
) -> tuple[list[Floats], Floats, Floats]:
    """Pose two bones.

    Parameters
    ----------
    body : (T, 3, 3) that the limb hangs on. joints : (T, 3) upper, middle and lower.
    forward : (T, 3) axis of the upper segment, NaN where nothing shows it.

    Returns
    -------
    (T,) flexion, adduction and rotation of the upper joint, and angle of the hinge, rad.
    (T, 3, 3) frames of the second bone's body; of a left one, its mirror image.
    (T,) angle between the second bone and the person's, degrees; NaN where that is hidden, 0 where
    the limb is straighter than the model's can be.
    """
    upper, middle, lower = joints
    first, second, ahead = (
        _mirror(side) * unit(into(body, v)) for v in (middle - upper, lower - middle, forward)
    )
    hidden = np.isnan(second).any(axis=-1)
    # A limb whose last joint is hidden keeps its long axis.
    second = unit(np.stack([bridged(column) for column in second.T], axis=-1))
    bones = np.broadcast_to(hinge.bone, first.shape)
    bend = between(first, second)
    model = _plane(bones, hinge.turned(hinge.bent(bend)))
    exact = _plane(first, second) @ np.swapaxes(model, -1, -2)
    flexion, adduction = _swing(first)
    swing = rotations(_Z, flexion) @ rotations(_X, adduction)
    now, wanted = (_twist(swing, axis) for axis in (exact[:, :, 0], ahead))
    twist = _steady_twist(now, wanted, bend, np.radians(hinge.twist_deg))
    turned = rotations(-first, twist - now) @ exact
    angle = hinge.towards(into(turned, second))
    angles = [*_nearest(zxy(np.eye(3), turned), flexion), angle]
    frames = body * _mirror(side) @ turned @ rotations(hinge.axis, angle)
    apart = np.degrees(between(hinge.turned(angle), into(turned, second)))
    apart = np.where(bend < hinge.straightest, 0.0, apart)
    return angles, frames, np.where(hidden, np.nan, apart)


def _steady_twist(now: Floats, wanted: Floats, bend: Floats, most: float) -> Floats:
    """(T,) rotation of a limb about its long axis, rad.

    It is as the segment's forward axis shows, bridged where nothing shows it, but the second bone
    may deviate by SLACK_DEG only, unless nobody can take the pose: a knee that a detector
    bends backwards would turn the whole leg round.

    Parameters
    ----------
    now : (T,) at which both bones are exact. wanted : (T,) as shown, NaN where it is not.
    bend : (T,) angle between the bones. most : that people reach.
    """
    wanted = np.clip(wrapped(bridged(wanted, unwrap=True)), -most, most)
    half = np.sin(np.radians(SLACK_DEG / 2)) / np.maximum(np.sin(bend), 1e-9)
    slack = 2 * np.arcsin(np.minimum(half, 1.0))
    reached = np.clip(now + np.clip(wrapped(wanted - now), -slack, slack), -most, most)
    return np.where(np.abs(now) <= most + slack, reached, wanted)


def _swing(bone: Floats) -> tuple[Floats, Floats]:
    """Angles about z and x, rad, that bring -y to a direction (T, 3): the smaller of both pairs."""
    z, x = np.arctan2(bone[:, 0], -bone[:, 1]), np.arcsin(np.clip(-bone[:, 2], -1, 1))
    other_z, other_x = wrapped(z + np.pi), np.copysign(np.pi, x) - x
    other = np.abs(other_z) + np.abs(other_x) < np.abs(z) + np.abs(x)
    return np.where(other, other_z, z), np.where(other, other_x, x)


def _nearest(angles: Sequence[Floats], flexion: Floats) -> list[Floats]:
    """Return the one of two equal triples z, x, y whose z is nearer to ``flexion``."""
    z, x, y = angles
    other = np.abs(wrapped(z - flexion)) > np.pi / 2
    others = (wrapped(z + np.pi), np.copysign(np.pi, x) - x, wrapped(y + np.pi))
    return [np.where(other, b, a) for a, b in zip((z, x, y), others, strict=True)]


def _mirror(side: str) -> Floats:
    """(3,) the factors that make a left limb a right one."""
    return np.array([1.0, 1.0, 1.0 if side == "right" else -1.0])


def _twist(swing: Floats, axis: Floats) -> Floats:
    """(T,) rotation about y that brings the x axis of a frame to an axis (T, 3), rad."""
    x, _, z = np.moveaxis(into(swing, axis), -1, 0)
    return np.asarray(np.arctan2(-z, x))


def _plane(first: Floats, second: Floats) -> Floats:
    """(T, 3, 3) frames of two bones."""
    return frame(y=first, z=np.cross(first, second), keep="y")


def into(frames: Floats, vectors: Floats) -> Floats:
    """(T, 3) vectors in the coordinates of frames (T, 3, 3)."""
    return np.asarray(np.einsum("tji,tj->ti", frames, vectors))


def rotations(axes: Floats, angles: Floats) -> Floats:
    """(T, 3, 3) rotations about axes, (3,) or (T, 3), by angles (T,), rad; NaN where they are."""
    return to_matrix(from_vector(np.asarray(unit(np.atleast_2d(axes)) * angles[:, None])))


def bridged(values: Floats, *, unwrap: bool = False) -> Floats:
    """Fill gaps of (T,) linearly, and at both ends with the nearest value; 0 if all is a gap."""
    present = np.flatnonzero(~np.isnan(values))
    if not len(present):
        return np.zeros(len(values))
    some = np.unwrap(values[present]) if unwrap else values[present]
    return np.asarray(np.interp(np.arange(len(values)), present, some))
