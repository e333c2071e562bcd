"""Parse ROS 2 message definitions: what each type's fields are called and of which type they are.

The grammar is that of ``.msg`` files (a field, a constant or a comment per line) and of the text
that a log carries: one definition after another, parted by a line of ``=`` and ``MSG: pkg/Type``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

PRIMITIVES = frozenset(
    [
        *("bool", "byte", "char", "string", "wstring", "float32", "float64"),
        *("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"),
    ]
)
MAX_LEAVES = 4096
MAX_DEPTH = 32

_FIELD = re.compile(
    r"(?P<type>[A-Za-z]\w*(?:/\w+){0,2}(?:<=\d+)?)(?P<array>\[(?:(?:<=)?\d+)?\])?"
    r"\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)",
    re.ASCII,
)
_SEPARATOR = re.compile(r"^={3,}[ \t\r]*$", re.MULTILINE)
_TITLE = re.compile(r"\s*MSG:\s+(\S+)[ \t\r]*$", re.MULTILINE)


class DefinitionError(ValueError):
    """A message definition that makes no sense; ``str(error)`` says where."""


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message."""

    name: str
    type: str
    """A primitive ("float64", "string<=8") or a message ("geometry_msgs/Pose")."""
    array: str
    """"" = a single value, "[]" = a sequence, "[<=3]" = a bounded one, "[3]" = a fixed array."""

    @property
    def is_message(self) -> bool:
        """Whether the type is another message."""
        return "/" in self.type

    @property
    def is_sequence(self) -> bool:
        """Whether it is an array with its length on the wire."""
        return self.array == "[]" or self.array.startswith("[<=")


Definitions = Mapping[str, tuple[Field, ...]]
"""The fields of each message type ("pkg/Type"), in the order of the definition."""


def short_name(name: str) -> str:
    """Type name without the middle part: ``pkg/msg/Type`` and ``pkg/Type`` are the same type."""
    parts = name.split("/")
    if len(parts) not in (2, 3) or not all(parts):
        raise DefinitionError(f"{name!r} is not the name of a message type")
    return f"{parts[0]}/{parts[-1]}"


def parse_fields(name: str, text: str) -> tuple[Field, ...]:
    """Fields of one ``.msg`` definition; comments, constants and default values are left out."""
    package = short_name(name).split("/")[0]
    fields = []
    for line in text.splitlines():
        statement = line.split("#", 1)[0].strip()
        if not statement:
            continue
        match = _FIELD.fullmatch(statement)
        if match is None or match["array"] == "[0]":
            raise DefinitionError(f"{name} has a line that is no field: {statement[:80]!r}")
        if not match["rest"].startswith("="):
            fields.append(
                Field(match["name"], _full_type(match["type"], package), match["array"] or "")
            )
    if len({field.name for field in fields}) != len(fields):
        raise DefinitionError(f"{name} has two fields of one name")
    return tuple(fields)


def parse(name: str, text: str) -> dict[str, tuple[Field, ...]]:
    """All definitions of a concatenated schema text whose first definition is of type ``name``.

    Raises :class:`DefinitionError` where the text cannot be parsed or defines a type twice,
    differently. A type that the text uses and does not define is found by :func:`leaves`.
    """
    first, *others = _SEPARATOR.split(text)
    definitions = {short_name(name): parse_fields(name, first)}
    for block in others:
        title = _TITLE.match(block)
        if title is None:
            raise DefinitionError("a definition lacks its line 'MSG: package/Type'")
        key = short_name(title[1])
        fields = parse_fields(key, block[title.end() :])
        if definitions.setdefault(key, fields) != fields:
            raise DefinitionError(f"{key} is defined twice, differently")
    return definitions


def leaves(definitions: Definitions, name: str) -> list[tuple[str, str]]:
    """Every number and string of a message as (path, type), in the order of the wire.

    Two types with equal leaves have equal bytes: upper bounds of sequences and strings, which
    leave no trace there, are dropped. A path holds the arrays on its way:
    ``("skeletons[].markers[].center.pose.position.x", "float64")``.

    Raises :class:`DefinitionError` where a definition is missing, recursive or absurdly large.
    """
    fields: list[tuple[str, str]] = []
    for leaf in _walk(definitions, short_name(name), "", 0):
        fields.append(leaf)
        if len(fields) > MAX_LEAVES:
            raise DefinitionError(f"{name} has more than {MAX_LEAVES} fields")
    return fields


def _walk(
    definitions: Definitions, name: str, prefix: str, depth: int
) -> Iterator[tuple[str, str]]:
    if name not in definitions:
        raise DefinitionError(f"the definition of {name} is missing")
    if depth > MAX_DEPTH:
        raise DefinitionError(f"{name} contains itself or is nested deeper than {MAX_DEPTH}")
    for field in definitions[name]:
        path = f"{prefix}{field.name}{'[]' if field.is_sequence else field.array}"
        if field.is_message:
            yield from _walk(definitions, field.type, f"{path}.", depth + 1)
        else:
            yield path, field.type.split("<=")[0]
    if not definitions[name]:
        # ROS 2 gives an empty message one byte on the wire.
        yield f"{prefix}structure_needs_at_least_one_member", "uint8"


def _full_type(name: str, package: str) -> str:
    if name.split("<=")[0] in PRIMITIVES:
        return name
    if "<=" in name:
        raise DefinitionError(f"{name!r} is not a type")
    return short_name(name if "/" in name else f"{package}/{name}")
