"""The whole simulation: people, cameras, what the cameras report, the truth, and the log."""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid, conjugate, from_matrix, multiply, to_vector
from hiros_mcap.io.channels import add_skeleton_channel, add_static_poses
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.detectors.keypoint_messages import (
    add_camera_info,
    add_keypoint_channel,
    encode_detections,
)
from hiros_mcap.progress import Progress
from hiros_mcap.rays.keypoints import KeypointFrame
from hiros_mcap.simulate.actions import ACTIONS
from hiros_mcap.simulate.body_model import LINK_SEGMENTS, MODEL, BodyModel
from hiros_mcap.simulate.cameras import (
    SimulatedCamera,
    bearing_of,
    build_cameras,
    seconds_since,
    stream,
)
from hiros_mcap.simulate.detector import SimulatedDetections, detect
from hiros_mcap.simulate.image_detector import SimulatedKeypoints, detect_keypoints, lens_of
from hiros_mcap.simulate.motion import Person
from hiros_mcap.simulate.settings import SimulateParams
from hiros_mcap.skeletons import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    ANGULAR_VELOCITY,
    ORIENTATION,
    POSITION,
    VELOCITY,
    Floats,
    Frame,
    SkeletonModel,
    Stamps,
)

WORLD, TRUTH_TOPIC = "world", "/truth/skeletons"
_KEYPOINTS = "/keypoints"
_STEP = 1e-3  # s, of the central differences that give the truth's velocities
_CHUNK = 256  # instants of truth evaluated at once


@dataclass(frozen=True)
class Simulation:
    """A scene and what its cameras say about it; the same ``params``, the same numbers.

    Nothing is computed before it is asked for. Frames are made one by one while iterating.
    """

    params: SimulateParams

    @property
    def model(self) -> SkeletonModel:
        """The 32 joints and 31 links of the Azure Kinect."""
        return MODEL

    @cached_property
    def people(self) -> Sequence[Person]:
        """Who is there, with his proportions and his motion as a function of time, s."""
        params = self.params
        rng = stream(params.seed, "people")
        bodies = [
            BodyModel.of(rng.uniform(*params.heights), params.proportions, rng)
            for _ in range(params.people)
        ]
        motion = stream(params.seed, "motion")
        facing = params.facing
        if facing is None and params.action == "pass":
            facing = bearing_of(self.cameras)
        return ACTIONS[params.action].inside(params.area).perform(bodies, motion, facing)

    @cached_property
    def cameras(self) -> list[SimulatedCamera]:
        """The cameras with their true and their published poses."""
        return build_cameras(self.params)

    @property
    def transforms(self) -> dict[str, Rigid]:
        """Published pose in the world of each camera, by its name: what /tf_static says."""
        return {camera.name: camera.published for camera in self.cameras}

    @property
    def intrinsics(self) -> dict[str, Intrinsics]:
        """Lens of each RGB camera, by its name."""
        lens = lens_of(self.params.image)
        return {camera.name: lens for camera in self.cameras if camera.kind == "rgb"}

    @cached_property
    def _reported(self) -> dict[int, SimulatedDetections]:
        return {
            camera.index: detect(self.people, camera, self.params)
            for camera in self.cameras
            if camera.kind == "depth"
        }

    @cached_property
    def _found(self) -> dict[int, SimulatedKeypoints]:
        return {
            camera.index: detect_keypoints(self.people, camera, self.params)
            for camera in self.cameras
            if camera.kind == "rgb"
        }

    @property
    def detections(self) -> Iterator[Frame]:
        """What depth cameras detect, in log-time order, each in its camera's coordinates.

        ``stamp`` is header.stamp; ``stamps`` are the skeletons' src_time.
        """
        for camera, k in self._frames(self._reported):
            yield _frame(camera, self._reported[camera.index], k)

    @property
    def keypoints(self) -> Iterator[KeypointFrame]:
        """What RGB cameras find in their images, in log-time order."""
        for camera, k in self._frames(self._found):
            stamps = int(camera.stamped[k]), int(camera.logged[k])
            yield KeypointFrame(camera.name, *stamps, *self._found[camera.index].image(k))

    def _frames(self, cameras: Mapping[int, object]) -> Iterator[tuple[SimulatedCamera, int]]:
        """Yield camera and number of the frames that arrive of some cameras, in log-time order."""
        order = sorted(
            (int(self.cameras[index].logged[k]), index, int(k))
            for index in cameras
            for k in np.flatnonzero(self.cameras[index].kept)
        )
        yield from ((self.cameras[index], k) for _, index, k in order)

    @property
    def truth(self) -> Iterator[Frame]:
        """Where everybody really is, in frame "world", with velocities and accelerations."""
        params = self.params
        count = np.arange(int(np.ceil(params.seconds * params.truth_rate)))
        stamps = params.start + np.round(count / params.truth_rate * 1e9).astype(np.int64)
        for start in range(0, len(stamps), _CHUNK):
            yield from self.truth_at(stamps[start : start + _CHUNK])

    def truth_at(self, stamps: Stamps) -> list[Frame]:
        """Return the truth at any instants, ns since the epoch; ids are 0, 1, ..."""
        markers, links = self._kinematics(seconds_since(self.params.start, stamps))
        frames = []
        for k, stamp in enumerate(stamps.tolist()):
            frame = Frame.empty(len(self.people), MODEL, stamp=stamp, source=WORLD, frame_id=WORLD)
            frame.ids[:] = np.arange(len(self.people))
            frame.markers[:], frame.links[:] = markers[:, k], links[:, k]
            for confidences in (
                frame.confidences,
                frame.marker_confidences,
                frame.link_confidences,
            ):
                confidences[:] = 1.0
            frames.append(frame)
        return frames

    def _kinematics(self, t: Floats) -> tuple[Floats, Floats]:
        """States (P, n, M, 19) of markers and (P, n, L, 19) of links at times ``t``, s."""
        markers = np.full((len(self.people), len(t), MODEL.n_markers, 19), np.nan)
        links = np.full((len(self.people), len(t), MODEL.n_links, 19), np.nan)
        for state, link_state, person in zip(markers, links, self.people, strict=True):
            (before, q_before), (now, q_now), (after, q_after) = (
                _markers_and_links(person, t + shift) for shift in (-_STEP, 0.0, _STEP)
            )
            state[..., POSITION] = now
            state[..., VELOCITY] = (after - before) / (2 * _STEP)
            state[..., ACCELERATION] = (after - 2 * now + before) / _STEP**2
            link_state[..., ORIENTATION] = q_now
            coming = to_vector(multiply(q_now, conjugate(q_before))) / _STEP
            going = to_vector(multiply(q_after, conjugate(q_now))) / _STEP
            link_state[..., ANGULAR_VELOCITY] = (coming + going) / 2
            link_state[..., ANGULAR_ACCELERATION] = (going - coming) / _STEP
        return markers, links


_DEFAULT = SimulateParams()


def simulate(params: SimulateParams = _DEFAULT) -> Simulation:
    """Set up a scene with known truth, and cameras that see it as badly as ``params`` ask."""
    return Simulation(params)


def _markers_and_links(person: Person, t: Floats) -> tuple[Floats, Floats]:
    markers, rotations = person.pose(t)
    return markers, from_matrix(rotations)[:, LINK_SEGMENTS]


def _frame(camera: SimulatedCamera, reported: SimulatedDetections, k: int) -> Frame:
    """Message ``k`` of a camera."""
    there = np.flatnonzero(reported.present[k])
    frame = Frame.empty(
        len(there),
        MODEL,
        stamp=int(camera.sent[k]),
        log_time=int(camera.logged[k]),
        source=camera.name,
        frame_id=camera.name,
    )
    frame.stamps[:] = camera.stamped[k]
    frame.positions[:] = reported.positions[k, there]
    frame.orientations[:] = reported.orientations[k, there]
    confidences = reported.confidences[k, there]
    frame.marker_confidences[:] = confidences
    frame.link_confidences[:] = np.minimum(confidences[:, 1:], confidences[:, MODEL.link_parents])
    frame.confidences[:] = confidences.mean(axis=-1)
    return frame


def write_log(
    path: str | os.PathLike[str], params: SimulateParams, progress: Progress | None = None
) -> dict[str, int]:
    """Write a simulated log and return its messages by topic.

    Skeletons are on /<camera>/skeletons in the camera's coordinates, keypoints of RGB cameras on
    /<camera>/keypoints and their lens on /<camera>/camera_info, the cameras' published poses on
    /tf_static, and the true skeletons on /truth/skeletons in the frame "world". The same parameters
    give the same bytes. ``progress`` is told the time that is simulated, ns.

    Raises LogError if ``path`` cannot be written; there is no file then.
    """
    simulation = simulate(params)
    encoder = Encoder(simulation.model)
    with McapWriter(path) as writer:
        add_static_poses(writer, simulation.transforms, WORLD, params.start)
        for camera, lens in simulation.intrinsics.items():
            add_camera_info(writer, f"/{camera}/camera_info", lens, camera, params.start)
        channels: dict[str, int] = {}
        for topic, frame in _by_log_time(simulation):
            if isinstance(frame, KeypointFrame):
                data = encode_detections(frame, frame.camera)
            else:
                data = encoder.encode(frame)
            if topic not in channels:
                channels[topic] = _add_channel(writer, topic, params)
            writer.write(channels[topic], frame.log_time, data)
            if progress is not None:
                progress.update(frame.stamp - params.start, round(params.seconds * 1e9))
        writer.commit()
        return {writer.channels[ident].topic: n for ident, n in sorted(writer.counts.items())}


def _add_channel(writer: McapWriter, topic: str, params: SimulateParams) -> int:
    if topic.endswith(_KEYPOINTS):
        return add_keypoint_channel(writer, topic, params.image.joints)
    return add_skeleton_channel(writer, topic)


def _by_log_time(simulation: Simulation) -> Iterator[tuple[str, Frame | KeypointFrame]]:
    """Yield all messages with their topics, in log-time order."""
    named = ((f"/{frame.source}/skeletons", frame) for frame in simulation.detections)
    true = ((TRUTH_TOPIC, frame) for frame in simulation.truth)
    images = ((f"/{frame.camera}{_KEYPOINTS}", frame) for frame in simulation.keypoints)
    return heapq.merge(named, true, images, key=lambda pair: pair[1].log_time)
