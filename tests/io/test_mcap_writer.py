import os
import random
import resource
import signal
import stat
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap_logs import KINDS, by_library, make_messages, write_log

import hiros_schemas
from hiros_mcap.errors import LogError
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.container import ChunkCopier, McapReader, McapWriter
from hiros_mcap.io.container import writer as writer_module


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out" / "o.mcap"


@pytest.fixture(autouse=True)
def folder(out):
    out.parent.mkdir()


def write(out, messages=None, **options):
    with McapWriter(out, chunk_size=500, **options) as writer:
        schema = writer.add_schema("pkg/msg/Type", b"int32 x")
        for topic in ("/a", "/b"):
            writer.add_channel(topic, schema, metadata={"qos": topic})
        for channel, log_time, data in messages or make_messages():
            writer.write(channel, log_time, data, publish_time=log_time + 1)
        writer.add_metadata("about", {"key": "value"})
        writer.add_attachment("note.txt", b"some note", "text/plain")
        writer.commit()
    return out


def copy(source, out, channels=None):
    with McapReader(source) as reader, McapWriter(out, inputs=[source], chunk_size=500) as writer:
        copier = ChunkCopier(reader, writer, reader.channels if channels is None else channels)
        new = writer.add_channel("/new", 0)
        for message in reader.messages():
            copier.until(message.log_time)
            writer.write(new, message.log_time, b"new")
        copier.finish()
        writer.commit()
    return out


def kept(path, channels=(1, 2)):
    return [m for m in by_library(path) if m[0] in channels]


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_the_library_reads_what_was_written(out, compression):
    write(out, compression=compression)
    got = [(channel, log_time, data) for channel, log_time, data, _, _ in by_library(out)]
    assert got == make_messages()


def test_the_seeking_reader_finds_channels_metadata_and_attachments(out):
    with write(out).open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        assert [m.data for _, _, m in reader.iter_messages()] == [d for _, _, d in make_messages()]
        assert {c.topic: c.metadata for c in reader.get_summary().channels.values()} == {
            "/a": {"qos": "/a"},
            "/b": {"qos": "/b"},
        }
        assert [m.metadata for m in reader.iter_metadata()] == [{"key": "value"}]
        assert [a.data for a in reader.iter_attachments()] == [b"some note"]


def test_the_statistics_count_what_is_there(out):
    with write(out).open("rb") as file:
        stats = make_reader(file).get_summary().statistics
    times = [t for _, t, _ in make_messages()]
    assert stats.channel_message_counts == {1: 20, 2: 20}
    assert (stats.message_start_time, stats.message_end_time) == (times[0], times[-1])
    assert (stats.message_count, stats.attachment_count, stats.metadata_count) == (40, 1, 1)


def test_rosbags_reads_what_was_written(out):
    from rosbags import highlevel

    with McapWriter(out) as writer:
        channel = add_skeleton_channel(writer, "/hiros/tracked")
        for k in range(5):
            writer.write(channel, k, bytes([0, 1, 0, 0, k]))
        writer.commit()
    with highlevel.AnyReader([Path(out)]) as reader:
        assert [raw[4] for _, _, raw in reader.messages()] == [0, 1, 2, 3, 4]


def test_a_skeleton_channel_is_declared_as_rosbag2_declares_it(out):
    with McapWriter(out) as writer:
        ids = [add_skeleton_channel(writer, topic) for topic in ("/hiros/a", "/hiros/b")]
        first, second = (writer.channels[i] for i in ids)
    assert first.schema_id == second.schema_id
    assert first.message_encoding == "cdr"
    assert first.metadata["topic_type_hash"] == hiros_schemas.type_hash(
        hiros_schemas.SKELETON_GROUP
    )
    assert first.metadata["offered_qos_profiles"].startswith("- history: 1\n")


def test_the_speed_of_the_background_thread_changes_no_byte(tmp_path, out, monkeypatch):
    usual, rng = write(out).read_bytes(), random.Random(1)

    def slow(data, compression, fast=writer_module.compress):
        time.sleep(rng.choice((0, 0.01)))
        return fast(data, compression)

    monkeypatch.setattr(writer_module, "compress", slow)
    assert write(tmp_path / "other.mcap").read_bytes() == usual


def test_messages_that_are_made_later_lie_in_the_order_of_the_calls(out):
    with McapWriter(out, chunk_size=500) as writer:
        channel = writer.add_channel("/a", 0)
        writer.write(channel, 1, b"first")
        writer.write_each(channel, [2, 3], iter([b"second" * 100, b"third"]))
        writer.write(channel, 4, b"fourth")
        writer.commit()
    got = [(log_time, data, number) for _, log_time, data, _, number in by_library(out)]
    assert got == [(1, b"first", 0), (2, b"second" * 100, 1), (3, b"third", 2), (4, b"fourth", 3)]


def test_an_error_in_making_messages_is_raised_and_nothing_appears(out):
    def broken():
        yield b"one"
        raise LogError("cannot be encoded")

    with pytest.raises(LogError, match="cannot be encoded"), McapWriter(out) as writer:
        writer.write_each(writer.add_channel("/a", 0), [1, 2], broken())
        writer.commit()
    assert not out.exists()


def test_messages_larger_than_a_chunk_and_empty_ones_are_written(out):
    sizes = [0, 1, 70_000, 499, 0, 200_000, 3]
    write(out, [(1, k, bytes([k]) * n) for k, n in enumerate(sizes)])
    assert [(len(m[2]), set(m[2])) for m in by_library(out)] == [
        (n, {k} if n else set()) for k, n in enumerate(sizes)
    ]


def test_messages_of_several_chunks_are_numbered(out):
    said = [bytes([65 + k]) * (k % 9) for k in range(61)]
    with McapWriter(out, chunk_size=500) as writer:
        channel = writer.add_channel("/a", 0)
        for k, message in enumerate(said):
            writer.write(channel, k, message)
        writer.commit()
        assert len(writer._indexes) > 3
    assert [m[2] for m in by_library(out)] == said
    with McapReader(out) as reader:
        messages = list(reader.messages())
        assert [(m.sequence, m.log_time) for m in messages] == [(k, k) for k in range(61)]


@pytest.mark.parametrize(
    "numbers", [(-1, {}), (1, {"publish_time": 1 << 64}), (1, {"sequence": -1})]
)
def test_times_and_numbers_that_no_record_can_hold_are_refused(out, numbers):
    time, others = numbers
    with McapWriter(out) as writer:
        channel = writer.add_channel("/a", 0)
        with pytest.raises(ValueError, match="no such times"):
            writer.write(channel, time, b"x", **others)


def test_an_empty_log_is_a_valid_log(out):
    with McapWriter(out) as writer:
        writer.commit()
    assert by_library(out) == []
    with McapReader(out) as reader:
        assert list(reader.messages()) == []


def test_without_a_commit_nothing_appears(out):
    with McapWriter(out) as writer:
        writer.write(writer.add_channel("/a", 0), 1, b"x")
        assert [p.suffix for p in out.parent.iterdir()] == [".tmp"]
    assert list(out.parent.iterdir()) == []


def test_the_new_name_is_on_the_disk_when_a_log_is_finished(out, monkeypatch):
    synced, fsync = [], os.fsync

    def spy(descriptor):
        synced.append((os.fstat(descriptor).st_ino, out.exists()))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", spy)
    write(out, [(1, 1, b"x")])
    assert synced == [(out.stat().st_ino, False), (out.parent.stat().st_ino, True)]


def test_what_a_killed_run_leaves_tells_when_it_began(out):
    program = (
        "import os, signal, sys; from hiros_mcap.io.container import McapWriter\n"
        "writer = McapWriter(sys.argv[1]); os.kill(os.getpid(), signal.SIGKILL)"
    )
    process = subprocess.Popen([sys.executable, "-c", program, out])
    assert process.wait() == -signal.SIGKILL
    (left,) = out.parent.iterdir()
    prefix = f".hiros-{process.pid}-"
    assert left.name.startswith(prefix)
    began = time.mktime(time.strptime(left.name.removeprefix(prefix)[:17], "%Y-%m-%d-%H%M%S"))
    assert 0 <= time.time() - began < 120


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_error_leaves_the_former_output_alone(out, error):
    out.write_text("former")
    with pytest.raises(error), McapWriter(out) as writer:
        writer.write(writer.add_channel("/a", 0), 1, b"x")
        raise error
    assert [p.name for p in out.parent.iterdir()] == [out.name]
    assert out.read_text() == "former"


def test_a_full_disk_is_an_error_and_leaves_nothing(out):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    try:
        with pytest.raises(LogError, match=r"o\.mcap: cannot be written: File too large"):
            write(out, [(1, k, os.urandom(300)) for k in range(60)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(out.parent.iterdir()) == []


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_an_error_at_the_last_step_leaves_nothing(out, monkeypatch, call):
    def fail(*_):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(*{"fsync": (os, "fsync"), "replace": (Path, "replace")}[call], fail)
    with pytest.raises(LogError, match="cannot be written: Input/output error"):
        write(out)
    assert list(out.parent.iterdir()) == []


def test_an_output_that_becomes_a_folder_meanwhile_is_an_error(out):
    with pytest.raises(LogError, match="Is a directory"), McapWriter(out) as writer:
        out.mkdir()
        writer.commit()
    assert [p.name for p in out.parent.iterdir()] == [out.name]


def test_no_thread_is_left(out):
    write(out)
    assert not [t for t in threading.enumerate() if t.name.startswith("hiros-write")]


def test_the_input_is_not_overwritten_under_any_name(tmp_path, out):
    source = write_log(tmp_path / "in.mcap")
    (tmp_path / "soft.mcap").symlink_to(source)
    (tmp_path / "hard.mcap").hardlink_to(source)
    for name in ("in.mcap", "out/../in.mcap", "soft.mcap", "hard.mcap"):
        with pytest.raises(LogError, match="is the input"):
            McapWriter(tmp_path / name, inputs=[source])


def test_what_cannot_be_an_output_is_refused(tmp_path, out):
    os.mkfifo(tmp_path / "fifo")
    for path, reason in [
        (tmp_path / "fifo", "not a regular file"),
        (tmp_path, "not a regular file"),
        (tmp_path / "no" / "folder.mcap", "No such file"),
    ]:
        with pytest.raises(LogError, match=reason):
            McapWriter(path)


def test_an_output_that_is_a_link_stays_one(tmp_path, out):
    out.symlink_to(tmp_path / "target.mcap")
    (tmp_path / "target.mcap").write_text("former")
    write(out)
    assert out.is_symlink()
    assert len(by_library(tmp_path / "target.mcap")) == 40


def test_the_output_has_the_mode_that_the_umask_leaves(out):
    former = os.umask(0o027)
    try:
        assert stat.S_IMODE(write(out).stat().st_mode) == 0o640
    finally:
        os.umask(former)


@pytest.mark.parametrize("kind", KINDS)
def test_copied_channels_keep_ids_times_numbers_and_bytes(tmp_path, out, kind):
    source = write_log(tmp_path / "in.mcap", **KINDS[kind])
    assert kept(copy(source, out)) == by_library(source)
    with McapReader(source) as before, McapReader(out) as after:
        assert {i: after.channels[i] for i in before.channels} == before.channels
        assert after.counts[3] == 40


@pytest.mark.parametrize("kind", KINDS)
def test_of_mixed_chunks_only_the_chosen_channels_are_copied(tmp_path, out, kind):
    source = write_log(tmp_path / "in.mcap", **KINDS[kind])
    copy(source, out, {2})
    assert kept(out) == [m for m in by_library(source) if m[0] == 2]
    with out.open("rb") as file:
        topics = {channel.topic for _, channel, _ in NonSeekingReader(file).iter_messages()}
    assert topics == {"/b", "/new"}


def test_a_chunk_that_is_kept_whole_is_not_compressed_again(tmp_path, out):
    source = write_log(tmp_path / "in.mcap")
    copy(source, out)
    with McapReader(source) as reader:
        pieces = [reader.raw(chunk) for chunk in reader.contents.chunks]
    whole = out.read_bytes()
    assert len(pieces) > 3
    assert all(piece in whole for piece in pieces)


def test_a_damaged_chunk_is_not_copied(tmp_path, out):
    source = write_log(tmp_path / "in.mcap", enable_data_crcs=False)
    whole = bytearray(source.read_bytes())
    with McapReader(source) as reader:
        chunk = reader.contents.chunks[2]
    whole[chunk.data_offset + chunk.data_size // 2] ^= 1
    source.write_bytes(whole)
    with (
        McapReader(source) as reader,
        McapWriter(out) as writer,
        pytest.raises(LogError, match=f"damaged chunk at byte {chunk.offset}"),
    ):
        ChunkCopier(reader, writer, reader.channels).finish()


def test_what_is_appended_lies_behind_what_was_written_before(tmp_path, out):
    source = write_log(tmp_path / "in.mcap", [(1, 7, b"second")])
    with McapReader(source) as reader, McapWriter(out) as writer:
        writer.define(reader.schema(reader.channels[1]))
        writer.define(reader.channels[1])
        writer.write(1, 7, b"first")
        writer.append(reader, reader.channels)
        writer.commit()
    assert [message[2] for message in by_library(out)] == [b"first", b"second"]


def test_new_ids_lie_above_those_of_channels_left_out(tmp_path, out):
    source = write_log(tmp_path / "in.mcap")
    with McapReader(source) as reader, McapWriter(out) as writer:
        ChunkCopier(reader, writer, {1})
        assert writer.add_channel("/new", 0) == 3
        assert writer.add_schema("pkg/msg/New", b"int32 y") == 2


def test_the_new_id_of_a_schema_lies_above_those_of_channels_left_out(tmp_path, out):
    source = write_log(tmp_path / "in.mcap")  # two channels with one schema
    with McapReader(source) as reader, McapWriter(out) as writer:
        writer.copy_definitions(reader, {1})
        (schema,) = reader.contents.schemas.values()
        channel = replace(reader.contents.channels[2], topic="/other")
        new = writer.adopt(channel, replace(schema, data=b"int32 z"))
        assert writer.channels[new].schema_id == 2


def test_wrong_calls_are_errors(out):
    with McapWriter(out) as writer:
        with pytest.raises(ValueError, match="no schema 5"):
            writer.add_channel("/a", 5)
        with pytest.raises(ValueError, match="no channel 7"):
            writer.write(7, 0, b"")
    with pytest.raises(ValueError, match="compression"):
        McapWriter(out, compression="brotli")
