"""A log file, read at given places, and its chunks, unpacked and checked.

The file is never mapped, so that it may shrink safely. What it claims never decides how much memory
is taken. And where bytes go: a file that appears only when it is complete, a pipe, or the memory.
"""

from __future__ import annotations

import os
import stat
import threading
import weakref
from abc import ABC, abstractmethod
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from isal.isal_zlib import crc32

from hiros_mcap.errors import LogError
from hiros_mcap.io.bag_files import ZSTD_MAGIC
from hiros_mcap.io.container.records import MAX_CHUNK, Bytes, Chunk, FormatError
from hiros_mcap.kernels.record_index import (
    FORBIDDEN,
    OK,
    PAST_END,
    SHORT_MESSAGE,
    index_records,
)
from hiros_mcap.outputs import sync_folder, temporary_name

if TYPE_CHECKING:
    import zstandard

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


MAX_WINDOW = 2**27
"""Largest zstd window, bytes: the limit of zstd's own command line."""
COMPRESSIONS = ("zstd", "lz4", "")
_THREAD = threading.local()
_FAULTS = {
    PAST_END: "a record reaches past the end of the chunk",
    SHORT_MESSAGE: "a message is shorter than its fixed fields",
    FORBIDDEN: "a record that is not allowed in a chunk",
}

Table = npt.NDArray[np.uint64]


ChunkRecords = tuple[Bytes, Table, Table]
"""The records of a chunk: its bytes; a row per message, columns as in kernels.record_index; a row
per schema or channel: opcode, first and past-the-end byte of its content."""


def read_chunk(file: LogFile, chunk: Chunk) -> ChunkRecords:
    """Read a chunk and find its records; raises FormatError unless checksum and lengths hold."""
    packed = file.read(chunk.data_offset, chunk.data_size)
    return unpack_chunk(packed, chunk.compression, chunk.size, chunk.crc)


def unpack_chunk(packed: Bytes, compression: str, size: int, crc: int) -> ChunkRecords:
    """Find the records in the bytes of a chunk like :func:`read_chunk`."""
    data = decompress(packed, compression, size)
    if crc and crc32(data) != crc:
        raise FormatError("the checksum is wrong")
    status, where, messages, definitions = index_records(np.frombuffer(data, np.uint8))
    if status != OK:
        raise FormatError(f"{_FAULTS[int(status)]} (byte {where} in the chunk)")
    return data, messages, definitions


def is_packed(message: Bytes) -> bool:
    """Whether a message in CDR is a zstd frame instead.

    So stores it ``ros2 bag record --compression-mode message`` (rosbag2_compression_zstd,
    zstd_compressor.cpp).
    """
    return message[: len(ZSTD_MAGIC)] == ZSTD_MAGIC


def unpack_message(message: Bytes, most: int = MAX_CHUNK) -> bytes:
    """Return what is in a zstd frame, or raise FormatError if that is more than ``most`` bytes."""
    import zstandard

    try:
        size = zstandard.frame_content_size(message)
        if size > most:
            raise FormatError(f"its messages claim {size} bytes uncompressed; the limit is {most}")
        plain = _unzstd(message, most if size < 0 else size)
    except zstandard.ZstdError as error:
        raise FormatError(f"zstd: {error}") from None
    if len(plain) != size and (size >= 0 or len(plain) > most):
        raise FormatError("a message does not decompress to the bytes that it claims")
    return plain


def compress(data: Bytes, compression: str) -> Bytes:
    """Compress a chunk; zstd at the fast level -3.

    On skeletons it packs 2.1 GB/s to 25 % of the size, the usual level 3 0.7 GB/s to 24 %.
    """
    if compression == "zstd":
        return _compressor().compress(data)
    if compression == "lz4":
        import lz4.frame

        return bytes(lz4.frame.compress(data))
    return data


def _compressor() -> zstandard.ZstdCompressor:
    """Return the thread's compressor: a new one for each chunk costs half as much again."""
    if not hasattr(_THREAD, "compressor"):
        import zstandard

        _THREAD.compressor = zstandard.ZstdCompressor(level=-3)
    compressor: zstandard.ZstdCompressor = _THREAD.compressor
    return compressor


def decompress(data: Bytes, compression: str, size: int) -> Bytes:
    """Return exactly ``size`` bytes, or raise FormatError; takes no more memory than that."""
    if size > MAX_CHUNK:
        raise FormatError(f"claims {size} bytes uncompressed; the limit is {MAX_CHUNK}")
    plain = data
    if compression == "zstd":
        plain = _unzstd(data, size)
    elif compression == "lz4":
        plain = _unlz4(data, size)
    elif compression:
        raise FormatError(f"unknown compression {compression!r}")
    if len(plain) != size:
        raise FormatError(f"does not decompress to the {size} bytes that it claims")
    return plain


def _unzstd(data: Bytes, size: int) -> bytes:
    import zstandard

    unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
    try:
        # One byte more than claimed is asked for, so that too much is noticed.
        with unpacker.stream_reader(data, read_across_frames=True) as stream:
            return stream.read(size + 1)
    except zstandard.ZstdError as error:
        raise FormatError(f"zstd: {error}") from None


def _unlz4(data: Bytes, size: int) -> bytes:
    import lz4.frame

    unpacker = lz4.frame.LZ4FrameDecompressor()
    try:
        plain = bytes(unpacker.decompress(data, max_length=size + 1))
    except RuntimeError as error:
        raise FormatError(f"lz4: {error}") from None
    if not unpacker.eof or unpacker.unused_data:
        raise FormatError("lz4: not exactly one frame")
    return plain


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
            sync_folder(self._target.parent)  # else a power cut may undo the new name
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
        """The file as it was written so far."""
        return MemoryFile(self.path, self._data)

    def _put(self, parts: Iterable[Bytes]) -> None:
        for part in parts:
            self._data += part
