"""Keypoints and lenses as messages: what is written is read by other programs, too."""

from __future__ import annotations

import numpy as np
import pytest

import hiros_schemas
from hiros_mcap.body.intrinsics import FISHEYE, Intrinsics
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.detectors.detector_reader import DetectorMessage
from hiros_mcap.io.detectors.keypoint_messages import (
    add_camera_info,
    add_keypoint_channel,
    camera_info,
    decode_keypoints,
    encode_detections,
)
from hiros_mcap.io.ros_cdr import decoder_of, types_of
from hiros_mcap.io.ros_messages import intrinsics_of
from hiros_mcap.rays.keypoints import KeypointFrame, cleaned
from hiros_mcap.running.overview import overview_of

LENS = Intrinsics(
    (640, 480), np.array([[500.0, 0, 320], [0, 510.0, 240], [0, 0, 1]]), np.full(4, 0.1), FISHEYE
)


def decoded(data, kind):
    name = hiros_schemas.short_name(kind)
    return decoder_of(types_of((name, hiros_schemas.text(kind))), name)(data)


def detections(frame, joints):
    """The message of a frame, and the people in it whose model has so many joints."""
    data, kind = encode_detections(frame, "cam"), hiros_schemas.DETECTION_ARRAY
    message = DetectorMessage("/k", "yolo_msgs/DetectionArray", 0, data, lambda d: decoded(d, kind))
    return message.fields, decode_keypoints(message, joints, {})


def image(pixels, stamp=3_000_000_007):
    scores = np.where(np.isnan(pixels[..., 0]), 0.0, 0.75)
    return KeypointFrame("rgb", stamp, stamp, pixels, scores)


def test_people_come_back_with_their_missing_joints():
    pixels = np.arange(2 * 3 * 2, dtype=float).reshape(2, 3, 2)
    pixels[1, 0] = np.nan
    frame = image(pixels)
    message, found = detections(frame, 3)
    assert (found.stamp, found.camera) == (frame.stamp, "cam")
    assert np.array_equal(found.pixels, pixels, equal_nan=True)
    assert np.array_equal(found.scores, frame.scores)
    box = message.detections[0].bbox
    assert (box.center.position.x, box.center.position.y) == (2.0, 3.0)
    assert (box.size.x, box.size.y) == (4.0, 4.0)
    assert message.detections[1].keypoints.data[0].id == 2


@pytest.mark.parametrize("people", [0, 1])
def test_somebody_without_any_joint_is_nobody(people):
    _, found = detections(image(np.full((people, 3, 2), np.nan)), 3)
    assert found.pixels.shape == (0, 3, 2)


def test_joints_beyond_the_model_are_left_out():
    _, found = detections(image(np.ones((1, 5, 2))), 3)
    assert found.pixels.shape == (1, 3, 2)


def test_a_lens_comes_back():
    message = decoded(camera_info(LENS, "cam", 5), hiros_schemas.CAMERA_INFO)
    lens = intrinsics_of(message, "/cam/camera_info")
    assert (lens.size, lens.model, message.header.frame_id) == (LENS.size, FISHEYE, "cam")
    assert np.array_equal(lens.matrix, LENS.matrix)
    assert np.array_equal(lens.distortion, LENS.distortion)


def skeleton2d(points):
    kind = hiros_schemas.SKELETON_2D
    name = hiros_schemas.short_name(kind)
    store = types_of((name, hiros_schemas.text(kind)))
    types = store.types
    point, header = types["hri_msgs/msg/NormalizedPointOfInterest2D"], types["std_msgs/msg/Header"]
    stamp = types["builtin_interfaces/msg/Time"](3, 7)
    message = types[kind](header(stamp, "cam"), [point(*row) for row in points])
    data = bytes(store.serialize_cdr(message, kind))
    return DetectorMessage("/k", name, 0, data, decoder_of(store, name))


def test_shares_of_the_image_become_pixels():
    points = [(0.5, 0.25, 0.8), (0.0, 0.0, 0.0), (np.nan, 0.2, 1.0), (0.1, 0.2, -1.0), (3, 0.5, 1)]
    found = decode_keypoints(skeleton2d(points), 18, {"cam": LENS})
    assert (found.stamp, found.camera) == (3_000_000_007, "cam")
    assert found.pixels.shape == (1, 18, 2)
    assert found.pixels[0, 0].tolist() == [320, 120]
    assert np.isnan(found.pixels[0, 1:]).all()
    assert found.scores[0].tolist() == [pytest.approx(0.8)] + 17 * [0]


def test_a_detector_without_scores_is_believed():
    pixels, scores = cleaned(np.array([[[5.0, 6.0], [0, 0]]]), np.zeros((1, 2)))
    assert scores.tolist() == [[1, 0]]
    assert np.array_equal(pixels, [[[5, 6], [np.nan, np.nan]]], equal_nan=True)


def test_the_overview_of_a_log_lists_its_rgb_cameras(tmp_path):
    with McapWriter(tmp_path / "a.mcap") as writer:
        add_camera_info(writer, "/rgb/camera_info", LENS, "rgb", 0)
        channel = add_keypoint_channel(writer, "/rgb/keypoints", "halpe-26")
        for k in range(3):
            frame = image(np.full((k, 26, 2), 9.0), 10**18 + 20_000_000 * k)
            writer.write(channel, frame.stamp, encode_detections(frame, "rgb"))
        writer.commit()
    (row,) = overview_of(tmp_path / "a.mcap").keypoints
    assert (row.topic, row.camera, row.joints) == ("/rgb/keypoints", "rgb", "halpe-26")
    assert (row.images, row.rate_hz) == (3, pytest.approx(50))
    assert (row.least_people, row.most_people, row.mean_people) == (0, 2, 1)
    assert (row.width, row.height) == LENS.size
