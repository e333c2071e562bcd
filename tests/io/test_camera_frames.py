"""Transforms in namespaces, and how frames, topics and files with poses call the cameras."""

from __future__ import annotations

import json

import numpy as np
import pytest
from odd_logs import changed, poses_of, published

from hiros_cli.app import run as command
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.camera_clock import LATE, ClockFault, described
from hiros_mcap.io.log import open_log

NAMES = ("camera_0", "camera_1", "camera_2")
TOPICS = tuple(f"/{name}/skeletons" for name in NAMES)


def positions(log):
    return [(f.frame_id, f.positions) for f in log.detections()]


def assert_same_places(path, healthy, **choices):
    """All detections are where those of the healthy log are; return the notes."""
    with open_log(healthy) as one, open_log(path, **choices) as other:
        for (_, here), (_, there) in zip(positions(one), positions(other), strict=True):
            np.testing.assert_allclose(there, here, atol=1e-5)
        return " ".join(other.remarks)


def of_each(rows, child=None):
    """The transforms of each camera in a namespace of its own."""
    return {f"/{row[1]}/tf_static": [(row[0], child or row[1], *row[2:])] for row in rows}


def elsewhere(rows):
    return [(parent, f"arm_{child}", *pose) for parent, child, *pose in rows]


@pytest.mark.parametrize(
    ("topics", "used"),
    [
        (lambda rows: {"/lab/tf_static": rows}, ["/lab/tf_static"]),
        (lambda rows: {"/robot1/tf": rows}, ["/robot1/tf"]),
        (of_each, [f"/{name}/tf_static" for name in NAMES]),
        (lambda rows: {"/tf_static": [], **of_each(rows)}, ["/camera_1/tf_static"]),
        (lambda rows: {"/tf_static": elsewhere(rows), "/lab/tf_static": rows}, ["/lab/tf_static"]),
        (lambda rows: {"/tf_static": rows[:2], "/robot/tf_static": rows[2:]}, ["/robot/tf_static"]),
    ],
)
def test_transforms_in_namespaces_are_read_where_there_is_no_global_one(
    topics, used, crossing, tmp_path
):
    log = published(crossing, tmp_path / "log.mcap", topics(poses_of(crossing)))
    notes = assert_same_places(log, crossing)
    assert all(topic in notes for topic in used)
    assert "in a namespace" in notes


def test_a_namespace_changes_nothing_where_the_global_transforms_join_the_cameras(
    crossing, tmp_path
):
    rows, odd = poses_of(crossing), ((5.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    spaced = [("map", "world", *odd), ("map", "camera_1", *odd)]
    topics = {"/tf_static": rows, "/robot1/tf_static": spaced}
    log = published(crossing, tmp_path / "log.mcap", topics)
    assert "namespace" not in assert_same_places(log, crossing)
    with open_log(log) as opened:
        assert opened.fixed_frame == "world"


def test_robots_of_one_kind_have_their_frame_in_their_own_namespace(crossing, tmp_path):
    topics = of_each(poses_of(crossing), "camera_link")
    log = published(crossing, tmp_path / "log.mcap", topics, lambda _: "camera_link")
    assert "'camera_link' is that of /camera_1/tf_static" in assert_same_places(log, crossing)


@pytest.mark.parametrize("in_messages", [True, False])
def test_a_prefix_on_one_side_is_allowed_for(in_messages, crossing, tmp_path):
    rows = poses_of(crossing)
    if not in_messages:
        rows = [(parent, f"lab/{child}", *pose) for parent, child, *pose in rows]
    name = (lambda source: f"lab/{source}") if in_messages else None
    log = published(crossing, tmp_path / "log.mcap", {"/tf_static": rows}, name)
    assert "tf_prefix" in assert_same_places(log, crossing)


@pytest.mark.parametrize("topic", ["/tf_static", "/tf", "/lab/tf_static"])
def test_cameras_that_are_parents_of_the_room_are_named(topic, crossing, tmp_path, capsys):
    rows = [(child, parent, *pose) for parent, child, *pose in poses_of(crossing)]
    log = published(crossing, tmp_path / "log.mcap", {topic: rows})
    assert command(["process", str(log), "-o", str(tmp_path / "out.mcap")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "'world' has several parents, 'camera_0', 'camera_1' and 'camera_2'" in line
    assert "parent and child may be exchanged" in line
    assert not (tmp_path / "out.mcap").exists()
    assert command(["info", str(log)]) == 0
    assert "parent and child may be exchanged" in " ".join(capsys.readouterr().out.split())


def test_topics_that_look_like_transforms_are_named(crossing, tmp_path):
    log = published(crossing, tmp_path / "log.mcap", {"/transforms": poses_of(crossing)})
    with open_log(log) as opened, pytest.raises(LogError, match=r"/transforms \(TFMessage\)"):
        _ = opened.fixed_frame


def test_a_camera_without_a_frame_beside_others_is_named(crossing, tmp_path):
    def nameless(frame, _):
        return frame.replace(frame_id="", source="") if frame.source == "camera_1" else frame

    log = changed(crossing, tmp_path / "log.mcap", nameless)
    with open_log(log) as opened, pytest.raises(LogError) as error:
        _ = opened.fixed_frame
    assert "/camera_1/skeletons: header.frame_id is empty, while the other" in str(error.value)
    file = file_of(tmp_path / "cameras.json", poses_of(crossing), TOPICS)
    assert_same_places(log, crossing, extrinsics=file)


# -- files with poses --------------------------------------------------------------------------


def file_of(path, rows, names):
    """A file with the poses of a log's transforms; ``names`` are those of the cameras."""
    cameras = [
        {"frame": name, "translation": list(at), "quaternion_xyzw": list(xyzw)}
        for (_, _, at, xyzw), name in zip(rows, names, strict=False)
    ]
    path.write_text(json.dumps({"camera": cameras}))
    return path


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize(
    "names",
    [TOPICS, [topic.strip("/") for topic in TOPICS], NAMES, ["/camera_0/skeletons", *NAMES[1:]]],
)
def test_a_file_may_call_cameras_by_topics_or_parts_of_them(names, shared, crossing, tmp_path):
    rows = poses_of(crossing)
    frame = (lambda _: "depth_camera_link") if shared else None
    log = published(crossing, tmp_path / "log.mcap", {}, frame)
    file = file_of(tmp_path / "cameras.json", rows, names)
    assert_same_places(log, crossing, extrinsics=file)


def test_a_result_with_poses_by_topic_can_be_read_alone(crossing, tmp_path):
    log = published(crossing, tmp_path / "log.mcap", {}, lambda _: "depth_camera_link")
    file = file_of(tmp_path / "cameras.json", poses_of(crossing), TOPICS)
    out, options = tmp_path / "out.mcap", ["--stages", "T", "--calibrate", "off"]
    arguments = ["process", str(log), "-q", "-o", str(out), "--extrinsics", str(file)]
    assert command([*arguments, *options]) == 0
    assert_same_places(out, crossing)


@pytest.mark.parametrize("names", [["a", "b", "c"], ["camera_0", "camera_1", "c"]])
@pytest.mark.parametrize(
    "arguments", [["process", "-o", "OUT.mcap"], ["info"], ["view", "--save", "OUT.rrd"]]
)
def test_names_that_fit_no_camera_are_an_error_of_both_sides(
    arguments, names, crossing, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    file = file_of(tmp_path / "cameras.json", poses_of(crossing), names)
    given = ["--extrinsics", str(file), str(crossing)]
    assert command([arguments[0], *given, *arguments[1:]]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    for text in (str(file), *names, "/camera_2/skeletons (frame camera_2)"):
        assert text in line
    assert [path.name for path in tmp_path.iterdir()] == ["cameras.json"]


def test_poses_of_no_camera_of_the_log_are_noted(crossing, tmp_path):
    rows = poses_of(crossing)
    file = file_of(tmp_path / "cameras.json", [*rows, rows[0]], [*NAMES, "camera_9"])
    notes = assert_same_places(crossing, crossing, extrinsics=file)
    assert f"{file}: not used: camera_9" in notes


def test_a_file_without_a_pose_of_a_camera_is_an_error(crossing, tmp_path):
    file = file_of(tmp_path / "cameras.json", poses_of(crossing), NAMES[:2])
    with pytest.raises(ConfigError, match="has no pose of /camera_2/skeletons"):
        open_log(crossing, extrinsics=file)
    with open_log(crossing, topics=["/camera_[01]/*"], extrinsics=file) as log:
        assert log.fixed_frame == "world"


def test_a_time_of_another_age_is_not_said():
    fault = ClockFault("camera_0", LATE, 0.2, 1_700_000_000_000_000_000, corrected=True, messages=3)
    assert described(fault, 0) == "camera_0: 3 messages arrived up to 200 ms late"
