"""The RGB cameras of a log: their lenses, and the keypoints of all their images."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import hiros_schemas
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import TransformTree
from hiros_mcap.errors import LogError
from hiros_mcap.io.channels import channels_of
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.detectors.conversion import source_of
from hiros_mcap.io.keypoint_messages import decode_detections, joint_model
from hiros_mcap.io.log import Source, reading
from hiros_mcap.io.ros_messages import CAMERA_INFO, intrinsics_of, open_messages
from hiros_mcap.rays.intrinsics import Intrinsics
from hiros_mcap.rays.keypoints import KeypointFrame
from hiros_mcap.skeletons import SkeletonModel


class RgbCamera(NamedTuple):
    """An RGB camera and what a detector found in its images."""

    topic: str
    """Of its keypoints."""
    name: str
    """Its optical frame."""
    lens: Intrinsics
    model: SkeletonModel
    """Of the joints; only their names and links count."""
    frames: list[KeypointFrame]
    """In the order of the log."""


def read_rgb_cameras(
    source: Source, span: tuple[int, int] | None = None, step: int = 0
) -> list[RgbCamera]:
    """Read all cameras of a log that have keypoints and a lens; messages that are damaged are not.

    Parameters
    ----------
    span : log times, ns, between which images are read; None = all. step : ns; of each camera, one
    image in each such interval is read; 0 = all.

    Raises LogError if the log cannot be read.
    """
    with reading(source) as reader:
        lenses = _lenses(reader)
        cameras = [
            _camera(reader, info.id, lenses, span or (0, 2**63 - 1), step)
            for info in channels_of(reader)
            if info.count and info.has_type(hiros_schemas.DETECTION_ARRAY)
        ]
        return [camera for camera in cameras if camera is not None]


def _lenses(reader: McapReader) -> dict[str, Intrinsics]:
    """Optical frame -> lens."""
    lenses: dict[str, Intrinsics] = {}
    with open_messages(reader) as messages:
        topics = [topic for topic, kind in messages.types.items() if kind == CAMERA_INFO]
        seen: set[str] = set()
        for raw in messages.read(topics):
            if raw.topic not in seen:
                seen.add(raw.topic)
                info = messages.decode(raw)
                lenses[info.header.frame_id] = intrinsics_of(info, raw.topic)
    return lenses


def _camera(
    reader: McapReader,
    channel: int,
    lenses: dict[str, Intrinsics],
    span: tuple[int, int],
    step: int,
) -> RgbCamera | None:
    """Read a channel of keypoints; None if it has no lens."""
    (info,) = (info for info in channels_of(reader) if info.id == channel)
    source, model = source_of(reader, info, selected=True), joint_model(info)
    frames: list[KeypointFrame] = []
    name, due = "", span[0]
    for message in reader.messages({channel}):
        if not due <= message.log_time <= span[1]:
            continue
        due = message.log_time + step
        with suppress(LogError):
            found = decode_detections(source.message(message).fields, model.n_markers)
            name = name or found.frame_id
            stamps = found.stamp or message.log_time, message.log_time
            frames.append(KeypointFrame(name, *stamps, found.pixels, found.scores))
    lens = lenses.get(name)
    return None if lens is None else RgbCamera(info.topic, name, lens, model, frames)


def poses_of(
    cameras: Sequence[RgbCamera], transforms: TransformTree, fixed_frame: str
) -> dict[str, Rigid]:
    """Pose in the fixed frame of each camera whose optical frame is joined to it, by its name."""
    poses = {}
    for camera in cameras:
        with suppress(LogError):
            poses[camera.name] = transforms.lookup(camera.name, fixed_frame, 0)
    return poses
