"""Recorded motion performed by a simulated body.

Only directions are taken from a recording: each segment of the body turns as the recorded limb
does, and has its own constant length. So any skeleton drives the same 32 joints; what a recording
lacks (hands, thumbs, nose, eyes) is where the body has it. Units do not matter: the path over the
floor is scaled by the length of the legs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.simulate.body import SEGMENTS, SLOT, Body
from hiros_mcap.simulate.settings import SimulateParams
from hiros_mcap.skeletons import Floats

MAX_BYTES = 1 << 28

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
_ATTEMPTS, _APART_M = 60, 0.6
_HINGE = 0.1
"""How much of the trunk's sideways axis is in a limb's: it decides while the limb is straight."""


@dataclass(frozen=True, slots=True)
class Clip:
    """Joints over time."""

    joints: Mapping[str, Floats]
    """Name -> (F, 3), z up, any unit."""
    rate: float
    """Frames per second."""

    @property
    def frames(self) -> int:
        """F."""
        return len(next(iter(self.joints.values())))


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the stripped lines of a text file with their numbers.

    Raises
    ------
    ConfigError
        The file is too large or no text.
    """
    if path.stat().st_size > MAX_BYTES:
        raise ConfigError(f"{path}: larger than {MAX_BYTES} bytes")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        text = path.read_text(encoding="latin-1")
    if "\0" in text:
        raise ConfigError(f"{path}: not a text file")
    for number, line in enumerate(text.splitlines(), start=1):
        yield number, line.strip()


def euler(angles: Floats, axes: str) -> Floats:
    """(n, 3, 3) Product of rotations about ``axes``, the first letter leftmost, rad (n, k)."""
    result = np.broadcast_to(np.eye(3), (len(angles), 3, 3))
    for k, axis in enumerate(axes):
        c, s = np.cos(angles[:, k]), np.sin(angles[:, k])
        i, j = {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
        turn = np.broadcast_to(np.eye(3), (len(angles), 3, 3)).copy()
        turn[:, i, i], turn[:, j, j], turn[:, i, j], turn[:, j, i] = c, c, -s, s
        result = result @ turn
    return np.asarray(result)


def load_clip(motion: Path, skeleton: Path | None = None) -> Clip:
    """Read an AMC file with its ASF skeleton, or a BVH file.

    Raises
    ------
    ConfigError
        The file is of another kind, or faulty, or its skeleton is missing.
    """
    from hiros_mcap.simulate.asf_amc import read_amc, read_asf
    from hiros_mcap.simulate.bvh import read_bvh

    kind = motion.suffix.lower()
    if kind == ".bvh":
        return read_bvh(motion)
    if kind != ".amc":
        raise ConfigError(f"{motion}: a motion file ends in .amc or .bvh")
    if skeleton is None:
        raise ConfigError(f"{motion}: needs the skeleton that it is of, an .asf file")
    return read_amc(motion, read_asf(skeleton))


@dataclass(frozen=True, slots=True)
class Performer:
    """A body that repeats a recording, forth and back if it is too short.

    ``place`` (2,) m and ``heading``, rad: where the middle of the path is, and how it is turned.
    """

    body: Body
    clip: Clip
    roles: Mapping[str, Floats]
    place: Floats
    heading: float
    scale: float
    ground: float

    @classmethod
    def of(cls, body: Body, clip: Clip, place: Floats, heading: float, name: str) -> Performer:
        """Fit a recording to a body.

        Raises
        ------
        ConfigError
            The recording lacks an arm, a leg or the head; ``name`` names it.
        """
        roles = _roles(clip, name)
        recorded = np.median(
            np.linalg.norm(roles["left hip"] - roles["left knee"], axis=-1)
            + np.linalg.norm(roles["left knee"] - roles["left ankle"], axis=-1)
        )
        own = sum(np.linalg.norm(body.offset(f"{part}_LEFT")) for part in ("KNEE", "ANKLE"))
        draft = cls(body, clip, roles, place, heading, float(own / recorded), 0.0)
        times = np.arange(clip.frames) / clip.rate
        feet = [SLOT["FOOT_LEFT"], SLOT["FOOT_RIGHT"]]
        toes = draft.pose(times)[0][:, feet, 2]
        ground = float(body.toe_height - np.percentile(toes.min(axis=1), 5))
        return cls(body, clip, roles, place, heading, float(own / recorded), ground)

    def pose(self, t: Floats) -> tuple[Floats, Floats]:
        """(n, M, 3) markers, m, and (n, S, 3, 3) segment rotations in the world at times ``t``."""
        joints = {role: self._at(path, t) for role, path in self.roles.items()}
        rotations = segment_rotations(self.body, joints)
        middle = (joints["left hip"] + joints["right hip"]) / 2
        path = (self.roles["left hip"] + self.roles["right hip"]) / 2
        centre = np.array([*path[:, :2].mean(axis=0), 0.0])
        hips = (self.body.offset("HIP_LEFT") + self.body.offset("HIP_RIGHT")) / 2
        pelvis = self.scale * (middle - centre) - rotations[:, 0] @ hips
        turn = euler(np.array([[self.heading]]), "Z")[0]
        pelvis = pelvis @ turn.T + np.array([*self.place, self.ground])
        rotations = turn @ rotations
        return self.body.markers(pelvis, rotations), rotations

    def _at(self, path: Floats, t: Floats) -> Floats:
        """(n, 3) A joint at times ``t`` by cubic interpolation (Catmull and Rom)."""
        last = self.clip.frames - 1
        phase = np.mod(np.maximum(t, 0.0) * self.clip.rate, 2 * last)
        phase = np.where(phase > last, 2 * last - phase, phase)
        k = np.clip(np.floor(phase).astype(int), 0, last - 1)
        u = (phase - k)[:, None]
        before, after = path[np.maximum(k - 1, 0)], path[np.minimum(k + 2, last)]
        here, there = path[k], path[k + 1]
        return np.asarray(
            here
            + 0.5 * u * (there - before)
            + u * u * (before - 2.5 * here + 2 * there - 0.5 * after)
            + u**3 * (1.5 * (here - there) + 0.5 * (after - before))
        )


def perform_files(
    params: SimulateParams, bodies: Sequence[Body], rng: np.random.Generator
) -> list[Performer]:
    """Let bodies perform the files of ``params``, turned and placed so that nobody meets anybody.

    Raises
    ------
    ConfigError
        A file is faulty.
    """
    names, skeletons = params.motion, params.skeleton
    clips: dict[int, Clip] = {}
    performers: list[Performer] = []
    for k, body in enumerate(bodies):
        n = k % len(names)
        if n not in clips:
            skeleton = Path(skeletons[min(n, len(skeletons) - 1)]) if skeletons else None
            clips[n] = load_clip(Path(names[n]), skeleton)
        first = Performer.of(body, clips[n], np.zeros(2), 0.0, names[n])
        performers.append(_placed(first, performers, params.seconds, rng))
    return performers


def _placed(
    performer: Performer, others: Sequence[Performer], seconds: float, rng: np.random.Generator
) -> Performer:
    """Try places and headings until everybody is a step apart; the best one if none is."""
    times = np.arange(0.0, seconds, 0.1)
    taken = [other.pose(times)[0][:, 0, :2] for other in others]
    best, widest = performer, -1.0
    for attempt in range(_ATTEMPTS):
        angle, far = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 0.6 + 0.03 * attempt)
        place = np.array([far * np.cos(angle), far * np.sin(angle)])
        tried = replace(performer, place=place, heading=float(rng.uniform(-np.pi, np.pi)))
        path = tried.pose(times)[0][:, 0, :2]
        apart = min(
            (float(np.linalg.norm(path - other, axis=1).min()) for other in taken), default=np.inf
        )
        if apart > widest:
            best, widest = tried, apart
        if apart >= _APART_M:
            break
    return best


def _roles(clip: Clip, name: str) -> dict[str, Floats]:
    """Role -> (F, 3): "left knee", "neck", ..."""
    by_name = {_bare(joint): path for joint, path in clip.joints.items()}
    is_bones = "lfemur" in by_name
    found = {}
    for role, names in _MIDDLE.items():
        path = next((by_name[n] for n in names if n in by_name), None)
        if path is None:
            raise ConfigError(f"{name}: has no {role} (its joints: {_some(clip)})")
        found[role] = path
    for side in ("left", "right"):
        for role, names in _LIMBS.items():
            options = [_BONES[role]] if is_bones and role in _BONES else list(names)
            keys = [key for n in options for key in (side + n, side[0] + n, n + side, n + side[0])]
            path = next((by_name[key] for key in keys if key in by_name), None)
            if path is None:
                raise ConfigError(f"{name}: has no {side} {role} (its joints: {_some(clip)})")
            found[f"{side} {role}"] = path
    return found


def _bare(name: str) -> str:
    """Return a joint's name without a rig's prefix, case or separators."""
    return "".join(c for c in name.rpartition(":")[2].lower() if c.isalnum())


def _some(clip: Clip) -> str:
    names = list(clip.joints)
    return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")


def segment_rotations(body: Body, joints: Mapping[str, Floats]) -> Floats:
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


def _foot(body: Body, side: str, ahead: Floats, right: Floats) -> Floats:
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
