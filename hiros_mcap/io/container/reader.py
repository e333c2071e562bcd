"""Messages of an MCAP file, chunk by chunk or in order; a damaged file is an error.

What the reader promises: every message of the chosen channels is handed out exactly once with
exactly its bytes, or a LogError says what is wrong and where. Messages that rosbag2 compressed one
by one are handed out as they were before. Checksums are always compared,
nothing is taken from an index that the data contradict, and memory is bounded: a file whose chunks
overlap so much in time that they would take more is refused.
"""

from __future__ import annotations

import heapq
import math
import os
import struct
import time
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, Self, TypeVar

import numpy as np
import numpy.typing as npt

from hiros_mcap.errors import LogError
from hiros_mcap.io.bag_files import ZSTD_MAGIC
from hiros_mcap.io.container.file import (
    LogFile,
    Table,
    read_chunk,
    unpack_message,
)
from hiros_mcap.io.container.losses import Recovery
from hiros_mcap.io.container.records import (
    HEAD,
    MAX_CHUNK,
    AttachmentIndex,
    Bytes,
    Channel,
    Chunk,
    FormatError,
    Message,
    Schema,
)
from hiros_mcap.io.container.walk import Contents, remedy, scan
from hiros_mcap.kernels.record_index import CHANNEL, LOG_TIME, START, STOP

Keys = npt.NDArray[np.uint64]
"""(N, 3) log time, ns; first byte of the message's chunk in the file; its first byte in the chunk.
Messages are ordered by the first, those of equal time by the others: as they are in the file."""

LogTimes = tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]
"""Which messages of a chunk, in their order in the file, have other log times, and these, ns."""

T = TypeVar("T")


class LogOrder(Generic[T]):
    """Puts the messages of items, such as chunks, in order as soon as nothing earlier can come."""

    def __init__(self) -> None:
        self._items: dict[int, T] = {}
        self._keys: Keys = np.empty((0, 3), np.uint64)
        self._places = np.empty((0, 2), np.int64)  # number of the item, message in it
        self._added = 0

    def add(self, item: T, keys: Keys) -> None:
        """Add an item of N messages."""
        places = np.stack([np.full(len(keys), self._added), np.arange(len(keys))], axis=1)
        self._items[self._added] = item
        self._added += 1
        self._keys = np.concatenate([self._keys, keys])
        self._places = np.concatenate([self._places, places])

    def before(self, log_time: int | None) -> Iterator[tuple[T, list[int]]]:
        """Hand out the messages before a log time, or all that are left if it is None.

        Yields runs of messages of one item: the item, and which of its messages.
        """
        times = self._keys[:, 0]
        is_all = len(times) > 0 and (log_time is None or bool(times[-1] < log_time))
        if is_all and len(self._items) == 1 and bool((times[1:] > times[:-1]).all()):
            # Nothing overlaps, or one live message comes after the other.
            (item,) = self._items.values()
            self._keys, self._places, self._items = self._keys[:0], self._places[:0], {}
            yield item, list(range(len(times)))
            return
        ready = np.full(len(times), log_time is None) if log_time is None else times < log_time
        chosen = np.flatnonzero(ready)
        order = chosen[np.lexsort(self._keys[chosen].T[::-1])]
        places, items = self._places[order], self._items
        self._keys, self._places = self._keys[~ready], self._places[~ready]
        self._items = {i: items[i] for i in np.unique(self._places[:, 0]).tolist()}
        cuts = np.flatnonzero(np.diff(places[:, 0])) + 1
        for run in np.split(places, cuts) if len(places) else ():
            yield items[int(run[0, 0])], run[:, 1].tolist()


_AHEAD = 1
_AHEAD_BYTES = 64 * 2**20
MEMORY = 2**30
"""Bytes that reading may take unless the user allows more."""
_KEPT = 64 * 2**20
"""Bytes: the chunks of a file that holds no more stay in memory, so that each is read once."""
_TOGETHER = 8 * 2**20
"""Bytes of chunks that are read together: each batch costs every stage as much as some messages.
Recorders' chunks are of 0.75 to 4 MiB, ours of a little more than 2."""
_COLUMNS = [LOG_TIME, START]
_ATTACHMENT_FIXED = 32  # bytes before the data of an attachment, besides its names
PACKED_MESSAGES = (
    "its messages are compressed one by one with zstd (ros2 bag record --compression-mode "
    "message); hiros unpacks them"
)


class Records(NamedTuple):
    """The messages of one chunk, decompressed and checked."""

    data: Bytes
    messages: Table  # one row per message, columns as in kernels.record_index
    offset: int  # first byte of the chunk in the file

    @property
    def keys(self) -> Keys:
        """(N, 3) by which the messages are ordered."""
        keys = np.full((len(self.messages), 3), self.offset, np.uint64)
        keys[:, [0, 2]] = self.messages[:, _COLUMNS]
        return keys

    def only(self, chosen: npt.NDArray[np.bool_], least: int = 0) -> Records:
        """Keep some of the messages; drop the bytes of the others if these are most.

        Data of fewer than ``least`` bytes are kept.
        """
        messages = self.messages[chosen]
        if len(self.data) < least:
            return self._replace(messages=messages)
        lengths = messages[:, STOP] - messages[:, START]
        if 2 * int(lengths.sum()) > len(self.data):
            return self._replace(messages=messages)
        view = memoryview(self.data)
        data = b"".join(view[start:stop] for start, stop in messages[:, [START, STOP]].tolist())
        messages[:, STOP] = np.cumsum(lengths)
        messages[:, START] = messages[:, STOP] - lengths
        return self._replace(data=data, messages=messages)

    def packed(self, channels: Collection[int]) -> list[int]:
        """Return which messages of some channels, which are in CDR, are zstd frames instead."""
        starts = self.messages[:, START]
        data = np.frombuffer(self.data, np.uint8)
        could = self.messages[:, STOP] - starts >= len(ZSTD_MAGIC)
        for k, byte in enumerate(ZSTD_MAGIC):
            could[could] = data[starts[could] + np.uint64(k)] == byte
        rows = np.flatnonzero(could)
        chosen = np.isin(self.messages[rows, CHANNEL], list(channels))
        return [int(row) for row in rows[chosen]]

    def unpacked(self, rows: Collection[int]) -> Records:
        """Return the messages with what is in some of them, which are zstd frames.

        Raises FormatError for damaged frames, and for what is larger than a chunk may be.
        """
        view, parts, at = memoryview(self.data), [], 0
        chosen, messages = set(rows), self.messages.copy()
        for k, (start, stop) in enumerate(self.messages[:, [START, STOP]].tolist()):
            part: Bytes = view[start:stop]
            if k in chosen:
                part = unpack_message(part, MAX_CHUNK - at)
            parts.append(part)
            messages[k, [START, STOP]] = at, at + len(part)
            at += len(part)
        return self._replace(data=b"".join(parts), messages=messages)

    def at(self, rows: Sequence[int]) -> Iterator[Message]:
        """Yield some messages; their data are views, which are valid as long as they are held."""
        view = memoryview(self.data)
        for channel, sequence, logged, published, start, stop in self.messages[rows].tolist():
            data: Any = view[start:stop]
            yield Message(channel, logged, data, published, sequence)


class Batch(NamedTuple):
    """Messages of some chunks, in no particular order."""

    records: Sequence[Records]
    until: int | None
    """Every message with an earlier log time, ns, is in here or came before; None = every one."""

    def halves(self) -> tuple[Batch, Batch]:
        """Split the messages in two, the earlier and the later ones."""
        keys = np.concatenate([part.keys for part in self.records])
        order = np.lexsort(keys.T[::-1])
        later = np.zeros(len(keys), np.bool_)
        later[order[len(order) // 2 :]] = True
        cuts = np.cumsum([len(part.messages) for part in self.records])[:-1]
        flags = list(zip(self.records, np.split(later, cuts), strict=True))
        first = [part._replace(messages=part.messages[~flag]) for part, flag in flags]
        second = [part._replace(messages=part.messages[flag]) for part, flag in flags]
        return Batch(first, int(keys[later, 0].min())), Batch(second, self.until)


class McapReader:
    """An open MCAP file; use it as a context manager.

    Opening walks the whole file (see scan) and raises LogError for a damaged or truncated one.

    Parameters
    ----------
    path : the file, which may be open.
    memory : bytes that reading may take, about. Half of it is for chunks that overlap in time.

    Attributes
    ----------
    recovery : what is lost of a damaged file; None if such a file is refused.
    left_out : type and number of messages of the topics of a recording that the file lacks.
    remarks : what was converted for the file. warnings : what is missing of it.
    types : channel -> what its messages hold, where their type does not tell.
    faults : by topic, how many messages could not be converted, and why the first one could not.
    waited_s : time in which more of the file was waited for.
    prompt : when the latest message came that was waited for, s, and its log time, ns.
    """

    recovery: Recovery | None = None
    left_out: Mapping[str, tuple[str, int]] = MappingProxyType({})
    remarks: Sequence[str] = ()
    warnings: Sequence[str] = ()
    types: Mapping[int, str] = MappingProxyType({})
    faults: Mapping[str, tuple[int, str]] = MappingProxyType({})
    waited_s = 0.0
    prompt = math.inf, 0

    def __init__(self, path: str | os.PathLike[str] | LogFile, *, memory: int = MEMORY) -> None:
        self._file = path if isinstance(path, LogFile) else LogFile(path)
        self._memory = memory
        self.path: Path | str = self._file.path
        self.cpu_s = 0.0  # CPU time, s, of the threads that read ahead
        try:
            self._contents = self._walk()
            largest = max((chunk.size for chunk in self._contents.chunks), default=0)
            self._depth = min(_AHEAD, _AHEAD_BYTES // max(largest, _TOGETHER))
            self._checked: dict[int, frozenset[int]] = {}
            self._packed: set[int] = set()
            size = sum(chunk.size for chunk in self._contents.chunks)
            self._keeps = size <= min(_KEPT, memory // 8)
            self._kept: dict[int, Records] = {}
            self._retimed: Mapping[int, LogTimes] = {}
            self._complete_definitions()
            self.counts = self._count()
        except BaseException:
            self._file.close()
            raise

    def _walk(self) -> Contents:
        return scan(self._file)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def contents(self) -> Contents:
        """The index of the file: header, definitions, chunks, metadata, statistics."""
        return self._contents

    @property
    def memory(self) -> int:
        """Bytes that reading may take, about."""
        return self._memory

    @property
    def has_checksums(self) -> bool:
        """Whether a damaged message is noticed: a checksum covers each of them."""
        chunks = self._contents.chunks
        return self._contents.has_data_crc or all(chunk.crc for chunk in chunks if chunk.size)

    @property
    def channels(self) -> dict[int, Channel]:
        """Channels by id, also those without a message."""
        return self._contents.channels

    def schema(self, channel: Channel) -> Schema | None:
        """Message definition of a channel, None if it has none."""
        return self._contents.schemas.get(channel.schema_id)

    def attachment(self, name: str) -> bytes | None:
        """Bytes of the first attachment of a name, which the walk has checked; None = no such."""
        indexes = (index for index in self._contents.attachments if index.name == name)
        index = next(indexes, None)
        return None if index is None else self.data_of(index)

    def data_of(self, index: AttachmentIndex) -> bytes:
        """Bytes of an attachment that the walk found."""
        names = len(index.name.encode()) + len(index.media_type.encode())
        start = index.offset + HEAD.size + _ATTACHMENT_FIXED + names
        return self._file.read(start, index.data_size)

    def raw(self, chunk: Chunk) -> bytes:
        """Chunk record and its message index records as they are in the file."""
        return self._file.read(chunk.offset, chunk.index_end - chunk.offset)

    def batches(
        self,
        channels: Collection[int] | None = None,
        size: int = _TOGETHER,
        spans: Sequence[tuple[int, int]] | None = None,
    ) -> Iterator[Batch]:
        """Yield the messages chunk by chunk, neighbours of up to ``size`` bytes together.

        Chunks without any of ``channels`` (ids, None for all) are not decompressed, nor are those
        that lie between ``spans`` (log times, ns; None for all).

        Raises LogError where the file turns out to be damaged, at the message or a few chunks
        before it; it is then also wrong to use the messages before it.
        """
        chunks = self._contents.chunks
        if channels is not None:
            chunks = [chunk for chunk in chunks if chunk.holds(channels)]
        if spans is not None:
            chunks = [
                chunk
                for chunk in chunks
                if any(chunk.end_time >= begin and chunk.start_time <= end for begin, end in spans)
            ]
        chunks = sorted(chunks, key=lambda c: (c.start_time, c.offset))
        held = _most_held(chunks)
        if held > self._memory // 2:
            raise LogError(
                f"its chunks of one time take {held >> 20} MiB; the limit is half of "
                f"{self._memory / 2**30:g} GiB; `mcap sort` writes them in order of time, and "
                "--memory GIB raises the limit",
                path=self.path,
            )
        groups = list(_together(chunks, size))
        for k, group in enumerate(groups, 1):
            until = groups[k][0].start_time if k < len(groups) else None
            yield Batch([self._chosen(self.load(chunk), channels) for chunk in group], until)

    def runs(self, channels: Collection[int] | None = None) -> Iterator[tuple[Records, list[int]]]:
        """Yield the messages in the order of log times, those of equal time as in the file.

        They come as runs of messages of one chunk: its records, and which of its messages. For
        ``channels`` and errors see :meth:`batches`.
        """
        order = LogOrder[Records]()
        for batch in self.ahead(self.batches(channels, 0)):
            for records in batch.records:
                order.add(records, records.keys)
            yield from order.before(batch.until)

    def messages(self, channels: Collection[int] | None = None) -> Iterator[Message]:
        """Yield the messages one by one, as :meth:`runs` orders them."""
        for records, rows in self.runs(channels):
            yield from records.at(rows)

    def messages_in(self, chunk: Chunk) -> Iterator[Message]:
        """Yield the messages of one chunk by log time."""
        records = self.load(chunk)
        return records.at(np.lexsort(records.keys.T[::-1]).tolist())

    def ahead(self, items: Iterator[T]) -> Iterator[T]:
        """Run an iterator that reads this file in a thread, ahead of the use of its items.

        Its CPU time is added to ``cpu_s``. An error that it raises comes at its turn. Raises
        LogError if somebody wrote to the file meanwhile.
        """
        with ThreadPoolExecutor(1, thread_name_prefix="hiros-read") as pool:
            waiting: deque[Future[T | None]] = deque()
            try:
                while True:
                    while len(waiting) <= self._depth:
                        waiting.append(pool.submit(self._timed, items))
                    item = waiting.popleft().result()
                    if item is None:
                        break
                    yield item
            finally:
                for future in waiting:
                    future.cancel()
        self._file.check_unchanged()

    def _timed(self, items: Iterator[T]) -> T | None:
        """Return the next item, None at the end."""
        start = time.thread_time()
        try:
            return next(items, None)
        finally:
            self.cpu_s += time.thread_time() - start

    def load(self, chunk: Chunk) -> Records:
        """Read, decompress and check one chunk, unless it is in memory; raises LogError."""
        if chunk.offset in self._kept:
            return self._kept[chunk.offset]
        records = self._read_chunk(chunk)
        if self._keeps:
            self._kept[chunk.offset] = records
        return records

    def retime(self, log_times: Mapping[int, LogTimes]) -> None:
        """Hand out the messages of some chunks, by their offset, with other log times from now on.

        The chunks lie at these times then, so that everything that goes by log times does, too.
        """
        chunks = self._contents.chunks
        for i, chunk in enumerate(chunks):
            if chunk.offset in log_times:
                times = _with_times(self.load(chunk), log_times[chunk.offset]).messages[:, LOG_TIME]
                ends = int(times.min()), int(times.max())
                chunks[i] = replace(chunk, start_time=ends[0], end_time=ends[1], retimed=True)
        self._retimed, self._kept = log_times, {}

    def _read_chunk(self, chunk: Chunk) -> Records:
        try:
            data, messages, definitions = read_chunk(self._file, chunk)
            defined = self._define(data, definitions)
            records = Records(data, self._accepted(chunk, messages), chunk.offset)
            in_cdr = [i for i, c in self.channels.items() if c.message_encoding == "cdr"]
            if packed := records.packed(in_cdr):
                records = records.unpacked(packed)
                self._packed.add(chunk.offset)
                self.remarks = tuple(dict.fromkeys((*self.remarks, PACKED_MESSAGES)))
        except (FormatError, struct.error, ValueError, OverflowError) as fault:
            where_from = "messages" if chunk.loose else "chunk"
            raise LogError(
                f"damaged {where_from} at byte {chunk.offset}: {fault}; {remedy(self.path)}",
                path=self.path,
            ) from None
        except MemoryError:
            raise LogError("is too large for the memory", path=self.path) from None
        self._checked[chunk.offset] = defined
        return _with_times(records, self._retimed[chunk.offset]) if chunk.retimed else records

    def _chosen(self, records: Records, channels: Collection[int] | None) -> Records:
        if channels is None:
            return records
        chosen = np.isin(records.messages[:, CHANNEL], list(channels))
        return records.only(chosen, least=_TOGETHER)

    def definitions_in(self, chunk: Chunk) -> frozenset[int]:
        """Channels that the chunk defines; the chunk is checked for that if it was not yet."""
        if chunk.offset not in self._checked:
            self.load(chunk)
        return self._checked[chunk.offset]

    def has_packed_messages(self, chunk: Chunk) -> bool:
        """Whether messages of a chunk are compressed one by one, so that it is not copied as it is.

        It is known of chunks that were read.
        """
        return chunk.offset in self._packed

    def _define(self, data: Bytes, definitions: Table) -> frozenset[int]:
        defined = set()
        for opcode, start, stop in definitions.tolist():
            ident = self._contents.define(opcode, memoryview(data)[start:stop])
            if opcode == 4:
                defined.add(ident)
        return frozenset(defined)

    def _accepted(self, chunk: Chunk, table: Table) -> Table:
        """Return the messages if they are what the chunk record and its indexes claim of them."""
        if not len(table):
            counts: dict[int, int] = {}
        else:
            times = table[:, LOG_TIME]
            outside = times.min() < chunk.start_time or times.max() > chunk.end_time
            if outside and not chunk.retimed:
                raise FormatError("a message lies outside of the times that the chunk claims")
            numbers = np.bincount(table[:, CHANNEL].astype(np.intp))
            counts = {i: n for i, n in enumerate(numbers.tolist()) if n}
        claimed = {i: n for i, n in (chunk.counts or {}).items() if n}
        if chunk.counts is not None and counts != claimed:
            raise FormatError("the messages do not match the message indexes")
        if unknown := [i for i in counts if i not in self._contents.channels]:
            raise FormatError(f"a message belongs to channel {unknown[0]}, which is not defined")
        return table

    def _complete_definitions(self) -> None:
        """Look into chunks for the definitions and counts that the walk could not see."""
        chunks, channels = self._contents.chunks, self._contents.channels
        schemas = self._contents.schemas
        complete = all(i in channels for chunk in chunks for i in chunk.counts or ())
        # The summary may repeat the channels and not their schemas.
        complete &= all(c.schema_id in schemas for c in channels.values() if c.schema_id)
        unseen = [i for i, c in enumerate(chunks) if c.counts is None or not complete]
        used = (self.load(chunks[i]).messages[:, CHANNEL] for i in unseen)
        for i, numbers in zip(unseen, self.ahead(used), strict=True):
            chunks[i] = replace(chunks[i], counts=dict(Counter(numbers.tolist())))
        for channel in channels.values():
            if channel.schema_id and channel.schema_id not in schemas:
                raise LogError(
                    f"has no schema {channel.schema_id}", path=self.path, topic=channel.topic
                )

    def _count(self) -> dict[int, int]:
        """Messages per channel; every chunk is compared with this when it is read."""
        counts = Counter(dict.fromkeys(self._contents.channels, 0))
        for chunk in self._contents.chunks:
            counts.update(chunk.counts or {})
        stats, total = self._contents.statistics, sum(counts.values())
        if stats is not None and stats.message_count != total:
            raise LogError(
                f"damaged: the statistics claim {stats.message_count} messages, there are {total}; "
                f"{remedy(self.path)}",
                path=self.path,
            )
        return dict(counts)


def _with_times(records: Records, log_times: LogTimes) -> Records:
    """Return records with other log times of some messages."""
    messages = records.messages.copy()
    messages[log_times[0], LOG_TIME] = log_times[1]
    return records._replace(messages=messages)


def _most_held(chunks: Sequence[Chunk]) -> int:
    """Bytes of the chunks that overlap at one time, at most; they are sorted by their start."""
    held: list[tuple[int, int]] = []  # end time and size
    size = most = 0
    for chunk in chunks:
        while held and held[0][0] < chunk.start_time:
            size -= heapq.heappop(held)[1]
        heapq.heappush(held, (chunk.end_time, chunk.size))
        size += chunk.size
        most = max(most, size)
    return most


def _together(chunks: Iterable[Chunk], most: int) -> Iterator[list[Chunk]]:
    """Group neighbours of up to ``most`` bytes; a larger chunk is alone."""
    group: list[Chunk] = []
    size = 0
    for chunk in chunks:
        if group and size + chunk.size > most:
            yield group
            group, size = [], 0
        group.append(chunk)
        size += chunk.size
    if group:
        yield group
