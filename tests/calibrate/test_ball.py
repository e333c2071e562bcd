"""``hiros calibrate ball`` on small logs of rendered images, and of ready centres."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
from rendered_ball import (
    ball_path,
    camera_at,
    centres_of,
    compressed,
    image,
    images_of,
    millimetres,
    write_bag,
    write_messages,
)

from hiros_cli.app import run
from hiros_mcap.body.rotations import angle
from hiros_mcap.body.transforms import read_extrinsics
from hiros_mcap.calibrate.ball import calibrate_ball
from hiros_mcap.errors import LogError, RegistrationError

CAMERAS = [camera_at(0.0), camera_at(1.7)]
FRAMES = 48
OPTIONS = ["--radius", "0.12"]
PNG = "16UC1; compressedDepth png"


def as_jpeg(head, pixels):
    return compressed(head, pixels, "rgb8; jpeg compressed bgr8", ".png")


def as_png(head, metres):
    return compressed(head, millimetres(metres), PNG, ".png", bytes(12))


def as_float(head, metres):
    return image(head, metres.astype("<f4"), "32FC1")


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Two cameras: one raw in mm, the other one compressed and in m."""
    path = ball_path(FRAMES)
    messages = images_of(0, CAMERAS[0], path)
    messages += images_of(1, CAMERAS[1], path, colour=as_jpeg, depth=as_float)
    return write_messages(tmp_path_factory.mktemp("ball") / "ball.mcap", messages)


def assert_pose(found, true, degrees, metres):
    assert np.degrees(angle(found.xyzw, true.xyzw)) < degrees
    assert np.linalg.norm(found.translation - true.translation) < metres


def test_poses_from_images(log, tmp_path, capsys):
    """48 images, 5 mm of noise, 10 % strays and holes, clutter of the same colour."""
    target = tmp_path / "cameras.toml"
    assert run(["calibrate", "ball", str(log), "-o", str(target), *OPTIONS]) == 0
    assert "poses from the ball: good" in capsys.readouterr().out
    tree = read_extrinsics(target)
    found = tree.lookup("camera_1_optical", "camera_0_optical", 0)
    assert_pose(found, CAMERAS[0].inverse() @ CAMERAS[1], 0.3, 0.01)


def test_what_is_counted_and_measured(log):
    report = calibrate_ball(log, radius=0.12)
    camera = report.cameras[1]
    assert camera.seen > 0.9 * FRAMES
    assert camera.seen + sum(report.skipped[camera.name].values()) == FRAMES
    assert camera.residual_mm < 5
    assert report.radius == pytest.approx(0.12, abs=0.004)
    assert report.warnings == ()


def test_another_radius_is_noticed(log):
    report = calibrate_ball(log, radius=0.13)
    assert "looks like one of radius 0.12" in report.warnings[0]
    assert report.verdict == "doubtful"


def test_compressed_depth(tmp_path):
    path = ball_path(24)
    messages = [m for k in (0, 1) for m in images_of(k, CAMERAS[k], path, depth=as_png)]
    found = calibrate_ball(write_messages(tmp_path / "a.mcap", messages), 0.12)
    assert_pose(found.cameras[1].pose, CAMERAS[0].inverse() @ CAMERAS[1], 0.6, 0.02)


def test_the_log_s_transforms_place_ready_centres(tmp_path):
    from mcap_logs import tf_bytes

    rows = [(0, "room", f"camera_{k}", c.translation, c.xyzw) for k, c in enumerate(CAMERAS)]
    messages = centres_of(CAMERAS, ball_path(100))
    path = write_messages(tmp_path / "a.mcap", messages, static=tf_bytes(*rows))
    found = calibrate_ball(path)
    assert (found.fixed_frame, found.gauge) == ("room", "transforms")
    for camera, true in zip(found.cameras, CAMERAS, strict=True):
        assert_pose(camera.pose, true, 0.2, 0.005)


def test_json(tmp_path, capsys):
    path = write_messages(tmp_path / "a.mcap", centres_of(CAMERAS, ball_path(100)))
    assert run(["calibrate", "ball", str(path), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["schema"] == "hiros.calibrate.ball"
    assert data["cameras"][0]["error_deg"] is None
    assert 0 < data["cameras"][1]["error_deg"] < 0.2
    assert data["cameras"][1]["against"] == "/ball_0"


def failure(arguments, capsys):
    assert run(["calibrate", "ball", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_what_fails_says_why_in_one_line_and_writes_nothing(log, walking, tmp_path, capsys):
    target = tmp_path / "out.toml"
    here = [str(log), "-o", str(target)]
    assert "never saw a ball of radius 0.24 m" in failure(here, capsys)
    assert "never saw a ball" in failure([*here, *OPTIONS, "--color", "90-99:9-90:9-90"], capsys)
    one = [*here, *OPTIONS, "--topic", "/camera_0/*"]
    assert "at least 2 cameras needed, found camera_0" in failure(one, capsys)
    assert "has no colour images" in failure([str(walking)], capsys)
    assert "--color: 'red'" in failure([*here, "--color", "red"], capsys)
    assert not target.exists()


@pytest.mark.parametrize("storage", ["sqlite", "ros1", "split"])
def test_other_kinds_of_logs(storage, tmp_path):
    messages = centres_of(CAMERAS, ball_path(60))
    path = tmp_path / ("a.bag" if storage == "ros1" else "a")
    if storage == "split":
        path.mkdir()
        for k in (0, 1):
            write_messages(path / f"a_{k}.mcap", messages[k * 60 : k * 60 + 60])
        files = "relative_file_paths: [a_0.mcap, a_1.mcap]"
        (path / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  {files}\n")
    else:
        write_bag(path, messages)
    found = calibrate_ball(path)
    assert_pose(found.cameras[1].pose, CAMERAS[0].inverse() @ CAMERAS[1], 0.2, 0.005)


def test_images_without_camera_info_or_joined_frames_are_refused(tmp_path):
    messages = images_of(0, CAMERAS[0], ball_path(1))
    bare = write_messages(tmp_path / "a.mcap", [m for m in messages if "info" not in m[0]])
    with pytest.raises(LogError, match="record the camera_info channels"):
        calibrate_ball(bare)
    for topic, _, message in messages:
        if "depth" in topic:
            message.header.frame_id = "depth_optical"
    with pytest.raises(LogError, match="record depth that is registered to the colour image"):
        calibrate_ball(write_messages(tmp_path / "b.mcap", messages))


def test_cameras_whose_clocks_differ_are_refused(tmp_path):
    messages = centres_of(CAMERAS, ball_path(300))
    for topic, _, message in messages:
        message.header.stamp.sec += topic == "/ball_1"
    with pytest.raises(RegistrationError, match="check the cameras' clocks"):
        calibrate_ball(write_messages(tmp_path / "a.mcap", messages))


def test_damaged_images_are_named_where_there_are_too_few(tmp_path):
    def cut(head, pixels):
        picture = as_jpeg(head, pixels)
        picture.data = picture.data[: len(picture.data) // 3]
        return picture

    path = ball_path(24)
    messages = images_of(0, CAMERAS[0], path, colour=cut) + images_of(1, CAMERAS[1], path)
    log = write_messages(tmp_path / "a.mcap", messages)
    with pytest.raises(RegistrationError, match="never saw the ball; damaged images: camera_0 24"):
        calibrate_ball(log, radius=0.12)


HUGE = """
import struct, zlib
from types import SimpleNamespace
import numpy as np
from hiros_mcap.errors import LogError
from hiros_mcap.io.ros_messages import colour_image

def part(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

side = 12_000
pixels = zlib.compress(bytes((side // 8 + 1) * side))
size = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
parts = [part(b"IHDR", size), part(b"IDAT", pixels), part(b"IEND", b"")]
data = np.frombuffer(b"\\x89PNG\\r\\n\\x1a\\n" + b"".join(parts), np.uint8)
try:
    colour_image(SimpleNamespace(data=data, format="png"))
except LogError as error:
    print(error)
"""


def test_a_picture_that_is_small_and_unpacks_to_gigabytes_is_refused():
    # OpenCV takes its limit when it is loaded.
    done = subprocess.run([sys.executable, "-c", HUGE], capture_output=True, text=True, check=True)
    assert "a compressed image cannot be decoded" in done.stdout
