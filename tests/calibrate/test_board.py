"""The cameras in the frame of a board, from rendered images to the file."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stderr
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from rendered_ball import STORE, header, image, millimetres, write_messages
from scipy.spatial.transform import Rotation
from whole_commands import altered_text

from hiros_cli.app import run
from hiros_mcap.body.rotations import Rigid, angle, to_matrix
from hiros_mcap.body.transforms import read_extrinsics
from hiros_mcap.calibrate.board import calibrate_board
from hiros_mcap.errors import ConfigError, RegistrationError

WIDTH, HEIGHT = 640, 480
K = np.array([[520.0, 0, 319.5], [0, 520.0, 239.5], [0, 0, 1]])
TOP = 1.0
"""m: height of the board in the cameras' world."""
MARKERS = np.array([[0.0, 0.35], [0.0, 0.0], [0.35, 0.0], [0.35, 0.35]])
"""m: centres on the board; x from marker 1 to 2, y from 1 to 0."""
PLATE = 1000  # pixels per m of the board's picture


def plate():
    """A picture of the board, 0.7 m wide, whose row 0 is at y = -0.175 m."""
    picture = np.full((700, 700), 255, np.uint8)
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for k, centre in enumerate(MARKERS):
        marker = cv2.aruco.generateImageMarker(words, k, 200)[::-1]  # rows count y upwards
        column, row = np.rint((centre + 0.175) * PLATE).astype(int) - 100
        picture[row : row + 200, column : column + 200] = marker
    return picture


def see(camera, seed, board=True, unknown=()):
    """Ray-cast the board: BGR (H, W, 3) and depth (H, W), m, with noise; 0 at some markers."""
    rng = np.random.default_rng(seed)
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(columns - 319.5) / 520, (rows - 239.5) / 520, np.ones((HEIGHT, WIDTH))], -1)
    directions = rays @ to_matrix(camera.xyzw).T
    depth = (TOP - camera.translation[2]) / directions[..., 2]
    places = camera.translation[:2] + directions[..., :2] * depth[..., None]
    pixels = np.full((HEIGHT, WIDTH), 120.0)
    at = np.floor((places + 0.175) * PLATE).astype(int)
    on = ((at >= 0) & (at < 700)).all(axis=-1) & (depth > 0) & board
    pixels[on] = plate()[at[on][:, 1], at[on][:, 0]]
    depth = np.where((depth > 0) & (depth < 6), depth, 4.0) + rng.normal(0, 0.004, depth.shape)
    for k in unknown:
        depth[np.abs(places - MARKERS[k]).max(axis=-1) < 0.15] = 0.0
    pixels = np.clip(pixels + rng.normal(0, 3, pixels.shape), 0, 255).astype(np.uint8)
    return np.repeat(pixels[..., None], 3, axis=2), depth


def info(head):
    roi = STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    kind = STORE.types["sensor_msgs/msg/CameraInfo"]
    p = np.hstack([K, np.zeros((3, 1))]).reshape(-1)
    lens = np.zeros(5), K.reshape(-1), np.eye(3).reshape(-1), p
    return kind(head, HEIGHT, WIDTH, "plumb_bob", *lens, 0, 0, roi)


def above(angle):
    """A camera 1.2 m above the board that looks at its middle from the side."""
    middle = np.array([0.175, 0.175, TOP])
    place = middle + np.array([np.cos(angle), np.sin(angle), 1.2])
    z = (middle - place) / np.linalg.norm(middle - place)
    x = np.cross(z, [0, 0, 1.0]) / np.linalg.norm(np.cross(z, [0, 0, 1.0]))
    matrix = np.stack([x, np.cross(z, x), z], axis=1)
    return Rigid(Rotation.from_matrix(matrix).as_quat(), place)


CAMERAS = [above(0.3), above(1.8)]


def write_board(path, sees=(True, True), n=6, unknown=()):
    """Write a log; in the first image of camera 0, the depth of some markers is unknown."""
    messages = []
    for k, camera in enumerate(CAMERAS):
        frame = f"camera_{k}_optical"
        for i in range(n):
            stamp = 10**18 + i * 33_333_333
            pixels, metres = see(camera, 10 * k + i, sees[k], () if k or i else unknown)
            head = header(stamp, frame)
            messages += [
                (f"/camera_{k}/color/image_raw", stamp, image(head, pixels, "bgr8")),
                (f"/camera_{k}/depth/image_raw", stamp, image(head, millimetres(metres), "16UC1")),
            ]
        for kind in ("color", "depth"):
            messages.append(
                (f"/camera_{k}/{kind}/camera_info", 10**18, info(header(10**18, frame)))
            )
    return write_messages(path, messages)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_board(tmp_path_factory.mktemp("board") / "board.mcap")


def assert_right(poses):
    for pose, camera in zip(poses, CAMERAS, strict=True):
        wanted = camera.translation - [0, 0, TOP]
        assert np.linalg.norm(pose.translation - wanted) < 0.015
        assert np.degrees(angle(pose.xyzw, camera.xyzw)) < 0.5


def test_each_camera_sees_the_board(log):
    found = calibrate_board(log)
    assert (found.verdict, found.gauge) == ("good", "board"), found.reason
    assert [camera.seen for camera in found.cameras] == [6, 6]
    assert_right([camera.pose for camera in found.cameras])


@pytest.mark.parametrize("unknown", [(2,), (0, 1, 2, 3)])
def test_an_image_without_the_depth_of_a_marker_is_left_out(unknown, tmp_path):
    found = calibrate_board(write_board(tmp_path / "board.mcap", unknown=unknown))
    assert [camera.seen for camera in found.cameras] == [5, 6]
    assert_right([camera.pose for camera in found.cameras])


def of_the_ball():
    """Poses of the cameras in another frame, as TOML."""
    turn = Rigid(np.array([0.0, 0.0, np.sin(0.2), np.cos(0.2)]), np.array([1.0, 2.0, 0.3]))
    lines = []
    for k, camera in enumerate(CAMERAS):
        pose = turn @ camera
        lines += [
            "[[camera]]",
            f'frame = "camera_{k}_optical"',
            f"translation = {pose.translation.tolist()}",
            f"quaternion_xyzw = {pose.xyzw.tolist()}",
        ]
    return "\n".join(lines).encode()


@pytest.fixture(scope="module")
def brief(tmp_path_factory):
    return write_board(tmp_path_factory.mktemp("board") / "brief.mcap", n=1)


@settings(max_examples=4, deadline=None, derandomize=True, database=None)
@given(data=altered_text(of_the_ball()))
def test_altered_poses_are_taken_or_refused_in_one_line(brief, data):
    poses = brief.with_name("ball.toml")
    poses.write_bytes(data)
    with redirect_stderr(io.StringIO()) as stderr:
        code = run(["calibrate", "board", str(brief), "--extrinsics", str(poses)])
    assert code in (0, 2)
    assert stderr.getvalue().count("hiros: error: ") == (code == 2), stderr.getvalue()
    assert "Traceback" not in stderr.getvalue()


def test_with_known_poses_one_camera_is_enough(tmp_path):
    log = write_board(tmp_path / "board.mcap", sees=(True, False))
    ball = tmp_path / "ball.toml"
    ball.write_bytes(of_the_ball())
    found = calibrate_board(log, extrinsics=ball)
    assert found.gauge == "transforms"
    assert_right([camera.pose for camera in found.cameras])
    with pytest.raises(RegistrationError, match="camera_1 never saw the board"):
        calibrate_board(log)


def test_the_file_and_what_is_printed(log, tmp_path, capsys):
    target = tmp_path / "cameras.toml"
    assert run(["calibrate", "board", str(log), "-o", str(target)]) == 0
    assert "marker 1 of the board" in capsys.readouterr().out
    tree = read_extrinsics(target)
    assert_right([tree.at_rest(f"camera_{k}_optical", "world") for k in (0, 1)])
    assert run(["calibrate", "board", str(log), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "good"


def test_no_board_and_no_such_dictionary(tmp_path):
    log = write_board(tmp_path / "board.mcap", sees=(False, False))
    with pytest.raises(RegistrationError, match="no camera sees markers 0 to 3"):
        calibrate_board(log)
    with pytest.raises(ConfigError, match="there is no 'DICT_9'"):
        calibrate_board(log, dictionary="DICT_9")


def test_every_field_of_the_json_is_documented(log, capsys):
    assert run(["calibrate", "board", str(log), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    page = (Path(__file__).parents[2] / "docs/json.md").read_text(encoding="utf-8")
    section = page.split("## `hiros.calibrate.board`")[1].split("\n## ")[0]
    fields = {*data} - {"schema", "version", "warnings", "cameras", "skipped"}
    fields |= {f"cameras[].{key}" for key in data["cameras"][0]}
    assert [field for field in fields if f"`{field}`" not in section] == []
