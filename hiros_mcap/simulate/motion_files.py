"""Recorded motion, joints over time, from files of Acclaim (ASF and AMC) and Biovision (BVH)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.skeletons import Floats

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

MAX_BYTES = 1 << 28
Y_UP_TO_Z_UP: Floats = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Motion files have y up."""
RATE = 120.0
"""Frames per second: AMC files do not say; those of the usual collections have this many."""
_DOFS = ("rx", "ry", "rz")
_ROOT_ORDER: tuple[str, ...] = ("TX", "TY", "TZ", "RX", "RY", "RZ")
_CHANNEL = re.compile("[XYZ](position|rotation)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Clip:
    """Joints over time."""

    joints: Mapping[str, Floats]  # name -> (F, 3), z up, any unit
    rate: float  # frames per second

    @property
    def frames(self) -> int:
        """F."""
        return len(next(iter(self.joints.values())))


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the stripped lines of a text file with their numbers.

    Raises ConfigError if the file is too large or no text.
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


def euler(angles: Floats, axes: str) -> Rotation:
    """Product of rotations about ``axes``, the first letter leftmost; angles (n, k), rad."""
    from scipy.spatial.transform import Rotation

    result = Rotation.identity(len(angles))
    for k, axis in enumerate(axes):  # one by one: a file may name any number of axes, any twice
        result = result * Rotation.from_euler(axis, angles[:, k : k + 1])
    return result


@dataclass(slots=True)
class _AsfBone:
    direction: Floats
    """(3,) from start to end, in the global frame of the rest pose, times the length."""
    frame: Floats  # (3, 3) rotation of the bone's own axes in the rest pose
    dofs: tuple[str, ...] = ()
    parent: str = "root"


@dataclass(frozen=True, slots=True)
class AsfSkeleton:
    """The skeleton of an ASF file."""

    bones: dict[str, _AsfBone]  # in the order in which parents come before children
    degrees: bool
    root_order: tuple[str, ...]


def read_asf(path: Path) -> AsfSkeleton:
    """Read a skeleton.

    Raises ConfigError naming the file, the line and the fault.
    """
    bones: dict[str, _AsfBone] = {}
    degrees = True
    order = _ROOT_ORDER
    section = ""
    current: dict[str, list[str]] = {}
    parents: dict[str, str] = {}
    for number, line in text_lines(path):
        words = line.split()
        if line.startswith("#") or not words:
            continue
        if words[0].startswith(":"):
            section = words[0][1:].lower()
            continue
        try:
            if section == "units" and words[0] == "angle":
                degrees = words[1].lower().startswith("deg")
            elif section == "root" and words[0] == "order":
                order = tuple(word.upper() for word in words[1:])
                if sorted(order) != sorted(_ROOT_ORDER):
                    raise ValueError(f"not the six of {' '.join(_ROOT_ORDER)}")
            elif section == "bonedata":
                current = _bone_line(words, current, bones, degrees=degrees)
            elif section == "hierarchy" and words[0] not in ("begin", "end"):
                parents.update(dict.fromkeys(words[1:], words[0]))
        except (ValueError, IndexError, KeyError) as error:
            fault = f"cannot be read ({error})"
            raise ConfigError(f"{path}: line {number}: {fault}: {line[:60]!r}") from None
    if not bones:
        raise ConfigError(f"{path}: not an ASF file: it has no bones")
    if unknown := [name for name in parents if name not in bones]:
        raise ConfigError(f"{path}: the hierarchy names an unknown bone: {unknown[0]}")
    for name, parent in parents.items():
        bones[name].parent = parent
    return AsfSkeleton(_parents_first(path, bones), degrees, order)


def _bone_line(
    words: list[str], current: dict[str, list[str]], bones: dict[str, _AsfBone], *, degrees: bool
) -> dict[str, list[str]]:
    """Collect a bone's lines; make it at its end."""
    if words[0] == "begin":
        return {}
    if words[0] != "end":
        current[words[0]] = words[1:]
        return current
    factor = math.pi / 180 if degrees else 1.0
    direction = np.array([float(x) for x in current["direction"]])
    angles = [factor * float(x) for x in current["axis"][:3]]
    axes = current["axis"][3] if len(current["axis"]) > 3 else "XYZ"
    length = float(current["length"][0])
    dofs = tuple(word.lower() for word in current.get("dof", []))
    # The first axis named is the first rotation, so it stands rightmost.
    frame = euler(np.array([angles[::-1]]), axes[::-1]).as_matrix()[0]
    bones[current["name"][0]] = _AsfBone(direction * length, frame, dofs)
    return {}


def _parents_first(path: Path, bones: dict[str, _AsfBone]) -> dict[str, _AsfBone]:
    ordered: dict[str, _AsfBone] = {}
    while len(ordered) < len(bones):
        ready = [
            name
            for name, bone in bones.items()
            if name not in ordered and (bone.parent == "root" or bone.parent in ordered)
        ]
        if not ready:
            raise ConfigError(f"{path}: the hierarchy has a loop or a missing parent")
        ordered.update({name: bones[name] for name in ready})
    return ordered


def read_amc(path: Path, skeleton: AsfSkeleton) -> Clip:
    """Read a motion: where every bone ends, in the units of the skeleton, z up.

    Raises ConfigError naming the file, the line and the fault.
    """
    frames: list[dict[str, list[float]]] = []
    for number, line in text_lines(path):
        words = line.split()
        if not words or line.startswith(("#", ":")):
            continue
        if words[0].isdigit() and len(words) == 1:
            frames.append({})
            continue
        if not frames or (words[0] != "root" and words[0] not in skeleton.bones):
            raise ConfigError(f"{path}: line {number}: the skeleton has no bone {words[0]!r}")
        try:
            frames[-1][words[0]] = [float(x) for x in words[1:]]
        except ValueError:
            raise ConfigError(f"{path}: line {number}: not numbers: {line[:60]!r}") from None
    if len(frames) < 2:
        raise ConfigError(f"{path}: not an AMC file: it has {len(frames)} frames")
    return Clip(_joints(path, skeleton, frames), RATE)


def _joints(
    path: Path, skeleton: AsfSkeleton, frames: list[dict[str, list[float]]]
) -> dict[str, Floats]:
    """Bone -> (F, 3) its end; "root" too."""
    factor = math.pi / 180 if skeleton.degrees else 1.0
    root = _series(path, frames, "root", len(skeleton.root_order))
    column = {name: root[:, k] for k, name in enumerate(skeleton.root_order)}
    ends = {"root": np.stack([column[axis] for axis in ("TX", "TY", "TZ")], axis=-1)}
    root_angles = np.stack([factor * column[axis] for axis in ("RX", "RY", "RZ")], axis=-1)
    rotations = {"root": euler(root_angles[:, ::-1], "ZYX").as_matrix()}
    for name, bone in skeleton.bones.items():
        angles = np.zeros((len(frames), 3))
        if bone.dofs:
            values = _series(path, frames, name, len(bone.dofs))
            for k, dof in enumerate(bone.dofs):
                if dof in _DOFS:
                    angles[:, _DOFS.index(dof)] = factor * values[:, k]
        local = bone.frame @ euler(angles[:, ::-1], "ZYX").as_matrix() @ bone.frame.T
        rotations[name] = rotations[bone.parent] @ local
        ends[name] = ends[bone.parent] + rotations[name] @ bone.direction
    return {name: end @ Y_UP_TO_Z_UP.T for name, end in ends.items()}


def _series(path: Path, frames: list[dict[str, list[float]]], name: str, n: int) -> Floats:
    """(F, n) numbers of a bone."""
    for k, frame in enumerate(frames, start=1):
        if len(frame.get(name, ())) != n:
            raise ConfigError(f"{path}: frame {k}: {name} needs {n} numbers")
    return np.array([frame[name] for frame in frames])


@dataclass(slots=True)
class _BvhJoint:
    name: str
    parent: int
    offset: Floats = field(default_factory=lambda: np.zeros(3))
    channels: tuple[str, ...] = ()


def read_bvh(path: Path) -> Clip:
    """Read a motion: where every joint is, in the file's own unit, z up.

    Raises ConfigError naming the file, the line and the fault.
    """
    joints: list[_BvhJoint] = []
    stack: list[int] = []
    rows: list[list[float]] = []
    step, in_motion = 0.0, False
    for number, line in text_lines(path):
        words = line.replace(":", " : ").split()
        if not words:
            continue
        try:
            if in_motion and words[0] not in ("Frames", "Frame"):
                rows.append([float(x) for x in words])
            elif words[0] == "Frame" and words[1:3] == ["Time", ":"]:
                step = float(words[3])
            elif words[0] == "MOTION":
                in_motion = True
            elif not in_motion:
                _hierarchy_line(words, joints, stack)
        except (ValueError, IndexError):
            raise ConfigError(f"{path}: line {number}: cannot be read: {line[:60]!r}") from None
    if not joints:
        raise ConfigError(f"{path}: not a BVH file: it has no joints")
    n = sum(len(joint.channels) for joint in joints)
    if len(rows) < 2 or step <= 0:
        raise ConfigError(f"{path}: has {len(rows)} frames of {step} s: no motion")
    if wrong := next((k for k, row in enumerate(rows, start=1) if len(row) != n), 0):
        raise ConfigError(f"{path}: frame {wrong}: {len(rows[wrong - 1])} numbers instead of {n}")
    return Clip(_positions(joints, np.array(rows)), 1 / step)


def _hierarchy_line(words: list[str], joints: list[_BvhJoint], stack: list[int]) -> None:
    if words[0] in ("ROOT", "JOINT", "End"):
        name = words[1] if words[0] != "End" else f"{joints[stack[-1]].name}End"
        joints.append(_BvhJoint(name, stack[-1] if stack else -1))
    elif words[0] == "{":
        stack.append(len(joints) - 1)
    elif words[0] == "}":
        stack.pop()
    elif words[0] == "OFFSET":
        joints[stack[-1]].offset = np.array([float(x) for x in words[1:4]])
        if len(words) < 4:
            raise ValueError("an offset has three numbers")
    elif words[0] == "CHANNELS":
        channels = tuple(words[2 : 2 + int(words[1])])
        if not all(_CHANNEL.fullmatch(channel) for channel in channels):
            raise ValueError("a channel is a position or a rotation of X, Y or Z")
        joints[stack[-1]].channels = channels


def _positions(joints: list[_BvhJoint], rows: Floats) -> dict[str, Floats]:
    """Joint -> (F, 3)."""
    places: list[Floats] = []
    rotations: list[Floats] = []
    first = 0
    for joint in joints:
        values = rows[:, first : first + len(joint.channels)]
        first += len(joint.channels)
        shift = np.tile(joint.offset, (len(rows), 1))
        angles, axes = [np.zeros((len(rows), 0))], ""
        for k, channel in enumerate(joint.channels):
            axis = "XYZ".index(channel[0].upper())
            if channel.lower().endswith("position"):
                shift[:, axis] = values[:, k] + (joint.offset[axis] if joint.parent >= 0 else 0.0)
            else:
                angles.append(np.radians(values[:, k : k + 1]))
                axes += channel[0].upper()
        turns = euler(np.concatenate(angles, axis=1), axes).as_matrix()
        if joint.parent < 0:
            places.append(shift)
            rotations.append(turns)
        else:
            places.append(
                places[joint.parent] + np.einsum("fij,fj->fi", rotations[joint.parent], shift)
            )
            rotations.append(rotations[joint.parent] @ turns)
    return {joint.name: place @ Y_UP_TO_Z_UP.T for joint, place in zip(joints, places, strict=True)}
