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
    type: str  # a primitive ("float64", "string<=8") or a message ("geometry_msgs/Pose")
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


STANDARD = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Pose": ("geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"),
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/Accel": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec\n",
    "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n",
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\n"
        "float64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    ),
    "rcl_interfaces/Log": (
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\n"
        "string file\nstring function\nuint32 line\n"
    ),
    "diagnostic_msgs/KeyValue": "string key\nstring value\n",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte level\nstring name\nstring message\nstring hardware_id\n"
        "diagnostic_msgs/KeyValue[] values\n"
    ),
    "diagnostic_msgs/DiagnosticArray": (
        "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n"
    ),
    "visualization_msgs/UVCoordinate": "float32 u\nfloat32 v\n",
    "visualization_msgs/MeshFile": "string filename\nuint8[] data\n",
    "visualization_msgs/Marker": (
        "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\n"
        "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\n"
        "builtin_interfaces/Duration lifetime\nbool frame_locked\ngeometry_msgs/Point[] points\n"
        "std_msgs/ColorRGBA[] colors\nstring texture_resource\n"
        "sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] uv_coordinates\n"
        "string text\nstring mesh_resource\nvisualization_msgs/MeshFile mesh_file\n"
        "bool mesh_use_embedded_materials\n"
    ),
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers\n",
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n"
    ),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n"
        "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\n"
        "uint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n"
    ),
    # The package yolo_msgs of yolo_ros 4.
    "yolo_msgs/Point2D": "float64 x\nfloat64 y\n",
    "yolo_msgs/Vector2": "float64 x\nfloat64 y\n",
    "yolo_msgs/Pose2D": "yolo_msgs/Point2D position\nfloat64 theta\n",
    "yolo_msgs/BoundingBox2D": "yolo_msgs/Pose2D center\nyolo_msgs/Vector2 size\n",
    "yolo_msgs/BoundingBox3D": (
        "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\nstring frame_id\n"
    ),
    "yolo_msgs/Mask": "int32 height\nint32 width\nyolo_msgs/Point2D[] data\n",
    "yolo_msgs/KeyPoint2D": "int32 id\nyolo_msgs/Point2D point\nfloat64 score\n",
    "yolo_msgs/KeyPoint2DArray": "yolo_msgs/KeyPoint2D[] data\n",
    "yolo_msgs/KeyPoint3D": "int32 id\ngeometry_msgs/Point point\nfloat64 score\n",
    "yolo_msgs/KeyPoint3DArray": "yolo_msgs/KeyPoint3D[] data\nstring frame_id\n",
    "yolo_msgs/Detection": (
        "int32 class_id\nstring class_name\nfloat64 score\nstring id\n"
        "yolo_msgs/BoundingBox2D bbox\nyolo_msgs/BoundingBox3D bbox3d\nyolo_msgs/Mask mask\n"
        "yolo_msgs/KeyPoint2DArray keypoints\nyolo_msgs/KeyPoint3DArray keypoints3d\n"
    ),
    "yolo_msgs/DetectionArray": ("std_msgs/Header header\nyolo_msgs/Detection[] detections\n"),
    # ROS4HRI's package hri_msgs.
    "hri_msgs/NormalizedPointOfInterest2D": "float32 x\nfloat32 y\nfloat32 c\n",
    "hri_msgs/Skeleton2D": (
        "std_msgs/Header header\nhri_msgs/NormalizedPointOfInterest2D[] skeleton\n"
    ),
    # Stereolabs' package zed_msgs, as documented for the ZED ROS 2 wrapper 5.
    "zed_msgs/Keypoint2Di": "uint32[2] kp\n",
    "zed_msgs/Keypoint2Df": "float32[2] kp\n",
    "zed_msgs/Keypoint3D": "float32[3] kp\n",
    "zed_msgs/BoundingBox2Di": "zed_msgs/Keypoint2Di[4] corners\n",
    "zed_msgs/BoundingBox2Df": "zed_msgs/Keypoint2Df[4] corners\n",
    "zed_msgs/BoundingBox3D": "zed_msgs/Keypoint3D[8] corners\n",
    "zed_msgs/Skeleton2D": "zed_msgs/Keypoint2Df[70] keypoints\n",
    "zed_msgs/Skeleton3D": "zed_msgs/Keypoint3D[70] keypoints\n",
    "zed_msgs/Object": (
        "string label\nint16 label_id\nstring sublabel\nfloat32 confidence\n"
        "float32[3] position\nfloat32[6] position_covariance\nfloat32[3] velocity\n"
        "bool tracking_available\nint8 tracking_state\nint8 action_state\n"
        "zed_msgs/BoundingBox2Di bounding_box_2d\nzed_msgs/BoundingBox3D bounding_box_3d\n"
        "float32[3] dimensions_3d\nbool skeleton_available\nint8 body_format\n"
        "zed_msgs/BoundingBox2Df head_bounding_box_2d\n"
        "zed_msgs/BoundingBox3D head_bounding_box_3d\nfloat32[3] head_position\n"
        "zed_msgs/Skeleton2D skeleton_2d\nzed_msgs/Skeleton3D skeleton_3d\n"
    ),
    "zed_msgs/ObjectsStamped": "std_msgs/Header header\nzed_msgs/Object[] objects\n",
}
