"""``hiros recover`` and ``hiros process --recover``: what is left of damaged recordings."""

from __future__ import annotations

import json
import re
import shlex
import shutil

import pytest
from mcap_logs import by_library, write_log

from hiros_cli.app import run
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.io.log import open_log


def damaged(source, target):
    """Copy a log with one byte changed in the middle of a chunk in the middle."""
    data = bytearray(source.read_bytes())
    with McapReader(source) as reader:
        chunks = reader.contents.chunks
    chunk = chunks[len(chunks) // 2]
    data[chunk.data_offset + chunk.data_size // 2] ^= 1
    target.write_bytes(data)
    return target


def cut(source, target, share=0.6):
    """Copy a log as far as it was written when the power went."""
    data = source.read_bytes()
    target.write_bytes(data[: int(share * len(data))])
    return target


@pytest.fixture
def log(crossing, tmp_path):
    """The crossing in many chunks."""
    path = tmp_path / "lab.mcap"
    with McapReader(crossing) as reader, McapWriter(path, chunk_size=150_000) as writer:
        writer.copy_definitions(reader, reader.channels)
        for m in reader.messages():
            writer.write(m.channel_id, m.log_time, m.data, sequence=m.sequence)
        writer.add_attachment("note.txt", b"hello", "text/plain", (3, 4))
        writer.commit()
    return path


def mark(path):
    with McapReader(path) as reader:
        return dict(reader.contents.metadata).get("hiros.recovery", {})


def test_what_is_left_is_a_healthy_log_with_a_mark(log, tmp_path, capsys):
    bad, out = damaged(log, tmp_path / "bad.mcap"), tmp_path / "out.mcap"
    assert run(["recover", str(bad), "-o", str(out)]) == 3
    said = capsys.readouterr()
    assert said.err.startswith(f"hiros: warning: {bad}: lost: /camera_0/skeletons: ")
    whole, left = by_library(log), by_library(out)
    assert [row for row in whole if row in left] == left
    lost = len(whole) - len(left)
    assert 0 < lost < len(whole) / 3
    assert mark(out)["lost_messages"] == str(lost)
    assert json.loads(mark(out)["damages"])[0]["fault"].startswith("damaged chunk")
    with McapReader(out) as reader:
        assert reader.has_checksums
        assert reader.attachment("note.txt") == b"hello"
        assert reader.contents.attachments[0].create_time == 4
    assert f"wrote {len(left)} messages" in said.out


def test_a_healthy_log_is_copied_and_nothing_is_lost(log, tmp_path, capsys):
    out = tmp_path / "out.mcap"
    assert run(["recover", str(log), "-o", str(out)]) == 0
    said = capsys.readouterr()
    assert "nothing was lost: the log is not damaged" in said.out
    assert said.err == ""
    assert by_library(out) == by_library(log)
    assert mark(out) == {}


def test_a_log_that_lost_its_summary_only_is_complete(log, tmp_path, capsys):
    bad, data = tmp_path / "bad.mcap", log.read_bytes()
    summary = int.from_bytes(data[-28:-20], "little")
    bad.write_bytes(data[: summary + 50])
    assert run(["recover", str(bad), "-o", str(tmp_path / "out.mcap")]) == 0
    assert "nothing was lost: the damage cost no message" in capsys.readouterr().out
    assert by_library(tmp_path / "out.mcap") == by_library(log)


def test_messages_that_nothing_checked_are_a_loss_though_all_are_there(tmp_path, capsys):
    codes = []
    for name, checked in (("checked", True), ("unchecked", False)):
        path = tmp_path / f"{name}.mcap"
        data = write_log(path, use_chunking=False, enable_data_crcs=checked).read_bytes()
        path.write_bytes(data[:-10])
        codes.append(run(["recover", str(path), "--json"]))
        assert json.loads(capsys.readouterr().out)["lost_messages"] == 0
    assert codes == [0, 3]


def test_the_loss_as_json(log, tmp_path, capsys):
    bad = cut(log, tmp_path / "bad.mcap")
    assert run(["recover", str(bad), "--json"]) == 3
    said = json.loads(capsys.readouterr().out)
    assert (said["complete"], said["lost_messages"]) == (False, None)
    assert said["recovered_messages"] == len(by_library(tmp_path / "bad.recovered.mcap"))


@pytest.mark.parametrize("data", [b"", b"no log", b"\x89MCAP0\r\n" + bytes(5000)])
def test_where_nothing_can_be_read_nothing_is_written(data, tmp_path, capsys):
    (tmp_path / "bad.mcap").write_bytes(data)
    assert run(["recover", str(tmp_path / "bad.mcap"), "-o", str(tmp_path / "out.mcap")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out.mcap").exists()


def test_the_refusal_of_a_damaged_log_names_the_command(log, tmp_path, capsys):
    for bad in (cut(log, tmp_path / "cut.mcap"), damaged(log, tmp_path / "bad.mcap")):
        assert run(["process", str(bad), "-o", str(tmp_path / "out.mcap")]) == 2
        error = capsys.readouterr().err
        (command,) = re.findall(r"`hiros (recover .*)` saves what is readable", error)
        assert run(shlex.split(command)) == 3


def test_a_run_on_what_is_left_is_marked_and_warns(log, tmp_path, capsys):
    bad, out = cut(log, tmp_path / "bad.mcap"), tmp_path / "out.mcap"
    assert run(["process", str(bad), "-o", str(out), "--recover", "-q"]) == 3
    said = capsys.readouterr().err
    assert "hiros: warning: the recording is damaged; lost: " in said
    assert re.search(r"an unknown number of messages; all from byte \d+ on", said)
    assert mark(out)["lost_messages"] == "null"
    run(["recover", str(bad), "-o", str(tmp_path / "left.mcap"), "-q"])
    assert run(["process", str(tmp_path / "left.mcap"), "-o", str(tmp_path / "two.mcap")]) == 0
    assert "was damaged before it was recovered; lost: " in capsys.readouterr().err
    assert mark(tmp_path / "two.mcap") == mark(out)


def test_a_run_on_a_healthy_log_is_the_same_with_the_option(log, tmp_path):
    plain, careful = tmp_path / "plain.mcap", tmp_path / "careful.mcap"
    assert run(["process", str(log), "-o", str(plain), "-q"]) == 0
    assert run(["process", str(log), "-o", str(careful), "-q", "--recover"]) == 0
    assert plain.read_bytes() == careful.read_bytes()


@pytest.fixture
def folder(log, tmp_path):
    """The log as a rosbag2 recording of twelve files, of which the last channel ids differ."""
    folder = tmp_path / "bag"
    folder.mkdir()
    with McapReader(log) as reader:
        messages = list(reader.messages())
        step = -(-len(messages) // 12)
        for part in range(12):
            with McapWriter(folder / f"bag_{part}.mcap") as writer:
                ids = sorted(reader.channels, reverse=part > 5)
                new = {}
                for i in ids:
                    channel, schema = reader.channels[i], reader.schema(reader.channels[i])
                    assert schema is not None
                    ident = writer.add_schema(schema.name, schema.data)
                    new[i] = writer.add_channel(channel.topic, ident, metadata=channel.metadata)
                for m in messages[part * step : (part + 1) * step]:
                    writer.write(new[m.channel_id], m.log_time, m.data, sequence=m.sequence)
                writer.commit()
    names = "".join(f"\n    - bag_{part}.mcap" for part in range(12))
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n"
        f"  compression_mode: ''\n  relative_file_paths:{names}\n"
    )
    return folder


def by_topic(path):
    with McapReader(path) as reader:
        topics = {i: channel.topic for i, channel in reader.channels.items()}
        return [(topics[m.channel_id], m.log_time, bytes(m.data)) for m in reader.messages()]


def test_a_recording_of_several_files_is_read_as_one(folder, log):
    with open_log(folder) as split, open_log(log) as whole:
        counts = {channel.topic: channel.count for channel in whole.channels}
        assert {c.topic: c.count for c in split.channels}.items() <= counts.items()
        assert [f.stamp for f in split.detections()] == [f.stamp for f in whole.detections()]
        assert split.reader.has_checksums


def test_a_cut_file_of_several_is_named_and_the_others_are_recovered(folder, log, tmp_path, capsys):
    last, out = folder / "bag_11.mcap", tmp_path / "out.mcap"
    cut(last, last, 0.5)
    assert run(["process", str(folder), "-o", str(tmp_path / "result.mcap")]) == 2
    assert f"{last}: truncated" in capsys.readouterr().err
    assert run(["recover", str(folder), "-o", str(out)]) == 3
    assert "damage at bag_11.mcap, byte" in capsys.readouterr().out
    left, whole = by_topic(out), by_topic(log)
    assert left == whole[: len(left)]
    assert len(left) == 11 * -(-len(whole) // 12)
    assert run(["process", str(folder), "-o", str(out), "--recover", "-q"]) == 3
    assert "bag_11.mcap" in mark(out)["damages"]


@pytest.mark.parametrize("text", [None, ""])
def test_a_folder_whose_list_of_files_is_lost_is_read_in_the_order_of_numbers(
    folder, log, tmp_path, text
):
    if text is None:
        (folder / "metadata.yaml").unlink()
    else:
        (folder / "metadata.yaml").write_text(text)
    assert run(["process", str(folder), "-o", str(tmp_path / "result.mcap")]) == 0
    assert run(["recover", str(folder), "-o", str(tmp_path / "out.mcap"), "-q"]) == 0
    assert by_topic(tmp_path / "out.mcap") == by_topic(log)


def test_a_file_that_is_missing_is_a_loss(folder, log, tmp_path, capsys):
    (folder / "bag_3.mcap").unlink()
    assert run(["recover", str(folder), "-o", str(tmp_path / "out.mcap")]) == 3
    assert "bag_3.mcap" in capsys.readouterr().out
    shutil.rmtree(folder)
