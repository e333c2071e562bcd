"""Recordings of rosbag2 as people have them: what the same messages in one MCAP say."""

from __future__ import annotations

import subprocess
import sys

import pytest
import zstandard
from detector_logs import store_of
from generators import rosbags_types
from mcap.reader import make_reader
from rosbag2_recorder import SINCE_LYRICAL, Recorded, in_idl, record, sample, write_metadata
from rosbags import rosbag1
from rosbags.typesys import Stores

import hiros_schemas
from hiros_cli.app import run
from hiros_mcap.errors import LogError
from hiros_mcap.io.bag_files import are_splits
from hiros_mcap.io.joining import recover
from hiros_mcap.io.log import open_log
from hiros_mcap.many.find import are_many, find_logs
from hiros_mcap.running.overview import overview_of


@pytest.fixture(scope="module")
def messages():
    return sample()


@pytest.fixture(scope="module")
def healthy(messages, tmp_path_factory):
    """The same messages in one MCAP file."""
    return record(tmp_path_factory.mktemp("one") / "lab", messages, metadata=False) / "lab_0.mcap"


@pytest.fixture(scope="module")
def result(healthy, tmp_path_factory):
    """The result of a run on that file."""
    return processed(healthy, tmp_path_factory.mktemp("result") / "out.mcap")


def processed(log, out, *options):
    assert run(["process", str(log), "-o", str(out), "-q", *options]) == 0
    return content(out)


def content(path):
    """Every message of a file, by the mcap library."""
    with path.open("rb") as file:
        rows = make_reader(file).iter_messages()
        return sorted((c.topic, m.log_time, bytes(m.data)) for _, c, m in rows)


@pytest.mark.parametrize("options", [{}, {"parts": 3}, {"storage": "sqlite3"}])
def test_messages_that_are_compressed_one_by_one_are_unpacked(messages, result, options, tmp_path):
    folder = record(tmp_path / "lab", messages, mode="message", **options)
    assert "--compression-mode message" in " ".join(overview_of(folder).remarks)
    assert processed(folder, tmp_path / "out.mcap") == result


@pytest.mark.parametrize("metadata", [True, False])
def test_a_file_of_compressed_messages_needs_no_metadata(messages, result, metadata, tmp_path):
    folder = record(tmp_path / "lab", messages, mode="message", metadata=metadata)
    assert processed(folder / "lab_0.mcap", tmp_path / "out.mcap") == result


def test_compressed_messages_are_unpacked_live_and_in_copies(messages, result, healthy, tmp_path):
    file = record(tmp_path / "lab", messages, mode="message") / "lab_0.mcap"
    assert recover(file, tmp_path / "copy.mcap").complete
    assert content(tmp_path / "copy.mcap") == content(healthy)
    out = [tmp_path / name for name in ("live.mcap", "healthy.mcap")]
    for source, target in zip((file, healthy), out, strict=True):
        with source.open("rb") as stream:
            command = [sys.executable, "-m", "hiros_mcap", "process", "-", "-o", str(target)]
            subprocess.run([*command, "-q"], stdin=stream, check=True)
    assert content(out[0]) == content(out[1])


def test_a_frame_that_is_damaged_is_an_error(messages, tmp_path):
    cut = [m._replace(data=zstandard.compress(m.data)) for m in messages]
    cut[40] = cut[40]._replace(data=cut[40].data[:-9])
    folder = record(tmp_path / "lab", cut)
    with pytest.raises(
        LogError, match=r"lab_0.mcap: damaged chunk at byte \d+: a message does not"
    ):
        list(open_log(folder).detections())
    with pytest.raises(LogError, match="is a SQLite bag that cannot be read: a message does not"):
        open_log(record(tmp_path / "x", cut, storage="sqlite3"))


def test_a_plugin_of_another_compression_is_named(messages, tmp_path):
    folder = record(tmp_path / "lab", messages, mode="message")
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace("format: zstd", "format: snappy"))
    with pytest.raises(LogError, match="is compressed by 'snappy', .*--compression-format zstd"):
        open_log(folder)


@pytest.mark.parametrize("parts", [1, 3])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_files_that_were_unpacked_by_hand_are_taken(storage, parts, messages, result, tmp_path):
    folder = record(tmp_path / "lab", messages, storage=storage, parts=parts, mode="file")
    for file in sorted(folder.glob("*.zstd"))[:2]:  # one of three is left as it is
        file.with_suffix("").write_bytes(zstandard.ZstdDecompressor().decompress(file.read_bytes()))
        file.unlink()
    assert processed(folder, tmp_path / "out.mcap") == result


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_file_that_is_compressed_is_read_alone(storage, messages, result, tmp_path, capsys):
    folder = record(tmp_path / "lab", messages, storage=storage, mode="file", metadata=False)
    (file,) = folder.iterdir()
    assert processed(file, tmp_path / "out.mcap") == result
    assert run(["info", str(file)]) == 0
    assert "its files are compressed with zstd" in capsys.readouterr().out
    file.write_bytes(file.read_bytes()[:-1000])
    assert run(["process", str(file), "-o", str(tmp_path / "cut.mcap")]) == 2
    assert "zstd that cannot be read: it ends within a frame" in capsys.readouterr().err
    assert not (tmp_path / "cut.mcap").exists()


# (topic, type, definition, how it is written): what a recorder stores beside the skeletons
ODD = {
    # rosbag2_cpp/local_message_definition_source.cpp, and empty_message_definition_for
    "not found": ("/odd", "acme_msgs/msg/Odd", "", "unknown"),
    "empty": ("/odd", "acme_msgs/msg/Odd", "", ""),
    # sequential_writer.cpp: topics of service events, with the definition of the service
    "service": (
        "/add/_service_event",
        "acme_msgs/srv/Add_Event",
        f"{'=' * 80}\nSRV: acme_msgs/srv/Add\nint64 a\n---\nint64 sum\n",
        "ros2msg",
    ),
    "action": ("/fib/_action/feedback", "acme/action/Fib_FeedbackMessage", "Fib_Feedback f", ""),
    "wstring": ("/w", "acme_msgs/msg/W", "wstring text\nwstring<=5 name\n", "ros2msg"),
    "bounded": ("/b", "acme_msgs/msg/B", "string<=5[<=3] names\nfloat128 q\n", "ros2msg"),
    "no type": ("/n", "thing", "", "unknown"),
    "no text": ("/j", "acme_msgs/msg/J", "}{ $$\n= = =\n", "ros2msg"),
    "IDL": (
        "/i",
        "acme_msgs/msg/I",
        f"{'=' * 80}\nIDL: acme_msgs/msg/I\nmodule acme {{",
        "ros2idl",
    ),
}


def with_odd(messages, *kinds):
    """The messages, and in the middle one of each odd kind."""
    time, data = messages[50].time, b"\0\1\0\0hello\0\0\0"
    rows = [ODD[kind] for kind in kinds]
    odd = [Recorded(topic, name, time, data, text, how) for topic, name, text, how in rows]
    return [*messages[:50], *odd, *messages[50:]]


@pytest.mark.parametrize("metadata", [True, False])
@pytest.mark.parametrize("mode", ["none", "message", "file"])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_types_that_nobody_needs_change_no_result(
    storage, mode, metadata, messages, result, tmp_path
):
    options = {"storage": storage, "mode": mode, "metadata": metadata, "parts": 3}
    folder = record(tmp_path / "lab", with_odd(messages, *ODD), **options)
    assert processed(folder, tmp_path / "out.mcap") == result


def test_what_nobody_needs_is_counted(messages, tmp_path, capsys):
    folder = record(tmp_path / "lab", with_odd(messages, "not found"), storage="sqlite3")
    assert run(["info", str(folder)]) == 0
    assert "not copied from the bag: /odd (acme_msgs/msg/Odd, 1)" in capsys.readouterr().out


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("encoding", ["unknown", "ros2msg"])
def test_the_definition_of_hiros_counts_where_the_recorder_found_none(
    storage, encoding, messages, result, tmp_path
):
    bare = [m._replace(definition="", encoding=encoding) for m in messages]
    folder = record(tmp_path / "lab", bare, storage=storage)
    assert processed(folder, tmp_path / "out.mcap") == result
    if storage == "mcap":
        notes = overview_of(folder / "lab_0.mcap").remarks
        assert any("recorded without the definition of tf2_msgs/msg/TFMessage" in t for t in notes)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_definitions_in_idl_are_read(storage, messages, result, tmp_path):
    texts = {kind: in_idl(kind) for kind in {m.type for m in messages}}
    idl = [m._replace(definition=texts[m.type], encoding="ros2idl") for m in messages]
    assert (
        processed(record(tmp_path / "lab", idl, storage=storage), tmp_path / "out.mcap") == result
    )


@pytest.mark.parametrize("mode", ["none", "file"])
def test_transforms_need_no_definition(mode, messages, result, tmp_path, capsys):
    bare = [m._replace(encoding="") if m.topic == "/tf_static" else m for m in messages]
    folder = record(tmp_path / "lab", bare, mode=mode)
    assert processed(folder, tmp_path / "out.mcap") == result
    assert run(["info", str(folder)]) == 0
    assert "/tf_static: recorded without the definition of tf2_msgs" in capsys.readouterr().out


def test_a_type_that_only_its_owner_defines_is_named_with_a_remedy(messages, tmp_path, capsys):
    kind = "zed_interfaces/msg/ObjectsStamped"
    bare = [
        m if m.topic == "/tf_static" else m._replace(type=kind, definition="") for m in messages
    ]
    log = record(tmp_path / "lab", bare) / "lab_0.mcap"
    assert run(["process", str(log)]) == 2
    said = "without their definition; record them with the package of zed_interfaces/"
    assert said in capsys.readouterr().err


def test_a_bag_of_ros_1_may_hold_a_type_that_nobody_needs(messages, tmp_path):
    names = (hiros_schemas.SKELETON_GROUP, hiros_schemas.TF_MESSAGE)
    store = store_of({name: hiros_schemas.text(name) for name in names}, Stores.ROS1_NOETIC)
    with rosbag1.Writer(tmp_path / "lab.bag") as writer:
        # what topic_tools/ShapeShifter writes of a type that it does not know
        odd = writer.add_connection("/odd", "acme_msgs/msg/Odd", msgdef="}{ *", md5sum="*")
        writer.write(odd, messages[0].time, b"hello")
        kinds = {m.topic: m.type for m in messages}
        topics = {t: writer.add_connection(t, kind, typestore=store) for t, kind in kinds.items()}
        for m in messages:
            raw = rosbags_types().cdr_to_ros1(m.data, m.type)
            writer.write(topics[m.topic], m.time, bytes(raw))
    with open_log(tmp_path / "lab.bag") as log:
        assert sum(1 for _ in log.detections()) == len(messages) - 1
        assert log.left_out == {"/odd": ("acme_msgs/msg/Odd", 1)}


def test_the_name_of_the_storage_does_not_matter(messages, result, tmp_path):
    folder = record(tmp_path / "lab", messages, storage="sqlite3")
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace(": sqlite3", ": ''"))
    assert processed(folder, tmp_path / "out.mcap") == result


@pytest.mark.parametrize("names", ["{folder}_{k}", SINCE_LYRICAL])
@pytest.mark.parametrize("mode", ["none", "message", "file"])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_parts_without_metadata_are_one_recording(
    storage, mode, names, messages, result, tmp_path, capsys
):
    folder = record(
        tmp_path / "lab", messages, storage=storage, parts=3, mode=mode, names=names, metadata=False
    )
    assert find_logs([str(tmp_path)]) == [str(folder)]
    assert not are_many([str(folder)])
    assert run(["info", str(folder)]) == 0
    assert "metadata.yaml is missing; by their names, the 3 files" in capsys.readouterr().out
    assert processed(folder, tmp_path / "out.mcap") == result


def test_parts_of_lyrical_may_lie_in_a_folder_of_another_name(tmp_path):
    names = [f"{k}_lab_2026_11_27-10_00_0{k}.mcap" for k in range(3)]
    assert are_splits("monday", names)
    assert not are_splits("monday", names[1:])
    assert not are_splits("monday", [*names, "0_lab_2026_11_28-10_00_00.mcap"])
    assert not are_splits("monday", ["lab_0.mcap", "lab_1.mcap"])
    assert not are_splits("lab", ["lab_0.mcap", "lab_1.db3"])


@pytest.mark.parametrize("names", ["{folder}_{k}", SINCE_LYRICAL])
@pytest.mark.parametrize("options", [{}, {"storage": "sqlite3", "metadata": False}])
def test_a_part_without_transforms_names_the_one_that_has_them(
    options, names, messages, tmp_path, capsys
):
    folder = record(tmp_path / "lab", messages, parts=3, mode="message", names=names, **options)
    first, part, _ = sorted(p for p in folder.iterdir() if p.name != "metadata.yaml")
    hint = f"{first.name} beside it may be a part of the same recording, one part of which has"
    assert run(["info", str(part)]) == 0
    assert hint in capsys.readouterr().out
    assert run(["process", str(part), "-o", str(tmp_path / "out.mcap")]) == 2
    text = capsys.readouterr().err
    assert f"{hint} /tf_static: name the folder {folder}" in text
    assert "look like transforms" not in text  # the part declares /tf_static


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_part_that_is_missing_is_named_with_a_remedy(storage, messages, tmp_path, capsys):
    folder = record(tmp_path / "lab", messages, storage=storage, parts=3)
    (last := max(p for p in folder.iterdir() if p.name.startswith("lab_"))).unlink()
    assert run(["process", str(folder), "-o", str(tmp_path / "out.mcap")]) == 2
    text = capsys.readouterr().err
    assert f"metadata.yaml lists {last.name}, which the folder lacks" in text
    assert "hiros recover FOLDER" in text
    assert run(["recover", str(folder), "-o", str(tmp_path / "left.mcap")]) == 3
    assert len(content(tmp_path / "left.mcap")) == 100


def test_a_damaged_sqlite_part_costs_what_is_in_it(messages, tmp_path):
    folder = record(tmp_path / "lab", messages, storage="sqlite3", parts=3)
    file = folder / "lab_1.db3"
    file.write_bytes(file.read_bytes()[:4096] + bytes(file.stat().st_size - 4096))
    recovery = recover(folder, tmp_path / "left.mcap")
    assert recovery.recovered == len(content(tmp_path / "left.mcap")) == 100
    assert [damage.file for damage in recovery.damages] == ["lab_1.db3"]


KILLED = """
import os, signal, sqlite3, sys
database = sqlite3.connect(sys.argv[1])
database.execute("PRAGMA journal_mode=WAL")
database.execute("ATTACH ? AS whole", sys.argv[2:])
database.execute("INSERT INTO messages SELECT * FROM whole.messages WHERE id > 50")
database.commit()
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("given", ["folder", "file"])
def test_what_a_killed_recorder_left_beside_a_sqlite_bag_is_read(given, messages, tmp_path):
    """ros2 bag record --storage-preset-profile resilient; nothing in the folder is changed."""
    (whole,) = record(tmp_path / "whole", messages, storage="sqlite3", metadata=False).iterdir()
    folder = record(tmp_path / "lab", messages[:50], storage="sqlite3", metadata=False)
    (file,) = folder.iterdir()
    subprocess.run([sys.executable, "-c", KILLED, file, whole], check=False)
    (folder / "lab_0.db3-shm").unlink()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert before.keys() == {"lab_0.db3", "lab_0.db3-wal"}
    with open_log(folder if given == "folder" else file) as log:
        assert sum(log.reader.counts.values()) == len(messages)
        note = "lab_0.db3-wal, which the recorder did not finish, is read, too"
        assert any(note in remark for remark in log.remarks)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("kept", [1, 40, 149])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_metadata_that_counts_more_than_there_is_warns(storage, kept, messages, tmp_path, capsys):
    folder = record(tmp_path / "lab", messages[-kept:], storage=storage)
    file = next(p for p in folder.iterdir() if p.name.startswith("lab_"))
    write_metadata(folder, [file], messages, storage)
    warning = f"metadata.yaml counts {len(messages)} messages, and the recording holds {kept}"
    for path in (folder, file):
        run(["info", str(path)])
        said = capsys.readouterr()
        assert f"{warning};" in said.err + said.out
        run(["process", str(path), "-o", str(tmp_path / "out.mcap"), "-q"])
        assert warning in capsys.readouterr().err


def test_a_count_that_is_right_does_not_warn(messages, tmp_path):
    folder = record(tmp_path / "lab", messages, parts=3)
    assert overview_of(folder).warnings == ()
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace("message_count: 150", "message_count: 953"))
    assert overview_of(folder).warnings[0].startswith("metadata.yaml counts 953 messages")


def aliases(key):
    """Ten lines that mean a billion values."""
    lines = "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 10))
    return f"a0: &a0 [x, x]\n{lines}{key}: *a9\n"


BAG = "rosbag2_bagfile_information"
DAMAGED_METADATA = {
    "empty": lambda text: "",
    "cut": lambda text: text[: text.index("relative_file_paths") + 24],
    "tag": lambda text: text.replace(f"{BAG}:", f"{BAG}: !!python/object/apply:os.getcwd"),
    "unknown tag": lambda text: text.replace("message_count:", "message_count: !count", 1),
    "aliases": lambda text: aliases("x") + text,
    "merge keys": lambda text: "a: &a {x: 1}\nb: {<<: [*a, *a]}\n" + text,
    "a list": lambda text: f"- {BAG}",
    "files that are numbers": lambda text: f"{BAG}: {{relative_file_paths: [[1], 2]}}",
    "a count that is a word": lambda text: text.replace("message_count: ", "message_count: x"),
    "an endless count": lambda text: text.replace("message_count: ", "message_count: .inf #"),
    "a tab": lambda text: text.replace("  ", "\t"),
    "no text": lambda text: text + "\udcff",
    "nested": lambda text: text + "[" * 5000,
    "many names": lambda text: text + "".join(f"/a_topic_{k}: 1\n" for k in range(100_000)),
}


@pytest.mark.parametrize("damage", DAMAGED_METADATA)
def test_metadata_that_cannot_be_understood_is_one_warning(damage, messages, healthy, tmp_path):
    folder = record(tmp_path / "lab", messages)
    path = folder / "metadata.yaml"
    text = DAMAGED_METADATA[damage](path.read_text())
    path.write_bytes(text.encode(errors="surrogateescape"))
    (warning,) = overview_of(folder).warnings
    assert warning.startswith(str(path)) and warning.endswith("; it was not used")
    assert "\n" not in warning and len(warning) < 400
    with open_log(folder) as log, open_log(healthy) as whole:
        assert log.reader.counts == whole.reader.counts
