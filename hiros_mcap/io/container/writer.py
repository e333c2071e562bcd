"""Writes an MCAP file: chunked, indexed, with every checksum, the same bytes for the same calls.

One background thread encodes, compresses and writes in the order of the calls. Timing and the
number of cores therefore change no byte. Clock, host and paths do not get into the file.
"""

from __future__ import annotations

import os
import struct
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any, Self

from isal.isal_zlib import crc32

from hiros_mcap._version import __version__
from hiros_mcap.errors import LogError
from hiros_mcap.io.container import records as r
from hiros_mcap.io.container.file import COMPRESSIONS, OutputFile, Sink, compress
from hiros_mcap.io.container.reader import McapReader
from hiros_mcap.io.container.records import Opcode

CHUNK_SIZE = 2 << 20
"""A chunk is closed when its records reach this many bytes. 2 and 4 MiB take 5 % less than 1 MiB,
since the threads disturb each other less often."""
_GATHERED = 1 << 18  # bytes of single messages that are handed over together
_MAX_ID = 0xFFFF
_MESSAGE = struct.Struct("<BQHIQQ")

Numbered = tuple[int, int, int, int, r.Bytes]
"""A message: channel, sequence number, log and publish time, ns, and its bytes."""


class OpenChunk:
    """The chunk that is being filled, by the background thread alone.

    The next chunk takes its room: bytes that grow are copied again and again on their way.
    """

    def __init__(self) -> None:
        self._room = memoryview(bytearray())
        self.clear()

    def clear(self) -> None:
        """Begin the next chunk."""
        self.size = 0
        self.index: dict[int, list[tuple[int, int]]] = {}
        self.start_time, self.end_time = 2**64, 0

    @property
    def records(self) -> memoryview:
        """Of the chunk, until it is cleared."""
        return self._room[: self.size]

    def add(
        self, channel_id: int, number: int, log_time: int, published: int, data: r.Bytes
    ) -> None:
        """Append a message."""
        begin = self.size + _MESSAGE.size
        end = begin + len(data)
        if end > len(self._room):
            records, self._room = self.records, memoryview(bytearray(end + end // 8))
            self._room[: self.size] = records
        size = end - self.size - r.HEAD.size
        head = Opcode.MESSAGE, size, channel_id, number, log_time, published
        _MESSAGE.pack_into(self._room, self.size, *head)
        self._room[begin:end] = data
        self.index.setdefault(channel_id, []).append((log_time, self.size))
        self.start_time = min(self.start_time, log_time)
        self.end_time = max(self.end_time, log_time)
        self.size = end


class McapWriter:
    """An MCAP file in the making; nothing appears at its path before ``commit``.

    Use it as a context manager: leaving it without a commit, by an error or not, removes every
    trace and leaves a former file untouched.

    Parameters
    ----------
    out : the output, a file or where else the bytes go.
    inputs : files that must not be the output.
    compression : zstd, lz4 or "" for none.
    chunk_size : bytes of records per chunk.
    """

    def __init__(
        self,
        out: str | os.PathLike[str] | Sink,
        *,
        inputs: Iterable[str | os.PathLike[str]] = (),
        compression: str = "zstd",
        chunk_size: int = CHUNK_SIZE,
    ) -> None:
        if compression not in COMPRESSIONS:
            raise ValueError(f"compression is one of {COMPRESSIONS}, not {compression!r}")
        self.schemas: dict[int, r.Schema] = {}
        self.channels: dict[int, r.Channel] = {}
        self.counts: Counter[int] = Counter()
        self.cpu_s = 0.0  # CPU time, s, of the background thread so far
        self._compression = compression
        self._chunk_size = chunk_size
        self._times: list[int] = []
        self._reserved: tuple[set[int], set[int]] = (set(), set())  # schemas and channels
        self._batch = OpenChunk()
        self._singles: list[Numbered] = []
        self._gathered = 0
        self._indexes: list[r.ChunkIndex] = []
        self._extras: list[tuple[int, bytes]] = []
        self._waiting: deque[Future[None]] = deque()
        self._out = out if isinstance(out, Sink) else OutputFile(out, inputs)
        self.path = self._out.path
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="hiros-write")
        header = r.record(Opcode.HEADER, r.text("ros2"), r.text(f"hiros {__version__}"))
        self._submit(self._out.write, r.MAGIC, header)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.shutdown(cancel_futures=True)
        self._out.discard()

    # -- definitions ---------------------------------------------------------------------------

    def copy_definitions(self, reader: McapReader, channels: Iterable[int]) -> None:
        """Copy channels with their ids, schemas and metadata.

        New ids will be none of that file, also not of channels that are not copied.
        """
        contents = reader.contents
        self._reserved[0].update(contents.schemas)
        self._reserved[1].update(contents.channels)
        for channel in (contents.channels[i] for i in sorted(channels)):
            if channel.schema_id:
                self.define(contents.schemas[channel.schema_id])
            self.define(channel)

    def add_schema(self, name: str, data: bytes, encoding: str = "ros2msg") -> int:
        """Add a definition of messages and return its id."""
        ident = self._free(self.schemas, self._reserved[0])
        schema = r.Schema(id=ident, name=name, encoding=encoding, data=data)
        self._define(self.schemas, schema)
        return schema.id

    def add_channel(
        self,
        topic: str,
        schema_id: int,
        *,
        encoding: str = "cdr",
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Add a channel and return its id; schema 0 means none."""
        if schema_id and schema_id not in self.schemas:
            raise ValueError(f"there is no schema {schema_id}")
        ident = self._free(self.channels, self._reserved[1])
        channel = r.Channel(
            id=ident,
            topic=topic,
            message_encoding=encoding,
            schema_id=schema_id,
            metadata=dict(metadata or {}),
        )
        self._define(self.channels, channel)
        return ident

    def define(self, new: r.Schema | r.Channel) -> None:
        """Add a definition with its id; raises ValueError if another one has it."""
        self._define(self.schemas if isinstance(new, r.Schema) else self.channels, new)

    def _define(self, table: dict[int, Any], new: Any) -> None:
        present = table.setdefault(new.id, new)
        if present is not new:
            if present != new:
                raise ValueError(f"id {new.id} is taken by another definition")
            return
        self._submit(self._out.write, r.build(new))

    def _free(self, table: Mapping[int, object], reserved: set[int]) -> int:
        """Return the id above all others, or the smallest free one if there is none above."""
        taken = reserved | table.keys()
        ident = max(taken, default=0) + 1
        if ident > _MAX_ID:
            ident = next((i for i in range(1, _MAX_ID + 1) if i not in taken), 0)
        if not ident:
            raise LogError("has no ids left for new channels", path=self.path)
        return ident

    # -- messages ------------------------------------------------------------------------------

    def write(
        self,
        channel_id: int,
        log_time: int,
        data: r.Bytes,
        *,
        publish_time: int | None = None,
        sequence: int | None = None,
    ) -> None:
        """Add a message; times are ns.

        The publish time is the log time unless given; the sequence number counts the channel's
        messages unless given.

        Raises ValueError for a channel that does not exist, and for numbers below 0 or too large.
        """
        published = log_time if publish_time is None else publish_time
        times = log_time, published
        if not (0 <= min(times) <= max(times) < 2**64 and 0 <= (sequence or 0) < 2**32):
            raise ValueError(f"a message has no such times or number: {times}, {sequence}")
        counted = self._count(channel_id, 1)
        number = counted if sequence is None else sequence
        self._singles.append((channel_id, number, *times, bytes(data)))
        self._gathered += _MESSAGE.size + len(data)
        if self._gathered >= _GATHERED:
            self._hand_over()

    def write_each(
        self, channel_id: int, log_times: Sequence[int], messages: Iterable[r.Bytes]
    ) -> None:
        """Add messages that the background thread makes; a later call raises its errors.

        So a run is not held up: encoding takes a tenth of the time of a whole run.
        """
        first = self._count(channel_id, len(log_times))
        pairs = enumerate(zip(log_times, messages, strict=True), first)
        self._submit(self._add, ((channel_id, n, time, time, data) for n, (time, data) in pairs))

    def _count(self, channel_id: int, n: int) -> int:
        """Count messages of a channel; return the sequence number of the first."""
        if channel_id not in self.channels:
            raise ValueError(f"there is no channel {channel_id}")
        self.counts[channel_id] += n
        return self.counts[channel_id] - n

    def copy_chunk(self, reader: McapReader, chunk: r.Chunk) -> None:
        """Copy a chunk's messages of the copied channels; bytes, times and numbers stay.

        A chunk of which everything is kept is checked and copied in its compressed form. Of any
        other chunk, the messages are added one by one; so they are where the reader has given them
        other log times (:meth:`McapReader.retime`), which are copied, and where the messages are
        compressed themselves.
        """
        counts = {i: n for i, n in (chunk.counts or {}).items() if n}
        if not any(i in self.channels for i in counts):
            return
        whole = counts.keys() | reader.definitions_in(chunk) <= self.channels.keys()
        as_it_is = not (chunk.retimed or reader.has_packed_messages(chunk))
        if whole and chunk.index_end > chunk.end and as_it_is:
            self.counts.update(counts)
            self._submit(self._emit_copy, chunk, reader)
            return
        for message in reader.messages_in(chunk):
            if message.channel_id in self.channels:
                self.write_message(message.channel_id, message)

    def write_message(self, channel_id: int, message: r.Message) -> None:
        """Add a message of a file, with its times and number."""
        self.write(
            channel_id,
            message.log_time,
            message.data,
            publish_time=message.publish_time,
            sequence=message.sequence,
        )

    def append(self, reader: McapReader, channels: Collection[int]) -> None:
        """Copy all messages of some channels of a file in the order in which they lie in it.

        A channel keeps its id unless one of another file has it; equal channels of several files
        become one.
        """
        ids = {
            i: self.adopt(reader.channels[i], reader.schema(reader.channels[i]))
            for i in sorted(channels)
        }
        others = reader.channels.keys() - ids.keys()
        kept = all(i == new for i, new in ids.items()) and not (others & self.channels.keys())
        for chunk in sorted(reader.contents.chunks, key=lambda chunk: chunk.offset):
            if kept:
                self._submit(self._flush)  # what is copied next lies behind these messages
                self.copy_chunk(reader, chunk)
            elif chunk.holds(ids):
                for message in reader.messages_in(chunk):
                    if message.channel_id in ids:
                        self.write_message(ids[message.channel_id], message)
        self._wait()  # the file may be closed now

    def append_extras(self, reader: McapReader) -> None:
        """Copy the attachments and the metadata of a file."""
        for name, values in reader.contents.metadata:
            self.add_metadata(name, values)
        for index in reader.contents.attachments:
            times = index.log_time, index.create_time
            self.add_attachment(index.name, reader.data_of(index), index.media_type, times)

    def _wait(self) -> None:
        """Wait until the background thread has done everything so far."""
        while self._waiting:
            self._waiting.popleft().result()

    def adopt(self, channel: r.Channel, schema: r.Schema | None) -> int:
        """Return the id of a channel that is equal to one of a log; add it if there is none."""
        ident = channel.id

        def equal(other: r.Channel) -> bool:
            mine = self.schemas.get(other.schema_id)
            same = mine == schema or (mine and schema and replace(mine, id=schema.id) == schema)
            return bool(same) and replace(other, id=0, schema_id=0) == replace(
                channel, id=0, schema_id=0
            )

        for present in sorted(self.channels.values(), key=lambda other: other.id != ident):
            if equal(present):
                return present.id
        if schema is not None and self.schemas.get(schema.id, schema) != schema:
            schema = replace(schema, id=self._free(self.schemas, self._reserved[0]))
        if ident in self.channels:
            ident = self._free(self.channels, self._reserved[1])
        if schema is not None:
            self.define(schema)
        self.define(replace(channel, id=ident, schema_id=schema.id if schema else 0))
        return ident

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record; keys are sorted."""
        content = r.text(name) + r.texts(values)
        self._submit(
            self._emit_extra, r.record(Opcode.METADATA, content), Opcode.METADATA_INDEX, name
        )

    def add_attachment(
        self,
        name: str,
        data: bytes,
        media_type: str = "application/octet-stream",
        times: tuple[int, int] = (0, 0),
    ) -> None:
        """Add a file; its times of logging and creation, ns, are 0 unless it is copied.

        So the output depends on the input only.
        """
        logged, created = times
        file = r.Attachment(
            create_time=created, log_time=logged, name=name, media_type=media_type, data=data
        )
        tail = struct.pack("<QQQ", *times, len(data)) + r.text(name) + r.text(media_type)
        self._submit(self._emit_extra, r.build(file), Opcode.ATTACHMENT_INDEX, tail)

    def commit(self) -> None:
        """Finish the file, check it and let it appear at ``path``, replacing what was there."""
        self._submit(self._flush)
        self._wait()
        self._summary()
        self._out.commit()

    # -- in the background ---------------------------------------------------------------------

    def _submit(self, job: Callable[..., None], *args: Any) -> None:
        """Queue a job of the background thread; its errors are raised by a later call."""
        if self._singles:
            self._hand_over()
        self._queue(job, *args)

    def _hand_over(self) -> None:
        """Queue the single messages so far."""
        singles, self._singles, self._gathered = self._singles, [], 0
        self._queue(self._add, singles)

    def _queue(self, job: Callable[..., None], *args: Any) -> None:
        self._waiting.append(self._worker.submit(self._do, job, *args))
        while len(self._waiting) > 8:
            self._waiting.popleft().result()

    def _do(self, job: Callable[..., None], *args: Any) -> None:
        start = time.thread_time()
        try:
            job(*args)
        finally:
            self.cpu_s += time.thread_time() - start

    def _add(self, messages: Iterable[Numbered]) -> None:
        """Put messages into the chunk."""
        for message in messages:
            self._batch.add(*message)
            if self._batch.size >= self._chunk_size:
                self._flush()

    def _flush(self) -> None:
        """Write the chunk, and begin the next one."""
        if self._batch.index:
            self._emit_batch(self._batch)
            self._batch.clear()

    def _emit_batch(self, batch: OpenChunk) -> None:
        times, data = (batch.start_time, batch.end_time), batch.records
        packed = compress(data, self._compression)
        head = r.CHUNK_HEAD.pack(*times, len(data), crc32(data)) + r.text(self._compression)
        fixed = head + struct.pack("<Q", len(packed))
        indexes = {}
        for channel, entries in sorted(batch.index.items()):
            flat = struct.pack(f"<{2 * len(entries)}Q", *(n for pair in entries for n in pair))
            head = r.INDEX_HEAD.pack(channel, len(flat))
            indexes[channel] = r.record(Opcode.MESSAGE_INDEX, head, flat)
        record = r.HEAD.pack(Opcode.CHUNK, len(fixed) + len(packed)), fixed, packed
        self._emit(record, indexes, times, self._compression, (len(packed), len(data)))

    def _emit_copy(self, chunk: r.Chunk, reader: McapReader) -> None:
        raw = memoryview(reader.raw(chunk))
        at = length = chunk.end - chunk.offset
        indexes = {}
        while at < len(raw):
            _, size = r.HEAD.unpack_from(raw, at)
            channel, _ = r.INDEX_HEAD.unpack_from(raw, at + r.HEAD.size)
            indexes[channel] = raw[at : at + r.HEAD.size + size]
            at += len(indexes[channel])
        times, sizes = (chunk.start_time, chunk.end_time), (chunk.data_size, chunk.size)
        self._emit([raw[:length]], indexes, times, chunk.compression, sizes)

    def _emit(
        self,
        record: Sequence[r.Bytes],
        indexes: Mapping[int, r.Bytes],
        times: tuple[int, int],
        compression: str,
        sizes: tuple[int, int],
    ) -> None:
        """Write a chunk and its message indexes, by channel.

        ``times`` are log times, ns, and ``sizes`` the bytes of its messages, packed and plain.
        """
        start, length = self._out.offset, sum(map(len, record))
        at, offsets = start + length, {}
        for channel, data in indexes.items():
            offsets[channel] = at
            at += len(data)
        self._out.write(*record, *indexes.values())
        self._times += times
        self._indexes.append(
            r.ChunkIndex(
                message_start_time=times[0],
                message_end_time=times[1],
                chunk_start_offset=start,
                chunk_length=length,
                message_index_offsets=offsets,
                message_index_length=at - start - length,
                compression=compression,
                compressed_size=sizes[0],
                uncompressed_size=sizes[1],
            )
        )

    def _emit_extra(self, content: bytes, opcode: int, tail: bytes | str) -> None:
        """Write metadata or an attachment and note its index record."""
        place = struct.pack("<QQ", self._out.offset, len(content))
        rest = r.text(tail) if isinstance(tail, str) else tail
        self._extras.append((opcode, r.record(opcode, place, rest)))
        self._out.write(content)

    # -- summary -------------------------------------------------------------------------------

    def _statistics(self) -> r.Statistics:
        kinds = Counter(opcode for opcode, _ in self._extras)
        return r.Statistics(
            message_count=self.counts.total(),
            schema_count=len(self.schemas),
            channel_count=len(self.channels),
            attachment_count=kinds[Opcode.ATTACHMENT_INDEX],
            metadata_count=kinds[Opcode.METADATA_INDEX],
            chunk_count=len(self._indexes),
            message_start_time=min(self._times, default=0),
            message_end_time=max(self._times, default=0),
            channel_message_counts={i: n for i, n in sorted(self.counts.items()) if n},
        )

    def _summary(self) -> None:
        """Write the end of data, the summary, its offsets and the footer."""
        self._out.write(r.record(Opcode.DATA_END, struct.pack("<I", self._out.crc)))
        groups = [
            (Opcode.SCHEMA, [r.build(self.schemas[i]) for i in sorted(self.schemas)]),
            (Opcode.CHANNEL, [r.build(self.channels[i]) for i in sorted(self.channels)]),
            (Opcode.STATISTICS, [r.build(self._statistics())]),
            (Opcode.CHUNK_INDEX, [r.build(index) for index in self._indexes]),
        ]
        groups += [
            (opcode, [index for kind, index in self._extras if kind == opcode])
            for opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)
        ]
        start = self._out.offset
        summary = bytearray()
        offsets = bytearray()
        for opcode, group in groups:
            if group:
                place = struct.pack("<BQQ", opcode, start + len(summary), sum(map(len, group)))
                offsets += r.record(Opcode.SUMMARY_OFFSET, place)
                summary += b"".join(group)
        footer = r.HEAD.pack(Opcode.FOOTER, r.FOOTER.size)
        footer += struct.pack("<QQ", start, start + len(summary))
        crc = crc32(summary + offsets + footer)
        self._out.write(summary, offsets, footer, struct.pack("<I", crc), r.MAGIC)


class LiveWriter(McapWriter):
    """An MCAP on its way to a reader: :meth:`flush` sends what was written since the last.

    Messages are not in chunks, since a chunk would have to wait for its last message, and no index
    grows with the length of the recording. Whatever leaves the ``with`` block without a commit has
    no end mark.
    """

    def __init__(self, out: Sink) -> None:
        super().__init__(out, compression="")

    def _queue(self, job: Callable[..., None], *args: Any) -> None:
        """Do a job at once: whoever flushes would wait for another thread anyway."""
        job(*args)

    def flush(self) -> None:
        """Send everything so far, and wait until it is on its way."""
        self._submit(self._flush)
        self._wait()

    def _emit_batch(self, batch: OpenChunk) -> None:
        first, last = self._times or (batch.start_time, batch.end_time)
        self._times = [min(first, batch.start_time), max(last, batch.end_time)]
        self._out.write(batch.records)


class ChunkCopier:
    """Copies chosen channels of a log chunk by chunk, in step with what else is written.

    Parameters
    ----------
    reader, writer : source and target; the definitions are copied at once.
    channels : ids of the channels to copy.
    """

    def __init__(self, reader: McapReader, writer: McapWriter, channels: Iterable[int]) -> None:
        self._reader, self._writer = reader, writer
        chosen = set(channels)
        writer.copy_definitions(reader, chosen)
        chunks = (chunk for chunk in reader.contents.chunks if chunk.holds(chosen))
        self._chunks = deque(sorted(chunks, key=lambda chunk: (chunk.start_time, chunk.offset)))

    def until(self, log_time: int) -> None:
        """Copy the chunks that start before or at ``log_time``, ns."""
        while self._chunks and self._chunks[0].start_time <= log_time:
            self._writer.copy_chunk(self._reader, self._chunks.popleft())

    def finish(self) -> None:
        """Copy the chunks that are left."""
        self.until(2**64)
