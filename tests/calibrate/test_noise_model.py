"""White noise by camera, joint, range and confidence."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_mcap.calibrate.noise_model import measure_noise_model
from hiros_mcap.skeletons import Frame, SkeletonModel

MODEL = SkeletonModel.of(["HIP", "HAND"], [("arm", 0, 1)])


def standing(distance: float, seed: int, confidence: float = 1.0) -> list[Frame]:
    """One person in camera_0, whose hand is twice as noisy: 4 mm at 2 m, growing with r^1.5."""
    rng, frames = np.random.default_rng(seed), []
    guess = 3.0 if confidence < 0.5 else 1.0
    for k in range(400):
        frame = Frame.empty(1, MODEL, stamp=10**18 + k * 33_333_333, source="camera_0")
        sd = 0.004 * (distance / 2.0) ** 1.5 * guess * np.array([[1.0], [2.0]])
        place = [distance, 0.001 * k, 0.0]  # moves slowly
        frame.markers[0, :, :3] = place + sd * rng.normal(size=(2, 3))
        frame.marker_confidences[0] = confidence
        frames.append(frame.replace(ids=np.array([7])))
    return frames


def test_range_joint_and_confidence() -> None:
    frames = standing(1.5, 1) + standing(4.0, 2) + standing(2.0, 3, confidence=0.3)
    found = measure_noise_model(frames, MODEL, {"camera_0": np.zeros(3)})
    assert found.power == pytest.approx(1.5, abs=0.15)
    assert found.guessed == pytest.approx(3.0, rel=0.15)
    assert found.joints["HAND"] / found.joints["HIP"] == pytest.approx(2.0, rel=0.1)
    assert found.sigma * found.joints["HIP"] == pytest.approx(0.004, rel=0.15)


def test_one_range_does_not_tell_the_power() -> None:
    found = measure_noise_model(standing(2.0, 1), MODEL, {"camera_0": np.zeros(3)})
    assert found.power == 1.0
    assert np.isnan(found.guessed)


def test_a_camera_without_a_pose_tells_nothing() -> None:
    assert measure_noise_model(standing(2.0, 1), MODEL, {}).joints == {}
