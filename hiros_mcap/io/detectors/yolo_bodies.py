"""Keypoints in space of ``yolo_msgs/DetectionArray``, which yolo_ros finds with a depth image.

The same type also has keypoints in the image, which are those of an RGB camera. What a channel
holds tells: where detections have ``keypoints3d``, they are skeletons, in the frame that these
name. Joints without a depth are left out of the list; the id of a keypoint is its number in COCO's
model, from 1.
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
from hiros_mcap.io.detectors.keypoint_messages import DETECTIONS_IN_SPACE, USUAL_JOINTS
from hiros_mcap.skeletons import UNTRACKED


class YoloBodies(DetectorReader):
    """Detections without keypoints in space are of other things, or have no depth."""

    types = (DETECTIONS_IN_SPACE,)

    def __init__(self) -> None:
        self._model = body_model(USUAL_JOINTS)

    def read(self, message: DetectorMessage) -> Iterable[SeenPeople] | None:
        """Read the people of an image."""
        header, n = message.fields.header, self._model.n_markers
        found = [one for one in message.fields.detections if len(one.keypoints3d.data)]
        positions = np.full((len(found), n, 3), np.nan)
        scores = np.full((len(found), n), np.nan)
        for person, detection in enumerate(found):
            for joint in detection.keypoints3d.data:
                if 1 <= joint.id <= n:
                    place = joint.point.x, joint.point.y, joint.point.z
                    positions[person, joint.id - 1] = place
                    scores[person, joint.id - 1] = joint.score
        frame_id = next((one.keypoints3d.frame_id for one in found), "") or header.frame_id
        people = seen_people(
            self._model,
            message,
            frame_id,
            positions,
            stamp=nanoseconds(header.stamp),
            ids=[int(one.id) if one.id.isdecimal() else UNTRACKED for one in found],
            confidences=[float(one.score) for one in found],
        )
        people.frame.marker_confidences[:] = scores
        return [people]
