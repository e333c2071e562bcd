"""Scores of whole logs: every output channel against the truth, and what needs no truth."""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path

import numpy as np

import hiros_schemas
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.evaluate.ellipsoids import EllipsoidCoverage, coverage_of
from hiros_mcap.evaluate.match import MATCH_DISTANCE, Matches, Track, match
from hiros_mcap.evaluate.partial_truth import people_without_truth
from hiros_mcap.evaluate.scores import Scores, score_matches
from hiros_mcap.evaluate.smoothness import jitter, limb_variations
from hiros_mcap.evaluate.statistics import mean_of
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.evaluate.truth_files import load_truth
from hiros_mcap.io.channels import OUTPUT_PREFIX, OUTPUT_TOPICS, TRUTH_PREFIX, channels_of
from hiros_mcap.io.log import open_groups, open_log, open_reader, span_of
from hiros_mcap.io.marker_uncertainty import UNCERTAIN_TOPIC, read_uncertainty
from hiros_mcap.skeletons import Frame, SkeletonModel

_FIRST_MESSAGES = 100
"""Cameras of a channel that take turns are all among them."""


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
    topics = _skeletons(path)
    if topics and all(map(_is_ours, topics)):
        fault = "holds results or a truth, but no detections; name the recording"
        raise LogError(fault, path=path)


def has_cameras(path: str | os.PathLike[str]) -> bool:
    """Whether a log holds skeletons of cameras, which can be processed."""
    return any(not _is_ours(topic) for topic, count in _skeletons(path).items() if count)


def start_of(path: str | os.PathLike[str]) -> int:
    """Time, ns, from which times of motion capture files count.

    It is the log time of the first skeleton of a camera. A result without its cameras is logged
    later than it was seen, so there it is the stamp of its first frame.
    """
    with open_groups(path) as reader:
        start = span_of(reader)[0]
    if has_cameras(path):
        return start
    heard = [topic for topic, n in _skeletons(path, [f"{OUTPUT_PREFIX}/*"]).items() if n]
    return min((_first_stamp(path, topic) for topic in heard), default=start)


def _first_stamp(path: str | os.PathLike[str], topic: str) -> int:
    with open_log(path, topics=[topic], output_prefix="/none") as log:
        return min(frame.stamp for frame in islice(log.frames(), _FIRST_MESSAGES))


def _skeletons(path: str | os.PathLike[str], globs: Sequence[str] = ("*",)) -> dict[str, int]:
    """Topic -> number of messages of the log's skeleton channels that a glob matches."""
    with open_groups(path) as reader:
        channels = [i for i in channels_of(reader) if i.has_type(hiros_schemas.SKELETON_GROUP)]
    return {i.topic: i.count for i in channels if any(fnmatchcase(i.topic, g) for g in globs)}


def _is_ours(topic: str) -> bool:
    return topic.startswith((f"{OUTPUT_PREFIX}/", f"{TRUTH_PREFIX}/"))


def output_channels(path: str | os.PathLike[str], globs: Sequence[str] = ()) -> list[str]:
    """Topics of a log's output channels in the order of the stages, or those that globs name.

    Raises LogError if there is none.
    """
    if not globs and not has_outputs(path):
        raise LogError("holds no results of hiros; run `hiros process` first", path=path)
    with open_log(path, topics=list(globs) or [f"{OUTPUT_PREFIX}/*"], output_prefix="/none") as log:
        return _in_order(camera.channel.topic for camera in log.cameras)


def _in_order(topics: Iterable[str]) -> list[str]:
    order = {topic: k for k, topic in enumerate(OUTPUT_TOPICS)}
    return sorted(topics, key=lambda topic: (order.get(topic, len(order)), topic))


def _scored_channels(path: str | os.PathLike[str], globs: Sequence[str]) -> list[str]:
    """Topics to score, also of channels without any message: those miss everybody."""
    counts = _skeletons(path, list(globs) or [f"{OUTPUT_PREFIX}/*"])
    heard = output_channels(path, globs) if any(counts.values()) or not counts else []
    return _in_order({*heard, *(topic for topic, count in counts.items() if not count)})


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
    coverage: EllipsoidCoverage | None = None
    """Whether its uncertainty is right; None if it states none."""


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
    for topic in _scored_channels(path, globs):
        matches, model, skipped = _matched(path, topic, truth, max_distance)
        try:
            scores = score_matches(matches, truth, model)
        except ValueError as error:
            raise LogError(str(error), path=path, topic=topic) from None
        told = read_uncertainty(path) if topic == UNCERTAIN_TOPIC else {}
        covered = coverage_of(matches, told, model) if told else None
        results[topic] = ChannelResult(scores, matches, model, skipped, covered)
    return results


def covered_by(
    path: str | os.PathLike[str],
    truth: Truth,
    coverage: str = "auto",
    globs: Sequence[str] = (),
    max_distance: float = MATCH_DISTANCE,
) -> tuple[Truth, tuple[int, ...]]:
    """Return the truth, marked as partial or not, and the ids that show that it is partial.

    ``coverage`` is "all", "partial", or "auto": then the last output channel decides, see
    :func:`hiros_mcap.evaluate.partial_truth.people_without_truth`.

    Raises LogError or ConfigError as :func:`evaluate_log` does.
    """
    if coverage != "auto":
        return replace(truth, partial=coverage == "partial"), ()
    topic = _scored_channels(path, globs)[-1]
    matches, model, _ = _matched(path, topic, truth, max_distance)
    others = people_without_truth(matches, truth.seen_by(model), max_distance)
    return replace(truth, partial=bool(others)), others


def _matched(
    path: str | os.PathLike[str], topic: str, truth: Truth, max_distance: float
) -> tuple[Matches, SkeletonModel, dict[str, int]]:
    """Return the matches of a channel, its model, and how many messages were skipped, by reason."""
    if truth.model is not None and not _skeletons(path, [glob.escape(topic)])[topic]:
        return match([], truth, max_distance), truth.model, {}
    frames, model, skipped = read_channel(path, topic)
    try:
        seen = truth.seen_by(model)
        return match(frames, seen, max_distance), seen.model or model, skipped
    except ConfigError as error:
        raise ConfigError(f"{path}: {topic}: {error}") from None


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
