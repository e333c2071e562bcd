"""Where live records go that are sent message by message: a server, or a graph."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator

from hiros_mcap.io.container.file import Sink
from hiros_mcap.io.container.records import (
    HEAD,
    MAGIC,
    MESSAGE_HEAD,
    Bytes,
    Channel,
    Cursor,
    Opcode,
    Schema,
)


class MessageSink(Sink):
    """Takes the records of an MCAP apart.

    Attributes
    ----------
    results_only : whether it gets the results and a summary of them, without the input.
    """

    results_only = False

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._schemas: dict[int, Schema] = {}
        self._known: set[int] = set()

    @abstractmethod
    def _open(self, channel: Channel, schema: Schema | None) -> None:
        """Get ready for the messages of a channel."""

    @abstractmethod
    def _send(self, ident: int, log_time: int, data: bytes) -> None:
        """Send a message of a channel; its time in ns."""

    def _put(self, parts: Iterable[Bytes]) -> None:
        """Send what is in whole records."""
        for opcode, content in _records(b"".join(parts)):
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(Cursor(content))
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(Cursor(content))
                if channel.id not in self._known:
                    self._known.add(channel.id)
                    self._open(channel, self._schemas.get(channel.schema_id))
            elif opcode == Opcode.MESSAGE:
                ident, _, log_time, _ = MESSAGE_HEAD.unpack_from(content)
                self._send(ident, log_time, bytes(content[MESSAGE_HEAD.size :]))


def _records(data: bytes) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and content of the records in some bytes, which may begin with the mark."""
    at, view = len(MAGIC) if data.startswith(MAGIC) else 0, memoryview(data)
    while at + HEAD.size <= len(data):
        opcode, size = HEAD.unpack_from(data, at)
        at += HEAD.size
        yield opcode, view[at : at + size]
        at += size
