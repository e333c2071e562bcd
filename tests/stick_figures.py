"""Small people for tests: eight markers with a left and a right side, seven links."""

from __future__ import annotations

import numpy as np

from hiros_mcap.skeletons import Frame, SkeletonModel

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
PERIOD = SECOND // 30

MODEL = SkeletonModel.of(
    [
        "PELVIS", "NECK", "SHOULDER_LEFT", "SHOULDER_RIGHT",
        "HIP_LEFT", "HIP_RIGHT", "WRIST_LEFT", "WRIST_RIGHT",
    ],
    [
        ("NECK", 0, 1), ("SHOULDER_LEFT", 1, 2), ("SHOULDER_RIGHT", 1, 3), ("HIP_LEFT", 0, 4),
        ("HIP_RIGHT", 0, 5), ("WRIST_LEFT", 2, 6), ("WRIST_RIGHT", 3, 7),
    ],
)  # fmt: skip
POSE = np.array([
    [0.0, 0.0, 1.0], [0.0, 0.0, 1.5], [0.0, 0.2, 1.45], [0.0, -0.2, 1.45],
    [0.0, 0.12, 0.95], [0.0, -0.12, 0.95], [0.1, 0.4, 1.0], [0.1, -0.4, 1.1],
])  # fmt: skip
MIRROR = [0, 1, 3, 2, 5, 4, 7, 6]


def person(x=0.0, y=0.0):
    """Markers (8, 3) of somebody who stands at (x, y)."""
    return POSE + np.array([x, y, 0.0])


def seen(people, stamp, source="a", *, ids=None, turns=False):
    """A camera's message; ``turns`` fills link orientations with the identity."""
    frame = Frame.empty(
        len(people), MODEL, stamp=stamp, log_time=stamp, source=source, frame_id="world"
    )
    for row, markers in enumerate(people):
        frame.markers[row, :, :3] = markers
    frame.marker_confidences[:] = 1.0
    if ids is not None:
        frame.ids[:] = ids
    if turns:
        frame.links[:, :, 3:7] = [0.0, 0.0, 0.0, 1.0]
    return frame


def at(k, camera=0):
    """Stamp of frame ``k`` of a camera; cameras are 3 ms apart."""
    return START + round(k * PERIOD) + camera * 3_000_000
