"""A file that appears under its name only when it is complete."""

from __future__ import annotations

import contextlib
import os
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from io import FileIO
from pathlib import Path

from isal.isal_zlib import crc32

from hiros_mcap.errors import LogError
from hiros_mcap.io.container.file import LogFile
from hiros_mcap.io.container.records import Bytes
from hiros_mcap.io.container.scan import scan
from hiros_mcap.outputs import create_locked, temporary_name

_BEGIN = 16 << 20  # bytes
_PARTS = 64  # POSIX guarantees 16, every current system 1024


def _write(file: FileIO, parts: list[memoryview]) -> int:
    """Write some of ``parts``, at least one byte; return how many bytes."""
    if hasattr(os, "writev"):
        return os.writev(file.fileno(), parts[:_PARTS])
    return file.write(parts[0])


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
        views = [memoryview(part) for part in parts if len(part)]
        for view in views:
            self.crc = crc32(view, self.crc)
            self.offset += len(view)
        self._put(views)

    @abstractmethod
    def _put(self, parts: list[memoryview]) -> None:
        """Append parts that are not empty."""

    def commit(self) -> None:  # noqa: B027 - most have nothing to do
        """Finish: all is written."""

    def discard(self) -> None:  # noqa: B027
        """Let go of what is not committed."""


class OutputFile(Sink):
    """A temporary file beside the output, renamed to it by ``commit`` and never left behind.

    Its name is ``.hiros-*.tmp``, in the output's folder because a rename cannot cross file systems.
    A run that is killed leaves it there and changes nothing else; the next one removes it.

    Raises LogError if the output is one of ``inputs`` under any name, is not a regular file, or
    cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], inputs: Iterable[str | os.PathLike[str]]):
        super().__init__(path)
        self._begun = 0
        try:
            self._target = Path(os.path.realpath(path))
            self._refuse(inputs)
            self.temp = temporary_name(self._target)
            # A signal may raise anywhere, even before the caller's `with` block begins.
            self._remove = weakref.finalize(self, self.temp.unlink, missing_ok=True)
            self._unlock: Callable[[], object] = int
            self._file = os.fdopen(create_locked(self.temp), "wb", buffering=0)
            if os.name == "posix":  # elsewhere an open file cannot be renamed
                # A copy of the descriptor keeps the lock until the file has its name.
                self._unlock = weakref.finalize(self, os.close, os.dup(self._file.fileno()))
        except (OSError, ValueError) as error:
            raise self._error(error) from None

    def _put(self, left: list[memoryview]) -> None:
        try:
            while left:
                # One system call for all parts: each one releases and takes the GIL.
                n = _write(self._file, left)
                while left and n >= len(left[0]):
                    n -= len(left.pop(0))
                if n:
                    left[0] = left[0][n:]
            if self.offset - self._begun >= _BEGIN and hasattr(os, "posix_fadvise"):
                # The system begins to write to the disk, which leaves `sync` little to do.
                length, start = self.offset - self._begun, self._begun
                with contextlib.suppress(OSError):  # not every file system takes advice
                    os.posix_fadvise(self._file.fileno(), start, length, os.POSIX_FADV_DONTNEED)
                self._begun = self.offset
        except (OSError, ValueError, MemoryError) as error:
            raise self._error(error) from None

    def commit(self) -> None:
        """Let the file appear under its name, replacing what was there, in one step.

        It is on the disk then, and its records are in order; the checksum of its data was computed
        from the bytes that were written.
        """
        try:
            os.fsync(self._file.fileno())
            self._file.close()
            check = LogFile(self.temp)
            try:
                scan(check, checksum=False)
            finally:
                check.close()
            self.temp.replace(self._target)
            if os.name == "posix":
                folder = os.open(self._target.parent, os.O_RDONLY)
                try:
                    os.fsync(folder)
                finally:
                    os.close(folder)
            self._unlock()
        except (OSError, ValueError) as error:
            raise self._error(error) from None

    def discard(self) -> None:
        """Remove the temporary file; after ``commit`` there is none."""
        try:
            self._file.close()
        finally:
            self._remove()
            self._unlock()

    def _refuse(self, inputs: Iterable[str | os.PathLike[str]]) -> None:
        if not self._target.exists():
            return
        if not self._target.is_file():
            raise LogError("cannot be written: is not a regular file", path=self.path)
        for other in map(Path, inputs):
            if other.exists() and self._target.samefile(other):
                raise LogError("is the input; choose another output", path=self.path)

    def _error(self, error: Exception) -> LogError:
        fault = getattr(error, "strerror", None) or str(error) or type(error).__name__
        return LogError(f"cannot be written: {fault}", path=self.path)
