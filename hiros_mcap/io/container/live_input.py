"""Where live records come from: the bytes of an MCAP that is still being written."""

from __future__ import annotations

import hashlib
import os
import select
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from hiros_mcap.errors import LogError
from hiros_mcap.io.container.file import unpack_chunk
from hiros_mcap.io.container.records import (
    HEAD,
    MAX_CHUNK,
    Channel,
    Cursor,
    FormatError,
    McapRecord,
    Message,
    Opcode,
    Schema,
)

if TYPE_CHECKING:
    from mcap.records import Chunk

_PATIENCE = 0.1  # s: how soon a request to stop is heard
_PAUSE = 0.01  # s between looks at a file that does not grow
_BLOCK = 1 << 18
_LARGEST_RECORD = MAX_CHUNK + (1 << 16)  # Bytes: a chunk without compression, and its head
_AFTERWARDS_S = 1.0
"""How long to look for more behind the end mark; a writer that stops later is not waited for."""


class LiveInput(ABC):
    """Records that are still being written.

    Attributes
    ----------
    name : what errors and summaries call it.
    fault : what was odd about it, "" if nothing was.
    """

    def __init__(self, name: str) -> None:
        self.name, self.fault = name, ""
        self._stopped = False

    @abstractmethod
    def records(self) -> Iterator[McapRecord | None]:
        """Yield definitions, messages and metadata in their order, and None before it waits.

        Raises LogError for damage.
        """

    def stop(self) -> None:
        """End the input here; a signal handler may call it."""
        self._stopped = True

    def close(self) -> None:  # noqa: B027 - most inputs hold nothing
        """Let go of what was opened for the input; nothing is read afterwards."""

    def digest(self) -> str:
        """SHA-256 of all bytes so far, in hexadecimal; "" if what came cannot be had again."""
        return ""


class McapInput(LiveInput):
    """The bytes of an MCAP.

    Parameters
    ----------
    descriptor : of a pipe or an open file, which belongs to the caller. name : of the input.
    follow : wait at the end of a file for more.
    """

    def __init__(self, descriptor: int, name: str, *, follow: bool = False) -> None:
        super().__init__(name)
        self._descriptor = descriptor
        self._follow = follow
        self._digest = hashlib.sha256()
        self._buffer = bytearray()

    def digest(self) -> str:
        """SHA-256 of all bytes so far, in hexadecimal."""
        return self._digest.hexdigest()

    def records(self) -> Iterator[McapRecord | None]:
        """Yield the records as soon as they are complete, those of a chunk when the chunk is.

        None means that no other one is complete. Raises LogError for damage. A record that the end
        cuts off is left out.
        """
        from mcap.exceptions import EndOfFile, InvalidMagic, McapError
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader

        reader = StreamReader(
            self,  # type: ignore[arg-type]  # it needs no more than read()
            emit_chunks=True,
            validate_crcs=True,
            record_size_limit=_LARGEST_RECORD,
        )
        begun = False
        try:
            for record in reader.records:
                begun = True
                if isinstance(record, Chunk):
                    yield from _unpacked(record)
                else:
                    yield record
                if not self._has_record():
                    yield None
            if self._goes_on():
                self.fault = (
                    "the input goes on behind its end mark, perhaps with another recording; that "
                    "was not read: process recordings one by one"
                )
        except EndOfFile:
            if not begun:
                raise LogError("is empty or not MCAP", path=self.name) from None
            if not (self._stopped or self.fault):
                self.fault = (
                    "the input ended without its end mark; if its writer was not stopped on "
                    "purpose, look for the fault there"
                )
        except (InvalidMagic, struct.error):
            raise LogError(
                "is not MCAP; live input takes nothing else: name a bag as a file", path=self.name
            ) from None
        except (McapError, FormatError, ValueError, MemoryError) as error:
            raise LogError(
                f"damaged: {error}; save the input as a file and use --recover",
                path=self.name,
            ) from None

    def _goes_on(self) -> bool:
        """Whether anything comes behind the end mark; a file that grows is not waited for."""
        if self._buffer or self._follow or self._stopped:
            return bool(self._buffer)
        ready = select.select([self._descriptor], [], [], _AFTERWARDS_S)[0]
        return bool(ready and os.read(self._descriptor, 1))

    def read(self, size: int) -> bytes:
        """Wait for as many bytes; nothing if the input ends before.

        Raises LogError, and FormatError where a length is none.
        """
        if not 0 <= size <= _LARGEST_RECORD:
            raise FormatError(f"a field claims {size} bytes; the limit is {_LARGEST_RECORD}")
        while len(self._buffer) < size:
            if not self._fetch(_PATIENCE):
                return b""
        taken = bytes(self._buffer[:size])
        del self._buffer[:size]
        return taken

    def _has_record(self) -> bool:
        """Whether a whole record has arrived."""
        return self._holds_record() or (self._fetch(0.0) and self._holds_record())

    def _holds_record(self) -> bool:
        if len(self._buffer) < HEAD.size:
            return False
        size: int = HEAD.unpack_from(self._buffer)[1]
        return len(self._buffer) >= HEAD.size + size

    def _fetch(self, patience: float) -> bool:
        """Take what has arrived, or arrives within some time, s; return whether more may come."""
        if self._stopped:
            return False
        try:
            data = self._arrived(patience)
        except OSError as error:
            raise LogError(f"cannot be read: {error.strerror}", path=self.name) from None
        if data:
            self._digest.update(data)
            self._buffer += data
        return data != b""

    def _arrived(self, patience: float) -> bytes | None:
        """Return what there is to read, nothing at the end; None if nothing came in time."""
        if not self._follow:
            ready = select.select([self._descriptor], [], [], patience)[0]
            return os.read(self._descriptor, _BLOCK) if ready else None
        if data := os.read(self._descriptor, _BLOCK):
            return data
        if self._is_replaced():
            self.fault = (
                "the file was cut short or replaced by another while it was followed; what "
                "came before was used: follow the new file in another run"
            )
            return b""
        time.sleep(min(patience, _PAUSE))
        return None

    def _is_replaced(self) -> bool:
        """Whether nothing more can come: the file is shorter, or its name is another file's."""
        state = os.fstat(self._descriptor)
        if state.st_size < os.lseek(self._descriptor, 0, os.SEEK_CUR):
            return True
        try:
            named = Path(self.name).stat()
        except OSError:  # it was removed; whoever writes may go on
            return False
        return not os.path.samestat(state, named)


def _unpacked(chunk: Chunk) -> Iterator[McapRecord]:
    """Yield the records of a chunk, its definitions first; raises FormatError."""
    data, messages, definitions = unpack_chunk(
        chunk.data, chunk.compression, chunk.uncompressed_size, chunk.uncompressed_crc
    )
    for opcode, start, stop in definitions.tolist():
        yield (Schema if opcode == Opcode.SCHEMA else Channel).read(Cursor(data[start:stop]))
    for channel, sequence, log_time, publish_time, start, stop in messages.tolist():
        yield Message(channel, log_time, bytes(data[start:stop]), publish_time, sequence)
