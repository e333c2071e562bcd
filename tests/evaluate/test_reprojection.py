"""Keypoints against a result that is projected into the images."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.evaluate.reprojection import reprojection
from hiros_mcap.io.rgb_cameras import RgbCamera
from hiros_mcap.rays.keypoints import KeypointFrame
from hiros_mcap.skeletons import POSITION, Frame, SkeletonModel

MODEL = SkeletonModel.of(["LHip", "RHip", "Nose"], [("LHip", 1, 0)])
LENS = Intrinsics(
    (1000, 800), np.array([[1000.0, 0, 500], [0, 1000.0, 400], [0, 0, 1]]), np.zeros(0)
)
BODY = np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.0, -0.6, 0.0]])
ASIDE = np.array([1.5, 0.0, 0.0])


def result(*people, stamps=(0, 100)):
    """A frame at each of some stamps, ms, of people at places in the room, m."""
    frames = []
    for ms in stamps:
        frame = Frame.empty(len(people), MODEL, stamp=ms * 10**6)
        frame.ids[:] = np.arange(len(people))
        for row, place in enumerate(people):
            frame.markers[row, :, POSITION] = BODY + place
        frames.append(frame)
    return frames


def camera(*images, names=("left_hip", "right_hip", "nose")):
    """A camera that looks along z from the origin; images are (ms, pixels (P, 3, 2))."""
    frames = [
        KeypointFrame(
            "rgb", ms * 10**6, ms * 10**6, np.array(pixels), np.ones(np.shape(pixels)[:2])
        )
        for ms, pixels in images
    ]
    return RgbCamera("/rgb/keypoints", "rgb", LENS, SkeletonModel.of(names, []), frames)


def seen(place):
    return LENS.pixels(BODY + place)


FRONT = np.array([0.0, 0.0, 4.0])


def test_keypoints_are_as_far_as_they_were_moved():
    found = reprojection(
        camera((50, [np.add(seen(FRONT), (3.0, 4.0))])), Rigid.identity(), result(FRONT), MODEL
    )
    assert (found.distance.median, found.distance.percentile_95) == pytest.approx((5.0, 5.0))
    assert found.distance.count == 3
    assert set(found.joints) == {"left_hip", "right_hip", "nose"}
    assert (found.detections, found.unmatched) == (1, 0)


def test_the_result_is_interpolated_to_the_time_of_the_image():
    frames = result(FRONT, stamps=(0,)) + result(FRONT + ASIDE, stamps=(100,))
    found = reprojection(camera((50, [seen(FRONT + ASIDE / 2)])), Rigid.identity(), frames, MODEL)
    assert found.distance.median == pytest.approx(0.0, abs=1e-6)


def test_each_detection_belongs_to_whom_it_is_near_in_the_image():
    both = [seen(FRONT + ASIDE), np.add(seen(FRONT), (6.0, 0.0))]
    found = reprojection(camera((50, both)), Rigid.identity(), result(FRONT, FRONT + ASIDE), MODEL)
    assert found.distance.median == pytest.approx(3.0)
    assert found.unmatched == 0


def test_a_stranger_in_the_background_is_nobody_and_a_missing_joint_does_not_count():
    pixels = seen(FRONT)
    pixels[2] = np.nan
    stranger = seen(np.add(FRONT, (3.0, 0.0, 4.0)))
    found = reprojection(camera((50, [pixels, stranger])), Rigid.identity(), result(FRONT), MODEL)
    assert (found.detections, found.unmatched) == (2, 1)
    assert found.distance.percentile_95 == pytest.approx(0.0, abs=1e-6)
    assert found.distance.count == 2
    assert "nose" not in found.joints


def test_a_pose_that_is_off_shows_in_px():
    pose = Rigid(np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.04, 0.0, 0.0]))
    found = reprojection(camera((50, [seen(FRONT)])), pose, result(FRONT), MODEL)
    assert found.distance.median == pytest.approx(1000 * 0.04 / 4)


def test_nobody_in_the_result_and_nobody_in_the_image():
    empty = np.zeros((0, 3, 2))
    found = reprojection(camera((0, empty), (50, [seen(FRONT)])), Rigid.identity(), [], MODEL)
    assert (found.detections, found.unmatched, found.distance.count) == (1, 1, 0)
    assert np.isnan(found.distance.median)
