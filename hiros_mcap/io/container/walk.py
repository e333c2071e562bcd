"""The walk over the records of an MCAP file, in the order in which they lie in it.

There is one walk and two policies, which differ in what a fault means and in how much of a chunk is
believed: :class:`StrictWalk` stops at the first fault, :mod:`.salvage` notes it and goes on behind
it. No chunk is decompressed here. What exists is decided by the data alone: the summary at the end
of the file may add definitions, and wherever it contradicts the data the file is refused.
"""

from __future__ import annotations

import shlex
import struct
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from hiros_mcap.errors import LogError
from hiros_mcap.io.container import records as r
from hiros_mcap.io.container.file import LogFile
from hiros_mcap.io.container.records import FormatError, Opcode

MAX_RECORD = 64 * 2**20
"""Largest definition, metadata or summary record that is read, bytes."""
_RERUN = b"RRF"  # files of `hiros view --save`
_TABLES = (".csv", ".tsv", ".trc", ".c3d", ".json", ".npy")  # what `hiros import` reads
_LOOSE = frozenset((Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE))

Definition = TypeVar("Definition", r.Schema, r.Channel)
Reader = Callable[[int, int], int | None]
"""Takes the content of a record, its first and its past-the-end byte. Returns where the record
ends, None if its length is right."""


@dataclass(slots=True)
class Contents:
    """The index of a file, as the walk builds it."""

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
            schema = r.Schema.read(r.Cursor(content))
            # The format asks readers to ignore a schema with the id that means "none".
            return _put(self.schemas, schema, "schema") if schema.id else 0
        return _put(self.channels, r.Channel.read(r.Cursor(content)), "channel")


def _put(table: dict[int, Definition], new: Definition, kind: str) -> int:
    if table.setdefault(new.id, new) != new:
        raise FormatError(f"{kind} {new.id} is defined twice, differently")
    return new.id


class CutOffError(FormatError):
    """The file ends inside a record, or before one that must come."""


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
            start, self.end, self.first, self.final, size, 0, "", start, size, self.end,
            dict(self.counts), loose=True,
        )  # fmt: skip


class Walk(ABC):
    """Where the walk is, and what it has found so far. A policy overrides what is abstract.

    Methods raise FormatError or struct.error for a fault, and CutOffError where the file ends.
    """

    def __init__(self, file: LogFile) -> None:
        self.file = file
        self.at = 0
        self.contents = Contents()
        self._definitions = self.contents  # takes those outside of chunks
        self._ahead = b""
        self._ahead_at = 0
        self._run: _LooseMessages | None = None
        self._index: dict[int, int] | None = None  # messages by channel, right after a chunk only
        self._index_end = 0

    # -- the policy ----------------------------------------------------------------------------

    def _goes_on(self) -> bool:
        """Whether a record must come."""
        return True

    @abstractmethod
    def _keep(self, chunk: r.Chunk) -> int:
        """Add a chunk, or a run of messages outside of chunks; return where it ends."""

    @abstractmethod
    def _leave_chunk(self) -> None:
        """Use the message indexes behind the last chunk."""

    @abstractmethod
    def _fault(self, fault: Exception, stop: int) -> int:
        """Return where to go on, or raise an error.

        ``stop`` is where the faulty record ends, 0 if it has no usable head.
        """

    # -- records -------------------------------------------------------------------------------

    def _section(self, readers: Mapping[int, Reader], last: int | None = None) -> None:
        """Hand every record to its reader, up to the record that ends the section."""
        while self._goes_on():
            stop = 0
            try:
                opcode, begin, stop = self._next()
                reader = self._skip if opcode == last else self._reader(readers, opcode, stop)
                if self._index is not None and opcode != Opcode.MESSAGE_INDEX:
                    self._leave_chunk()
                if self._run is not None and opcode not in _LOOSE:
                    self._end_run()
                if opcode == last:
                    return
                self.at = reader(begin, stop) or stop
            except (FormatError, struct.error) as fault:
                self.at = self._fault(fault, stop)

    def _reader(self, readers: Mapping[int, Reader], opcode: int, stop: int) -> Reader:
        """Return what reads a record that ends at ``stop``; raises FormatError for a wrong one."""
        if opcode in readers:
            return readers[opcode]
        if opcode >= r.PRIVATE_OP:
            return self._skip
        raise FormatError(f"a {r.name_of(opcode)} record is not allowed here")

    def _data_readers(self) -> dict[int, Reader]:
        return {
            Opcode.SCHEMA: self._loose_definition,
            Opcode.CHANNEL: self._loose_definition,
            Opcode.MESSAGE: self._loose_message,
            Opcode.CHUNK: self._chunk,
            Opcode.MESSAGE_INDEX: self._message_index,
            Opcode.ATTACHMENT: self._attachment,
            Opcode.METADATA: self._metadata,
        }

    def _next(self) -> tuple[int, int, int]:
        """Opcode, first content byte and past-the-end byte of the record at ``self.at``."""
        left = self.file.size - self.at
        if left < r.HEAD.size:
            raise CutOffError("the file ends before its footer")
        opcode, length = self._fields(self.at, r.HEAD)
        begin = self.at + r.HEAD.size
        if length > self.file.size - begin:
            raise CutOffError(f"the file ends inside a {r.name_of(opcode)} record")
        return opcode, begin, begin + length

    def _peek(self, offset: int, n: int) -> bytes:
        """Return a few bytes, read ahead in blocks because most records are small."""
        start = offset - self._ahead_at
        if start < 0 or start + n > len(self._ahead):
            self._ahead = self.file.read(offset, min(max(n, 1 << 14), self.file.size - offset))
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

    def _cursor(self, begin: int, stop: int) -> r.Cursor:
        return r.Cursor(self._content(begin, stop))

    # -- what the records of the data section hold ---------------------------------------------

    def _skip(self, begin: int, stop: int) -> int:
        """Pass over a record that hiros has no use for."""
        return stop

    def _definition(self, begin: int, stop: int) -> None:
        opcode = self._peek(self.at, 1)[0]
        self._definitions.define(opcode, self._content(begin, stop))

    def _loose_definition(self, begin: int, stop: int) -> None:
        self._definition(begin, stop)
        if self._run is not None:
            self._run.end = stop

    def _loose_message(self, begin: int, stop: int) -> None:
        """Add a message outside of chunks to the current run of them."""
        if stop - begin < r.MESSAGE_HEAD.size:
            raise FormatError("a message record is shorter than its fixed fields")
        channel, _, time, _ = self._fields(begin, r.MESSAGE_HEAD)
        if self._run is not None and stop - self._run.offset > 1 << 20:
            self._end_run()
        if self._run is None:
            self._run = _LooseMessages(self.at, stop, time, time)
        run = self._run
        run.end, run.first, run.final = stop, min(run.first, time), max(run.final, time)
        run.counts[channel] += 1

    def _end_run(self) -> None:
        run, self._run = self._run, None
        if run is not None:
            self._keep(run.chunk())

    def _chunk(self, begin: int, stop: int) -> int:
        head = self._peek(begin, min(stop - begin, r.MAX_CHUNK_HEAD))
        end = self._keep(r.parse_chunk(head, self.at, begin, stop))
        self._index = {}
        return end

    def _message_index(self, begin: int, stop: int) -> None:
        if self._index is None:
            raise FormatError("a message index does not follow a chunk")
        if stop - begin < r.INDEX_HEAD.size:
            raise FormatError("a message index is shorter than its fixed fields")
        channel, size = self._fields(begin, r.INDEX_HEAD)
        if size % 16 or size > stop - begin - r.INDEX_HEAD.size:
            raise FormatError("a message index does not fit its record")
        if channel in self._index:
            raise FormatError(f"a chunk has two message indexes of channel {channel}")
        self._index[channel] = size // 16
        self._index_end = stop

    def _attachment(self, begin: int, stop: int) -> None:
        at = r.Cursor(self._peek(begin, min(stop - begin, 1 << 18)))
        log_time, create_time = at.read8(), at.read8()
        name, media_type = at.read_prefixed_string(), at.read_prefixed_string()
        size = at.read8()
        data = begin + at.count
        if size > stop - data - 4:
            raise FormatError("an attachment's data reach past its record")
        crc = int.from_bytes(self.file.read(data + size, 4), "little")
        if crc and crc != self.file.crc(begin, data + size):
            raise FormatError(f"the checksum of the attachment {name!r} is wrong")
        length = stop - self.at
        self.contents.attachments.append(
            r.AttachmentIndex(self.at, length, log_time, create_time, size, name, media_type)
        )

    def _metadata(self, begin: int, stop: int) -> None:
        metadata = r.Metadata.read(self._cursor(begin, stop))
        self.contents.metadata.append((metadata.name, metadata.metadata))

    def _data_end(self, begin: int, stop: int) -> None:
        """Compare the checksum of the data section, which may cover what has no other one."""
        crc = r.DataEnd.read(self._cursor(begin, stop)).data_section_crc
        holds = not crc or crc == self.file.crc(0, self.at)
        self.contents.has_data_crc = crc != 0 and holds
        if not holds:
            raise FormatError("the checksum of the data section is wrong")


def remedy(path: Path | str) -> str:
    """Return what helps against a damaged file."""
    return f"`hiros recover {shlex.quote(str(path))}` saves what is readable"


def scan(file: LogFile) -> Contents:
    """Walk the file; raises LogError naming the fault and its place."""
    walk = StrictWalk(file)
    walk.run()
    return walk.contents


class StrictWalk(Walk):
    """Stops at the first fault; believes of a chunk what its record and its indexes claim."""

    def __init__(self, file: LogFile) -> None:
        super().__init__(file)
        self.chunk_indexes: list[r.ChunkIndex] = []
        self.extras: list[int] = []
        """First bytes of the attachments and the metadata, by the summary."""

    def run(self) -> None:
        """Find what is there; raises LogError for any damage."""
        try:
            self._opening()
            self._section(self._data_readers(), Opcode.DATA_END)
            _, begin, stop = self._next()
            self._data_end(begin, stop)
            self.read_summary(stop)
            self._agreement()
        except CutOffError as fault:
            raise self._cut_off(fault) from None
        except (FormatError, struct.error) as fault:
            raise self._damaged(fault) from None
        except MemoryError:
            raise LogError("is too large for the memory", path=self.file.path) from None
        self.file.check_unchanged()

    def _opening(self) -> None:
        start = self.file.read(0, min(len(r.MAGIC), self.file.size))
        if not start:
            raise LogError("is empty (0 bytes)", path=self.file.path)
        if start != r.MAGIC[: len(start)]:
            is_table = str(self.file.path).lower().endswith(_TABLES)
            hint = "; `hiros import` makes a log of files of joints" if is_table else ""
            if start.startswith(_RERUN):
                hint = f" but a Rerun recording; open it with: rerun {self.file.path}"
            raise LogError(f"is not an MCAP file{hint}", path=self.file.path)
        self.at = len(r.MAGIC)
        if self.file.size < self.at:
            raise CutOffError("the file ends inside its first bytes")
        opcode, begin, stop = self._next()
        if opcode != Opcode.HEADER:
            raise FormatError(f"a header is expected, not a {r.name_of(opcode)} record")
        header = r.Header.read(self._cursor(begin, stop))
        self.contents.profile, self.contents.library = header.profile, header.library
        self.at = stop

    # -- the policy ----------------------------------------------------------------------------

    def _keep(self, chunk: r.Chunk) -> int:
        self.contents.chunks.append(chunk)
        return chunk.end

    def _leave_chunk(self) -> None:
        index, self._index = self._index, None
        if index:
            chunk = self.contents.chunks[-1]
            self.contents.chunks[-1] = replace(chunk, index_end=self._index_end, counts=index)

    def _fault(self, fault: Exception, stop: int) -> int:
        raise fault

    def _damaged(self, fault: Exception) -> LogError:
        text = f"damaged at byte {self.at}: {fault}; {remedy(self.file.path)}"
        return LogError(text, path=self.file.path)

    def _cut_off(self, fault: Exception) -> LogError:
        """Return the error of a file that ends too early; one with its last bytes is damaged."""
        end = self.file.size - len(r.MAGIC)
        if end >= len(r.MAGIC) and self.file.read(end, len(r.MAGIC)) == r.MAGIC:
            return self._damaged(fault)
        where = str(fault).removeprefix("the file ends ")
        return LogError(
            f"truncated: the file ends at byte {self.file.size}, {where} at byte {self.at}; "
            f"the recording was cut off; {remedy(self.file.path)}",
            path=self.file.path,
        )

    # -- summary -------------------------------------------------------------------------------

    def read_summary(self, start: int) -> None:
        """Walk from the first byte of the summary to the end of the file.

        Raises FormatError or struct.error unless its checksum holds.
        """
        self.at = start
        self._section(self._summary_readers(), Opcode.FOOTER)
        _, begin, stop = self._next()
        if stop - begin != r.FOOTER.size:
            raise FormatError("the footer has a wrong length")
        summary_start, _, crc = r.FOOTER.unpack(self._peek(begin, r.FOOTER.size))
        if summary_start not in (0, start):
            raise FormatError("the footer gives a wrong position of the summary")
        if summary_start == 0 and (self.contents.statistics or self.chunk_indexes):
            raise FormatError("the footer names no summary, but the file has one")
        if crc and crc != self.file.crc(start, begin + 16):
            raise FormatError("the checksum of the summary is wrong")
        self.at = stop
        if self.file.size - stop < len(r.MAGIC):
            raise CutOffError("the file ends inside its last bytes")
        if self.file.read(stop, len(r.MAGIC)) != r.MAGIC:
            raise FormatError("the log does not end like an MCAP file")
        if beyond := self.file.size - stop - len(r.MAGIC):
            raise FormatError(f"{beyond} bytes follow the end of the log")

    def _summary_readers(self) -> dict[int, Reader]:
        return {
            Opcode.SCHEMA: self._definition,
            Opcode.CHANNEL: self._definition,
            Opcode.STATISTICS: self._statistics,
            Opcode.CHUNK_INDEX: self._chunk_index,
            Opcode.ATTACHMENT_INDEX: self._extra_index,
            Opcode.METADATA_INDEX: self._extra_index,
            Opcode.SUMMARY_OFFSET: self._skip,
        }

    def _statistics(self, begin: int, stop: int) -> None:
        if self.contents.statistics is not None:
            raise FormatError("there are two statistics records")
        self.contents.statistics = r.Statistics.read(self._cursor(begin, stop))

    def _chunk_index(self, begin: int, stop: int) -> None:
        self.chunk_indexes.append(r.ChunkIndex.read(self._cursor(begin, stop)))

    def _extra_index(self, begin: int, stop: int) -> None:
        self.extras.append(self._cursor(begin, stop).read8())

    def _agreement(self) -> None:
        """Compare what the summary claims to exist with what the walk found."""
        chunks = [chunk for chunk in self.contents.chunks if not chunk.loose]
        claimed = {
            (i.chunk_start_offset, i.chunk_length, i.message_start_time, i.message_end_time)
            for i in self.chunk_indexes
        }
        actual = {(c.offset, c.end - c.offset, c.start_time, c.end_time) for c in chunks}
        if self.chunk_indexes and (claimed != actual or len(self.chunk_indexes) != len(actual)):
            raise FormatError("the chunk indexes of the summary do not fit the chunks of the log")
        stats = self.contents.statistics
        if stats is None:
            return
        counts = (len(chunks), len(self.contents.attachments), len(self.contents.metadata))
        if (stats.chunk_count, stats.attachment_count, stats.metadata_count) != counts:
            raise FormatError(
                "the statistics of the summary claim other numbers of chunks, attachments or "
                f"metadata than {counts[0]}, {counts[1]} and {counts[2]}"
            )
