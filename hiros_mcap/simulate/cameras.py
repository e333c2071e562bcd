"""The cameras: their true and published poses, and the times of their frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hiros_mcap.body.rotations import Rigid, multiply, to_matrix
from hiros_mcap.simulate.randomness import stream
from hiros_mcap.simulate.settings import SimulateParams
from hiros_mcap.simulate.spatial import from_vector, quaternions
from hiros_mcap.skeletons import Floats, Stamps

_SECOND = 1e9


@dataclass(frozen=True, slots=True)
class Ticks:
    """The nominal frames of one camera, n of them, also those that never arrive. All (n,)."""

    captured: Stamps
    """When light hit the sensor, ns: true time."""
    stamped: Stamps
    """The same on the camera's own clock: the skeletons' src_time."""
    sent: Stamps
    """header.stamp: when the detector was done, on the camera's clock."""
    logged: Stamps
    """When the message reached the log, ns: true time."""
    kept: np.ndarray[tuple[int], np.dtype[np.bool_]]
    """Whether the frame arrives at all."""


@dataclass(frozen=True, slots=True)
class SimulatedCamera:
    """One simulated depth camera."""

    index: int
    matrix: Floats
    """(3, 3) true rotation from camera to world."""
    pose: Rigid
    """True pose in the world, of camera coordinates (x right, y down, z forward)."""
    published: Rigid
    """The pose on /tf_static, with the errors of a calibration."""
    ticks: Ticks

    @property
    def name(self) -> str:
        """Frame of its coordinates, and the first part of its topic."""
        return f"camera_{self.index}"

    def points(self, world: Floats) -> Floats:
        """Camera coordinates of points (..., 3) in the world, m."""
        seen: Floats = (world - self.pose.translation) @ self.matrix
        return seen


def build_cameras(params: SimulateParams) -> list[SimulatedCamera]:
    """Build cameras at their poses, or on a circle, looking inwards; two at a right angle."""
    if params.rig.poses:
        poses = [Rigid(np.array(each[3:]), np.array(each[:3])) for each in params.rig.poses]
        return [_camera(params, k, pose, to_matrix(pose.xyzw)) for k, pose in enumerate(poses)]
    turn = stream(params.seed, "rig").uniform(0, 2 * np.pi)
    step = 2 * np.pi / max(params.cameras, 4 if params.cameras == 2 else 1)
    return [_on_circle(params, index, turn + index * step) for index in range(params.cameras)]


def _on_circle(params: SimulateParams, index: int, bearing: float) -> SimulatedCamera:
    rig = params.rig
    place = np.array([rig.radius * np.cos(bearing), rig.radius * np.sin(bearing), rig.height])
    matrix = aimed(np.array([0.0, 0.0, rig.aim_height]) - place)
    return _camera(params, index, Rigid(quaternions(matrix), place), matrix)


def aimed(forward: Floats) -> Floats:
    """(3, 3) rotation from camera to world of a camera that looks along ``forward`` (3,), m."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(forward, right), forward])


def _camera(params: SimulateParams, index: int, pose: Rigid, matrix: Floats) -> SimulatedCamera:
    return SimulatedCamera(
        index, matrix, pose, _with_calibration_error(pose, params, index), _ticks(params, index)
    )


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


def _ticks(params: SimulateParams, index: int) -> Ticks:
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
    return Ticks(
        captured=captured,
        stamped=captured + clock,
        sent=logged + clock,
        logged=logged,
        kept=rng.random(n) >= min(1.0, params.dropouts * rig.lost_frames),
    )


def _nanoseconds(seconds: Floats) -> Stamps:
    return np.round(seconds * _SECOND).astype(np.int64)


def seconds_since(start: int, stamps: Stamps) -> Floats:
    """Time, s, since ``start`` of stamps, both ns."""
    elapsed: Floats = (stamps - start).astype(np.float64) / _SECOND
    return elapsed
