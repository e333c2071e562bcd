"""The records of an MCAP file: strict parsing, and what the mcap library has no types for.

Format: https://mcap.dev/spec. A record is one byte of opcode, eight bytes of content length, the
content; integers are little endian, strings carry their length in front. Records may be followed
by fields of a later version, which are ignored.

The types of records are the library's, and so are reading and writing of most of them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from io import BytesIO

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Header,
    McapRecord,
    Message,
    Metadata,
    Schema,
    Statistics,
)

__all__ = [
    "Attachment",
    "AttachmentIndex",
    "Channel",
    "ChunkIndex",
    "DataEnd",
    "Header",
    "McapRecord",
    "Message",
    "Metadata",
    "Opcode",
    "Schema",
    "Statistics",
]

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
FOOTER = struct.Struct("<QQI")
CHUNK_HEAD = struct.Struct("<QQQI")
MAX_CHUNK_HEAD = 128
"""Bytes of a chunk's record that hold everything before its data."""
INDEX_HEAD = struct.Struct("<HI")
"""Channel and bytes of a message index."""

PRIVATE_OP = 0x80
"""Opcodes from here on belong to applications; a reader skips them."""
MAX_CHUNK = 256 * 2**20
"""Largest chunk that is read, bytes uncompressed. Recorders write 0.75 to 4 MiB."""

Bytes = bytes | bytearray | memoryview


def name_of(opcode: int) -> str:
    """Name of a record type for an error message."""
    try:
        return Opcode(opcode).name.lower().replace("_", " ")
    except ValueError:
        return f"unknown (opcode 0x{opcode:02x})"


class FormatError(ValueError):
    """A fault of some bytes. The caller, who knows the file, turns it into a LogError."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Where a chunk of messages lies in the file and what its record claims of it.

    A run of messages outside of chunks is described as a chunk too, with ``loose`` set: then
    ``offset`` to ``end`` are bare records, neither compressed nor protected by a checksum.
    """

    offset: int  # first byte of the record
    end: int  # first byte after the record
    start_time: int  # claimed earliest log time, ns
    end_time: int  # claimed latest log time, ns
    size: int  # uncompressed, bytes
    crc: int  # CRC-32 of the uncompressed records, 0 = none
    compression: str  # zstd, lz4 or nothing
    data_offset: int
    """First byte of the (compressed) records; they reach to ``data_offset + data_size``."""
    data_size: int
    index_end: int  # first byte after the message index records that follow the chunk
    counts: Mapping[int, int] | None
    """Messages per channel id by the message index; None where the file has no index of it."""
    loose: bool = False
    retimed: bool = False  # whether its times are not those of the record, see McapReader.retime

    def holds(self, channels: Iterable[int]) -> bool:
        """Whether any of the channels has a message in here, as far as is known."""
        return self.counts is None or any(i in self.counts for i in channels)


class Cursor(ReadDataStream):
    """Reads fields one after the other and never past the end of the record.

    The library's own stream takes what is there for a field that is cut off.
    """

    def __init__(self, data: Bytes) -> None:
        super().__init__(BytesIO(data))
        self._left = len(data)

    def read(self, length: int) -> bytes:
        """Return the next bytes; raises FormatError when there are fewer."""
        if length > self._left:
            raise FormatError(f"a field of {length} bytes reaches past the end of the record")
        self._left -= length
        return super().read(length)

    def read_prefixed_string(self) -> str:
        """Return a string; raises FormatError when it is not UTF-8."""
        try:
            return super().read_prefixed_string()
        except UnicodeDecodeError:
            raise FormatError("a string is not UTF-8") from None


def parse_chunk(head: Bytes, offset: int, begin: int, stop: int) -> Chunk:
    """Read what a chunk's record claims.

    Parameters
    ----------
    head : its first MAX_CHUNK_HEAD bytes of content, or all. offset : first byte of the record.
    begin, stop : first and past-the-end byte of the content.
    """
    at = Cursor(head)
    start_time, end_time, size, crc = CHUNK_HEAD.unpack(at.read(CHUNK_HEAD.size))
    compression, data_size = at.read_prefixed_string(), at.read8()
    if data_size > stop - begin - at.count:
        raise FormatError("a chunk's data reach past its record")
    if start_time > end_time:
        raise FormatError("a chunk claims to end before it starts")
    if size > MAX_CHUNK:
        raise FormatError(f"a chunk claims {size} bytes uncompressed; the limit is {MAX_CHUNK}")
    data = begin + at.count
    return Chunk(
        offset, stop, start_time, end_time, size, crc, compression, data, data_size, stop, None
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


def build(record: McapRecord) -> bytes:
    """Return the bytes of a record as the library writes it, a channel's metadata sorted."""
    if isinstance(record, Channel):
        record = replace(record, metadata=dict(sorted(record.metadata.items())))
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
