"""Where live records come from: the bytes of an MCAP that is still being written."""

from __future__ import annotations

import hashlib
import os
import select
import struct
import time
from collections.abc import Callable, Iterator
from typing import Protocol

from hiros_mcap.errors import LogError
from hiros_mcap.io.container.records import McapRecord

_PATIENCE = 0.1  # s: how soon a request to stop is heard
_PAUSE = 0.01  # s between looks at a file that does not grow
_BLOCK = 1 << 18
_LARGEST_RECORD = 1 << 30


class LiveInput(Protocol):
    """Records that are still being written.

    Attributes
    ----------
    name : what errors and summaries call it.
    before_waiting : is called before more is awaited.
    is_cut : whether it ended without its end mark.
    """

    name: str
    before_waiting: Callable[[], None]
    is_cut: bool

    def records(self) -> Iterator[McapRecord]:
        """Yield definitions, messages and metadata in their order; raises LogError for damage."""

    def stop(self) -> None:
        """End the input here; a signal handler may call it."""

    def digest(self) -> str:
        """SHA-256 of all bytes so far, in hexadecimal; "" if there are none to be had again."""


class McapInput:
    """The bytes of an MCAP: a :class:`LiveInput`.

    Parameters
    ----------
    descriptor : of a pipe or an open file. name : what errors and summaries call it.
    follow : wait at the end of a file for more.
    """

    def __init__(self, descriptor: int, name: str, *, follow: bool = False) -> None:
        self.name = name
        self.is_cut = False
        self.before_waiting: Callable[[], None] = lambda: None
        self._descriptor = descriptor
        self._follow = follow
        self._stopped = False
        self._digest = hashlib.sha256()
        self._buffer = bytearray()

    def stop(self) -> None:
        """End the input here; a signal handler may call it."""
        self._stopped = True

    def digest(self) -> str:
        """SHA-256 of all bytes so far, in hexadecimal."""
        return self._digest.hexdigest()

    def records(self) -> Iterator[McapRecord]:
        """Yield the records as soon as they are complete, those of a chunk when the chunk is.

        Raises LogError for damage. A record that the end cuts off is left out.
        """
        from mcap.exceptions import EndOfFile, InvalidMagic, McapError
        from mcap.stream_reader import StreamReader
        from zstandard import ZstdError

        reader = StreamReader(
            self,  # type: ignore[arg-type]  # it needs no more than read()
            validate_crcs=True,
            record_size_limit=_LARGEST_RECORD,
        )
        begun = False
        try:
            for record in reader.records:
                begun = True
                yield record
        except EndOfFile:
            if not begun:
                raise LogError("is empty or not MCAP", path=self.name) from None
            self.is_cut = not self._stopped
        except (InvalidMagic, struct.error):
            raise LogError(
                "is not MCAP; live input takes nothing else: name a bag as a file", path=self.name
            ) from None
        except (McapError, ZstdError, ValueError, RuntimeError, MemoryError) as error:
            raise LogError(
                f"damaged: {error}; save the input as a file and use --recover",
                path=self.name,
            ) from None

    def read(self, size: int) -> bytes:
        """Wait for as many bytes; nothing if the input ends before. Raises LogError."""
        while len(self._buffer) < size:
            self.before_waiting()
            try:
                data = self._wait()
            except OSError as error:
                raise LogError(f"cannot be read: {error.strerror}", path=self.name) from None
            if not data:
                return b""
            self._digest.update(data)
            self._buffer += data
        taken = bytes(self._buffer[:size])
        del self._buffer[:size]
        return taken

    def _wait(self) -> bytes:
        while not self._stopped:
            if self._follow:
                if data := os.read(self._descriptor, _BLOCK):
                    return data
                time.sleep(_PAUSE)
            elif select.select([self._descriptor], [], [], _PATIENCE)[0]:
                return os.read(self._descriptor, _BLOCK)
        return b""
