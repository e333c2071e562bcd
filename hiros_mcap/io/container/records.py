"""The records of an MCAP file: what hiros reads out of them and how it writes them.

Format: https://mcap.dev/spec. A record is one byte of opcode, eight bytes of content length, the
content; integers are little endian, strings carry their length in front. Records may be followed
by fields of a later version, which are ignored.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
FOOTER = struct.Struct("<QQI")
CHUNK_HEAD = struct.Struct("<QQQI")

HEADER_OP, FOOTER_OP, SCHEMA_OP, CHANNEL_OP, MESSAGE_OP, CHUNK_OP = range(0x01, 0x07)
MESSAGE_INDEX_OP, CHUNK_INDEX_OP, ATTACHMENT_OP, ATTACHMENT_INDEX_OP = range(0x07, 0x0B)
STATISTICS_OP, METADATA_OP, METADATA_INDEX_OP, SUMMARY_OFFSET_OP, DATA_END_OP = range(0x0B, 0x10)
PRIVATE_OP = 0x80
"""Opcodes from here on belong to applications; a reader skips them."""

NAMES = {
    HEADER_OP: "header",
    FOOTER_OP: "footer",
    SCHEMA_OP: "schema",
    CHANNEL_OP: "channel",
    MESSAGE_OP: "message",
    CHUNK_OP: "chunk",
    MESSAGE_INDEX_OP: "message index",
    CHUNK_INDEX_OP: "chunk index",
    ATTACHMENT_OP: "attachment",
    ATTACHMENT_INDEX_OP: "attachment index",
    STATISTICS_OP: "statistics",
    METADATA_OP: "metadata",
    METADATA_INDEX_OP: "metadata index",
    SUMMARY_OFFSET_OP: "summary offset",
    DATA_END_OP: "data end",
}

Bytes = bytes | bytearray | memoryview


def name_of(opcode: int) -> str:
    """Name of a record type for an error message."""
    return NAMES.get(opcode, f"unknown (opcode 0x{opcode:02x})")


class FormatError(ValueError):
    """What is wrong with some bytes; whoever knows the file turns it into a LogError."""


@dataclass(frozen=True, slots=True)
class Schema:
    """A message definition."""

    id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """A stream of messages on a topic; ``schema_id`` 0 means that it has no schema."""

    id: int
    topic: str
    encoding: str
    schema_id: int
    metadata: Mapping[str, str]


class Message(NamedTuple):
    """One message; ``data`` is a view into its chunk, valid as long as somebody holds it."""

    channel_id: int
    log_time: int
    data: memoryview
    publish_time: int
    sequence: int


@dataclass(frozen=True, slots=True)
class Chunk:
    """Where a batch of messages lies in the file and what its record claims of it.

    A run of messages outside of chunks is described as a chunk too, with ``loose`` set: then
    ``offset`` to ``end`` are bare records, neither compressed nor protected by a checksum.
    """

    offset: int
    """First byte of the record."""
    end: int
    """First byte after the record."""
    start_time: int
    """Claimed earliest log time, ns."""
    end_time: int
    """Claimed latest log time, ns."""
    size: int
    """Uncompressed, bytes."""
    crc: int
    """CRC-32 of the uncompressed records, 0 = none."""
    compression: str
    """zstd, lz4 or nothing."""
    data_offset: int
    """First byte of the (compressed) records; they reach to ``data_offset + data_size``."""
    data_size: int
    index_end: int
    """First byte after the message index records that follow the chunk."""
    counts: Mapping[int, int] | None
    """Messages per channel id by the message index; None where the file has no index of it."""
    loose: bool = False

    def holds(self, channels: Iterable[int]) -> bool:
        """Whether any of the channels has a message in here, as far as is known."""
        return self.counts is None or any(i in self.counts for i in channels)


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file inside the file; the bytes stay there until asked for."""

    name: str
    media_type: str
    log_time: int
    create_time: int
    data_offset: int
    data_size: int


@dataclass(frozen=True, slots=True)
class ChunkIndex:
    """A chunk as the summary has it."""

    start_time: int
    end_time: int
    offset: int
    length: int
    index_offsets: Mapping[int, int]
    index_length: int
    compression: str
    data_size: int
    size: int


@dataclass(frozen=True, slots=True)
class Statistics:
    """The counts that the summary claims."""

    messages: int
    schemas: int
    channels: int
    attachments: int
    metadata: int
    chunks: int
    start_time: int
    end_time: int
    counts: Mapping[int, int]


class Cursor:
    """Reads fields one after the other and never past the end of the record."""

    def __init__(self, data: Bytes) -> None:
        self.data = memoryview(data)
        self.at = 0

    def take(self, n: int) -> memoryview:
        """Return the next ``n`` bytes; raises FormatError when there are fewer."""
        if n > len(self.data) - self.at:
            raise FormatError(f"a field of {n} bytes reaches past the end of the record")
        self.at += n
        return self.data[self.at - n : self.at]

    def number(self, width: int) -> int:
        """Return an unsigned integer of 1, 2, 4 or 8 bytes."""
        return int.from_bytes(self.take(width), "little")

    def string(self) -> str:
        """Return a string; raises FormatError when it is not UTF-8."""
        raw = self.take(self.number(4))
        try:
            return str(raw, "utf-8")
        except UnicodeDecodeError:
            raise FormatError("a string is not UTF-8") from None

    def strings(self) -> dict[str, str]:
        """Return a map of strings; raises FormatError when a key occurs twice."""
        inner = Cursor(self.take(self.number(4)))
        found: dict[str, str] = {}
        while inner.at < len(inner.data):
            key, value = inner.string(), inner.string()
            if key in found:
                raise FormatError(f"the key {key!r} occurs twice in a map")
            found[key] = value
        return found

    def numbers(self, key_width: int, value_width: int) -> list[tuple[int, int]]:
        """Return an array of pairs of integers."""
        inner = Cursor(self.take(self.number(4)))
        pairs = []
        while inner.at < len(inner.data):
            pairs.append((inner.number(key_width), inner.number(value_width)))
        return pairs


def parse_schema(content: Bytes) -> Schema:
    """Read a schema from the content of its record."""
    at = Cursor(content)
    return Schema(at.number(2), at.string(), at.string(), bytes(at.take(at.number(4))))


def parse_channel(content: Bytes) -> Channel:
    """Read a channel from the content of its record."""
    at = Cursor(content)
    ident, schema_id = at.number(2), at.number(2)
    return Channel(ident, at.string(), at.string(), schema_id, at.strings())


def parse_chunk_index(content: Bytes) -> ChunkIndex:
    """Read a chunk index from the content of its record."""
    at = Cursor(content)
    start, end, offset, length = (at.number(8) for _ in range(4))
    offsets = dict(at.numbers(2, 8))
    index_length, compression = at.number(8), at.string()
    return ChunkIndex(
        start, end, offset, length, offsets, index_length, compression, at.number(8), at.number(8)
    )


def parse_statistics(content: Bytes) -> Statistics:
    """Read the statistics from the content of their record."""
    at = Cursor(content)
    messages, schemas = at.number(8), at.number(2)
    channels, attachments, metadata, chunks = (at.number(4) for _ in range(4))
    start, end, counts = at.number(8), at.number(8), dict(at.numbers(2, 8))
    return Statistics(
        messages, schemas, channels, attachments, metadata, chunks, start, end, counts
    )


def record(opcode: int, *parts: Bytes) -> bytes:
    """Return the bytes of a record with the given content."""
    return b"".join((HEAD.pack(opcode, sum(map(len, parts))), *parts))


def text(value: str) -> bytes:
    """Return a string with its length in front."""
    raw = value.encode()
    return struct.pack("<I", len(raw)) + raw


def texts(values: Mapping[str, str]) -> bytes:
    """Return a map of strings with its length in front, in sorted order."""
    raw = b"".join(text(part) for key in sorted(values) for part in (key, values[key]))
    return struct.pack("<I", len(raw)) + raw


def pairs(values: Iterable[tuple[int, int]], layout: str) -> bytes:
    """Return an array of pairs with its length in front; ``layout`` as in struct, e.g. HQ."""
    raw = b"".join(struct.pack("<" + layout, *pair) for pair in values)
    return struct.pack("<I", len(raw)) + raw


def build_schema(schema: Schema) -> bytes:
    """Return the record of a schema."""
    body = text(schema.name) + text(schema.encoding) + struct.pack("<I", len(schema.data))
    return record(SCHEMA_OP, struct.pack("<H", schema.id), body, schema.data)


def build_channel(channel: Channel) -> bytes:
    """Return the record of a channel."""
    body = text(channel.topic) + text(channel.encoding) + texts(channel.metadata)
    return record(CHANNEL_OP, struct.pack("<HH", channel.id, channel.schema_id), body)


def build_chunk_index(index: ChunkIndex) -> bytes:
    """Return the record of a chunk index."""
    return record(
        CHUNK_INDEX_OP,
        struct.pack("<QQQQ", index.start_time, index.end_time, index.offset, index.length),
        pairs(index.index_offsets.items(), "HQ"),
        struct.pack("<Q", index.index_length),
        text(index.compression),
        struct.pack("<QQ", index.data_size, index.size),
    )


def build_statistics(stats: Statistics) -> bytes:
    """Return the record of the statistics."""
    fixed = struct.pack(
        "<QHIIIIQQ",
        stats.messages,
        stats.schemas,
        stats.channels,
        stats.attachments,
        stats.metadata,
        stats.chunks,
        stats.start_time,
        stats.end_time,
    )
    return record(STATISTICS_OP, fixed, pairs(sorted(stats.counts.items()), "HQ"))


def build_attachment(name: str, media_type: str, data: Bytes, log_time: int) -> bytes:
    """Return the record of an attachment; its creation time is said to be unknown (0)."""
    fixed = struct.pack("<QQ", log_time, 0) + text(name) + text(media_type)
    content = b"".join((fixed, struct.pack("<Q", len(data)), data))
    return record(ATTACHMENT_OP, content, struct.pack("<I", zlib.crc32(content)))
