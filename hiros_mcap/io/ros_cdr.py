"""Messages of ROS in CDR: decoded by the definitions of their log, written piece by piece.

Skeletons have a faster road, :mod:`hiros_mcap.io.codec`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import hiros_schemas
from hiros_mcap.errors import LogError
from hiros_mcap.skeletons import Floats

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Bytes = bytes | memoryview


class RosMessage(NamedTuple):
    """A message that is not decoded."""

    topic: str
    type: str
    log_time: int  # ns
    data: Bytes  # CDR; valid as long as it is held


_HEADER = "std_msgs/msg/Header"
_HEADER_TEXT = "builtin_interfaces/Time stamp\nstring frame_id\n"


def long_name(name: str) -> str:
    """``pkg/msg/Type`` of ``pkg/Type`` or of itself."""
    package, *_, kind = name.split("/")
    return f"{package}/msg/{kind}"


@lru_cache(maxsize=64)
def types_of(*texts: tuple[str, str]) -> Typestore:
    """Types of names and their definitions, and of what these contain; ROS 2's is the Header.

    The definitions of standard types differ from release to release, so only those of the log
    itself tell what its bytes are. rosbags compiles code for each type, which cameras share. Raises
    LogError for text that is no definition.
    """
    return _with_types(exact_types({_HEADER: _HEADER_TEXT}), dict(texts))


def exact_types(texts: Mapping[str, str]) -> Typestore:
    """Types of complete definitions; raises LogError for text that is none."""
    from rosbags.typesys import Stores, get_typestore

    return _with_types(get_typestore(Stores.EMPTY), texts)


@lru_cache(maxsize=64)
def definition(name: str, encoding: str, text: str) -> str:
    """Return the definition of a type as ``ros2msg`` has it, which a recorder may write otherwise.

    IDL is translated. Where the recorder found no definition, that of hiros counts. Other encodings
    are not changed. Raises LogError if there is no definition, or it cannot be parsed.
    """
    if text.strip() and encoding == "ros2idl":
        with _parsing(name):
            return str(_idl_types(name, text).generate_msgdef(long_name(name), ros_version=2)[0])
    if text.strip():
        return text
    try:
        return hiros_schemas.text(name)
    except KeyError:
        raise LogError(
            f"holds messages of {name} without their definition; record them with the package of "
            f"{name} installed"
        ) from None


def _idl_types(name: str, text: str) -> Typestore:
    """Types of a complete definition in IDL, as rosbag2 stores it; raises LogError for other text.

    Files follow each other, each below a line of 80 ``=`` and its name.
    """
    from rosbags.typesys import Stores, get_types_from_idl, get_typestore

    store = get_typestore(Stores.EMPTY)
    line = "=" * 80 + "\nIDL: "
    files = [file.partition("\n")[2] for file in text.split(line)[1:]] or [text]
    with _parsing(name):
        for file in files:
            types = get_types_from_idl(file)
            store.register({k: v for k, v in types.items() if k not in store.fielddefs})
    return store


def ros2_types(texts: Mapping[str, str]) -> Typestore:
    """Types of ``texts`` on top of ROS 2's standard ones, whose Header has no ``seq``.

    Raises LogError for text that is no definition.
    """
    from rosbags.typesys import Stores, get_typestore

    return _with_types(get_typestore(Stores.ROS2_HUMBLE), texts)


def _with_types(store: Typestore, texts: Mapping[str, str]) -> Typestore:
    from rosbags.typesys import get_types_from_msg

    for name, text in texts.items():
        with _parsing(name):
            types = get_types_from_msg(text, long_name(name))
            store.register({k: v for k, v in types.items() if k not in store.fielddefs})
    return store


@contextmanager
def _parsing(name: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # noqa: BLE001 - its parser raises many kinds
        reason = " ".join(str(error).split())[:80]
        raise LogError(f"the definition of {name} cannot be parsed: {reason}") from None


def decoder_of(store: Typestore, name: str) -> Callable[[Bytes], Any]:
    """Return what decodes messages of a type in CDR; it raises LogError for damaged bytes."""
    return partial(_converted, store.deserialize_cdr, long_name(name))


def cdr_of(store: Typestore, name: str) -> Callable[[Bytes], bytes]:
    """Return what turns messages of ROS 1 into CDR; it raises LogError for damaged bytes."""
    convert = partial(_converted, store.ros1_to_cdr, long_name(name))
    return lambda data: bytes(convert(data))


def _converted(convert: Callable[[Bytes, str], Any], name: str, data: Bytes) -> Any:
    try:
        return convert(data, name)
    except Exception as error:  # noqa: BLE001 - damaged bytes raise anything
        raise LogError(f"a message cannot be decoded: {type(error).__name__}") from None


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
