"""Skeletons and motions of motion capture in ASF and AMC files (Acclaim)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.simulate.clip import Y_UP_TO_Z_UP, Clip, euler, text_lines
from hiros_mcap.skeletons import Floats

RATE = 120.0
"""Frames per second: AMC files do not say; those of the usual collections have this many."""
_DOFS = ("rx", "ry", "rz")
_ROOT_ORDER: tuple[str, ...] = ("TX", "TY", "TZ", "RX", "RY", "RZ")


@dataclass(slots=True)
class _AsfBone:
    direction: Floats
    """(3,) from start to end, in the global frame of the rest pose, times the length."""
    frame: Floats
    """(3, 3) rotation of the bone's own axes in the rest pose."""
    dofs: tuple[str, ...] = ()
    parent: str = "root"


@dataclass(frozen=True, slots=True)
class AsfSkeleton:
    """What an ASF file says."""

    bones: dict[str, _AsfBone]
    """In the order in which parents come before children."""
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
