"""The recovering policy: what can still be read of a damaged MCAP file.

The walk goes on behind damage. It takes a chunk only if its checksum holds, so every message of it
is the one that was recorded. A chunk that was cut off has no checksum that could hold: it is lost.
Where a length is wrong, the walk goes on at the next chunk: by the summary's chunk indexes, or by
searching for a chunk record whose lengths, compression and checksum hold. Only a file without any
chunk is searched for messages, which have no checksum of their own.
"""

from __future__ import annotations

import re
import struct
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from hiros_mcap.errors import LogError
from hiros_mcap.io.container import records as r
from hiros_mcap.io.container.chunks import COMPRESSIONS, ChunkRecords, Table, read_chunk
from hiros_mcap.io.container.file import LogFile
from hiros_mcap.io.container.reader import McapReader
from hiros_mcap.io.container.records import MAX_CHUNK, FormatError, Opcode
from hiros_mcap.io.container.recovery import Damage, Recovery, Remains, SeenMessages, seen_in
from hiros_mcap.io.container.scan import StrictWalk
from hiros_mcap.io.container.walk import Contents, Reader, Walk
from hiros_mcap.kernels.record_index import CHANNEL, LOG_TIME, START

_BLOCK = 4 << 20  # bytes that are searched at once
_OVERLAP = 64
_BEFORE_DATA = r.HEAD.size + r.MESSAGE_HEAD.size
# What a chunk begins with: opcode, length below 2^40, two times, size below 2^32, checksum, name
# of the compression. What the end of the data and a message begin with: opcode and length.
_CHUNK = rb"\x06.{5}\0{3}.{20}\0{4}.{4}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4})"
_CHUNK_HEAD = re.compile(_CHUNK, re.DOTALL)
_RESUME = re.compile(_CHUNK + rb"|\x0f\x04\0{7}", re.DOTALL)
_RESUME_UNCHUNKED = re.compile(_RESUME.pattern + rb"|\x05.{4}\0{4}", re.DOTALL)
_HARMLESS = frozenset(Opcode) - {
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
}
"""Records without data of their own. Messages without a definition are counted by themselves."""


class RecoveringReader(McapReader):
    """Reads what is left of a damaged file; of a healthy one, everything.

    Raises LogError if the file cannot be opened, or nothing in it can be read.
    """

    def _walk(self) -> Contents:
        contents, self.recovery = salvage(self._file)
        return contents

    def _define(self, data: r.Bytes, definitions: Table) -> frozenset[int]:
        """Return the channels that a chunk defines; the walk took note of their definitions."""
        rows = (row for row in definitions.tolist() if row[0] == Opcode.CHANNEL)
        view = memoryview(data)
        return frozenset(r.Channel.read(r.Cursor(view[start:stop])).id for _, start, stop in rows)

    def _accepted(self, chunk: r.Chunk, table: Table) -> Table:
        """Return the messages whose channel is known."""
        return table[np.isin(table[:, CHANNEL], list(self._contents.channels))]


def salvage(file: LogFile) -> tuple[Contents, Recovery]:
    """Walk a file that may be damaged; raises LogError if nothing in it can be read."""
    if not file.size:
        raise LogError("is empty (0 bytes)", path=file.path)
    try:
        walk = RecoveringWalk(file, _RESUME)
        walk.run()
        if walk.damages and not walk.has_chunks:
            walk = RecoveringWalk(file, _RESUME_UNCHUNKED)
            walk.run()
        return walk.contents, walk.recovery()
    except MemoryError:
        raise LogError("is too large for the memory", path=file.path) from None


class RecoveringWalk(Walk):
    """Goes on behind damage; ``resume`` finds places to go on at.

    Definitions in the summary and in chunks have a checksum; they overrule others.
    """

    def __init__(self, file: LogFile, resume: re.Pattern[bytes]) -> None:
        super().__init__(file)
        self.damages: list[Damage] = []
        self.has_chunks = False
        self._resume = resume
        self._end = file.size
        self._claimed: r.Statistics | None = None
        self._places: list[int] = []  # of chunks, attachments and metadata, by the summary
        self._definitions = Contents()
        self._seen: dict[int, dict[int, SeenMessages]] = {}  # by offset of the chunk, by channel
        self._records: ChunkRecords | None = None  # of the chunk that was just read
        self._exact = False  # whether the chunk claims the times of its messages
        self._data_ended = False

    def run(self) -> None:
        """Find everything that can be read; raises LogError if there is nothing."""
        self._read_summary()
        self.at = min(len(r.MAGIC), self._end)
        if self.file.read(0, self.at) != r.MAGIC:
            self.damages.append(Damage(0, self.at, "not what an MCAP file begins with", {}))
        readers: dict[int, Reader] = dict.fromkeys(_HARMLESS, self._skip)
        self._section({**readers, **self._data_readers(), Opcode.DATA_END: self._data_end})
        self._leave_chunk(whole=self._complete)
        self._end_run()
        closed = self._end < self.file.size or self._ends_at(self.at)
        if not closed and not (self.damages and self.damages[-1].end == self._end):
            fault = f"the {'summary' if self._data_ended else 'recording'} was cut off here"
            cut = Damage(self._end, self._end, fault, {} if self._data_ended else None)
            self.damages.append(cut)
        self.file.check_unchanged()

    @property
    def _complete(self) -> bool:
        """Whether the walk has seen where the data end."""
        return self._data_ended or self._end < self.file.size

    def _read_summary(self) -> None:
        """Take definitions, places and statistics from the summary if its checksum holds."""
        summary = StrictWalk(self.file)
        try:
            footer = self.file.size - len(r.MAGIC) - r.FOOTER.size
            start, _, _ = r.FOOTER.unpack(self._peek(max(footer, 0), r.FOOTER.size))
            if not len(r.MAGIC) < start < footer:
                return
            summary.read_summary(start)
        except (FormatError, LogError, struct.error):
            return
        self.contents, self._claimed = summary.contents, summary.contents.statistics
        self.contents.statistics = None
        if summary.chunk_indexes:  # otherwise messages may be anywhere
            chunks = (index.chunk_start_offset for index in summary.chunk_indexes)
            self._places = sorted([*summary.extras, *chunks])
        self._end = start

    # -- the policy ----------------------------------------------------------------------------

    def _goes_on(self) -> bool:
        return self.at < self._end and not self._ends_at(self.at)

    def _reader(self, readers: Mapping[int, Reader], opcode: int, stop: int) -> Reader:
        reader = super()._reader(readers, opcode, stop)
        if opcode != Opcode.CHUNK and not self._plausible(stop):
            raise FormatError(f"no record follows a {r.name_of(opcode)} record")
        return reader

    def _fault(self, fault: Exception, stop: int) -> int:
        """Go on behind damage: at the next record if the length of this one holds."""
        self._leave_chunk(whole=False)
        self._end_run()
        start, opcode = self.at, self._peek(self.at, 1)[0]
        alone = stop > start and self._plausible(stop)
        end = stop if alone else self._resync(start + 1)
        extra = opcode in (Opcode.ATTACHMENT, Opcode.METADATA) and not self._data_ended
        harmless = self._data_ended or (alone and (extra or opcode in _HARMLESS))
        is_chunk = opcode == Opcode.CHUNK
        span = self._claimed_times(start) if is_chunk else None
        text, counts = str(fault), dict[int, int]() if harmless else None
        self.damages.append(Damage(start, end, text, counts, None, span, extra))
        self.has_chunks |= is_chunk
        if is_chunk and alone:
            self._index = {}  # the message indexes that follow tell what is lost
        return end

    def _keep(self, chunk: r.Chunk) -> int:
        """Add a chunk, with its true times and counts; raises FormatError if it is damaged."""
        if not chunk.loose:
            self.has_chunks = True
            chunk = self._with_true_end(chunk)
        if chunk.compression not in COMPRESSIONS:
            raise FormatError(f"unknown compression {chunk.compression!r}")
        try:
            records = read_chunk(self.file, chunk)
            if not chunk.loose:
                for opcode, start, stop in records.definitions.tolist():
                    self.contents.define(opcode, memoryview(records.data)[start:stop])
        except (struct.error, ValueError, OverflowError) as fault:
            raise FormatError(f"damaged chunk: {fault}") from None
        seen = self._seen[chunk.offset] = seen_in(records.messages)
        times = [time for s in seen.values() for time in (s.first, s.last)]
        first, last = min(times, default=chunk.start_time), max(times, default=chunk.end_time)
        self._exact = (chunk.start_time, chunk.end_time) == (first, last)
        self._records = None if chunk.loose else records
        counts = {channel: s.number for channel, s in seen.items()}
        self.contents.chunks.append(replace(chunk, start_time=first, end_time=last, counts=counts))
        return chunk.end

    def _with_true_end(self, chunk: r.Chunk) -> r.Chunk:
        """Return the chunk without what is behind its data, where the record's length is wrong.

        That length has no checksum, that of the data has one.
        """
        end = chunk.data_offset + chunk.data_size
        if end != chunk.end and (self._plausible(end) or not self._plausible(chunk.end)):
            return replace(chunk, end=end, index_end=end)
        return chunk

    def _leave_chunk(self, *, whole: bool) -> None:
        """Compare the message indexes with their chunk, or learn from them what is lost."""
        index, self._index = self._index, None
        records, self._records = self._records, None
        if not index:
            return
        entries = {i: self._entries(where.start, where.number) for i, where in index.items()}
        if records is None:
            if whole:
                self.damages[-1] = self._with_entries(self.damages[-1], entries)
        elif self._exact and _agrees(records.messages, entries):
            self.contents.chunks[-1] = replace(self.contents.chunks[-1], index_end=self._index_end)
        elif whole:
            start, fault = self.contents.chunks[-1].end, "a chunk's message indexes do not match it"
            self.damages.append(Damage(start, self._index_end, fault, {}))

    def _entries(self, start: int, n: int) -> Table:
        """(n, 2) log times, ns, and places in the chunk of the messages that an index lists."""
        return np.frombuffer(self.file.read(start, 16 * n), "<u8").reshape(-1, 2)

    def _with_entries(self, damage: Damage, entries: Mapping[int, Table]) -> Damage:
        """Return what the message indexes behind a lost chunk tell of it, if that can be."""
        _, _, size, _ = self._fields(damage.offset + r.HEAD.size, r.CHUNK_HEAD)
        channels = [i for i, some in entries.items() for _ in range(len(some))]
        table = np.concatenate(list(entries.values()))
        order = np.argsort(table[:, 1])
        starts = table[order, 1].tolist()
        if not starts or starts[-1] + _BEFORE_DATA > size:
            return damage
        sizes = dict.fromkeys(entries, 0)
        for k, start, end in zip(order.tolist(), starts, [*starts[1:], size], strict=True):
            sizes[channels[k]] += max(0, end - start - _BEFORE_DATA)
        counts = {i: len(some) for i, some in entries.items()}
        span = int(table[:, 0].min()), int(table[:, 0].max())
        return replace(damage, counts=counts, sizes=sizes, span=span)

    def _claimed_times(self, offset: int) -> tuple[int, int] | None:
        """Log times, ns, in the head of a lost chunk, which has no checksum."""
        head = self._peek(offset, min(_OVERLAP, self.file.size - offset))
        if not _CHUNK_HEAD.match(head):
            return None
        start, end, _, _ = r.CHUNK_HEAD.unpack_from(head, r.HEAD.size)
        return (start, end) if start <= end else None

    # -- records that need more care -----------------------------------------------------------

    def _loose_message(self, begin: int, stop: int) -> None:
        self._check_channel(begin)
        super()._loose_message(begin, stop)

    def _check_channel(self, begin: int) -> None:
        """Raise FormatError unless the message at ``begin`` belongs to a channel so far."""
        channel = int.from_bytes(self._peek(begin, 2), "little")
        if channel not in self._definitions.channels and channel not in self.contents.channels:
            raise FormatError(f"a message belongs to channel {channel}, which is not defined")

    def _data_end(self, begin: int, stop: int) -> None:
        try:
            super()._data_end(begin, stop)
        except FormatError:
            if not self.damages:  # which explain it
                raise
        finally:
            self._data_ended = True

    # -- going on behind damage ----------------------------------------------------------------

    def _ends_at(self, offset: int) -> bool:
        """Whether the last bytes of a complete file are there."""
        return self._end - offset == len(r.MAGIC) and self._peek(offset, len(r.MAGIC)) == r.MAGIC

    def _plausible(self, offset: int) -> bool:
        """Whether a record may begin there, also one that was cut off, or the file ends."""
        left = self._end - offset
        if left == 0 or self._ends_at(offset):
            return True
        if left < r.HEAD.size:
            return not self._complete and 0 < self._peek(offset, 1)[0] <= Opcode.DATA_END
        opcode, length = self._fields(offset, r.HEAD)
        fits = length <= left - r.HEAD.size
        if opcode >= r.PRIVATE_OP:
            return bool(fits)
        cut = not self._complete and length <= 2 * MAX_CHUNK
        too_short = opcode == Opcode.MESSAGE and length < r.MESSAGE_HEAD.size
        return bool(0 < opcode <= Opcode.DATA_END and (fits or cut) and not too_short)

    def _resync(self, start: int) -> int:
        """Place of the first record from ``start`` on that can be vouched for, or the end."""
        if self._places:
            later = bisect_left(self._places, start)
            return self._places[later] if later < len(self._places) else self._end
        here = self.at
        try:
            return next(filter(self._holds, self._candidates(start)), self._end)
        finally:
            self.at = here

    def _candidates(self, start: int) -> Iterator[int]:
        """Yield places where a record seems to begin."""
        for block in range(start, self._end, _BLOCK):
            data = self.file.read(block, min(_BLOCK + _OVERLAP, self._end - block))
            at = 0
            while (match := self._resume.search(data, at)) and match.start() < _BLOCK:
                yield block + match.start()
                at = match.start() + 1

    def _holds(self, offset: int) -> bool:
        """Whether the candidate is a record: a chunk by its checksum, others by what follows."""
        self.at = offset
        try:
            opcode, begin, stop = self._next()
            if opcode == Opcode.CHUNK:
                head = self._peek(begin, min(stop - begin, r.MAX_CHUNK_HEAD))
                chunk = r.parse_chunk(head, offset, begin, stop)
                return len(read_chunk(self.file, chunk).messages) > 0
            if opcode == Opcode.MESSAGE:
                self._check_channel(begin)
            return self._plausible(stop) and (self._end - stop < r.HEAD.size or self._follows(stop))
        except (FormatError, struct.error):
            return False

    def _follows(self, offset: int) -> bool:
        """Whether a record begins there that is followed by another one, or was cut off."""
        _, length = self._fields(offset, r.HEAD)
        stop = offset + r.HEAD.size + length
        return stop > self._end or self._plausible(stop)

    # -- the answer ----------------------------------------------------------------------------

    def recovery(self) -> Recovery:
        """Complete the contents and return what is lost; raises LogError if there is nothing."""
        contents = self.contents
        contents.schemas = {**self._definitions.schemas, **contents.schemas}
        channels = {**self._definitions.channels, **contents.channels}
        contents.channels = {
            i: c for i, c in channels.items() if not c.schema_id or c.schema_id in contents.schemas
        }
        contents.chunks = [self._defined(chunk) for chunk in contents.chunks]
        recovered = sum(sum((chunk.counts or {}).values()) for chunk in contents.chunks)
        if self.damages and not recovered:
            first = self.damages[0]
            fault = (
                "is not an MCAP file"
                if not first.offset
                else f"no message of it can be read: {first.fault} at byte {first.offset}"
            )
            raise LogError(fault, path=self.file.path)
        plain = [chunk for chunk in contents.chunks if not chunk.crc]
        unchecked = sum(sum((chunk.counts or {}).values()) for chunk in plain)
        remains = Remains(contents.channels, self._seen, self.damages, self._claimed)
        checked = contents.has_data_crc
        return Recovery(tuple(self.damages), remains.losses(), 0 if checked else unchecked)

    def _defined(self, chunk: r.Chunk) -> r.Chunk:
        """Return the chunk without messages whose channel is not defined anywhere."""
        counts = {i: n for i, n in (chunk.counts or {}).items() if i in self.contents.channels}
        return chunk if counts == chunk.counts else chunk.indexed(chunk.end, counts)


def _agrees(messages: Table, entries: Mapping[int, Table]) -> bool:
    """Whether message indexes list exactly the messages of their chunk."""
    ids = np.array(list(entries), np.uint64)
    channels = np.repeat(ids, [len(some) for some in entries.values()])
    listed = np.column_stack([channels, *np.concatenate(list(entries.values())).T])
    wanted = messages[:, [CHANNEL, LOG_TIME, START]]
    wanted[:, 2] -= np.uint64(_BEFORE_DATA)
    return np.array_equal(listed[np.argsort(listed[:, 2])], wanted)
