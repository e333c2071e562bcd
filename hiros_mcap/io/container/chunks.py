"""One chunk of an MCAP file: packed, or unpacked and checked.

What a file claims never decides how much memory is taken.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
from isal.isal_zlib import crc32

from hiros_mcap.io.container.file import LogFile
from hiros_mcap.io.container.records import MAX_CHUNK, Bytes, Chunk, FormatError
from hiros_mcap.kernels.record_index import (
    FORBIDDEN,
    OK,
    PAST_END,
    SHORT_MESSAGE,
    index_records,
)

if TYPE_CHECKING:
    import zstandard

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


class ChunkRecords(NamedTuple):
    """The records of a chunk."""

    data: Bytes
    messages: Table
    """One row per message, columns as in kernels.record_index."""
    definitions: Table
    """One row per schema or channel: opcode, first and past-the-end byte of its content."""


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
    return ChunkRecords(data, messages, definitions)


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
