"""What can still be read of a damaged MCAP file.

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
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hiros_mcap.errors import LogError
from hiros_mcap.io.container import records as r
from hiros_mcap.io.container.chunks import ChunkRecords, Table, read_chunk
from hiros_mcap.io.container.compression import COMPRESSIONS, MAX_CHUNK
from hiros_mcap.io.container.file import LogFile
from hiros_mcap.io.container.reader import McapReader
from hiros_mcap.io.container.records import FormatError, Opcode
from hiros_mcap.io.container.recovery import ChannelLoss, Damage, Recovery, merged
from hiros_mcap.io.container.scan import Contents, Scan
from hiros_mcap.kernels.record_index import CHANNEL, LOG_TIME, START, STOP

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

Definitions = Mapping[int, r.Channel]


class RecoveringReader(McapReader):
    """Reads what is left of a damaged file; of a healthy one, everything.

    Raises LogError if the file cannot be opened, or nothing in it can be read.
    """

    recovery: Recovery

    def _walk(self) -> Contents:
        contents, self.recovery = salvage(self._file)
        return contents

    def _define(self, data: r.Bytes, definitions: Table) -> frozenset[int]:
        """Return the channels that a chunk defines; the walk took note of their definitions."""
        rows = (row for row in definitions.tolist() if row[0] == Opcode.CHANNEL)
        view = memoryview(data)
        return frozenset(r.parse_channel(view[start:stop]).id for _, start, stop in rows)

    def _accepted(self, chunk: r.Chunk, table: Table) -> Table:
        """Return the messages whose channel is known."""
        return table[np.isin(table[:, CHANNEL], list(self._contents.channels))]


def salvage(file: LogFile) -> tuple[Contents, Recovery]:
    """Walk a file that may be damaged; raises LogError if nothing in it can be read."""
    if not file.size:
        raise LogError("is empty (0 bytes)", path=file.path)
    try:
        walk = _Salvage(file, _RESUME).walk()
        if walk.damages and not walk.has_chunks:
            walk = _Salvage(file, _RESUME_UNCHUNKED).walk()
        return walk.result()
    except MemoryError:
        raise LogError("is too large for the memory", path=file.path) from None


class _Seen(NamedTuple):
    """Messages of one channel in one chunk."""

    number: int
    size: int
    """Bytes of their data."""
    first: int
    """Earliest log time, ns."""
    last: int
    """Latest log time, ns."""


class _Salvage(Scan):
    """The walk through a damaged file; ``resume`` finds places to go on at.

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
        self._unprotected = Contents()
        self._definitions = self.found
        self._seen: dict[int, dict[int, _Seen]] = {}  # by offset of the chunk, by channel
        self._records: ChunkRecords | None = None  # of the chunk that was just read
        self._entries: dict[int, Table] = {}  # of the message indexes behind it
        self._exact = False  # whether the chunk claims the times of its messages
        self._stop = 0
        self._data_ended = False

    def walk(self) -> _Salvage:
        """Find everything that can be read."""
        self._read_summary()
        self._definitions = self._unprotected
        self.at = min(len(r.MAGIC), self._end)
        if self.file.read(0, self.at) != r.MAGIC:
            self.damages.append(Damage(0, self.at, "not what an MCAP file begins with", {}))
        while self.at < self._end and not self._ends_at(self.at):
            self._step()
        self._leave_chunk(whole=self._complete)
        self._end_run()
        closed = self._end < self.file.size or self._ends_at(self.at)
        if not closed and not (self.damages and self.damages[-1].end == self._end):
            fault = f"the {'summary' if self._data_ended else 'recording'} was cut off here"
            cut = Damage(self._end, self._end, fault, {} if self._data_ended else None)
            self.damages.append(cut)
        self.file.check_unchanged()
        return self

    @property
    def _complete(self) -> bool:
        """Whether the walk has seen where the data end."""
        return self._data_ended or self._end < self.file.size

    # -- the summary ---------------------------------------------------------------------------

    def _read_summary(self) -> None:
        """Take definitions, places and statistics from the summary if its checksum holds."""
        try:
            footer = self.file.size - len(r.MAGIC) - r.FOOTER.size
            start, _, _ = r.FOOTER.unpack(self._peek(max(footer, 0), r.FOOTER.size))
            if not len(r.MAGIC) < start < footer:
                return
            self.at = start
            self._section(self._summary_records(), Opcode.FOOTER)
            self._footer(start)
        except (FormatError, LogError, struct.error):
            self.found = self._definitions = Contents()
            self._chunk_indexes, self._places = [], []
            return
        self._claimed, self.found.statistics = self.found.statistics, None
        self._places = sorted([*self._places, *(i.chunk_start_offset for i in self._chunk_indexes)])
        if not self._chunk_indexes:
            self._places = []  # messages may be anywhere
        self._end = start

    def _summary_records(self) -> dict[int, Callable[[int, int], None]]:
        known = super()._summary_records()
        known[Opcode.ATTACHMENT_INDEX] = known[Opcode.METADATA_INDEX] = self._place
        return known

    def _place(self, begin: int, stop: int) -> None:
        self._places.append(r.Cursor(self._peek(begin, 8)).number(8))

    def _definition(self, begin: int, stop: int) -> None:
        opcode = self._peek(self.at, 1)[0]
        self._definitions.define(opcode, self._content(begin, stop))

    # -- record by record ----------------------------------------------------------------------

    def _step(self) -> None:
        """Take the record at ``at``, or go on behind the damage there."""
        opcode, stop = self._peek(self.at, 1)[0], 0
        try:
            opcode, begin, stop = self._next()
            handler = self._handler(opcode)
            if opcode != Opcode.CHUNK and not self._plausible(stop):
                raise FormatError(f"no record follows a {r.name_of(opcode)} record")
            if opcode != Opcode.MESSAGE_INDEX:
                self._leave_chunk(whole=True)
            if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                self._end_run()
            self._stop = stop
            handler(begin, stop)
            self.at = self._stop
        except (FormatError, struct.error) as fault:
            self._pass(str(fault), opcode, stop)

    def _handler(self, opcode: int) -> Callable[[int, int], None]:
        if opcode == Opcode.DATA_END:
            return self._last
        if opcode in self._data_records():
            return self._data_records()[opcode]
        if opcode >= r.PRIVATE_OP or opcode in _HARMLESS:
            return self._skip
        raise FormatError(f"a {r.name_of(opcode)} record is not allowed here")

    def _last(self, begin: int, stop: int) -> None:
        """Compare the checksum of the data, which may cover what has no other one."""
        crc = r.Cursor(self._content(begin, stop)).number(4)
        holds = crc != 0 and crc == self.file.crc(0, self.at)
        self.found.has_data_crc = holds
        if crc and not holds and not self.damages:
            fault = "the checksum of the data section is wrong"
            self.damages.append(Damage(self.at, stop, fault, {}))
        self._data_ended = True

    def _pass(self, fault: str, opcode: int, stop: int) -> None:
        """Go on behind damage: at the next record if the length of this one holds."""
        self._leave_chunk(whole=False)
        self._end_run()
        start, is_chunk = self.at, opcode == Opcode.CHUNK
        alone = stop > start and self._plausible(stop)
        end = stop if alone else self._resync(start + 1)
        extra = opcode in (Opcode.ATTACHMENT, Opcode.METADATA) and not self._data_ended
        known = self._data_ended or (alone and (extra or opcode in _HARMLESS))
        span = self._claimed_times(start) if is_chunk else None
        self.damages.append(Damage(start, end, fault, {} if known else None, None, span, extra))
        self.has_chunks |= is_chunk
        self.at = end
        if is_chunk and alone:
            self._index = {}  # the message indexes that follow tell what is lost

    def _claimed_times(self, offset: int) -> tuple[int, int] | None:
        """Log times, ns, in the head of a lost chunk, which has no checksum."""
        head = self._peek(offset, min(_OVERLAP, self.file.size - offset))
        if not _CHUNK_HEAD.match(head):
            return None
        start, end, _, _ = r.CHUNK_HEAD.unpack_from(head, r.HEAD.size)
        return (start, end) if start <= end else None

    def _short(self, where: str) -> Exception:
        return FormatError(f"the file ends {where}")

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

    # -- going on behind damage ----------------------------------------------------------------

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
            while (found := self._resume.search(data, at)) and found.start() < _BLOCK:
                yield block + found.start()
                at = found.start() + 1

    def _holds(self, offset: int) -> bool:
        """Whether the candidate is a record: a chunk by its checksum, others by what follows."""
        self.at = offset
        try:
            opcode, begin, stop = self._next()
            if opcode == Opcode.CHUNK:
                chunk = self._chunk_head(begin, stop)
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

    # -- chunks --------------------------------------------------------------------------------

    def _chunk(self, begin: int, stop: int) -> None:
        """Take a chunk if its checksum holds."""
        self.has_chunks = True
        chunk = self._chunk_head(begin, stop)
        # The length of the record has no checksum, that of the data has one.
        end = chunk.data_offset + chunk.data_size
        if end != stop and (self._plausible(end) or not self._plausible(stop)):
            self._stop = end
            chunk = replace(chunk, end=end, index_end=end)
        self._take(chunk)
        self._index = {}

    def _take(self, chunk: r.Chunk) -> None:
        """Add a chunk, with its true times and counts; raises FormatError if it is damaged."""
        if chunk.compression not in COMPRESSIONS:
            raise FormatError(f"unknown compression {chunk.compression!r}")
        try:
            records = read_chunk(self.file, chunk)
            if not chunk.loose:
                for opcode, start, stop in records.definitions.tolist():
                    self.found.define(opcode, memoryview(records.data)[start:stop])
        except (struct.error, ValueError, OverflowError) as fault:
            raise FormatError(f"damaged chunk: {fault}") from None
        seen = dict(_by_channel(records.messages))
        times = [time for s in seen.values() for time in (s.first, s.last)]
        first, last = min(times, default=chunk.start_time), max(times, default=chunk.end_time)
        self._exact = (chunk.start_time, chunk.end_time) == (first, last)
        self._records, self._entries = records, {}
        self._seen[chunk.offset] = seen
        counts = {channel: s.number for channel, s in seen.items()}
        self.found.chunks.append(replace(chunk, start_time=first, end_time=last, counts=counts))

    def _message_index(self, begin: int, stop: int) -> None:
        super()._message_index(begin, stop)
        at = r.Cursor(self._content(begin, stop))
        channel = at.number(2)
        self._entries[channel] = np.frombuffer(at.take(at.number(4)), "<u8").reshape(-1, 2)

    def _leave_chunk(self, *, whole: bool) -> None:
        """Compare the message indexes with their chunk, or learn from them what is lost.

        ``whole``: no index is missing because of damage.
        """
        index, self._index = self._index, None
        records, self._records = self._records, None
        if not index:
            return
        if records is None:
            if whole:
                self.damages[-1] = self._told(self.damages[-1])
        elif self._exact and _agrees(records.messages, self._entries):
            self.found.chunks[-1] = replace(self.found.chunks[-1], index_end=self._index_end)
        elif whole:
            start, fault = self.found.chunks[-1].end, "a chunk's message indexes do not match it"
            self.damages.append(Damage(start, self._index_end, fault, {}))

    def _told(self, damage: Damage) -> Damage:
        """Return what the message indexes behind a lost chunk tell of it, if that can be."""
        _, _, size, _ = self._fields(damage.offset + r.HEAD.size, r.CHUNK_HEAD)
        channels = [i for i, entries in self._entries.items() for _ in range(len(entries))]
        entries = np.concatenate(list(self._entries.values()))
        order = np.argsort(entries[:, 1])
        starts = entries[order, 1].tolist()
        if not starts or starts[-1] + _BEFORE_DATA > size:
            return damage
        sizes = dict.fromkeys(self._entries, 0)
        for k, start, end in zip(order.tolist(), starts, [*starts[1:], size], strict=True):
            sizes[channels[k]] += max(0, end - start - _BEFORE_DATA)
        counts = {i: len(found) for i, found in self._entries.items()}
        span = int(entries[:, 0].min()), int(entries[:, 0].max())
        return replace(damage, counts=counts, sizes=sizes, span=span)

    # -- outside of chunks ---------------------------------------------------------------------

    def _loose_message(self, begin: int, stop: int) -> None:
        self._check_channel(begin)
        super()._loose_message(begin, stop)

    def _check_channel(self, begin: int) -> None:
        """Raise FormatError unless the message at ``begin`` belongs to a channel so far."""
        channel = int.from_bytes(self._peek(begin, 2), "little")
        if channel not in self._unprotected.channels and channel not in self.found.channels:
            raise FormatError(f"a message belongs to channel {channel}, which is not defined")

    def _end_run(self) -> None:
        run, self._run = self._run, None
        if run is not None:
            self._take(run.chunk())
            self._records = None

    # -- the answer ----------------------------------------------------------------------------

    def result(self) -> tuple[Contents, Recovery]:
        """Return what can be read and what is lost; raises LogError if there is nothing."""
        found = self.found
        found.schemas = {**self._unprotected.schemas, **found.schemas}
        channels = {**self._unprotected.channels, **found.channels}
        found.channels = {
            i: c for i, c in channels.items() if not c.schema_id or c.schema_id in found.schemas
        }
        found.chunks = [self._known(chunk) for chunk in found.chunks]
        recovered = sum(sum((chunk.counts or {}).values()) for chunk in found.chunks)
        if self.damages and not recovered:
            first = self.damages[0]
            fault = (
                "is not an MCAP file"
                if not first.offset
                else f"no message of it can be read: {first.fault} at byte {first.offset}"
            )
            raise LogError(fault, path=self.file.path)
        plain = [chunk for chunk in found.chunks if not chunk.crc]
        unchecked = sum(sum((chunk.counts or {}).values()) for chunk in plain)
        losses = merged(self._loss(i) for i in sorted(self._all_channels()))
        recovery = Recovery(tuple(self.damages), losses, 0 if found.has_data_crc else unchecked)
        return found, recovery

    def _known(self, chunk: r.Chunk) -> r.Chunk:
        """Return the chunk without messages whose channel is not defined anywhere."""
        counts = {i: n for i, n in (chunk.counts or {}).items() if i in self.found.channels}
        if counts == chunk.counts:
            return chunk
        return replace(chunk, counts=counts, index_end=chunk.end)

    def _all_channels(self) -> set[int]:
        """Return the ids of every channel that is known to have, or may have had, messages."""
        found: set[int] = set(self.found.channels)
        for seen in self._seen.values():
            found |= seen.keys()
        for damage in self.damages:
            found |= (damage.counts or {}).keys()
        return found

    def _loss(self, channel: int) -> ChannelLoss:
        """Return what is left of a channel, and what is lost as far as can be known."""
        seen = [chunk[channel] for chunk in self._seen.values() if channel in chunk]
        kept = sum(s.number for s in seen)
        if channel not in self.found.channels:
            topic, size = f"channel {channel} without a definition", sum(s.size for s in seen)
            span = max(s.last for s in seen) - min(s.first for s in seen) if seen else None
            return ChannelLoss(topic, 0, kept, size, None if span is None else span * 1e-9)
        topic = self.found.channels[channel].topic
        suspects = [d for d in self.damages if d.counts is None or d.counts.get(channel)]
        lost = self._lost(channel, kept, suspects)
        if lost == 0:
            return ChannelLoss(topic, kept, 0, 0, 0.0)
        sizes = [None if d.sizes is None else d.sizes.get(channel, 0) for d in suspects]
        gaps = [self._gap(channel, d) for d in suspects]
        known_sizes = [n for n in sizes if n is not None]
        known_gaps = [n for n in gaps if n is not None]
        return ChannelLoss(
            topic,
            kept,
            lost,
            sum(known_sizes) if len(known_sizes) == len(sizes) else None,
            sum(known_gaps) if len(known_gaps) == len(gaps) else None,
        )

    def _lost(self, channel: int, kept: int, suspects: Iterable[Damage]) -> int | None:
        """Messages of a channel that are lost, by the statistics or the message indexes."""
        claimed = self._claimed
        if claimed is not None:
            counts = claimed.channel_message_counts
            if sum(counts.values()) == claimed.message_count:
                return max(0, counts.get(channel, 0) - kept)
        counts_lost = [None if d.counts is None else d.counts[channel] for d in suspects]
        return None if None in counts_lost else sum(n for n in counts_lost if n is not None)

    def _gap(self, channel: int, damage: Damage) -> float | None:
        """Time, s, without messages about some damage, of any channel that it may concern."""
        every = damage.counts is None
        before, after = [], []
        for offset, chunk in self._seen.items():
            some = [s for i, s in chunk.items() if every or i == channel]
            if offset < damage.offset:
                before += [s.last for s in some]
            elif offset >= damage.end:
                after += [s.first for s in some]
        start = max(before, default=damage.span and damage.span[0])
        end = min(after, default=damage.span and damage.span[1])
        return None if start is None or end is None else max(0, end - start) * 1e-9


def _by_channel(messages: Table) -> Iterator[tuple[int, _Seen]]:
    """Yield what a chunk holds of each of its channels."""
    for channel in np.unique(messages[:, CHANNEL]).tolist():
        rows = messages[messages[:, CHANNEL] == channel]
        size = int((rows[:, STOP] - rows[:, START]).sum())
        times = rows[:, LOG_TIME]
        yield channel, _Seen(len(rows), size, int(times.min()), int(times.max()))


def _agrees(messages: Table, entries: Mapping[int, Table]) -> bool:
    """Whether message indexes list exactly the messages of their chunk."""
    ids = np.array(list(entries), np.uint64)
    channels = np.repeat(ids, [len(some) for some in entries.values()])
    found = np.column_stack([channels, *np.concatenate(list(entries.values())).T])
    wanted = messages[:, [CHANNEL, LOG_TIME, START]]
    wanted[:, 2] -= np.uint64(_BEFORE_DATA)
    return np.array_equal(found[np.argsort(found[:, 2])], wanted)
