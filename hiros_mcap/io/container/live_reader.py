"""Messages of an MCAP that is still being written: a pipe, or a file that grows.

The reader first listens for a while and keeps what comes, for whoever opens the log. From then on
it hands out every message as soon as it is complete; one in a chunk when the chunk is complete.
What came while a run was busy is handed out together, which takes half of the time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from time import perf_counter, thread_time
from typing import TypeVar

import numpy as np

from hiros_mcap.errors import LogError
from hiros_mcap.io.container.file import is_packed, unpack_message
from hiros_mcap.io.container.live_input import LiveInput
from hiros_mcap.io.container.reader import PACKED_MESSAGES, Batch, LogOrder, McapReader, Records
from hiros_mcap.io.container.records import Channel, FormatError, McapRecord, Message, Schema
from hiros_mcap.io.container.walk import Contents
from hiros_mcap.kernels.record_index import COLUMNS

T = TypeVar("T")
Arriving = Iterator[Message | None]
"""Messages, and None before more is awaited."""
_IDLE_S = 0.001  # s: who waits longer for a message had dealt with all before
_TOGETHER = 32  # messages that are handed out together at most: results wait for all of them


class LiveReader(McapReader):
    """The reader of an MCAP that is still being written.

    Attributes
    ----------
    preface : the messages that came while the reader listened.
    forgotten : messages of the preface that were too many to keep.
    listeners : are called with every message behind the preface, before it is handed out.
    done : is called when what was handed out is dealt with.
    span : log times, ns, of the first message and of the latest, of the channels handed out.
    hidden : channels whose messages become those of other channels.
    fault : why nothing more is read though the input goes on; "" while it is read.
    steps : what messages go through as they come, one after the other: each turns the messages of
        the one before into others. None between them says that more is awaited.
    """

    def __init__(self, source: LiveInput) -> None:
        self.path = source.name
        self.source = source
        self.cpu_s = 0.0
        self.waited_s = 0.0
        self.counts: Counter[int] = Counter()
        self.preface: list[Message] = []
        self.forgotten = 0
        self.listeners: list[Callable[[Message], None]] = []
        self.done: Callable[[], None] = lambda: None
        self.span = (0, 0)
        self.hidden: set[int] = set()
        self.fault = ""
        self.steps: Sequence[Callable[[Arriving], Arriving]] = ()
        self._contents = Contents()
        self._messages = self._read(source)

    @property
    def channels(self) -> dict[int, Channel]:
        """The channels that are not hidden, by their numbers."""
        channels = self._contents.channels
        return (
            {i: c for i, c in channels.items() if i not in self.hidden} if self.hidden else channels
        )

    def close(self) -> None:
        """Do nothing: the input belongs to the caller."""

    def listening(self, most: int, keep: Callable[[str], bool]) -> Iterator[Message]:
        """Yield the messages as they come, and keep them in the preface.

        Of more than ``most`` messages the first are forgotten, but for topics to ``keep``.
        """
        for message in filter(None, self._messages):
            self.preface.append(message)
            yield message
            if len(self.preface) > most:
                old, recent = self.preface[: most // 2], self.preface[most // 2 :]
                kept = [m for m in old if keep(self.channels[m.channel_id].topic)]
                self.forgotten += len(old) - len(kept)
                self.preface = kept + recent

    def batches(
        self,
        channels: Collection[int] | None = None,
        size: int = 0,
        spans: Sequence[tuple[int, int]] | None = None,
    ) -> Iterator[Batch]:
        """Yield the preface, and then every message as soon as it is there.

        ``channels`` may grow meanwhile. Raises LogError where the input is damaged.
        """
        yield self._batch(self._heard(channels))
        for messages in self._together():
            if chosen := [m for m in messages if channels is None or m.channel_id in channels]:
                yield self._batch(chosen)
            self.done()
        yield Batch([_records([])], None)

    def _together(self) -> Iterator[list[Message]]:
        """Yield the messages that are there at once; what comes before damage, too."""
        messages: list[Message] = []
        try:
            for message in self._messages:
                if message is not None:
                    for listener in self.listeners:
                        listener(message)
                    messages.append(message)
                if message is None or len(messages) == _TOGETHER:
                    yield messages
                    messages = []
        except LogError:
            yield messages
            raise
        yield messages

    def _heard(self, channels: Collection[int] | None) -> list[Message]:
        return [m for m in self.preface if channels is None or m.channel_id in channels]

    def _batch(self, messages: list[Message]) -> Batch:
        """Return messages that nothing earlier is waited for."""
        times = [m.log_time for m in messages]
        if times:
            self.span = self.span[0] or min(times), max(*times, self.span[1])
        return Batch([_records(messages)], max(times, default=0) + 1)

    def runs(self, channels: Collection[int] | None = None) -> Iterator[tuple[Records, list[int]]]:
        """Yield the preface in the order of log times."""
        order = LogOrder[Records]()
        records = _records(self._heard(channels))
        order.add(records, records.keys)
        yield from order.before(None)

    def ahead(self, items: Iterator[T]) -> Iterator[T]:
        """Return the items: nothing can be read before it is there."""
        return items

    def _read(self, source: LiveInput) -> Arriving:
        """Yield the messages as they are to be used, and None before more is awaited."""
        messages = self._arriving(source)
        for step in self.steps:
            messages = step(messages)
        awaits, waited = True, -1.0
        for message in messages:
            if message and awaits and self.waited_s - waited > _IDLE_S:
                self.prompt = perf_counter(), message.log_time
            awaits, waited = message is None, self.waited_s
            yield message

    def _arriving(self, source: LiveInput) -> Arriving:
        """Yield the messages, and None before more is awaited; note everything else."""
        for record in self._awaited(source.records()):
            if record is None:
                yield None
                continue
            if not isinstance(record, Message):
                self._note(record)
                continue
            if record.channel_id not in self._contents.channels:
                fault = f"damaged: a message belongs to channel {record.channel_id}, not defined"
                raise LogError(fault, path=self.path)
            self.counts[record.channel_id] += 1
            yield self._unpacked(record)

    def _awaited(self, records: Iterator[McapRecord | None]) -> Iterator[McapRecord | None]:
        """Yield the records; add up the time in which there was nothing to do but wait."""
        while True:
            began, worked = perf_counter(), thread_time()
            try:
                record = next(records)
            except StopIteration:
                return
            finally:
                self.waited_s += perf_counter() - began - (thread_time() - worked)
            yield record

    def end(self, fault: str) -> None:
        """Read no further, for a reason."""
        self.fault = fault
        self.source.stop()

    def hide(self, ident: int) -> None:
        """Forget a channel whose messages become those of another one, also in the preface."""
        if ident not in self.hidden:
            self.hidden.add(ident)
            self.preface = [m for m in self.preface if m.channel_id != ident]

    def _unpacked(self, message: Message) -> Message:
        """Return a message as it was before rosbag2 compressed it; raises LogError for damage."""
        channel = self._contents.channels[message.channel_id]
        if channel.message_encoding != "cdr" or not is_packed(message.data):
            return message
        self.remarks = (PACKED_MESSAGES,)
        try:
            return replace(message, data=unpack_message(message.data))
        except FormatError as error:
            raise LogError(f"damaged: {error}", path=self.path, topic=channel.topic) from None

    def define(self, *records: Channel | Schema) -> None:
        """Take definitions of what messages become."""
        for record in records:
            self._note(record)

    def _note(self, record: object) -> None:
        from mcap.records import Header, Metadata

        match record:
            case Channel():
                self._contents.channels.setdefault(record.id, record)
            case Schema():
                self._contents.schemas.setdefault(record.id, record)
            case Metadata():
                self._contents.metadata.append((record.name, dict(record.metadata)))
            case Header():
                self._contents.profile = record.profile
                self._contents.library = record.library


def _records(messages: list[Message]) -> Records:
    """Return messages as if they were those of a chunk."""
    table = np.empty((len(messages), COLUMNS), np.uint64)
    at = 0
    for row, m in zip(table, messages, strict=True):
        end = at + len(m.data)
        row[:] = m.channel_id, m.sequence, m.log_time, m.publish_time, at, end
        at = end
    return Records(b"".join(m.data for m in messages), table, 0)
