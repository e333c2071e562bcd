"""Keypoints of RGB cameras from files: with which lens, pose and joints they go into a log.

They become ``yolo_msgs/DetectionArray``, the only type of ROS with any number of joints and people
in px, beside a CameraInfo per camera and /tf_static.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.foreign_cameras import LensAndPose, read_calibration
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import read_extrinsics
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.channels import add_static_poses
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.detectors.body_models import BODY_MODELS, KEYPOINT_MODELS, body_model
from hiros_mcap.io.detectors.keypoint_messages import (
    add_camera_info,
    add_keypoint_channel,
    encode_detections,
)
from hiros_mcap.rays.keypoints import KeypointFrame, cleaned
from hiros_mcap.skeletons import Floats, Stamps

WORLD = "world"
_SHARES = 1.5
"""Coordinates up to this are shares of the image, not px."""
_BEYOND, _WITHIN = 1.1, 0.5
"""Of the image's size: keypoints reach farther, or only so far, if it is another image's."""
_SAME_LENGTH, _SAME_S = 0.05, 1.0
_PEOPLE = 500
"""Of whom the lengths of links are measured."""

Say = Callable[[str], object]


@dataclass(frozen=True)
class RgbSetup:
    """What nobody can read in files of keypoints."""

    calibration: Sequence[Path] = ()
    """Lenses, and poses unless ``extrinsics`` has them."""
    extrinsics: Path | None = None
    joints: str = ""
    """Model of the table; "" = by the number of joints."""
    rates: Mapping[str, float] = field(default_factory=dict)
    """Instants per second by camera; of "", those of all others."""
    starts: Mapping[str, float] = field(default_factory=dict)
    """s by camera, at which its time 0 lies after that of the others."""


class ImageSeries(NamedTuple):
    """What a detector found in the images of a camera."""

    path: Path
    camera: str
    joints: tuple[str, ...]
    stamps: Stamps
    """(T,) ns."""
    images: list[Floats]
    """(P, J, 3) px and scores, as they are in the file."""
    is_counted: bool
    """Whether only the number of joints tells which they are."""

    def people(self) -> Floats:
        """(N, J, 2) px of everybody; NaN where a joint was not found."""
        both = np.concatenate(self.images)
        return cleaned(both[..., :2], both[..., 2])[0]

    def surest(self) -> Floats:
        """(N, 2) px of the better rated half of all keypoints.

        MediaPipe guesses where legs out of the image are, at two or three times its height.
        """
        scores = np.concatenate(self.images)[..., 2]
        found = self.people()
        seen = np.isfinite(found[..., 0])
        return found[seen & (scores >= np.median(scores[seen]))] if seen.any() else found[seen]


def of_camera(values: Mapping[str, float], camera: str) -> float | None:
    """Return the value of a camera, or that of all cameras; None if there is none."""
    own = [value for name, value in values.items() if name and _is_same(name, camera)]
    return own[0] if own else values.get("")


def check_named(setup: RgbSetup, cameras: Sequence[str]) -> None:
    """Raise ConfigError if a rate or a start is of a camera that is not imported."""
    for option, values in (("--rate", setup.rates), ("--start", setup.starts)):
        for name in filter(None, values):
            if not any(_is_same(name, camera) for camera in cameras):
                raise ConfigError(
                    f"{option} names {name}, not among the cameras {', '.join(cameras)}"
                )


def _is_same(name: str, other: str) -> bool:
    """Whether names mean one camera, as cam1_json and cam_01: one has the parts of the other."""
    parts = [
        [int(p) if p.isdecimal() else p for p in re.findall(r"[^\W\d_]+|\d+", text.lower())]
        for text in (name, other)
    ]
    short, long = sorted(parts, key=len)
    n = len(short)
    return bool(n) and any(long[k : k + n] == short for k in range(len(long) - n + 1))


def _matched(cameras: Sequence[str], known: Sequence[str], path: Path, note: Say) -> dict[str, str]:
    """Return the name in a file of each camera: by its name, else by the order."""
    found = [[k for k in known if k == c] or [k for k in known if _is_same(c, k)] for c in cameras]
    names = [choices[0] for choices in found if len(choices) == 1]
    if len(names) == len(set(names)) == len(cameras):
        return dict(zip(cameras, names, strict=True))
    if len(cameras) != len(known):
        raise ConfigError(
            f"{path}: has the cameras {', '.join(known)}, the keypoints are of "
            f"{', '.join(cameras)}; name files or folders as there, or as many in the same order"
        )
    pairs = ", ".join(f"{c} is {k}" for c, k in zip(cameras, known, strict=True))
    note(f"{path}: cameras are matched by their order: {pairs}")
    return dict(zip(cameras, known, strict=True))


def add_images(
    writer: McapWriter, series: Sequence[ImageSeries], setup: RgbSetup, warn: Say, note: Say
) -> Iterator[Iterator[tuple[int, int, bytes]]]:
    """Write lenses and poses; yield of each camera log time, channel and bytes of its messages."""
    if not series:
        return
    cameras = _with_lenses(series, setup, note)
    poses = _poses(cameras, setup, note)
    joints = {count: _joints(series, count, note) for count in {len(s.joints) for s in series}}
    first = min(int(s.stamps[0]) for s in series)
    if poses:
        add_static_poses(writer, poses, WORLD, first)
    _check_lengths(series, warn)
    for each, camera in zip(series, cameras, strict=True):
        lens = camera.lens
        assert lens is not None  # noqa: S101 - for the type
        add_camera_info(writer, f"/{camera.name}/camera_info", lens, camera.name, first)
        factor, shift = _pixels(each, camera.name, lens.size, warn, note)
        model = joints[len(each.joints)] if each.is_counted else _named(each.joints)
        channel = add_keypoint_channel(writer, f"/{camera.name}/keypoints", model)
        yield _messages(each, camera.name, channel, lens.size, factor, shift)


def _messages(
    series: ImageSeries,
    name: str,
    channel: int,
    size: tuple[int, int],
    factor: Floats,
    shift: Floats,
) -> Iterator[tuple[int, int, bytes]]:
    for stamp, image in zip(series.stamps.tolist(), series.images, strict=True):
        found = cleaned(
            factor * image[..., :2] + shift * (image[..., :2] != 0), image[..., 2], size
        )
        yield stamp, channel, encode_detections(KeypointFrame(name, stamp, stamp, *found), name)


def _with_lenses(series: Sequence[ImageSeries], setup: RgbSetup, note: Say) -> list[LensAndPose]:
    """Return the camera of each series, by the calibration."""
    if not setup.calibration:
        raise ConfigError(
            f"{series[0].path}: keypoints of images need the lenses of their cameras: name the "
            "calibration with --calibration (TOML, .qca.txt, or ROS' YAML)"
        )
    known: dict[str, LensAndPose] = {}
    for path in setup.calibration:
        cameras = read_calibration(path)
        if not any(camera.lens for camera in cameras):
            fault = "tells no lens" if cameras else "is no calibration of cameras"
            raise ConfigError(f"{path}: {fault}; hiros needs size, matrix and distortions of each")
        for camera in cameras:
            name = path.stem if camera.name in known else camera.name
            known[name] = camera._replace(name=name)
    lenses = [name for name, camera in known.items() if camera.lens]
    names = _matched([s.camera for s in series], lenses, setup.calibration[0], note)
    return [known[names[s.camera]] for s in series]


def _poses(cameras: Sequence[LensAndPose], setup: RgbSetup, note: Say) -> dict[str, Rigid]:
    """Return the poses of the cameras in the room, as far as files tell."""
    poses = {c.name: c.pose for c in cameras if c.pose is not None}
    if setup.extrinsics is not None:
        tree = read_extrinsics(setup.extrinsics)
        found = {child: child for _, _, child, _ in tree.static_poses()}
        names = _matched([c.name for c in cameras], [*found], setup.extrinsics, note)
        poses = {c: tree.lookup(name, tree.root(name), 0) for c, name in names.items()}
    if lacking := [c.name for c in cameras if c.name not in poses]:
        note(f"no pose of {', '.join(lacking)}; name a file with poses with --extrinsics")
    return poses


def _named(joints: tuple[str, ...]) -> str:
    """Return the model of the table with these joints, or else their names."""
    models = (name for name in BODY_MODELS if body_model(name).marker_names == joints)
    return next(models, ",".join(joints))


def _joints(series: Sequence[ImageSeries], count: int, note: Say) -> str:
    """Return which of the models with so many joints it is: that with the shortest links."""
    counted = [s for s in series if s.is_counted and len(s.joints) == count]
    names = [n for n in KEYPOINT_MODELS.get(count, ()) if body_model(n).n_markers == count]
    if not counted or len(names) < 2:
        return next((_named(s.joints) for s in counted), "")
    people = np.concatenate([s.people() for s in counted])
    people = people[:: max(len(people) // _PEOPLE, 1)]
    lengths = {}
    for name in names:
        parents, children = body_model(name).links.T
        apart = np.linalg.norm(people[:, parents] - people[:, children], axis=-1)
        lengths[name] = float(np.nanmean(apart)) if np.isfinite(apart).any() else np.inf
    model = min(names, key=lambda name: lengths[name])
    others = " or ".join(name for name in names if name != model)
    note(f"{count} keypoints are taken as {model}, not as {others}; --joints says which they are")
    return model


def _pixels(
    series: ImageSeries, name: str, size: tuple[int, int], warn: Say, note: Say
) -> tuple[Floats, Floats]:
    """Return factor and shift, (2,), by which the file's coordinates become px.

    Raises ConfigError if they are of another image than the lens.
    """
    surest, whole = series.surest(), np.array(size, np.float64)
    if not len(surest):
        warn(f"{series.path}: {name}: no keypoint was found in any image")
        return np.ones(2), np.zeros(2)
    low, high = np.percentile(surest, (1, 99), axis=0)
    if np.abs([low, high]).max() <= _SHARES:
        centred = low.min() < -_SHARES / 6  # OpenPose writes them from -1 to 1, too
        ends = "-1 to 1" if centred else "0 to 1"
        note(f"{name}: keypoints are shares of the image, {ends}; they become px of {_size(size)}")
        return (whole / 2, whole / 2) if centred else (whole, np.zeros(2))
    reach = f"keypoints reach to {high[0]:.0f}, {high[1]:.0f} px, and its lens is of {_size(size)}"
    if (high > _BEYOND * whole).any():
        turned = (high <= _BEYOND * whole[::-1]).all()
        remedy = "the video was turned" if turned else "the video has another size"
        raise ConfigError(f"{series.path}: {name}: {reach} px: {remedy}; calibrate these images")
    if (high < _WITHIN * whole).all():
        warn(f"{series.path}: {name}: {reach} px; if the video was made smaller, calibrate with it")
    return np.ones(2), np.zeros(2)


def _size(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def _check_lengths(series: Sequence[ImageSeries], warn: Say) -> None:
    """Warn if videos differ much in length: then one has another rate."""
    seconds = {s.camera: (s.stamps[-1] - s.stamps[0]) * 1e-9 for s in series}
    shortest, longest = min(seconds.values()), max(seconds.values())
    if longest - shortest > max(_SAME_S, _SAME_LENGTH * longest):
        lengths = ", ".join(f"{name} {length:.1f} s" for name, length in seconds.items())
        warn(
            f"videos are not equally long: {lengths}; if one has another rate, give it: --rate "
            f"{min(seconds, key=lambda name: seconds[name])}=50"
        )
