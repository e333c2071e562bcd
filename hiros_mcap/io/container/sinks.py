"""Where bytes go: a file that appears only when it is complete, a pipe, or the memory."""

from __future__ import annotations

import os
import weakref
from abc import ABC, abstractmethod
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from isal.isal_zlib import crc32

from hiros_mcap.errors import LogError
from hiros_mcap.io.container.file import MemoryFile
from hiros_mcap.io.container.records import Bytes
from hiros_mcap.outputs import temporary_name


class Sink(ABC):
    """Where bytes go, one after the other.

    Attributes
    ----------
    path : what errors name. offset, crc : number and CRC-32 of the bytes so far.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.offset = 0
        self.crc = 0

    def write(self, *parts: Bytes) -> None:
        """Append; raises LogError if that is not possible."""
        for part in parts:
            self.crc = crc32(part, self.crc)
            self.offset += len(part)
        self._put(parts)

    @abstractmethod
    def _put(self, parts: Iterable[Bytes]) -> None:
        """Append parts."""

    def commit(self) -> None:  # noqa: B027 - most have nothing to do
        """Finish: all is written."""

    def discard(self) -> None:  # noqa: B027
        """Let go of what is not committed."""


class OutputFile(Sink):
    """A temporary file beside the output, renamed to it by ``commit``.

    It is in the output's folder because a rename cannot cross file systems.

    Raises LogError if the output is one of ``inputs`` under any name, is not a regular file, or
    cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], inputs: Iterable[str | os.PathLike[str]]):
        super().__init__(path)
        self._target = Path(os.path.realpath(path))
        if self._target.exists():
            if not self._target.is_file():
                raise LogError("cannot be written: is not a regular file", path=path)
            if any(Path(i).exists() and self._target.samefile(i) for i in inputs):
                raise LogError("is the input; choose another output", path=path)
        self.temp = temporary_name(self._target)
        # A signal may raise anywhere, even before the caller's `with` block begins.
        self._remove = weakref.finalize(self, self.temp.unlink, missing_ok=True)
        try:
            self._file = self.temp.open("xb")
        except (OSError, ValueError) as error:
            raise self._error(error) from None

    def _put(self, parts: Iterable[Bytes]) -> None:
        try:
            self._file.writelines(parts)
        except (OSError, ValueError, MemoryError) as error:
            raise self._error(error) from None

    def commit(self) -> None:
        """Let the file, which is on the disk then, replace what was there in one step."""
        try:
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            self.temp.replace(self._target)
        except (OSError, ValueError) as error:
            raise self._error(error) from None

    def discard(self) -> None:
        """Remove the temporary file; after ``commit`` there is none."""
        with suppress(OSError):  # what is still in its buffer is not wanted
            self._file.close()
        self._remove()

    def _error(self, error: Exception) -> LogError:
        fault = getattr(error, "strerror", None) or str(error) or type(error).__name__
        return LogError(f"cannot be written: {fault}", path=self.path)


class Pipe(Sink):
    """A pipe in place of a file.

    A reader that is slow makes the writer wait; BrokenPipeError is raised if it is gone.
    """

    def __init__(self, descriptor: int, name: str) -> None:
        super().__init__(name)
        self._descriptor = descriptor

    def _put(self, parts: Iterable[Bytes]) -> None:
        """Write everything, however long that takes; raises BrokenPipeError or LogError."""
        data = memoryview(b"".join(parts))
        try:
            while data:
                data = data[os.write(self._descriptor, data) :]
        except BrokenPipeError:
            raise
        except OSError as error:
            raise LogError(f"cannot be written: {error.strerror}", path=self.path) from None


class MemorySink(Sink):
    """Bytes in place of a file: what a recording of another format becomes."""

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
