"""Scores of whole logs: what of them is scored, with and without a truth."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path

import numpy as np

from hiros_mcap.config import Config, load_config
from hiros_mcap.defaults import DEFAULT_SYSTEM
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.evaluate.match import (
    MATCH_DISTANCE,
    Matches,
    match,
    tracks_of,
)
from hiros_mcap.evaluate.scores import EllipsoidCoverage, Scores, coverage_of, score_matches
from hiros_mcap.evaluate.smoothness import jitter, limb_variations
from hiros_mcap.evaluate.statistics import mean_of
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.evaluate.truth_files import check_only, load_truth
from hiros_mcap.io.channels import (
    CONFIG_ATTACHMENT,
    OUTPUT_PREFIX,
    OUTPUT_TOPICS,
    PROVENANCE,
    TRUTH_PREFIX,
    channels_of,
    is_ours,
    skeleton_channels,
)
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.detectors.keypoint_messages import is_keypoints
from hiros_mcap.io.log import Source, open_groups, open_log, reading, span_of
from hiros_mcap.io.marker_uncertainty import (
    UNCERTAIN_TOPIC,
    Deviations,
    deviations_of,
    read_uncertainty,
)
from hiros_mcap.outside import parse
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.running.recording import Recording
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.systems import system_names

_FIRST_MESSAGES = 100  # cameras of a channel that take turns are all among them


@dataclass(frozen=True, slots=True)
class PersonSpan:
    """How long an id lives in a channel."""

    id: int
    seconds: float
    frames: int


@dataclass(frozen=True, slots=True)
class Consistency:
    """Measures of a channel that need no truth, :data:`measures.CONSISTENCY`."""

    frames: int
    people: tuple[PersonSpan, ...]
    limb_variation: float
    limbs: Mapping[str, float]  # the same by link
    jitter: float
    jitters: Mapping[str, float] = field(default_factory=dict)  # the same by joint

    @property
    def n_people(self) -> int:
        """Number of ids."""
        return len(self.people)


@dataclass(frozen=True, slots=True)
class Channel:
    """The content of a channel of skeletons, in a log or after a run."""

    path: Path | str  # the log
    frames: Sequence[Frame]
    model: SkeletonModel
    skipped: Mapping[str, int] = field(default_factory=dict)
    """Messages that gave no frame, by reason."""
    deviations: Deviations = field(default_factory=dict)
    """Standard deviations that the channel states for its joints."""


@dataclass(frozen=True, slots=True)
class ChannelResult:
    """A channel against the truth."""

    scores: Scores
    matches: Matches
    model: SkeletonModel
    skipped: Mapping[str, int]  # messages that gave no frame, by reason
    coverage: EllipsoidCoverage | None = None
    """Whether its uncertainty is right; None if it states none."""


def has_outputs(source: Source) -> bool:
    """Whether a log holds a channel that hiros wrote."""
    with reading(source) as reader:
        return any(fnmatchcase(c.topic, f"{OUTPUT_PREFIX}/*") for c in channels_of(reader))


def check_recording(path: str | os.PathLike[str]) -> None:
    """Raise LogError if a log holds results of hiros or a truth, but no detections."""
    topics = _skeletons(path)
    if topics and all(map(is_ours, topics)):
        fault = "holds results or a truth, but no detections; name the recording"
        raise LogError(fault, path=path)


def has_cameras(source: Source) -> bool:
    """Whether a log holds skeletons of cameras, which can be processed."""
    return any(not is_ours(topic) for topic, count in _skeletons(source).items() if count)


def start_of(source: Source) -> int:
    """Time, ns, from which times of motion capture files count.

    It is the log time of the first skeleton of a camera. A result without its cameras is logged
    later than it was seen, so there it is the stamp of its first frame.
    """
    with reading(source) as reader:
        heard = [topic for topic, n in _skeletons(reader, [f"{OUTPUT_PREFIX}/*"]).items() if n]
        if not has_cameras(reader) and heard:
            return min(_first_stamp(reader, topic) for topic in heard)
        with open_groups(reader) as groups:
            return span_of(groups)[0]


def _first_stamp(reader: McapReader, topic: str) -> int:
    with open_log(reader, topics=[topic], output_prefix="/none") as log:
        return min(frame.stamp for frame in islice(log.frames(), _FIRST_MESSAGES))


def _skeletons(source: Source, globs: Sequence[str] = ("*",)) -> dict[str, int]:
    """Topic -> number of messages of the log's skeleton channels that a glob matches.

    The keypoints of RGB cameras count, too: they become skeletons.
    """
    with reading(source) as file, open_groups(file) as reader:
        channels = [*skeleton_channels(reader), *filter(is_keypoints, channels_of(file))]
    return {i.topic: i.count for i in channels if any(fnmatchcase(i.topic, g) for g in globs)}


def output_channels(source: Source, globs: Sequence[str] = ()) -> list[str]:
    """Topics of a log's output channels in the order of the stages, or those that globs name.

    Raises LogError if there is none.
    """
    with reading(source) as reader:
        if not globs and not has_outputs(reader):
            raise LogError("holds no results of hiros; run `hiros process` first", path=reader.path)
        topics = list(globs) or [f"{OUTPUT_PREFIX}/*"]
        with open_log(reader, topics=topics, output_prefix="/none") as log:
            return _in_order(camera.channel.topic for camera in log.cameras)


def _in_order(topics: Iterable[str]) -> list[str]:
    order = {topic: k for k, topic in enumerate(OUTPUT_TOPICS)}
    return sorted(topics, key=lambda topic: (order.get(topic, len(order)), topic))


def find_truth(source: Source, named: str | None = None) -> Truth | None:
    """Return the truth that the user names (a file, or a topic of the log), else the log's own.

    None if nothing was named and the log has no /truth channel.

    Raises LogError or ConfigError if what was named does not exist or cannot be read.
    """
    if named is not None and Path(named).is_file():
        return load_truth(named)
    if named is not None:
        if not named.startswith("/"):
            raise ConfigError(f"the truth {named!r} is neither a file nor a channel (/...)")
        return load_truth(source, named)
    with reading(source) as reader:
        has_truth = any(info.topic.startswith(f"{TRUTH_PREFIX}/") for info in channels_of(reader))
        return load_truth(reader) if has_truth else None


def fused_topics(source: Source, truth: str | None) -> tuple[str, ...]:
    """Topics of the cameras to fuse when a camera of the log is the truth; () = all.

    A camera that is the reference must not be in what is compared with it (Lee 2022, section 2.3).

    Raises LogError if the log cannot be read; ConfigError if the truth is the only camera, or is
    several.
    """
    if truth is None or not truth.startswith("/"):
        return ()
    with open_log(source) as log:
        topics = tuple(camera.channel.topic for camera in log.cameras)
        path = log.path
    others = tuple(topic for topic in topics if not fnmatchcase(topic, truth))
    check_only(path, truth, [topic for topic in topics if topic not in others])
    if not others:
        raise ConfigError(f"{path}: no camera is left besides the truth {truth}")
    return () if others == topics else others


def read_channel(source: Source, topic: str) -> tuple[list[Frame], SkeletonModel, dict[str, int]]:
    """Frames of an output channel, their model, and how many messages were skipped, by reason."""
    (channel,) = _read(source, [glob.escape(topic)]).values()
    return list(channel.frames), channel.model, dict(channel.skipped)


def read_results(source: Source, globs: Sequence[str] = ()) -> dict[str, Channel]:
    """Read all output channels, or those that globs name, in the order of the stages.

    A channel without any message is in there, too: it misses everybody.

    Raises LogError if the log cannot be read, or there is no such channel.
    """
    with reading(source) as reader:
        counts = _skeletons(reader, list(globs) or [f"{OUTPUT_PREFIX}/*"])
        topics = output_channels(reader, globs) if any(counts.values()) or not counts else []
        channels = _read(reader, list(map(glob.escape, topics))) if topics else {}
        model = next((one.model for one in channels.values()), SkeletonModel.of([], []))
        channels |= {topic: Channel(reader.path, [], model) for topic, n in counts.items() if not n}
        if UNCERTAIN_TOPIC in channels:
            stated = replace(channels[UNCERTAIN_TOPIC], deviations=read_uncertainty(reader))
            channels[UNCERTAIN_TOPIC] = stated
        return {topic: channels[topic] for topic in _in_order(channels)}


def _read(source: Source, globs: Sequence[str]) -> dict[str, Channel]:
    """Read some channels in one pass."""
    with open_log(source, topics=globs, output_prefix="/none") as log:
        frames: dict[str, list[Frame]] = {camera.channel.topic: [] for camera in log.cameras}
        read = log.read(fixed=False)
        for topics, block in read:
            for topic, frame in zip(topics, block.frames(), strict=True):
                frames[topic].append(frame)
        skipped = {topic: dict(read.accounts[topic].skipped) for topic in frames}
        return {
            topic: Channel(log.path, some, log.model, skipped[topic])
            for topic, some in frames.items()
        }


def evaluate_log(
    source: Source, truth: Truth, globs: Sequence[str] = ()
) -> dict[str, ChannelResult]:
    """Topic -> result of every output channel against the truth, in the order of the stages.

    Raises LogError or ConfigError if the log cannot be read, has no output channel, or shares no
    time or marker with the truth.
    """
    return evaluate_channels(read_results(source, globs), truth)


def evaluate_channels(
    channels: Mapping[str, Channel], truth: Truth, max_distance: float = MATCH_DISTANCE
) -> dict[str, ChannelResult]:
    """Topic -> result of every channel against the truth.

    Raises LogError or ConfigError if a channel shares no time or marker with the truth.
    """
    results = {}
    for topic, channel in channels.items():
        matches, model = _matched(topic, channel, truth, max_distance)
        try:
            scores = score_matches(matches, truth, model)
        except ValueError as error:
            raise LogError(str(error), path=channel.path, topic=topic) from None
        stated = channel.deviations
        covered = coverage_of(matches, stated, model) if stated else None
        results[topic] = ChannelResult(scores, matches, model, channel.skipped, covered)
    return results


def _matched(
    topic: str, channel: Channel, truth: Truth, max_distance: float
) -> tuple[Matches, SkeletonModel]:
    """Return the matches of a channel, and the model of the true and the matched skeletons."""
    if truth.model is not None and not channel.frames:
        return match([], truth, max_distance), truth.model
    try:
        seen = truth.seen_by(channel.model)
    except ConfigError as error:
        raise ConfigError(f"{channel.path}: {topic}: {error}") from None
    return match(channel.frames, seen, max_distance), seen.model or channel.model


def consistency(frames: Sequence[Frame], model: SkeletonModel) -> Consistency:
    """Measure what needs no truth: limb constancy, jitter, how long ids live."""
    tracks = tracks_of(frames)
    limbs, jitters = limb_variations(tracks.values(), model), jitter(tracks.values())
    return Consistency(
        frames=len(frames),
        people=tuple(
            PersonSpan(person, float(t.stamps[-1] - t.stamps[0]) / 1e9, len(t.stamps))
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


def check_scorable(log: Source, truth: str | None, *, has_truth: bool) -> None:
    """Refuse a log that holds neither a result nor cameras, or nothing to judge its result by.

    Raises ConfigError.
    """
    with reading(log) as reader:
        if has_cameras(reader):
            return
        path = reader.path
        if not has_truth:
            raise ConfigError(
                f"{path}: has no truth, and no cameras that could be left out; name a truth: "
                f"hiros eval {path} --truth FILE"
            )
        if truth is None and not has_outputs(reader):
            raise ConfigError(
                f"{path}: holds a truth but no result; name the result: "
                f"hiros eval RESULT --truth {path}"
            )


def results_of(
    log: Source,
    config: Config,
    truth: str | None = None,
    globs: Sequence[str] = (),
    system: str = DEFAULT_SYSTEM,
) -> dict[str, Channel]:
    """Return the channels that are scored, all outputs or those that globs name.

    They are in the log itself if it holds outputs, the truth in it if it holds no cameras either,
    else what a ``system`` makes of it.

    Raises LogError or ConfigError if the log cannot be processed.
    """
    with reading(log) as reader:
        if has_outputs(reader):
            return read_results(reader, globs)
        if not has_cameras(reader):
            return read_results(reader, globs or [f"{TRUTH_PREFIX}/*"])
        options = ProcessOptions(system, topics=fused_topics(reader, truth))
        recording = Recording.read(reader, config, options)
    results = recording.run(config, options)
    topics = {f"{OUTPUT_PREFIX}/{name}": name for name in results}
    if globs:
        topics = {t: n for t, n in topics.items() if any(fnmatchcase(t, g) for g in globs)}
    if not topics:
        named = ", ".join(globs)
        raise LogError(f"no channel of a run of {system} matches {named}", path=reader.path)
    channels = {
        topic: Channel(recording.prepared.log.path, results[name], recording.model)
        for topic, name in topics.items()
    }
    if UNCERTAIN_TOPIC in channels:
        last = channels[UNCERTAIN_TOPIC]
        stated = deviations_of(last.frames, last.model)
        channels[UNCERTAIN_TOPIC] = replace(last, deviations=stated)
    return channels


def settings_of(
    log: Source, config: Config, system: str, *, asked: bool
) -> tuple[Config, ProcessOptions]:
    """Return with what a log is run anew: a result with the settings that made it.

    ``config`` and ``system`` count for a recording, and if the user ``asked`` for them.

    Raises LogError or ConfigError if the settings in a result cannot be used.
    """
    with reading(log) as reader:
        facts = dict(reader.contents.metadata).get(PROVENANCE, {})
        name = facts.get("system", "")
        if asked or not name:
            return config, ProcessOptions(system)
        if name not in system_names():
            fault = f"its system {name} is not installed here; install it, or name a --system"
            raise LogError(fault, path=reader.path)
        text = (reader.attachment(CONFIG_ATTACHMENT) or b"").decode(errors="replace")
        table = parse(text, "TOML", f"{reader.path}: {CONFIG_ATTACHMENT}")
        return load_config(system=name, named={str(reader.path): table}), ProcessOptions(name)
