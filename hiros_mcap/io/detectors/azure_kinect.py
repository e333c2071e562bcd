"""Bodies of the Azure Kinect ROS driver: one sphere per joint in a MarkerArray.

The driver publishes a message per capture on ``body_tracking_data``, with the positions in metres
in the frame of the depth camera. The id of a marker is the body's id times 100 plus the joint's
number in the Body Tracking SDK (``K4AROSDevice::getBodyMarker`` in src/k4a_ros_device.cpp). There
are no confidences. Forks for ROS 2 publish the same.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from hiros_mcap.io.detectors.body_models import body_model
from hiros_mcap.io.detectors.detector_reader import (
    DetectorMessage,
    DetectorReader,
    SeenPeople,
    nanoseconds,
    seen_people,
)
from hiros_mcap.skeletons import ORIENTATION, Stamps

TOPIC = "body_tracking_data"
_SPHERE, _ADD = 2, 0
_FACTOR = 100
"""Between the ids of two bodies."""


class AzureKinectMarkers(DetectorReader):
    """Any other MarkerArray is declined: its ids or its markers are of another kind."""

    types = ("visualization_msgs/MarkerArray",)

    def __init__(self) -> None:
        self._model = body_model("azure-kinect")
        self._frames: dict[str, str] = {}

    def read(self, message: DetectorMessage) -> Iterable[SeenPeople] | None:
        """Group the markers by body; an empty message names no frame, so the last one counts."""
        markers = message.fields.markers
        if not markers:
            if message.topic.rpartition("/")[2] != TOPIC:
                return None
            return [self._nobody(message)]
        ids = np.array([marker.id for marker in markers], np.int64)
        if not self._are_joints(ids) or any(m.type != _SPHERE or m.action != _ADD for m in markers):
            return None
        header = markers[0].header
        self._frames[message.topic] = header.frame_id
        bodies, rows = np.unique(ids // _FACTOR, return_inverse=True)
        poses = np.full((len(bodies), self._model.n_markers, 7), np.nan)
        for row, joint, marker in zip(rows, ids % _FACTOR, markers, strict=True):
            at, turn = marker.pose.position, marker.pose.orientation
            poses[row, joint] = at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w
        found = seen_people(
            self._model,
            message,
            header.frame_id,
            poses[:, :, :3],
            stamp=nanoseconds(header.stamp),
            ids=bodies.tolist(),
        )
        turned = (poses[:, :, 3:] != 0).any(axis=-1)
        found.frame.markers[turned, ORIENTATION] = poses[turned, 3:]
        return [found]

    def _are_joints(self, ids: Stamps) -> bool:
        n = self._model.n_markers
        whole = len(ids) % n == 0 and len(np.unique(ids)) == len(ids)
        return bool(whole and (ids >= 0).all() and (ids % _FACTOR < n).all())

    def _nobody(self, message: DetectorMessage) -> SeenPeople:
        empty = np.empty((0, self._model.n_markers, 3))
        return seen_people(self._model, message, self._frames.get(message.topic, ""), empty)
