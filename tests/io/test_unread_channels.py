"""A camera whose type nobody reads is missed: a warning names it."""

from __future__ import annotations

import pytest

from hiros_cli.app import run
from hiros_mcap.io.channels import channels_of
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.io.log import open_log

LAST = "/camera_2/skeletons"


def with_other(source, target, topic, name, every=1, kept=False):
    """Copy a log whose last camera publishes another type on another topic; or does both."""
    with McapReader(source) as reader, McapWriter(target) as writer:
        (last,) = (info.id for info in channels_of(reader) if info.topic == LAST)
        writer.copy_definitions(reader, set(reader.channels) - (set() if kept else {last}))
        other = writer.add_channel(topic, writer.add_schema(name, b"int32 x"))
        for k, message in enumerate(reader.messages()):
            if message.channel_id != last or kept:
                writer.write(message.channel_id, message.log_time, bytes(message.data))
            if message.channel_id == last and k % every == 0:
                writer.write(other, message.log_time, b"\0\1\0\0\0\0\0\0")
        writer.commit()
    return target


def warnings_of(path, **options):
    with open_log(path, **options) as log:
        return [text for text in log.warnings if "not read" in text]


@pytest.mark.parametrize(
    ("topic", "name"),
    [
        ("/camera_2/yolo/detections_3d", "acme_msgs/msg/DetectionArray"),
        ("/camera_2/keypoints", "geometry_msgs/msg/PoseArray"),
        ("/camera_7/out", "acme_msgs/msg/Thing"),
        ("/door_side/out", "acme_msgs/msg/Thing"),
        ("/camera_2/bodies", ""),
    ],
)
def test_a_camera_of_another_type_is_named(topic, name, crossing, tmp_path, capsys):
    path = with_other(crossing, tmp_path / "log.mcap", topic, name)
    (warning,) = warnings_of(path)
    assert warning.startswith(f"{topic}: ")
    assert (name or "no type") in warning
    assert warnings_of(path, topics=["/camera_[01]/skeletons"]) == []
    assert run(["info", str(path)]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith(topic))
    assert row.rstrip().endswith("(not read)")


def test_a_camera_that_detects_more_rarely_is_named(crossing, tmp_path):
    path = tmp_path / "log.mcap"
    assert warnings_of(with_other(crossing, path, "/camera_2/people", "acme/msg/X", every=4))


@pytest.mark.parametrize(
    ("topic", "name"),
    [
        ("/camera_2/image", "sensor_msgs/msg/Image"),
        ("/rviz", "visualization_msgs/msg/MarkerArray"),
        ("/odometry", "nav_msgs/msg/Odometry"),
        ("/rosout", "rcl_interfaces/msg/Log"),
    ],
)
def test_what_is_no_camera_is_not_named(topic, name, crossing, tmp_path):
    assert warnings_of(with_other(crossing, tmp_path / "log.mcap", topic, name)) == []


def test_what_else_a_camera_publishes_is_not_named(crossing, tmp_path):
    path = tmp_path / "log.mcap"
    topic, name = "/camera_2/bodies_raw", "acme_msgs/msg/Bodies"
    assert warnings_of(with_other(crossing, path, topic, name, kept=True)) == []
