"""The recovering policy: what can still be read of a damaged MCAP file.

1. If the summary at the end of the file is whole, it tells the definitions, where chunks,
   attachments and metadata begin, and how many messages each channel has.
2. The walk takes a chunk only if its checksum holds, so every message of it is the one that was
   recorded. Messages outside of chunks have no checksum: they count up to the first damage.
3. Behind a damaged record the walk goes on where this record ends, if another one begins there;
   else at the next place that the summary tells. If there is none, everything behind is lost.
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from hiros_mcap.errors import LogError
from hiros_mcap.io.container import records as r
from hiros_mcap.io.container.file import LogFile, Table, read_chunk
from hiros_mcap.io.container.losses import ChannelLoss, Damage, Lost, Recovery, merged
from hiros_mcap.io.container.reader import McapReader
from hiros_mcap.io.container.records import FormatError, Opcode
from hiros_mcap.io.container.walk import Contents, Reader, StrictWalk, Walk
from hiros_mcap.kernels.record_index import CHANNEL, LOG_TIME

_LONGEST = 2**40  # bytes that a record may claim


class RecoveringReader(McapReader):
    """Reads what is left of a damaged file; of a healthy one, everything.

    Raises LogError if the file cannot be opened, or nothing in it can be read.
    """

    def _walk(self) -> Contents:
        if not self._file.size:
            raise LogError("is empty (0 bytes)", path=self.path)
        walk = RecoveringWalk(self._file)
        try:
            self.recovery = walk.run()
        except MemoryError:
            raise LogError("is too large for the memory", path=self.path) from None
        return walk.contents

    def _define(self, data: r.Bytes, definitions: Table) -> frozenset[int]:
        """Return the channels that a chunk defines; the walk took note of their definitions."""
        rows = (row for row in definitions.tolist() if row[0] == Opcode.CHANNEL)
        view = memoryview(data)
        return frozenset(r.Channel.read(r.Cursor(view[start:stop])).id for _, start, stop in rows)

    def _accepted(self, chunk: r.Chunk, table: Table) -> Table:
        """Return the messages whose channel is known."""
        return table[np.isin(table[:, CHANNEL], list(self._contents.channels))]


class RecoveringWalk(Walk):
    """Goes on behind damage, and notes it.

    Definitions in the summary and in chunks have a checksum; they overrule others.
    """

    def __init__(self, file: LogFile) -> None:
        super().__init__(file)
        self.damages: list[Damage] = []
        self._definitions = Contents()
        self._end = file.size  # of the data, as far as is known
        self._places: list[int] = []  # of chunks, attachments and metadata, by the summary
        self._claimed: Mapping[int, int] | None = None  # messages by channel, by the summary
        self._data_ended = False

    def run(self) -> Recovery:
        """Find what can be read, return what is lost; raises LogError if nothing can be read."""
        has_summary = self._read_summary()
        self.at = min(len(r.MAGIC), self._end)
        if self.file.read(0, self.at) != r.MAGIC:
            self._note(0, self.at, "not what an MCAP file begins with", Lost.NOTHING)
        ends: dict[int, Reader] = {Opcode.HEADER: self._skip, Opcode.DATA_END: self._data_end}
        self._section({**ends, **self._data_readers()})
        self._end_run()
        if not self._data_ended and not (self.damages and self.damages[-1].end == self._end):
            self._note(self._end, self._end, "the recording was cut off here", Lost.REST)
        elif self._data_ended and not has_summary:
            self._note(self.at, self._end, "the summary is damaged or cut off", Lost.NOTHING)
        self.file.check_unchanged()
        return self._recovery()

    def _read_summary(self) -> bool:
        """Use the summary if its checksum holds; return whether it does, or none was written."""
        summary = StrictWalk(self.file)
        footer = self.file.size - len(r.MAGIC) - r.FOOTER.size
        if footer < len(r.MAGIC) + r.HEAD.size:
            return False
        start = r.FOOTER.unpack(self._peek(footer, r.FOOTER.size))[0] or footer - r.HEAD.size
        try:
            summary.read_summary(start)
        except (FormatError, LogError, struct.error):
            return False
        self._end, self.contents = start, summary.contents
        chunks = (index.chunk_start_offset for index in summary.chunk_indexes)
        self._places = sorted([*chunks, *summary.extras])
        stats, self.contents.statistics = self.contents.statistics, None
        if stats and sum(stats.channel_message_counts.values()) == stats.message_count:
            self._claimed = stats.channel_message_counts
        return True

    # -- the policy ----------------------------------------------------------------------------

    def _goes_on(self) -> bool:
        return self.at < self._end and not self._data_ended

    def _reader(self, readers: Mapping[int, Reader], opcode: int, stop: int) -> Reader:
        if opcode != Opcode.CHUNK and not self._has_end(stop):
            raise FormatError(f"the length of a {r.name_of(opcode)} record is wrong")
        return super()._reader(readers, opcode, stop)

    def _has_end(self, stop: int) -> bool:
        """Whether the record here ends at ``stop``: another one, or the end, follows."""
        if not self.at < stop <= self._next_place():
            return False
        if self._end - stop < r.HEAD.size:
            return True
        opcode, length = self._fields(stop, r.HEAD)
        is_record = 0 < opcode <= Opcode.DATA_END or opcode >= r.PRIVATE_OP
        return bool(is_record and length < _LONGEST)

    def _next_place(self) -> int:
        """Where the next record begins of which the summary tells; else the end."""
        later = bisect_right(self._places, self.at)
        return self._places[later] if later < len(self._places) else self._end

    def _fault(self, fault: Exception, stop: int) -> int:
        """Note damage, and go on at the end of the record or at the next place."""
        start, opcode = self.at, self._peek(self.at, 1)[0]
        self._end_run()
        self._index = {}  # message indexes may follow
        lost = Lost.MESSAGES
        if not self._has_end(stop) or opcode == Opcode.MESSAGE:
            stop = self._next_place()
            lost = Lost.REST if stop == self._end else Lost.MESSAGES
        elif opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
            lost = Lost.EXTRA
        self._note(start, stop, str(fault), lost)
        return stop

    def _note(self, start: int, stop: int, fault: str, lost: Lost) -> None:
        self.damages.append(Damage(start, stop, fault, lost))

    def _keep(self, chunk: r.Chunk) -> int:
        """Add a chunk, with its true times and counts; raises FormatError if it is damaged."""
        if not chunk.loose and chunk.data_offset + chunk.data_size != chunk.end:
            raise FormatError("damaged chunk: its two lengths differ")
        try:
            data, messages, definitions = read_chunk(self.file, chunk)
            for opcode, start, stop in () if chunk.loose else definitions.tolist():
                self.contents.define(opcode, memoryview(data)[start:stop])
        except (struct.error, ValueError, OverflowError) as fault:
            raise FormatError(f"damaged chunk: {fault}") from None
        if len(messages):
            times = messages[:, LOG_TIME]
            chunk = replace(chunk, start_time=int(times.min()), end_time=int(times.max()))
        counts = Counter(messages[:, CHANNEL].tolist())
        self.contents.chunks.append(replace(chunk, counts=counts))
        return chunk.end

    def _leave_chunk(self) -> None:
        """Believe message indexes, which have no checksum, in a file without damage only.

        Otherwise a copy of the file gets new ones.
        """
        index, self._index = self._index, None
        if index and not self.damages:
            chunk, counts = self.contents.chunks[-1], {i: n for i, n in index.items() if n}
            if counts == chunk.counts:
                self.contents.chunks[-1] = replace(chunk, index_end=self._index_end)
            else:
                fault = "a chunk's message indexes do not match it"
                self._note(chunk.end, self._index_end, fault, Lost.NOTHING)

    def _loose_message(self, begin: int, stop: int) -> None:
        if self.damages:
            raise FormatError("behind damage, nothing vouches for messages outside of chunks")
        channel = int.from_bytes(self._peek(begin, 2), "little")
        if channel not in self._definitions.channels and channel not in self.contents.channels:
            raise FormatError(f"a message belongs to channel {channel}, which is not defined")
        super()._loose_message(begin, stop)

    def _data_end(self, begin: int, stop: int) -> None:
        if stop - begin != 4:  # another record with a flipped bit in its head
            raise FormatError("the data end record has a wrong length")
        self._data_ended = True
        if not self.damages:  # which change the checksum
            super()._data_end(begin, stop)

    # -- the answer ----------------------------------------------------------------------------

    def _recovery(self) -> Recovery:
        """Complete the contents and return what is lost; raises LogError if nothing is left."""
        contents = self.contents
        contents.schemas = {**self._definitions.schemas, **contents.schemas}
        channels = {**self._definitions.channels, **contents.channels}
        contents.channels = {
            i: c for i, c in channels.items() if not c.schema_id or c.schema_id in contents.schemas
        }
        losses = merged(self._losses())
        if not self.damages and any(loss.lost for loss in losses):
            fault = "messages, or the definition of their channel, are missing"
            self._note(self._end, self._end, fault, Lost.MESSAGES)
        if self.damages and not any(loss.recovered for loss in losses):
            place, fault = self.damages[0].offset, self.damages[0].fault
            text = f"no message of it can be read: {fault} at byte {place}"
            raise LogError(text if place else "is not an MCAP file", path=self.file.path)
        unchecked = 0
        for k, chunk in enumerate(contents.chunks):
            counts = {i: n for i, n in (chunk.counts or {}).items() if i in contents.channels}
            index_end = chunk.end if self.damages else chunk.index_end
            contents.chunks[k] = replace(chunk, counts=counts, index_end=index_end)
            unchecked += 0 if chunk.crc or contents.has_data_crc else sum(counts.values())
        return Recovery(tuple(self.damages), losses, unchecked)

    def _losses(self) -> Iterator[ChannelLoss]:
        """Compare what is there with the statistics; without them, the loss is unknown."""
        channels, kept = self.contents.channels, Counter[int]()
        for chunk in self.contents.chunks:
            kept.update(chunk.counts or {})
        unknown = any(damage.lost in (Lost.MESSAGES, Lost.REST) for damage in self.damages)
        for i in sorted({*channels, *kept, *(self._claimed or ())}):
            lost = None if unknown else 0
            if self._claimed is not None:
                lost = max(0, self._claimed.get(i, 0) - kept[i])
            if i in channels:
                yield ChannelLoss(channels[i].topic, kept[i], lost)
            elif kept[i] or lost:
                yield ChannelLoss(f"channel {i} without a definition", 0, kept[i] + (lost or 0))
