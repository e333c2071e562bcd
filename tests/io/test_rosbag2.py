"""Output as a ROS 2 bag, read by a library that knows nothing of hiros."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

import hiros_mcap
import hiros_schemas
from hiros_cli.app import run
from hiros_mcap.errors import LogError
from hiros_mcap.io.bag_output import write_bag_metadata


@pytest.fixture(scope="module")
def bag(walking, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bag") / "lab"
    hiros_mcap.process(walking, f"{folder}/")
    return folder


def counts(mcap):
    with mcap.open("rb") as file:
        summary: Any = make_reader(file).get_summary()
    found = summary.statistics.channel_message_counts
    return {channel.topic: found.get(i, 0) for i, channel in summary.channels.items()}


def test_a_bag_is_an_mcap_file_and_its_metadata(bag):
    assert sorted(path.name for path in bag.iterdir()) == ["lab_0.mcap", "metadata.yaml"]
    info = YAML(typ="safe").load(bag / "metadata.yaml")["rosbag2_bagfile_information"]
    assert (info["version"], info["storage_identifier"]) == (8, "mcap")
    assert info["files"][0]["message_count"] == info["message_count"] > 0
    assert 1.4e9 < info["duration"]["nanoseconds"] < 1.6e9


def test_rosbags_reads_every_message_and_type(bag):
    found: Counter[str] = Counter()
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            found[connection.topic] += 1
            if found[connection.topic] == 1:
                reader.deserialize(data, connection.msgtype)
    assert found == counts(bag / "lab_0.mcap")
    assert found["/hiros/filtered"] > 40


def test_metadata_says_what_the_file_holds(bag):
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Reader(bag) as reader:
        described = {c.topic: c for c in reader.connections}
        times = [time for _, time, _ in reader.messages()]
        assert (reader.start_time, reader.end_time) == (min(times), max(times) + 1)
        assert reader.message_count == len(times)
    assert {t: c.msgcount for t, c in described.items()} == counts(bag / "lab_0.mcap")
    tf, skeletons = described["/tf_static"], described["/hiros/filtered"]
    assert tf.digest == store.hash_rihs01(hiros_schemas.TF_MESSAGE)
    assert skeletons.digest == hiros_schemas.type_hash(hiros_schemas.SKELETON_GROUP)
    assert durability(tf) == [QosDurability.TRANSIENT_LOCAL]
    assert durability(skeletons) == [QosDurability.VOLATILE]


def durability(connection):
    return [profile.durability for profile in connection.ext.offered_qos_profiles]


def test_hiros_reads_its_own_bag(bag, walking, tmp_path):
    hiros_mcap.process(walking, tmp_path / "same.mcap")
    assert (bag / "lab_0.mcap").read_bytes() == (tmp_path / "same.mcap").read_bytes()
    result = hiros_mcap.open_result(bag)
    assert result.people == (0,)
    assert len(result.events())


@pytest.mark.parametrize("profile", ["", "- history: 1", "- durability: 1", "no yaml: ["])
def test_static_transforms_are_kept_for_late_subscribers(profile, walking, tmp_path):
    source, target = tmp_path / "in.mcap", tmp_path / "out.mcap"
    with walking.open("rb") as old, source.open("wb") as new:
        writer = Writer(new)
        writer.start("ros2")
        ids: dict[int, int] = {}
        for schema, channel, message in make_reader(old).iter_messages():
            if channel.id not in ids:
                assert schema is not None
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                qos = {"offered_qos_profiles": profile} if channel.topic == "/tf_static" else {}
                ids[channel.id] = writer.register_channel(channel.topic, "cdr", known, qos)
            writer.add_message(ids[channel.id], message.log_time, message.data, message.log_time)
        writer.finish()
    hiros_mcap.process(source, target)
    with Reader(bag_of(target)) as reader:
        (tf,) = (c for c in reader.connections if c.topic == "/tf_static")
        assert durability(tf) == [QosDurability.TRANSIENT_LOCAL]
        assert len(list(reader.messages([tf]))) == counts(source)["/tf_static"]
    assert counts(target).items() >= counts(source).items()


def bag_of(mcap):
    """Make a bag of a plain result."""
    folder = mcap.parent / "bag"
    folder.mkdir()
    shutil.copy(mcap, folder)
    write_bag_metadata(folder / mcap.name)
    return folder


@pytest.mark.parametrize("name", ["new/", "there"])
def test_a_folder_is_made_or_filled(name, walking, tmp_path):
    (tmp_path / "there").mkdir()
    target = f"{tmp_path}/{name}"
    for _ in range(2):  # the second run replaces the first one's bag
        assert run(["process", str(walking), "-o", target, "-q", "--stages", "T"]) == 0
        with Reader(Path(target)) as reader:
            assert "/hiros/tracked" in {c.topic for c in reader.connections}


def test_a_folder_of_somebody_else_stays(walking, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("the only copy")
    assert run(["process", str(walking), "-o", str(tmp_path)]) == 2
    assert "holds other files" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_a_failed_run_leaves_no_folder(tmp_path):
    (tmp_path / "bad.mcap").write_bytes(b"no log at all")
    with pytest.raises(LogError):
        hiros_mcap.process(tmp_path / "bad.mcap", f"{tmp_path}/new/")
    assert [path.name for path in tmp_path.iterdir()] == ["bad.mcap"]


@pytest.mark.parametrize("name", ["out.db3", "out.bag"])
def test_other_bags_are_refused_with_the_remedy(name, walking, tmp_path, capsys):
    assert run(["process", str(walking), "-o", str(tmp_path / name)]) == 2
    assert f"name a folder: -o {tmp_path / 'out'}/" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
