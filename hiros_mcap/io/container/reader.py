"""Messages of an MCAP file in the order of their log times; a damaged file is an error.

What the reader promises: every message of the chosen channels is handed out exactly once with
exactly its bytes, or a LogError says what is wrong and where. Checksums are always compared,
nothing is taken from an index that the data contradict, and memory is bounded by the chunks that
overlap in time.
"""

from __future__ import annotations

import itertools
import os
import struct
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np
import numpy.typing as npt
from isal.isal_zlib import crc32

from hiros_mcap.errors import LogError
from hiros_mcap.io.container.compression import decompress
from hiros_mcap.io.container.file import LogFile
from hiros_mcap.io.container.records import (
    Attachment,
    Bytes,
    Channel,
    Chunk,
    FormatError,
    Message,
    Schema,
)
from hiros_mcap.io.container.scan import Contents, scan
from hiros_mcap.kernels.record_index import (
    CHANNEL,
    FORBIDDEN,
    LOG_TIME,
    OK,
    PAST_END,
    PUBLISH_TIME,
    SEQUENCE,
    SHORT_MESSAGE,
    START,
    STOP,
    index_records,
)

_AHEAD = 2
_AHEAD_BYTES = 64 * 2**20
_TOGETHER = 4 * 2**20
"""Bytes of chunks that are digested at once; each call of a digest costs as much as some messages.
Recorders' chunks are of 0.75 to 4 MiB."""
_FAULTS = {
    PAST_END: "a record reaches past the end of the chunk",
    SHORT_MESSAGE: "a message is shorter than its fixed fields",
    FORBIDDEN: "a record that has no place in a chunk",
}
Table = npt.NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class Records:
    """The records of one chunk, decompressed and checked."""

    chunk: Chunk
    data: Bytes
    messages: Table
    """One row per message in order of log time, columns as in kernels.records."""
    defined: frozenset[int]
    """Channels that the chunk itself defines."""
    notes: Sequence[Any] = ()
    """One per message, or none at all."""


class McapReader:
    """An open MCAP file; use it as a context manager.

    Opening walks the whole file (see scan) and raises LogError for a damaged or truncated one.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._file = LogFile(path)
        self.path = self._file.path
        self.cpu_s = 0.0
        """CPU time, s, that handing out messages has taken in the thread that reads ahead."""
        try:
            self._contents = scan(self._file)
            self._checked: dict[int, frozenset[int]] = {}
            self._complete_definitions()
            self.counts = self._count()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def contents(self) -> Contents:
        """What the walk found: header, definitions, chunks, metadata, statistics."""
        return self._contents

    @property
    def channels(self) -> dict[int, Channel]:
        """Channels by id, also those without a message."""
        return self._contents.channels

    def schema(self, channel: Channel) -> Schema | None:
        """Message definition of a channel, None if it has none."""
        return self._contents.schemas.get(channel.schema_id)

    def attachment(self, attachment: Attachment) -> bytes:
        """Bytes of an attachment, which the walk has checked."""
        return self._file.read(attachment.data_offset, attachment.data_size)

    def raw(self, chunk: Chunk) -> bytes:
        """Chunk record and its message index records as they are in the file."""
        return self._file.read(chunk.offset, chunk.index_end - chunk.offset)

    def messages(
        self,
        channels: Collection[int] | None = None,
        digest: Callable[[Sequence[Records]], Sequence[Sequence[Any]]] | None = None,
    ) -> Iterator[Message]:
        """Messages by log time; those of equal time in the order of the file.

        Parameters
        ----------
        channels : ids to read, None for all. Chunks without any of them are not decompressed.
        digest : is called in the thread that reads ahead, with the chosen messages of some chunks,
            and returns a note for each of them.

        Raises
        ------
        LogError
            where the file turns out to be damaged, at the message or a few chunks before it; it is
            then also wrong to use the messages before it.
        """
        wanted = self._wanted(channels)
        chosen = None if channels is None else np.isin(np.arange(65536), list(channels))

        def load(chunk: Chunk) -> Records:
            loaded = self.load(chunk)
            if chosen is None:
                return loaded
            return replace(loaded, messages=loaded.messages[chosen[loaded.messages[:, CHANNEL]]])

        def load_all(chunks: Sequence[Chunk]) -> list[Records]:
            start = time.thread_time()
            loaded = [load(chunk) for chunk in chunks]
            if digest is not None:
                notes = digest(loaded)
                loaded = [replace(c, notes=said) for c, said in zip(loaded, notes, strict=True)]
            self.cpu_s += time.thread_time() - start
            return loaded

        pending: list[Records] = []
        together = _together(wanted) if digest else ([chunk] for chunk in wanted)
        everything = itertools.chain.from_iterable(read_ahead(load_all, together))
        for at, loaded in enumerate(everything):
            pending.append(loaded)
            horizon = wanted[at + 1].start_time if at + 1 < len(wanted) else None
            ready, pending = _split(pending, horizon)
            yield from _merged(ready)
        self._file.check_unchanged()

    def messages_in(self, chunk: Chunk) -> Iterator[Message]:
        """Messages of one chunk by log time."""
        return _merged([self.load(chunk)])

    def load(self, chunk: Chunk) -> Records:
        """Read, decompress and check one chunk; raises LogError."""
        try:
            data = self._plain(chunk)
            status, where, table, definitions = index_records(np.frombuffer(data, np.uint8))
            if status != OK:
                raise FormatError(f"{_FAULTS[int(status)]} (byte {where} in the chunk)")
            defined = self._define(data, definitions)
            self._check_messages(chunk, table)
        except (FormatError, struct.error, ValueError, OverflowError) as fault:
            where_from = "messages" if chunk.loose else "chunk"
            raise LogError(
                f"damaged {where_from} at byte {chunk.offset}: {fault}", path=self.path
            ) from None
        except MemoryError:
            raise LogError("is too large for the memory", path=self.path) from None
        self._checked[chunk.offset] = defined
        return Records(chunk, data, _by_time(table), defined)

    def definitions_in(self, chunk: Chunk) -> frozenset[int]:
        """Channels that the chunk defines; the chunk is checked for that if it was not yet."""
        if chunk.offset not in self._checked:
            self.load(chunk)
        return self._checked[chunk.offset]

    def _plain(self, chunk: Chunk) -> Bytes:
        packed = self._file.read(chunk.data_offset, chunk.data_size)
        data = decompress(packed, chunk.compression, chunk.size)
        if chunk.crc and crc32(data) != chunk.crc:
            raise FormatError("the checksum is wrong")
        return data

    def _define(self, data: Bytes, definitions: Table) -> frozenset[int]:
        defined = set()
        for opcode, start, stop in definitions.tolist():
            ident = self._contents.define(opcode, memoryview(data)[start:stop])
            if opcode == 4:
                defined.add(ident)
        return frozenset(defined)

    def _check_messages(self, chunk: Chunk, table: Table) -> None:
        """Compare the messages with what the chunk record and its indexes claim of them."""
        if not len(table):
            found: dict[int, int] = {}
        else:
            times = table[:, LOG_TIME]
            if times.min() < chunk.start_time or times.max() > chunk.end_time:
                raise FormatError("a message lies outside of the times that the chunk claims")
            numbers = np.bincount(table[:, CHANNEL].astype(np.intp))
            found = {i: n for i, n in enumerate(numbers.tolist()) if n}
        claimed = {i: n for i, n in (chunk.counts or {}).items() if n}
        if chunk.counts is not None and found != claimed:
            raise FormatError("the messages are not those of the message indexes")
        if unknown := [i for i in found if i not in self._contents.channels]:
            raise FormatError(f"a message belongs to channel {unknown[0]}, which is not defined")

    def _wanted(self, channels: Collection[int] | None) -> list[Chunk]:
        chunks = self._contents.chunks
        if channels is not None:
            chunks = [chunk for chunk in chunks if chunk.holds(channels)]
        return sorted(chunks, key=lambda chunk: (chunk.start_time, chunk.offset))

    def _complete_definitions(self) -> None:
        """Look into chunks for the definitions and counts that the walk could not see."""
        chunks, channels = self._contents.chunks, self._contents.channels
        schemas = self._contents.schemas
        known = all(i in channels for chunk in chunks for i in chunk.counts or ())
        # The summary may repeat the channels and not their schemas.
        known &= all(c.schema_id in schemas for c in channels.values() if c.schema_id)
        unseen = [i for i, c in enumerate(chunks) if c.counts is None or not known]
        loaded = read_ahead(self._load_quietly, ([chunks[i]] for i in unseen))
        for i, records in zip(unseen, loaded, strict=True):
            counts = Counter(records.messages[:, CHANNEL].tolist())
            chunks[i] = replace(chunks[i], counts=dict(counts))
        for channel in channels.values():
            if channel.schema_id and channel.schema_id not in schemas:
                raise LogError(
                    f"has no schema {channel.schema_id}", path=self.path, topic=channel.topic
                )

    def _load_quietly(self, chunks: Sequence[Chunk]) -> Records:
        """Load a chunk without keeping its bytes."""
        (chunk,) = chunks
        return replace(self.load(chunk), data=b"")

    def _count(self) -> dict[int, int]:
        """Messages per channel; every chunk is compared with this when it is read."""
        counts = Counter(dict.fromkeys(self._contents.channels, 0))
        for chunk in self._contents.chunks:
            counts.update(chunk.counts or {})
        stats, total = self._contents.statistics, sum(counts.values())
        if stats is not None and stats.messages != total:
            raise LogError(
                f"damaged: the statistics claim {stats.messages} messages, there are {total}",
                path=self.path,
            )
        return dict(counts)


T = TypeVar("T")


def read_ahead(
    load: Callable[[Sequence[Chunk]], T], groups: Iterable[Sequence[Chunk]]
) -> Iterator[T]:
    """Load groups of chunks in a thread, ahead of their use; an error comes at its group's turn."""
    with ThreadPoolExecutor(1, thread_name_prefix="hiros-read") as pool:
        waiting: deque[tuple[int, Future[T]]] = deque()
        try:
            for chunks in groups:
                size = sum(chunk.size for chunk in chunks)
                waiting.append((size, pool.submit(load, chunks)))
                while len(waiting) > _AHEAD or sum(n for n, _ in waiting) > _AHEAD_BYTES:
                    yield waiting.popleft()[1].result()
            while waiting:
                yield waiting.popleft()[1].result()
        finally:
            for _, future in waiting:
                future.cancel()


def _together(chunks: Iterable[Chunk]) -> Iterator[list[Chunk]]:
    """Group neighbours."""
    group: list[Chunk] = []
    size = 0
    for chunk in chunks:
        if group and size + chunk.size > _TOGETHER:
            yield group
            group, size = [], 0
        group.append(chunk)
        size += chunk.size
    if group:
        yield group


def _by_time(table: Table) -> Table:
    """Rows in order of log time, those of equal time as they are in the chunk."""
    times = table[:, LOG_TIME]
    if np.all(times[1:] >= times[:-1]):
        return table
    return table[np.argsort(times, kind="stable")]


def _split(pending: list[Records], horizon: int | None) -> tuple[list[Records], list[Records]]:
    """Split into what can be handed out and what may be preceded by a chunk still to come.

    A message at the horizon itself waits: the chunk that starts there may lie earlier in the file.
    """
    if horizon is None:
        return pending, []
    ready, later = [], []
    for records in pending:
        cut = int(np.searchsorted(records.messages[:, LOG_TIME], np.uint64(horizon), "left"))
        if cut:
            ready.append(
                replace(records, messages=records.messages[:cut], notes=records.notes[:cut])
            )
        if cut < len(records.messages):
            later.append(
                replace(records, messages=records.messages[cut:], notes=records.notes[cut:])
            )
    return ready, later


def _merged(ready: list[Records]) -> Iterator[Message]:
    """Messages of several chunks by (log time, place in the file)."""
    if not ready:
        return
    ready = sorted(ready, key=lambda records: records.chunk.offset)
    views = [memoryview(records.data) for records in ready]
    table = np.concatenate([records.messages for records in ready])
    notes = [note for records in ready for note in records.notes] or [None] * len(table)
    owner = np.repeat(np.arange(len(ready)), [len(records.messages) for records in ready])
    if len(ready) > 1:
        # Parts are in file order and each is stably sorted, so a stable sort by time is enough.
        order = np.argsort(table[:, LOG_TIME], kind="stable")
        table, owner = table[order], owner[order]
        notes = [notes[k] for k in order.tolist()]
    columns = (table[:, k].tolist() for k in (CHANNEL, LOG_TIME, START, STOP))
    rest = (table[:, k].tolist() for k in (PUBLISH_TIME, SEQUENCE))
    for part, channel, logged, start, stop, publish, sequence, note in zip(
        owner.tolist(), *columns, *rest, notes, strict=True
    ):
        yield Message(channel, logged, views[part][start:stop], publish, sequence, note)
