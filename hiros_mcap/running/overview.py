"""Overview of a log for somebody who sees it for the first time: any MCAP file, any bag."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hiros_mcap.config import load_config, presets_of, to_toml
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.bag_files import files_of, kind_of
from hiros_mcap.io.camera_clock import clocks_in_words
from hiros_mcap.io.channels import (
    EVENTS_ATTACHMENT,
    OUTPUT_PREFIX,
    OUTPUT_TOPICS,
    PROVENANCE,
    TRUTH_PREFIX,
    ChannelInfo,
    channels_of,
    skeleton_channels,
)
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.detectors.body_models import name_of
from hiros_mcap.io.detectors.conversion import Selection
from hiros_mcap.io.joining import channels_in, messages_in, open_part
from hiros_mcap.io.log import Log, Reading, open_log, open_reader
from hiros_mcap.io.log_times import NO_STAMP, StampPlace, place_of, times_of
from hiros_mcap.io.result import stored_parameters, stored_report, values_of
from hiros_mcap.io.rgb_cameras import RgbCamera, read_rgb_cameras
from hiros_mcap.running.observe import MessageRate
from hiros_mcap.systems import sections_of
from hiros_mcap.wording import plain, quantity

_GAP_S = 1.0

LogKind = Literal["recording", "result", "golden", "truth", "other"]
"""recording: skeletons to process. result: what `hiros process` wrote. golden: what `hiros check`
compares with. truth: true skeletons only. other: no skeletons that can be read."""


@dataclass(frozen=True, slots=True)
class ChannelRow:
    """A channel of the file."""

    topic: str
    type: str  # name of the schema, "" if there is none
    encoding: str
    messages: int
    rate_hz: float  # messages per second between the first and the last; NaN below two
    seconds: float
    """Time between the first and the last message, s; NaN without messages. Of results it is the
    time of the data, of all else the log time."""


@dataclass(frozen=True, slots=True)
class CameraRow:
    """A camera whose skeletons can be read."""

    name: str
    topic: str
    frame: str  # frame of its detections, "" if no message says
    fault: str  # why that frame cannot be expressed in the fixed frame, "" if it can
    frames: int  # messages with something new in them
    rate_hz: float  # frames per second of the camera's own time, gaps of more than 1 s left out
    longest_gap_s: float
    """Longest time, s, between two frames, or beyond 1 s before the first or after the last."""
    least_people: int
    most_people: int
    mean_people: float


@dataclass(frozen=True, slots=True)
class KeypointRow:
    """An RGB camera whose keypoints can be read."""

    topic: str
    camera: str  # its optical frame
    joints: str  # model of the joints
    images: int
    rate_hz: float  # images per second; NaN below two
    least_people: int
    most_people: int
    mean_people: float
    width: int
    height: int  # of the images, px


@dataclass(frozen=True, slots=True)
class PersonRow:
    """A person of a result or a truth."""

    topic: str
    id: int
    frames: int
    seconds: float  # time between the first and the last frame, s


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """A parameter that is not what the preset says."""

    name: str
    value: str  # as TOML
    default: str  # as TOML, "" if this version of hiros has no such parameter


@dataclass(frozen=True, slots=True)
class RunRow:
    """How a result came about, as far as the file tells."""

    version: str
    system: str
    stages: tuple[str, ...]
    preset: str  # the preset that explains most parameters, "" if the file does not hold them
    changed: tuple[ParameterRow, ...]  # parameters with other values than in that preset
    fixed_frame: str
    warnings: tuple[str, ...]  # warnings of the run


@dataclass(frozen=True, slots=True)
class Overview:
    """The whole log."""

    path: str
    kind: LogKind
    seconds: float
    """Time between the first and the last message, of the skeletons if there are any, s."""
    megabytes: float
    has_checksums: bool  # whether a damaged message would be noticed
    channels: tuple[ChannelRow, ...]
    people: tuple[PersonRow, ...] = ()
    """Of the last stage's channel, or of the truth in a file with nothing else."""
    run: RunRow | None = None  # how the results came about; None where there are none
    fault: str = ""  # why the log cannot be processed, "" if it can
    fixed_frame: str = ""  # frame that results would be in, "" if there is none
    cameras: tuple[CameraRow, ...] = ()
    keypoints: tuple[KeypointRow, ...] = ()
    markers: tuple[str, ...] = ()
    links: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()  # reasons to doubt results of the log, with their remedies
    remarks: tuple[str, ...] = ()  # notes about the log
    skipped: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    """Messages that give nothing, by topic and reason."""
    clocks: tuple[str, ...] = ()  # faults of the cameras' clocks, by the times of the messages

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; numbers that are not finite are None."""
        return plain(self)


def overview_of(
    path: str | os.PathLike[str],
    *,
    topics: Sequence[str] | None = None,
    extrinsics: str | os.PathLike[str] | None = None,
    skeletons: Selection | None = None,
) -> Overview:
    """Read a log from end to end and report what is in it.

    Parameters are those of :func:`hiros_mcap.io.log.open_log`. A log without skeletons that can
    be read has an overview, too: its ``fault`` says why. Frames that do not resolve are no error
    here but part of the answer.

    Raises
    ------
    LogError
        The file is damaged, or ``topics`` fits no channel.
    ConfigError
        ``extrinsics`` is wrong.
    """
    try:
        log = open_log(path, topics=topics, extrinsics=extrinsics, skeletons=skeletons)
    except LogError as error:
        if topics is not None:
            raise
        parts = files_of(Path(path)).parts
        if any(kind_of(part) for part in parts):
            return _of_bag(Path(path), parts, error.cause)
        with open_reader(path) as reader:
            overview = replace(_of_file(path, reader), fault=error.cause)
            return replace(overview, warnings=tuple(reader.warnings), remarks=tuple(reader.remarks))
    with log:
        return _with_cameras(_of_file(path, log.reader), log)


def _of_file(path: str | os.PathLike[str], reader: McapReader) -> Overview:
    """Report on a file, whether its skeletons can be processed or not."""
    channels, spans = channels_of(reader), _spans(reader)
    kind = _kind(reader)
    start = min((begin for begin, _ in spans.values()), default=0)
    end = max((end for _, end in spans.values()), default=0)
    return Overview(
        path=str(path),
        kind=kind,
        seconds=(end - start) / 1e9,
        megabytes=_size(Path(reader.path)) / 1e6,
        has_checksums=reader.has_checksums,
        channels=tuple(
            _channel_row((i.topic, i.schema), i.encoding, i.count, spans.get(i.id))
            for i in channels
        ),
        people=_people(reader) if kind in ("result", "golden", "truth") else (),
        run=_run(reader) if kind in ("result", "golden") else None,
        keypoints=tuple(_keypoint_rows(reader)),
    )


def _keypoint_rows(reader: McapReader) -> Iterator[KeypointRow]:
    """Yield a row for each RGB camera with a lens; damaged lenses are said elsewhere."""
    cameras: list[RgbCamera] = []
    with suppress(LogError):
        cameras = read_rgb_cameras(reader)
    for topic, name, lens, model, frames in cameras:
        people = [len(frame.pixels) for frame in frames] or [0]
        seconds = (frames[-1].stamp - frames[0].stamp) / 1e9 if frames else 0.0
        rate = (len(frames) - 1) / seconds if seconds > 0 else math.nan
        joints = name_of(model) or quantity(model.n_markers, "joint")
        mean = sum(people) / len(people)
        least, most = min(people), max(people)
        yield KeypointRow(topic, name, joints, len(frames), rate, least, most, mean, *lens.size)


def _with_cameras(overview: Overview, log: Log) -> Overview:
    """Add what is known of the cameras of a log whose skeletons can be read."""
    fixed, fault = _fixed_frame(log)
    reading = log.read(fixed=False)
    cameras = tuple(_camera_rows(reading, fixed))
    start, end = log.span
    strange = {info.topic for info in log.strangers}
    return replace(
        overview,
        channels=tuple(
            replace(row, type=f"{row.type} (not read)") if row.topic in strange else row
            for row in overview.channels
        ),
        seconds=(end - start) / 1e9,
        fault=fault,
        fixed_frame=fixed,
        cameras=cameras,
        markers=log.model.marker_names,
        links=log.model.link_names,
        warnings=log.warnings if fixed else (),
        remarks=(*log.remarks, *_notes(reading)),
        skipped={t: dict(account.skipped) for t, account in reading.accounts.items()},
        clocks=clocks_in_words(log.times(), start),
    )


def _notes(reading: Reading) -> Iterator[str]:
    """Yield what was odd in the messages."""
    for account in reading.accounts.values():
        if account.people and account.empty_at_first:
            n = quantity(account.empty_at_first, "message")
            yield f"{account.topic}: nobody is in view at the beginning, for {n}"
        yield from account.notes(reading.log.model.marker_names)


def _of_bag(path: Path, parts: Iterable[Path], fault: str) -> Overview:
    """Report on a bag without skeletons to process; raises LogError if it cannot be read."""
    stamps: dict[tuple[str, str, str], list[int]] = {}
    for name in parts:
        with open_part(name) as part:
            infos = channels_in(part)
            for info in infos:
                stamps.setdefault((info.topic, info.schema, info.encoding), [])
            for info, time, _ in messages_in(part, infos):
                stamps[info.topic, info.schema, info.encoding].append(time)
    times = [time for times_of in stamps.values() for time in times_of]
    return Overview(
        path=str(path),
        kind="other",
        seconds=(max(times) - min(times)) / 1e9 if times else 0.0,
        megabytes=_size(path) / 1e6,
        has_checksums=False,
        channels=tuple(
            _channel_row(
                (topic, kind),
                encoding,
                len(times_of),
                (min(times_of), max(times_of)) if times_of else None,
            )
            for (topic, kind, encoding), times_of in sorted(stamps.items())
        ),
        fault=fault,
    )


# The file


def _size(path: Path) -> int:
    """Bytes of a file, or of the files in a bag's folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def _kind(reader: McapReader) -> LogKind:
    """Tell what a file is by where its skeletons are, and who wrote it."""
    skeletons = [info.topic for info in skeleton_channels(reader)]
    results = [topic for topic in skeletons if topic in OUTPUT_TOPICS]
    true = [topic for topic in skeletons if topic.startswith(f"{TRUTH_PREFIX}/")]
    if results:
        ours = reader.contents.library.startswith("hiros")
        complete = reader.attachment(EVENTS_ATTACHMENT) is not None
        return "golden" if ours and not complete and len(results) == len(skeletons) else "result"
    if true and len(true) == len(skeletons):
        return "truth"
    return "recording" if skeletons else "other"


def _spans(reader: McapReader) -> dict[int, tuple[int, int]]:
    """Time, ns, of the first and the last message of every channel with messages.

    It is the log time, but for results that of the data: they are logged later, many at once.
    """
    spans: dict[int, tuple[int, int]] = {}
    places = {info.id: _place_of(reader, info) for info in channels_of(reader)}
    for batch in reader.batches():
        for records in batch.records:
            ids, log_times, stamps = times_of(records, places).T
            times = np.where(stamps > 0, stamps, log_times)
            for ident in np.unique(ids).tolist():
                of_channel = times[ids == ident]
                first, last = int(of_channel.min()), int(of_channel.max())
                before = spans.get(ident, (first, last))
                spans[ident] = min(before[0], first), max(before[1], last)
    return spans


def _place_of(reader: McapReader, info: ChannelInfo) -> StampPlace:
    """Return where the stamps of a channel's messages lie, if they are results."""
    is_result = info.topic.startswith(f"{OUTPUT_PREFIX}/")
    return (place_of(reader, info) if is_result else None) or NO_STAMP


def _channel_row(
    name: tuple[str, str], encoding: str, count: int, span: tuple[int, int] | None
) -> ChannelRow:
    """Return the row of a channel by its topic and type, and its first and last time, ns."""
    seconds = (span[1] - span[0]) / 1e9 if span else math.nan
    rate = (count - 1) / seconds if count > 1 and seconds > 0 else math.nan
    return ChannelRow(*name, encoding, count, rate, seconds)


# Results and truths


def _people(reader: McapReader) -> tuple[PersonRow, ...]:
    """People of the last stage, else of the truths."""
    topics = [info.topic for info in skeleton_channels(reader) if info.count]
    last = [topic for topic in OUTPUT_TOPICS if topic in topics][-1:]
    rows = []
    for topic in last or [topic for topic in topics if topic.startswith(f"{TRUTH_PREFIX}/")]:
        stamps: dict[int, list[int]] = {}
        with open_log(reader, topics=[topic], output_prefix="/none") as log:
            for frame in log.frames():
                for _, person in frame.tracked():
                    stamps.setdefault(person, []).append(frame.stamp)
        rows += [
            PersonRow(topic, person, len(times), (max(times) - min(times)) / 1e9)
            for person, times in sorted(stamps.items())
        ]
    return tuple(rows)


def _run(reader: McapReader) -> RunRow:
    """Read what a result says about itself; whatever is missing or odd stays empty."""
    facts = dict(reader.contents.metadata).get(PROVENANCE, {})
    system = facts.get("system", "")
    try:
        preset, changed = _changed(stored_parameters(reader), system)
    except ConfigError:
        preset, changed = "", ()
    return RunRow(
        version=facts.get("version", ""),
        system=system,
        stages=tuple(filter(None, facts.get("stages", "").split(","))),
        preset=preset,
        changed=changed,
        fixed_frame=facts.get("fixed_frame", ""),
        warnings=_stored_warnings(reader),
    )


def _stored_warnings(reader: McapReader) -> tuple[str, ...]:
    try:
        return stored_report(reader).warnings
    except LogError:
        return ()


def _changed(values: Mapping[str, str], system: str) -> tuple[str, tuple[ParameterRow, ...]]:
    """Find the preset that is nearest to the parameters of a run, and what differs from it.

    Raises ConfigError if the system is not installed here.
    """
    if not values:
        return "", ()
    rows: dict[str, tuple[ParameterRow, ...]] = {}
    for preset in presets_of(system):
        config = load_config(preset=preset, system=system)
        usual = values_of(to_toml(config, sections_of(system)), "")
        rows[preset] = tuple(
            ParameterRow(name, value, usual.get(name, ""))
            for name, value in values.items()
            if value != usual.get(name, "")
        )
    nearest = min(rows, key=lambda preset: len(rows[preset]))
    return nearest, rows[nearest]


# Cameras


def _fixed_frame(log: Log) -> tuple[str, str]:
    try:
        fixed = log.fixed_frame
        return fixed, "" if fixed else "no camera names a frame"
    except LogError as error:
        return "", error.fault


def _unresolved(log: Log, frame: str, fixed: str) -> str:
    """Return why ``frame`` does not resolve to ``fixed``, "" if it does."""
    try:
        log.transforms.lookup(frame, fixed or log.transforms.root(frame), 0)
    except LogError as error:
        return error.fault
    return "" if fixed or not frame else "no fixed frame"


def _camera_rows(reading: Reading, fixed: str) -> Iterator[CameraRow]:
    """Yield a row for each camera; those that sent nothing have a row, too."""
    log = reading.log
    topics = {
        name: (camera.channel.topic, next(iter(camera.frames), ""))
        for camera in log.cameras
        for name in camera.sources.values()
    }
    counts: dict[str, list[tuple[int, int]]] = {name: [] for name in topics}  # stamp, people
    logged: dict[str, tuple[int, int]] = {}  # first and last
    for frame in reading.frames():
        topic, named = topics.get(frame.source, ("", ""))
        topics[frame.source] = topic, named or frame.frame_id
        counts.setdefault(frame.source, []).append((frame.stamp, frame.n_people))
        first, _ = logged.get(frame.source, (frame.log_time, 0))
        logged[frame.source] = first, frame.log_time
    begin, end = log.span
    for name, (topic, frame_id) in topics.items():
        people = [n for _, n in counts[name]]
        if (fault := _unresolved(log, frame_id, fixed)) and not any(people):
            frame_id = fault = ""  # of a camera that shows nobody, nothing depends on its frame
        stamps, rate = np.sort([stamp for stamp, _ in counts[name]]), MessageRate()
        if len(stamps):
            rate.add(stamps)
        steps = [step / 1e9 for step in np.diff(stamps).tolist() if step]
        # A camera may begin late, or stop: what other cameras' log times show.
        first, last = logged.get(name, (begin, end))
        steps += [gap for gap in ((first - begin) / 1e9, (end - last) / 1e9) if gap > _GAP_S]
        yield CameraRow(
            name=name,
            topic=topic,
            frame=frame_id,
            fault=fault,
            frames=len(people),
            rate_hz=rate.hertz,
            longest_gap_s=max(steps, default=math.nan),
            least_people=min(people, default=0),
            most_people=max(people, default=0),
            mean_people=sum(people) / len(people) if people else math.nan,
        )
