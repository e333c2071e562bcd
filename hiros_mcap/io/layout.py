"""Decide from a channel's schema how its messages are laid out; never guess.

Messages whose fields are the published ones, by name, type and order, are read as they are. Where
fields were added or moved, or have another numeric type, the generic library reads them and what
it found is written in the published layout. Anything else is refused.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import Any

import hiros_schemas
from hiros_mcap.errors import LogError, SchemaError
from hiros_mcap.io.ros_cdr import CdrWriter, decoder_of, definition, exact_types

Bytes = bytes | bytearray | memoryview

MAX_SCHEMA = 1 << 20

_NAME = hiros_schemas.SKELETON_GROUP
_ENCODINGS = "ros2msg", "ros2idl"
_TIME = "builtin_interfaces/Time"
_INTEGERS = frozenset(
    ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"),
)
_COMPATIBLE = {
    "float64": frozenset(("float32", "float64")),
    "int32": _INTEGERS,
    "uint32": _INTEGERS,
    "string": frozenset(("string",)),
}
_WRITERS: dict[str, Callable[[CdrWriter, Any], None]] = {
    "int32": CdrWriter.int32,
    "uint32": CdrWriter.uint32,
    "float64": CdrWriter.float64,
    "string": CdrWriter.string,
}


class Layout:
    """How a channel's messages are laid out; calling it gives a message's published bytes.

    Attributes
    ----------
    difference : the first field that is not as published; "" when there is none.
    """

    def __init__(self, read: Callable[[Any], Any] | None = None, difference: str = "") -> None:
        self._read = read
        self.difference = difference

    @property
    def is_published(self) -> bool:
        """Whether messages need no translation (which is a thousand times slower than reading)."""
        return self._read is None

    def __call__(self, data: Bytes, topic: str | None = None) -> Bytes:
        """Return the message in the published layout. Raises :class:`LogError` if unreadable."""
        if self._read is None:
            return data
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            kind = bytes(data[:2]).hex()
            raise LogError(f"message encapsulation 0x{kind} is not plain CDR", topic=topic)
        out = CdrWriter()
        try:
            _write(out, _PUBLISHED, hiros_schemas.short_name(_NAME), self._read(data))
        except (LogError, struct.error) as error:
            fault = f"message cannot be read with its own schema: {error}"
            raise LogError(fault, topic=topic) from error
        return out.finish()


def check_schema(name: str, encoding: str, data: bytes, *, topic: str | None = None) -> Layout:
    """Compare a channel's schema with the published SkeletonGroup, field by field.

    Comments, constants, default values, upper bounds and the names of nested types do not matter.

    Raises SchemaError if the schema cannot be parsed, or a needed field is missing or of an
    incompatible type.
    """
    try:
        return _layout(name, encoding, data)
    except hiros_schemas.DefinitionError as error:
        raise SchemaError(str(error), topic=topic) from error


def _layout(name: str, encoding: str, data: bytes) -> Layout:
    if encoding not in _ENCODINGS and data:
        raise hiros_schemas.DefinitionError(
            f"schema encoding {encoding!r} is neither ros2msg nor ros2idl; record it with rosbag2"
        )
    definitions = _parse(name, encoding, data)
    leaves = hiros_schemas.leaves(definitions, name)
    difference = _difference(leaves)
    if not difference:
        return PUBLISHED
    _refuse_missing(leaves)
    return Layout(_generic_reader(definitions), difference)


def _parse(name: str, encoding: str, data: bytes) -> hiros_schemas.Definitions:
    if hiros_schemas.short_name(name) != hiros_schemas.short_name(_NAME):
        raise hiros_schemas.DefinitionError(f"schema {name!r} is not {_NAME}")
    if len(data) > MAX_SCHEMA:
        raise hiros_schemas.DefinitionError(f"schema is larger than {MAX_SCHEMA} bytes")
    try:
        text = definition(name, encoding, bytes(data).decode())
    except UnicodeDecodeError as error:
        raise hiros_schemas.DefinitionError("schema is not UTF-8 text") from error
    except LogError as error:
        raise hiros_schemas.DefinitionError(error.fault) from error
    # Recorders may leave out the types that every ROS 2 system has built in.
    return {_TIME: _PUBLISHED[_TIME], **hiros_schemas.parse(name, text)}


def _difference(leaves: list[tuple[str, str]]) -> str:
    """Name the first field that differs from the published ones, "" if none does."""
    for (path, kind), (expected_path, expected_kind) in zip(leaves, _LEAVES, strict=False):
        if path != expected_path:
            return f"field {path} where {expected_path} is expected"
        if kind != expected_kind:
            return f"field {path} is {kind} instead of {expected_kind}"
    if len(leaves) == len(_LEAVES):
        return ""
    longer = max(leaves, _LEAVES, key=len)[min(len(leaves), len(_LEAVES))][0]
    return f"field {longer} is {'unknown' if len(leaves) > len(_LEAVES) else 'missing'}"


def _refuse_missing(leaves: list[tuple[str, str]]) -> None:
    kinds = {re.sub(r"\[\d*\]", "[]", path): kind for path, kind in leaves}
    for path, kind in _LEAVES:
        if path not in kinds:
            fault = f"schema lacks the field {path} ({kind}) of {_NAME}"
            raise hiros_schemas.DefinitionError(fault)
        if kinds[path] not in _COMPATIBLE[kind]:
            fault = f"schema has {kinds[path]} instead of {kind} for the field {path}"
            raise hiros_schemas.DefinitionError(fault)


def _generic_reader(definitions: hiros_schemas.Definitions) -> Callable[[Any], Any]:
    """Make a decoder of the generic library for exactly the definitions that were checked."""
    if definitions[_TIME] != _PUBLISHED[_TIME]:
        raise hiros_schemas.DefinitionError(f"schema cannot be used: it has another {_TIME}")
    first = hiros_schemas.short_name(_NAME)
    names = [first, *(key for key in definitions if key != first)]
    blocks = [
        f"MSG: {key}\n"
        + "".join(f"{field.type}{field.array} {field.name}\n" for field in definitions[key])
        for key in names
    ]
    text = f"{'=' * 80}\n".join(blocks).partition("\n")[2]
    try:
        return decoder_of(exact_types({first: text}), first)
    except LogError as error:
        raise hiros_schemas.DefinitionError(f"schema cannot be used: {error}") from error


def _write(out: CdrWriter, definitions: hiros_schemas.Definitions, name: str, message: Any) -> None:
    """Append a decoded message."""
    for field in definitions[name]:
        value = getattr(message, field.name)
        if field.array:
            out.uint32(len(value))
        for item in value if field.array else (value,):
            if field.is_message:
                _write(out, definitions, field.type, item)
            else:
                _WRITERS[field.type](out, item)


_PUBLISHED = hiros_schemas.parse(_NAME, hiros_schemas.text(_NAME))
_LEAVES = hiros_schemas.leaves(_PUBLISHED, _NAME)

PUBLISHED = Layout()
"""The layout of the published definition: messages are read as they are."""
