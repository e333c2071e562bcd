"""A log of skeletons as frames.

::

    with open_log("lab.mcap") as log:
        for frame in log.detections():
            ...

What a log is stands in :mod:`.opened_log`; here it is found out.
"""

from __future__ import annotations

import glob
import hashlib
import math
import os
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from threading import Event

import numpy as np

import hiros_schemas
from hiros_mcap.body.body_size import body_size
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import TransformTree, read_extrinsics
from hiros_mcap.errors import LogError, explained, naming
from hiros_mcap.io.bags import open_recording, transforms_beside
from hiros_mcap.io.camera_frames import (
    as_file_says,
    as_transforms_say,
    cameras_called,
    note_unused,
    transforms_of,
)
from hiros_mcap.io.channels import (
    OUTPUT_PREFIX,
    CameraChannel,
    ChannelInfo,
    channels_of,
    check_schema,
    is_selected,
    select_skeletons,
    skeleton_channels,
)
from hiros_mcap.io.codec import Decoder, ModelBuilder, OtherSkeletonError
from hiros_mcap.io.container import Batch, McapReader, Message, Records
from hiros_mcap.io.container.reader import MEMORY
from hiros_mcap.io.copied_channels import copied_channels
from hiros_mcap.io.detectors.conversion import (
    ENCODINGS,
    Selection,
    converted,
    is_of_other_detector,
    name_detections,
    of_people,
)
from hiros_mcap.io.detectors.keypoint_messages import is_keypoints
from hiros_mcap.io.detectors.rgb_keypoints import RGB_TOPIC, RgbRig
from hiros_mcap.io.log_accounts import DAMAGED, FAR_FUTURE, LATEST, STALE, Account
from hiros_mcap.io.log_times import mend_log_times
from hiros_mcap.io.opened_log import Log, Reading, span_of
from hiros_mcap.io.unread_channels import unread_cameras
from hiros_mcap.kernels.record_index import CHANNEL, START
from hiros_mcap.skeletons import Frame, SkeletonModel


def learn_model(
    reader: McapReader, channels: Collection[int]
) -> tuple[SkeletonModel, dict[int, Message]]:
    """Learn the skeleton model, and each channel's first message on the way.

    The first messages with people are enough when they hold every marker and link that the
    detectors claim to know; at worst, and while a channel shows nobody, the whole log is read. A
    message that is damaged, or contradicts the former ones, teaches nothing; whoever decodes it
    will say so. Raises OtherSkeletonError if the first skeletons of a channel contradict another
    channel.
    """
    learner = _Learner(set(channels))
    for records, rows in reader.runs(channels):
        part = records._replace(messages=records.messages[rows])
        for message in part.at(learner.new_in(part)):
            learner.take(message, reader.channels[message.channel_id].topic)
            if learner.done:
                break
        if learner.done:
            break
    model = learner.builder.build()
    if learner.fault and not model.n_markers:
        raise LogError(f"no message has a skeleton with markers; first error: {learner.fault}")
    return model, learner.first


class _Learner:
    """Learns the skeleton model from messages of some channels."""

    def __init__(self, channels: set[int]) -> None:
        self.builder = ModelBuilder()
        self.first: dict[int, Message] = {}
        self.fault = ""  # why the first message that teaches nothing does so
        self._channels = channels
        self._taught: set[int] = set()  # channels that have shown somebody
        self._decoder = Decoder(self.builder.build())

    @property
    def done(self) -> bool:
        """Whether no further message teaches anything."""
        return self.builder.complete and self._channels == self._taught & self.first.keys()

    def new_in(self, records: Records) -> list[int]:
        """Return which messages are the first of a channel, or do not fit the model so far."""
        channels, first = np.unique(records.messages[:, CHANNEL], return_index=True)
        places = zip(channels.tolist(), first.tolist(), strict=True)
        new = {k for i, k in places if i not in self.first}
        batch = Batch([records], None)
        for decoded in () if self.done else self._decoder.decode(batch):
            faulty = decoded.keys[list(decoded.faults), 2]  # where the messages start
            for ident, parts in zip(decoded.channels, decoded.parts, strict=True):
                if any(begin < end for *_, begin, end in parts):
                    self._taught.add(ident)
            new.update(np.flatnonzero(np.isin(records.messages[:, START], faulty)).tolist())
        return sorted(new)

    def take(self, message: Message, topic: str) -> None:
        """Learn from a message if it may hold anything new."""
        ident = message.channel_id
        is_known = self.builder.complete and ident in self._taught
        if ident not in self.first or not (is_known or self._reads(message)):
            try:
                if self.builder.add(message.data, topic):
                    self._taught.add(ident)
                self._decoder = Decoder(self.builder.build())
            except LogError as error:
                if isinstance(error, OtherSkeletonError) and ident not in self._taught:
                    raise OtherSkeletonError("the cameras have different skeletons") from None
                self.fault = self.fault or f"{topic}: {error.fault}"
        self.first.setdefault(ident, message)

    def _reads(self, message: Message) -> bool:
        """Whether a message has nothing that the model lacks; faster than learning it."""
        try:
            self._decoder.decode_message(message.data)
        except LogError:
            return False
        return True


__all__ = [
    "DAMAGED",
    "FAR_FUTURE",
    "STALE",
    "Account",
    "CameraChannel",
    "Log",
    "Reading",
    "Source",
    "open_groups",
    "open_log",
    "open_reader",
    "reading",
    "skeletons_of",
    "span_of",
]

Source = str | os.PathLike[str] | McapReader
"""A log: its path, or the open file, which then stays open."""


def open_log(
    path: Source,
    *,
    topics: Sequence[str] | None = None,
    extrinsics: str | os.PathLike[str] | None = None,
    fixed_frame: str | None = None,
    output_prefix: str = OUTPUT_PREFIX,
    recover: bool = False,
    memory: int = MEMORY,
    skeletons: Selection | None = None,
) -> Log:
    """Open a log and find out what is in it.

    Parameters
    ----------
    path : an MCAP file, a ROS 1 bag, a SQLite bag (.db3), or a rosbag2 folder; or one of them
        that is open (see :func:`open_reader`), so that several logs are read of one file.
    topics : globs of the skeleton channels to read (see channels.select_skeletons).
    extrinsics : file with the cameras' poses, instead of /tf_static and /tf.
    fixed_frame : frame of the results, instead of the root of the transforms.
    output_prefix : channels below it are results of hiros and not read.
    recover : read what can be read of a damaged MCAP file; ``Log.recovery`` says what is lost.
    memory : bytes that reading may take, about; see :class:`McapReader`.
    skeletons : skeleton model of the results and unit of the log's positions.

    Raises
    ------
    LogError
        the file is not a complete, undamaged MCAP or bag, or holds no skeletons; a camera's
        messages can all not be decoded.
    SchemaError
        a chosen channel's message definition is not that of SkeletonGroup.
    ConfigError
        the extrinsics file is wrong.
    """
    tree = None if extrinsics is None else read_extrinsics(Path(extrinsics))
    selects = partial(is_selected, topics=topics, output_prefix=output_prefix)
    selection = (skeletons or Selection())._replace(selects=selects)
    with ExitStack() as stack:
        if isinstance(path, McapReader):
            file = path
        else:
            file = stack.enter_context(open_reader(path, recover=recover, memory=memory))
        with naming(file.path):
            rig, doubt = selection.rig, list[str]()
            if rig is None:
                rig, doubt = _rgb_cameras(file, tree, selection)
            selection = selection._replace(rig=rig)
            reader = converted(file, selection)
            tree = tree if rig is None else rig.tree
            topics = _with_triangulated(topics, rig, reader)
        try:
            contents = skeletons_of(reader, tree, topics, output_prefix)
        except OtherSkeletonError:
            with naming(file.path):
                reader = converted(file, selection._replace(several=True))
            contents = skeletons_of(reader, tree, topics, output_prefix)
        except LogError as error:
            raise explained(error, file.warnings) from None
        if tree is not None and tree.negated and not selection.negate:
            negate = ",".join(_negated(tree, contents[0]))
            with naming(file.path):
                reader = converted(file, selection._replace(negate=negate))
            contents = skeletons_of(reader, tree, topics, output_prefix)
        if rig is not None:
            contents = _beside_others(*contents, rig.fixed_frame)
        if tree is not None and tree.source:
            note_unused(tree, contents[0], rig.homes.values() if rig else ())
        encodings = ("cdr",) if reader is file else ENCODINGS
        unread = [i for i in of_people(file, selects) if i.encoding not in encodings]
        owns_file = reader is not path
        if reader is file:
            stack.pop_all()
        known = {info.topic for info in unread} | set(rig.models if rig else ())
        unknown = (i for i in _not_taken(reader) if i.topic not in known)
        others = (i for i in unknown if is_keypoints(i) or not is_of_other_detector(i))
        strangers = tuple(unread_cameras(others, contents[0], selects))
        log = Log(reader, *contents, fixed_frame, unread, strangers, owns_file=owns_file)
        log.reader.warnings = (*log.reader.warnings, *doubt, *(rig.warnings if rig else ()))
        if tree is None:
            _look_beside(log)
        return log


def _beside_others(
    cameras: list[CameraChannel], model: SkeletonModel, tree: TransformTree, fixed: str
) -> tuple[list[CameraChannel], SkeletonModel, TransformTree]:
    """Give what RGB cameras see a frame of its own, so that it can be moved to the others."""
    if len(cameras) < 2:
        return cameras, model, tree
    own = {c.topic_frame: {0: Rigid.identity()} for c in cameras if c.channel.topic == RGB_TOPIC}
    cameras = [c.in_frame(c.topic_frame) if c.topic_frame in own else c for c in cameras]
    return cameras, model, tree.with_poses(own, fixed)


def _negated(tree: TransformTree, cameras: Sequence[CameraChannel]) -> Iterator[str]:
    """Yield which axes of which topics a file with poses negates."""
    for name, axis in tree.negated.items():
        yield from (f"{camera.channel.topic}={axis}" for camera in cameras_called(name, cameras))


def _not_taken(reader: McapReader) -> Iterator[ChannelInfo]:
    """Yield the channels whose messages are no SkeletonGroups, and did not become some."""
    groups = hiros_schemas.SKELETON_GROUP
    yield from (i for i in channels_of(reader) if not (i.has_type(groups) or is_keypoints(i)))
    for topic, (kind, n) in reader.left_out.items():
        yield ChannelInfo(-1, topic, "" if kind == "no type" else kind, "", n, {})


def _with_triangulated(
    topics: Sequence[str] | None, rig: RgbRig | None, reader: McapReader
) -> Sequence[str] | None:
    """Return the globs of skeletons: those that name keypoints only mean what these became."""
    infos = channels_of(reader)
    images = [info.topic for info in infos if is_keypoints(info)]
    if topics is None or not images:
        return topics
    others = [info.topic for info in skeleton_channels(reader)]

    def names(glob: str, channels: Iterable[str]) -> bool:
        return any(fnmatchcase(topic, glob) for topic in channels)

    kept = [glob for glob in topics if names(glob, others) or not names(glob, images)]
    return [*kept, *([RGB_TOPIC] if rig is not None else [])] or topics


def _rgb_cameras(
    reader: McapReader, tree: TransformTree | None, selection: Selection
) -> tuple[RgbRig | None, list[str]]:
    """Find out how RGB cameras stand; if they cannot be used beside others, say why.

    Raises LogError where there are no others.
    """
    from hiros_mcap.io.rgb_cameras import rgb_rig

    try:
        return rgb_rig(reader, tree, selection.selects, refine=selection.refine), []
    except LogError as error:
        others = [i for i in of_people(reader, selection.selects) if not is_keypoints(i)]
        if not others:
            raise
        return None, [f"RGB cameras are not used: {error.fault}"]


def with_rays(log: Log, topics: Collection[str], remark: str, *, refine: bool) -> Log:
    """Return the log with cameras whose depth is guessed taken as rays: triangulated together.

    Parameters
    ----------
    topics : of these cameras. remark : says so. refine : as of :func:`~.rgb_cameras.rgb_rig`.

    Raises LogError if fewer than two cameras see somebody, or their poses are not known.
    """
    from hiros_mcap.io.rgb_cameras import guessed_depth, rgb_rig, too_few

    wanted = {camera.channel.topic for camera in log.cameras}
    filmed = set(log.rig.models if log.rig else ()) | set(topics)
    guessing = [camera for camera in log.cameras if camera.channel.topic in topics]
    with naming(log.path):
        guessed = guessed_depth(log.reader, log.model, guessing)
        selects = (wanted | filmed).__contains__
        rig = rgb_rig(log.reader, log.transforms, selects, guessed, refine=refine)
        if rig is None:
            raise too_few(log.reader, sorted(topics), sorted(topics))
        rig = replace(rig, remarks=(remark, *rig.remarks))
        reader = converted(log.reader, Selection(selects=selects, rig=rig))
        kept = [glob.escape(topic) for topic in sorted(wanted - filmed)]
        cameras, model, tree = skeletons_of(reader, rig.tree, [*kept, RGB_TOPIC])
    reader.warnings = (*log.reader.warnings, *rig.warnings)
    return replace(log, reader=reader, cameras=cameras, model=model, transforms=tree)


def _look_beside(log: Log) -> None:
    """Let the log warn if it lacks transforms that another part of its recording has."""
    try:
        _ = log.fixed_frame
    except LogError:
        topics = (info.topic for info in log.channels if info.count)
        if not any(topic.endswith("/tf_static") for topic in topics):
            hint = transforms_beside(Path(log.path))
            log.reader.warnings = (*log.reader.warnings, *filter(None, [hint]))


def skeletons_of(
    reader: McapReader,
    tree: TransformTree | None,
    topics: Sequence[str] | None,
    output_prefix: str = OUTPUT_PREFIX,
) -> tuple[list[CameraChannel], SkeletonModel, TransformTree]:
    """Find out about the chosen channels: cameras, skeleton model, and transforms unless given.

    Raises as :func:`open_log` does.
    """
    with naming(reader.path):
        chosen = select_skeletons(channels_of(reader), topics, output_prefix)
        for info in chosen:
            check_schema(reader.schema(reader.channels[info.id]), info.topic)
        model, first = learn_model(reader, {info.id for info in chosen})
        decoder = Decoder(model)
        channels = [
            _camera(reader, info, decoder, first[info.id])
            if info.count
            else CameraChannel(info, {"": ""}, ())
            for info in chosen
        ]
        begin = min((message.log_time for message in first.values()), default=0)
        copies = copied_channels(reader, decoder, channels)
        channels = [camera for camera in channels if camera.channel.topic not in copies]
        cameras, known = _name_cameras(channels), tree
        if known is None:
            known, cameras = transforms_of(reader, min(begin, LATEST), cameras)
        elif known.source:
            cameras = as_file_says(cameras, known)
        else:
            cameras = as_transforms_say(cameras, known)
        for topic, original in copies.items():
            known.remark(f"{topic}: left out, a copy of {original}: it shows the same joints")
    return cameras, model, known


def open_reader(
    path: str | os.PathLike[str],
    *,
    recover: bool = False,
    memory: int = MEMORY,
) -> McapReader:
    """Open the container of a log of any kind, see :func:`open_log`; raises LogError.

    Of a bag and of a split recording, it has the skeletons and transforms. Log times that cannot be
    right are mended, see :mod:`.log_times`.
    """
    reader = open_recording(Path(path), recover=recover, memory=memory)
    try:
        mend_log_times(reader)
        name_detections(reader)
    except BaseException:
        reader.close()
        raise
    return reader


@contextmanager
def reading(source: Source) -> Iterator[McapReader]:
    """Yield the open file of a log; close it unless it was open before."""
    if isinstance(source, McapReader):
        yield source
        return
    with open_reader(source) as reader:
        yield reader


@contextmanager
def open_groups(source: Source) -> Iterator[McapReader]:
    """Yield a log as SkeletonGroups, also one of other detectors; raises LogError."""
    selects = partial(is_selected, topics=None, output_prefix=OUTPUT_PREFIX)
    with reading(source) as file, naming(file.path):
        groups = converted(file, Selection(selects=selects))
        try:
            yield groups
        finally:
            if groups is not file:
                groups.close()


def _camera(
    reader: McapReader, info: ChannelInfo, decoder: Decoder, first: Message
) -> CameraChannel:
    """Find out the names of a channel's cameras and frames from the first people on it.

    A message that shows nobody may name another frame, or none.
    """
    populated: list[Frame] = []
    empty: list[Frame] = []
    failed: LogError | None = None
    for message in _after(first, reader):
        try:
            decoded = decoder.decode_message(message.data, message.log_time)
        except LogError as error:
            failed = failed or error
            continue
        populated += (frame for frame in decoded if frame.n_people)
        empty = empty or decoded
        if any(frame.frame_id for frame in populated) or len(populated) > _NAMELESS:
            break
    if failed is not None and not (populated or empty):
        raise LogError(failed.fault, topic=info.topic)
    named = [frame for frame in populated if frame.frame_id] or populated[:1]
    sources = {frame.source: frame.source for frame in named or empty}
    frames = tuple({frame.frame_id.lstrip("/"): 0 for frame in named})
    size = body_size(np.concatenate([frame.positions for frame in named])) if named else math.nan
    stamps = ((f.log_time, max(*f.stamps.tolist(), 0) or f.stamp) for f in named)
    lag = next((logged - stamp for logged, stamp in stamps if stamp > 0), 0)
    begin = named[0].log_time if named else 0
    return CameraChannel(info, sources, frames, size, lag=lag, begin=begin)


_NAMELESS = 100  # people without a coordinate frame, after whom a channel is taken to name none


def _after(first: Message, reader: McapReader) -> Iterator[Message]:
    """Yield a channel's first message, already at hand, and only if it does not do the others."""
    yield first
    messages = reader.messages({first.channel_id})
    next(messages, None)
    yield from messages


def _name_cameras(channels: Sequence[CameraChannel]) -> list[CameraChannel]:
    """Name each camera by what its messages call it, or by its topic where that is not unique.

    Those that show nobody come last: the others are called as if they were not there.
    """
    owners = Counter(source for camera in channels if camera.frames for source in camera.sources)
    blind = Counter(source for camera in channels if not camera.frames for source in camera.sources)
    named = []
    for camera in channels:
        topic, alone = camera.channel.topic, len(camera.sources) == 1
        names = {
            source: source
            if source and owners[source] + (not camera.frames) * blind[source] == 1
            else topic
            if alone
            else f"{topic}:{source}"
            for source in camera.sources
        }
        named.append(replace(camera, sources=names))
    return named


@contextmanager
def digest_of(path: Path) -> Iterator[Future[str]]:
    """Find the SHA-256 of an input in a thread, as ``sha256sum`` prints it: a result names it so.

    It is "" for what cannot be read twice, such as a pipe. That of a folder is the hash of its
    files' contents one after the other, in the order of names.
    """
    stopped = Event()
    with ThreadPoolExecutor(1, thread_name_prefix="hiros-digest") as pool:
        try:
            yield pool.submit(_hash, path, stopped)
        finally:
            stopped.set()


def _hash(path: Path, stopped: Event) -> str:
    inside = sorted(path.rglob("*")) if path.is_dir() else [path]
    files = [file for file in inside if not file.is_dir()]
    if not all(file.is_file() for file in files):
        return ""
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb", buffering=0) as stream:
            while not stopped.is_set() and (block := stream.read(1 << 20)):
                digest.update(block)
    return digest.hexdigest()
