"""Without any truth: fuse all cameras but one, and see how far the one left out is from that.

The camera's own noise is in the number, so it is an upper bound of the error of the rest; what it
is good for is comparing cameras, joints and settings on one's own log.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.config import Config
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.logs import Consistency, consistency, output_channels, read_channel
from hiros_mcap.evaluate.match import match
from hiros_mcap.evaluate.parts import parts_of
from hiros_mcap.evaluate.scores import ErrorStats, mean_of
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.io.log import open_log
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.skeletons import Floats, Frame, SkeletonModel

SIMULTANEOUS_NS = 50_000_000
"""Views of two cameras are compared when they are at most this far apart."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A camera against what all others make of the scene."""

    topic: str
    detections: int
    """Skeletons that the camera reports while the others see anybody."""
    unmatched: int
    """Of these, how many nobody is near to."""
    mirrored: int
    """Of these, how many fit better with left and right swapped; not in the errors below."""
    error: ErrorStats
    median: float
    """Of the joint distances, mm."""
    offset: float
    """Norm of the mean displacement over all joints, mm: mostly error of the extrinsics."""
    parts: Mapping[str, ErrorStats]
    joints: Mapping[str, ErrorStats]


@dataclass(frozen=True, slots=True)
class SelfScores:
    """What a log says about itself."""

    consistency: Consistency
    """Of the result of all cameras, last stage."""
    cameras: tuple[LeftOut, ...]
    disagreement: Mapping[tuple[str, str], float]
    """Median distance between the same joint in two cameras at one time, mm; both against the
    result of all, which takes the motion between their exposures out."""


@dataclass(slots=True)
class _Residuals:
    """Detections of a camera that are of somebody."""

    stamps: npt.NDArray[np.int64]
    people: npt.NDArray[np.int64]
    displacement: Floats
    """(R, M, 3) detection minus reference, m."""
    mirrored: npt.NDArray[np.bool_]
    unmatched: int


def leave_one_out(
    source: str | os.PathLike[str],
    *,
    config: Config | None = None,
    options: ProcessOptions | None = None,
) -> SelfScores:
    """Score a recording against itself: process it once with all cameras, once without each.

    Raises
    ------
    ConfigError
        There are fewer than two cameras' channels.
    LogError
        The log cannot be read.
    """
    config, options = config or Config(), options or ProcessOptions()
    detections, model = _detections(source, config, options)
    if len(detections) < 2:
        raise ConfigError(f"{source}: leaving one camera out needs two channels of detections")
    everybody = _fused(source, config, options, list(detections))
    cameras = []
    for topic, frames in detections.items():
        others = [other for other in detections if other != topic]
        cameras.append(_left_out(topic, frames, _fused(source, config, options, others), model))
    residuals = {
        topic: _residuals(frames, everybody, model) for topic, frames in detections.items()
    }
    return SelfScores(
        consistency=consistency(everybody, model),
        cameras=tuple(cameras),
        disagreement={
            (a, b): _disagreement(residuals[a], residuals[b])
            for a, b in combinations(detections, 2)
        },
    )


def _detections(
    source: str | os.PathLike[str], config: Config, options: ProcessOptions
) -> tuple[dict[str, list[Frame]], SkeletonModel]:
    """Topic -> detections in the fixed frame."""
    with open_log(
        source,
        topics=options.topics or None,
        extrinsics=options.extrinsics,
        fixed_frame=config.input.fixed_frame or None,
    ) as log:
        topic_of = {
            name: camera.channel.topic for camera in log.cameras for name in camera.sources.values()
        }
        found: dict[str, list[Frame]] = {topic: [] for topic in dict.fromkeys(topic_of.values())}
        for frame in log.detections():
            found[topic_of[frame.source]].append(frame)
        return found, log.model


def _fused(
    source: str | os.PathLike[str], config: Config, options: ProcessOptions, topics: Sequence[str]
) -> list[Frame]:
    """Return the last stage's frames on some of the cameras."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mcap"
        escaped = tuple(_literal(topic) for topic in topics)
        process(source, out, config=config, options=replace(options, topics=escaped, keep=()))
        return read_channel(out, output_channels(out)[-1])[0]


def _literal(topic: str) -> str:
    """Return a glob that matches just this topic."""
    return "".join(f"[{c}]" if c in "*?[" else c for c in topic)


def _left_out(
    topic: str, frames: Sequence[Frame], fused: Sequence[Frame], model: SkeletonModel
) -> LeftOut:
    found = _residuals(frames, fused, model)
    displacement = found.displacement[~found.mirrored]
    errors = 1000 * np.linalg.norm(displacement, axis=-1)
    known = errors[~np.isnan(errors)]
    joints = {name: ErrorStats.of(errors[:, k]) for k, name in enumerate(model.marker_names)}
    means = [mean_of(displacement[..., axis]) for axis in range(3)]
    return LeftOut(
        topic=topic,
        detections=len(found.stamps) + found.unmatched,
        unmatched=found.unmatched,
        mirrored=int(found.mirrored.sum()),
        error=ErrorStats.of(errors),
        median=float(np.median(known)) if known.size else np.nan,
        offset=1000 * float(np.linalg.norm(means)),
        parts={part: ErrorStats.of(errors[:, own]) for part, own in parts_of(model).items()},
        joints={name: joint for name, joint in joints.items() if joint.count},
    )


def _residuals(frames: Sequence[Frame], fused: Sequence[Frame], model: SkeletonModel) -> _Residuals:
    """Match a camera's detections to what was fused, and subtract it."""
    empty = np.zeros(0, np.int64)
    none = _Residuals(empty, empty, np.zeros((0, model.n_markers, 3)), np.zeros(0, bool), 0)
    if not any(len(frame.ids) for frame in fused):
        return none
    named = (f.replace(ids=np.arange(len(f.ids), dtype=np.int32)) for f in frames)
    matches = match(named, Truth.of(fused, model))
    if not matches.poses:
        none.unmatched = matches.false
        return none
    poses, reference = np.stack(matches.poses), np.stack(matches.true_poses)
    displacement = poses - reference
    swapped = poses[:, symmetry_of(model).mirror] - reference
    size, size_swapped = (_mean_norm(d) for d in (displacement, swapped))
    return _Residuals(
        np.array(matches.stamps, np.int64),
        np.array(matches.people, np.int64),
        displacement,
        size_swapped < size,
        matches.false,
    )


def _mean_norm(displacement: Floats) -> Floats:
    """(R,) Mean length over the joints that are known."""
    norms = np.linalg.norm(displacement, axis=-1)
    known = ~np.isnan(norms)
    total = np.where(known, norms, 0.0).sum(axis=-1)
    return np.asarray(total / np.maximum(known.sum(axis=-1), 1))


def _disagreement(a: _Residuals, b: _Residuals) -> float:
    """Median distance, mm, between joints that two cameras see at one time."""
    distances = []
    for person in np.intersect1d(a.people, b.people):
        mine = np.nonzero((a.people == person) & ~a.mirrored)[0]
        theirs = np.nonzero((b.people == person) & ~b.mirrored)[0]
        if not len(mine) or not len(theirs):
            continue
        after = np.clip(np.searchsorted(b.stamps[theirs], a.stamps[mine]), 1, len(theirs) - 1)
        if len(theirs) == 1:
            after[:] = 0
        near = np.where(
            a.stamps[mine] - b.stamps[theirs[after - 1]] < b.stamps[theirs[after]] - a.stamps[mine],
            theirs[after - 1],
            theirs[after],
        )
        close = np.abs(b.stamps[near] - a.stamps[mine]) <= SIMULTANEOUS_NS
        difference = a.displacement[mine[close]] - b.displacement[near[close]]
        distances.append(np.linalg.norm(difference, axis=-1).ravel())
    every = np.concatenate([np.zeros(0), *distances])
    every = every[~np.isnan(every)]
    return 1000 * float(np.median(every)) if every.size else np.nan
