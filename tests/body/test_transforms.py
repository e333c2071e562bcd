import json
import math
import struct

import numpy as np
import pytest
from mcap_logs import tf_bytes
from scipy.spatial.transform import Rotation

from hiros_mcap.body import rotations
from hiros_mcap.body.transforms import (
    Transform,
    TransformTree,
    parse_tf,
    read_extrinsics,
    transform_to_fixed,
)
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.skeletons import Frame, SkeletonModel

NAN = math.nan
QUARTER = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))  # 90 degrees about z
NONE = (0.0, 0.0, 0.0, 1.0)
MODEL = SkeletonModel.of(("a", "b", "c"), (("ab", 0, 1), ("bc", 1, 2)))


def tree_of(*rows, static=True):
    """Rows are (child, parent, translation, xyzw[, stamp])."""
    tree = TransformTree()
    for child, parent, translation, xyzw, *stamp in rows:
        tree.add(Transform(*stamp or (0,), parent, child, translation, xyzw), static=static)
    return tree


def random_rotations(n, seed=0):
    return Rotation.random(n, random_state=seed).as_quat()


def random_frame(n=3, seed=0):
    rng = np.random.default_rng(seed)
    frame = Frame.empty(n, MODEL, frame_id="camera", source="camera", stamp=5)
    for block in (frame.markers, frame.links, frame.boxes):
        block[...] = rng.normal(size=block.shape)
        block[..., 3:7] /= np.linalg.norm(block[..., 3:7], axis=-1)[..., None]
    return frame


# -- rotations ---------------------------------------------------------------------------------


def test_products_and_rotations_are_those_of_scipy():
    a, b = random_rotations(50), random_rotations(50, 1)
    vectors = np.random.default_rng(2).normal(size=(50, 3))
    product = (Rotation.from_quat(a) * Rotation.from_quat(b)).as_matrix()
    np.testing.assert_allclose(rotations.to_matrix(rotations.multiply(a, b)), product, atol=1e-12)
    rotated = Rotation.from_quat(a).apply(vectors)
    np.testing.assert_allclose(rotations.rotate(a, vectors), rotated, atol=1e-12)


def test_rotation_vectors_and_matrices_are_those_of_scipy():
    turns = Rotation.random(200, rng=3)
    vectors = np.concatenate(
        [turns.as_rotvec(), np.eye(3) * math.pi, np.zeros((1, 3)), [[1e-9] * 3]]
    )
    turns = Rotation.from_rotvec(vectors)
    found = rotations.from_vector(vectors)
    np.testing.assert_allclose(rotations.to_matrix(found), turns.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(
        np.abs(np.sum(rotations.from_matrix(turns.as_matrix()) * turns.as_quat(), axis=1)), 1.0
    )
    np.testing.assert_allclose(rotations.to_vector(found), vectors, atol=1e-12)


def test_the_angle_ignores_the_sign_of_a_quaternion():
    assert rotations.angle(np.array(QUARTER), -np.array(QUARTER)) == pytest.approx(0, abs=1e-7)
    assert rotations.angle(np.array(QUARTER), np.array(NONE)) == pytest.approx(math.pi / 2)


def test_slerp_goes_the_shorter_way_at_constant_speed():
    third = rotations.slerp(np.array(NONE), -np.array(QUARTER), 1 / 3)
    expected = Rotation.from_euler("z", 30, degrees=True).as_quat()
    assert rotations.angle(third, expected) == pytest.approx(0, abs=1e-7)
    close = rotations.slerp(np.array(NONE), np.array([1e-12, 0, 0, 1]), 0.5)
    np.testing.assert_allclose(close, NONE, atol=1e-12)


# -- messages ----------------------------------------------------------------------------------


ROWS = [
    (1_700_000_000_123_456_789, "world", "camera_0", (1.0, 2.0, 3.0), NONE),
    (5, "a frame with a längere name", "b", (-1.5, 0.0, 1e9), QUARTER),
    (0, "", "x", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
]


@pytest.mark.parametrize("n", range(4))
def test_tf_messages_are_read_as_the_library_wrote_them(n):
    assert parse_tf(tf_bytes(*ROWS[:n])) == [Transform(*row) for row in ROWS[:n]]


def test_big_endian_tf_messages_are_read():
    text = struct.pack(">I", 2) + b"a\0"
    head = struct.pack(">IiI", 1, 3, 4) + text + b"\0\0" + text + b"\0" * 6
    data = b"\0\0\0\0" + head + struct.pack(">7d", 1, 2, 3, *NONE)
    assert parse_tf(data) == [Transform(3_000_000_004, "a", "a", (1, 2, 3), NONE)]


def test_every_cut_of_a_tf_message_is_an_error():
    data = tf_bytes(*ROWS)
    for n in range(len(data)):
        with pytest.raises(LogError, match="tf message"):
            parse_tf(data[:n])
    with pytest.raises(LogError, match="longer"):
        parse_tf(data + bytes(4))
    with pytest.raises(LogError, match="plain CDR"):
        parse_tf(b"\0\3" + data[2:])


# -- tree --------------------------------------------------------------------------------------


def test_a_chain_is_walked_up_and_down():
    tree = tree_of(
        ("base", "world", (1, 0, 0), QUARTER),
        ("camera", "base", (1, 0, 0), NONE),
        ("other", "world", (0, 0, 5), NONE),
    )
    np.testing.assert_allclose(tree.lookup("camera", "world", 0).translation, [1, 1, 0], atol=1e-12)
    pose = tree.lookup("camera", "other", 0)
    np.testing.assert_allclose(pose.translation, [1, 1, -5], atol=1e-12)
    back = tree.lookup("other", "camera", 0)
    np.testing.assert_allclose((pose @ back).translation, 0, atol=1e-12)


def test_a_moving_frame_is_interpolated_and_held_at_the_ends():
    tree = tree_of(
        ("camera", "world", (10, 0, 0), QUARTER, 200),
        ("camera", "world", (0, 0, 0), NONE, 100),
        static=False,
    )
    middle = tree.lookup("camera", "world", 150)
    np.testing.assert_allclose(middle.translation, [5, 0, 0])
    assert rotations.angle(middle.xyzw, np.array(NONE)) == pytest.approx(math.pi / 4)
    assert tree.lookup("camera", "world", 0).translation[0] == 0
    assert tree.lookup("camera", "world", 999).translation[0] == 10


def test_the_last_of_two_samples_of_a_moving_frame_counts():
    rows = [("c", "w", (k, 0, 0), NONE, 5) for k in range(2)]
    assert tree_of(*rows, static=False).lookup("c", "w", 7).translation[0] == 1


def static_tree(*poses, begin=0):
    """Poses are (log time, x[, xyzw])."""
    tree = TransformTree(begin)
    for log_time, x, *xyzw in poses:
        row = Transform(0, "w", "c", (x, 0.0, 0.0), *(xyzw or [NONE]))
        tree.add(row, static=True, log_time=log_time)
    return tree


@pytest.mark.parametrize("times", [(7, 7), (3, 9), (0, 0)])
def test_static_transforms_that_disagree_before_the_first_detection_are_refused(times):
    tree = static_tree((times[0], 1.0), (times[1], 1.2, QUARTER), begin=10)
    with pytest.raises(LogError, match=r"20.0 cm and 90.0 degrees.*1\.000.*1\.200.*--extrinsics"):
        tree.lookup("c", "w", 50)


def test_static_transforms_that_alternate_are_refused():
    with pytest.raises(LogError, match="in turns that disagree by 100.0 cm"):
        static_tree((10, 1.0), (20, 2.0), (30, 1.0)).lookup("c", "w", 5)


def test_repeated_static_transforms_are_one_to_the_rounding():
    tree = static_tree((10, 1.0), (20, 1.00005), (20, 1.0, (1e-5, 0, 0, 1)), (30, 1.0))
    assert tree.at_rest("c", "w") is not None
    assert tree.changes_above(["c"]) == []


def test_a_changed_static_pose_counts_from_its_log_time_on():
    tree = static_tree((3, 1.0), (5, 1.0), (20, 2.0), (25, 2.0), (30, 4.0), begin=10)
    places = [tree.lookup("c", "w", 0, now).translation[0] for now in (0, 19, 20, 29, 30, 99)]
    assert places == [1, 1, 2, 2, 4, 4]
    assert tree.at_rest("c", "w") is None
    assert [(c.log_time, c.metres) for c in tree.changes_above(["c"])] == [(20, 1), (30, 2)]


def test_the_fixed_frame_is_the_root_of_all_cameras():
    tree = tree_of(("c0", "map", (0, 0, 0), NONE), ("c1", "rig", (0, 0, 0), NONE))
    tree.add(Transform(0, "map", "rig", (0, 0, 0), NONE), static=True)
    assert tree.common_root(["c0", "c1"]) == "map"
    assert TransformTree().common_root(["world", "world"]) == "world"


def test_cameras_without_a_common_root_are_named():
    tree = tree_of(("c0", "world", (0, 0, 0), NONE))
    with pytest.raises(LogError, match=r"c0 in world; c1 in c1.*of c0, world.*--extrinsics"):
        tree.common_root(["c0", "c1"])


def test_a_missing_transform_names_the_camera_and_the_known_frames():
    tree = tree_of(("c0", "world", (0, 0, 0), NONE))
    with pytest.raises(LogError, match=r"'c1' to 'world'; known frames: c0, world"):
        tree.lookup("c1", "world", 0)


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        (("c", "other", (0, 0, 0), NONE), "two parents"),
        (("world", "c", (0, 0, 0), NONE), "loop: c -> world -> c"),
        (("c", "world", (0, 0, 0), (0, 0, 0, 0)), "length 0"),
        (("c", "world", (NAN, 0, 0), NONE), "not finite"),
        (("c", "world", (0, 0, 0), (0, 0, 0, math.inf)), "not finite"),
    ],
)
def test_a_faulty_transform_is_an_error_for_those_who_need_it(row, reason):
    tree = tree_of(("c", "world", (0, 0, 0), NONE), row, ("d", "room", (1, 0, 0), NONE))
    with pytest.raises(LogError, match=reason):
        tree.lookup("c", "world", 0)
    assert tree.lookup("d", "room", 0).translation[0] == 1


def test_a_frame_both_static_and_moving_is_an_error():
    tree = tree_of(("c", "world", (0, 0, 0), NONE))
    tree.add(Transform(0, "world", "c", (0, 0, 0), NONE), static=False)
    with pytest.raises(LogError, match="on /tf_static and on /tf"):
        tree.lookup("c", "world", 0)


def test_a_quaternion_that_is_not_quite_one_is_normalised_and_counted():
    tree = tree_of(("c", "w", (0, 0, 0), (0, 0, 0, 1.01)), ("d", "w", (0, 0, 0), (0, 0, 0, 1.0001)))
    assert tree.lookup("c", "w", 0).xyzw[3] == 1
    assert tree.normalised == {"c": 1}


# -- extrinsics --------------------------------------------------------------------------------


def extrinsics(tmp_path, text, name="cameras.toml"):
    path = tmp_path / name
    path.write_text(text)
    return path


CAMERA = {"frame": "c", "parent": "lab", "translation": [1, 2.5, 3], "quaternion_xyzw": NONE}


def test_extrinsics_are_read_from_toml_and_json(tmp_path):
    toml = '[[camera]]\nframe = "c"\nparent = "lab"\ntranslation = [1, 2.5, 3]\n'
    toml += "quaternion_xyzw = [0, 0, 0, 1]\n"
    for name, text in (("c.toml", toml), ("c.json", json.dumps({"camera": [CAMERA]}))):
        pose = read_extrinsics(extrinsics(tmp_path, text, name)).lookup("c", "lab", 0)
        assert pose.translation.tolist() == [1, 2.5, 3]


def calib(rotation, translation, name="left"):
    """A camera as Anipose and Pose2Sim write it."""
    return (
        f'[cam_01]\nname = "{name}"\nsize = [1920, 1080]\n'
        "matrix = [[1400.0, 0.0, 960.0], [0.0, 1400.0, 540.0], [0.0, 0.0, 1.0]]\n"
        "distortions = [0.0, 0.0, 0.0, 0.0]\nfisheye = false\n"
        f"rotation = {list(map(float, rotation))}\ntranslation = {list(map(float, translation))}\n"
        "[metadata]\nadjusted = false\nerror = 0.2\n"
    )


def test_a_camera_of_anipose_or_pose2sim_stands_where_it_sees_the_room_from(tmp_path):
    """Its numbers bring points of the room into the camera, as cv2.projectPoints takes them."""
    turn, place = Rotation.from_rotvec([1.2, -0.4, 0.7]), np.array([2.0, -3.0, 1.5])
    path = extrinsics(tmp_path, calib(turn.as_rotvec(), -turn.apply(place)), "Calib.toml")
    pose = read_extrinsics(path).lookup("left", "world", 0)
    np.testing.assert_allclose(pose.translation, place, atol=1e-12)
    seen = turn.apply(np.array([0.3, 0.2, 1.0]) - place)
    there = rotations.rotate(pose.xyzw, seen) + pose.translation
    np.testing.assert_allclose(there, [0.3, 0.2, 1.0], atol=1e-12)


@pytest.mark.parametrize(
    ("rotation", "translation", "fault"),
    [
        ([0, 0, 0], [0, 0, 2400.0], "stands 2400 m from the origin, so its unit is another one"),
        ([0, 0], [0, 0, 2], "rotation and translation should be three numbers"),
        ([0, 0, math.nan], [0, 0, 2], "rotation and translation should be three numbers"),
    ],
)
def test_a_faulty_calibration_of_another_program_is_refused(rotation, translation, fault, tmp_path):
    path = extrinsics(tmp_path, calib(rotation, translation), "calibration.toml")
    with pytest.raises(ConfigError, match=rf"calibration\.toml: cam_01: {fault}"):
        read_extrinsics(path)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"translation": [1, 2]}, r"camera\.0\.translation"),
        ({"translation": [1, 2, "x"]}, r"camera\.0\.translation\.2"),
        ({"quaternion_xyzw": [0, 0, 0, 2]}, "c: quaternion_xyzw: its length is 2, not 1"),
        ({"frame": ""}, r"camera\.0\.frame"),
        ({"rotation": []}, r"camera\.0\.rotation: there is no such key"),
    ],
)
def test_a_wrong_extrinsics_file_is_an_error_that_names_the_key(tmp_path, change, key):
    path = extrinsics(tmp_path, json.dumps({"camera": [CAMERA | change]}), "c.json")
    with pytest.raises(ConfigError, match=rf"c\.json: {key}"):
        read_extrinsics(path)


def test_an_unreadable_extrinsics_file_is_an_error(tmp_path):
    twice = json.dumps({"camera": [CAMERA, CAMERA]})
    for name, text in (("a.toml", "[[camera"), ("b.json", "{"), ("c.toml", ""), ("d.json", twice)):
        with pytest.raises(ConfigError, match=name):
            read_extrinsics(extrinsics(tmp_path, text, name))
    with pytest.raises(ConfigError, match="No such file"):
        read_extrinsics(tmp_path / "absent.toml")
    (tmp_path / "e.toml").write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(ConfigError, match=r"e\.toml: not text: "):
        read_extrinsics(tmp_path / "e.toml")


def test_extrinsics_that_go_round_are_an_error_of_the_file(tmp_path):
    circle = [CAMERA, CAMERA | {"frame": "lab", "parent": "c"}]
    path = extrinsics(tmp_path, json.dumps({"camera": circle}), "c.json")
    with pytest.raises(ConfigError, match=r"c\.json: the transforms form a loop: c -> "):
        read_extrinsics(path)


# -- frames ------------------------------------------------------------------------------------


def test_positions_move_and_the_rest_turns():
    frame = random_frame(2)
    tree = tree_of(("camera", "world", (1, 2, 3), QUARTER))
    (moved,) = transform_to_fixed([frame], tree, "world")
    turn = Rotation.from_quat(QUARTER)
    for old, new in ((frame.markers[1, 2], moved.markers[1, 2]), (frame.boxes[0], moved.boxes[0])):
        np.testing.assert_allclose(new[:3] - [1, 2, 3], turn.apply(old[:3]))
        product = (turn * Rotation.from_quat(old[3:7])).as_quat()
        np.testing.assert_allclose(abs(new[3:7] @ product), 1)
        for k in range(7, 19, 3):
            np.testing.assert_allclose(new[k : k + 3], turn.apply(old[k : k + 3]))
    np.testing.assert_array_equal(moved.boxes[:, 19:], frame.boxes[:, 19:])


def test_what_is_absent_stays_absent():
    frame = Frame.empty(2, MODEL, frame_id="camera")
    frame.markers[0, 1, :3] = 1
    (moved,) = transform_to_fixed([frame], tree_of(("camera", "w", (1, 1, 1), QUARTER)), "w")
    np.testing.assert_array_equal(np.isnan(moved.markers), np.isnan(frame.markers))


def test_frames_in_the_fixed_frame_pass_and_none_is_changed():
    frame = random_frame()
    before = frame.markers.copy()
    assert list(transform_to_fixed([frame], TransformTree(), "camera")) == [frame]
    list(transform_to_fixed([frame], tree_of(("camera", "w", (1, 1, 1), QUARTER)), "w"))
    np.testing.assert_array_equal(frame.markers, before)


def test_a_moving_camera_is_taken_at_the_time_of_the_frame():
    rows = [("camera", "w", (float(t), 0.0, 0.0), NONE, t) for t in (0, 10)]
    frames = [random_frame().replace(stamp=t) for t in (2, 7)]
    moved = list(transform_to_fixed(frames, tree_of(*rows, static=False), "w"))
    shift = [m.markers[0, 0, 0] - f.markers[0, 0, 0] for f, m in zip(frames, moved, strict=True)]
    np.testing.assert_allclose(shift, [2, 7])


def test_a_marker_of_which_only_the_position_is_known_moves():
    frame = Frame.empty(1, MODEL, frame_id="camera")
    frame.markers[0, 0, :3] = 1.0
    tree = tree_of(("camera", "world", (1.0, 2.0, 3.0), NONE))
    (moved,) = transform_to_fixed([frame], tree, "world")
    assert moved.positions[0, 0].tolist() == [2.0, 3.0, 4.0]
    assert np.isnan(moved.markers[0, 0, 3:]).all()
