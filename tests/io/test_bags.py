"""Bags of other kinds than MCAP, made by rosbags, say what the same MCAP says."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from detector_logs import store_of
from generators import same
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.typesys import Stores

import hiros_mcap
import hiros_schemas
from hiros_cli.app import run
from hiros_mcap.errors import LogError
from hiros_mcap.io.channels import LATCHED_QOS, ChannelInfo, channels_of, needs_latching
from hiros_mcap.io.container import Channel, McapReader, McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.running.overview import overview_of

pytestmark = pytest.mark.usefixtures("nothing_left")
SKELETONS, TF = hiros_schemas.SKELETON_GROUP, hiros_schemas.TF_MESSAGE
SAMPLE = Path(__file__).parents[2] / "sample_data" / "one_person_walking.mcap"
TEXTS = {name: hiros_schemas.text(name) for name in (SKELETONS, TF)}
ENDLESS = QosTime(9223372036, 854775807)
LATCHED = Qos(
    QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, ENDLESS,
    ENDLESS, QosLiveliness.AUTOMATIC, ENDLESS, False,
)  # fmt: skip

Message = tuple[str, str, int, bytes]


@pytest.fixture(scope="module")
def messages():
    """(topic, type, time, CDR) of a sample log's detections and transforms, and a string."""
    with McapReader(SAMPLE) as reader:
        names = {
            i: schema.name
            for i, channel in reader.channels.items()
            if (schema := reader.schema(channel)) and not channel.topic.startswith("/truth")
        }
        found = [
            (reader.channels[m.channel_id].topic, names[m.channel_id], m.log_time, bytes(m.data))
            for m in reader.messages(names)
        ]
    text = b"\0\1\0\0\6\0\0\0hello\0"
    return [*found[:80], ("/chatter", "std_msgs/msg/String", found[79][2], text)]


def rosbag2_folder(folder, messages, version, plugin):
    store = store_of(TEXTS)
    with rosbag2.Writer(folder, version=version, storage_plugin=plugin) as writer:
        connections = {}
        for topic, name, time, data in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, name, typestore=store, offered_qos_profiles=[LATCHED]
                )
            writer.write(connections[topic], time, data)
    return folder


def sqlite(folder, messages):
    return rosbag2_folder(folder / "bag", messages, 9, rosbag2.StoragePlugin.SQLITE3)


def sqlite_without_definitions(folder, messages):
    return rosbag2_folder(folder / "bag", messages, 8, rosbag2.StoragePlugin.SQLITE3)


def bare_db3(folder, messages):
    (file,) = sqlite(folder, messages).glob("*.db3")
    return file


def ros1_bag(folder, messages):
    ros1, ros2 = store_of(TEXTS, Stores.ROS1_NOETIC), store_of(TEXTS)
    path = folder / "lab.bag"
    with rosbag1.Writer(path) as writer:
        connections = {}
        for topic, name, time, data in messages:
            raw = bytes(ros2.cdr_to_ros1(data, name))  # with the Header's seq, which ROS 2 lacks
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=ros1)
            writer.write(connections[topic], time, raw)
    return path


MAKERS = [sqlite, sqlite_without_definitions, bare_db3, ros1_bag]


@pytest.fixture(params=MAKERS, ids=lambda maker: maker.__name__)
def bag(request, tmp_path, messages):
    maker: Callable[[Path, list[Message]], Path] = request.param
    return maker(tmp_path, messages)


def test_a_bag_says_what_the_mcap_says(bag, messages):
    with open_log(SAMPLE) as log:
        expected = [f for f, m in zip(log.detections(), messages, strict=False) if m]
    with open_log(bag) as log:
        found = list(log.detections())
        assert log.path == bag
        assert log.left_out == {"/chatter": ("std_msgs/msg/String", 1)}
        assert {i.topic for i in log.channels} == {m[0] for m in messages[:-1]}
    assert len(found) == sum(m[1] == SKELETONS for m in messages) > 70
    for a, b in zip(found, expected, strict=False):
        assert same(a, b)
        assert a.log_time == b.log_time


@pytest.mark.parametrize("maker", MAKERS)
def test_a_bag_without_skeletons_says_what_it_has(maker, tmp_path, messages, capsys):
    path = maker(tmp_path, [m for m in messages if m[1] != SKELETONS])
    with pytest.raises(
        LogError, match=r"no SkeletonGroup topic, .*it has /chatter \(std_msgs"
    ) as bad:
        open_log(path)
    assert "/tf_static" in str(bad.value)
    overview = overview_of(path)
    rows = {row.topic: (row.type, row.messages) for row in overview.channels}
    assert rows["/chatter"] == ("std_msgs/msg/String", 1)
    assert rows["/tf_static"][1] == 1
    assert (overview.kind, overview.cameras) == ("other", ())
    assert run(["info", str(path)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"^/chatter +1 +- +0\.0  String", text, re.MULTILINE)
    last = text.rstrip().splitlines()[-2]
    assert last.startswith("nothing to process: has no SkeletonGroup topic, nor another type")


@pytest.mark.parametrize("bag", [sqlite, ros1_bag], indirect=True)
def test_a_bag_is_a_log_for_every_command(bag, tmp_path, capsys):
    commands = ["info", "eval", "compare --jobs 1 --system raw", "view --save v.rrd"]
    for command in (*commands, "calibrate noise --json"):
        name, *options = command.replace("v.rrd", str(tmp_path / "v.rrd")).split()
        assert run([name, *options, str(bag)]) == 0, capsys.readouterr().err
    assert "left out" in capsys.readouterr().out.lower()


def test_quality_of_service_goes_along(tmp_path, messages):
    with open_log(sqlite(tmp_path, messages)) as log:
        for channel in log.channels:
            profiles = channel.metadata["offered_qos_profiles"]
            assert re.search("durability: (1|transient_local)", profiles)


@pytest.mark.parametrize(
    ("topic", "profiles", "encoding", "needed"),
    [
        ("/tf_static", "", "cdr", True),
        ("/tf_static", LATCHED_QOS, "cdr", False),
        ("/tf_static", "- depth: 1\n  durability: transient_local", "cdr", False),
        ("/tf_static", LATCHED_QOS.replace("durability: 1", "durability: 2"), "cdr", True),
        ("/tf_static", "no yaml: [", "cdr", True),
        ("/tf_static", "", "json", False),
        ("/tf", "", "cdr", False),
    ],
)
def test_static_transforms_that_nobody_keeps_are_kept_in_the_copy(
    topic, profiles, encoding, needed
):
    info = ChannelInfo(1, topic, TF, encoding, 1, {"offered_qos_profiles": profiles})
    assert needs_latching(info) is needed


@pytest.mark.parametrize("encoding", ["ros2msg", "ros2idl"])
def test_the_copy_of_static_transforms_is_whole_and_latched(walking, tmp_path, encoding):
    source, target = tmp_path / "in.mcap", tmp_path / "out.mcap"
    with McapReader(walking) as old, McapWriter(source) as new:
        for definition in (*old.contents.schemas.values(), *old.channels.values()):
            if isinstance(definition, Channel):
                new.define(replace(definition, metadata={}))
            elif definition.name == TF:
                new.define(replace(definition, encoding=encoding))
            else:
                new.define(definition)
        for message in old.messages():
            new.write_message(message.channel_id, message)
        new.commit()
    hiros_mcap.process(source, target, stages="T")
    with McapReader(source) as before, McapReader(target) as after:
        (old_info,), (info,) = (static_of(reader) for reader in (before, after))
        assert needs_latching(old_info)
        assert not needs_latching(info)
        copy = [bytes(m.data) for m in after.messages([info.id])]
        assert copy == [bytes(m.data) for m in before.messages([old_info.id])] != []
        schema = after.schema(after.channels[info.id])
        old_schema = before.schema(before.channels[old_info.id])
        assert (schema.encoding, schema.data) == (encoding, old_schema.data)
    hiros_mcap.process(source, target, stages="T", keep=["/truth/*"])
    with McapReader(target) as after:
        assert static_of(after) == []  # the same holds for it as for other channels


def static_of(reader):
    return [info for info in channels_of(reader) if info.topic == "/tf_static"]


def test_a_folder_of_several_mcap_files_is_one_recording(tmp_path, messages):
    folder = rosbag2_folder(tmp_path / "bag", messages[:-1], 9, rosbag2.StoragePlugin.MCAP)
    with open_log(folder) as log:
        whole = list(log.detections())
    (first,) = folder.glob("*.mcap")
    (folder / "bag_1.mcap").write_bytes(first.read_bytes())
    text = (folder / "metadata.yaml").read_text()
    name = first.name
    (folder / "metadata.yaml").write_text(text.replace(f"- {name}", f"- {name}\n  - bag_1.mcap", 1))
    with open_log(folder) as log:
        # The second file repeats the first: every message comes twice.
        assert sum(log.reader.counts.values()) == 2 * len(messages[:-1])
        found = list(log.detections())
    assert [f.stamp for f in found[::1]][:3] == [f.stamp for f in whole][:3]


@pytest.mark.parametrize("start", [b"#ROSBAG V2.0\n", b"SQLite format 3\0"])
@pytest.mark.parametrize("name", ["old.bag", "old.db3"])
def test_a_damaged_bag_is_an_error_of_one_line(tmp_path, start, name):
    (tmp_path / name).write_bytes(start + bytes(100))
    with pytest.raises(LogError, match=r"bag that cannot be read: .") as caught:
        open_log(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert name in str(caught.value)


def test_a_bag_cut_short_is_an_error(bag):
    file = bag if bag.is_file() else next(bag.glob("*.db3"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(LogError, match="cannot be read"):
        open_log(bag)
