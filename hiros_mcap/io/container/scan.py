"""The strict policy: an MCAP file is whole, or the first fault in it is an error.

No chunk is decompressed. What exists is decided by the data alone: the summary at the end of the
file may add definitions, and wherever it contradicts the data the file is refused.
"""

from __future__ import annotations

import shlex
import struct
from dataclasses import replace
from pathlib import Path

from hiros_mcap.errors import LogError
from hiros_mcap.io.container import records as r
from hiros_mcap.io.container.file import LogFile
from hiros_mcap.io.container.records import FormatError, Opcode
from hiros_mcap.io.container.walk import Contents, CutOffError, Reader, Walk


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
            raise LogError("is not an MCAP file", path=self.file.path)
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
