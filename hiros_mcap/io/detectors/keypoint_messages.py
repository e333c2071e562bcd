"""Messages of RGB cameras: keypoints as ``yolo_msgs/DetectionArray``, lenses as CameraInfo.

A DetectionArray has any number of joints and people, in px of the image, but does not name the
joints: the id of a keypoint is its number in a joint model, from 1. A channel that hiros writes
names the model in its metadata; in others it is COCO's, which YOLO uses.

hiros also reads ``hri_msgs/Skeleton2D``: 18 joints of one person, in shares of the image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import hiros_schemas
from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.io.channels import LATCHED_QOS, ChannelInfo, add_ros_channel
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.detectors.body_models import BODY_MODELS, body_model, linked
from hiros_mcap.io.detectors.detector_reader import DetectorMessage, nanoseconds
from hiros_mcap.io.ros_cdr import CdrWriter
from hiros_mcap.rays.keypoints import KeypointFrame, cleaned
from hiros_mcap.skeletons import Floats, SkeletonModel

JOINTS = "hiros:joints"
"""Key of a channel's metadata: the model of the table that numbers the joints, or their names."""
LATE = "hiros:late"
"""Key of a channel's metadata: how late its stamps are, s, as hiros found from the people."""
USUAL_JOINTS = "coco-17"
_HRI = body_model("hri-18")
_DETECTIONS = hiros_schemas.short_name(hiros_schemas.DETECTION_ARRAY)
KEYPOINT_TYPES = _DETECTIONS, hiros_schemas.short_name(hiros_schemas.SKELETON_2D)
"""Types that are read, ``pkg/Type``."""
DETECTIONS_IN_SPACE = f"{_DETECTIONS}3D"
"""What a channel of detections with keypoints in space is called, see :mod:`.yolo_bodies`."""


def joint_model(info: ChannelInfo) -> SkeletonModel:
    """Return the model by which a channel of keypoints numbers the joints."""
    if info.has_type(hiros_schemas.SKELETON_2D):
        return _HRI
    name = info.metadata.get(JOINTS, USUAL_JOINTS)
    return body_model(name) if name in BODY_MODELS else linked(name.split(","))


def lateness(info: ChannelInfo) -> float:
    """Return how late the stamps of a channel of keypoints are, s."""
    try:
        return float(info.metadata.get(LATE, "0"))
    except ValueError:
        return 0.0


def is_keypoints(info: ChannelInfo) -> bool:
    """Whether a channel has keypoints of images."""
    return info.type in KEYPOINT_TYPES


def decode_keypoints(
    message: DetectorMessage, joints: int, lenses: Mapping[str, Intrinsics]
) -> KeypointFrame:
    """Return the people of a message of :data:`KEYPOINT_TYPES`; its camera is the optical frame.

    ``joints`` is the number in the channel's model; ``lenses`` tell the images' sizes, by frame.
    Left out are detections without keypoints, which are of other things, ids beyond the model, and
    what :func:`~hiros_mcap.rays.keypoints.cleaned` does not take as found.

    Raises LogError for a message that is damaged.
    """
    header = message.fields.header
    lens = lenses.get(header.frame_id)
    if message.type == _DETECTIONS:
        pixels, scores = _of_detections(_keypoints(message, "keypoints"), joints)
        found = cleaned(pixels, scores, lens.size if lens else None)
    else:
        size = lens.size if lens else (1, 1)
        shares, scores = _of_skeleton2d(message.fields)
        found = cleaned(shares * size, scores, size)
    stamp = nanoseconds(header.stamp) or message.log_time
    return KeypointFrame(header.frame_id, stamp, message.log_time, *found)


def _of_detections(people: Sequence[Sequence[Any]], joints: int) -> tuple[Floats, Floats]:
    """(P, J, 2) px, and (P, J) scores, of keypoints at the places of their ids."""
    pixels = np.full((len(people), joints, 2), np.nan)
    scores = np.zeros((len(people), joints))
    for person, keypoints in enumerate(people):
        for found in keypoints:
            if 1 <= found.id <= joints:
                pixels[person, found.id - 1] = found.point.x, found.point.y
                scores[person, found.id - 1] = found.score
    return pixels, scores


def _of_skeleton2d(message: Any) -> tuple[Floats, Floats]:
    """(1, J, 2) shares of the image, and (1, J) scores, of the joints of "hri-18"."""
    points = np.full((1, _HRI.n_markers, 3), np.nan)
    for joint, point in enumerate(message.skeleton[: _HRI.n_markers]):
        points[0, joint] = point.x, point.y, point.c
    return points[..., :2], points[..., 2]


def joined(*messages: KeypointFrame) -> KeypointFrame:
    """Return the people of one image; some detectors have a topic per person."""
    pixels = np.concatenate([message.pixels for message in messages])
    scores = np.concatenate([message.scores for message in messages])
    return messages[0]._replace(pixels=pixels, scores=scores)


def has_keypoints_in_space(message: DetectorMessage) -> bool | None:
    """Whether the people of a DetectionArray have keypoints in space; None if it shows nobody.

    Raises LogError for a message that is damaged.
    """
    in_space = bool(_keypoints(message, "keypoints3d"))
    return in_space if in_space or _keypoints(message, "keypoints") else None


def _keypoints(message: DetectorMessage, name: str) -> list[Sequence[Any]]:
    """Return the keypoints of each detection that has some; the others show no people."""
    people = [getattr(d, name).data for d in message.fields.detections if hasattr(d, name)]
    return [keypoints for keypoints in people if len(keypoints)]


def encode_detections(frame: KeypointFrame, frame_id: str) -> bytes:
    """Return the people of an image as a DetectionArray in CDR; ``frame_id`` is optical."""
    there = ~np.isnan(frame.pixels[..., 0])
    people = np.flatnonzero(there.any(axis=1)).tolist()
    out = CdrWriter()
    out.header(frame.stamp, frame_id)
    out.uint32(len(people))
    for person in people:
        found = np.flatnonzero(there[person])
        pixels, scores = frame.pixels[person, found], frame.scores[person, found]
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        out.int32(0)
        out.string("person")
        out.float64(float(scores.mean()))
        out.string("")
        out.float64(*((low + high) / 2).tolist(), 0.0, *(high - low).tolist())
        out.float64(*[0.0] * 6, 1.0, *[0.0] * 3)  # no box in space, no mask
        out.string("")
        out.int32(0, 0)
        out.uint32(0)
        out.uint32(len(found))
        for joint, row in zip(found.tolist(), np.c_[pixels, scores].tolist(), strict=True):
            out.int32(joint + 1)
            out.float64(*row)
        out.uint32(0)
        out.string("")
    return out.finish()


def add_keypoint_channel(writer: McapWriter, topic: str, joints: str) -> int:
    """Declare a channel of detections with the joints of a model of the table; return its id."""
    return add_ros_channel(writer, topic, hiros_schemas.DETECTION_ARRAY, **{JOINTS: joints})


def add_camera_info(
    writer: McapWriter, topic: str, lens: Intrinsics, frame_id: str, stamp: int
) -> None:
    """Write the lens of a camera, latched; ``stamp``, ns, is the log time, too."""
    channel = add_ros_channel(writer, topic, hiros_schemas.CAMERA_INFO, LATCHED_QOS)
    writer.write(channel, stamp, camera_info(lens, frame_id, stamp))


def camera_info(lens: Intrinsics, frame_id: str, stamp: int) -> bytes:
    """Return a lens as a CameraInfo in CDR; its image is not rectified."""
    width, height = lens.size
    out = CdrWriter()
    out.header(stamp, frame_id)
    out.uint32(height)
    out.uint32(width)
    out.string(lens.model)
    out.sequence(lens.distortion)
    out.array(lens.matrix)
    out.array(np.eye(3))
    out.array(np.column_stack([lens.matrix, np.zeros(3)]))
    out.raw(bytes(6 * 4 + 1))  # no binning, no region of interest
    return out.finish()
