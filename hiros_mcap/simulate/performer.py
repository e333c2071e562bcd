"""Recorded motion performed by a simulated body.

Only directions come from a recording: each segment of the body points as the recorded limb does,
and keeps its own constant length. So any skeleton drives the same 32 joints. Joints that a
recording lacks (hands, thumbs, nose, eyes) follow from the body. Units do not matter: the length of
the legs scales the path over the floor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.simulate.body_model import SEGMENTS, SLOT, BodyModel
from hiros_mcap.simulate.motion_files import Clip, euler, read_amc, read_asf, read_bvh
from hiros_mcap.simulate.settings import SimulateParams
from hiros_mcap.skeletons import Floats

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

# Joint of the body -> names that files give it, by preference. L stands for l, left, Left, ...
_MIDDLE = {
    "neck": ("neck", "neck1", "lowerneck", "thorax", "head", "chest3", "spine2", "spine1", "chest"),
    "head": ("headend", "head", "upperneck", "neck"),
}
_LIMBS = {
    "hip": ("upleg", "hipjoint", "thigh", "hip", "upperleg"),
    "knee": ("leg", "femur", "knee", "shin", "lowleg", "lowerleg"),
    "ankle": ("foot", "tibia", "ankle"),
    "toe": ("toebase", "foot", "toe", "toes", "footend", "ankleend"),
    "shoulder": ("arm", "clavicle", "shoulder", "uparm", "upperarm"),
    "elbow": ("forearm", "humerus", "elbow", "lowarm", "lowerarm"),
    "wrist": ("hand", "radius", "wrist"),
    "hand": ("handmiddle1", "hand", "handend", "wristend", "fingers"),
}
# Files of bones (ASF) name the bone by its limb: what ends at the knee is called femur.
_BONES = {"hand": "hand", "toe": "foot", "wrist": "radius", "ankle": "tibia"}
_ATTEMPTS, _MIN_DISTANCE = 60, 0.6
_HINGE = 0.1
"""Weight of the trunk's sideways axis in a limb's axis. It decides while the limb is straight."""


def load_clip(motion: Path, skeleton: Path | None = None) -> Clip:
    """Read an AMC file with its ASF skeleton, or a BVH file.

    Raises ConfigError if the file is of another kind, or faulty, or its skeleton is missing.
    """
    kind = motion.suffix.lower()
    if kind == ".bvh":
        return read_bvh(motion)
    if kind != ".amc":
        raise ConfigError(f"{motion}: a motion file ends in .amc or .bvh")
    if skeleton is None:
        raise ConfigError(f"{motion}: needs its skeleton, an .asf file (--skeleton)")
    return read_amc(motion, read_asf(skeleton))


@dataclass(frozen=True, slots=True)
class Performer:
    """A body that repeats a recording, forth and back if it is too short."""

    body: BodyModel
    clip: Clip
    paths: Mapping[str, CubicHermiteSpline]
    """Role ("left knee") -> position over frames, in the recording's unit."""
    centre: Floats  # (3,) Middle of the hips' path over the floor, in the recording's unit
    scale: float  # metres per unit of the recording: the ratio of the lengths of the legs
    place: Floats = field(default_factory=lambda: np.zeros(2))  # (2,) m, where ``centre`` is put
    heading: float = 0.0  # rad, by which the recording is rotated about the vertical
    ground: float = 0.0  # m, by which it is lifted to stand on the floor

    @classmethod
    def of(cls, body: BodyModel, clip: Clip, name: str) -> Performer:
        """Fit a recording to a body.

        Raises ConfigError if the recording lacks an arm, a leg or the head; ``name`` names it.
        """
        roles = _roles(clip, name)
        recorded = np.median(
            np.linalg.norm(roles["left hip"] - roles["left knee"], axis=-1)
            + np.linalg.norm(roles["left knee"] - roles["left ankle"], axis=-1)
        )
        leg = sum(np.linalg.norm(body.offset(f"{part}_LEFT")) for part in ("KNEE", "ANKLE"))
        hips = (roles["left hip"] + roles["right hip"]) / 2
        centre = np.array([*hips[:, :2].mean(axis=0), 0.0])
        paths = {role: _catmull_rom(path) for role, path in roles.items()}
        draft = cls(body, clip, paths, centre, float(leg / recorded))
        feet = [SLOT["FOOT_LEFT"], SLOT["FOOT_RIGHT"]]
        toes = draft.pose(np.arange(clip.frames) / clip.rate)[0][:, feet, 2]
        ground = float(body.toe_height - np.percentile(toes.min(axis=1), 5))
        return replace(draft, ground=ground)

    def pose(self, t: Floats) -> tuple[Floats, Floats]:
        """(n, M, 3) markers, m, and (n, S, 3, 3) segment rotations in the world at times ``t``."""
        last = self.clip.frames - 1
        frame = np.mod(np.maximum(t, 0.0) * self.clip.rate, 2 * last)
        frame = np.where(frame > last, 2 * last - frame, frame)
        joints = {role: path(frame) for role, path in self.paths.items()}
        rotations = recorded_rotations(self.body, joints)
        recorded_hips = (joints["left hip"] + joints["right hip"]) / 2
        hips = (self.body.offset("HIP_LEFT") + self.body.offset("HIP_RIGHT")) / 2
        pelvis = self.scale * (recorded_hips - self.centre) - rotations[:, 0] @ hips
        rotation = euler(np.array([[self.heading]]), "Z").as_matrix()[0]
        pelvis = pelvis @ rotation.T + np.array([*self.place, self.ground])
        rotations = rotation @ rotations
        return self.body.markers(pelvis, rotations), rotations


def _catmull_rom(path: Floats) -> CubicHermiteSpline:
    """Interpolate a path (F, 3) between its frames by the cubic of Catmull and Rom."""
    from scipy.interpolate import CubicHermiteSpline

    padded = np.concatenate([path[:1], path, path[-1:]])
    return CubicHermiteSpline(np.arange(len(path)), path, (padded[2:] - padded[:-2]) / 2)


def perform_files(
    params: SimulateParams, bodies: Sequence[BodyModel], rng: np.random.Generator
) -> list[Performer]:
    """Let bodies perform the files of ``params``, placed and rotated so that nobody collides.

    Raises ConfigError if a file is faulty.
    """
    names, skeletons = params.motion, params.skeleton
    clips: dict[int, Clip] = {}
    performers: list[Performer] = []
    for k, body in enumerate(bodies):
        n = k % len(names)
        if n not in clips:
            skeleton = Path(skeletons[min(n, len(skeletons) - 1)]) if skeletons else None
            clips[n] = load_clip(Path(names[n]), skeleton)
        first = Performer.of(body, clips[n], names[n])
        performers.append(_placed(first, performers, params.seconds, rng))
    return performers


def _placed(
    performer: Performer, others: Sequence[Performer], seconds: float, rng: np.random.Generator
) -> Performer:
    """Try places and headings until nobody comes closer than a step; the best one if none does."""
    times = np.arange(0.0, seconds, 0.1)
    taken = [other.pose(times)[0][:, 0, :2] for other in others]
    best, farthest = performer, -1.0
    for attempt in range(_ATTEMPTS):
        angle, far = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 0.6 + 0.03 * attempt)
        place = np.array([far * np.cos(angle), far * np.sin(angle)])
        tried = replace(performer, place=place, heading=float(rng.uniform(-np.pi, np.pi)))
        path = tried.pose(times)[0][:, 0, :2]
        distance = min(
            (float(np.linalg.norm(path - other, axis=1).min()) for other in taken), default=np.inf
        )
        if distance > farthest:
            best, farthest = tried, distance
        if distance >= _MIN_DISTANCE:
            break
    return best


def _roles(clip: Clip, name: str) -> dict[str, Floats]:
    """Role -> (F, 3): "left knee", "neck", ..."""
    by_name = {_bare(joint): path for joint, path in clip.joints.items()}
    is_bones = "lfemur" in by_name
    roles = {}
    for role, names in _MIDDLE.items():
        path = next((by_name[n] for n in names if n in by_name), None)
        if path is None:
            raise ConfigError(f"{name}: has no {role} (its joints: {_some(clip)})")
        roles[role] = path
    for side in ("left", "right"):
        for role, names in _LIMBS.items():
            options = [_BONES[role]] if is_bones and role in _BONES else list(names)
            keys = [key for n in options for key in (side + n, side[0] + n, n + side, n + side[0])]
            path = next((by_name[key] for key in keys if key in by_name), None)
            if path is None:
                raise ConfigError(f"{name}: has no {side} {role} (its joints: {_some(clip)})")
            roles[f"{side} {role}"] = path
    return roles


def _bare(name: str) -> str:
    """Return a joint's name without a rig's prefix, case or separators."""
    return "".join(c for c in name.rpartition(":")[2].lower() if c.isalnum())


def _some(clip: Clip) -> str:
    names = list(clip.joints)
    return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")


def recorded_rotations(body: BodyModel, joints: Mapping[str, Floats]) -> Floats:
    """(n, S, 3, 3) Rotation of every segment so that limbs lie as the joints (n, 3) do.

    x forward, y up along the bone, z to the right. A limb's z is the axis of its hinge, elbow or
    knee; while that is straight, the trunk's.
    """
    n = len(joints["neck"])
    rotations = np.empty((n, len(SEGMENTS), 3, 3))

    def put(segment: str, up: Floats, right: Floats) -> None:
        rotations[:, SEGMENTS.index(segment)] = _frame(up, right)

    hips = (joints["left hip"] + joints["right hip"]) / 2
    across = {
        part: _unit(joints[f"right {part}"] - joints[f"left {part}"])
        for part in ("hip", "shoulder")
    }
    spine = joints["neck"] - hips
    put("pelvis", spine, across["hip"])
    put("abdomen", spine, across["hip"] + across["shoulder"])
    put("thorax", spine, across["shoulder"])
    skull = joints["head"] - joints["neck"]
    skull = np.where(np.linalg.norm(skull, axis=-1, keepdims=True) > 1e-9, skull, spine)
    for segment in ("neck", "head"):
        put(segment, skull, across["shoulder"])
    for side in ("left", "right"):
        shoulder, elbow, wrist, hand, hip, knee, ankle, toe = (
            joints[f"{side} {part}"]
            for part in ("shoulder", "elbow", "wrist", "hand", "hip", "knee", "ankle", "toe")
        )
        hinge = np.cross(_unit(elbow - shoulder), _unit(wrist - elbow))
        right = hinge + _HINGE * across["shoulder"]
        put(f"upper_arm_{side}", shoulder - elbow, right)
        put(f"forearm_{side}", elbow - wrist, right)
        palm = wrist - hand
        same = np.linalg.norm(palm, axis=-1, keepdims=True) < 1e-9
        put(f"hand_{side}", np.where(same, elbow - wrist, palm), right)
        hinge = -np.cross(_unit(knee - hip), _unit(ankle - knee))
        right = hinge + _HINGE * across["hip"]
        put(f"thigh_{side}", hip - knee, right)
        put(f"shank_{side}", knee - ankle, right)
        rotations[:, SEGMENTS.index(f"foot_{side}")] = _foot(body, side, toe - ankle, right)
    return rotations


def _foot(body: BodyModel, side: str, ahead: Floats, right: Floats) -> Floats:
    """Rotation that lays the foot's own direction from ankle to toes along ``ahead``."""
    offset = body.offset(f"FOOT_{side.upper()}")
    c, s = offset[0] / np.hypot(offset[0], offset[1]), -offset[1] / np.hypot(offset[0], offset[1])
    d = _unit(ahead)
    z = _unit(right - d * (right * d).sum(axis=-1, keepdims=True))
    e = np.cross(z, d)
    return np.stack([c * d + s * e, c * e - s * d, z], axis=-1)


def _frame(up: Floats, right: Floats) -> Floats:
    """(n, 3, 3) Columns x, y, z: y along ``up``, z as near to ``right`` as possible."""
    y = _unit(up)
    z = _unit(right - y * (right * y).sum(axis=-1, keepdims=True))
    return np.stack([np.cross(y, z), y, z], axis=-1)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
