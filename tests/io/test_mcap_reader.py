import contextlib
import itertools
import os
import random
import threading

import pytest
from mcap.writer import IndexType
from mcap_logs import (
    KINDS,
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
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.container import records as r
from hiros_mcap.io.container.file import LogFile


def read(path, channels=None):
    with McapReader(path) as reader:
        return [
            (m.channel_id, m.log_time, bytes(m.data), m.publish_time, m.sequence)
            for m in reader.messages(channels)
        ]


def fault_of(path):
    with pytest.raises(LogError) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "log.mcap"


class Counting(McapReader):
    """A reader that notes which chunks it decompressed."""

    def load(self, chunk):
        self.loaded = [*getattr(self, "loaded", []), chunk.offset]
        return super().load(chunk)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_container_reads_as_the_library_reads_it(path, kind):
    write_log(path, **KINDS[kind])
    assert read(path) == by_library(path)


@pytest.mark.parametrize("size", [1, 100])
def test_a_disk_that_gives_a_few_bytes_at_a_time_gives_the_same(size, path, monkeypatch):
    wanted, whole = read(write_log(path)), LogFile._read_at
    monkeypatch.setattr(LogFile, "_read_at", lambda file, at, n: whole(file, at, min(n, size)))
    assert read(path) == wanted


@pytest.mark.parametrize("kind", KINDS)
def test_definitions_and_counts_are_known_before_any_message_is_read(path, kind):
    with McapReader(write_log(path, **KINDS[kind])) as reader:
        assert {c.topic: c.metadata for c in reader.channels.values()} == {
            "/a": {"qos": "/a"},
            "/b": {"qos": "/b"},
        }
        assert reader.schema(reader.channels[1]).data == b"int32 x"
        assert reader.counts == {1: 20, 2: 20}


@pytest.mark.parametrize("given", [True, False])
def test_it_is_known_whether_the_data_section_has_a_checksum(path, given):
    with McapReader(write_log(path, enable_data_crcs=given)) as reader:
        assert reader.contents.has_data_crc == given


@pytest.mark.parametrize(
    ("options", "given"),
    [
        ({"enable_crcs": False, "enable_data_crcs": False}, False),
        ({"enable_crcs": False}, True),
        ({"enable_data_crcs": False}, True),
        ({"enable_data_crcs": False, "use_chunking": False}, False),
        ({"use_chunking": False}, True),
    ],
)
def test_it_is_known_whether_checksums_protect_every_message(path, options, given):
    with McapReader(write_log(path, **options)) as reader:
        assert reader.has_checksums == given


def test_attachments_and_metadata_are_found(path):
    with McapReader(write_log(path)) as reader:
        (attachment,) = reader.contents.attachments
        assert (attachment.name, reader.attachment("note.txt")) == ("note.txt", b"some note")
        assert reader.contents.metadata == [("about", {"key": "value"})]


@pytest.mark.parametrize("beyond", range(1, 13))
def test_an_attachment_may_not_claim_a_byte_more_than_its_record_has(beyond, path):
    data = bytearray(write_log(path, enable_crcs=False, enable_data_crcs=False).read_bytes())
    at = data.index(b"text/plain", data.index(b"some note") - 30) + len(b"text/plain")
    data[at] += beyond
    path.write_bytes(data)
    assert "an attachment's data reach past its record" in fault_of(path)


def test_every_combination_of_optional_records_is_read(path):
    names = ("repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets")
    indexes = (IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE, IndexType.ALL)
    wanted = [(c, t, d, t + 1, k) for k, (c, t, d) in enumerate(make_messages())]
    for chunked, kind, *flags in itertools.product((True, False), indexes, *[(True, False)] * 4):
        options = dict(zip(names, flags, strict=True), use_chunking=chunked, index_types=kind)
        assert read(write_log(path, **options)) == wanted, options


def test_a_log_without_anything_has_no_messages(path):
    assert read(mcap_file(path)) == []


def test_a_channel_without_schema_is_read(path):
    assert [m[2] for m in read(mcap_file(path, channel(), message(data=b"x")))] == [b"x"]


def test_fields_and_records_of_later_versions_are_skipped(path):
    private = r.record(0x99, b"whatever")
    inner = (channel(extra=b"123"), private, message())
    records = chunk(*inner, extra=b"1234567"), index(1, [(5, 0)], extra=b"123"), private
    assert len(read(mcap_file(path, *records, private, header_extra=b"123"))) == 1


def test_a_chunk_of_several_zstd_frames_is_read_whole(path):
    parts = chunk(channel(), message(), compression="zstd"), chunk(message(), compression="zstd")
    packed = b"".join(part[9 + 28 + 8 + 8 :] for part in parts)
    plain = (channel(), message(), message())
    assert len(read(mcap_file(path, chunk(*plain, compression="zstd", packed=packed)))) == 2


def test_messages_come_by_time_from_chunks_that_overlap_and_are_not_sorted(path):
    rng = random.Random(3)
    messages = [(1, rng.randrange(1000, 1400), bytes([k])) for k in range(200)]
    write_log(path, messages, chunk_size=300)
    got = [(m[1], m[2]) for m in read(path)]
    assert got == sorted(((t, d) for _, t, d in messages), key=lambda item: item[0])


def overlapping(path, times):
    """20 chunks of 10 messages of 100 bytes, whose times overlap."""
    messages = [(1 + k % 2, times(k), bytes([k]) * 100) for k in range(200)]
    return write_log(path, messages, chunk_size=1100)


def test_chunks_that_overlap_too_much_name_the_limit_and_the_option(path):
    overlapping(path, lambda k: 1000 + 97 * k % 200)
    with McapReader(path, memory=40_000) as reader:
        assert reader.contents.chunks[0].size < 20_000 < sum(c.size for c in reader.contents.chunks)
        with pytest.raises(LogError) as caught:
            list(reader.messages())
    assert "its chunks of one time take" in str(caught.value)
    assert "--memory GIB raises the limit" in str(caught.value)
    with McapReader(path, memory=100_000) as reader:
        assert len(list(reader.messages())) == 200


def test_chunks_that_follow_each_other_may_be_larger_than_the_limit(path):
    overlapping(path, lambda k: 1000 + k)
    with McapReader(path, memory=10_000) as reader:
        assert len(list(reader.messages())) == 200


def test_messages_of_equal_time_come_in_the_order_of_the_file(path):
    messages = [(1 + k % 2, 7, bytes([k])) for k in range(100)]
    write_log(path, messages, chunk_size=200)
    assert [m[2] for m in read(path)] == [data for _, _, data in messages]


def test_only_chunks_near_the_current_time_are_held(path):
    write_log(path, make_messages(200), chunk_size=100)
    with Counting(path) as reader:
        messages = reader.messages()
        next(messages)
        assert len(reader.loaded) <= 4 < len(reader.contents.chunks)
        messages.close()


def test_chunks_without_the_chosen_channels_are_not_decompressed(path):
    write_log(path, [(1, k, bytes(90)) for k in range(20)] + [(2, 30, b"x")], chunk_size=100)
    with Counting(path) as reader:
        assert [m.data for m in reader.messages({2})] == [b"x"]
        assert len(reader.loaded) == 1


def test_chunks_that_touch_a_span_are_read_and_others_are_not(path):
    write_log(path, [(1, 10 * k, bytes(90)) for k in range(20)], chunk_size=300)
    with Counting(path) as reader:
        chunks = reader.contents.chunks
        spans = [(chunks[1].end_time, chunks[2].start_time)]
        list(reader.batches(spans=spans))
        assert reader.loaded == [chunk.offset for chunk in chunks[1:3]]


@pytest.mark.parametrize("kind", KINDS)
def test_a_log_cut_anywhere_is_refused(path, kind):
    whole = write_log(path, make_messages(2), **KINDS[kind]).read_bytes()
    assert "is empty" in fault_of(write_bytes(path, b""))
    for n in range(1, len(whole)):
        assert "truncated" in fault_of(write_bytes(path, whole[:n])), n


def write_bytes(path, data):
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_no_flipped_bit_changes_a_message_in_silence(path, kind):
    whole = write_log(path, **KINDS[kind]).read_bytes()
    wanted, rng, refused = read(path), random.Random(kind), 0
    for _ in range(150):
        at = rng.randrange(8 * len(whole))
        damaged = bytearray(whole)
        damaged[at // 8] ^= 1 << at % 8
        try:
            assert read(write_bytes(path, damaged)) == wanted, at
        except LogError:
            refused += 1
    assert refused > 100


@pytest.mark.parametrize("kind", ["zstd", "lz4", "none"])
def test_chunk_checksums_alone_protect_the_messages(path, kind):
    whole = write_log(path, **KINDS[kind], enable_data_crcs=False).read_bytes()
    wanted, rng = read(path), random.Random(kind)
    for _ in range(150):
        damaged = bytearray(whole)
        at = rng.randrange(8 * len(whole))
        damaged[at // 8] ^= 1 << at % 8
        with contextlib.suppress(LogError):
            assert read(write_bytes(path, damaged)) == wanted, at


FAULTS = {
    "nested chunk": ([channel(), chunk(chunk(message()))], "not allowed in a chunk"),
    "short message": ([chunk(channel(), r.record(5, bytes(21)))], "shorter than its fixed"),
    "short loose message": ([channel(), r.record(5, bytes(21))], "shorter than its fixed"),
    "chunk ends in a message": ([chunk(channel(), message()[:-3])], "past the end of the chunk"),
    "chunk ends in a head": ([chunk(channel(), b"\5\0")], "past the end of the chunk"),
    "unknown channel": ([chunk(message(ident=9))], "channel 9, which is not defined"),
    "unknown channel outside": ([message(ident=9)], "channel 9, which is not defined"),
    "channel defined twice": ([channel(), channel(topic="/b")], "defined twice"),
    "defined twice in chunks": (
        [chunk(channel()), chunk(channel(topic="/b"), message())],
        "defined twice",
    ),
    "outside of its times": ([chunk(channel(), message(time=101))], "outside of the times"),
    "ends before it starts": ([chunk(times=(5, 4))], "ends before|end before"),
    "wrong checksum": ([chunk(channel(), message(), crc=1)], "checksum is wrong"),
    "wrong size": ([chunk(channel(), message(), size=10)], "does not decompress"),
    "unknown compression": ([chunk(compression="br", packed=b"x")], "unknown compression 'br'"),
    "not zstd": ([chunk(message(), compression="zstd", packed=b"junk")], "zstd"),
    "not lz4": ([chunk(message(), compression="lz4", packed=b"junk")], "lz4"),
    "huge claim": ([chunk(size=2**40)], "the limit is"),
    "bomb": ([chunk(bytes(2**25), compression="zstd", size=100)], "does not decompress"),
    "lz4 bomb": ([chunk(bytes(2**25), compression="lz4", size=100)], "lz4"),
    "index without chunk": ([channel(), index(1, [])], "does not follow a chunk"),
    "index twice": ([chunk(), index(1, []), index(1, [])], "two message indexes"),
    "index lies": ([chunk(channel(), message()), index(1, [(5, 0)] * 2)], "do not match"),
    "index of another": (
        [channel(2), chunk(channel(), message()), index(2, [(5, 0)])],
        "do not match",
    ),
    "reserved opcode": ([r.record(0x20, b"")], "not allowed here"),
    "opcode 0": ([r.record(0, b"")], "not allowed here"),
    "footer too early": ([r.record(r.Opcode.FOOTER, bytes(20))], "not allowed here"),
    "not UTF-8": ([channel(topic="/a").replace(b"/a", b"\xff\xff")], "not UTF-8"),
    "schema missing": ([channel().replace(b"\1\0\0\0", b"\1\0\7\0")], "no schema 7"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_malformed_log_is_refused_with_the_reason(path, name):
    data, reason = FAULTS[name]
    fault = fault_of(mcap_file(path, *data))
    assert any(part in fault for part in reason.split("|")), fault


def test_bytes_after_the_end_are_refused(path):
    assert "4 bytes follow" in fault_of(mcap_file(path, tail=b"more"))


def test_two_logs_in_one_file_are_refused(path):
    whole = write_log(path).read_bytes()
    assert "follow the end" in fault_of(write_bytes(path, whole + whole))


def test_a_record_longer_than_the_file_is_refused(path):
    whole = bytearray(mcap_file(path, channel(), message()).read_bytes())
    at = whole.index(channel()) + 1
    whole[at : at + 8] = (2**63).to_bytes(8, "little")
    assert "inside a channel record" in fault_of(write_bytes(path, whole))


def test_statistics_that_claim_other_messages_are_refused(path):
    path = write_log(path, use_chunking=False)
    whole = bytearray(path.read_bytes())
    at = whole.index(b"\x0b", whole.rindex(b"int32 x"))
    assert whole[at + 9] == 40
    whole[at + 9] = 41
    footer = len(whole) - 8 - 4
    whole[footer : footer + 4] = bytes(4)
    assert "statistics claim 41 messages, there are 40" in fault_of(write_bytes(path, whole))


def test_a_text_file_is_not_an_mcap(path):
    assert "is not an MCAP file" in fault_of(write_bytes(path, b"hello, world, this is text"))


def test_what_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    assert "not a regular file" in fault_of(tmp_path / "fifo")
    assert "not a regular file" in fault_of(tmp_path)
    assert "No such file" in fault_of(tmp_path / "absent")


def test_a_log_that_changes_while_it_is_read_is_refused(path):
    with McapReader(write_log(path)) as reader, pytest.raises(LogError, match="changed while"):
        for _ in reader.messages():
            os.utime(path, ns=(0, 0))


def test_a_reader_that_is_left_early_leaves_no_thread(path):
    with McapReader(write_log(path)) as reader:
        messages = reader.messages()
        next(messages)
        messages.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("hiros-read")]


def test_an_error_of_the_reading_thread_comes_at_its_chunk(path):
    good = [chunk(channel(), message(time=k), times=(k, k)) for k in range(5)]
    entries = [index(1, [(k, 0)]) for k in range(5)]
    bad = chunk(message(time=9), times=(9, 9), crc=1), index(1, [(9, 0)])
    mcap_file(path, channel(), *itertools.chain(*zip(good, entries, strict=True)), *bad)
    with McapReader(path) as reader:
        messages = reader.messages()
        assert [next(messages).log_time for _ in range(5)] == list(range(5))
        with pytest.raises(LogError, match="checksum"):
            next(messages)
