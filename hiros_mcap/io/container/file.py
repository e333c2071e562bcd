"""A log file, opened once and read at given places; never mapped, so that it may shrink safely."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from threading import Lock

from isal.isal_zlib import crc32

from hiros_mcap.errors import LogError
from hiros_mcap.io.container.records import Bytes, FormatError

_BLOCK = 1 << 20


class LogFile:
    """Random access to the bytes of a regular file, from several threads.

    Raises LogError when the file cannot be opened, is not a regular file, cannot be read or
    changes while it is being read.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._lock = Lock()
        try:
            # A FIFO would block in open(): look before.
            if not stat.S_ISREG(self.path.stat().st_mode):
                fault = "is not a regular file; hiros reads files, so save a stream first"
                raise LogError(fault, path=self.path)
            self._file = self.path.open("rb", buffering=0)
        except (OSError, ValueError) as error:
            raise _refused(self.path, error) from None
        self._state = self._size_and_time()
        self.size = self._state[0]

    def close(self) -> None:
        """Close the file; reading afterwards is an error."""
        self._file.close()

    def read(self, offset: int, n: int) -> bytes:
        """Return exactly ``n`` bytes from ``offset``, or raise FormatError where the file ends."""
        if offset + n > self.size:
            raise FormatError("reaches past the end of the file")
        parts = []
        try:
            while n and (part := self._read_at(offset, n)):
                parts.append(part)
                offset, n = offset + len(part), n - len(part)
        except (OSError, ValueError, MemoryError) as error:
            raise _refused(self.path, error) from None
        if n:
            raise LogError("shrank while it was being read", path=self.path)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def _read_at(self, offset: int, n: int) -> bytes:
        if hasattr(os, "pread"):  # needs no lock, and gives up the GIL once instead of twice
            return os.pread(self._file.fileno(), n, offset)
        with self._lock:
            self._file.seek(offset)
            return self._file.read(n)

    def crc(self, start: int, stop: int) -> int:
        """CRC-32 of the bytes from ``start`` to before ``stop``."""
        value = 0
        for at in range(start, stop, _BLOCK):
            value = crc32(self.read(at, min(_BLOCK, stop - at)), value)
        return value

    def check_unchanged(self) -> None:
        """Raise LogError if somebody wrote to the file since it was opened."""
        if self._size_and_time() != self._state:
            raise LogError("changed while it was being read", path=self.path)

    def _size_and_time(self) -> tuple[int, int]:
        try:
            state = os.fstat(self._file.fileno())
        except (OSError, ValueError) as error:
            raise _refused(self.path, error) from None
        return state.st_size, state.st_mtime_ns


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


def _refused(path: Path, error: Exception) -> LogError:
    """LogError with the reason that the operating system gives."""
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return LogError(f"cannot be read: {reason}", path=path)
