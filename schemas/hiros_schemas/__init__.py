"""The message definitions that hiros reads and writes, as text and as hashes.

The nine ``.msg`` files lie in the folder ``hiros_skeleton_msgs`` beside this module, which is a
complete ROS 2 interface package: put it (or a link to it) into a workspace and ``colcon build``.
Beside the wheels of ROS 2, :mod:`hiros_schemas.ros2_packages` builds it.
"""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path

from hiros_schemas.definitions import (
    STANDARD,
    DefinitionError,
    Definitions,
    Field,
    leaves,
    parse,
    parse_fields,
    short_name,
)

__all__ = [
    "CAMERA_INFO",
    "DETECTION_ARRAY",
    "DIAGNOSTICS",
    "JOINT_STATE",
    "LOG",
    "MARKER_ARRAY",
    "NAMES",
    "OBJECTS_STAMPED",
    "ROS_PACKAGE",
    "SKELETON_2D",
    "SKELETON_GROUP",
    "STAMPED_SKELETON",
    "TF_MESSAGE",
    "UNCERTAINTY",
    "DefinitionError",
    "Definitions",
    "Field",
    "leaves",
    "parse",
    "short_name",
    "text",
    "type_hash",
]

ROS_PACKAGE = Path(__file__).parent / "hiros_skeleton_msgs"
"""Folder of the ROS 2 interface package: package.xml, CMakeLists.txt, msg/."""

NAMES = tuple(
    f"hiros_skeleton_msgs/msg/{name}"
    for name in (
        "Box",
        "KinematicState",
        "Link",
        "Marker",
        "Skeleton",
        "SkeletonGroup",
        "SkeletonGroupUncertainty",
        "SkeletonUncertainty",
        "StampedSkeleton",
    )
)
"""Full names of the nine message types."""

SKELETON_GROUP = "hiros_skeleton_msgs/msg/SkeletonGroup"
STAMPED_SKELETON = "hiros_skeleton_msgs/msg/StampedSkeleton"
DETECTION_ARRAY = "yolo_msgs/msg/DetectionArray"
SKELETON_2D = "hri_msgs/msg/Skeleton2D"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
OBJECTS_STAMPED = "zed_msgs/msg/ObjectsStamped"
UNCERTAINTY = "hiros_skeleton_msgs/msg/SkeletonGroupUncertainty"
"""Type that hiros adds to the published package: how well each marker is known."""
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"
JOINT_STATE = "sensor_msgs/msg/JointState"
LOG = "rcl_interfaces/msg/Log"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

DELIMITER = "=" * 80

# Numbers of the field types in a type description (REP 2016, type_description_interfaces).
_NESTED, _ARRAY, _SEQUENCE = 1, 48, 144
_TYPE_IDS = {
    "int8": 2,
    "uint8": 3,
    "int16": 4,
    "int32": 6,
    "uint32": 7,
    "float32": 10,
    "float64": 11,
    "bool": 15,
    "byte": 16,
    "string": 17,
}


@cache
def text(name: str) -> str:
    """Return the schema text that MCAP's ``ros2msg`` wants: the type, then all that it uses.

    Takes ``pkg/msg/Type`` or ``pkg/Type`` of :data:`NAMES`, of other types that are named above,
    or of what these are made of. Comments are left out: the text goes into every log.

    Raises :class:`KeyError` for another name.
    """
    first, *others = _closure(short_name(name))
    blocks = [_bare(first), *(f"{DELIMITER}\nMSG: {key}\n{_bare(key)}" for key in others)]
    return "\n".join(blocks)


@cache
def type_hash(name: str) -> str:
    """Return the RIHS01 hash of a type: the SHA-256 of its type description (REP 2011, REP 2016).

    rosbag2 keeps it beside a channel, to tell types of one name and different fields apart.
    """
    first, *others = _closure(short_name(name))
    description = {
        "type_description": _description(first),
        "referenced_type_descriptions": [_description(key) for key in sorted(others)],
    }
    return f"RIHS01_{hashlib.sha256(json.dumps(description).encode()).hexdigest()}"


def _definition(key: str) -> str:
    """Text of one definition, as it is in its file."""
    if key in STANDARD:
        return STANDARD[key]
    if key.startswith("hiros_skeleton_msgs/") and f"hiros_skeleton_msgs/msg/{key[20:]}" in NAMES:
        return (ROS_PACKAGE / "msg" / f"{key[20:]}.msg").read_text(encoding="utf-8")
    raise KeyError(f"hiros has no definition of {key}")


def _bare(key: str) -> str:
    """Text of one definition without comments and blank lines."""
    lines = (line.split("#", 1)[0].rstrip() for line in _definition(key).splitlines())
    return "".join(f"{line}\n" for line in lines if line)


def _closure(key: str, keys: dict[str, None] | None = None) -> list[str]:
    """Find the type and all that it uses, each once, in the order of first use."""
    keys = {} if keys is None else keys
    keys[key] = None
    for field in parse_fields(key, _definition(key)):
        if field.is_message and field.type not in keys:
            _closure(field.type, keys)
    return list(keys)


def _description(key: str) -> dict[str, object]:
    fields = parse_fields(key, _definition(key))
    return {"type_name": _long(key), "fields": [_field(field) for field in fields]}


def _field(field: Field) -> dict[str, object]:
    number = _NESTED if field.is_message else _TYPE_IDS[field.type]
    size = 0 if field.is_sequence else int(field.array.strip("[]") or 0)
    kind = {
        "type_id": number + (_SEQUENCE if field.is_sequence else _ARRAY if size else 0),
        "capacity": size,
        "string_capacity": 0,
        "nested_type_name": _long(field.type) if field.is_message else "",
    }
    return {"name": field.name, "type": kind}


def _long(key: str) -> str:
    package, name = key.split("/")
    return f"{package}/msg/{name}"
