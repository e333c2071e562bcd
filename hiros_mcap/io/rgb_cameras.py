"""The RGB cameras of a log: their lenses, the keypoints of their images, and where they stand."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import groupby, pairwise
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.body.transforms import TransformTree
from hiros_mcap.errors import LogError
from hiros_mcap.io.camera_frames import (
    as_file_says,
    as_transforms_say,
    cameras_called,
    transforms_of,
)
from hiros_mcap.io.channels import CameraChannel, ChannelInfo, channels_of
from hiros_mcap.io.codec import Decoder
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.detectors.conversion import source_of
from hiros_mcap.io.detectors.keypoint_messages import (
    decode_keypoints,
    is_keypoints,
    joined,
    joint_model,
    lateness,
)
from hiros_mcap.io.detectors.rgb_keypoints import NO_LENS, RgbRig, keypoints_of_guess
from hiros_mcap.io.log_accounts import LATEST
from hiros_mcap.io.ros_messages import CAMERA_INFO, SeenLenses, open_messages
from hiros_mcap.rays.keypoints import KeypointFrame
from hiros_mcap.rays.rig_refinement import MOST_S, STRETCHES, RayRig, refine_rig
from hiros_mcap.rays.skeleton_rays import LENS, NONE_GUESSED, GuessedDepth, looking_at
from hiros_mcap.skeletons import SECOND, SkeletonModel

_EVER = (0, 2**63 - 1)
_POOR_PX = 25.0  # median reprojection error beyond which poses, lenses or sizes are wrong
_SHAPE_PX = 10.0
"""Median distance up to which poses stay as given where depths are guessed: so is the shape of the
body. It errs by as much from each side, and would turn the cameras by some tenths of a degree."""


class RgbCamera(NamedTuple):
    """An RGB camera and what a detector found in its images."""

    topic: str  # of its keypoints
    name: str  # its optical frame
    lens: Intrinsics
    model: SkeletonModel  # of the joints; only their names and links count
    frames: list[KeypointFrame]  # in the order of the log


def read_rgb_cameras(
    reader: McapReader, span: tuple[int, int] = _EVER, step: int = 0,
    selects: Callable[[str], bool] = lambda _: True, guessed: GuessedDepth = NONE_GUESSED,
) -> list[RgbCamera]:  # fmt: skip
    """Read all cameras of a log that have keypoints and a lens; messages that are damaged are not.

    Those with ``guessed`` depth need no lens.

    Parameters
    ----------
    span : log times, ns, between which images are read. step : ns; of each camera, one image in
        each such interval is read; 0 = all. selects : says of a topic whether it is read.

    Raises LogError if the log cannot be read.
    """
    infos = _channels(reader, selects, guessed)
    known = _lenses(reader).lenses if infos else {}
    lenses = known | dict.fromkeys(guessed.turns, LENS)
    cameras: dict[str, RgbCamera] = {}
    for info in infos:
        model = guessed.models.get(info.topic) or joint_model(info)
        for name, frames in _frames_of(reader, info, model, lenses, guessed, span, step).items():
            if name not in lenses:
                continue
            camera = RgbCamera(info.topic, name, lenses[name], model, [])
            cameras.setdefault(name, camera).frames.extend(frames)
    return [camera._replace(frames=_together(camera.frames)) for camera in cameras.values()]


def _channels(
    reader: McapReader, selects: Callable[[str], bool], guessed: GuessedDepth
) -> list[ChannelInfo]:
    """Return the wanted channels of keypoints, and those whose depth is guessed."""
    infos = (info for info in channels_of(reader) if info.count and selects(info.topic))
    return [info for info in infos if is_keypoints(info) or info.topic in guessed.models]


def _together(frames: list[KeypointFrame]) -> list[KeypointFrame]:
    """Return one frame per image: some detectors have a topic per person."""
    if all(a.log_time <= b.log_time and a.stamp != b.stamp for a, b in pairwise(frames)):
        return frames
    in_order = sorted(frames, key=lambda f: f.stamp)
    return [joined(*same) for _, same in groupby(in_order, key=lambda f: f.stamp)]


def _frames_of(
    reader: McapReader, info: ChannelInfo, model: SkeletonModel, lenses: Mapping[str, Intrinsics],
    guessed: GuessedDepth, span: tuple[int, int], step: int,
) -> dict[str, list[KeypointFrame]]:  # fmt: skip
    """Read a channel of keypoints: optical frame -> images."""
    source, decoder = source_of(reader, info, selected=True), Decoder(model)
    frames: dict[str, list[KeypointFrame]] = {}
    due, late = span[0], round(lateness(info) * SECOND)
    for message in reader.messages({info.id}):
        if not due <= message.log_time <= span[1]:
            continue
        due = message.log_time + step
        with suppress(LogError):
            detected = source.message(message)
            if info.topic in guessed.models:
                skeletons = decoder.decode_message(detected.cdr, message.log_time)
                images = [keypoints_of_guess(frame, guessed) for frame in skeletons]
            else:
                images = [decode_keypoints(detected, model.n_markers, lenses)]
            for found in images:
                frame = found._replace(stamp=found.stamp - late)
                frames.setdefault(found.camera, []).append(frame)
    return frames


def guessed_depth(
    reader: McapReader, model: SkeletonModel, channels: Sequence[CameraChannel]
) -> GuessedDepth:
    """Find out where cameras look whose depth is guessed: towards the first people."""
    decoder, turns = Decoder(model), dict[str, Rigid]()
    for camera in channels:
        source = source_of(reader, camera.channel, selected=True)
        for message in reader.messages({camera.channel.id}):
            with suppress(LogError):
                for frame in decoder.decode_message(source.message(message).cdr):
                    name = frame.frame_id.lstrip("/")
                    if name not in turns and np.isfinite(frame.positions[..., 0]).any():
                        turns[name] = looking_at(frame.positions)
            if turns.keys() >= set(camera.frames):
                break
    return GuessedDepth(dict.fromkeys((c.channel.topic for c in channels), model), turns)


def _lenses(reader: McapReader) -> SeenLenses:
    """Return what a log tells of lenses."""
    seen = SeenLenses()
    with open_messages(reader) as messages:
        topics = [topic for topic, kind in messages.types.items() if kind == CAMERA_INFO]
        for raw in messages.read(topics):
            seen.take(raw.topic, raw.log_time, raw.data, partial(messages.decode, raw))
    return seen


def poses_of(
    cameras: Sequence[RgbCamera], transforms: TransformTree, fixed_frame: str
) -> dict[str, Rigid]:
    """Pose in the fixed frame of each camera whose optical frame is joined to it, by its name."""
    poses = {}
    for camera in cameras:
        with suppress(LogError):
            poses[camera.name] = transforms.lookup(camera.name, fixed_frame, 0)
    return poses


# -- how they stand --------------------------------------------------------------------------------


def rgb_rig(
    reader: McapReader, tree: TransformTree | None, selects: Callable[[str], bool],
    guessed: GuessedDepth = NONE_GUESSED, *, refine: bool = True,
) -> RgbRig | None:  # fmt: skip
    """Find out how the RGB cameras of a log stand; None if it has no keypoints.

    Parameters
    ----------
    tree : the cameras' poses, of a file; None = those of the log.
    selects : says of a topic whether its keypoints are wanted.
    guessed : 3D skeletons that count as keypoints.
    refine : whether poses are those that the people tell, where these are better.

    Raises
    ------
    LogError
        no two cameras have a lens and a pose, or nobody is seen by two.
    ConfigError
        a file with poses lacks a camera.
    """
    infos = _channels(reader, selects, guessed)
    if not infos:
        return None
    cameras = sampled_cameras(reader, selects, guessed)
    if len(cameras) < 2:
        raise too_few(reader, [i.topic for i in infos], [c.topic for c in cameras])
    known, channels = placed_cameras(reader, tree, cameras)
    fixed = known.common_root([channel.frames[0] for channel in channels])
    turns = {camera.name: guessed.turns.get(camera.name, Rigid.identity()) for camera in cameras}
    poses = {
        camera.name: known.lookup(channel.frames[0], fixed, 0) @ turns[camera.name]
        for camera, channel in zip(cameras, channels, strict=True)
    }
    given = _given_lags(known, cameras, channels)
    late = {c.name: round(given.get(c.name, 0.0) * SECOND) for c in cameras}
    frames = {c.name: [f._replace(stamp=f.stamp - late[c.name]) for f in c.frames] for c in cameras}
    lenses = {c.name: c.lens for c in cameras}
    found = refine_rig(frames, lenses, poses, clocks=not given)
    _check_poses(found, frames, lenses, poses, cameras[0].model)
    if guessed.models and not found.reason and _worst(found.before) < _SHAPE_PX:
        found = found._replace(reason="bodies that are guessed tell no better ones")
    is_moved = refine and not found.reason
    seen = _lenses(reader)
    homes = {c.name: channel.frames[0] for c, channel in zip(cameras, channels, strict=True)}
    if is_moved:
        moved = {homes[n]: {0: pose @ turns[n].inverse()} for n, pose in found.poses.items()}
        known = known.with_poses(moved, fixed)
    lags = {c.name: given.get(c.name, 0.0) + found.lags.get(c.name, 0.0) for c in cameras}
    return RgbRig(
        known, fixed, lenses, seen.faults,
        {i.topic: guessed.models.get(i.topic) or joint_model(i) for i in infos}, homes, lags,
        {c.topic: lags[c.name] for c in cameras}, is_moved,
        tuple(_remarks(found, is_moved)), tuple(_warnings(found, seen, cameras, is_moved)),
        guessed,
    )  # fmt: skip


def sampled_cameras(
    reader: McapReader, selects: Callable[[str], bool], guessed: GuessedDepth = NONE_GUESSED
) -> list[RgbCamera]:
    """Read the images that tell how cameras stand: of a long log, some stretches."""
    idents = {info.id for info in _channels(reader, selects, guessed)}
    chunks = [c for c in reader.contents.chunks if c.holds(idents) and c.start_time <= LATEST]
    begin = min((c.start_time for c in chunks), default=0)
    end = max((c.end_time for c in chunks), default=0)
    length = int(MOST_S * SECOND / STRETCHES)
    if end - begin <= MOST_S * SECOND:
        return read_rgb_cameras(reader, selects=selects, guessed=guessed)
    cameras: dict[str, RgbCamera] = {}
    for k in range(STRETCHES):
        first = begin + (end - begin) * k // STRETCHES
        span = first, first + length
        for camera in read_rgb_cameras(reader, span, selects=selects, guessed=guessed):
            cameras.setdefault(camera.name, camera._replace(frames=[])).frames.extend(camera.frames)
    return list(cameras.values())


def placed_cameras(
    reader: McapReader, tree: TransformTree | None, cameras: Sequence[RgbCamera]
) -> tuple[TransformTree, list[CameraChannel]]:
    """Return the transforms, and the cameras in the frames that these have for them."""
    infos = {info.topic: info for info in channels_of(reader)}
    channels = [CameraChannel(infos[c.topic], {c.name: c.name}, (c.name,)) for c in cameras]
    if tree is None:
        begin = min((f.log_time for c in cameras for f in c.frames[:1]), default=0)
        return transforms_of(reader, min(begin, LATEST), channels)
    return tree, (as_file_says if tree.source else as_transforms_say)(channels, tree)


def _given_lags(
    tree: TransformTree, cameras: Sequence[RgbCamera], channels: Sequence[CameraChannel]
) -> dict[str, float]:
    """Optical frame -> s by which stamps are late, as a file with poses says."""
    names = {channel.channel.topic: c.name for c, channel in zip(cameras, channels, strict=True)}
    stated = {name: lateness(c.channel) for c in channels for name in (names[c.channel.topic],)}
    return {name: late for name, late in stated.items() if late} | {
        names[channel.channel.topic]: -seconds
        for name, seconds in tree.clocks.items()
        for channel in cameras_called(name, channels)
    }


def too_few(reader: McapReader, topics: Sequence[str], lensed: Sequence[str]) -> LogError:
    """Return the error of a log without two RGB cameras that can be used."""
    if bare := [topic for topic in topics if topic not in lensed]:
        why = "; ".join(_lenses(reader).faults.values()) or NO_LENS
        return LogError(
            f"{', '.join(bare)}: keypoints without a lens: {why}, or import them with --calibration"
        )
    return LogError(
        f"{', '.join(topics)}: one RGB camera alone does not tell where people are; record two or "
        "more that see them from different sides"
    )


def _check_poses(
    found: RayRig, frames: Mapping[str, Sequence[KeypointFrame]],
    lenses: Mapping[str, Intrinsics], poses: Mapping[str, Rigid], model: SkeletonModel,
) -> None:  # fmt: skip
    """Raise LogError if poses or images fit only when they are read the other way round."""
    worst = _worst(found.before)
    if worst < _POOR_PX:
        return

    def fits(frames: Mapping[str, Sequence[KeypointFrame]], poses: Mapping[str, Rigid]) -> str:
        other = _worst(refine_rig(frames, lenses, poses, clocks=False).before)
        return f"{other:.0f} px" if other < min(_POOR_PX, worst / 2) else ""

    if px := fits(frames, {name: pose.inverse() for name, pose in poses.items()}):
        raise LogError(
            "the poses of the RGB cameras are the other way round: those of the room in the camera "
            f"would fit the people to {px}; invert them"
        )
    poor = [name for name, error in found.before.items() if error > _POOR_PX]
    for names in (poor, list(frames)):
        if names and (px := fits(_mirrored(frames, lenses, names, model), poses)):
            raise LogError(
                f"the images of {', '.join(names)} are mirrored: the other way round they fit to "
                f"{px}; run the detector on the video as the camera saw it (ffmpeg's hflip turns "
                "it back)"
            )
    if math.isinf(worst):
        raise LogError(
            "no two RGB cameras see the same person, by their poses and lenses; check both, or "
            "find the poses by `hiros calibrate people`"
        )


def _mirrored(
    frames: Mapping[str, Sequence[KeypointFrame]], lenses: Mapping[str, Intrinsics],
    names: Sequence[str], model: SkeletonModel,
) -> dict[str, Sequence[KeypointFrame]]:  # fmt: skip
    """Mirror the images of some cameras, and with them the sides of people."""
    sides = symmetry_of(model).mirror
    turned: dict[str, Sequence[KeypointFrame]] = dict(frames)
    for name in names:
        start, step = np.array([lenses[name].size[0] - 1.0, 0.0]), np.array([-1.0, 1.0])
        turned[name] = [
            f._replace(pixels=(start + step * f.pixels)[:, sides], scores=f.scores[:, sides])
            for f in frames[name]
        ]
    return turned


def _worst(errors: Mapping[str, float]) -> float:
    """Return the largest of the errors that are known, px; infinite if none is."""
    known = [error for error in errors.values() if not math.isnan(error)]
    return max(known, default=math.inf)


def _in_px(errors: Mapping[str, float]) -> str:
    return ", ".join(f"{error:.1f}" for error in errors.values())


def _remarks(found: RayRig, is_moved: bool) -> Iterator[str]:
    """Say what is done with the poses and clocks, and how well they fit."""
    names = ", ".join(found.poses)
    if is_moved:
        yield (
            f"poses of RGB cameras ({names}) come from the people: keypoints lie nearer to their "
            f"joints, at the median {_in_px(found.before)} -> {_in_px(found.after)} px"
        )
    else:
        why = f": {found.reason}" if found.reason else ""
        yield f"poses of RGB cameras ({names}) stay as given{why}; {_in_px(found.before)} px"
    late = {name: lag for name, lag in found.lags.items() if abs(lag) >= 1e-3}
    if late:
        lags = ", ".join(f"{name} {1e3 * lag:+.0f} ms" for name, lag in late.items())
        yield f"clocks of RGB cameras, found from the people: {lags}"


def _warnings(
    found: RayRig, seen: SeenLenses, cameras: Sequence[RgbCamera], is_moved: bool
) -> Iterator[str]:
    """Yield reasons to doubt the skeletons of RGB cameras."""
    yield from (seen.changes[c.name] for c in cameras if c.name in seen.changes)
    errors = found.after if is_moved else found.before
    poor = [name for name, error in errors.items() if error > _POOR_PX]
    if poor:
        yield (
            f"{', '.join(poor)}: keypoints lie {_in_px({n: errors[n] for n in poor})} px from the "
            "joints that the RGB cameras find together; check pose, lens and image size"
        )
    if found.regular:
        yield (
            "people move so regularly that the clocks of the RGB cameras may be a step apart; let "
            "somebody clap or change direction, or pass their clocks with --extrinsics FILE"
        )
