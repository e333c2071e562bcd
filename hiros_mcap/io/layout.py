"""Decide from a channel's schema whether its messages are SkeletonGroups; never guess.

Their fields must be the published ones, by name, type and order.
"""

from __future__ import annotations

import hiros_schemas
from hiros_mcap.errors import LogError, SchemaError
from hiros_mcap.io.container import Schema
from hiros_mcap.io.ros_cdr import definition

MAX_SCHEMA = 1 << 20

_NAME = hiros_schemas.SKELETON_GROUP
_ENCODINGS = "ros2msg", "ros2idl"
_TIME = "builtin_interfaces/Time"


def check_schema(schema: Schema | None, topic: str) -> None:
    """Compare a channel's schema with the published SkeletonGroup, field by field.

    Comments, constants, default values, upper bounds and the names of nested types do not matter.

    Raises SchemaError if the schema is missing, cannot be parsed or has other fields.
    """
    try:
        if schema is None:
            raise hiros_schemas.DefinitionError("has no message definition")
        if difference := _difference(_leaves(schema)):
            raise hiros_schemas.DefinitionError(
                f"schema is not that of {_NAME}: {difference}; convert the messages, or write a "
                "reader of your own (docs/detectors.md)"
            )
    except hiros_schemas.DefinitionError as error:
        raise SchemaError(str(error), topic=topic) from error


def _leaves(schema: Schema) -> list[tuple[str, str]]:
    """Path and type of each field of a schema; raises DefinitionError."""
    if schema.encoding not in _ENCODINGS and schema.data:
        raise hiros_schemas.DefinitionError(
            f"schema encoding {schema.encoding!r} is neither ros2msg nor ros2idl; record it with "
            "rosbag2"
        )
    if hiros_schemas.short_name(schema.name) != hiros_schemas.short_name(_NAME):
        raise hiros_schemas.DefinitionError(f"schema {schema.name!r} is not {_NAME}")
    if len(schema.data) > MAX_SCHEMA:
        raise hiros_schemas.DefinitionError(f"schema is larger than {MAX_SCHEMA} bytes")
    try:
        text = definition(schema.name, schema.encoding, bytes(schema.data).decode())
    except UnicodeDecodeError as error:
        raise hiros_schemas.DefinitionError("schema is not UTF-8 text") from error
    except LogError as error:
        raise hiros_schemas.DefinitionError(error.fault) from error
    # Recorders may leave out the types that every ROS 2 system has built in.
    types = {_TIME: _PUBLISHED[_TIME], **hiros_schemas.parse(schema.name, text)}
    return hiros_schemas.leaves(types, schema.name)


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


_PUBLISHED = hiros_schemas.parse(_NAME, hiros_schemas.text(_NAME))
_LEAVES = hiros_schemas.leaves(_PUBLISHED, _NAME)
