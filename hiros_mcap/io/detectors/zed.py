"""Bodies of the ZED ROS 2 wrapper (Stereolabs): ``zed_msgs/ObjectsStamped``.

Every object has a fixed array ``skeleton_3d`` of 70 keypoints, m. Its ``body_format`` says how
many count: 0 = 18, 1 = 34, 2 = 38, 3 = 70 (zed_msgs/msg/Object.msg). The package was called
``zed_interfaces`` before, whose oldest messages have 18 keypoints and no ``body_format``.
Confidences go from 0 to 100. A keypoint that was not seen is NaN, or 0 0 0. ``tracking_state`` 2 is
of an object that nobody sees: where it might be. ``label_id`` -1 is no id.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from hiros_mcap.errors import LogError
from hiros_mcap.io.detectors.body_models import body_model
from hiros_mcap.io.detectors.detector_reader import (
    DetectorMessage,
    DetectorReader,
    SeenPeople,
    nanoseconds,
    seen_people,
)
from hiros_mcap.skeletons import UNTRACKED, Floats

FORMATS = ("zed-18", "zed-34", "zed-38", "zed-70")
"""Models by ``body_format``."""
_SEARCHING = 2


class ZedBodies(DetectorReader):
    """Objects without a skeleton are left out; a message of nothing else is declined.

    A camera that sees nobody before its format is known waits for somebody.
    """

    types = ("zed_msgs/ObjectsStamped", "zed_interfaces/ObjectsStamped")

    def __init__(self) -> None:
        self._formats: dict[str, str] = {}

    def read(self, message: DetectorMessage) -> Iterable[SeenPeople] | None:
        """Read the people; a camera that sees nobody uses the format of its last ones."""
        objects = message.fields.objects
        people = [person for person in objects if person.skeleton_available]
        if people:
            self._formats[message.topic] = self._format(people, message.topic)
        elif objects:
            return None
        elif message.topic not in self._formats:
            return []
        header = message.fields.header
        model = body_model(self._formats[message.topic])
        seen = seen_people(
            model,
            message,
            header.frame_id,
            _positions(people, model.n_markers),
            stamp=nanoseconds(header.stamp),
            ids=[max(int(person.label_id), UNTRACKED) for person in people],
            confidences=[float(person.confidence) / 100.0 for person in people],
        )
        for row, person in enumerate(people):
            if getattr(person, "tracking_state", 0) == _SEARCHING:  # guessed, so not trusted
                seen.frame.confidences[row] = 0.0
                seen.frame.marker_confidences[row] = 0.0
        return [seen]

    def _format(self, people: Sequence[Any], topic: str) -> str:
        number = int(getattr(people[0], "body_format", 0))
        if not 0 <= number < len(FORMATS):
            fault = f"body_format {number} is unknown; hiros knows 0 to {len(FORMATS) - 1}"
            raise LogError(fault, topic=topic)
        return FORMATS[number]


def _positions(people: Sequence[Any], n: int) -> Floats:
    """(P, n, 3) m, as they are in the objects."""
    points = np.full((len(people), n, 3), np.nan)
    for row, person in zip(points, people, strict=True):
        keypoints = person.skeleton_3d.keypoints[:n]
        row[: len(keypoints)] = [point.kp for point in keypoints]
    points[~np.isfinite(points).all(axis=-1)] = np.nan
    return points
