"""Messages other than skeletons as little-endian CDR, written piece by piece."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from hiros_mcap.skeletons import Floats

HEADER = b"\0\1\0\0"  # CDR, little endian
TIME_SIZE = 8
"""Bytes of a Time."""


class CdrWriter:
    """Bytes of one message; every number stands at a multiple of its size."""

    def __init__(self) -> None:
        self._body = bytearray()

    def finish(self) -> bytes:
        """Return the message."""
        return HEADER + bytes(self._body)

    def _put(self, form: str, size: int, *values: float) -> None:
        self._body += bytes(-len(self._body) % size)
        self._body += struct.pack(f"<{len(values)}{form}", *values)

    def raw(self, data: bytes) -> None:
        """Write bytes that another writer made at the same place."""
        self._body += data

    def byte(self, value: int) -> None:
        """Write a uint8 or a bool."""
        self._body.append(value)

    def int32(self, *values: int) -> None:
        """Write one or more int32."""
        self._put("i", 4, *values)

    def uint32(self, value: int) -> None:
        """Write a uint32, as the length of a sequence is."""
        self._put("I", 4, value)

    def float32(self, *values: float) -> None:
        """Write one or more float32."""
        self._put("f", 4, *values)

    def float64(self, *values: float) -> None:
        """Write one or more float64."""
        self._put("d", 8, *values)

    def array(self, values: Floats) -> None:
        """Write all numbers of an array as float64, without a length."""
        if values.size:
            self._body += bytes(-len(self._body) % 8)
            self._body += np.ascontiguousarray(values, "<f8").tobytes()

    def sequence(self, values: Floats) -> None:
        """Write a sequence of float64."""
        self.uint32(values.size)
        self.array(values)

    def int32s(self, values: Sequence[int]) -> None:
        """Write a sequence of int32."""
        self.uint32(len(values))
        self._put("i", 4, *values)

    def string(self, text: str) -> None:
        """Write a string."""
        data = text.encode() + b"\0"
        self.uint32(len(data))
        self._body += data

    def strings(self, texts: Sequence[str]) -> None:
        """Write a sequence of strings."""
        self.uint32(len(texts))
        for text in texts:
            self.string(text)

    def time(self, stamp: int) -> None:
        """Write a Time or a Duration, given in ns."""
        seconds, nanoseconds = divmod(stamp, 1_000_000_000)
        self.int32(seconds)
        self.uint32(nanoseconds)

    def header(self, stamp: int, frame_id: str) -> None:
        """Write a std_msgs/Header."""
        self.time(stamp)
        self.string(frame_id)
