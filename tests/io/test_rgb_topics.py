"""Logs of RGB cameras: which of them are read, and what a result of them still says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hiros_schemas
from hiros_cli.app import run
from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.evaluate.logs import evaluate_channels, find_truth, read_results
from hiros_mcap.io.channels import add_ros_channel, add_static_poses
from hiros_mcap.io.container import ChunkCopier, McapReader, McapWriter
from hiros_mcap.io.container.live_input import McapInput
from hiros_mcap.io.detectors.body_models import body_model, joints_of
from hiros_mcap.io.detectors.keypoint_messages import (
    add_camera_info,
    add_keypoint_channel,
    encode_detections,
)
from hiros_mcap.io.live_log import open_live
from hiros_mcap.io.log import open_log
from hiros_mcap.io.rgb_cameras import placed_cameras, poses_of, read_rgb_cameras
from hiros_mcap.io.ros_cdr import CdrWriter
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.skeletons import SECOND


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A depth camera and three RGB cameras."""
    path = tmp_path_factory.mktemp("rgb") / "log.mcap"
    rig = {"kinds": ("depth", "rgb", "rgb", "rgb")}
    write_log(path, SimulateParams.model_validate({"cameras": 4, "seconds": 1.0, "rig": rig}))
    return path


def test_people_with_a_topic_each_are_of_one_image(tmp_path):
    """As ROS4HRI publishes them: /humans/bodies/ID/skeleton2d."""
    log, hri, path = tmp_path / "log.mcap", body_model("hri-18").marker_names, tmp_path / "hri.mcap"
    rig = {"kinds": ("rgb", "rgb", "rgb")}
    scene = {"people": 2, "cameras": 3, "seconds": 1.0, "rig": rig}
    write_log(log, SimulateParams.model_validate(scene))
    with McapReader(log) as reader, McapWriter(path) as writer:
        cameras = read_rgb_cameras(reader)
        tree, _ = placed_cameras(reader, None, cameras)
        start = cameras[0].frames[0].stamp
        add_static_poses(writer, poses_of(cameras, tree, "world"), "world", start)
        messages = []
        for camera in cameras:
            add_camera_info(writer, f"/{camera.name}/camera_info", camera.lens, camera.name, start)
            slots = {joint: k for k, joint in enumerate(joints_of(camera.model.marker_names))}
            for person in range(2):
                topic = f"/{camera.name}/bodies/{person}/skeleton2d"
                channel = add_ros_channel(writer, topic, hiros_schemas.SKELETON_2D)
                for frame in (f for f in camera.frames if person < len(f.pixels)):
                    out = CdrWriter()
                    out.header(frame.stamp, camera.name)
                    out.uint32(len(hri))
                    for joint in joints_of(hri):
                        slot = slots.get(joint)
                        share = [0.0, 0.0] if slot is None else frame.pixels[person, slot]
                        share = np.nan_to_num(np.divide(share, camera.lens.size)).tolist()
                        out.float32(*share, float(share[0] > 0))
                    messages.append((frame.stamp, channel, out.finish()))
        for stamp, channel, data in sorted(messages):
            writer.write(channel, stamp, data)
        writer.commit()
    with open_log(path) as opened:
        reading = opened.read()
        counts = [frame.n_people for frame in reading.frames()]
        notes = [*reading.warnings, *opened.warnings]
    assert np.median(counts) == 2
    assert not [text for text in notes if "came too late" in text]


@pytest.mark.parametrize(
    ("topics", "read", "lenses"),
    [
        (["/camera_[123]/keypoints"], {"/rgb/skeletons"}, 3),
        (["/camera_[12]/keypoints"], {"/rgb/skeletons"}, 2),
        (["/camera_*"], {"/camera_0/skeletons", "/rgb/skeletons"}, 3),
        (["/camera_0/skeletons"], {"/camera_0/skeletons"}, 0),
        (["/camera_0/*", "/camera_1/keypoints"], {"/camera_0/skeletons"}, 0),
    ],
)
def test_topics_of_keypoints_choose_rgb_cameras(topics, read, lenses, log):
    with open_log(log, topics=topics) as opened:
        assert {camera.channel.topic for camera in opened.cameras} == read
        assert len(opened.rig.lenses if opened.rig else ()) == lenses
        assert sum("RGB cameras are not used" in text for text in opened.warnings) == (
            topics[-1] == "/camera_1/keypoints"
        )


def test_live_no_message_is_lost_where_rgb_cameras_see_nobody_at_first(log):
    with log.open("rb") as file, open_live(McapInput(file.fileno(), "live")) as live:
        reading = live.read()
        list(reading.frames())
    account = reading.accounts["/rgb/skeletons"]
    assert account.used == account.read > 25


@pytest.mark.parametrize(
    ("size", "zoom", "said"),
    [
        ((1920, 1080), 1.0, []),
        ((1920, 1080), 1.001, []),  # it focuses
        ((1920, 1080), 2.0, ["its focal length from 1100 to 2200 px; hiros takes the first one"]),
        ((640, 480), 1.0, ["its image from 1920 x 1080 to 640 x 480 px; hiros takes the first"]),
    ],
)
def test_a_lens_that_changes_is_a_warning_if_keypoints_need_it(size, zoom, said, log, tmp_path):
    path = tmp_path / "log.mcap"
    with McapReader(log) as reader, McapWriter(path) as writer:
        ChunkCopier(reader, writer, reader.channels).finish()
        lens = read_rgb_cameras(reader)[0].lens
        matrix = lens.matrix * [[zoom], [zoom], [1.0]]
        stamp = reader.contents.chunks[0].start_time + 2 * SECOND
        lens = Intrinsics(size, matrix, lens.distortion, lens.model)
        name = read_rgb_cameras(reader)[0].name
        topic = next(c.topic for c in reader.channels.values() if c.topic.endswith("camera_info"))
        add_camera_info(writer, topic, lens, name, stamp)
        for k, width in enumerate((640, 1920)):  # of a camera that has no keypoints
            other = replace(lens, size=(width, 1080))
            add_camera_info(writer, "/other/camera_info", other, "other", stamp + k * SECOND)
        writer.commit()
    with open_log(path) as opened:
        found = [text for text in opened.warnings if "the lens of" in text]
    assert len(found) == len(said)
    assert all(part in text for part, text in zip(said, found, strict=True))
    with path.open("rb") as file, open_live(McapInput(file.fileno(), "live")) as live:
        reading = live.read()
        list(reading.frames())
    assert [text for text in reading.warnings if "the lens of" in text] == found


def at_one_place(frame, lens):
    there = np.isfinite(frame.pixels)
    return frame._replace(pixels=np.where(there, [[[640.0, 360.0]]], np.nan)), lens


@pytest.mark.parametrize(
    ("change", "said"),
    [
        # A detector that writes logits, or -1 for what it does not know.
        (
            lambda frame, lens: (frame._replace(scores=frame.scores - 2.0), lens),
            "/camera_1/keypoints: no keypoint counts",
        ),
        (at_one_place, "camera_1: 30 detections of people in images not used: they are nobody"),
        (
            lambda frame, lens: (frame, replace(lens, distortion=np.array([1e30, 0, 0, 0]))),
            "camera_1: 30 messages of keypoints not used: /camera_1/camera_info: its CameraInfo "
            "has a distortion that cannot be undone on",
        ),
    ],
    ids=["no score", "one place", "absurd distortion"],
)
def test_a_camera_that_tells_nothing_is_named(change, said, log, tmp_path):
    path, topics = tmp_path / "log.mcap", ("/camera_1/keypoints", "/camera_1/camera_info")
    with McapReader(log) as reader, McapWriter(path) as writer:
        (camera,) = (c for c in read_rgb_cameras(reader) if c.topic in topics)
        others = {i for i, c in reader.channels.items() if c.topic not in topics}
        ChunkCopier(reader, writer, others).finish()
        channel = add_keypoint_channel(writer, topics[0], "coco-17")
        _, lens = change(camera.frames[0], camera.lens)
        add_camera_info(writer, topics[1], lens, camera.name, camera.frames[0].log_time)
        for frame in camera.frames:
            data = encode_detections(change(frame, lens)[0], camera.name)
            writer.write(channel, frame.log_time, data)
        writer.commit()
    with open_log(path) as opened:
        assert sum(text.startswith(said) for text in opened.warnings) == 1
    with path.open("rb") as file, open_live(McapInput(file.fileno(), "live")) as opened:
        reading = opened.read()
        list(reading.frames())
    assert sum(text.startswith(said) for text in reading.warnings) == 1
    with open_log(log) as opened:
        assert opened.warnings == ()


def test_a_result_of_rgb_cameras_says_how_it_was_made(log, tmp_path, capsys):
    out = tmp_path / "out.mcap"
    assert run(["process", str(log), "-o", str(out), "-q"]) == 0
    assert run(["info", str(out)]) == 0
    assert "system fuse" in capsys.readouterr().out


@pytest.mark.parametrize("poses", ["given", "refined"])
def test_rgb_cameras_alone_are_one_view(poses, log, tmp_path):
    out = tmp_path / "out.mcap"
    arguments = ["process", str(log), "-o", str(out), "-q", "--topic", "/camera_[123]/keypoints"]
    assert run([*arguments, "--set", f"input.poses={poses}"]) == 0


def test_rgb_cameras_do_not_carry_depth_cameras_away(tmp_path):
    """The room stays where the depth cameras' given poses have it."""
    path, errors = tmp_path / "log.mcap", []
    scene = {"people": 2, "cameras": 4, "seconds": 8.0, "action": "cross", "seed": 2}
    rig = {"kinds": ("depth", "rgb", "depth", "rgb")}
    write_log(path, SimulateParams.model_validate({**scene, "rig": rig}))
    for topics in (["/camera_*/skeletons"], ["/camera_*"]):
        process(path, out := tmp_path / "out.mcap", topics=topics, system="fuse")
        found = {"/x": read_results(out)["/hiros/filtered"]}
        errors.append(evaluate_channels(found, find_truth(path))["/x"].scores.mean)
    assert errors[1] < 1.1 * errors[0]
