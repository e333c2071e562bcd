"""The rest of a damaged log is as recorded, and losses are told."""

from __future__ import annotations

import random
import struct

import pytest
from mcap.writer import IndexType
from mcap_logs import (
    KINDS,
    NO_SUMMARY,
    by_library,
    channel,
    chunk,
    index,
    make_messages,
    mcap_file,
    message,
    write_log,
)

from hiros_mcap.errors import LogError
from hiros_mcap.io.container import McapReader, RecoveringReader
from hiros_mcap.io.container import records as r

CHUNKED = sorted(KINDS.keys() - {"unchunked"})
COUNTED_ONLY = {"index_types": IndexType.NONE, "enable_data_crcs": False}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "log.mcap"


def left_of(path, data):
    """Messages that are read of some bytes, and what was lost."""
    damaged = path.with_name("damaged.mcap")
    damaged.write_bytes(data)
    with RecoveringReader(damaged) as reader:
        rows = [
            (m.channel_id, m.log_time, bytes(m.data), m.publish_time, m.sequence)
            for m in reader.messages()
        ]
        return rows, reader.recovery


def is_part(rows, of):
    """Whether rows are some of the others, in their order."""
    rest = iter(of)
    return all(row in rest for row in rows)


def boundaries(path):
    """First bytes of the records of a file, and its length."""
    data, at, found = path.read_bytes(), len(r.MAGIC), []
    while at < len(data) - len(r.MAGIC):
        found.append(at)
        at += r.HEAD.size + r.HEAD.unpack_from(data, at)[1]
    return [*found, len(data)]


@pytest.mark.parametrize("kind", KINDS)
def test_a_healthy_log_is_complete(path, kind):
    rows, recovery = left_of(path, write_log(path, **KINDS[kind]).read_bytes())
    assert rows == by_library(path)
    assert (recovery.damages, recovery.lost, recovery.complete) == ((), 0, True)


@pytest.mark.parametrize("kind", KINDS)
def test_a_log_cut_anywhere_gives_everything_before_its_last_chunk(path, kind):
    whole = write_log(path, **KINDS[kind]).read_bytes()
    wanted, places = by_library(path), boundaries(path)
    with McapReader(path) as reader:
        chunks = [] if kind == "unchunked" else reader.contents.chunks
    for cut in {*places[1:-1], *(p + 5 for p in places[1:-1]), *(p - 5 for p in places[1:])}:
        ended = [c for c in chunks if c.end <= cut]
        try:
            rows, recovery = left_of(path, whole[:cut])
        except LogError as error:
            assert not ended, cut
            assert "can be read" in str(error)
            continue
        assert rows == wanted[: len(rows)], cut
        assert recovery.damages
        assert recovery.complete == (recovery.lost == 0)
        if recovery.complete:
            assert rows == wanted
        if chunks:
            with_counts = sum(n for c in ended for n in (c.counts or {}).values())
            assert len(rows) == with_counts


@pytest.mark.parametrize("kind", CHUNKED)
@pytest.mark.parametrize("data_crc", [True, False])
def test_no_flipped_bit_changes_a_recovered_message(path, kind, data_crc):
    options = {**KINDS[kind], "enable_data_crcs": data_crc}
    whole = write_log(path, **options).read_bytes()
    wanted, rng, partial = by_library(path), random.Random(kind), 0
    # Without a summary, the first chunk alone defines the channels.
    start = boundaries(path)[2] if kind == "no-summary" else 0
    for _ in range(60):
        at = rng.randrange(8 * start, 8 * len(whole))
        damaged = bytearray(whole)
        damaged[at // 8] ^= 1 << at % 8
        rows, recovery = left_of(path, bytes(damaged))
        assert is_part(rows, wanted), at
        if kind != "no-summary":  # which tells where the next chunk is
            assert len(rows) >= 20, at  # of 40; a chunk holds 8 at most
        assert recovery.lost in (None, 40 - len(rows)), (at, recovery)
        partial += len(rows) < 40
    assert partial > 5


@pytest.mark.parametrize("kind", CHUNKED)
@pytest.mark.parametrize("size", [16, 512, 900])
def test_zeros_in_the_middle_cost_the_chunks_that_they_touch(path, kind, size):
    whole = write_log(path, make_messages(200), **KINDS[kind]).read_bytes()
    wanted = by_library(path)
    with McapReader(path) as reader:
        chunks = reader.contents.chunks
    begin = chunks[1].offset if kind == "no-summary" else 9
    end = chunks[-1].index_end - size
    for start in range(begin, end, (end - begin) // 12):
        rows, recovery = left_of(path, whole[:start] + bytes(size) + whole[start + size :])
        until = len(whole) if kind == "no-summary" else start + size
        hit = [c for c in chunks if c.offset < until and c.end > start]
        lost = sum(n for c in hit for n in (c.counts or {}).values())
        assert is_part(rows, wanted)
        assert len(rows) >= 200 - lost, start  # there may have been zeros before
        assert recovery.lost in (None, 200 - len(rows))


def test_chunks_behind_a_damaged_one_are_kept_without_a_summary(path):
    write_log(path, make_messages(200))
    with McapReader(path) as reader:
        lost = reader.contents.chunks[5]
        end = reader.contents.chunks[-1].index_end
    data = bytearray(path.read_bytes()[:end])
    data[lost.data_offset + 5] ^= 1
    rows, recovery = left_of(path, bytes(data))
    assert rows == [row for row in by_library(path) if row not in in_chunk(path, 5)]
    first, second = recovery.damages
    assert (first.offset, first.end, first.lost) == (lost.offset, lost.end, "messages")
    assert "damaged chunk" in first.fault
    assert (second.offset, second.fault) == (end, "the recording was cut off here")
    assert recovery.lost is None
    assert f"all from byte {end} on" in recovery.loss


@pytest.mark.parametrize("options", [{}, NO_SUMMARY])
def test_a_summary_leads_to_the_chunk_that_a_wrong_length_hides(path, options):
    data = bytearray(write_log(path, make_messages(200), **options).read_bytes())
    with McapReader(path) as reader:
        lost, hidden, following = reader.contents.chunks[5:8]
    struct.pack_into("<Q", data, lost.offset + 1, following.offset - lost.offset - r.HEAD.size)
    rows, recovery = left_of(path, bytes(data))
    gone = in_chunk(path, 5) + (in_chunk(path, 6) if options else [])
    assert rows == [row for row in by_library(path) if row not in gone]
    end = following.offset if options else hidden.offset
    assert [(d.offset, d.end) for d in recovery.damages] == [(lost.offset, end)]
    assert recovery.lost == (None if options else 200 - len(rows))


@pytest.mark.parametrize("options", [{}, COUNTED_ONLY, NO_SUMMARY])
def test_a_chunk_that_looks_like_another_record_is_no_silent_loss(path, options):
    data = bytearray(write_log(path, **options).read_bytes())
    with McapReader(path) as reader:
        lost = reader.contents.chunks[1]
    data[lost.offset] = 0x86  # a private record, which readers skip
    rows, recovery = left_of(path, bytes(data))
    assert rows == [row for row in by_library(path) if row not in in_chunk(path, 1)]
    assert recovery.lost == (None if options is NO_SUMMARY else 40 - len(rows))
    assert recovery.damages
    assert not recovery.complete


def test_message_indexes_of_a_damaged_log_are_not_copied(path):
    data = bytearray(write_log(path, make_messages(200)).read_bytes())
    assert has_indexes(path, data)
    with McapReader(path) as reader:
        data[reader.contents.chunks[5].data_offset + 5] ^= 1
    assert not has_indexes(path, data)


def has_indexes(path, data):
    path.write_bytes(data)
    with RecoveringReader(path) as reader:
        return any(chunk.index_end > chunk.end for chunk in reader.contents.chunks)


def test_metadata_behind_a_damaged_attachment_are_left(path):
    data = bytearray(write_log(path).read_bytes())
    with McapReader(path) as reader:
        (attachment,) = reader.contents.attachments
        rows = [(m.channel_id, bytes(m.data)) for m in reader.messages()]
    data[attachment.offset + 7] ^= 1  # its length
    path.write_bytes(data)
    with RecoveringReader(path) as reader:
        assert [(m.channel_id, bytes(m.data)) for m in reader.messages()] == rows
        assert reader.contents.attachments == []
        assert reader.contents.metadata == [("about", {"key": "value"})]


def test_statistics_tell_what_is_lost_of_each_channel(path):
    data = bytearray(write_log(path, make_messages(200)).read_bytes())
    with McapReader(path) as reader:
        lost = reader.contents.chunks[5]
    data[lost.data_offset + 5] ^= 1
    _, recovery = left_of(path, bytes(data))
    assert {c.topic: c.lost for c in recovery.channels} == {
        "/a": (lost.counts or {})[1],
        "/b": (lost.counts or {})[2],
    }
    assert all(str(c) in recovery.loss for c in recovery.channels)


@pytest.mark.parametrize("keep", [0, 4, 22])
def test_an_unchunked_log_is_read_up_to_the_damage(path, keep):
    whole = write_log(path, use_chunking=False, attachment=False).read_bytes()
    wanted, places = by_library(path), boundaries(path)
    start, end = places[10] + keep, places[14] + 5  # records 0 to 3 are no messages
    rows, recovery = left_of(path, whole[:start] + bytes(end - start) + whole[end:])
    assert rows == wanted[: 6 if keep else 5]  # without the one that nothing follows
    assert recovery.lost == 40 - len(rows)
    assert recovery.unchecked == len(rows)
    damaged_at = places[10] if keep else places[9]
    assert f"all from byte {damaged_at} on" in recovery.loss


@pytest.mark.parametrize("length", [None, 2**40])
def test_messages_of_a_damaged_uncompressed_chunk_are_not_taken(path, length):
    # The chunk's own length is wrong, so that its messages look like messages outside of chunks.
    whole = bytearray(write_log(path, **KINDS["none"], **NO_SUMMARY).read_bytes())
    with McapReader(path) as reader:
        second = reader.contents.chunks[1]
    if length is None:
        length = second.data_offset - second.offset - r.HEAD.size
        assert whole[second.data_offset] == r.Opcode.MESSAGE
    struct.pack_into("<Q", whole, second.offset + 1, length)
    rows, recovery = left_of(path, bytes(whole))
    assert rows == in_chunk(path, 0)
    assert recovery.lost is None
    assert f"all from byte {recovery.damages[-1].offset} on" in recovery.loss


def in_chunk(path, number):
    with McapReader(path) as reader:
        chunk_of = reader.contents.chunks[number]
        return [
            (m.channel_id, m.log_time, bytes(m.data), m.publish_time, m.sequence)
            for m in reader.messages_in(chunk_of)
        ]


def test_messages_whose_channel_is_lost_are_counted(path):
    parts = [chunk(channel(), message(), crc=1), chunk(channel(2, "/b"), message(), message(2))]
    rows, recovery = left_of(path, mcap_file(path, *parts).read_bytes())
    assert [row[0] for row in rows] == [2]
    (loss,) = (c for c in recovery.channels if c.topic != "/b")
    assert (loss.topic, loss.lost) == ("channel 1 without a definition", 1)


def test_the_indexes_of_a_lost_chunk_are_no_damage(path):
    first = [channel(), channel(2, "/b"), message(), message(2)]
    at = len(first[0]) + len(first[1])
    parts = [chunk(*first, times=(5, 5)), index(1, [(5, at)]), index(2, [(5, at + len(first[2]))])]
    lost = chunk(message(2), times=(5, 5), crc=1), index(2, [(5, 0)])
    rows, recovery = left_of(path, mcap_file(path, *parts, *lost).read_bytes())
    assert [row[0] for row in rows] == [1, 2]
    assert len(recovery.damages) == 1
    assert [(c.topic, c.lost) for c in recovery.channels] == [("/a", None), ("/b", None)]


def test_indexes_of_times_of_today_match(path):
    messages = [(c, t + 1_700_000_000_000_000_001, d) for c, t, d in make_messages()]
    _, recovery = left_of(path, write_log(path, messages).read_bytes())
    assert recovery.damages == ()


def test_a_damaged_index_costs_nothing(path):
    inner = [channel(), message(time=5), message(time=6)]
    parts = chunk(*inner, times=(5, 6)), index(1, [(5, 34)])
    rows, recovery = left_of(path, mcap_file(path, *parts).read_bytes())
    assert len(rows) == 2
    assert recovery.complete
    assert "indexes do not match" in recovery.damages[0].fault
