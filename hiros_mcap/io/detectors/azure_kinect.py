"""Bodies of the Azure Kinect ROS driver: one sphere per joint in a MarkerArray.

The driver publishes a message per capture on ``body_tracking_data``, with the positions in metres
in the frame of the depth camera. The id of a marker is the body's id times 100 plus the joint's
number in the Body Tracking SDK (``K4AROSDevice::getBodyMarker`` in src/k4a_ros_device.cpp). There
are no confidences. Forks for ROS 2 publish the same.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from hiros_mcap.io.detectors.body_models import body_model
from hiros_mcap.io.detectors.detector_reader import (
    NANO,
    DetectorMessage,
    DetectorReader,
    SeenPeople,
    seen_people,
)
from hiros_mcap.skeletons import ORIENTATION, Floats, Stamps

TOPIC = "body_tracking_data"
_SPHERE, _ADD = 2, 0
_LITTLE = b"\0\1"
_FIRST = 8  # byte of the first marker, behind the encapsulation and the number of markers
_LONGEST = 256  # bytes of a marker's namespace
_FACTOR = 100
"""Between the ids of two bodies."""


class AzureKinectMarkers(DetectorReader):
    """Any other MarkerArray is declined: its ids or its markers are of another kind."""

    types = ("visualization_msgs/MarkerArray",)

    def __init__(self) -> None:
        self._model = body_model("azure-kinect")
        self._frames: dict[str, str] = {}

    def read(self, message: DetectorMessage) -> Iterable[SeenPeople] | None:
        """Group the markers by body; an empty message names no frame, so the last one counts.

        Raises LogError for a message that is cut off.
        """
        data = bytes(message.cdr)
        if data[4:_FIRST] == bytes(4):  # no markers
            named = message.topic.rpartition("/")[2] == TOPIC
            return [self._nobody(message)] if named else None
        gathered = _gathered(data)
        if gathered is None:
            _ = message.fields  # says that it is damaged; otherwise it has other markers
            return None
        stamp, frame_id, ids, kinds, poses = gathered
        if not self._are_joints(ids) or (kinds != (_SPHERE, _ADD)).any():
            return None
        self._frames[message.topic] = frame_id
        bodies, rows = np.unique(ids // _FACTOR, return_inverse=True)
        joints = np.full((len(bodies), self._model.n_markers, 7), np.nan)
        joints[rows, ids % _FACTOR] = poses
        people = seen_people(
            self._model,
            message,
            frame_id,
            joints[:, :, :3],
            stamp=stamp,
            ids=bodies.tolist(),
        )
        turned = (joints[:, :, 3:] != 0).any(axis=-1)
        people.frame.markers[turned, ORIENTATION] = joints[turned, 3:]
        return [people]

    def _are_joints(self, ids: Stamps) -> bool:
        n = self._model.n_markers
        whole = len(ids) % n == 0 and len(np.unique(ids)) == len(ids)
        return bool(whole and (ids >= 0).all() and (ids % _FACTOR < n).all())

    def _nobody(self, message: DetectorMessage) -> SeenPeople:
        empty = np.empty((0, self._model.n_markers, 3))
        return seen_people(self._model, message, self._frames.get(message.topic, ""), empty)


def _gathered(data: bytes) -> tuple[int, str, Stamps, Stamps, Floats] | None:
    """Find the N markers of a capture, which all have one header; None where that does not hold.

    Returns the stamp, ns; the frame_id; the ids, (N,); types and actions, (N, 2); positions, m, and
    orientations x y z w, (N, 7).

    The header's bytes show where each marker begins. What stands behind the pose differs between
    the versions of ROS and is passed over. Decoding the fields takes fifty times as long.
    """
    if len(data) < _FIRST + 16 or data[:2] != _LITTLE:
        return None
    n, sec, nanosec, length = struct.unpack_from("<IiII", data, 4)
    header = data[_FIRST : _FIRST + 12 + length]
    if not n or length < 1 or len(header) < 12 + length:
        return None
    begins = [_FIRST]
    while (at := data.find(header, begins[-1] + len(header))) >= 0 and len(begins) <= n:
        begins.append(at)
    starts = np.array(begins, np.int64)
    if len(starts) != n or (starts % 4).any():
        return None
    content = np.frombuffer(data, np.uint8)
    name = starts + len(header) + -(len(header)) % 4
    if name[-1] + 4 > len(data):
        return None
    lengths = _numbers(content, name, "<u4", 1)[:, 0].astype(np.int64)
    ids = name + 4 + lengths + -lengths % 4
    poses = ids + 12 + -(ids + 12 - 4) % 8
    if lengths.max() > _LONGEST or poses.max() + 56 > len(data):
        return None
    heads = _numbers(content, ids, "<i4", 3).astype(np.int64)
    frame_id = str(header[12 : 11 + length], "utf-8", "replace")
    stamp = sec * NANO + nanosec
    return stamp, frame_id, heads[:, 0], heads[:, 1:], _numbers(content, poses, "<f8", 7)


def _numbers(content: npt.NDArray[np.uint8], places: Stamps, kind: str, n: int) -> Any:
    """(N, n) numbers of a kind that stand at N places."""
    size = n * np.dtype(kind).itemsize
    return np.ascontiguousarray(content[places[:, None] + np.arange(size)]).view(kind)
