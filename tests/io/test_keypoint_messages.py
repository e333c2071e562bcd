"""Keypoints and lenses as messages: what is written is read by other programs, too."""

from __future__ import annotations

import numpy as np
import pytest

import hiros_schemas
from hiros_mcap.io.keypoint_messages import camera_info, decode_detections, encode_detections
from hiros_mcap.io.ros_cdr import decoder_of, types_of
from hiros_mcap.io.ros_messages import intrinsics_of
from hiros_mcap.rays.intrinsics import FISHEYE, Intrinsics
from hiros_mcap.rays.keypoints import KeypointFrame

LENS = Intrinsics(
    (640, 480), np.array([[500.0, 0, 320], [0, 510.0, 240], [0, 0, 1]]), np.full(4, 0.1), FISHEYE
)


def decoded(data, kind):
    name = hiros_schemas.short_name(kind)
    return decoder_of(types_of({name: hiros_schemas.text(kind)}), name)(data)


def image(pixels, stamp=3_000_000_007):
    scores = np.where(np.isnan(pixels[..., 0]), 0.0, 0.75)
    return KeypointFrame("rgb", stamp, stamp, pixels, scores)


def test_people_come_back_with_their_missing_joints():
    pixels = np.arange(2 * 3 * 2, dtype=float).reshape(2, 3, 2)
    pixels[1, 0] = np.nan
    frame = image(pixels)
    message = decoded(encode_detections(frame, "cam"), hiros_schemas.DETECTION_ARRAY)
    found = decode_detections(message, 3)
    assert (found.stamp, found.frame_id) == (frame.stamp, "cam")
    assert np.array_equal(found.pixels, pixels, equal_nan=True)
    assert np.array_equal(found.scores, frame.scores)
    box = message.detections[0].bbox
    assert (box.center.position.x, box.center.position.y) == (2.0, 3.0)
    assert (box.size.x, box.size.y) == (4.0, 4.0)
    assert message.detections[1].keypoints.data[0].id == 2


@pytest.mark.parametrize("people", [0, 1])
def test_somebody_without_any_joint_is_nobody(people):
    frame = image(np.full((people, 3, 2), np.nan))
    message = decoded(encode_detections(frame, "cam"), hiros_schemas.DETECTION_ARRAY)
    assert decode_detections(message, 3).pixels.shape == (0, 3, 2)


def test_joints_beyond_the_model_are_left_out():
    message = decoded(
        encode_detections(image(np.ones((1, 5, 2))), "c"), hiros_schemas.DETECTION_ARRAY
    )
    assert decode_detections(message, 3).pixels.shape == (1, 3, 2)


def test_a_lens_comes_back():
    message = decoded(camera_info(LENS, "cam", 5), hiros_schemas.CAMERA_INFO)
    lens = intrinsics_of(message, "/cam/camera_info")
    assert (lens.size, lens.model, message.header.frame_id) == (LENS.size, FISHEYE, "cam")
    assert np.array_equal(lens.matrix, LENS.matrix)
    assert np.array_equal(lens.distortion, LENS.distortion)
