"""Logs for benchmarks: simulated scenes, and what may be wrong with a rig.

Scenes are before the realistic detector, "kinect", unless ``--detector ideal`` or a scene says
otherwise: errors of the ideal one average out, those of whole limbs do not. Benchmarks of speed
take the usual parameters of a simulation: how right a joint is changes nothing there.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import Transform, TransformTree, transform_to_fixed
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.io.channels import add_skeleton_channel, add_static_poses
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.simulate.chance import coloured
from hiros_mcap.simulate.simulation import TRUTH_TOPIC, write_log
from hiros_mcap.skeletons import POSITION, Floats, Frame, SkeletonModel, Stamps


@dataclass(frozen=True)
class Scene:
    """Views and places of cameras, by the cameras' names."""

    model: SkeletonModel
    frames: list[Frame]
    poses: Mapping[str, Rigid]
    clocks: Mapping[str, float]
    """s that the stamps of each camera are too late."""
    truth: Sequence[Frame] = ()

    def write(self, path: Path, *, transforms: bool = False) -> None:
        """Write a log, by default without transforms."""
        encoder = Encoder(self.model)
        named = [(f"/{frame.source}/people", frame) for frame in self.frames]
        named += [(TRUTH_TOPIC, frame) for frame in self.truth]
        with McapWriter(path) as writer:
            if transforms:
                start = min(frame.log_time for frame in self.frames)
                add_static_poses(writer, self.poses, "world", start)
            channels: dict[str, int] = {}
            for topic, frame in sorted(named, key=lambda pair: pair[1].log_time):
                if topic not in channels:
                    channels[topic] = add_skeleton_channel(writer, topic)
                writer.write(channels[topic], frame.log_time, encoder.encode(frame))
            writer.commit()


DETECTOR = argparse.ArgumentParser(add_help=False)
"""A parent of parsers: the option that names the detector of all scenes."""
DETECTOR.add_argument(
    "--detector",
    default="kinect",
    choices=("kinect", "ideal"),
    help="of simulated logs, by default kinect: whole limbs err together",
)
_usual = {"kind": "kinect"}


def use_detector(arguments: Sequence[str]) -> list[str]:
    """Let all scenes be before the detector that a command names; return its other arguments."""
    given, rest = DETECTOR.parse_known_args(arguments)
    _usual["kind"] = given.detector
    return rest


def params_of(seed: int, **changes: Any) -> SimulateParams:
    """Return the parameters of a scene: usual ones, but for the detector and ``changes``."""
    detector = {**_usual, **changes.pop("detector", {})}
    return SimulateParams.model_validate({"seed": seed, **changes, "detector": detector})


def write_scene(path: Path, seed: int, **changes: Any) -> Path:
    """Write a log of a scene."""
    write_log(path, params_of(seed, **changes))
    return path


def simulated(seed: int, *, shift: float = 2.0, **params: Any) -> Scene:
    """Simulate a scene whose cameras' clocks are wrong by up to ``shift`` s; log times as well.

    The poses are the true ones.
    """
    simulation = simulate(params_of(seed, **params))
    rng = np.random.default_rng(seed)
    clocks = {camera.name: rng.uniform(-shift, shift) for camera in simulation.cameras}
    frames = [late(frame, clocks[frame.source]) for frame in simulation.detections]
    poses = {camera.name: camera.pose for camera in simulation.cameras}
    return Scene(simulation.model, frames, poses, clocks)


def published(seed: int, **params: Any) -> Scene:
    """Simulate a scene with right clocks, the poses that its log states, and its truth."""
    simulation = simulate(params_of(seed, **params))
    clocks = dict.fromkeys(simulation.transforms, 0.0)
    frames, truth = list(simulation.detections), list(simulation.truth)
    return Scene(simulation.model, frames, simulation.transforms, clocks, truth)


def late(frame: Frame, seconds: float) -> Frame:
    """Return a message whose clock and log time are late."""
    ns = round(1e9 * seconds)
    return frame.replace(
        stamp=frame.stamp + ns, log_time=frame.log_time + ns, stamps=frame.stamps + ns
    )


def wrong_stamps(scene: Scene, seed: int, most: float = 0.1) -> Scene:
    """Return a scene whose cameras stamp wrongly by up to ``most`` s; log times stay."""
    rng = np.random.default_rng(seed)
    clocks = {name: float(rng.uniform(-most, most)) for name in scene.poses}
    frames = [
        late(frame, clocks[frame.source]).replace(log_time=frame.log_time) for frame in scene.frames
    ]
    return replace(scene, frames=frames, clocks=clocks)


def knocked(scene: Scene, degrees: float, metres: float, share: float = 0.5) -> Scene:
    """Return a scene whose second camera, after a ``share`` of the log, stands elsewhere.

    It is rotated by ``degrees`` and moved by ``metres``; the log still states where it stood.
    """
    name = sorted(scene.poses)[1]
    stood = scene.poses[name]
    back = (stood @ _push(degrees, metres)).inverse() @ stood
    times = [frame.log_time for frame in scene.frames]
    from_then = min(times) + share * (max(times) - min(times))
    after = [f for f in scene.frames if f.source == name and f.log_time >= from_then]
    rest = [f for f in scene.frames if f.source != name or f.log_time < from_then]
    tree = TransformTree()
    tree.add(Transform(0, "moved", name, tuple(back.translation), tuple(back.xyzw)), static=True)
    moved = [f.replace(frame_id=name) for f in transform_to_fixed(after, tree, "moved")]
    return replace(scene, frames=[*rest, *moved])


def misplaced(scene: Scene, degrees: float, metres: float = 0.0) -> Scene:
    """Return a scene whose second camera is said to stand where it does not."""
    name = sorted(scene.poses)[1]
    return replace(scene, poses={**scene.poses, name: scene.poses[name] @ _push(degrees, metres)})


GUESSED_BODY, GUESSED_TILT, GUESSED_SECONDS = 0.035, 0.3, 1.0
"""Of a detector that guesses depths: SD of the depth of a body as a share of its distance, SD of
the slope of each link against the image, and the time constant of both, s."""


def guessing(scene: Scene, seed: int) -> Scene:
    """Return a scene whose detectors guess depths from one image, as MediaPipe does on film.

    Joints stay on their rays. A body is too near or too far, and each link leans towards the camera
    or away from it, with all that hangs on it; both change slowly.
    """
    rng, truth, frames = np.random.default_rng(seed), Truth.of(scene.truth), list[Frame]()
    parents = scene.model.link_parents
    for name, pose in scene.poses.items():
        views = [frame for frame in scene.frames if frame.source == name]
        stamps: Stamps = np.array([frame.stamp for frame in views])
        lasts = float(np.exp(-np.median(np.diff(stamps)) * 1e-9 / GUESSED_SECONDS))
        shape = (len(views), len(truth.people))
        bodies = 1 + GUESSED_BODY * coloured(rng, shape, lasts)
        slopes = GUESSED_TILT * coloured(rng, (*shape, len(parents)), lasts)
        # Before the first and after the last instant of the truth, people are where they were then.
        true = truth.at(np.clip(stamps, truth.stamps[0], truth.stamps[-1]))[0]
        for frame, there, body, slope in zip(views, true, bodies, slopes, strict=True):
            people = frame.people.copy()
            for points in people.markers[:, :, POSITION]:
                off: Floats = np.linalg.norm(pose.moved(points[None])[0] - there, axis=2)
                who = int(np.nanargmin(np.nanmean(off, axis=1)))
                length = np.linalg.norm(points[1:] - points[list(parents)], axis=1)
                deeper = np.zeros(len(points))
                for link, parent in enumerate(parents):  # parents come first
                    deeper[link + 1] = deeper[parent] + slope[who, link] * length[link]
                away = np.linalg.norm(points, axis=1)
                points *= (body[who] + deeper / away)[:, None]
            frames.append(frame.replace(people=people))
    return replace(scene, frames=frames)


def _push(degrees: float, metres: float) -> Rigid:
    """Rotation about a slanting axis and shift along another one, in the camera's coordinates."""
    half, axis = np.radians(degrees) / 2, np.array([1.0, 2.0, 2.0]) / 3
    shift = metres * np.array([2.0, 1.0, -2.0]) / 3
    return Rigid(np.array([*(np.sin(half) * axis), np.cos(half)]), shift)


REALISTIC: Mapping[str, Any] = {
    "people": 2,
    "cameras": 2,
    "action": "pass",
    "seconds": 30.0,
    "rig": {"apart": 45.0, "radius": 2.7, "height": 1.5, "pause": 5.0},
}
"""The scene of real recordings by two Kinect v2: people who stand .8 m apart, face the cameras and
pass each other; cameras that stand 45 degrees apart and 2.7 m away, and pause once for all."""


def realistic(path: Path, seed: int, **changes: Any) -> Path:
    """Write a log of a realistic scene, or with other parameters of a simulation."""
    rig = {**REALISTIC["rig"], **changes.pop("rig", {})}
    return write_scene(path, seed, **{**REALISTIC, **changes, "rig": rig})
