"""Keypoints of videos, as pose detectors write them to files, as a log of RGB cameras.

::

    import_keypoints(["cam1_json", "cam2_json"], "lab.mcap", ["Calib.toml"], {"": 60.0})

Sources are, per camera, a folder of OpenPose's JSON files, one per image (also of RTMPose, Pose2Sim
and AlphaPose), or AlphaPose's results; for all cameras at once, FreeMoCap's array of cameras,
images, joints and px, or a table with the columns time, camera, joint, u, v and score.
"""

from __future__ import annotations

import csv
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.body.foreign_cameras import LensAndPose, read_calibration
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.channels import add_static_poses
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.detectors.body_models import BODY_MODELS, body_model, joints_of
from hiros_mcap.io.detectors.keypoint_messages import (
    add_camera_info,
    add_keypoint_channel,
    encode_detections,
)
from hiros_mcap.io.joints.importing import RELATIVE_START, Warn, numbered_files
from hiros_mcap.io.joints.text_tables import text_of
from hiros_mcap.outside import parse
from hiros_mcap.rays.intrinsics import Intrinsics
from hiros_mcap.rays.keypoints import KeypointFrame, cleaned
from hiros_mcap.skeletons import SECOND, Floats
from hiros_mcap.wording import quantity

_WORLD = "world"
_BY_COUNT = {
    17: "coco-17", 18: "openpose-18", 23: "coco-23", 25: "openpose-25", 26: "halpe-26",
    33: "mediapipe-33", 133: "coco-23",
}  # fmt: skip
"""Number of joints in a file -> the model whose joints come first in it."""
_SHARES = 1.5  # px; keypoints that are all below are shares of the image
_BEYOND, _MANY = 1.05, 0.2  # of the image; of the keypoints
_COLUMNS = "time", "camera", "joint", "u", "v", "score"
_NOISE = {"json", "keypoints", "openpose", "alphapose", "pose", "results"}
"""Words in the name of a source that do not name the camera."""


class Film(NamedTuple):
    """What a detector found in the images of one camera."""

    name: str
    """As the source calls the camera."""
    images: list[tuple[float, Floats]]
    """Number of each image, or its time, s; and (P, J, 3) px and score of its people."""
    is_timed: bool = False


def import_keypoints(
    sources: Sequence[str | os.PathLike[str]],
    target: str | os.PathLike[str],
    calibrations: Sequence[str | os.PathLike[str]],
    rates: Mapping[str, float],
    *,
    starts: Mapping[str, float] | None = None,
    joints: str = "",
    warn: Warn = lambda text: None,
    note: Warn = lambda text: None,
) -> dict[str, int]:
    """Write keypoints as a log of RGB cameras; return its messages by topic.

    Parameters
    ----------
    sources : files and folders; see above. target : MCAP log to write.
    calibrations : of the cameras; see :mod:`hiros_mcap.body.foreign_cameras`.
    rates : camera -> images per second; "" is any other camera.
    starts : camera -> time of its first image, s, where videos do not begin together.
    joints : name of the joint model; "" tells it by the number of joints.
    warn, note : are called with what makes the log doubtful, and with what was taken as meant.

    Raises
    ------
    ConfigError
        a source, the calibration or an option is wrong, or they do not fit each other.
    LogError
        ``target`` cannot be written.
    """
    cameras = [c for path in calibrations for c in read_calibration(Path(path))]
    where = ", ".join(map(str, calibrations))
    films = [film for path in sources for film in _films(Path(path), cameras, warn)]
    pairs = _paired(films, cameras, where)
    model = _model_of([film for film, _ in pairs], joints, note)
    frames: dict[str, list[KeypointFrame]] = {}
    for film, camera in pairs:
        frames[camera.name] = list(_frames(film, camera, body_model(model).n_markers, rates, note))
    for name, seconds in (starts or {}).items():
        if name not in frames:
            raise ConfigError(f"--start: there is no camera {name!r}, only {', '.join(frames)}")
        shift = round(seconds * SECOND)
        frames[name] = [
            f._replace(stamp=f.stamp + shift, log_time=f.log_time + shift) for f in frames[name]
        ]
    counts = {name: len(every) for name, every in frames.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{name} {n}" for name, n in counts.items())
        note(f"cameras have different numbers of images: {listed}")
    if bare := [camera.name for _, camera in pairs if camera.pose is None]:
        warn(f"{where}: has no pose of {', '.join(bare)}; pass the poses with --extrinsics")
    return _write(Path(target), [camera for _, camera in pairs], frames, model)


def _write(
    target: Path, cameras: Sequence[LensAndPose], frames: Mapping[str, Sequence[KeypointFrame]],
    model: str,
) -> dict[str, int]:  # fmt: skip
    """Write lenses, poses and keypoints."""
    begin = min(frame.log_time for every in frames.values() for frame in every)
    with McapWriter(target) as writer:
        poses: dict[str, Rigid] = {c.name: c.pose for c in cameras if c.pose is not None}
        if poses:
            add_static_poses(writer, poses, _WORLD, begin)
        channels = {}
        for camera in cameras:
            name = camera.name
            add_camera_info(writer, f"/{name}/camera_info", lens_of(camera), name, begin)
            channels[name] = add_keypoint_channel(writer, f"/{name}/keypoints", model)
        ordered = sorted(
            (frame for every in frames.values() for frame in every),
            key=lambda frame: (frame.log_time, frame.camera),
        )
        for frame in ordered:
            data = encode_detections(frame, frame.camera)
            writer.write(channels[frame.camera], frame.log_time, data)
        writer.commit()
        return {writer.channels[ident].topic: n for ident, n in sorted(writer.counts.items())}


def lens_of(camera: LensAndPose) -> Intrinsics:
    """Return the lens of a calibration; raises ConfigError if it has none."""
    if camera.size is None or camera.matrix is None:
        raise ConfigError(f"{camera.name}: the calibration has no lens; calibrate it")
    return Intrinsics(camera.size, camera.matrix, camera.distortion, camera.model)


# -- what is in the files -------------------------------------------------------------------


def _films(path: Path, cameras: Sequence[LensAndPose], warn: Warn) -> Iterator[Film]:
    """Read a source."""
    suffix = path.suffix.lower()
    if path.is_dir():
        yield _folder(path, warn)
    elif suffix == ".json":
        yield _results(path)
    elif suffix == ".npy":
        yield from _array(path, [camera.name for camera in cameras])
    elif suffix == ".csv":
        yield from _table(path)
    else:
        raise ConfigError(
            f"{path}: keypoints are read from folders of JSON files, from JSON, .npy or CSV"
        )


def _folder(path: Path, warn: Warn) -> Film:
    """Read a folder of OpenPose's files; those that cannot be read are counted."""
    images, faults = [], list[str]()
    for number, file in numbered_files(path, is_time=True):
        try:
            content = parse(text_of(file), "JSON", file)
            people = [person["pose_keypoints_2d"] for person in content["people"]]
            images.append((float(number), _people(people, file)))
        except ConfigError as error:
            faults.append(str(error))
        except (KeyError, TypeError, ValueError):
            faults.append(f"{file}: has no people with pose_keypoints_2d")
    if not images:
        raise ConfigError(faults[0] if faults else f"{path}: holds no JSON file")
    if faults:
        n, total = quantity(len(faults), "file"), len(faults) + len(images)
        warn(f"{path}: {n} of {total} cannot be read and left out; the first: {faults[0]}")
    return Film(path.name, images)


def _people(people: Sequence[Any], where: object) -> Floats:
    """(P, J, 3) of lists of x, y, score, x, ...; raises ConfigError if they are none."""
    counts = {len(person) for person in people}
    if len(counts) > 1 or any(n % 3 for n in counts):
        raise ConfigError(f"{where}: people have different numbers of keypoints")
    return np.array(people, np.float64).reshape(len(people), -1, 3)


def _results(path: Path) -> Film:
    """Read AlphaPose's results: a list of people, each with the name of its image."""
    by_image: dict[float, list[Any]] = {}
    content = parse(text_of(path), "JSON", path)
    try:
        for person in content:
            digits = re.findall(r"\d+", str(person["image_id"]))
            by_image.setdefault(float(digits[-1]), []).append(person["keypoints"])
    except (KeyError, TypeError, IndexError):
        raise ConfigError(
            f"{path}: no results of AlphaPose: a list of people with image_id and keypoints"
        ) from None
    return Film(path.stem, [(n, _people(p, path)) for n, p in sorted(by_image.items())])


def _array(path: Path, names: Sequence[str]) -> Iterator[Film]:
    """Read FreeMoCap's array (cameras, images, joints, 2 or 3); cameras are in order."""
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ConfigError(f"{path}: no array of numpy: {error}") from None
    if values.ndim != 4 or values.shape[3] not in (2, 3) or values.shape[0] != len(names):
        shape = " x ".join(map(str, values.shape))
        raise ConfigError(
            f"{path}: {shape} numbers; keypoints have cameras x images x joints x 2 or 3, and the "
            f"calibration has {quantity(len(names), 'camera')}"
        )
    for name, film in zip(names, values.astype(np.float64), strict=True):
        scores = np.where(np.isfinite(film[..., :1]), 1.0, 0.0)
        points = np.concatenate([film[..., :2], scores], axis=-1)
        yield Film(name, [(float(k), image[None]) for k, image in enumerate(points)])


def _table(path: Path) -> Iterator[Film]:
    """Read a table with a row per joint."""
    rows = csv.DictReader(text_of(path).splitlines())
    if lacks := [name for name in _COLUMNS if name not in (rows.fieldnames or ())]:
        raise ConfigError(
            f"{path}: has no column {', '.join(lacks)}; keypoints have {', '.join(_COLUMNS)}, and "
            "person if there are several"
        )
    names: dict[str, int] = {}
    found: dict[str, dict[float, dict[str, dict[int, list[float]]]]] = {}
    for number, row in enumerate(rows, 2):
        try:
            values = [float(row[name]) for name in ("u", "v", "score")]
            image = found.setdefault(row["camera"], {}).setdefault(float(row["time"]), {})
        except (TypeError, ValueError):
            raise ConfigError(f"{path}: line {number}: {row} is no keypoint") from None
        joint = names.setdefault(row["joint"], len(names))
        image.setdefault(row.get("person") or "", {})[joint] = values
    order = _order_of(list(names), path)
    for camera, images in found.items():
        film = []
        for time, people in sorted(images.items()):
            points = np.full((len(people), 1 + max(order), 3), np.nan)
            for p, joints in enumerate(people.values()):
                for joint, values in joints.items():
                    points[p, order[joint]] = values
            film.append((time, points))
        yield Film(camera, film, is_timed=True)


def _order_of(names: Sequence[str], path: Path) -> list[int]:
    """Return the place of each joint in the model that has them all."""
    joints = joints_of(names)
    for count, model in _BY_COUNT.items():
        places = joints_of(body_model(model).marker_names)
        if len(names) == count and set(joints) <= set(places):
            return [places.index(joint) for joint in joints]
    raise ConfigError(
        f"{path}: no joint model of hiros has its {len(names)} joints: {', '.join(names[:12])}"
    )


# -- what they mean -------------------------------------------------------------------------


def _model_of(films: Sequence[Film], joints: str, note: Warn) -> str:
    """Return the joint model of all cameras."""
    counts = Counter(p.shape[1] for film in films for _, p in film.images if len(p))
    if not counts:
        raise ConfigError("nobody is in any image; check the detector")
    if len(counts) > 1:
        listed = ", ".join(map(str, sorted(counts)))
        raise ConfigError(f"the cameras have different numbers of joints: {listed}; import alike")
    (count,) = counts
    known = BODY_MODELS if joints else ()
    if joints and (joints not in known or body_model(joints).n_markers > count):
        fits = [name for name in BODY_MODELS if body_model(name).n_markers <= count]
        raise ConfigError(
            f"--joints: {joints!r} has not {count} joints; these may: {', '.join(fits)}"
        )
    if joints:
        return joints
    if count not in _BY_COUNT:
        raise ConfigError(
            f"no joint model of {count} joints is known, only of {', '.join(map(str, _BY_COUNT))}; "
            "name one by --joints"
        )
    model = _BY_COUNT[count]
    if count == 25 and _is_25b(films):
        model = "openpose-25b"
    note(f"{count} joints a person are taken for {model}; --joints says otherwise")
    return model


def _is_25b(films: Sequence[Film]) -> bool:
    """Whether 25 joints are of BODY_25B: which of two joints is in the middle of its neighbours."""
    points = np.concatenate([p for film in films for _, p in film.images if len(p)])
    places = np.where(points[..., 2:] > 0, points[..., :2], np.nan)

    def off(middle: int, one: int, other: int) -> float:
        away = np.linalg.norm(places[:, middle] - (places[:, one] + places[:, other]) / 2, axis=1)
        return float(np.nanmedian(away)) if np.isfinite(away).any() else np.inf

    return off(17, 5, 6) < off(8, 9, 12)  # neck between shoulders; hip centre between hips


def _paired(
    films: Sequence[Film], cameras: Sequence[LensAndPose], where: str
) -> list[tuple[Film, LensAndPose]]:
    """Return the camera of each film: by name, or in their order if the numbers agree."""
    keys = [_key(camera.name) for camera in cameras]
    pairs = []
    for film in films:
        same = [c for c, key in zip(cameras, keys, strict=True) if key == _key(film.name)]
        pairs += [(film, same[0])] if len(same) == 1 else []
    if len({c.name for _, c in pairs}) == len(films):
        return pairs
    if len(films) == len(cameras):
        return list(zip(films, cameras, strict=True))
    raise ConfigError(
        f"{where}: has the cameras {', '.join(c.name for c in cameras) or 'none'}; the "
        f"keypoints are of {', '.join(film.name for film in films)}; name them alike"
    )


def _key(name: str) -> tuple[str | int, ...]:
    """Return the words and numbers of a camera's name: cam1_json and Cam_01 are the same."""
    words = re.findall(r"[a-z]+|\d+", name.lower())
    return tuple(int(w) if w.isdigit() else w for w in words if w not in _NOISE)


def _frames(
    film: Film, camera: LensAndPose, joints: int, rates: Mapping[str, float], note: Warn
) -> Iterator[KeypointFrame]:
    """Yield the images of a camera with their times."""
    lens = lens_of(camera)
    rate = rates.get(camera.name, rates.get(film.name, rates.get("", 0.0)))
    if not film.is_timed and not rate > 0:
        raise ConfigError(f"{film.name}: how many images a second? Pass --rate, such as --rate 60")
    size = np.array(lens.size, np.float64)
    points = np.concatenate([p.reshape(-1, 3) for _, p in film.images])
    pixels = points[(points[:, 2] > 0) & np.isfinite(points).all(axis=1), :2]
    scale = np.ones(2)
    if len(pixels) and pixels.max() <= _SHARES:
        scale = size
        note(f"{film.name}: keypoints are taken for shares of the image of {lens.size} px")
    elif len(pixels) and np.mean((pixels > _BEYOND * size).any(axis=1)) > _MANY:
        raise ConfigError(
            f"{film.name}: keypoints reach to {pixels.max(axis=0).round()} px, beyond the image of "
            f"{lens.size} px of the calibration; calibrate at the size of the video"
        )
    for time, people in film.images:
        seconds = time if film.is_timed else time / rate
        stamp = round((RELATIVE_START + seconds) * SECOND)
        kept = people[:, :joints]
        yield KeypointFrame(
            camera.name, stamp, stamp, *cleaned(kept[..., :2] * scale, kept[..., 2], lens.size)
        )
