"""The mapping file of ``hiros import``: what the columns and numbers of a file mean.

::

    detector = "openpose"       # what the entries below change of this detector's
    unit = "mm"
    axes = ["x", "-z", "y"]     # the file's axes that are x, y, z of the log
    negate = "x"                # if the file's axes are left-handed
    frame = "world"

    [time]
    column = "timestamp"
    unit = "ms"

    [columns]                   # of a CSV file
    person = "id"
    camera = "device"           # rows of several cameras
    position = "{joint}_{axis}"

    [joints]                    # names in the file = names in the log
    LSHO = "SHOULDER_LEFT"

    [files."left.csv"]          # what differs in one file
    camera = "left"
    frame = "left_camera"
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from hiros_mcap.errors import ConfigError
from hiros_mcap.io.detectors.body_models import BODY_MODELS, body_model
from hiros_mcap.outside import read_toml
from hiros_mcap.params import explain
from hiros_mcap.skeletons import Floats

_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
_AXES = ("x", "y", "z")


_Y_UP: dict[str, Any] = {"axes": ["x", "-z", "y"]}
DETECTOR_FILES: dict[str, dict[str, Any]] = {
    # OpenPose 1.7 --3d --write_json: a file per instant, 25 times x, y, z and 0 or 1.
    "openpose": {"names": "openpose-25", "columns": {"joints": "pose_keypoints_3d"}},
    # MediaPipe 0.10, PoseLandmarkerResult as JSON: x right, y down, z away from the camera.
    "mediapipe": {
        "names": "mediapipe-33",
        "axes": ["x", "z", "-y"],
        "time": {"column": "timestamp_ms", "unit": "ms"},
        "columns": {"people": "pose_world_landmarks", "confidence": "visibility"},
    },
    # The same result: shares of the image, x right, y down.
    "mediapipe-image": {
        "names": "mediapipe-33",
        "time": {"column": "timestamp_ms", "unit": "ms"},
        "columns": {"people": "pose_landmarks", "z": "", "confidence": "visibility"},
    },
    # MMPose 1, pred_out_dir of its inferencer, and what its demos save under instance_info: px.
    "mmpose": {
        "columns": {
            "frames": "instance_info",
            "people": "instances",
            "joints": "keypoints",
            "z": "",
            "confidence": "keypoint_scores",
        },
    },
    # FreeMoCap 1.8 and 2, z up: output_data/mediapipe_body_3d_xyz.csv and .npy,
    # NAME_by_trajectory.csv; _tidy has those of a row per joint. Its DataSaver writes them
    # (freemocap/data_layer/data_saver/data_saver.py), in version 2 skellyforge's Actor.
    "freemocap": {
        "unit": "mm",
        "names": "mediapipe-33",
        "time": {"column": "timestamp"},
        "columns": {"position": "body_{joint}_{axis}"},
    },
    # Azure-Kinect-Samples, body-tracking-samples/offline_processor/main.cpp: in the frame of the
    # depth camera, x right, y down, z ahead.
    "azure-kinect": {
        "unit": "mm",
        "frame": "{camera}",
        "names": "azure-kinect",
        "time": {"column": "timestamp_usec", "unit": "us"},
        "columns": {"people": "bodies", "person": "body_id", "joints": "joint_positions"},
    },
    # zed-sdk, body tracking/export/JSON export: instants by their time in ms, confidences 0 to 100.
    "zed": {
        "frame": "{camera}",
        "names": "zed",
        "certain": 100.0,
        "time": {"column": "timestamp", "unit": "ns"},
        "columns": {
            "frames": "",
            "people": "body_list",
            "person": "id",
            "joints": "keypoint",
            "confidence": "keypoint_confidence",
        },
    },
    # Pose2Sim 0.10, pose-3d/*.trc; OpenCap, MarkerData/*.trc.
    "pose2sim": _Y_UP,
    "opencap": _Y_UP,
    # OptiTrack Motive 1.8 to 3, File > Export > CSV: the ground plane is x, z.
    "motive": _Y_UP,
}
"""Name of a detector or program -> the mapping of its files."""


def names_by_count(name: str) -> dict[int, list[str]]:
    """Return the joints of a skeleton, or of those of a family such as "zed", by their number.

    Raises ValueError for another name.
    """
    family = [m for m in BODY_MODELS if name == m or m.startswith(f"{name}-")]
    if not family:
        raise ValueError(f"should be a list, or one of {', '.join(BODY_MODELS)}")
    models = [body_model(member).marker_names for member in family]
    return {len(markers): list(markers) for markers in models}


class TimeMapping(BaseModel):
    """When the rows are of."""

    model_config = _STRICT
    column: str = "time"
    """Of a CSV file; key of a JSON file."""
    unit: Literal["s", "ms", "us", "ns"] = "s"
    rate: float | None = Field(None, gt=0)
    """Instants per second, of a file without times."""
    frame: str = "frame"
    """Of a CSV file with a rate: the column with the number of the instant, if there is one."""
    start: datetime | float = 0.0
    """Added to every time: a TOML date, or seconds since 1970."""
    offset: float = 0.0
    """Seconds to add to this camera's clock."""

    @field_validator("start")
    @classmethod
    def _has_zone(cls, start: datetime | float) -> datetime | float:
        if isinstance(start, datetime) and start.tzinfo is None:
            raise ValueError("should have a zone, as 2026-05-01T10:00:00Z or ...+02:00")
        return start


class ColumnMapping(BaseModel):
    """Columns of a CSV file, keys of a JSON file."""

    model_config = _STRICT
    person: str = "person"
    joint: str = "joint"
    x: str = "x"
    y: str = "y"
    z: str = "z"
    """"" if positions are pixels of an image: x to the right, y down."""
    confidence: str = "confidence"
    """Where a row has all joints of a person: with {joint}, or the {axis} of the position."""
    position: str = ""
    """A CSV file with a row per instant and person: name of a column, with {joint} and {axis}."""
    camera: str = ""
    """Column with the name of the camera, if a file has rows of several."""
    frames: str = "frames"
    """"" if the instants are the entries of the whole file."""
    people: str = "people"
    joints: str = "joints"

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of the numbers of a joint: its coordinates, and last the confidence."""
        return self.x, self.y, *([self.z] if self.z else []), self.confidence

    def numbers_of(self, joint: str) -> tuple[str, ...]:
        """Names of these columns in a file that has a row per instant and person."""
        pattern = self.position or "{joint}_{axis}"
        columns = [pattern.format(joint=joint, axis=axis) for axis in self.numbers]
        if "{joint}" in self.confidence:
            columns[-1] = self.confidence.replace("{joint}", joint)
        return tuple(columns)

    def names_in(self, columns: Sequence[str]) -> list[str]:
        """Joints with a column of a coordinate, in their order; none if rows name the joint."""
        pattern = self.position or ("" if self.joint in columns else "{joint}_{axis}")
        names = []
        for axis in self.numbers[:-1] if pattern else ():
            before, _, after = pattern.format(joint="\0", axis=axis).partition("\0")
            names += [
                column[len(before) : len(column) - len(after)]
                for column in columns
                if column.startswith(before) and column.endswith(after)
            ]
        return list(dict.fromkeys(name for name in names if name))

    @field_validator("position")
    @classmethod
    def _is_pattern(cls, position: str) -> str:
        filled = position.replace("{joint}", "").replace("{axis}", "")
        one_of_each = position.count("{joint}") == position.count("{axis}") == 1
        if position and (not one_of_each or "{" in filled or "}" in filled):
            raise ValueError('should have {joint} and {axis}, as "{joint}_{axis}"')
        return position


class FileMapping(BaseModel):
    """How the columns and keys of one file are read."""

    model_config = _STRICT
    camera: str = ""
    """Name of the camera; the file's name if empty."""
    frame: str = "world"
    """Coordinate frame of the positions; {camera} stands for the camera's name."""
    unit: Literal["m", "cm", "mm"] = "m"
    """If it is set, it counts more than what a file says itself."""
    axes: list[str] = ["x", "y", "z"]
    negate: Literal["", "x", "y", "z"] = ""
    """Axis of a left-handed file whose sign is changed, before ``axes`` are picked."""
    time: TimeMapping = TimeMapping()
    columns: ColumnMapping = ColumnMapping()
    joints: dict[str, str] = {}
    names: dict[int, list[str]] = {}
    """Joints in the order of a list without names, by their number.

    In the file it is one list, the skeleton of a detector, or "zed" for any of ZED's.
    """
    rows: dict[str, str] = {}
    """Of a CSV file: column -> pattern of its cells, as *body; other rows do not count."""
    certain: float = Field(1.0, gt=0)
    """The highest confidence."""

    @field_validator("names", mode="before")
    @classmethod
    def _expanded(cls, names: Any) -> Any:
        if isinstance(names, str):
            return names_by_count(names)
        return {len(names): names} if isinstance(names, list) else names

    @field_validator("axes")
    @classmethod
    def _are_axes(cls, axes: list[str]) -> list[str]:
        if sorted(axis.removeprefix("-") for axis in axes) != list(_AXES):
            raise ValueError('should be x, y and z in some order, with signs, as ["x", "-z", "y"]')
        if np.linalg.det(rotation_of(axes)) < 0:
            raise ValueError(
                "should not mirror people: change one sign; if the file's own axes are "
                'left-handed, name one of them: negate = "x"'
            )
        return axes

    @field_validator("joints")
    @classmethod
    def _are_distinct(cls, joints: dict[str, str]) -> dict[str, str]:
        if len(set(joints.values())) < len(joints):
            raise ValueError("should give each joint another name")
        return joints

    def rotated(self, positions: Floats) -> Floats:
        """Return positions (..., 3) of the file in the axes of the log."""
        signs = [-1.0 if axis == self.negate else 1.0 for axis in _AXES]
        return np.asarray(positions * signs @ rotation_of(self.axes).T)


def rotation_of(axes: list[str]) -> Floats:
    """(3, 3) matrix whose rows pick the file's axes."""
    rows = np.zeros((3, 3))
    for row, axis in zip(rows, axes, strict=True):
        row[_AXES.index(axis.removeprefix("-"))] = -1.0 if axis.startswith("-") else 1.0
    return rows


_IMAGE = {"x": "u", "y": "v", "z": "", "confidence": "score"}
_TIDY = {"frame", "keypoint", "x", "y", "z"}
"""Columns of FreeMoCap's files of a row per joint: *_by_frame.csv and, of version 2, all CSV."""
_TIDY_ROWS = {"model": "*body", "trajectory": "3d_xyz"}
"""Rows of these that are of the body, not of hands, face or centres of mass."""


def of_columns(mapping: FileMapping, columns: Sequence[str]) -> FileMapping:
    """Return what a CSV file means, whose columns may tell that it is of a known program.

    FreeMoCap's tables of a row per joint have columns of their own. If no mapping names the
    columns, they may be those of hiros export. Columns u and v, with no x, are of an image.
    """
    image = mapping.columns.model_copy(update=_IMAGE)
    if mapping.columns.z and not mapping.columns.names_in(columns):
        is_tall = {image.joint, image.x, image.y} <= {*columns} and "x" not in columns
        if is_tall or image.names_in(columns):
            mapping = mapping.model_copy(update={"columns": image})
    if not mapping.columns.z:
        camera = "camera" if "camera" in columns else ""
        if "camera" in mapping.columns.model_fields_set:
            camera = mapping.columns.camera
        with_camera = mapping.columns.model_copy(update={"camera": camera})
        return mapping.model_copy(update={"columns": with_camera})
    if columns and set(columns) >= _TIDY and "joint" not in mapping.columns.model_fields_set:
        rows = {name: pattern for name, pattern in _TIDY_ROWS.items() if name in columns}
        tall = mapping.columns.model_copy(update={"joint": "keypoint", "position": ""})
        return mapping.model_copy(update={"rows": rows | mapping.rows, "columns": tall})
    time = TimeMapping(column="time (s)")
    if {"time", "columns"} & mapping.model_fields_set or time.column not in columns:
        return mapping
    joints = ColumnMapping(position="{joint} {axis} (m)", confidence="{joint} confidence")
    return mapping.model_copy(update={"time": time, "columns": joints})


def read_mapping(path: Path | None, sources: Sequence[Path]) -> list[FileMapping]:
    """Return what each source means, by a mapping file or by that of a detector.

    Without either, everything is as by default.

    Raises ConfigError naming the file and the key.
    """
    if path is None:
        return [FileMapping() for _ in sources]
    is_named = path.name in DETECTOR_FILES
    table: dict[str, Any] = {"detector": path.name} if is_named else read_toml(path)
    detector = str(table.pop("detector", ""))
    if detector and detector not in DETECTOR_FILES:
        detectors = ", ".join(DETECTOR_FILES)
        raise ConfigError(f"{path}: detector: {detector!r} is none of {detectors}")
    table = _merged(DETECTOR_FILES.get(detector, {}), table)
    try:
        files = table.pop("files", {})
        if not isinstance(files, dict):
            raise ConfigError(f'{path}: files: should be tables [files."NAME"]')
        usual = FileMapping.model_validate(table)
        by_name = {n: FileMapping.model_validate(_merged(table, f)) for n, f in files.items()}
    except ValidationError as error:
        where, message = explain(error)
        raise ConfigError(f"{path}: {'.'.join(where) or 'file'}: {message}") from None
    if others := sorted(by_name.keys() - {source.name for source in sources}):
        raise ConfigError(f"{path}: [files] names {', '.join(others)}, not among those imported")
    return [by_name.get(source.name, usual) for source in sources]


def _merged(table: dict[str, Any], entry: Any) -> dict[str, Any]:
    """Return a table with the entries of another one put over it, also within its tables."""
    merged = dict(table)
    for key, value in (entry if isinstance(entry, dict) else {}).items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = {**merged[key], **value} if both else value
    return merged
