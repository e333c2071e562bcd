"""An MCAP in memory: what a recording of another format becomes, for everybody who reads files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from hiros_mcap.io.container.atomic import Sink
from hiros_mcap.io.container.file import LogFile
from hiros_mcap.io.container.records import Bytes


class MemoryFile(LogFile):
    """The bytes of a log that are in memory.

    Parameters
    ----------
    path : what errors name. data : the bytes.
    """

    def __init__(self, path: Path, data: Bytes) -> None:
        self.path = path
        self.size = len(data)
        self._data = memoryview(data)

    def close(self) -> None:
        """Forget the bytes."""
        self._data = memoryview(b"")

    def check_unchanged(self) -> None:
        """Do nothing: nobody else has the bytes."""

    def _read_at(self, offset: int, n: int) -> bytes:
        return bytes(self._data[offset : offset + n])


class MemorySink(Sink):
    """Bytes in place of a file."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._data = bytearray()

    @property
    def file(self) -> MemoryFile:
        """What was written."""
        return MemoryFile(self.path, self._data)

    def _put(self, parts: Iterable[Bytes]) -> None:
        for part in parts:
            self._data += part
