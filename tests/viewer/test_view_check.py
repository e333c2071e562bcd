"""The distance from a camera's detections to the result."""

from __future__ import annotations

import numpy as np

from hiros_viewer.poses import Poses
from hiros_viewer.view_check import mean_distances

PERSON = np.array([[0, 0, 1.7], [-0.25, 0, 1.4], [0.25, 0, 1.4]], float)[None]
"""(1, 3, 3) head and shoulders."""


def test_each_message_is_compared_with_its_own_instant():
    messages = PERSON + 3.1, PERSON[:0], np.concatenate([PERSON, PERSON + 0.1]), PERSON + 9.0
    positions = np.concatenate(messages)
    seen = Poses(
        np.zeros((4, 2), np.int64),
        np.array([len(message) for message in messages]),
        np.full(len(positions), -1),
        positions,
        np.ones(positions.shape[:2]),
    )
    people = np.concatenate([PERSON, PERSON + 3.0, PERSON + 6.0])
    distances = mean_distances(seen, people, np.array([[1, 3], [0, 3], [0, 1], [0, 3]]))
    np.testing.assert_allclose(distances, [100 * 3**0.5, np.nan, 50 * 3**0.5, np.nan])
