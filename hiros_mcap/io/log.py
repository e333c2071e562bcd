"""A log of skeletons as Frames: container, codec and transforms joined.

::

    with open_log("lab.mcap") as log:
        for frame in log.detections():
            ...
"""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np

import hiros_schemas
from hiros_mcap.body.transforms import Mover, TransformTree, parse_tf, read_extrinsics
from hiros_mcap.errors import LogError
from hiros_mcap.frames import Block, frames_of
from hiros_mcap.io.bags import BagReader, kind_of
from hiros_mcap.io.channels import (
    OUTPUT_PREFIX,
    TF_TOPICS,
    ChannelInfo,
    channels_of,
    select_skeletons,
)
from hiros_mcap.io.codec import (
    Batch,
    BatchDecoder,
    Decoder,
    ModelBuilder,
    Poses,
    check_schema,
    clean,
)
from hiros_mcap.io.container import McapReader, Message, Records
from hiros_mcap.io.layout import Layout
from hiros_mcap.kernels.record_index import CHANNEL, START, STOP
from hiros_mcap.skeletons import Frame, People, SkeletonModel

STALE = "stale repeat"
DAMAGED = "cannot be decoded"


@dataclass(slots=True)
class Account:
    """What became of every message of a topic: read = used + skipped."""

    topic: str
    read: int = 0
    used: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    """Messages that gave no frame, by reason."""
    stale: int = 0
    """Skeletons left out because the camera had sent exactly them before."""
    cleaned: Counter[str] = field(default_factory=Counter)
    """Numbers taken out because they cannot be true, by kind (see codec.clean)."""
    untimed: int = 0
    """Frames without a time of their own, to which the log time was given."""
    first_error: str = ""
    """What was wrong with the first message that could not be decoded."""


@dataclass(frozen=True, slots=True)
class Camera:
    """A skeleton channel that is read."""

    channel: ChannelInfo
    layout: Layout
    sources: Mapping[str, str]
    """The name that each of its cameras goes by; usually there is one camera."""
    frames: tuple[str, ...]
    """Coordinate frames of its detections."""


class Log:
    """An open log; made by :func:`open_log`, used as a context manager.

    Attributes
    ----------
    path : the file.
    reader : its container.
    channels : every channel of the file.
    cameras : the skeleton channels that are read.
    model : the skeleton model of all cameras.
    transforms : where the cameras stand.
    accounts : what became of the messages, by topic; filled while ``frames`` runs.
    left_out : topics of a bag that are not in ``channels``, with their type and count.
    """

    def __init__(
        self,
        reader: McapReader,
        cameras: Sequence[Camera],
        model: SkeletonModel,
        transforms: TransformTree,
        fixed_frame: str | None,
    ) -> None:
        self.reader = reader
        self.path = reader.path
        self.left_out = reader.left_out if isinstance(reader, BagReader) else {}
        self.channels = channels_of(reader)
        self.cameras = tuple(cameras)
        self.model = model
        self.transforms = transforms
        self.strict = False
        self.accounts: dict[str, Account] = {}
        self._fixed_frame = fixed_frame

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self.reader.close()

    @cached_property
    def fixed_frame(self) -> str:
        """The frame that results are to be in: the root of the cameras' tree unless named.

        Raises LogError if the cameras' frames are not all joined to it.
        """
        frames = [name for camera in self.cameras for name in camera.frames]
        with _named(self.path):
            fixed = self._fixed_frame or self.transforms.common_root(frames)
            for name in frames:
                self.transforms.lookup(name, fixed, 0)
        return fixed

    @cached_property
    def span(self) -> tuple[int, int]:
        """Log times, ns, between which the skeletons lie; see :func:`span_of`."""
        return span_of(self.reader)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What nobody asked for but should know about the log."""
        return tuple(filter(None, (self._nameless(), self._left_out())))

    def _nameless(self) -> str:
        topics = [camera.channel.topic for camera in self.cameras if "" in camera.frames]
        if not topics:
            return ""
        unused = " and the log's transforms are not used" if len(self.transforms) else ""
        return (
            f"{len(topics)} channels name no coordinate frame ({', '.join(topics)}): their "
            f"skeletons are taken to be in one frame already{unused}"
        )

    def _left_out(self) -> str:
        topics = [f"{topic} ({kind}, {n})" for topic, (kind, n) in sorted(self.left_out.items())]
        return f"only in the bag, not taken over: {', '.join(topics)}" if topics else ""

    def frames(self) -> Iterator[Frame]:
        """Yield the detections of all cameras in the order of their log times.

        They are in the coordinates of the camera; ``frame_id`` says which. ``stamp`` is the
        latest source time of the people in it, or header.stamp where the detector gives none, or
        the log time; a time of 0 or before 1970 is none. A skeleton that repeats one of the
        camera's previous message in every number and in its source time is left out; a message of
        nothing else gives no frame.

        Raises LogError where the file is damaged. A message that cannot be decoded is counted in
        ``accounts`` and skipped, unless ``strict`` is set: then it is a LogError too.
        """
        for _, block in self._blocks(_Digest(self)):
            yield from block.frames()

    def detections(self) -> Iterator[Frame]:
        """Yield what :meth:`frames` does, in the fixed frame (Hi-ROS eq. 5).

        Raises LogError also for a frame that no transform joins to the fixed frame.
        """
        return frames_of(self.blocks())

    def detections_by_topic(self) -> Iterator[tuple[str, Frame]]:
        """Yield what :meth:`detections` does, each frame with its topic."""
        for topics, block in self._fixed_blocks():
            yield from zip(topics, block.frames(), strict=True)

    def blocks(self) -> Iterator[Block]:
        """Yield what :meth:`detections` does, some chunks' messages at once where that can be."""
        for _, block in self._fixed_blocks():
            yield block

    def _fixed_blocks(self) -> Iterator[tuple[Sequence[str], Block]]:
        """Yield the messages as blocks in the fixed frame, with the topic of each."""
        fixed = self.fixed_frame
        digest = _Digest(self, fixed)
        with _named(self.path):
            for topics, block in self._blocks(digest):
                if all(name == fixed for name in block.frame_ids):
                    yield topics, block
                    continue
                for topic, frame in zip(topics, block.frames(), strict=True):
                    yield (topic,), Block.of(digest.mover(frame))

    def _blocks(self, digest: _Digest) -> Iterator[tuple[Sequence[str], Block]]:
        """Yield the messages as blocks, with the topic of each."""
        topics = {camera.channel.topic for camera in self.cameras}
        self.accounts = {topic: Account(topic) for topic in sorted(topics)}
        streams = {
            camera.channel.id: _Stream(
                camera, self.model, self.accounts[camera.channel.topic], digest.settle
            )
            for camera in self.cameras
        }
        rows: list[_Row] = []
        with _named(self.path):
            for message in self.reader.messages(streams.keys(), digest):
                stream = streams[message.channel_id]
                row = stream.row_of(message)
                if rows and (row is None or row.batch is not rows[0].batch):
                    yield _block_of(rows)
                    rows = []
                if row is not None:
                    rows.append(row)
                    continue
                for frame in stream.frames_of(message, strict=self.strict):
                    yield (stream.topic,), Block.of(frame)
        if rows:
            yield _block_of(rows)


class _Row(NamedTuple):
    """A message that is taken as it lies in its batch."""

    batch: Batch
    place: int
    stamp: int
    log_time: int
    source: str
    frame_id: str
    topic: str


def _block_of(rows: list[_Row]) -> tuple[Sequence[str], Block]:
    """Return messages of one batch, and their topics."""
    batches, places, stamps, log_times, sources, frame_ids, topics = zip(*rows, strict=True)
    batch: Batch = batches[0]
    return topics, Block(
        np.array(stamps, np.int64),
        np.array(log_times, np.int64),
        sources,
        frame_ids,
        np.array([batch.rows[i] for i in places], np.int64),
        batch.people,
    )


class _Digest:
    """Decodes messages ahead of their use, in the thread that reads.

    With ``fixed``, cameras at rest are moved to that frame on the way.
    """

    def __init__(self, log: Log, fixed: str = "") -> None:
        self._decoder = BatchDecoder(log.model)
        self._poses = Poses(fixed, partial(log.transforms.at_rest, fixed=fixed)) if fixed else None
        self.mover = Mover(log.transforms, fixed)
        self._published = np.zeros(1 << 16, np.bool_)
        for camera in log.cameras:
            self._published[camera.channel.id] = camera.layout.is_published

    def settle(self, frame: Frame) -> Frame:
        """Move a frame that was decoded on its own, if those of a batch are."""
        if self._poses is None or self._poses.find(frame.frame_id.encode()) < 0:
            return frame
        return self.mover(frame.replace(frame_id=frame.frame_id.lstrip("/")))

    def __call__(self, chunks: Sequence[Records]) -> list[list[tuple[Batch, int] | None]]:
        """Return each message's place in a batch; None = decode it on its own."""
        notes: list[list[tuple[Batch, int] | None]] = [[None] * len(c.messages) for c in chunks]
        rows = [np.flatnonzero(self._published[c.messages[:, CHANNEL]]) for c in chunks]
        parts = [
            (c.data, c.messages[chosen][:, [START, STOP]].astype(np.int64, order="C"))
            for c, chosen in zip(chunks, rows, strict=True)
        ]
        batch = self._decoder.decode(parts, self._poses)
        if batch is not None:
            place = itertools.count()
            for said, chosen in zip(notes, rows, strict=True):
                for row in chosen.tolist():
                    said[row] = batch, next(place)
        return notes


class _Stream:
    """One channel being read: its decoder, its account and what it said last."""

    def __init__(
        self,
        camera: Camera,
        model: SkeletonModel,
        account: Account,
        settle: Callable[[Frame], Frame],
    ) -> None:
        self._settle = settle
        self.topic = camera.channel.topic
        self._names = dict(camera.sources)
        self._only = next(iter(self._names)) if len(self._names) == 1 else ""
        self._decoder = Decoder(model, topic=camera.channel.topic, layout=camera.layout)
        self._account = account
        self._previous: dict[str, _Last] = {}

    def row_of(self, message: Message) -> _Row | None:
        """Account for a message that is right as it is; None = see :meth:`frames_of`."""
        if message.note is None:
            return None
        batch, place = message.note
        said = batch.said(place)
        if said is None:
            return None
        times = said.times
        source = said.source if times else self._only or said.source
        last = self._previous.get(source)
        if times and (min(times) < 0 or (last is not None and last.may_be_repeated(times))):
            return None
        account = self._account
        account.read += 1
        account.used += 1
        if said.cleaned:
            account.cleaned.update(said.cleaned)
        stamp = self._stamp(times, said.stamp, message.log_time)
        self._previous[source] = _Last(times, (batch.people, batch.rows[place][0]))
        return _Row(
            batch, place, stamp, message.log_time, self._name(source), said.frame_id.lstrip("/"),
            self.topic,
        )  # fmt: skip

    def frames_of(self, message: Message, *, strict: bool) -> list[Frame]:
        """Decode, clean and name what a message holds, and account for it."""
        account = self._account
        account.read += 1
        try:
            decoded = self._decode(message)
        except LogError as error:
            if strict:
                raise
            account.skipped[DAMAGED] += 1
            account.first_error = account.first_error or error.fault
            return []
        found = []
        for frame, cleaned in decoded:
            if cleaned:
                account.cleaned.update(cleaned)
            fresh = self._fresh(frame)
            if fresh.n_people or not frame.n_people:
                found.append(fresh)
        if found:
            account.used += 1
        else:
            account.skipped[STALE] += 1
        return found

    def _decode(self, message: Message) -> list[tuple[Frame, Mapping[str, int]]]:
        """Return the frames of a message, cleaned, and what was taken out of each."""
        if message.note is not None:
            batch, row = message.note
            found = batch.frame(row, message.log_time)
            if found is not None:
                return [found]
        cleaned = [clean(f) for f in self._decoder.decode_all(message.data, message.log_time)]
        return [(self._settle(frame), counts) for frame, counts in cleaned]

    def _fresh(self, frame: Frame) -> Frame:
        """Return the frame named, stamped and without what was said before."""
        source = frame.source if frame.n_people else self._only or frame.source
        stamp = self._stamp(frame.stamps.tolist(), frame.stamp, frame.log_time)
        frame = frame.replace(
            stamp=stamp,
            stamps=np.maximum(frame.stamps, 0),
            source=self._name(source),
            frame_id=frame.frame_id.lstrip("/"),
        )
        last, self._previous[source] = self._previous.get(source), _Last.of(frame)
        fresh = frame if last is None else last.without_repeats(frame)
        self._account.stale += frame.n_people - fresh.n_people
        return fresh

    def _stamp(self, times: list[int], header: int, log_time: int) -> int:
        """Return the time of a message, ns, and count those that have none."""
        stamp = max([0, *times]) or max(0, header)
        if not stamp:
            self._account.untimed += 1
        return stamp or log_time

    def _name(self, source: str) -> str:
        """Return what a camera goes by."""
        return self._names.get(source, source or self._account.topic)


@dataclass(frozen=True, slots=True)
class _Last:
    """What a camera said last."""

    times: list[int]
    """Source time of each person, ns."""
    place: tuple[People, int]
    """Where its people are, and the row of the first."""

    @classmethod
    def of(cls, frame: Frame) -> _Last:
        return cls(frame.stamps.tolist(), (Block.of(frame).people, 0))

    def may_be_repeated(self, times: list[int]) -> bool:
        """Whether somebody has a source time that somebody had in this message."""
        return not (set(times) - {0}).isdisjoint(self.times)

    def without_repeats(self, frame: Frame) -> Frame:
        """Leave out people whose source time and numbers are those of somebody in here."""
        times = frame.stamps.tolist()
        if not self.may_be_repeated(times):
            return frame
        people, begin = self.place
        said = {(t, *_numbers(people, row)) for row, t in enumerate(self.times, begin) if t}
        here = Block.of(frame).people
        fresh = [p for p, time in enumerate(times) if (time, *_numbers(here, p)) not in said]
        return frame if len(fresh) == frame.n_people else frame.select(fresh)


def _numbers(people: People, row: int) -> tuple[bytes, bytes]:
    return people.markers[row].tobytes(), people.links[row].tobytes()


def open_log(
    path: str | os.PathLike[str],
    *,
    topics: Sequence[str] | None = None,
    extrinsics: str | os.PathLike[str] | None = None,
    fixed_frame: str | None = None,
    output_prefix: str = OUTPUT_PREFIX,
) -> Log:
    """Open a log and find out what is in it.

    Parameters
    ----------
    path : an MCAP file, a ROS 1 bag, a SQLite bag (.db3), or a rosbag2 folder. All but MCAP
        are rewritten into a temporary file first.
    topics : globs of the skeleton channels to read (see channels.select_skeletons).
    extrinsics : file with the cameras' poses, instead of /tf_static and /tf.
    fixed_frame : frame of the results, instead of the root of the transforms.
    output_prefix : channels below it are results of hiros and not read.

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
    reader = open_reader(path)
    try:
        with _named(reader.path):
            chosen = select_skeletons(channels_of(reader), topics, output_prefix)
            layouts = {info.id: _layout(reader, info) for info in chosen}
            model, first = _learn(reader, layouts)
            seen = [_look(reader, info, layouts[info.id], model, first) for info in chosen]
            cameras = _name_cameras(seen)
            transforms = _transforms(reader) if tree is None else tree
        return Log(reader, cameras, model, transforms, fixed_frame)
    except BaseException:
        reader.close()
        raise


def span_of(reader: McapReader) -> tuple[int, int]:
    """Return the log times, ns, between which a file's skeletons lie, without results of hiros.

    Not those of all messages: /tf_static and whatever else is kept for late listeners may be
    logged with a time of 0. In a file with nothing else, all messages count.
    """
    skeletons = [i for i in channels_of(reader) if i.has_type(hiros_schemas.SKELETON_GROUP)]
    found = [i.id for i in skeletons if i.count and not i.topic.startswith(f"{OUTPUT_PREFIX}/")]
    wanted = found or list(reader.channels)
    first = next(reader.messages(wanted), None)
    if first is None:
        return 0, 0
    return first.log_time, max(c.end_time for c in reader.contents.chunks if c.holds(wanted))


def open_reader(path: str | os.PathLike[str]) -> McapReader:
    """Open the container of a log of any kind, see :func:`open_log`; raises LogError."""
    path = Path(path)
    inside = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    kind = "" if path.is_dir() and len(inside) == 1 else kind_of(path)
    if kind:
        return BagReader(path, kind)
    if len(inside) != 1:
        raise LogError(f"is a folder with {len(inside)} MCAP files; name one", path=path)
    return McapReader(inside[0])


def _layout(reader: McapReader, info: ChannelInfo) -> Layout:
    schema = reader.schema(reader.channels[info.id])
    if schema is None:
        raise LogError("has no message definition", topic=info.topic)
    with _named(reader.path, info.topic):
        return check_schema(schema.name, schema.encoding, schema.data)


def _learn(
    reader: McapReader, layouts: Mapping[int, Layout]
) -> tuple[SkeletonModel, dict[int, Message]]:
    """Learn the skeleton model, and each channel's first message on the way.

    The first messages are enough when they hold every marker and link that the detectors claim to
    know; at worst the whole log is read. A message that is damaged, or contradicts the former
    ones, teaches nothing; whoever decodes it will say so.
    """
    builder, first, failed = ModelBuilder(), dict[int, Message](), ""
    decoders: dict[int, Decoder] = {}
    for message in reader.messages(layouts.keys()):
        ident = message.channel_id
        if ident not in first or not (builder.complete or _reads(decoders[ident], message)):
            topic = reader.channels[ident].topic
            try:
                builder.add(message.data, topic, layouts[ident])
                model = builder.build()
                decoders = {i: Decoder(model, layout=layout) for i, layout in layouts.items()}
            except LogError as error:
                failed = failed or f"; first error: {topic}: {error.fault}"
                decoders = decoders or {i: Decoder(builder.build()) for i in layouts}
        first.setdefault(ident, message)
        if builder.complete and len(first) == len(layouts):
            break
    model = builder.build()
    if not model.n_markers:
        raise LogError(f"no message holds a skeleton with a marker{failed}")
    return model, first


def _reads(decoder: Decoder, message: Message) -> bool:
    """Whether a message has nothing that the decoder's model lacks; faster than learning it."""
    try:
        decoder.decode(message.data, message.log_time)
    except LogError:
        return False
    return True


def _look(
    reader: McapReader,
    info: ChannelInfo,
    layout: Layout,
    model: SkeletonModel,
    first: Mapping[int, Message],
) -> Camera:
    """Find out the names of a channel's cameras and frames from the first skeletons on it."""
    decoder = Decoder(model, topic=info.topic, layout=layout)
    seen: list[Frame] = []
    failed: LogError | None = None
    for message in _after(first[info.id], reader, info.id):
        try:
            decoded = decoder.decode_all(message.data, message.log_time)
        except LogError as error:
            failed = failed or error
            continue
        if not seen or any(frame.n_people for frame in decoded):
            seen = decoded
        if any(frame.n_people for frame in seen):
            break
    if not seen and failed is not None:
        raise failed
    sources = {frame.source: frame.source for frame in seen}
    return Camera(info, layout, sources, tuple({f.frame_id.lstrip("/"): 0 for f in seen}))


def _after(first: Message, reader: McapReader, channel: int) -> Iterator[Message]:
    """Yield a channel's first message, already at hand, and only if it does not do the others."""
    yield first
    messages = reader.messages({channel})
    next(messages, None)
    yield from messages


def _name_cameras(seen: Sequence[Camera]) -> list[Camera]:
    """Name each camera by what its messages call it, or by its topic where that is not unique."""
    owners = Counter(source for camera in seen for source in camera.sources)
    named = []
    for camera in seen:
        topic, alone = camera.channel.topic, len(camera.sources) == 1
        names = {
            source: source
            if source and owners[source] == 1
            else topic
            if alone
            else f"{topic}:{source}"
            for source in camera.sources
        }
        named.append(Camera(camera.channel, camera.layout, names, camera.frames))
    return named


def _transforms(reader: McapReader) -> TransformTree:
    """Gather every transform of the log; only the chunks that hold some are read."""
    wanted = {
        info.id: info.topic
        for info in channels_of(reader)
        if info.topic in TF_TOPICS
        and info.has_type(hiros_schemas.TF_MESSAGE)
        and info.encoding == "cdr"
        and info.count
    }
    tree = TransformTree()
    if wanted:
        for message in reader.messages(wanted.keys()):
            topic = wanted[message.channel_id]
            with _named(reader.path, topic):
                transforms = parse_tf(message.data)
            for transform in transforms:
                tree.add(transform, static=topic == "/tf_static")
    return tree


@contextmanager
def _named(path: Path, topic: str | None = None) -> Iterator[None]:
    """Give the LogErrors of a block the name of the file."""
    try:
        yield
    except LogError as error:
        if error.path is not None:
            raise
        raise type(error)(error.fault, path=path, topic=error.topic or topic) from None
