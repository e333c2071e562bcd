"""One walk over a whole MCAP file that finds what is there and refuses what is damaged.

No chunk is decompressed. What exists is decided by the walk alone: the summary at the end of the
file may add definitions, and wherever it contradicts the data the file is refused.
"""

from __future__ import annotations

import shlex
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from hiros_mcap.errors import LogError
from hiros_mcap.io.container import records as r
from hiros_mcap.io.container.compression import MAX_CHUNK
from hiros_mcap.io.container.file import LogFile
from hiros_mcap.io.container.records import FormatError, Opcode

MAX_RECORD = 64 * 2**20
"""Largest definition, metadata or summary record that is read, bytes."""
_RUN = 1 << 20
_AHEAD = 1 << 14
_INDEX = struct.Struct("<HI")  # channel and bytes of a message index
_NAMES = 1 << 18

Definition = TypeVar("Definition", r.Schema, r.Channel)


def remedy(path: Path | str) -> str:
    """Return what helps against a damaged file."""
    return f"`hiros recover {shlex.quote(str(path))}` saves what is readable"


@dataclass(slots=True)
class Contents:
    """What the walk found."""

    profile: str = ""
    library: str = ""
    schemas: dict[int, r.Schema] = field(default_factory=dict)
    channels: dict[int, r.Channel] = field(default_factory=dict)
    chunks: list[r.Chunk] = field(default_factory=list)
    attachments: list[r.AttachmentIndex] = field(default_factory=list)
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    statistics: r.Statistics | None = None
    has_data_crc: bool = False

    def define(self, opcode: int, content: r.Bytes) -> int:
        """Note a schema or channel, return its id; raises FormatError if it had another meaning."""
        if opcode == Opcode.SCHEMA:
            schema = r.parse_schema(content)
            # The format asks readers to ignore a schema with the id that means "none".
            return _put(self.schemas, schema, "schema") if schema.id else 0
        return _put(self.channels, r.parse_channel(content), "channel")


def _put(table: dict[int, Definition], new: Definition, kind: str) -> int:
    if table.setdefault(new.id, new) != new:
        raise FormatError(f"{kind} {new.id} is defined twice, differently")
    return new.id


def scan(file: LogFile, *, checksum: bool = True) -> Contents:
    """Walk the file; raises LogError naming the fault and its place.

    Without ``checksum`` that of the data section is left alone, which saves reading all of it.
    """
    return Scan(file, checksum=checksum).run()


@dataclass(slots=True)
class _LooseMessages:
    """Consecutive messages outside of chunks, to be read as one chunk."""

    offset: int
    end: int
    first: int
    final: int
    counts: Counter[int] = field(default_factory=Counter)

    def chunk(self) -> r.Chunk:
        start, size = self.offset, self.end - self.offset
        return r.Chunk(
            offset=start,
            end=self.end,
            start_time=self.first,
            end_time=self.final,
            size=size,
            crc=0,
            compression="",
            data_offset=start,
            data_size=size,
            index_end=self.end,
            counts=dict(self.counts),
            loose=True,
        )


class Scan:
    """The walk: where it is, and what it has found so far."""

    def __init__(self, file: LogFile, *, checksum: bool = True) -> None:
        self.file = file
        self.checksum = checksum
        self.found = Contents()
        self.at = 0
        self._ahead = b""
        self._ahead_at = 0
        self._run: _LooseMessages | None = None
        self._chunk_indexes: list[r.ChunkIndex] = []
        self._index: dict[int, int] | None = None  # counts by channel, right after a chunk only
        self._index_end = 0

    def run(self) -> Contents:
        """Find what is there; raises LogError for any damage."""
        try:
            self._opening()
            self._sections()
            self._agreement()
        except (FormatError, struct.error) as fault:
            raise LogError(
                f"damaged at byte {self.at}: {fault}; {remedy(self.file.path)}",
                path=self.file.path,
            ) from None
        except MemoryError:
            raise LogError("is too large for the memory", path=self.file.path) from None
        self.file.check_unchanged()
        return self.found

    def _opening(self) -> None:
        start = self.file.read(0, min(len(r.MAGIC), self.file.size))
        if not start:
            raise LogError("is empty (0 bytes)", path=self.file.path)
        if start != r.MAGIC[: len(start)]:
            raise LogError("is not an MCAP file", path=self.file.path)
        self.at = len(r.MAGIC)
        if self.file.size < self.at:
            raise self._truncated("inside its first bytes")

    def _sections(self) -> None:
        """Walk header, data section, summary and footer."""
        opcode, begin, stop = self._next()
        if opcode != Opcode.HEADER:
            raise FormatError(f"a header is expected, not a {r.name_of(opcode)} record")
        at = r.Cursor(self._content(begin, stop))
        self.found.profile, self.found.library = at.string(), at.string()
        self.at = stop
        self._section(self._data_records(), Opcode.DATA_END)
        self._data_end()
        start = self.at
        self._section(self._summary_records(), Opcode.FOOTER)
        self._footer(start)

    def _section(self, known: dict[int, Callable[[int, int], None]], last: int) -> None:
        """Hand every record to its reader until the record that ends the section."""
        while True:
            opcode, begin, stop = self._next()
            if self._run is not None and opcode not in (
                Opcode.SCHEMA,
                Opcode.CHANNEL,
                Opcode.MESSAGE,
            ):
                self._end_run()
            if self._index is not None and opcode != Opcode.MESSAGE_INDEX:
                self._end_index()
            if opcode == last:
                return
            if opcode in known:
                known[opcode](begin, stop)
            elif opcode < r.PRIVATE_OP:
                raise FormatError(f"a {r.name_of(opcode)} record is not allowed here")
            self.at = stop

    def _data_records(self) -> dict[int, Callable[[int, int], None]]:
        return {
            Opcode.SCHEMA: self._loose_definition,
            Opcode.CHANNEL: self._loose_definition,
            Opcode.MESSAGE: self._loose_message,
            Opcode.CHUNK: self._chunk,
            Opcode.MESSAGE_INDEX: self._message_index,
            Opcode.ATTACHMENT: self._attachment,
            Opcode.METADATA: self._metadata,
        }

    def _summary_records(self) -> dict[int, Callable[[int, int], None]]:
        return {
            Opcode.SCHEMA: self._definition,
            Opcode.CHANNEL: self._definition,
            Opcode.STATISTICS: self._statistics,
            Opcode.CHUNK_INDEX: self._chunk_index,
            Opcode.ATTACHMENT_INDEX: self._skip,
            Opcode.METADATA_INDEX: self._skip,
            Opcode.SUMMARY_OFFSET: self._skip,
        }

    # -- bytes ---------------------------------------------------------------------------------

    def _next(self) -> tuple[int, int, int]:
        """Opcode, first content byte and past-the-end byte of the record at ``self.at``."""
        left = self.file.size - self.at
        if left < r.HEAD.size:
            raise self._short("before its footer")
        opcode, length = self._fields(self.at, r.HEAD)
        begin = self.at + r.HEAD.size
        if length > self.file.size - begin:
            raise self._short(f"inside a {r.name_of(opcode)} record")
        return opcode, begin, begin + length

    def _closed(self) -> bool:
        """Whether the file ends as a complete one does."""
        end = self.file.size - len(r.MAGIC)
        return end >= len(r.MAGIC) and self.file.read(end, len(r.MAGIC)) == r.MAGIC

    def _short(self, where: str) -> Exception:
        if self._closed():
            return FormatError(f"the log ends {where}")
        return self._truncated(where)

    def _truncated(self, where: str) -> LogError:
        return LogError(
            f"truncated: the file ends at byte {self.file.size}, {where} at byte {self.at}; "
            f"the recording was cut off; {remedy(self.file.path)}",
            path=self.file.path,
        )

    def _peek(self, offset: int, n: int) -> bytes:
        """Return a few bytes, read ahead in blocks because most records are small."""
        start = offset - self._ahead_at
        if start < 0 or start + n > len(self._ahead):
            self._ahead = self.file.read(offset, min(max(n, _AHEAD), self.file.size - offset))
            self._ahead_at, start = offset, 0
        return self._ahead[start : start + n]

    def _fields(self, offset: int, form: struct.Struct) -> tuple[Any, ...]:
        """Return fixed fields; as :meth:`_peek`, without a copy."""
        start = offset - self._ahead_at
        if start < 0 or start + form.size > len(self._ahead):
            return form.unpack(self._peek(offset, form.size))
        return form.unpack_from(self._ahead, start)

    def _content(self, begin: int, stop: int) -> bytes:
        if stop - begin > MAX_RECORD:
            raise FormatError(f"a record of {stop - begin} bytes; the limit is {MAX_RECORD}")
        return self._peek(begin, stop - begin)

    # -- data section --------------------------------------------------------------------------

    def _skip(self, begin: int, stop: int) -> None:
        """Pass over a record that hiros has no use for."""

    def _definition(self, begin: int, stop: int) -> None:
        opcode = self._peek(self.at, 1)[0]
        self.found.define(opcode, self._content(begin, stop))

    def _loose_definition(self, begin: int, stop: int) -> None:
        self._definition(begin, stop)
        if self._run is not None:
            self._run.end = stop

    def _loose_message(self, begin: int, stop: int) -> None:
        """Add a message outside of chunks to the current run of them."""
        if stop - begin < r.MESSAGE_HEAD.size:
            raise FormatError("a message record is shorter than its fixed fields")
        channel, _, time, _ = self._fields(begin, r.MESSAGE_HEAD)
        if self._run is not None and stop - self._run.offset > _RUN:
            self._end_run()
        if self._run is None:
            self._run = _LooseMessages(self.at, stop, time, time)
        run = self._run
        run.end, run.first, run.final = stop, min(run.first, time), max(run.final, time)
        run.counts[channel] += 1

    def _end_run(self) -> None:
        run, self._run = self._run, None
        if run is not None:
            self.found.chunks.append(run.chunk())

    def _chunk(self, begin: int, stop: int) -> None:
        self.found.chunks.append(self._chunk_head(begin, stop))
        self._index = {}

    def _chunk_head(self, begin: int, stop: int) -> r.Chunk:
        """Read what the record of a chunk claims."""
        at = r.Cursor(self._peek(begin, min(stop - begin, 128)))
        start, end, size, crc = r.CHUNK_HEAD.unpack(at.take(r.CHUNK_HEAD.size))
        compression, data_size = at.string(), at.number(8)
        if data_size > stop - begin - at.at:
            raise FormatError("a chunk's data reach past its record")
        if start > end:
            raise FormatError("a chunk claims to end before it starts")
        if size > MAX_CHUNK:
            raise FormatError(f"a chunk claims {size} bytes uncompressed; the limit is {MAX_CHUNK}")
        data = begin + at.at
        return r.Chunk(
            self.at, stop, start, end, size, crc, compression, data, data_size, stop, None
        )

    def _message_index(self, begin: int, stop: int) -> None:
        if self._index is None:
            raise FormatError("a message index does not follow a chunk")
        if stop - begin < _INDEX.size:
            raise FormatError("a message index is shorter than its fixed fields")
        channel, size = self._fields(begin, _INDEX)
        if size % 16 or size > stop - begin - _INDEX.size:
            raise FormatError("a message index does not fit its record")
        if channel in self._index:
            raise FormatError(f"a chunk has two message indexes of channel {channel}")
        self._index[channel] = size // 16
        self._index_end = stop

    def _end_index(self) -> None:
        """Give the chunk the counts of the message indexes that followed it."""
        index, self._index = self._index, None
        if index:
            chunk = self.found.chunks[-1]
            self.found.chunks[-1] = replace(chunk, index_end=self._index_end, counts=index)

    def _attachment(self, begin: int, stop: int) -> None:
        at = r.Cursor(self._peek(begin, min(stop - begin, _NAMES)))
        log_time, create_time = at.number(8), at.number(8)
        name, media_type, size = at.string(), at.string(), at.number(8)
        data = begin + at.at
        if size > stop - data - 4:
            raise FormatError("an attachment's data reach past its record")
        crc = int.from_bytes(self.file.read(data + size, 4), "little")
        if crc and crc != self.file.crc(begin, data + size):
            raise FormatError(f"the checksum of the attachment {name!r} is wrong")
        self.found.attachments.append(
            r.AttachmentIndex(
                offset=self.at,
                length=stop - self.at,
                log_time=log_time,
                create_time=create_time,
                data_size=size,
                name=name,
                media_type=media_type,
            )
        )

    def _metadata(self, begin: int, stop: int) -> None:
        at = r.Cursor(self._content(begin, stop))
        self.found.metadata.append((at.string(), at.strings()))

    def _data_end(self) -> None:
        _, begin, stop = self._next()
        crc = r.Cursor(self._content(begin, stop)).number(4)
        self.found.has_data_crc = crc != 0
        if crc and self.checksum and crc != self.file.crc(0, self.at):
            raise FormatError("the checksum of the data section is wrong")
        self.at = stop

    # -- summary -------------------------------------------------------------------------------

    def _statistics(self, begin: int, stop: int) -> None:
        if self.found.statistics is not None:
            raise FormatError("there are two statistics records")
        self.found.statistics = r.parse_statistics(self._content(begin, stop))

    def _chunk_index(self, begin: int, stop: int) -> None:
        self._chunk_indexes.append(r.parse_chunk_index(self._content(begin, stop)))

    def _footer(self, start: int) -> None:
        _, begin, stop = self._next()
        if stop - begin != r.FOOTER.size:
            raise FormatError("the footer has a wrong length")
        summary_start, _, crc = r.FOOTER.unpack(self._peek(begin, r.FOOTER.size))
        if summary_start not in (0, start):
            raise FormatError("the footer gives a wrong position of the summary")
        if summary_start == 0 and (self.found.statistics or self._chunk_indexes):
            raise FormatError("the footer names no summary, but the file has one")
        if crc and crc != self.file.crc(start, begin + 16):
            raise FormatError("the checksum of the summary is wrong")
        self.at = stop
        if self.file.size - stop < len(r.MAGIC):
            raise self._truncated("inside its last bytes")
        if self.file.read(stop, len(r.MAGIC)) != r.MAGIC:
            raise FormatError("the log does not end like an MCAP file")
        if beyond := self.file.size - stop - len(r.MAGIC):
            raise FormatError(f"{beyond} bytes follow the end of the log")

    def _agreement(self) -> None:
        """Compare what the summary claims to exist with what the walk found."""
        chunks = [chunk for chunk in self.found.chunks if not chunk.loose]
        claimed = {
            (i.chunk_start_offset, i.chunk_length, i.message_start_time, i.message_end_time)
            for i in self._chunk_indexes
        }
        actual = {(c.offset, c.end - c.offset, c.start_time, c.end_time) for c in chunks}
        if self._chunk_indexes and (claimed != actual or len(self._chunk_indexes) != len(actual)):
            raise FormatError("the chunk indexes of the summary do not fit the chunks of the log")
        stats = self.found.statistics
        if stats is None:
            return
        found = (len(chunks), len(self.found.attachments), len(self.found.metadata))
        if (stats.chunk_count, stats.attachment_count, stats.metadata_count) != found:
            raise FormatError(
                "the statistics of the summary claim other numbers of chunks, attachments or "
                f"metadata than {found[0]}, {found[1]} and {found[2]}"
            )
