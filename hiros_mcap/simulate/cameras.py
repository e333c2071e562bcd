"""The cameras: their true and published poses, the times of their frames, and their file.

The file is that of ``--extrinsics``, with a table ``[room]``.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from hiros_mcap.body.rotations import Rigid, from_matrix, from_vector, multiply, to_matrix
from hiros_mcap.body.transforms import read_camera_entries, read_extrinsics, read_room
from hiros_mcap.errors import ConfigError
from hiros_mcap.outputs import CAMERAS_MARK, write_text
from hiros_mcap.simulate.settings import Area, CameraKind, SimulateParams
from hiros_mcap.skeletons import SECOND, Flags, Floats, Stamps


@dataclass(frozen=True, slots=True)
class SimulatedCamera:
    """One simulated camera, and its n nominal frames, also those that never arrive."""

    index: int
    kind: CameraKind
    matrix: Floats  # (3, 3) true rotation from camera to world
    pose: Rigid  # true pose in the world, of camera coordinates (x right, y down, z forward)
    published: Rigid  # the pose on /tf_static, with the errors of a calibration
    captured: Stamps  # (n,) when light hit the sensor, ns: true time
    stamped: Stamps
    """(n,) the same on the camera's own clock: the skeletons' src_time, the keypoints' stamp."""
    sent: Stamps  # (n,) header.stamp: when the detector was done, on the camera's clock
    logged: Stamps  # (n,) when the message reached the log, ns: true time
    kept: Flags  # (n,) whether the frame arrives at all

    @property
    def name(self) -> str:
        """Frame of its coordinates, and the first part of its topic."""
        return f"camera_{self.index}"

    def points(self, world: Floats) -> Floats:
        """Camera coordinates of points (..., 3) in the world, m."""
        points: Floats = (world - self.pose.translation) @ self.matrix
        return points


def stream(seed: int, effect: str, *keys: int) -> np.random.Generator:
    """Return the generator that belongs to an effect (of a camera, of a person).

    One independent stream per effect, so that switching one off leaves the rest.
    """
    return np.random.default_rng([seed, zlib.crc32(effect.encode()), *keys])


def build_cameras(params: SimulateParams) -> list[SimulatedCamera]:
    """Build cameras at their poses, or on a circle, looking inwards; two at a right angle."""
    if params.rig.poses:
        poses = [
            Rigid(np.array(numbers[3:]), np.array(numbers[:3])) for numbers in params.rig.poses
        ]
        return [_camera(params, k, pose, to_matrix(pose.xyzw)) for k, pose in enumerate(poses)]
    turn = stream(params.seed, "rig").uniform(0, 2 * np.pi)
    step = 2 * np.pi / max(params.cameras, 4 if params.cameras == 2 else 1)
    if params.rig.apart is not None:
        step = np.radians(params.rig.apart)
    return [_on_circle(params, index, turn + index * step) for index in range(params.cameras)]


def _on_circle(params: SimulateParams, index: int, bearing: float) -> SimulatedCamera:
    rig = params.rig
    place = np.array([rig.radius * np.cos(bearing), rig.radius * np.sin(bearing), rig.height])
    matrix = aimed(np.array([0.0, 0.0, rig.aim_height]) - place)
    return _camera(params, index, Rigid(from_matrix(matrix), place), matrix)


def aimed(forward: Floats) -> Floats:
    """(3, 3) rotation from camera to world of a camera that looks along ``forward`` (3,), m."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(forward, right), forward])


def _camera(params: SimulateParams, index: int, pose: Rigid, matrix: Floats) -> SimulatedCamera:
    """Add the errors of the calibration and of the clock, and the times of all frames."""
    rng, rig = stream(params.seed, "clock", index), params.rig
    phase = 0.0 if rig.synchronised else rng.random()
    offset = rig.clock_offset * rng.standard_normal()
    n = max(1, int(np.ceil(params.seconds * rig.rate - phase)))
    jitter = params.clock_jitter * rig.jitter * rng.standard_normal(n)
    jitter = np.clip(jitter, -0.4 / rig.rate, 0.4 / rig.rate)  # frames stay in order
    seconds = np.maximum(0.0, (phase + np.arange(n)) / rig.rate + jitter)
    delay = rng.uniform(*rig.delay, n)
    captured = params.start + _nanoseconds(seconds)
    logged = np.maximum.accumulate(captured + _nanoseconds(delay))
    clock = _nanoseconds(np.array(offset))
    paused = np.abs(seconds - params.seconds / 2) < rig.pause / 2
    return SimulatedCamera(
        index=index,
        kind=rig.kinds[index % len(rig.kinds)],
        matrix=matrix,
        pose=pose,
        published=_with_calibration_error(pose, params, index),
        captured=captured,
        stamped=captured + clock,
        sent=logged + clock,
        logged=logged,
        kept=(rng.random(n) >= min(1.0, params.dropouts * rig.lost_frames)) & ~paused,
    )


def bearing_of(cameras: Sequence[SimulatedCamera]) -> float:
    """Direction, deg, from the middle of the room to most of the cameras; all around: the first."""
    places = np.array([camera.pose.translation[:2] for camera in cameras])
    x, y = places.sum(axis=0) + 1e-3 * places[0]
    return float(np.degrees(np.arctan2(y, x)))


def _with_calibration_error(pose: Rigid, params: SimulateParams, index: int) -> Rigid:
    """Return the pose as a calibration finds it: a little off."""
    rng, rig, scale = (
        stream(params.seed, "calibration", index),
        params.rig,
        params.calibration_error,
    )
    shift = scale * rig.position_error * rng.standard_normal(3)
    turn = np.radians(scale * rig.orientation_error) * rng.standard_normal(3)
    return Rigid(multiply(from_vector(turn), pose.xyzw), pose.translation + shift)


def _nanoseconds(seconds: Floats) -> Stamps:
    return np.round(seconds * SECOND).astype(np.int64)


def seconds_since(start: int, stamps: Stamps) -> Floats:
    """Time, s, since ``start`` of stamps, both ns."""
    elapsed: Floats = (stamps - start).astype(np.float64) / SECOND
    return elapsed


_LOWEST, _HIGHEST = 0.05, 20.0  # m above the floor
_SMALLEST, _LARGEST = 1.5, 40.0  # m, of a room
_NEVER = 1 << 62


def read_rig(path: Path) -> tuple[Mapping[str, Rigid], dict[str, Any]]:
    """Read the cameras of a file, where they were last, and the room if the file has one.

    Without the table ``[room]``, the room is the least rectangle that holds all cameras.

    Returns
    -------
    Frame of a camera -> its pose, z up from the floor.
    What that means for a simulation: fields of SimulateParams.

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
    return poses, settings


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
