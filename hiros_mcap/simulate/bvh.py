"""Motions in BVH files (Biovision)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.simulate.clip import Y_UP_TO_Z_UP, Clip, euler, text_lines
from hiros_mcap.skeletons import Floats

_CHANNEL = re.compile("[XYZ](position|rotation)", re.IGNORECASE)


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
