"""One simulated scene as the logs of other detectors: the bytes that their drivers write."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

import hiros_schemas
from hiros_mcap.io.channels import TRUTH_PREFIX
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.detectors.body_models import body_model, joints_of
from hiros_mcap.io.log import open_log
from hiros_mcap.simulate.settings import SimulateParams
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.skeletons import Frame

NANO = 1_000_000_000
MARKERS, OBJECTS = hiros_schemas.MARKER_ARRAY, hiros_schemas.OBJECTS_STAMPED
GROUP, STAMPED = hiros_schemas.SKELETON_GROUP, hiros_schemas.STAMPED_SKELETON
TF = hiros_schemas.TF_MESSAGE
# visualization_msgs/Marker of ROS 1 (Noetic): without the textures of ROS 2.
MARKERS_ROS1 = """\
visualization_msgs/Marker[] markers
================================================================================
MSG: visualization_msgs/Marker
Header header
string ns
int32 id
int32 type
int32 action
geometry_msgs/Pose pose
geometry_msgs/Vector3 scale
std_msgs/ColorRGBA color
duration lifetime
bool frame_locked
geometry_msgs/Point[] points
std_msgs/ColorRGBA[] colors
string text
string mesh_resource
bool mesh_use_embedded_materials
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
================================================================================
MSG: std_msgs/ColorRGBA
float32 r
float32 g
float32 b
float32 a
"""


@dataclass(frozen=True)
class Scene:
    """A simulated log of SkeletonGroups and what is in it."""

    path: Path
    detections: list[tuple[str, Frame]]
    """Topic and frame, in the camera's coordinates."""
    names: tuple[str, ...]
    others: list[tuple[str, str, int, bytes]]
    """Topic, type, log time and CDR of the transforms and the truth."""


def scene(path, **params):
    """Simulate a scene; orientations of the links are left out, since others have none."""
    write_log(path, SimulateParams.model_validate(params))
    with open_log(path) as log:
        topics = {next(iter(c.sources.values())): c.channel.topic for c in log.cameras}
        found = [(topics[frame.source], frame) for frame in log.frames()]
        names = log.model.marker_names
    with McapReader(path) as reader:
        kept = {
            i: (c.topic, schema.name)
            for i, c in reader.channels.items()
            if c.topic.startswith((TRUTH_PREFIX, "/tf")) and (schema := reader.schema(c))
        }
        others = [(*kept[m.channel_id], m.log_time, bytes(m.data)) for m in reader.messages(kept)]
    return Scene(path, found, names, others)


def store_of(texts, base=Stores.ROS2_HUMBLE):
    store = get_typestore(base)
    for name, text in texts.items():
        types = get_types_from_msg(text, name)
        store.register({k: v for k, v in types.items() if k not in store.fielddefs})
    return store


ROS2 = store_of({name: hiros_schemas.text(name) for name in (MARKERS, OBJECTS, GROUP, STAMPED, TF)})
ROS1 = store_of({GROUP: hiros_schemas.text(GROUP), TF: hiros_schemas.text(TF)}, Stores.ROS1_NOETIC)

Made = Iterator[tuple[str, str, int, bytes]]
"""Topic, type, log time, CDR."""


def default(name, store=ROS2, **values):
    """Make a message whose other fields are 0, "" and empty; nobody may change what is in them."""
    fields = _defaults(name, store)
    assert values.keys() <= fields.keys(), values
    return store.types[name](**{**fields, **values})


@cache
def _defaults(name, store):
    """Value of each field of a message type."""
    return {field: _empty(*kind, store) for field, kind in store.fielddefs[name][1]}


def _empty(node, desc, store):
    """The value of a field that nobody sets."""
    if node.name == "BASE":
        return {"string": "", "bool": False}.get(desc[0], 0)
    if node.name == "NAME":
        return default(desc, store)
    inner, n = desc if node.name == "ARRAY" else (desc[0], 0)
    if inner[0].name == "NAME":
        return [default(inner[1], store) for _ in range(n)]
    return np.zeros(n, inner[1][0])


def header(stamp, frame_id, store=ROS2):
    time = store.types["builtin_interfaces/msg/Time"](stamp // NANO, stamp % NANO)
    return default("std_msgs/msg/Header", store, stamp=time, frame_id=frame_id)


def stamp_of(frame):
    return max(frame.stamps.tolist(), default=frame.stamp)


def points_in(frame, names, model):
    """(P, M, 3) positions in the order of another model; NaN where the scene has no such joint."""
    slots = {joint: slot for slot, joint in enumerate(joints_of(names))}
    wanted = joints_of(body_model(model).marker_names)
    points = np.full((frame.n_people, len(wanted), 3), np.nan)
    for to, joint in enumerate(wanted):
        if joint in slots:
            points[:, to] = frame.positions[:, slots[joint]]
    return points


def azure_message(frame, store=ROS2):
    """Make the MarkerArray of one capture."""
    marker = "visualization_msgs/msg/Marker"
    point, turn = (
        store.types["geometry_msgs/msg/Point"],
        store.types["geometry_msgs/msg/Quaternion"],
    )
    pose = store.types["geometry_msgs/msg/Pose"]
    markers = [
        default(
            marker,
            store,
            header=header(stamp_of(frame), frame.frame_id, store),
            id=(7 + body) * 100 + joint,
            type=2,
            pose=pose(point(*map(float, xyz)), turn(0.0, 0.0, 0.0, 1.0)),
        )
        for body, joints in enumerate(frame.positions)
        for joint, xyz in enumerate(joints)
    ]
    return store.types[MARKERS](markers)


def azure(scene):
    """The Azure Kinect ROS driver on ROS 2."""
    for topic, frame in scene.detections:
        data = ROS2.serialize_cdr(azure_message(frame), MARKERS)
        yield topic.replace("skeletons", "body_tracking_data"), MARKERS, frame.log_time, bytes(data)


def zed(model):
    """The ZED ROS 2 wrapper with a body format."""
    body_format = ("zed-18", "zed-34", "zed-38", "zed-70").index(model)

    def make(scene):
        keypoint, skeleton = "zed_msgs/msg/Keypoint3D", "zed_msgs/msg/Skeleton3D"
        for topic, frame in scene.detections:
            objects = []
            for i, joints in enumerate(points_in(frame, scene.names, model)):
                rest = np.zeros((70 - len(joints), 3))
                keypoints = [
                    ROS2.types[keypoint](row.astype(np.float32)) for row in [*joints, *rest]
                ]
                objects.append(
                    default(
                        "zed_msgs/msg/Object",
                        label="Body",
                        label_id=i,
                        confidence=80.0,
                        skeleton_available=True,
                        body_format=body_format,
                        skeleton_3d=ROS2.types[skeleton](keypoints),
                    )
                )
            message = default(
                OBJECTS, header=header(stamp_of(frame), frame.frame_id), objects=objects
            )
            data = bytes(ROS2.serialize_cdr(message, OBJECTS))
            yield topic.replace("skeletons", "body_trk/skeletons"), OBJECTS, frame.log_time, data

    return make


def stamped(scene):
    """One StampedSkeleton per person."""
    for topic, data, log_time in groups(scene):
        group = ROS2.deserialize_cdr(data, GROUP)
        for person in group.skeletons:
            values = {n: getattr(person, n) for n, _ in ROS2.fielddefs[STAMPED][1] if n != "header"}
            one = default(STAMPED, header=group.header, **values)
            yield topic, STAMPED, log_time, bytes(ROS2.serialize_cdr(one, STAMPED))


def humans(scene):
    """ROS4HRI: the frames of human_description below body_<id>, and the ids that are tracked."""
    model = body_model("ros4hri")
    parents = {child: parent for parent, child in model.links.tolist()}
    for _, frame in scene.detections:
        for person, joints in enumerate(points_in(frame, scene.names, "ros4hri")):
            joints[1] = (joints[3] + joints[6]) / 2  # the torso's frame is between the shoulders
            body = f"{frame.source[-1]}{person + 10:04d}"
            turns = [Rotation.from_rotvec([0.3 * k, 0.7, -0.2 * k]) for k in range(len(joints))]
            rows = []
            for joint, name in enumerate(model.marker_names):
                above, at, turn = frame.frame_id, joints[joint], turns[joint]
                if joint in parents:
                    parent = parents[joint]
                    above, back = f"{model.marker_names[parent]}_{body}", turns[parent].inv()
                    at, turn = back.apply(at - joints[parent]), back * turn
                rows.append((above, f"{name}_{body}", at, turn.as_quat()))
            yield "/tf", TF, frame.log_time, tf_message(stamp_of(frame), rows)


def tf_message(stamp, rows):
    types = [ROS2.types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Quaternion")]
    transform, pose = (ROS2.types[f"geometry_msgs/msg/Transform{s}"] for s in ("Stamped", ""))
    found = [
        transform(
            header(stamp, parent),
            child,
            pose(*(kind(*map(float, x)) for kind, x in zip(types, (at, xyzw), strict=True))),
        )
        for parent, child, at, xyzw in rows
    ]
    return bytes(ROS2.serialize_cdr(ROS2.types[TF](found), TF))


def groups(scene):
    with McapReader(scene.path) as reader:
        topics = {i: c.topic for i, c in reader.channels.items() if c.topic.startswith("/camera")}
        for m in reader.messages(topics):
            yield topics[m.channel_id], bytes(m.data), m.log_time


def write_ros2(path, scene, make, texts=None):
    """Write a log in MCAP by the mcap library; ``texts`` are definitions of other releases."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        channels: dict[tuple[str, str], int] = {}
        for topic, name, log_time, data in [*scene.others, *make(scene)]:
            if (topic, name) not in channels:
                text = (texts or {}).get(name) or hiros_schemas.text(name)
                schema = writer.register_schema(name, "ros2msg", text.encode())
                channels[topic, name] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic, name], log_time, data, log_time)
        writer.finish()
    return path


def ros1_messages(scene):
    """SkeletonGroups and transforms as ROS 1 writes them, with the Header's seq."""
    for topic, data, log_time in groups(scene):
        yield topic, GROUP, log_time, bytes(ROS2.cdr_to_ros1(data, GROUP))
    for topic, name, log_time, data in scene.others:
        yield topic, name, log_time, bytes(ROS2.cdr_to_ros1(data, name))


def write_ros1_mcap(path, scene):
    """ROS 1 messages in MCAP, as ``mcap convert`` makes them of a bag."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros1", "test")
        channels: dict[tuple[str, str], int] = {}
        for topic, name, log_time, data in ros1_messages(scene):
            if (topic, name) not in channels:
                text = ROS1.generate_msgdef(name, ros_version=1)[0].encode()
                schema = writer.register_schema(name.replace("/msg/", "/"), "ros1msg", text)
                channels[topic, name] = writer.register_channel(topic, "ros1", schema)
            writer.add_message(channels[topic, name], log_time, data, log_time)
        writer.finish()
    return path


def write_ros1_bag(path, scene):
    """MarkerArrays of the Azure Kinect's original driver in a ROS 1 bag."""
    texts = {MARKERS: MARKERS_ROS1, **{name: hiros_schemas.text(name) for name in (TF, GROUP)}}
    store = store_of(texts, Stores.ROS1_NOETIC)
    rows = [
        (topic.replace("skeletons", "body_tracking_data"), MARKERS, frame.log_time,
         bytes(store.serialize_ros1(azure_message(frame, store), MARKERS)))
        for topic, frame in scene.detections
    ]  # fmt: skip
    rows += [row for row in ros1_messages(scene) if not row[0].startswith("/camera")]
    with Bag1Writer(path) as writer:
        connections: dict[str, Any] = {}
        for topic, name, log_time, data in sorted(rows, key=lambda row: row[2]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], log_time, data)
    return path


def write_native(path, scene):
    return scene.path


KINDS: dict[str, Callable[[Path, Scene], Path]] = {
    "skeleton groups": write_native,
    "stamped skeletons": lambda path, scene: write_ros2(path, scene, stamped),
    "ros1 in mcap": write_ros1_mcap,
    "azure kinect": lambda path, scene: write_ros2(path, scene, azure),
    "azure kinect in a ros1 bag": write_ros1_bag,
    "zed 18": lambda path, scene: write_ros2(path, scene, zed("zed-18")),
    "zed 34": lambda path, scene: write_ros2(path, scene, zed("zed-34")),
    "zed 38": lambda path, scene: write_ros2(path, scene, zed("zed-38")),
    "zed 70": lambda path, scene: write_ros2(path, scene, zed("zed-70")),
    "ros4hri": lambda path, scene: write_ros2(path, scene, humans),
}
"""Writers of the scene's log, by kind."""


def kinect_v2(scene):
    """SkeletonGroups with the joints of a Kinect v2."""
    model = body_model("kinect-v2")
    encoder = Encoder(model)
    for topic, frame in scene.detections:
        made = Frame.empty(
            frame.n_people, model, stamp=stamp_of(frame), source=frame.source,
            frame_id=frame.frame_id,
        )  # fmt: skip
        made.markers[:, :, :3] = points_in(frame, scene.names, "kinect-v2")
        made.link_confidences[:] = 1.0
        yield topic, GROUP, frame.log_time, encoder.encode(made)


def only(camera, make):
    """One camera of a scene."""

    def made(scene):
        yield from (row for row in make(scene) if row[0].startswith(f"/{camera}/"))

    return made


def together(*makers):
    """Several detectors in one log."""
    return lambda scene: (row for make in makers for row in make(scene))


# What drivers send besides: nobody is in view, or a message is of another kind. All is of camera_0.

Odd = Callable[[list[Any]], Iterator[tuple[str, str, int, bytes]]]
"""Rows of a log in -> rows of a log out."""


def markers_of(row):
    return ROS2.deserialize_cdr(row[3], MARKERS).markers


def with_markers(row, markers):
    data = ROS2.serialize_cdr(ROS2.types[MARKERS](list(markers)), MARKERS)
    return (*row[:3], bytes(data))


def with_objects(row, change):
    message = ROS2.deserialize_cdr(row[3], OBJECTS)
    change(message)
    return (*row[:3], bytes(ROS2.serialize_cdr(message, OBJECTS)))


def some_rows(change, chosen, camera="camera_0"):
    """Change some messages of a camera, which are numbered from 0; None leaves one out."""

    def odd(rows):
        n = 0
        for row in rows:
            if row[0].startswith(f"/{camera}/"):
                n += 1
                row = change(row) if chosen(n - 1) else row
            yield row

    return odd


def deletes_all(row):
    """A message that clears the screen has an empty header, and no id or pose."""
    return with_markers(row, [default("visualization_msgs/msg/Marker", action=3)])


def clears_before(row):
    deletion = default("visualization_msgs/msg/Marker", action=3)
    return with_markers(row, [deletion, *markers_of(row)])


def no_markers(row):
    return with_markers(row, [])


def one_more(row):
    return with_markers(row, [*markers_of(row), default("visualization_msgs/msg/Marker", type=9)])


def one_less(row):
    return with_markers(row, [m for m in markers_of(row) if m.id % 100 != 16])


def no_objects(row):
    return with_objects(row, lambda message: setattr(message, "objects", []))


def only_things(row):
    def change(message):
        for one in message.objects:
            one.skeleton_available = False

    return with_objects(row, change)


def first(n):
    return lambda k: k < n


def middle(k):
    return k % 5 == 3


ODD_AZURE: dict[str, Odd] = {
    "no markers at first": some_rows(no_markers, first(1)),
    "nobody for half a second": some_rows(no_markers, first(8)),
    "no markers in between": some_rows(no_markers, middle),
    "a deletion at first": some_rows(deletes_all, first(3)),
    "deletions in between": some_rows(deletes_all, middle),
    "a deletion in every message": some_rows(clears_before, lambda k: True),
    "one marker more": some_rows(one_more, middle),
    "one joint less": some_rows(one_less, middle),
    "nobody in the whole log": some_rows(no_markers, lambda k: True),
}
ODD_ZED: dict[str, Odd] = {
    "nobody at first": some_rows(no_objects, first(1)),
    "nobody for half a second": some_rows(no_objects, first(8)),
    "nobody in between": some_rows(no_objects, middle),
    "no skeletons at first": some_rows(only_things, first(3)),
    "no skeletons in between": some_rows(only_things, middle),
    "nobody in the whole log": some_rows(no_objects, lambda k: True),
}


def write_odd(path, scene, make, odd):
    """Write a scene's log with some odd messages."""
    return write_ros2(path, scene, lambda scene: odd(list(make(scene))))
