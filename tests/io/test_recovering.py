"""What is left of a damaged log is what was recorded, and what is lost is told."""

from __future__ import annotations

import random

import pytest
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
Row = tuple[int, int, bytes, int, int]


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
    for _ in range(120):
        at = rng.randrange(8 * start, 8 * len(whole))
        damaged = bytearray(whole)
        damaged[at // 8] ^= 1 << at % 8
        rows, recovery = left_of(path, bytes(damaged))
        assert is_part(rows, wanted), at
        assert len(rows) >= 20, at  # of 40; a chunk holds 8 at most
        assert recovery.lost in (None, 40 - len(rows)), (at, recovery)
        partial += len(rows) < 40
    assert partial > 10


@pytest.mark.parametrize("kind", CHUNKED)
@pytest.mark.parametrize("size", [16, 512, 900])
def test_zeros_in_the_middle_cost_the_chunks_that_they_touch(path, kind, size):
    whole = write_log(path, make_messages(200), **KINDS[kind]).read_bytes()
    wanted = by_library(path)
    with McapReader(path) as reader:
        chunks = reader.contents.chunks
    begin = chunks[1].offset if kind == "no-summary" else 9
    end = chunks[-1].index_end - size
    for start in range(begin, end, (end - begin) // 25):
        rows, recovery = left_of(path, whole[:start] + bytes(size) + whole[start + size :])
        hit = [c for c in chunks if c.offset < start + size and c.end > start]
        lost = sum(n for c in hit for n in (c.counts or {}).values())
        assert is_part(rows, wanted)
        assert len(rows) >= 200 - lost, start  # there may have been zeros before
        assert recovery.lost in (None, 200 - len(rows))


def test_what_is_lost_is_told_by_message_indexes_where_there_are_no_statistics(path):
    write_log(path, make_messages(200))
    with McapReader(path) as reader:
        lost = reader.contents.chunks[5]
        end = reader.contents.chunks[-1].index_end
    data = bytearray(path.read_bytes()[:end])
    data[lost.data_offset + 5] ^= 1
    _, recovery = left_of(path, bytes(data))
    first, second = recovery.damages
    assert (first.offset, first.end, first.counts) == (lost.offset, lost.end, lost.counts)
    assert first.sizes is not None
    assert sum(first.sizes.values()) == lost.size - 31 * sum(first.counts.values())
    assert "damaged chunk" in first.fault
    assert (second.offset, second.fault) == (end, "the recording was cut off here")
    assert recovery.lost is None  # behind the cut


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
    # Messages of a channel come every 20 ns.
    assert all(c.lost_s == pytest.approx(20e-9 * (c.lost + 1)) for c in recovery.channels)
    assert all(str(c) in recovery.loss for c in recovery.channels)


@pytest.mark.parametrize("keep", [0, 4, 22])
def test_an_unchunked_log_goes_on_at_the_next_message(path, keep):
    whole = write_log(path, use_chunking=False).read_bytes()
    wanted, places = by_library(path), boundaries(path)
    start, end = places[10] + keep, places[14] + 5  # records 0 to 3 are no messages
    rows, recovery = left_of(path, whole[:start] + bytes(end - start) + whole[end:])
    assert is_part(rows, wanted)
    assert rows[:5] == wanted[:5]
    assert rows[-25:] == wanted[-25:]
    assert recovery.lost == 40 - len(rows) <= 7
    assert recovery.unchecked == len(rows)


def test_messages_of_a_damaged_uncompressed_chunk_are_not_taken(path):
    # The chunk's own length is wrong, so that its messages look like messages outside of chunks.
    whole = bytearray(write_log(path, **KINDS["none"], **NO_SUMMARY).read_bytes())
    with McapReader(path) as reader:
        second = reader.contents.chunks[1]
    whole[second.offset + 6] ^= 1
    rows, _ = left_of(path, bytes(whole))
    assert rows == [row for row in by_library(path) if row not in in_chunk(path, 1)]


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
    assert (loss.topic, loss.lost, loss.lost_bytes) == ("channel 1 without a definition", 1, 7)


def test_the_indexes_of_a_lost_chunk_are_its_own(path):
    first = [channel(), channel(2, "/b"), message(), message(2)]
    at = len(first[0]) + len(first[1])
    parts = [chunk(*first, times=(5, 5)), index(1, [(5, at)]), index(2, [(5, at + len(first[2]))])]
    lost = chunk(message(2), times=(5, 5), crc=1), index(2, [(5, 0)])
    rows, recovery = left_of(path, mcap_file(path, *parts, *lost).read_bytes())
    assert [row[0] for row in rows] == [1, 2]
    assert [damage.counts for damage in recovery.damages] == [{2: 1}]
    assert [(c.topic, c.lost) for c in recovery.channels] == [("/a", 0), ("/b", 1)]


def test_indexes_of_times_of_today_match(path):
    messages = [(c, t + 1_700_000_000_000_000_001, d) for c, t, d in make_messages()]
    _, recovery = left_of(path, write_log(path, messages).read_bytes())
    assert recovery.damages == ()


def test_a_damaged_index_costs_nothing(path):
    inner = [channel(), message(time=5), message(time=6)]
    parts = chunk(*inner, times=(5, 6)), index(1, [(5, 34), (7, 0)])
    rows, recovery = left_of(path, mcap_file(path, *parts).read_bytes())
    assert len(rows) == 2
    assert recovery.complete
    assert "indexes do not match" in recovery.damages[0].fault


@pytest.mark.parametrize(
    ("data", "fault"),
    [
        (b"", "is empty"),
        (b"this is a text", "is not an MCAP file"),
        (r.MAGIC + bytes(5000), "no message of it can be read"),
    ],
)
def test_a_file_of_which_nothing_can_be_read_is_refused(path, data, fault):
    with pytest.raises(LogError, match=fault):
        left_of(path, data)
