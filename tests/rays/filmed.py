"""Keypoints of people who are filmed by RGB cameras, with the errors of a real detector."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid, from_matrix, from_vector
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.io.channels import add_static_poses
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.detectors.keypoint_messages import (
    add_camera_info,
    add_keypoint_channel,
    encode_detections,
)
from hiros_mcap.rays.keypoints import KeypointFrame
from hiros_mcap.simulate import SimulateParams, simulate

LENS = Intrinsics(
    (1280, 960), np.array([[900.0, 0, 640], [0, 900, 480], [0, 0, 1]]), np.array([-0.1, 0.02, 0, 0])
)
JOINTS = [0, 2, 3, 5, 6, 7, 12, 13, 14, 18, 19, 20, 21, 22, 23, 24, 25, 27]


class Film(NamedTuple):
    """What a detector found, and the truth."""

    frames: dict[str, list[KeypointFrame]]
    lenses: dict[str, Intrinsics]
    poses: dict[str, Rigid]
    """Camera -> where it stands in the room."""
    lags: dict[str, float]
    """Camera -> s by which its stamps are late."""


def looking(place, target):
    """A camera at a place that looks at a target, upright: its optical frame in the room."""
    z = np.subtract(target, place) / np.linalg.norm(np.subtract(target, place))
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return Rigid(from_matrix(np.stack([x, np.cross(z, x), z], axis=1)), np.array(place, float))


def around(cameras=4, radius=4.0, centre=(0.0, 0.0)):
    """Cameras around the middle of the room, at different heights."""
    angles = 2 * np.pi * (np.arange(cameras) + 0.3) / cameras
    return {
        f"cam{c + 1}": looking(
            [centre[0] + radius * np.cos(a), centre[1] + radius * np.sin(a), 1.7 + 0.25 * (c % 3)],
            [*centre, 1.0],
        )
        for c, a in enumerate(angles)
    }


def turned(poses, degrees, seed=0):
    """Poses that somebody measured badly, but the first one."""
    rng = np.random.default_rng(seed)
    wrong = {}
    for k, (name, pose) in enumerate(poses.items()):
        axis = rng.normal(size=3)
        turn = np.radians(degrees) * axis / np.linalg.norm(axis) * (k > 0)
        shift = rng.normal(size=3) * 0.02 * degrees * (k > 0)
        wrong[name] = Rigid(from_vector(turn), np.zeros(3)) @ Rigid(pose.xyzw, np.zeros(3))
        wrong[name] = Rigid(wrong[name].xyzw, pose.translation + shift)
    return wrong


def coloured(rng, n, shape, seconds, rate):
    """(n, ...) noise of standard deviation 1 that lasts for some seconds."""
    if not seconds:
        return rng.normal(size=(n, *shape))
    keep = np.exp(-1.0 / (rate * seconds))
    noise = rng.normal(size=(n, *shape))
    noise[1:] *= np.sqrt(1.0 - keep**2)
    for k in range(1, n):
        noise[k] += keep * noise[k - 1]
    return noise


def walking(people=2, seconds=12.0, seed=1, **params):
    """The truth of a simulated scene."""
    scene = {"people": people, "seconds": seconds, "seed": seed, "rig": {"rate": 30.0}, **params}
    simulation = simulate(SimulateParams.model_validate(scene))
    return Truth.of(simulation.truth, simulation.model)


def film(truth, poses, *, rate=30.0, lags=None, seed=0, noise=1.0, joints=JOINTS):
    """Film a truth; ``noise`` scales 2.5 px white, 4 px over .3 s and 5 px over 5 s."""
    rng = np.random.default_rng(seed)
    lags = lags or dict.fromkeys(poses, 0.0)
    first, last = int(truth.stamps[0]), int(truth.stamps[-1])
    frames = {}
    for k, (name, pose) in enumerate(poses.items()):
        begin = first + round(1e9 * k / rate / 4)  # a quarter of a frame apart
        times = np.arange(begin, last, round(1e9 / rate))
        places = truth.at(times)[0][:, :, joints]
        pixels = LENS.pixels(pose.inverse().moved(places))
        for px, lasting in ((2.5, 0.0), (4.0, 0.3), (5.0, 5.0)):
            pixels += noise * px * coloured(rng, len(times), pixels.shape[1:], lasting, rate)
        outlying = rng.random(pixels.shape[:3]) < 0.015 * (noise > 0)
        pixels[outlying] += rng.normal(size=(int(outlying.sum()), 2)) * 60.0
        pixels[rng.random(pixels.shape[:3]) < 0.05] = np.nan
        width, height = LENS.size
        inside = (pixels > 0).all(axis=-1) & (pixels[..., 0] < width) & (pixels[..., 1] < height)
        pixels[~inside] = np.nan
        there = inside.sum(axis=2) > 3
        stamps = times + round(1e9 * lags[name])
        order = [rng.permutation(np.flatnonzero(row)) for row in there]  # nobody has an id
        frames[name] = [
            KeypointFrame(
                name, int(s), int(s), p[rows], np.where(np.isnan(p[rows, :, 0]), 0.0, 0.9)
            )
            for s, p, rows in zip(stamps, pixels, order, strict=True)
        ]
    return Film(frames, dict.fromkeys(poses, LENS), dict(poses), lags)


def film_log(path, scene, joints, poses):
    """Write a film as a log, with these joints and poses of the cameras."""
    with McapWriter(path) as writer:
        stamp = min(frames[0].stamp for frames in scene.frames.values())
        add_static_poses(writer, poses, "room", stamp)
        for name, frames in scene.frames.items():
            add_camera_info(writer, f"/{name}/camera_info", scene.lenses[name], name, stamp)
            channel = add_keypoint_channel(writer, f"/{name}/keypoints", ",".join(joints))
            for frame in frames:
                writer.write(channel, frame.stamp, encode_detections(frame, name))
        writer.commit()
