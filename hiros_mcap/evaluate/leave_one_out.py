"""Without a truth: fuse all cameras but one, and measure how far the one left out is from the rest.

This is neither the error nor a bound on it: it adds the camera's own noise and misses errors that
all cameras share. It compares cameras, joints and settings on one log. Clocks and poses are those
of ``hiros process``, which all cameras give together; ``input.poses=given`` keeps the log's poses.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.config import Config, load_config
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.logs import Consistency, consistency
from hiros_mcap.evaluate.match import match
from hiros_mcap.evaluate.reprojection import ImageScores, image_scores, reprojection
from hiros_mcap.evaluate.statistics import ErrorStats, mean_of, nan_mean, parts_of
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.io.log import Source
from hiros_mcap.io.rgb_cameras import poses_of
from hiros_mcap.progress import Bar, Progress
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.running.recording import Recording
from hiros_mcap.skeletons import Flags, Floats, Frame, Ints, SkeletonModel, Stamps


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A camera against what all others make of the scene; see :data:`measures.LEFT_OUT`, in mm."""

    topic: str
    detections: int
    unmatched: int
    mirrored: int
    """They count as they are: what is struck out where it contradicts a result would flatter the
    result that is wrong."""
    distance: ErrorStats
    spread: float  # detectors differ by centimetres all the time; systems differ in the rest
    offset: float
    parts: Mapping[str, ErrorStats]
    joints: Mapping[str, ErrorStats]


@dataclass(frozen=True, slots=True)
class SelfScores:
    """Scores of a log that need no truth: consistency, and each camera against the others."""

    consistency: Consistency  # of the result of all cameras, last stage
    cameras: tuple[LeftOut, ...]
    images: tuple[ImageScores, ...] = ()  # of the RGB cameras


@dataclass(slots=True)
class _Residuals:
    """R detections of a camera that match somebody."""

    stamps: Stamps
    people: Stamps  # (R,) row of the person in the result of the other cameras
    displacement: Floats  # (R, M, 3) detection minus reference, m
    mirrored: Flags
    unmatched: int
    detections: Stamps | Ints  # (R,) number of the detection among all of the camera


def leave_one_out(
    source: Source,
    *,
    config: Config | None = None,
    options: ProcessOptions | None = None,
    progress: Progress | None = None,
) -> SelfScores:
    """Score a recording against itself: run it once with all cameras, once without each.

    ``progress`` is told the runs.

    Raises ConfigError if there are fewer than two cameras' channels; LogError if the log cannot be
    read.
    """
    options = options or ProcessOptions()
    config = config or load_config(system=options.system)
    recording = Recording.read(source, config, options)
    model, frames_of = recording.model, frames_of_cameras(recording, 1 if recording.images else 2)
    everybody = _fused(recording, config, options, frames_of)
    cameras, _ = leave_each_out(recording, frames_of, config, options, progress)
    return SelfScores(
        consistency=consistency(everybody, model),
        cameras=cameras,
        images=_images(source, recording, everybody, config, options),
    )


def _images(
    source: Source, recording: Recording, everybody: Sequence[Frame], config: Config,
    options: ProcessOptions,
) -> tuple[ImageScores, ...]:  # fmt: skip
    """Return each RGB camera against the result of all, and that of the others if there are any.

    Poses and clocks are those that all cameras give together.
    """
    log, cameras = recording.prepared.log, recording.images
    poses = poses_of(cameras, log.transforms, log.fixed_frame)
    scores, rig = image_scores(cameras, poses, everybody, recording.model), log.rig
    if rig is None or (len(rig.lenses) < 3 and len(recording.topics) < 2):
        return scores
    names = {camera.topic: camera for camera in cameras}
    left_out = []
    for score in scores:
        camera = names[score.topic]
        lenses = {name: lens for name, lens in rig.lenses.items() if name != camera.name}
        others = Recording.read(source, config, options, replace(rig, lenses=lenses))
        frames = _fused(others, config, options, others.topics.values())
        found = reprojection(camera, poses[camera.name], frames, others.model)
        left_out.append(replace(score, left_out=found))
    return tuple(left_out)


def leave_each_out(
    recording: Recording, frames_of: Mapping[str, Sequence[Frame]], config: Config,
    options: ProcessOptions, progress: Progress | None = None,
) -> tuple[tuple[LeftOut, ...], list[Distances]]:  # fmt: skip
    """Return each camera against the result of the others, and its distances one by one.

    ``frames_of`` : as :func:`frames_of_cameras` returns it.
    """
    progress, model = progress or Bar(), recording.model
    cameras, distances = [], []
    if len(frames_of) < 2:
        return (), []
    for k, (topic, frames) in enumerate(frames_of.items(), start=1):
        progress.update(k, len(frames_of) + 1)
        others = _fused(recording, config, options, frames_of.keys() - {topic})
        left = _residuals(frames, others, model)
        varying = _varying(left.displacement, left.people)
        cameras.append(_left_out(topic, left, varying, model))
        distances.append(_distances(frames, left, varying))
    return tuple(cameras), distances


def frames_of_cameras(recording: Recording, least: int = 2) -> dict[str, list[Frame]]:
    """Topic -> its detections; raises ConfigError for fewer than ``least``."""
    frames_of: dict[str, list[Frame]] = {topic: [] for topic in recording.topics.values()}
    for frame in recording.frames():
        frames_of[recording.topics[frame.source]].append(frame)
    if len(frames_of) < least:
        path = recording.prepared.log.path
        raise ConfigError(f"{path}: leaving one camera out needs at least two cameras")
    return frames_of


def _fused(
    recording: Recording, config: Config, options: ProcessOptions, topics: Collection[str]
) -> list[Frame]:
    """Return the last stage's frames on some of the cameras."""
    sources = [name for name, topic in recording.topics.items() if topic in topics]
    (frames,) = recording.run(config, options, sources, last=True).values()
    return frames


def _left_out(topic: str, residuals: _Residuals, varying: Floats, model: SkeletonModel) -> LeftOut:
    distances = 1000 * np.linalg.norm(residuals.displacement, axis=-1)
    means = [mean_of(residuals.displacement[..., axis]) for axis in range(3)]
    return LeftOut(
        topic=topic,
        detections=len(residuals.stamps) + residuals.unmatched,
        unmatched=residuals.unmatched,
        mirrored=int(residuals.mirrored.sum()),
        distance=ErrorStats.of(distances),
        spread=1000 * mean_of(np.linalg.norm(varying, axis=-1)),
        offset=1000 * float(np.linalg.norm(means)),
        parts={
            part: ErrorStats.of(distances[:, columns]) for part, columns in parts_of(model).items()
        },
        joints=ErrorStats.by_name(model.marker_names, distances),
    )


def _distances(frames: Sequence[Frame], residuals: _Residuals, varying: Floats) -> Distances:
    """Distances at all detections of a camera, matched or not."""
    counts = [len(frame.ids) for frame in frames]
    stamps = np.repeat(np.array([frame.stamp for frame in frames], np.int64), counts)
    joints = np.full((len(stamps), residuals.displacement.shape[1]), np.nan, np.float32)
    rest = joints.copy()
    joints[residuals.detections] = 1000 * np.linalg.norm(residuals.displacement, axis=-1)
    rest[residuals.detections] = 1000 * np.linalg.norm(varying, axis=-1)
    return Distances(stamps, joints, rest)


def _varying(displacement: Floats, people: Stamps) -> Floats:
    """(R, M, 3) Displacements without the median of each joint of each person, m."""
    varying = displacement.copy()
    for person in np.unique(people):
        rows = people == person
        for m in np.flatnonzero(~np.isnan(displacement[rows, :, 0]).all(axis=0)):
            varying[rows, m] -= np.nanmedian(displacement[rows, m], axis=0)
    return varying


def _residuals(frames: Sequence[Frame], fused: Sequence[Frame], model: SkeletonModel) -> _Residuals:
    """Match a camera's detections to what was fused, and subtract it."""
    anybody = any(len(frame.ids) for frame in fused)
    truth = Truth.of(fused or [Frame.empty(0, model)], model)
    matches = match(_numbered(frames) if anybody else [], truth)
    displacement = matches.poses - matches.true_poses
    swapped = matches.poses[:, symmetry_of(model).mirror] - matches.true_poses
    size, size_swapped = (nan_mean(np.linalg.norm(d, axis=-1), -1) for d in (displacement, swapped))
    rows = matches.stamps, matches.people, displacement, size_swapped < size
    return _Residuals(*rows, matches.false, matches.ids)


def _numbered(frames: Sequence[Frame]) -> Iterator[Frame]:
    """Yield the frames of a camera with the numbers of its detections as ids."""
    first = 0
    for frame in frames:
        count = len(frame.ids)
        yield frame.replace(ids=np.arange(first, first + count, dtype=np.int32))
        first += count


@dataclass(frozen=True, slots=True)
class Distances:
    """D detections of a camera against what a system makes of the others' views.

    Of a truth: what each true person is in each second, with M = 1.
    """

    stamps: Stamps  # (D,) ns
    joints: npt.NDArray[np.float32]
    """(D, M) distance of each joint, mm; NaN where the system has nobody there, or no such joint.
    Left and right are as the camera has them."""
    varying: npt.NDArray[np.float32]
    """(D, M) the same without the constant displacement of each joint of a person, mm."""
