"""Scores of whole logs: every output channel against the truth, and what needs no truth."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

import hiros_schemas
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.evaluate.match import MATCH_DISTANCE, Matches, Track, match
from hiros_mcap.evaluate.scores import Scores, score_matches
from hiros_mcap.evaluate.smoothness import jitter, limb_variations
from hiros_mcap.evaluate.statistics import mean_of
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.evaluate.truth_files import load_truth
from hiros_mcap.io.channels import OUTPUT_PREFIX, OUTPUT_TOPICS, TRUTH_PREFIX, channels_of
from hiros_mcap.io.log import open_log, open_reader
from hiros_mcap.skeletons import Frame, SkeletonModel


@dataclass(frozen=True, slots=True)
class PersonSpan:
    """How long an id lives in a channel."""

    id: int
    seconds: float
    frames: int


@dataclass(frozen=True, slots=True)
class Consistency:
    """What a channel says about itself, without any truth."""

    frames: int
    people: tuple[PersonSpan, ...]
    limb_variation: float
    """Mean over people and links of the coefficient of variation of the length."""
    limbs: Mapping[str, float]
    """The same by link."""
    jitter: float
    """Mean norm of the second difference of joint positions between frames, mm."""
    jitters: Mapping[str, float] = field(default_factory=dict)
    """The same by joint."""


def has_outputs(path: str | os.PathLike[str]) -> bool:
    """Whether a log holds a channel that hiros wrote."""
    with open_reader(path) as reader:
        return any(fnmatchcase(c.topic, f"{OUTPUT_PREFIX}/*") for c in channels_of(reader))


def check_recording(path: str | os.PathLike[str]) -> None:
    """Raise LogError if a log holds results of hiros or a truth, but no detections."""
    with open_reader(path) as reader:
        groups = [c for c in channels_of(reader) if c.has_type(hiros_schemas.SKELETON_GROUP)]
    own = tuple(f"{prefix}/" for prefix in (OUTPUT_PREFIX, TRUTH_PREFIX))
    if groups and all(c.topic.startswith(own) for c in groups):
        fault = "holds results or a truth, but no detections; name the recording"
        raise LogError(fault, path=path)


def output_channels(path: str | os.PathLike[str], globs: Sequence[str] = ()) -> list[str]:
    """Topics of a log's output channels in the order of the stages, or those that globs name.

    Raises LogError if there is none.
    """
    if not globs and not has_outputs(path):
        raise LogError("holds no results of hiros; run `hiros process` first", path=path)
    with open_log(path, topics=list(globs) or [f"{OUTPUT_PREFIX}/*"], output_prefix="/none") as log:
        topics = [camera.channel.topic for camera in log.cameras]
    order = {topic: k for k, topic in enumerate(OUTPUT_TOPICS)}
    return sorted(topics, key=lambda topic: (order.get(topic, len(order)), topic))


def find_truth(path: str | os.PathLike[str], named: str | None = None) -> Truth | None:
    """Return the truth that the user names (a file, or a topic of the log), else the log's own.

    None if nothing was named and the log has no /truth channel.

    Raises LogError or ConfigError if what was named does not exist or cannot be read.
    """
    if named is not None and Path(named).is_file():
        return load_truth(named)
    if named is not None:
        if not named.startswith("/"):
            raise ConfigError(f"the truth {named!r} is neither a file nor a channel (/...)")
        return load_truth(path, named)
    with open_reader(path) as reader:
        own = any(info.topic.startswith(f"{TRUTH_PREFIX}/") for info in channels_of(reader))
    return load_truth(path) if own else None


def fused_topics(path: str | os.PathLike[str], truth: str | None) -> tuple[str, ...]:
    """Topics of the cameras to fuse when a camera of the log is the truth; () = all.

    A camera that is the reference must not be in what is compared with it (Lee 2022, section 2.3).

    Raises
    ------
    LogError
        The log cannot be read.
    ConfigError
        The truth is the only camera.
    """
    if truth is None or not truth.startswith("/"):
        return ()
    with open_log(path) as log:
        topics = tuple(camera.channel.topic for camera in log.cameras)
    others = tuple(topic for topic in topics if not fnmatchcase(topic, truth))
    if not others:
        raise ConfigError(f"{path}: no camera is left besides the truth {truth}")
    return () if others == topics else others


def read_channel(
    path: str | os.PathLike[str], topic: str
) -> tuple[list[Frame], SkeletonModel, dict[str, int]]:
    """Frames of an output channel, their model, and how many messages were skipped, by reason."""
    with open_log(path, topics=[topic], output_prefix="/none") as log:
        frames = list(log.frames())
        skipped: Counter[str] = Counter()
        for account in log.accounts.values():
            skipped.update(account.skipped)
        return frames, log.model, dict(skipped)


@dataclass(frozen=True, slots=True)
class ChannelResult:
    """A channel against the truth."""

    scores: Scores
    matches: Matches
    model: SkeletonModel
    skipped: Mapping[str, int]
    """Messages that gave no frame, by reason."""


def evaluate_log(
    path: str | os.PathLike[str],
    truth: Truth,
    globs: Sequence[str] = (),
    max_distance: float = MATCH_DISTANCE,
) -> dict[str, ChannelResult]:
    """Topic -> result of every output channel against the truth, in the order of the stages.

    Raises LogError or ConfigError if the log cannot be read, has no output channel, or shares no
    time or marker with the truth.
    """
    results = {}
    for topic in output_channels(path, globs):
        frames, model, skipped = read_channel(path, topic)
        try:
            matches = match(frames, truth.seen_by(model), max_distance)
            scores = score_matches(matches, truth, model)
            results[topic] = ChannelResult(scores, matches, model, skipped)
        except ValueError as error:
            raise LogError(str(error), path=path, topic=topic) from None
        except ConfigError as error:
            raise ConfigError(f"{path}: {topic}: {error}") from None
    return results


def consistency(frames: Sequence[Frame], model: SkeletonModel) -> Consistency:
    """Measure what needs no truth: limb constancy, jitter, how long ids live."""
    tracks: dict[int, Track] = {}
    for frame in frames:
        for row, person in frame.tracked():
            track = tracks.setdefault(person, Track())
            track.stamps.append(frame.stamp)
            track.poses.append(frame.positions[row])
    limbs, jitters = limb_variations(tracks.values(), model), jitter(tracks.values())
    return Consistency(
        frames=len(frames),
        people=tuple(
            PersonSpan(person, (t.stamps[-1] - t.stamps[0]) / 1e9, len(t.stamps))
            for person, t in sorted(tracks.items())
        ),
        limb_variation=mean_of(limbs),
        limbs={
            name: float(value)
            for name, value in zip(model.link_names, limbs, strict=True)
            if not np.isnan(value)
        },
        jitter=mean_of(jitters),
        jitters=dict(zip(model.marker_names, jitters.tolist(), strict=False)),
    )
