"""One chunk of an MCAP file, decompressed and checked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from isal.isal_zlib import crc32

from hiros_mcap.io.container.compression import decompress
from hiros_mcap.io.container.file import LogFile
from hiros_mcap.io.container.records import Bytes, Chunk, FormatError
from hiros_mcap.kernels.record_index import (
    FORBIDDEN,
    OK,
    PAST_END,
    SHORT_MESSAGE,
    index_records,
)

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
