"""Calibrations of RGB cameras by other programs: TOML, Qualisys' .qca.txt, ROS' camera_info YAML.

TOML has a table per camera, as aniposelib writes it (Anipose, FreeMoCap, Pose2Sim: ``size``,
``matrix``, ``distortions``, ``rotation`` as a rotation vector, ``translation``). Caliscope's has
them below ``cameras``, or rotations as matrices. Rotation and translation bring the room's points
into the camera's frame, whose axes are OpenCV's: x right, y down, z ahead.

Qualisys counts lengths of the lens in 64ths of a pixel, and places in mm. Its cameras have y up and
z backwards; its coefficients of distortion are OpenCV's. A file of ROS has no pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from hiros_mcap.body.intrinsics import FISHEYE, PLUMB_BOB, RATIONAL, Intrinsics
from hiros_mcap.body.rotations import Rigid, from_matrix, from_vector
from hiros_mcap.errors import ConfigError
from hiros_mcap.outside import parse, read_text, read_yaml
from hiros_mcap.skeletons import Floats

_FARTHEST_M = 50.0
"""A camera that sees people stands nearer to the origin; in mm, no room is so small."""
_ROUNDED = 0.01
"""Most by which rounding moves a number of a rotation matrix times itself."""
_SUBPIXELS = 64.0
_QCA_AXES = np.diag([1.0, -1.0, -1.0])


class LensAndPose(NamedTuple):
    """What a calibration tells of a camera."""

    name: str
    lens: Intrinsics | None  # None if the file has none
    pose: Rigid | None  # in the room; None if the file has none


def read_calibration(path: Path) -> list[LensAndPose]:
    """Read a calibration of any of these programs; [] if a file of TOML or JSON is no calibration.

    Raises ConfigError, which names the file and the camera.
    """
    suffix = path.suffix.lower()
    if suffix in (".txt", ".xml"):
        return [*_qualisys(path)]
    if suffix in (".yaml", ".yml"):
        return [_ros(path)]
    raw = parse(read_text(path), "JSON" if suffix == ".json" else "TOML", path)
    return [_of_table(key, table, f"{path}: {key}") for key, table in _tables(raw).items()]


def _tables(raw: Any) -> dict[str, dict[str, Any]]:
    """Return the table of each camera of an OpenCV calibration; none if it is another file."""
    if not isinstance(raw, dict) or "camera" in raw:
        return {}
    tables = {**raw, **(raw["cameras"] if isinstance(raw.get("cameras"), dict) else {})}
    return {
        key: table
        for key, table in tables.items()
        if isinstance(table, dict) and {"rotation", "matrix"} & table.keys()
    }


def _of_table(key: str, table: Mapping[str, Any], where: str) -> LensAndPose:
    pose = None
    if table.get("rotation") is not None:
        fault = f"{where}: rotation and translation should be three numbers"
        rotation = _numbers(table["rotation"], (3, 9), fault)
        translation = _numbers(table.get("translation"), (3,), fault)
        turn = from_vector(rotation) if len(rotation) == 3 else _turn(rotation.reshape(3, 3), where)
        pose = _placed(turn, translation, where)
    name = str(table.get("name", key))
    size = table.get("size", table.get("resolution"))
    if size is None or "matrix" not in table:
        return LensAndPose(name, None, pose)
    distortion = table.get("distortions", table.get("distortion")) or []
    return _with_lens(name, size, table["matrix"], distortion, table.get("fisheye"), pose, where)


def _turn(matrix: Floats, where: str) -> Floats:
    """Return the quaternion of a rotation matrix; raises ConfigError for any other matrix."""
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > _ROUNDED or np.linalg.det(matrix) < 0:
        raise ConfigError(f"{where}: its matrix is no rotation, but mirrored or damaged")
    return from_matrix(matrix)


def _placed(turn: Floats, shift: Floats, where: str) -> Rigid:
    """Return the pose of a camera; ``turn`` and ``shift``, m, bring the room into its frame."""
    pose = Rigid(turn, shift).inverse()
    if (apart := float(np.linalg.norm(pose.translation))) > _FARTHEST_M:
        raise ConfigError(
            f"{where}: stands {apart:.4g} m from the origin, so its unit is another one: calibrate "
            "with a board in m, or divide all translations (mm: by 1000)"
        )
    return pose


def _with_lens(
    name: str, size: Any, matrix: Any, distortion: Any, fisheye: Any, pose: Rigid | None, where: str
) -> LensAndPose:
    """Return a camera with a lens; raises ConfigError if it is none."""
    width, height = _numbers(size, (2,), f"{where}: size should be width and height, px")
    square = _numbers(matrix, (9,), f"{where}: matrix should be 3 x 3 numbers").reshape(3, 3)
    fault = f"{where}: distortions should be 4, 5, 8, 12 or 14 numbers, or 4 of a fisheye lens"
    found = _numbers(distortion, (0, 4, 5, 8, 12, 14), fault)
    if fisheye and len(found) > 4 and not found[4:].any():
        found = found[:4]
    if fisheye and len(found) != 4:
        raise ConfigError(fault)
    model = FISHEYE if fisheye else PLUMB_BOB if len(found) <= 5 else RATIONAL
    lens = Intrinsics((round(width), round(height)), square, found, model)
    if lens.fault:
        raise ConfigError(f"{where}: {lens.fault}")
    return LensAndPose(name, lens, pose)


def _qualisys(path: Path) -> Iterator[LensAndPose]:
    text = read_text(path)
    try:
        if "<!ENTITY" in text:  # nothing but an attack
            raise ElementTree.ParseError("it defines entities")
        nodes = [*ElementTree.fromstring(text).iter("camera")]  # noqa: S314
    except ElementTree.ParseError as error:
        raise ConfigError(f"{path}: not a calibration of Qualisys: {error}") from None
    for node in nodes:
        name = node.get("serial", "")
        where = f"{path}: {name}"
        place, lens, view = (
            {} if (found := node.find(part)) is None else found.attrib
            for part in ("transform", "intrinsic", "fov_video_max")
        )
        if not lens:  # a camera that only sees markers
            continue
        if (turned := node.get("viewrotation", "0")) != "0":
            raise ConfigError(
                f"{where}: its video is turned by {turned} degrees (viewrotation), and the lens is "
                "of the image before; write the lens of the turned image as TOML"
            )
        fault = f"{where}: has no lens or no pose; export the calibration again"
        axes = [place.get(f"r{row}{column}") for row in (1, 2, 3) for column in (1, 2, 3)]
        rotation = _QCA_AXES @ _numbers(axes, (9,), fault).reshape(3, 3)
        centre = _numbers([place.get(axis) for axis in "xyz"], (3,), fault) / 1000.0
        names = [f"{part}{axis}" for part in ("focalLength", "centerPoint") for axis in "UV"]
        fx, fy, cx, cy = _numbers([lens.get(n) for n in names], (4,), fault) / _SUBPIXELS
        names = [f"{kind}Distortion{k}" for kind in ("radial", "tangental") for k in (1, 2)]
        distortion = _numbers([lens.get(n) for n in (*names, "radialDistortion3")], (5,), fault)
        ends = [lens.get("sensorMaxU"), lens.get("sensorMaxV")]
        size = _numbers(ends, (2,), fault) // _SUBPIXELS + 1
        if view:
            size = _numbers([view.get("right"), view.get("bottom")], (2,), fault) + 1
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        pose = _placed(_turn(rotation, where), -rotation @ centre, where)
        yield _with_lens(name, size, matrix, distortion, False, pose, where)


def _ros(path: Path) -> LensAndPose:
    raw = read_yaml(path)
    try:
        size = [raw["image_width"], raw["image_height"]]
        matrix, distortion = (
            raw[key]["data"] for key in ("camera_matrix", "distortion_coefficients")
        )
        model = str(raw.get("distortion_model") or "plumb_bob")
    except (TypeError, KeyError, AttributeError, ValueError):
        raise ConfigError(
            f"{path}: not a camera_info of ROS: needs image_width, image_height, camera_matrix and "
            "distortion_coefficients"
        ) from None
    fisheye = model in ("equidistant", "fisheye")
    name = str(raw.get("camera_name") or path.stem)
    return _with_lens(name, size, matrix, distortion, fisheye, None, str(path))


def _numbers(values: Any, counts: tuple[int, ...], fault: str) -> Floats:
    """Return a flat array; raises ConfigError if it has not that many finite numbers."""
    try:
        numbers = np.asarray(values, np.float64).ravel()
    except (TypeError, ValueError):
        numbers = np.full(1, np.nan)
    if len(numbers) not in counts or not np.isfinite(numbers).all():
        raise ConfigError(fault)
    return numbers
