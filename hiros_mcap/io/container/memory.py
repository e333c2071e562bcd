"""An MCAP in memory: what a recording of another format becomes, for everybody who reads files."""

from __future__ import annotations

from pathlib import Path

from isal.isal_zlib import crc32

from hiros_mcap.io.container.atomic import OutputFile
from hiros_mcap.io.container.file import LogFile
from hiros_mcap.io.container.records import Bytes
from hiros_mcap.io.container.writer import McapWriter


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


class MemoryWriter(McapWriter):
    """Writes an MCAP into memory; after a commit, ``file`` has it."""

    def __init__(self, path: Path) -> None:
        self._end = _MemoryEnd()
        super().__init__(path)

    @property
    def file(self) -> MemoryFile:
        """What was written."""
        return MemoryFile(Path(self.path), self._end.data)

    def _open(self, _: object) -> OutputFile:
        return self._end

    def _publish(self) -> None:
        """Do nothing: all is there."""


class _MemoryEnd(OutputFile):
    """Bytes in place of a file."""

    def __init__(self) -> None:
        self.offset = 0
        self.crc = 0
        self.data = bytearray()

    def write(self, *parts: Bytes) -> None:
        """Append."""
        for part in parts:
            self.crc = crc32(part, self.crc)
            self.offset += len(part)
            self.data += part

    def discard(self) -> None:
        """Do nothing: there is no file."""
