"""Logs of other detectors, with the bytes of their drivers, say what SkeletonGroups say."""

from __future__ import annotations

import re
from dataclasses import replace
from importlib.metadata import EntryPoint
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import detector_logs as made
import numpy as np
import pytest
from detector_logs import Scene, azure, kinect_v2, only, points_in, together, write_ros2, zed
from mcap.writer import Writer

import hiros_schemas
from hiros_cli.app import run
from hiros_mcap import plugins
from hiros_mcap.body.body_size import unit_of
from hiros_mcap.body.forward_cues import FacingMarkers
from hiros_mcap.config import load_config
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.evaluate import evaluate, load_truth
from hiros_mcap.io import detectors
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.io.detectors import azure_kinect, detector_readers
from hiros_mcap.io.detectors.body_models import BODY_MODELS, body_model, joints_of, name_of
from hiros_mcap.io.detectors.conversion import Selection
from hiros_mcap.io.detectors.detector_reader import DetectorMessage
from hiros_mcap.io.detectors.model_fitting import union_of
from hiros_mcap.io.log import open_log
from hiros_mcap.running.overview import overview_of
from hiros_mcap.running.pipeline import process

pytestmark = pytest.mark.usefixtures("nothing_left")
EXACT = {"skeleton groups", "stamped skeletons", "ros1 in mcap"}
"""They keep every number; float32 of the ZED is off by 1 um at 8 m, sums of frames by less."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.mcap"
    return made.scene(path, people=2, cameras=3, seconds=0.9, seed=11)


@pytest.fixture(scope="module")
def logs(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    return {
        kind: write(folder / f"{i}{'.bag' if 'bag' in kind else '.mcap'}", scene)
        for i, (kind, write) in enumerate(made.KINDS.items())
    }


@pytest.mark.parametrize("kind", made.KINDS)
def test_every_detector_says_what_skeleton_groups_say(kind, logs, scene):
    expected = {
        (frame.source, made.stamp_of(frame)): frame
        for _, frame in scene.detections
        if frame.n_people
    }
    with open_log(logs[kind]) as log:
        found = [frame for frame in log.frames() if frame.n_people]
        joints = joints_of(log.model.marker_names)
        assert log.warnings == ()
    assert len(found) == len(expected) > 70
    slots = {joint: slot for slot, joint in enumerate(joints_of(scene.names))}
    both = [(i, slots[joint]) for i, joint in enumerate(joints) if joint in slots]
    assert len(both) >= 13
    here, there = map(list, zip(*both, strict=True))
    for frame in found:
        other = expected[frame.source, frame.stamp]
        assert frame.frame_id == other.frame_id
        assert frame.log_time == other.log_time
        off = 0 if kind in EXACT else 2e-6
        np.testing.assert_allclose(frame.positions[:, here], other.positions[:, there], atol=off)


@pytest.mark.parametrize("kind", made.KINDS)
def test_one_image_of_each_camera_is_enough(kind, scene, tmp_path):
    firsts = {}
    for topic, frame in scene.detections:
        if frame.n_people == 2:
            firsts.setdefault(topic, frame)
    one = replace(scene, detections=list(firsts.items()))
    path = made.KINDS[kind](tmp_path / ("log.bag" if "bag" in kind else "log.mcap"), one)
    with open_log(path) as log:
        people = {frame.source: frame.n_people for frame in log.frames()}
    assert people == {frame.source: 2 for frame in firsts.values()}


@pytest.mark.parametrize("kind", sorted(made.KINDS.keys() - {"zed 34", "zed 70"}))
def test_every_detector_can_be_processed(kind, logs, tmp_path):
    out = tmp_path / "out.mcap"
    summary = process(logs[kind], out)
    assert len(summary.people) == 2
    assert summary.warnings == ()
    score = score_of(out)
    assert (score.missing, score.false, score.switches) == (0, 0, 0)
    assert score.mean < 45.0  # mm; SkeletonGroups have 30 to 40 here
    assert run(["export", str(out), "-o", str(tmp_path / "joints.csv"), "--quiet"]) == 0


def score_of(out):
    """Scores of the last channel against the truth that was copied."""
    truth = load_truth(out)
    with open_log(out, topics=["/hiros/filtered"], output_prefix="/no") as log:
        return evaluate(log.frames(), truth, log.model)


@pytest.mark.parametrize("reader", detector_readers(), ids=lambda reader: reader.__name__)
def test_every_reader_declines_what_is_not_its_own(reader):
    """One kind of message holds its skeletons only if it looks like it."""
    empty = made.ROS2.serialize_cdr(made.ROS2.types[made.MARKERS]([]), made.MARKERS)
    message = DetectorMessage("/costmap", "x/Y", 0, bytes(empty), lambda data: None)
    assert reader.types
    assert "x/Y" not in reader.types
    if "visualization_msgs/MarkerArray" in reader.types:
        decoded = DetectorMessage(
            "/costmap", "visualization_msgs/MarkerArray", 0, bytes(empty),
            lambda data: made.ROS2.deserialize_cdr(data, made.MARKERS),
        )  # fmt: skip
        assert reader().read(decoded) == []  # it may be of any use
        arrow = made.ROS2.types[made.MARKERS]([made.default("visualization_msgs/msg/Marker")])
        data = bytes(made.ROS2.serialize_cdr(arrow, made.MARKERS))
        assert reader().read(replace(decoded, cdr=data)) is None
    assert list(reader().rest()) == []
    assert message.fields is None


def test_other_markers_are_no_skeletons(tmp_path, scene):
    """A log of SkeletonGroups with markers for RViz in it stays as it is."""
    point = made.default("visualization_msgs/msg/Marker", id=3, type=2)
    data = bytes(made.ROS2.serialize_cdr(made.ROS2.types[made.MARKERS]([point]), made.MARKERS))
    when = scene.detections[0][1].log_time

    def both(scene):
        yield "/plan", made.MARKERS, when, data
        yield from ((t, made.GROUP, when, d) for t, d, when in made.groups(scene))

    with open_log(write_ros2(tmp_path / "log.mcap", scene, both)) as log:
        assert type(log.reader) is McapReader
        assert len(log.cameras) == 3


@pytest.mark.parametrize("namespaces", [("",), ("joint",), ("a", "bcd")])
@pytest.mark.parametrize("seconds", [0, 17])
def test_markers_are_gathered_as_rosbags_decodes_them(namespaces, seconds, scene):
    for _, frame in scene.detections[:20]:
        message = made.azure_message(frame)
        for i, marker in enumerate(message.markers):
            marker.ns = namespaces[i % len(namespaces)]
            marker.text = "t" * (i % 3)
            marker.header.stamp.sec = seconds
        data = bytes(made.ROS2.serialize_cdr(message, made.MARKERS))
        gathered = azure_kinect._gathered(data)
        assert (gathered is None) == (frame.n_people == 0)
        if gathered:
            stamp, frame_id, spaces, ids, kinds, placed = gathered
            markers = made.ROS2.deserialize_cdr(data, made.MARKERS).markers
            assert stamp == seconds * 10**9 + markers[0].header.stamp.nanosec
            assert frame_id == markers[0].header.frame_id
            assert spaces.tolist() == [marker.ns.encode() for marker in markers]
            assert ids.tolist() == [marker.id for marker in markers]
            assert kinds.tolist() == [[marker.type, marker.action] for marker in markers]
            poses = [(m.pose.position, m.pose.orientation) for m in markers]
            numbers = [(p.x, p.y, p.z, q.x, q.y, q.z, q.w) for p, q in poses]
            assert placed.tolist() == [list(row) for row in numbers]
        assert azure_kinect._gathered(data[: len(data) // 2]) is None


def test_messages_without_skeletons_are_counted_and_transforms_are_not(tmp_path, scene):
    def with_arrows(scene):
        arrow = made.ROS2.types[made.MARKERS]([made.default("visualization_msgs/msg/Marker")])
        for topic, name, log_time, data in islice(only("camera_0", azure)(scene), 5):
            yield topic, name, log_time, data
            yield topic, name, log_time, made.ROS2.serialize_cdr(arrow, name)

    def with_humans(scene):
        yield from islice(made.humans(scene), 20)

    for maker, wanted in (
        (with_arrows, ["/camera_0/body_tracking_data: 5 messages"]),
        (with_humans, []),
    ):
        with open_log(write_ros2(tmp_path / f"{maker.__name__}.mcap", scene, maker)) as log:
            assert any(frame.n_people for frame in log.frames())
            remarks = [text for text in log.remarks if "without skeletons" in text]
        assert remarks == [f"{what} without skeletons left out" for what in wanted]


def test_the_joints_of_a_marker_are_those_of_the_sdk(tmp_path, scene):
    assert body_model("azure-kinect").marker_names == scene.names
    assert body_model("azure-kinect").marker_names.index("HEAD") == 26


@pytest.mark.parametrize("name", BODY_MODELS)
def test_feet_with_toes_show_the_facing(name):
    model = body_model(name)
    has_toes = re.search("toe|foot", " ".join(model.marker_names).lower()) is not None
    assert len(FacingMarkers.of(model).feet) == 2 * has_toes


@pytest.mark.parametrize("name", BODY_MODELS)
def test_every_skeleton_is_one_tree(name):
    model = body_model(name)
    loose_heads = "coco-17", "coco-23", "mediapipe-33"
    trees = 2 if name in loose_heads else 1
    assert model.n_links == model.n_markers - trees
    assert len(set(model.link_children)) == model.n_links
    assert len(set(joints_of(model.marker_names))) == model.n_markers
    assert name_of(model) == name


@pytest.mark.parametrize(
    "name",
    ["left shoulder", "LeftShoulder", "SHOULDER_LEFT", "l_shoulder", "LShoulder", "Shoulder.L",
     "shoulder_l", "K4ABT_JOINT_SHOULDER_LEFT", "JOINT_SHOULDER_LEFT", "left-shoulder"],
)  # fmt: skip
def test_a_joint_has_many_names(name):
    sides = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "l_": "r_", "LS": "RS"}
    sides |= {"_l": "_r", ".L": ".R"}
    other = next(name.replace(a, b) for a, b in sides.items() if a in name)
    assert joints_of([name, other]) == [("shoulder", "left"), ("shoulder", "right")]


def test_an_initial_without_its_other_side_is_no_side():
    assert joints_of(["Lumbar", "Ribs"]) == [("lumbar", ""), ("ribs", "")]


@pytest.fixture(scope="module")
def mixed(scene, tmp_path_factory):
    make = together(
        only("camera_0", kinect_v2), only("camera_1", azure), only("camera_2", zed("zed-38"))
    )
    return write_ros2(tmp_path_factory.mktemp("mixed") / "mixed.mcap", scene, make)


def test_different_skeletons_are_fused_by_name(mixed, scene):
    with open_log(mixed) as log:
        frames = [frame for frame in log.frames() if frame.n_people]
        names = log.model.marker_names
        remarks = " ".join(log.remarks)
    assert {frame.source for frame in frames} == {"camera_0", "camera_1", "camera_2"}
    joints = joints_of(names)
    assert len(set(joints)) == len(joints)
    knee = joints.index(("knee", "left"))
    for topic, frame in scene.detections[:30]:
        if frame.n_people:
            same = [f for f in frames if f.source == frame.source and f.stamp == frame.stamp]
            expected = frame.positions[:, scene.names.index("KNEE_LEFT")]
            np.testing.assert_allclose(same[0].positions[:, knee], expected, atol=2e-6), topic
    assert "kinect-v2: /camera_0/skeletons" in remarks
    assert "results have their union" in remarks


def test_results_have_the_skeleton_that_was_chosen(mixed, tmp_path):
    config = load_config(None, ["input.model=zed-18"])
    summary = process(mixed, tmp_path / "out.mcap", config=config)
    with open_log(tmp_path / "out.mcap", topics=["/hiros/filtered"], output_prefix="/no") as log:
        assert set(log.model.marker_names) == set(body_model("zed-18").marker_names)
    assert len(summary.people) == 2
    left_out = [note for note in summary.notes if "has no place for" in note]
    assert any("HANDTIP_LEFT" in note for note in left_out), summary.notes


def test_the_skeleton_of_a_camera_can_be_chosen(mixed):
    with open_log(mixed, skeletons=Selection("/camera_0/skeletons")) as log:
        assert set(log.model.marker_names) <= set(body_model("kinect-v2").marker_names)


def test_an_unknown_skeleton_names_the_known_ones(mixed):
    with pytest.raises(ConfigError, match=r"no skeleton model 'kinect'.*kinect-v2.*/camera_0"):
        open_log(mixed, skeletons=Selection("kinect"))


def test_cameras_left_out_do_not_change_the_skeleton(mixed):
    with open_log(mixed, topics=["/camera_1/*"]) as log:
        assert log.model.marker_names == body_model("azure-kinect").marker_names
        assert len(log.cameras) == 1


def test_a_union_has_every_joint_once_and_stays_a_tree():
    models = [body_model(name) for name in ("azure-kinect", "kinect-v2", "zed-70", "ros4hri")]
    model = union_of(models)
    every = {joint for one in models for joint in joints_of(one.marker_names)}
    assert sorted(joints_of(model.marker_names)) == sorted(every)
    assert len(set(model.link_children)) == model.n_links == model.n_markers - 1
    assert len(set(model.link_names)) == model.n_links


@pytest.mark.parametrize(("factor", "unit"), [(1000.0, "mm"), (100.0, "cm")])
def test_a_wrong_unit_is_noticed_and_can_be_given(factor, unit, tmp_path, scene):
    large = Scene(
        scene.path,
        [(t, f.replace(markers=f.markers * factor)) for t, f in scene.detections[:60]],
        scene.names,
        scene.others,
    )
    path = write_ros2(tmp_path / "large.mcap", large, azure)
    with open_log(path) as log:
        assert len(log.warnings) == 3
        assert (
            f"the positions are in {unit}, not in m; read them with --unit {unit}"
            in (log.warnings[0])
        )
    with open_log(path, skeletons=Selection(unit=unit)) as log:
        assert log.warnings == ()
        frame = next(frame for frame in log.frames() if frame.n_people)
    expected = next(f for _, f in scene.detections if f.n_people and f.source == frame.source)
    np.testing.assert_allclose(frame.positions, expected.positions, atol=1e-9)


@pytest.mark.parametrize(
    ("size", "unit"),
    [(1.7, "m"), (0.2, "m"), (4.0, "m"), (1700.0, "mm"), (500.0, "mm"), (170.0, "cm"),
     (0.0017, ""), (float("nan"), "m")],
)  # fmt: skip
def test_units_by_the_size_of_people(size, unit):
    assert unit_of(size) == unit


def test_messages_that_cannot_be_decoded_are_counted(tmp_path, scene):
    def damaged(scene):
        for i, (topic, name, time, data) in enumerate(azure(scene)):
            yield topic, name, time, data[: len(data) // 2] if i in (40, 50) else data

    path = write_ros2(tmp_path / "log.mcap", scene, damaged)
    skipped = overview_of(path).skipped
    assert sum(n for reasons in skipped.values() for n in reasons.values()) == 2
    assert run(["process", str(path), "-o", str(tmp_path / "o.mcap"), "--strict", "-q"]) == 2


def test_info_says_how_the_log_is_read(logs, capsys):
    assert run(["info", str(logs["zed 38"])]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "zed_msgs/msg/ObjectsStamped read as skeletons (zed-38)" in out


def test_a_log_of_nothing_known_says_what_it_has(tmp_path, scene):
    path = write_ros2(tmp_path / "log.mcap", scene, lambda scene: iter(()))
    with pytest.raises(LogError, match=r"no detections of cameras|has no"):
        open_log(path)


def test_the_percents_of_the_zed_are_shares(logs):
    with open_log(logs["zed 38"]) as log:
        shares = np.concatenate([frame.confidences for frame in log.detections()])
    assert len(shares) > 0
    np.testing.assert_allclose(shares, 0.8)  # the driver says 80.0


DOCS = Path(__file__).parents[2] / "docs" / "detectors.md"
LAB = """\
std_msgs/Header header
int32[] ids
float32[] points
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def test_the_reader_of_the_documentation_reads(tmp_path, scene, monkeypatch):
    """It is 40 lines long at most, and registered for the rest of the program."""
    monkeypatch.setattr(detectors, "_READERS", list(detectors._READERS))
    (code,) = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    assert len(code.strip().splitlines()) <= 40
    names: dict[str, Any] = {}
    exec(code, names)
    store = made.store_of({"lab_msgs/msg/Bodies": LAB})
    slots = [joints_of(scene.names).index(joint) for joint in joints_of(names["JOINTS"])]
    frames = [frame for _, frame in scene.detections if frame.n_people]
    path = tmp_path / "lab.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        schema = writer.register_schema("lab_msgs/msg/Bodies", "ros2msg", LAB.encode())
        for camera in ("camera_0", "camera_1"):
            channel = writer.register_channel(f"/{camera}/bodies", "cdr", schema)
            for frame in (frame for frame in frames if frame.source == camera):
                points = 1000 * frame.positions[:, slots]
                bodies = store.types["lab_msgs/msg/Bodies"](
                    made.header(made.stamp_of(frame), camera, store),
                    np.arange(frame.n_people, dtype=np.int32),
                    points.astype(np.float32).ravel(),
                )
                data = bytes(store.serialize_cdr(bodies, "lab_msgs/msg/Bodies"))
                writer.add_message(channel, frame.log_time, data, frame.log_time)
        writer.finish()
    with open_log(path) as log:
        assert log.model.n_links == 6
        found = [frame for frame in log.frames() if frame.source == "camera_0"]
    expected = [frame for frame in frames if frame.source == "camera_0"]
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a.positions, b.positions[:, slots], atol=1e-5)
    monkeypatch.setattr(names["LabBodies"], "read", lambda self, message: [message])
    with pytest.raises(ConfigError, match="LabBodies gives DetectorMessage where SeenPeople of"):
        open_log(path)


@pytest.mark.parametrize(
    ("value", "fault"),
    [
        ("nowhere.reader:Lab", "cannot be loaded: No module named 'nowhere'"),
        ("os:path", "is no DetectorReader"),
    ],
)
def test_a_reader_that_cannot_be_loaded_is_named(value, fault, monkeypatch):
    point = EntryPoint("lab", value, plugins.DETECTORS)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [point])
    for cached in (plugins.installed, detectors._installed):
        cached.cache_clear()
    words = f"the detector reader lab ({value}) of a package without a name {fault}; install"
    with pytest.raises(ConfigError, match=re.escape(words)):
        detector_readers()
    for cached in (plugins.installed, detectors._installed):
        cached.cache_clear()


# Azure Kinect: which markers are bodies


OLD_SDK = [j for j in range(32) if j not in (8, 9, 10, 15, 16, 17)]
"""Joints of today's SDK in the order of the first SDKs."""


def with_spheres(kept, topic="body_tracking_data"):
    """MarkerArrays with some of the spheres; ``kept`` is the new number of each joint."""

    def make(scene):
        for row in azure(scene):
            spheres = made.markers_of(row)
            for one in spheres:
                one.id = one.id - one.id % 100 + kept.get(one.id % 100, -1)
            some = [one for one in spheres if one.id % 100 != 99]
            name = row[0].replace("body_tracking_data", topic)
            yield (name, *made.with_markers(row, some)[1:])

    return make


TRUSTED = [0, 1, 2, 3, 5, 12, 18, 22, 26]
FEWER = {
    "an old SDK": ({j: k for k, j in enumerate(OLD_SDK)}, "body_tracking_data", 26),
    "an old SDK, renamed": ({j: k for k, j in enumerate(OLD_SDK)}, "people", 26),
    "no head": ({j: j for j in range(26)}, "body_tracking_data", 26),
    "no hands": ({j: j for j in OLD_SDK}, "people", 26),
    "trusted": ({j: j for j in TRUSTED}, "body_tracking_data", 9),
}


@pytest.mark.parametrize("case", FEWER)
def test_fewer_joints_are_told_by_their_ids(case, logs, scene, tmp_path):
    kept, topic, n = FEWER[case]
    path = write_ros2(tmp_path / "log.mcap", scene, with_spheres(kept, topic))
    with open_log(path) as log, open_log(logs["azure kinect"]) as whole:
        assert log.model.n_markers == n
        slots = [whole.model.marker_names.index(name) for name in log.model.marker_names]
        for frame, other in zip(log.detections(), whole.detections(), strict=True):
            np.testing.assert_array_equal(frame.positions, other.positions[:, slots])
        assert any("joints" in text and "/camera_0/" in text for text in log.remarks)


def with_texts(spheres):
    text = made.default("visualization_msgs/msg/Marker", header=spheres[0].header, id=5, type=9)
    line = made.default("visualization_msgs/msg/Marker", header=spheres[0].header, id=9000, type=5)
    return [text, *spheres, line]


def numbered_from_0(spheres, space="body_{}"):
    for one in spheres:
        one.ns, one.id = space.format(one.id // 100), one.id % 100
    return spheres


DRAWN = {
    "text and lines": with_texts,
    "a namespace per body": numbered_from_0,
    "ids come again": lambda spheres: numbered_from_0(spheres, ""),
    "text in namespaces": lambda spheres: with_texts(numbered_from_0(spheres)),
}


@pytest.mark.parametrize("case", DRAWN)
def test_spheres_are_read_whatever_is_drawn_beside_them(case, logs, scene, tmp_path):
    def drawn(scene):
        for row in azure(scene):
            spheres = made.markers_of(row)
            yield made.with_markers(row, DRAWN[case](spheres) if spheres else [])

    path = write_ros2(tmp_path / "log.mcap", scene, drawn)
    with open_log(path) as log, open_log(logs["azure kinect"]) as whole:
        frames = list(log.detections())
        for frame, other in zip(frames, whole.detections(), strict=True):
            np.testing.assert_array_equal(frame.positions, other.positions)
        said = [text for text in log.remarks if "left out that are no spheres" in text]
        assert (len(said) == 3) == ("text" in case)
    ids = {tuple(frame.ids) for frame in frames if frame.n_people == 2}
    assert len(ids) == 1 and all(one != other for one, other in ids)


def test_too_few_spheres_are_counted_in_the_error(scene, tmp_path, capsys):
    kept = {j: j for j in TRUSTED}
    path = write_ros2(tmp_path / "log.mcap", scene, with_spheres(kept, "spheres"))
    with pytest.raises(LogError, match=r"/camera_0/spheres: .*: 9 markers a body, 32 are read"):
        open_log(path)
    assert run(["info", str(path)]) == 0
    assert "9 markers a body, 32 are read" in " ".join(capsys.readouterr().out.split())
    assert run(["process", str(path), "-o", str(tmp_path / "out.mcap")]) == 2
    assert not (tmp_path / "out.mcap").exists()


def test_ids_in_a_row_are_no_joints(scene, tmp_path):
    def in_a_row(scene):
        for row in azure(scene):
            spheres = made.markers_of(row)
            for k, one in enumerate(spheres):
                one.id = k
            yield made.with_markers(row, spheres)

    path = write_ros2(tmp_path / "log.mcap", scene, in_a_row)
    with pytest.raises(LogError, match=r"ids should be body \* 100 \+ joint"):
        open_log(path)


# yolo_ros: keypoints in space


YOLO = hiros_schemas.DETECTION_ARRAY
FLAT = r"(?m)^yolo_msgs/(BoundingBox.D|Mask|KeyPoint2DArray) \w+\n"
ONLY_IN_SPACE = re.sub(FLAT, "", hiros_schemas.text(YOLO))


def detections(frame, names, store, in_space=True):
    """A DetectionArray of yolo_ros; it leaves out joints without a depth."""
    kind = {name: store.types[f"yolo_msgs/msg/{name}"] for name in ("KeyPoint3D", "Detection")}
    point, found = store.types["geometry_msgs/msg/Point"], []
    for joints in points_in(frame, names, "coco-17") if in_space else []:
        seen = [(k, row) for k, row in enumerate(joints.tolist(), 1) if not np.isnan(row[0])]
        points = [kind["KeyPoint3D"](k, point(*row), 0.5) for k, row in seen]
        where = made.default(
            "yolo_msgs/msg/KeyPoint3DArray", store, data=points, frame_id=frame.frame_id
        )
        found.append(
            made.default("yolo_msgs/msg/Detection", store, score=0.8, id="3", keypoints3d=where)
        )
    header = made.header(made.stamp_of(frame), "colour", store)
    return store.types[YOLO](header, found)


@pytest.mark.parametrize("text", [hiros_schemas.text(YOLO), ONLY_IN_SPACE], ids=["all", "3D"])
def test_keypoints_in_space_are_skeletons(text, scene, tmp_path):
    store = made.store_of({YOLO: text})

    def yolo(scene):
        for k, (topic, frame) in enumerate(scene.detections):
            data = store.serialize_cdr(detections(frame, scene.names, store, k % 7 > 0), YOLO)
            yield topic.replace("skeletons", "yolo"), YOLO, frame.log_time, bytes(data)

    with open_log(write_ros2(tmp_path / "log.mcap", scene, yolo, {YOLO: text})) as log:
        frames = list(log.frames())
        assert log.model.marker_names == body_model("coco-17").marker_names
        assert log.fixed_frame == "world"
    for k, (frame, (_, given)) in enumerate(zip(frames, scene.detections, strict=True)):
        assert frame.n_people == given.n_people * (k % 7 > 0)
        if frame.n_people:
            expected = points_in(given, scene.names, "coco-17")
            np.testing.assert_array_equal(frame.positions, expected)
            assert frame.frame_id == given.frame_id
            assert set(frame.ids) == {3}


@pytest.mark.parametrize("kind", ["geometry_msgs/msg/PoseArray", "opt_msgs/msg/SkeletonArray"])
def test_a_log_of_unknown_types_names_the_reader_of_your_own(kind, tmp_path, capsys):
    with McapWriter(tmp_path / "log.mcap") as writer:
        channel = writer.add_channel("/camera_0/people", writer.add_schema(kind, b"int8 x"))
        writer.write(channel, 5, bytes(8))
        writer.commit()
    assert run(["process", str(tmp_path / "log.mcap")]) == 2
    text = capsys.readouterr().err
    assert "write a reader of your own (docs/detectors.md; entry point hiros.detectors)" in text
    assert f"/camera_0/people ({kind}, 1)" in text
    assert "hiros import" not in text


# ZED and ROS4HRI: what cannot be true


def test_a_body_that_the_zed_only_guesses_is_not_trusted(scene, tmp_path):
    def change(message):
        for one in message.objects[:1]:
            one.tracking_state, one.label_id = 2, -5

    def guessed(scene):
        return (made.with_objects(row, change) for row in zed("zed-38")(scene))

    with open_log(write_ros2(tmp_path / "log.mcap", scene, guessed)) as log:
        frames = [frame for frame in log.detections() if frame.n_people == 2]
    assert len(frames) > 20
    for frame in frames:
        assert frame.ids[0] == -1
        assert frame.confidences.tolist() == pytest.approx([0.0, 0.8])
        assert not np.isnan(frame.positions[0]).all()
        assert np.nanmax(frame.marker_confidences[0]) == 0.0


def chained(n):
    """The rows of a body of which all joints are below a chain of so many frames."""
    chain = ["body", *(f"f{k}" for k in range(n))]
    rows = [("camera_0", "body_x", (0, 0, 3), (0, 0, 0, 1))]
    rows += [(f"{a}_x", f"{b}_x", (0, 0, 0.002), (0, 0, 0, 1)) for a, b in pairwise(chain)]
    names = body_model("ros4hri").marker_names[1:]
    return rows + [
        (f"{chain[-1]}_x", f"{name}_x", (k, 0, 0), (0, 0, 0, 1)) for k, name in enumerate(names)
    ]


def test_a_chain_of_frames_is_read(scene, tmp_path):
    def humans(scene):
        for t in range(2):
            stamp = 1_700_000_000_000_000_000 + t * 100_000_000
            yield "/tf", made.TF, stamp, made.tf_message(stamp, chained(150))

    with open_log(write_ros2(tmp_path / "log.mcap", scene, humans)) as log:
        (frame, *_) = [frame for frame in log.frames() if frame.n_people]
    assert frame.positions[0, 5, 2] == pytest.approx(3.3)


@pytest.mark.parametrize(
    ("n", "said"),
    [
        (300, "/tf: 4 messages left out; the first one: body_x has 315 frames, more than the 200"),
        (3000, "/tf: 4 messages left out; the first one: a tf message has 3015 frames; at most"),
    ],
)
def test_a_body_with_more_frames_than_any_human_is_left_out(n, said, scene, tmp_path):
    def both(scene):
        for k, row in enumerate(made.humans(scene)):
            yield from [row, (*row[:3], made.tf_message(row[2], chained(n)))][: 1 + (k % 40 == 0)]

    with open_log(write_ros2(tmp_path / "log.mcap", scene, both)) as log:
        assert next(text for text in log.warnings if "/tf:" in text).startswith(said)
        found = [frame.positions for frame in log.detections()]
    with open_log(write_ros2(tmp_path / "healthy.mcap", scene, made.humans)) as log:
        for frame, positions in zip(log.detections(), found, strict=True):
            np.testing.assert_array_equal(frame.positions, positions)
