"""From what a person does to the pose of every segment: gait with planted feet, leg kinematics.

An action prescribes where the pelvis and the toes are and the joint angles of trunk, head and arms;
the legs follow by inverse kinematics. Everything is a function of time, evaluated for all instants
at once, twice continuously differentiable, so that velocities and accelerations exist.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from hiros_mcap.simulate.body_model import (
    ADULT_HEIGHT,
    PARENT_SEGMENT,
    SEGMENTS,
    UPRIGHT,
    BodyModel,
)
from hiros_mcap.simulate.paths import TURN, Path, bump, smoothstep
from hiros_mcap.skeletons import Floats

REACH = 0.996
"""Longest distance between a limb's ends relative to the straight one: no knee or elbow locks."""
_SOFTNESS = 0.015  # m, over which a limb's reach saturates
TOE_AHEAD = 0.10  # m, toes in front of the pelvis at mid-stance
_SIDES = ("left", "right")
_STRAIGHT = np.zeros(3)
_TO_SHOULDER = (
    ("pelvis", ("SPINE_NAVAL",)),
    ("abdomen", ("SPINE_CHEST",)),
    ("thorax", ("CLAVICLE_SIDE", "SHOULDER_SIDE")),
)


@dataclass(frozen=True, slots=True)
class Gait:
    """How somebody walks or runs. Lengths in metres for a person of 1.75 m."""

    cadence: float  # strides (two steps) per second
    duty: float  # part of the stride that a foot is on the ground; below one half is running
    clearance: float  # height of the toes in mid-swing, m
    heel_rise: float  # largest plantar flexion at push-off, rad
    drop: float  # how much lower than standing the pelvis is on average, m
    bob: float  # amplitude of its vertical oscillation, m; positive = highest in mid-stance
    arm_swing: float  # amplitude of the shoulder's flexion, rad
    elbow: float  # mean flexion of the elbow, rad
    lean: float  # forward lean of the trunk, rad


WALK = Gait(0.92, 0.58, 0.05, 0.6, 0.058, 0.014, 0.42, 0.35, 0.03)
STROLL = Gait(0.80, 0.65, 0.03, 0.25, 0.020, 0.006, 0.10, 0.25, 0.0)  # aside and backwards, too
MARCH = Gait(0.85, 0.60, 0.18, 0.7, 0.012, 0.006, 0.35, 0.35, 0.0)  # on the spot: knees up
JOG = Gait(1.30, 0.36, 0.16, 0.8, 0.045, -0.035, 0.55, 1.50, 0.14)
CRAWL = Gait(0.60, 0.62, 0.03, 0.0, 0.0, 0.005, 0.0, 0.0, 1.45)  # on hands and knees


@dataclass(slots=True)
class Posture:
    """The posture that an action prescribes at n instants."""

    body: BodyModel  # whose posture it is
    pelvis: Floats  # (n, 3) position of the PELVIS in the world, m
    heading: Floats  # (n,) direction that the person faces, rad
    toes: Floats  # (n, 2, 3) position of FOOT_LEFT and FOOT_RIGHT in the world, m
    foot_heading: Floats  # (n, 2) direction of each foot, rad
    foot_pitch: Floats  # (n, 2) plantar flexion from flat on the ground (heel up), rad
    foot_turn: Floats  # (n, 2) rotation of each foot, thus pitched, about its shank, rad
    angles: dict[str, Floats] = field(default_factory=dict)
    """(n, 3) flexion, adduction, internal rotation of a segment in its parent, rad; absent = 0.
    The pelvis' parent is the upright frame that faces ``heading``."""

    def add(self, segment: str, angles: Floats) -> None:
        """Add to a joint's angles."""
        self.angles[segment] = self.angles.get(segment, 0.0) + angles


@dataclass(frozen=True, slots=True)
class Person:
    """A body and what it does: ``posture(t)`` for times in seconds."""

    body: BodyModel
    posture: Callable[[Floats], Posture]

    def pose(self, t: Floats) -> tuple[Floats, Floats]:
        """(n, M, 3) markers, m, and (n, S, 3, 3) segment rotations in the world at times ``t``."""
        posture = self.posture(t)
        rotations = segment_rotations(posture)
        return self.body.markers(posture.pelvis, rotations), rotations


def angles(flexion: object = 0.0, adduction: object = 0.0, internal: object = 0.0) -> Floats:
    """(n, 3) joint angles, rad, from scalars or series."""
    parts = np.broadcast_arrays(
        *(np.asarray(part, np.float64) for part in (flexion, adduction, internal))
    )
    return np.stack(parts, axis=-1)


def arm(side: str, flexion: object, abduction: object = 0.0, inward: object = 0.0) -> Floats:
    """Shoulder angles (n, 3) with the same sense on both sides: positive abduction is outwards."""
    sign = 1.0 if side == "right" else -1.0
    return angles(
        flexion, -sign * np.asarray(abduction, np.float64), sign * np.asarray(inward, np.float64)
    )


def rotation_zxy(zxy: Floats) -> Floats:
    """(..., 3, 3) ``Rz(a) Rx(b) Ry(c)`` of angles (..., 3), rad: equation 21's sequence."""
    return from_euler("ZXY", zxy)


def facing(heading: Floats) -> Floats:
    """(..., 3, 3) rotation of an upright neutral segment that faces ``heading``."""
    return from_euler("Z", heading[..., None]) @ UPRIGHT


def segment_rotations(posture: Posture) -> Floats:
    """(n, S, 3, 3) rotation of every segment in the world."""
    n = len(posture.heading)
    rotations = np.empty((n, len(SEGMENTS), 3, 3))
    for slot, segment in enumerate(SEGMENTS):
        if segment.startswith(("thigh", "shank", "foot")):
            continue
        part, _, side = segment.rpartition("_")
        parent = PARENT_SEGMENT.get(part if side in _SIDES else segment)
        if parent in {"upper_arm", "forearm"}:
            parent = f"{parent}_{side}"
        base = facing(posture.heading) if parent is None else rotations[:, SEGMENTS.index(parent)]
        given = posture.angles.get(segment)
        rotations[:, slot] = base if given is None else base @ rotation_zxy(given)
    for k, side in enumerate(_SIDES):
        legs = _leg_rotations(posture, rotations[:, 0], k)
        for part, rotation in zip(("thigh", "shank", "foot"), legs, strict=True):
            rotations[:, SEGMENTS.index(f"{part}_{side}")] = rotation
    return rotations


def _leg_rotations(posture: Posture, pelvis: Floats, side: int) -> tuple[Floats, Floats, Floats]:
    """Thigh, shank and foot by inverse kinematics: the knee is a hinge that bends backwards."""
    body, name = posture.body, _SIDES[side].upper()
    flat = angles(-posture.foot_pitch[:, side], 0.0, posture.foot_turn[:, side])
    foot = facing(posture.foot_heading[:, side]) @ rotation_zxy(flat)
    hip = posture.pelvis + pelvis @ body.offset(f"HIP_{name}")
    reach = posture.toes[:, side] - foot @ body.offset(f"FOOT_{name}") - hip
    upper, lower = -body.offset(f"KNEE_{name}")[1], -body.offset(f"ANKLE_{name}")[1]
    span = np.linalg.norm(reach, axis=-1, keepdims=True)
    down = reach / span
    span = _reachable(span, upper, lower)
    forward = pelvis[..., 0] + foot[..., 0]
    forward -= down * (forward * down).sum(-1, keepdims=True)
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    cosine = (upper**2 + span**2 - lower**2) / (2 * upper * span)
    knee = upper * (cosine * down + np.sqrt(1 - cosine**2) * forward)
    right = np.cross(down, forward)
    thigh = _bone_rotation(-knee / upper, right)
    shank = _bone_rotation((knee - span * down) / lower, right)
    return thigh, shank, foot


def reach(posture: Posture, side: str, wrist: Floats) -> tuple[Floats, Floats]:
    """Give an arm the angles that put its wrist at ``wrist`` (n, 3), m, or as near as it gets.

    Returns the flexion (n,) of the shoulder and of the elbow, rad. The trunk's angles stand by now.
    """
    body, name = posture.body, side.upper()
    joint, rotation = posture.pelvis, facing(posture.heading)
    for segment, links in _TO_SHOULDER:
        rotation = rotation @ rotation_zxy(posture.angles.get(segment, _STRAIGHT))
        for link in links:
            joint = joint + rotation @ body.offset(link.replace("SIDE", name))
    aim = np.einsum("nji,nj->ni", rotation, wrist - joint)
    span = np.linalg.norm(aim, axis=-1)
    upper, lower = -body.offset(f"ELBOW_{name}")[1], -body.offset(f"WRIST_{name}")[1]
    within = _reachable(span, upper, lower)
    aim *= (within / span)[:, None]
    elbow = np.arccos((within**2 - upper**2 - lower**2) / (2 * upper * lower))
    along = upper + lower * np.cos(elbow)
    adduction = np.arcsin(-aim[:, 2] / along)
    ahead, down = lower * np.sin(elbow), along * np.cos(adduction)
    flexion = np.arctan2(aim[:, 0], -aim[:, 1]) - np.arctan2(ahead, down)
    posture.angles[f"upper_arm_{side}"] = angles(flexion, adduction)
    posture.angles[f"forearm_{side}"] = angles(elbow)
    return flexion, elbow


def _reachable(span: Floats, upper: float, lower: float) -> Floats:
    """Distance between the ends of a limb of two bones, m, that comes closest to ``span``."""
    longest = REACH * (upper + lower)
    within: Floats = longest - _SOFTNESS * np.logaddexp(0.0, (longest - span) / _SOFTNESS)
    return within


def _bone_rotation(up: Floats, right: Floats) -> Floats:
    """Rotation whose y is ``up`` and whose z is ``right``, both unit and orthogonal."""
    return np.stack([np.cross(up, right), up, right], axis=-1)


def standing(body: BodyModel, path: Path, t: Floats) -> Posture:
    """Stand on both feet, a hip's width apart."""
    heading = path.heading(t)
    pelvis = np.concatenate([path.position(t), np.full((*t.shape, 1), body.standing)], axis=-1)
    ground = pelvis * [1.0, 1.0, 0.0] + [0.0, 0.0, body.toe_height]
    ahead = 0.75 * float(body.offset("FOOT_LEFT")[0])
    toes = [
        beside(ground, heading, ahead, -body.offset(f"HIP_{side.upper()}")[2]) for side in _SIDES
    ]
    return Posture(
        body=body,
        pelvis=pelvis,
        heading=heading,
        toes=np.stack(toes, axis=1),
        foot_heading=np.repeat(heading[:, None], 2, axis=1),
        foot_pitch=np.zeros((len(t), 2)),
        foot_turn=np.zeros((len(t), 2)),
    )


def between(first: Posture, second: Posture, share: Floats) -> Posture:
    """Posture at the ``share`` (n,) of the way from the first to the second, heading alike."""

    def mixed(a: Floats, b: Floats) -> Floats:
        weight = share.reshape(-1, *[1] * (a.ndim - 1))
        return a + weight * (b - a)

    none = np.zeros((len(share), 3))
    return replace(
        first,
        pelvis=mixed(first.pelvis, second.pelvis),
        toes=mixed(first.toes, second.toes),
        foot_heading=mixed(first.foot_heading, second.foot_heading),
        foot_pitch=mixed(first.foot_pitch, second.foot_pitch),
        foot_turn=mixed(first.foot_turn, second.foot_turn),
        angles={
            name: mixed(first.angles.get(name, none), second.angles.get(name, none))
            for name in first.angles | second.angles
        },
    )


@dataclass(frozen=True, slots=True)
class Walker:
    """Walking or running along a path: each foot stays where it was put until it swings on.

    ``phase``, in strides, is where the left foot is in its stride at t = 0; it lands at 0.
    """

    body: BodyModel
    path: Path
    gait: Gait
    phase: float

    def posture(self, t: Floats) -> Posture:
        """Posture at times ``t``, s."""
        gait, scale = self.gait, self.body.height / ADULT_HEIGHT
        stride = gait.cadence * t + self.phase
        posture = standing(self.body, self.path, t)
        middle = TURN * (stride - gait.duty / 2)
        sway = 0.02 * scale * np.cos(middle)
        posture.pelvis = beside(posture.pelvis, posture.heading, 0.0, sway)
        posture.pelvis[:, 2] += scale * (gait.bob * np.cos(2 * middle) - gait.drop)
        for side in range(2):
            phase = stride + 0.5 * side
            posture.toes[:, side], posture.foot_heading[:, side] = self._foot(t, phase, side)
            posture.foot_pitch[:, side] = _foot_pitch(gait, phase)
        _swing_upper_body(posture, gait, TURN * stride)
        return posture

    def _foot(self, t: Floats, phase: Floats, side: int) -> tuple[Floats, Floats]:
        """Toes (n, 3) and heading (n,) of the foot that lands whenever ``phase`` is whole."""
        count, duty = np.floor(phase), self.gait.duty
        swing = (phase - count - duty) / (1 - duty)
        w = smoothstep(swing)
        here, heading = self._print(t + (count + duty / 2 - phase) / self.gait.cadence, side)
        there, next_heading = self._print(
            t + (count + 1 + duty / 2 - phase) / self.gait.cadence, side
        )
        toes = here + w[:, None] * (there - here)
        toes[:, 2] += self.gait.clearance * bump(swing, 0.0, 1.0)
        return toes, heading + w * (next_heading - heading)

    def _print(self, stance: Floats, side: int) -> tuple[Floats, Floats]:
        """Footprint (n, 3) and its heading (n,) of the stance whose middle is at ``stance``, s."""
        heading = self.path.heading(stance)
        ground = np.full((*stance.shape, 1), self.body.toe_height)
        track = np.concatenate([self.path.position(stance), ground], axis=-1)
        lateral = 0.6 * self.body.offset("HIP_LEFT" if side == 0 else "HIP_RIGHT")[2]
        return beside(track, heading, TOE_AHEAD, -lateral), heading


def beside(points: Floats, heading: Floats, ahead: float, left: Floats | float) -> Floats:
    """Points (n, 3) moved ``ahead`` of and to the ``left`` of a heading, m."""
    c, s = np.cos(heading), np.sin(heading)
    shift = [ahead * c - left * s, ahead * s + left * c, np.zeros_like(c)]
    moved: Floats = points + np.stack(shift, axis=-1)
    return moved


def _foot_pitch(gait: Gait, phase: Floats) -> Floats:
    """Plantar flexion: the heel rises before the toes leave, the toes rise before landing."""
    x = phase - np.floor(phase)
    leave = gait.duty
    heel = bump(x, leave - 0.30, leave + 0.26)
    return gait.heel_rise * heel - 0.2 * bump(x, leave + 0.20, 1.0)


def _swing_upper_body(posture: Posture, gait: Gait, angle: Floats) -> None:
    """Arms and shoulders go against the legs; ``angle``, rad, is 0 when the left foot lands."""
    beat = np.cos(angle)
    posture.add("pelvis", angles(-gait.lean, 0.04 * np.sin(angle), -0.07 * beat))
    posture.add("thorax", angles(0.0, -0.03 * np.sin(angle), 0.14 * beat))
    posture.add("neck", angles(gait.lean, 0.0, -0.07 * beat))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        flexion = gait.arm_swing * sign * beat
        posture.add(f"upper_arm_{side}", arm(side, flexion - 0.25 * gait.elbow, 0.12, 0.2))
        posture.add(f"forearm_{side}", angles(gait.elbow + 0.4 * flexion))


def from_euler(sequence: str, angles: Floats) -> Floats:
    """(..., 3, 3) matrices of angles (..., 3), rad, about moving axes, such as "ZXY"."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_euler(sequence, angles.reshape(-1, len(sequence))).as_matrix()
    return flat.reshape(*angles.shape[:-1], 3, 3)
