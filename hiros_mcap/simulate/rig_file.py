"""A room and its cameras as a file: that of ``--extrinsics``, with a table ``[room]``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import read_camera_entries, read_extrinsics, read_room
from hiros_mcap.errors import ConfigError
from hiros_mcap.outputs import CAMERAS_MARK, write_text
from hiros_mcap.simulate.settings import Area, SimulateParams

_LOWEST, _HIGHEST = 0.05, 20.0  # m above the floor
_SMALLEST, _LARGEST = 1.5, 40.0  # m, of a room
_NEVER = 1 << 62


class CameraRig(NamedTuple):
    """The cameras of a room."""

    poses: Mapping[str, Rigid]
    """Frame of a camera -> its pose, z up from the floor."""
    settings: dict[str, Any]
    """What they mean for a simulation: fields of SimulateParams."""


def read_rig(path: Path) -> CameraRig:
    """Read the cameras of a file, where they were last, and the room if the file has one.

    Without the table ``[room]``, the room is the least rectangle that holds all cameras.

    Raises ConfigError naming the file and what is wrong with it.
    """
    tree, room = read_extrinsics(path), read_room(path)
    names = list(dict.fromkeys(entry.frame for entry in read_camera_entries(path)))
    roots = {name: tree.root(name) for name in names}
    if len(set(roots.values())) > 1:
        raise ConfigError(f"{path}: the cameras have no common parent: {', '.join(roots)}")
    poses = {name: tree.lookup(name, roots[name], _NEVER, _NEVER) for name in names}
    for name, pose in poses.items():
        height = float(pose.translation[2])
        if not _LOWEST <= height <= _HIGHEST:
            fault = f"stands {height:.2f} m above the floor; z must point up, with the floor at 0"
            raise ConfigError(f"{path}: {name} {fault}")
    rows = [(*pose.translation.tolist(), *pose.xyzw.tolist()) for pose in poses.values()]
    places = np.array(rows)[:, :2]
    settings: dict[str, Any] = {"cameras": len(rows), "rig": {"poses": tuple(rows)}}
    settings["area"] = (*places.min(axis=0).tolist(), *places.max(axis=0).tolist())
    if room is not None:
        settings["area"] = room.area
        settings["rig"] |= {"fov": room.fov, "range": room.range}
    return CameraRig(poses, settings)


def room_area(size: tuple[float, float] | None, area: Area | None) -> Area:
    """Return the room of a width and depth, m, around the middle of ``area`` or the origin.

    Raises ConfigError if nothing says how large it is, or it is too small or large.
    """
    if size is None and area is None:
        raise ConfigError("--room: is missing; give the width and depth of the room, such as 6x5")
    x0, y0, x1, y1 = area or (0.0, 0.0, 0.0, 0.0)
    width, depth = size or (x1 - x0, y1 - y0)
    if not (_SMALLEST <= width <= _LARGEST and _SMALLEST <= depth <= _LARGEST):
        limits = f"{_SMALLEST:g} to {_LARGEST:g} m wide and deep"
        raise ConfigError(f"--room: should be {limits}, is {width:.3g} x {depth:.3g}")
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    return x - width / 2, y - depth / 2, x + width / 2, y + depth / 2


def save_rig(path: Path, params: SimulateParams) -> None:
    """Write a planned room, so that it can be simulated; raises LogError if that fails."""
    rig = params.rig
    cameras = [
        {
            "frame": f"camera_{k}",
            "parent": "world",
            "translation": [round(x, 4) for x in pose[:3]],
            "quaternion_xyzw": [round(x, 7) for x in pose[3:]],
        }
        for k, pose in enumerate(rig.poses)
    ]
    room = {"area": list(params.area), "fov": list(rig.fov), "range": list(rig.range)}
    write_text(path, CAMERAS_MARK + tomli_w.dumps({"room": room, "camera": cameras}))
