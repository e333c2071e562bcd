"""A log of skeletons as frames.

::

    with open_log("lab.mcap") as log:
        for frame in log.detections():
            ...
"""

from __future__ import annotations

import difflib
import math
import os
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

import hiros_schemas
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import (
    Mover,
    PoseChange,
    TimedPoses,
    TransformTree,
    parse_tf,
    read_extrinsics,
    same_place,
)
from hiros_mcap.errors import LogError
from hiros_mcap.frames import Block, frames_of
from hiros_mcap.io.bags import BagReader, SplitReader, kind_of, parts_of
from hiros_mcap.io.camera_clock import CameraTimes
from hiros_mcap.io.channels import (
    OUTPUT_PREFIX,
    OUTPUT_TOPICS,
    TF_TOPICS,
    ChannelInfo,
    channels_of,
    is_selected,
    select_skeletons,
)
from hiros_mcap.io.codec import (
    Decoded,
    Decoder,
    MessagePart,
    ModelBuilder,
    OtherSkeletonError,
    RestPoses,
)
from hiros_mcap.io.container import (
    Batch,
    LogOrder,
    McapReader,
    Message,
    Records,
    RecoveringReader,
    Recovery,
)
from hiros_mcap.io.container.reader import MEMORY
from hiros_mcap.io.container.recovery import RECOVERY_METADATA
from hiros_mcap.io.detectors.body_size import body_size, unit_doubt
from hiros_mcap.io.detectors.conversion import (
    ConvertedReader,
    Selection,
    SkeletonChoice,
    converted,
)
from hiros_mcap.io.layout import Layout, check_schema
from hiros_mcap.kernels.record_index import CHANNEL, START
from hiros_mcap.skeletons import Flags, Frame, People, SkeletonModel, Stamps
from hiros_mcap.summary import quantity

Source = str | os.PathLike[str] | McapReader
"""A log: its path, or the open file, which then stays open."""
STALE = "stale repeat"
DAMAGED = "cannot be decoded"
FAR_FUTURE = "log time after the year 2262"
"""Frames count ns in 63 bits; MCAP has 64."""
_LATEST = 2**63 - 1


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
    """Numbers taken out because they cannot be true, by kind (see kernels.cleaning)."""
    untimed: int = 0
    """Frames without a time of their own, to which the log time was given."""
    first_error: str = ""
    """What was wrong with the first message that could not be decoded."""


@dataclass(frozen=True, slots=True)
class CameraChannel:
    """A skeleton channel that is read."""

    channel: ChannelInfo
    layout: Layout
    sources: Mapping[str, str]
    """The name that each of its cameras goes by; usually there is one camera."""
    frames: tuple[str, ...]
    """Coordinate frames of its detections."""
    size: float = math.nan
    """Size of the first people on it, m; NaN if nobody is."""


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

    is_live = False
    """Whether the log is still being written, so that it is read once."""

    def __init__(
        self,
        reader: McapReader,
        cameras: Sequence[CameraChannel],
        model: SkeletonModel,
        transforms: TransformTree,
        fixed_frame: str | None,
        *,
        owns_file: bool = True,
    ) -> None:
        self.reader = reader
        self._owns_file = owns_file
        self.path = reader.path
        self.left_out = reader.left_out if isinstance(reader, BagReader) else {}
        self.channels = channels_of(reader)
        self.cameras = tuple(cameras)
        self.model = model
        self.transforms = transforms
        self.strict = False
        self.accounts: dict[str, Account] = {}
        self._fixed_frame = fixed_frame
        self._inputs: dict[int, _Input] = {}
        self._names: dict[str, int] = {}
        """Of cameras and coordinate frames, to their numbers in blocks."""
        self._layouts: dict[int, Layout] = {}

    def __repr__(self) -> str:
        return f"<Log {self.path}: {len(self.cameras)} skeleton channels, {self.model!r}>"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file, unless it was open before."""
        if self._owns_file:
            self.reader.close()

    @cached_property
    def fixed_frame(self) -> str:
        """The frame that results are to be in: the root of the cameras' tree unless named.

        Raises LogError if the cameras' frames are not all joined to it.
        """
        frames = [name for camera in self.cameras for name in camera.frames]
        if not frames:  # no camera sent anything
            return self._fixed_frame or ""
        self.check_fixed_frame()
        with _named(self.path):
            fixed = self._fixed_frame or self.transforms.common_root(frames)
            for name in frames:
                self.transforms.lookup(name, fixed, 0)
        return fixed

    def check_fixed_frame(self) -> None:
        """Raise LogError if results are to be in a frame that the log does not have."""
        known = {name for camera in self.cameras for name in camera.frames}
        known |= set(self.transforms.frames)
        if self._fixed_frame and self._fixed_frame not in known and any(known):
            names = sorted(filter(None, known))
            near = difflib.get_close_matches(self._fixed_frame, names, n=1)
            guess = f"; did you mean {near[0]!r}?" if near else ""
            raise LogError(
                f"has no frame {self._fixed_frame!r} for the results to be in{guess} (there are: "
                f"{', '.join(names)})",
                path=self.path,
            )

    def pose_of(self, camera: CameraChannel) -> Rigid | None:
        """Pose in the fixed frame at the start; None for no or several frames, or the fixed one."""
        if len(camera.frames) != 1 or camera.frames[0] == self.fixed_frame:
            return None
        return self.transforms.lookup(camera.frames[0], self.fixed_frame, 0)

    @cached_property
    def span(self) -> tuple[int, int]:
        """Log times, ns, between which the skeletons lie; see :func:`span_of`."""
        return span_of(self.reader)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes the cameras' poses doubtful, with the remedy.

        Raises LogError if the cameras' frames are not all joined to the fixed frame.
        """
        fixed = self.fixed_frame
        frames = sorted({name for camera in self.cameras for name in camera.frames} - {fixed})
        poses = {name: self.transforms.lookup(name, fixed, 0) for name in frames}
        changes: dict[str, list[PoseChange]] = {}
        for change in self.transforms.changes_above([*frames, fixed]):
            changes.setdefault(change.child, []).append(change)
        sizes = (unit_doubt(c.channel.topic, c.size) for c in self.cameras)
        return (
            *filter(None, sizes),
            *map(self._changed, changes.values()),
            *map(_coincide, same_place(poses)),
        )

    def _changed(self, changes: Sequence[PoseChange]) -> str:
        first = changes[0]
        seconds = (first.log_time - self.span[0]) * 1e-9
        more = f" and then {quantity(len(changes) - 1, 'time')} more" if len(changes) > 1 else ""
        return (
            f"the pose of {first.child} in {first.parent} changes by {first.distance} at "
            f"{seconds:.1f} s{more}; hiros uses the new pose from then on. If nobody moved or "
            "calibrated it, pass the right poses with --extrinsics FILE"
        )

    @property
    def recovery(self) -> Recovery | None:
        """What is lost of a damaged file; None if the log was opened without ``recover``."""
        found = getattr(self.reader, "recovery", None)
        return found if isinstance(found, Recovery) else None

    @property
    def recovery_mark(self) -> Mapping[str, str]:
        """What the metadata of a result say of this log's losses, also of earlier ones."""
        if self.recovery is not None and self.recovery.damages:
            return self.recovery.metadata()
        found = (v for name, v in self.reader.contents.metadata if name == RECOVERY_METADATA)
        return next(found, {})

    @property
    def losses(self) -> str:
        """What is lost of the recording, in one line; "" if nothing is."""
        return self.recovery_mark.get("loss", "")

    @property
    def remarks(self) -> tuple[str, ...]:
        """Notes about the log."""
        found = (self._empty(), self._nameless(), self._former(), self._left_out())
        own = self.reader.remarks if isinstance(self.reader, ConvertedReader) else ()
        return (*own, *filter(None, found))

    def _former(self) -> str:
        found = [info.topic for info in self.channels if info.topic in OUTPUT_TOPICS]
        if not found:
            return ""
        return (
            f"the log holds results of hiros already ({', '.join(found)}); a run reads the cameras "
            "again and its results replace them"
        )

    def _empty(self) -> str:
        if self.model.n_markers:
            return ""
        messages = sum(camera.channel.count for camera in self.cameras)
        what = "no camera sees anybody" if messages else "the cameras sent no message"
        return f"the room is empty: {what}"

    def _nameless(self) -> str:
        topics = [camera.channel.topic for camera in self.cameras if "" in camera.frames]
        if not topics:
            return ""
        unused = " and does not use the log's transforms" if len(self.transforms) else ""
        return (
            f"channels without a coordinate frame: {', '.join(topics)}; hiros assumes that their "
            f"skeletons share one frame{unused}"
        )

    def _left_out(self) -> str:
        topics = [f"{topic} ({kind}, {n})" for topic, (kind, n) in sorted(self.left_out.items())]
        return f"not copied from the bag: {', '.join(topics)}" if topics else ""

    def frames(self) -> Iterator[Frame]:
        """Yield the detections of all cameras in the order of their log times.

        They are in the coordinates of the camera; ``frame_id`` names them. ``stamp`` is the
        latest source time of the people in it, or header.stamp where the detector gives none, or
        the log time; a time of 0 or before 1970 is none. A skeleton that repeats one of the
        camera's previous message in every number and in its source time is left out; a message of
        nothing else gives no frame.

        Raises LogError where the file is damaged. A message that cannot be decoded is counted in
        ``accounts`` and skipped, unless ``strict`` is set: then it is a LogError too.
        """
        for _, block in self.read(fixed=False):
            yield from block.frames()

    def detections(self) -> Iterator[Frame]:
        """Yield what :meth:`frames` does, in the fixed frame (Hi-ROS 2023, eq 5).

        Raises LogError also for a frame that no transform joins to the fixed frame.
        """
        return frames_of(self.blocks())

    def blocks(self) -> Iterator[Block]:
        """Yield what :meth:`detections` does, some chunks' messages at once where that can be."""
        for _, block in self.read():
            yield block

    def camera_blocks(self, spans: Sequence[tuple[int, int]] | None = None) -> Iterator[Block]:
        """Yield what :meth:`frames` does as blocks, in the coordinates of the cameras.

        With ``spans`` of log times, ns, only the parts of the file in which they lie are read.
        """
        for _, block in self.read(fixed=False, spans=spans):
            yield block

    def use_poses(self, poses: Mapping[str, TimedPoses], fixed: str) -> None:
        """Replace the poses of some cameras' frames in the frame ``fixed``."""
        self.transforms = self.transforms.with_poses(poses, fixed)

    @property
    def has_plain_times(self) -> bool:
        """Whether the beginnings of the messages show the cameras and the times."""
        return all(len(c.sources) == 1 and c.layout.is_published for c in self.cameras)

    def times(self, tables: Sequence[Stamps] = ()) -> dict[str, CameraTimes]:
        """Return when the messages of each camera were stamped and logged, in log order.

        A stamp is that of a frame (see :meth:`frames`). Where some messages have people with a
        source time and others do not, only the kind that is more frequent is in there: detectors
        may fill in header.stamp when they are done.

        Only the beginning of each message is read, if every channel has one camera. Messages that
        are damaged are left out, and so are those without a time.

        ``tables`` are what :meth:`read` has put into ``times``, if the log has plain times.
        """
        if not self.has_plain_times:
            rows = ((f.source, f.log_time, f.stamp, 0) for f in self.frames())
            return _times_of(sorted(rows, key=itemgetter(1)))
        names = {c.channel.id: next(iter(c.sources.values())) for c in self.cameras}
        decoder = Decoder(self.model)
        with _named(self.path):
            parts = tables or map(decoder.read_times, self.reader.batches(names))
            table = np.concatenate([*parts, np.empty((0, 4), np.int64)])
        table = table[np.argsort(table[:, 1], kind="stable")]
        return {
            name: _camera_times(table[table[:, 0] == ident, 1:]) for ident, name in names.items()
        }

    def read(
        self,
        *,
        fixed: bool = True,
        spans: Sequence[tuple[int, int]] | None = None,
        step: int = 0,
        times: list[Stamps] | None = None,
    ) -> Iterator[tuple[Sequence[str], Block]]:
        """Yield the messages as blocks, with the topic of each frame.

        Parameters
        ----------
        fixed : in the fixed frame, as :meth:`detections`; otherwise as :meth:`frames`.
        spans : log times, ns; only the parts of the file in which they lie are read.
        step : ns; of a channel of one camera, about one message in each such interval is decoded.
            0 = all.
        times : gets the times of all messages of the log, for :meth:`times`; the whole file is
            then read.
        """
        if not fixed:
            yield from self._blocks(None, spans, step, times)
            return
        frame = self.fixed_frame
        mover = Mover(self.transforms, frame)
        poses = RestPoses(frame, partial(self.transforms.at_rest, fixed=frame))
        with _named(self.path):
            for topics, block in self._blocks(poses, spans, step, times):
                yield topics, mover.move_block(block)

    def _blocks(
        self,
        poses: RestPoses | None,
        spans: Sequence[tuple[int, int]] | None,
        step: int,
        times: list[Stamps] | None,
    ) -> Iterator[tuple[Sequence[str], Block]]:
        """Yield the messages as blocks, with the topic of each frame.

        With ``times``, all messages are read, and their times go there.

        A thread reads and decodes, chunk by chunk. Here the messages are put in order, and what
        depends on their order is done: repeats are left out, and every message is accounted for.
        """
        topics = {camera.channel.topic for camera in self.cameras}
        self.accounts = {topic: Account(topic) for topic in sorted(topics)}
        self._account_for_conversion()
        self._inputs.clear()
        self._layouts.clear()
        for camera in self.cameras:
            self.use(camera)
        inputs = self._inputs
        decoder = Decoder(self.model, layouts=self._layouts, poses=poses)
        batches = self.reader.batches(inputs, spans=spans if times is None else None)
        if step:
            spacing = _Spacing(step, self.cameras, None if times is None else spans)
            batches = spacing.thinned(batches, decoder, times)
        decoded = (d for batch in batches for d in decoder.decode(batch))
        order = LogOrder[Decoded]()
        with _named(self.path):
            for some in self.reader.ahead(decoded):
                order.add(some, some.keys)
                for part, messages in order.before(some.until):
                    yield from self._accounted(part, messages, inputs)

    def only(self, topics: Collection[str]) -> None:
        """Read these skeleton channels alone from here on."""
        self.cameras = tuple(c for c in self.cameras if c.channel.topic in topics)

    def use(self, camera: CameraChannel) -> None:
        """Read the messages of a camera from here on."""
        topic = camera.channel.topic
        account = self.accounts.setdefault(topic, Account(topic))
        self._inputs[camera.channel.id] = _Input(camera, account)
        self._layouts[camera.channel.id] = camera.layout

    def _account_for_conversion(self) -> None:
        """Account for the messages that could not be converted."""
        faults = self.reader.faults if isinstance(self.reader, ConvertedReader) else {}
        for topic, (n, first) in faults.items():
            if topic in self.accounts:
                account = self.accounts[topic]
                account.read, account.first_error = n, first
                account.skipped[DAMAGED] = n

    def _accounted(
        self, decoded: Decoded, messages: Sequence[int], inputs: Mapping[int, _Input]
    ) -> Iterator[tuple[Sequence[str], Block]]:
        """Yield the frames of some messages, in this order, as a block."""
        rows: list[_Row] = []
        fault: LogError | None = None
        times = decoded.keys[:, 0].tolist(), decoded.people.stamps.tolist()
        for i in messages:
            camera = inputs[decoded.channels[i]]
            rows += camera.take(decoded, i, *times)
            if self.strict and i in decoded.faults:
                fault = LogError(decoded.faults[i], topic=camera.topic)
                break
        if rows:
            topics, stamps, log_times, sources, frame_ids, begins, ends = zip(*rows, strict=True)
            yield (
                topics,
                Block(
                    np.array(stamps, np.int64),
                    np.array(log_times, np.int64),
                    np.array([self._names.setdefault(n, len(self._names)) for n in sources]),
                    np.array([self._names.setdefault(n, len(self._names)) for n in frame_ids]),
                    tuple(self._names),
                    np.array([begins, ends], np.int64).T.copy(),
                    decoded.people,
                ),
            )
        if fault is not None:
            raise fault


_SPARED = 0.75
"""A message is left out if it comes after a smaller share of the interval: none is regular."""


class _Spacing:
    """Leaves messages out: of a channel of one camera, those that come soon after a kept one.

    Parameters
    ----------
    step : usual interval, ns. cameras : the channels.
    spans : log times, ns, outside of which no message is kept; None = all may be.
    """

    def __init__(
        self,
        step: int,
        cameras: Iterable[CameraChannel],
        spans: Sequence[tuple[int, int]] | None = None,
    ) -> None:
        self._least, self._spans = round(_SPARED * step), spans
        self._shared = {
            camera.channel.id
            for camera in cameras
            if len(camera.sources) != 1 or camera.channel.topic == f"{OUTPUT_PREFIX}/tracked"
        }
        self._last: dict[int, int] = {}

    def thinned(
        self, batches: Iterable[Batch], decoder: Decoder, times: list[Stamps] | None
    ) -> Iterator[Batch]:
        """Yield the batches with the messages that are kept; the times of all go to ``times``."""
        for batch in batches:
            thin, table = decoder.spaced(batch, self._kept)
            if times is not None:
                times.append(table)
            yield thin

    def _kept(self, channel: int, times: Stamps, log_times: Stamps) -> Flags:
        """(n,) which of the next messages of a channel are kept, by their times, ns."""
        inside = np.full(len(times), self._spans is None)
        for begin, end in self._spans or ():
            inside |= (begin <= log_times) & (log_times <= end)
        if channel in self._shared:
            return inside
        last = self._last.get(channel, -self._least)
        for k in np.flatnonzero(inside).tolist():
            inside[k] = not 0 <= times[k] - last < self._least
            last = int(times[k]) if inside[k] else last
        self._last[channel] = last
        return inside


def _times_of(rows: Iterable[tuple[str, int, int, int]]) -> dict[str, CameraTimes]:
    """Gather by camera: name, log time, header.stamp, source time."""
    found: dict[str, list[tuple[int, ...]]] = {}
    for name, *times in rows:
        found.setdefault(name, []).append(tuple(times))
    return {name: _camera_times(np.array(some, np.int64)) for name, some in found.items()}


def _camera_times(rows: Stamps) -> CameraTimes:
    """Return the times that tell of a clock; (n, 3) log time, header.stamp, source time, 0 = none.

    A repeated stamp tells nothing.
    """
    log_times, headers, sources = rows.T
    stamps = sources if 2 * np.count_nonzero(sources) >= np.count_nonzero(headers) else headers
    kept = stamps > 0
    kept[1:] &= stamps[1:] != stamps[:-1]
    return CameraTimes(stamps[kept], log_times[kept])


class _Row(NamedTuple):
    """A frame of a block."""

    topic: str
    stamp: int
    log_time: int
    source: str
    frame_id: str
    begin: int
    end: int


class _LastMessage(NamedTuple):
    """The people of a camera's previous message."""

    times: Sequence[int]
    """Source time of each, ns; 0 = not given."""
    people: People
    begin: int
    """Row of the first of them."""


class _Input:
    """One channel being read: its account, and the last message of each of its cameras."""

    def __init__(self, camera: CameraChannel, account: Account) -> None:
        self.topic = camera.channel.topic
        self._names = dict(camera.sources)
        self._only = next(iter(self._names)) if len(self._names) == 1 else ""
        self._account = account
        self._previous: dict[str, _LastMessage] = {}

    def take(
        self, decoded: Decoded, i: int, log_times: Sequence[int], times: Sequence[int]
    ) -> list[_Row]:
        """Account for message ``i``; return its frames, named, stamped and without repeats.

        ``log_times`` are of all messages, ``times`` of all people, ns.
        """
        account = self._account
        account.read += 1
        if log_times[i] > _LATEST:
            account.skipped[FAR_FUTURE] += 1
            return []
        if i in decoded.faults:
            account.skipped[DAMAGED] += 1
            account.first_error = account.first_error or decoded.faults[i]
            return []
        if i in decoded.cleaned:
            account.cleaned.update(decoded.cleaned[i])
        rows: list[_Row] = []
        for part in decoded.parts[i]:
            rows += self._fresh(decoded, i, part, log_times[i], times[part.begin : part.end])
        if rows:
            account.used += 1
        else:
            account.skipped[STALE] += 1
        return rows

    def _fresh(
        self, decoded: Decoded, i: int, part: MessagePart, log_time: int, times: Sequence[int]
    ) -> Iterator[_Row]:
        """Yield the frame of a part unless all of its people are repeats."""
        people, begin, end = decoded.people, part.begin, part.end
        # A message without people does not name its camera.
        source = part.source if times else self._only or part.source
        stamp = max(times, default=0) or max(0, decoded.stamps[i])
        if not stamp:
            self._account.untimed += 1
        last = self._previous.get(source)
        n_fresh = end - begin
        if last is not None and not (set(times) - {0}).isdisjoint(last.times):
            n_fresh = _repeats_last(people, begin, times, last)
            self._account.stale += end - begin - n_fresh
            times = people.stamps[begin:end].tolist()
        self._previous[source] = _LastMessage(times, people, begin)
        if n_fresh or not times:
            name = self._names.get(source, source or self.topic)
            frame_id = part.frame_id.lstrip("/")
            yield _Row(
                self.topic, stamp or log_time, log_time, name, frame_id, begin, begin + n_fresh
            )


def _repeats_last(people: People, begin: int, times: Sequence[int], last: _LastMessage) -> int:
    """Put people who repeat one of the last message behind the others; return how many do not.

    A repeat has the same source time, and the same bits in every number of markers and links.
    """
    known = {_bits(last.people, row, time) for row, time in enumerate(last.times, last.begin)}
    here = [_bits(people, row, time) for row, time in enumerate(times, begin)]
    repeated = [bits[0] != 0 and bits in known for bits in here]
    people.reorder(begin, sorted(range(len(here)), key=lambda p: repeated[p]))
    return repeated.count(False)


def _bits(people: People, row: int, time: int) -> tuple[int, bytes, bytes]:
    return time, people.markers[row].tobytes(), people.links[row].tobytes()


def open_log(
    path: Source,
    *,
    topics: Sequence[str] | None = None,
    extrinsics: str | os.PathLike[str] | None = None,
    fixed_frame: str | None = None,
    output_prefix: str = OUTPUT_PREFIX,
    recover: bool = False,
    memory: int = MEMORY,
    skeletons: SkeletonChoice | None = None,
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
    selection = Selection(selects, skeletons or SkeletonChoice())
    with ExitStack() as stack:
        if isinstance(path, McapReader):
            file = path
        else:
            file = stack.enter_context(open_reader(path, recover=recover, memory=memory))
        with _named(file.path):
            reader = converted(file, selection)
        try:
            found = look_into(reader, tree, topics, output_prefix)
        except _SeveralModelsError:
            with _named(file.path):
                reader = converted(file, selection._replace(several=True))
            found = look_into(reader, tree, topics, output_prefix)
        owns_file = reader is not path
        if reader is file:
            stack.pop_all()
        return Log(reader, *found, fixed_frame, owns_file=owns_file)


def look_into(
    reader: McapReader,
    tree: TransformTree | None,
    topics: Sequence[str] | None,
    output_prefix: str = OUTPUT_PREFIX,
) -> tuple[list[CameraChannel], SkeletonModel, TransformTree]:
    """Find out about the chosen channels: cameras, skeleton model, and transforms unless given.

    Raises as :func:`open_log` does.
    """
    with _named(reader.path):
        layouts, model, first = _learn(reader, topics, output_prefix)
        decoder = Decoder(model, layouts=layouts)
        seen = [
            _look(reader, info, decoder, layouts[info.id], first[info.id])
            if info.count
            else CameraChannel(info, layouts[info.id], {"": ""}, ())
            for info in channels_of(reader)
            if info.id in layouts
        ]
        begin = min((message.log_time for message in first.values()), default=0)
        transforms = _transforms(reader, min(begin, _LATEST)) if tree is None else tree
    return _name_cameras(seen), model, transforms


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
    ends = (chunk.end_time for chunk in reader.contents.chunks if chunk.holds(wanted))
    return first.log_time, max((end for end in ends if end <= _LATEST), default=first.log_time)


def open_reader(
    path: str | os.PathLike[str], *, recover: bool = False, memory: int = MEMORY
) -> McapReader:
    """Open the container of a log of any kind, see :func:`open_log`; raises LogError."""
    path = Path(path)
    parts = parts_of(path, recover=recover)
    if len(parts) > 1:
        return SplitReader(path, parts, recover=recover, memory=memory)
    if not parts:
        return BagReader(path, kind_of(path), memory=memory)
    return (RecoveringReader if recover else McapReader)(parts[0], memory=memory)


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
    with reading(source) as file, _named(file.path):
        groups = converted(file, Selection(selects))
        try:
            yield groups
        finally:
            if groups is not file:
                groups.close()


def _layout(reader: McapReader, info: ChannelInfo) -> Layout:
    schema = reader.schema(reader.channels[info.id])
    if schema is None:
        raise LogError("has no message definition", topic=info.topic)
    with _named(reader.path, info.topic):
        return check_schema(schema.name, schema.encoding, schema.data)


class _SeveralModelsError(LogError):
    """The channels of a log have different skeletons, which a file is converted for."""


def _learn(
    reader: McapReader, topics: Sequence[str] | None, output_prefix: str
) -> tuple[dict[int, Layout], SkeletonModel, dict[int, Message]]:
    """Find the layouts of the channels to read, their skeleton model and their first messages."""
    chosen = select_skeletons(channels_of(reader), topics, output_prefix)
    layouts = {info.id: _layout(reader, info) for info in chosen}
    return layouts, *_learn_model(reader, layouts)


def _learn_model(
    reader: McapReader, layouts: Mapping[int, Layout]
) -> tuple[SkeletonModel, dict[int, Message]]:
    """Learn the skeleton model, and each channel's first message on the way.

    The first messages are enough when they hold every marker and link that the detectors claim to
    know; at worst the whole log is read. A message that is damaged, or contradicts the former
    ones, teaches nothing; whoever decodes it will say so. Raises _SeveralModelsError if the first
    skeletons of a channel contradict another channel.
    """
    builder, first, failed = ModelBuilder(), dict[int, Message](), ""
    taught: set[int] = set()
    decoder = Decoder(builder.build(), layouts=layouts)
    for records, rows in reader.runs(layouts.keys()):
        some = records._replace(messages=records.messages[rows])
        for message in some.at(_new_in(some, first, None if builder.complete else decoder)):
            ident, topic = message.channel_id, reader.channels[message.channel_id].topic
            if ident not in first or not (builder.complete or _reads(decoder, message)):
                try:
                    builder.add(message.data, topic, layouts[ident])
                    taught.add(ident)
                except OtherSkeletonError as error:
                    if ident not in taught:
                        raise _SeveralModelsError(
                            "the cameras have different skeletons, which live input cannot fuse; "
                            "record them first"
                        ) from None
                    failed = failed or f"; first error: {topic}: {error.fault}"
                except LogError as error:
                    failed = failed or f"; first error: {topic}: {error.fault}"
                else:
                    decoder = Decoder(builder.build(), layouts=layouts)
            first.setdefault(ident, message)
            if builder.complete and len(first) == len(layouts):
                break
        if builder.complete and len(first) == len(layouts):
            break
    model = builder.build()
    if failed and not model.n_markers:
        raise LogError(f"no message has a skeleton with markers{failed}")
    return model, first


def _new_in(records: Records, known: Collection[int], decoder: Decoder | None) -> list[int]:
    """Return which messages are the first of a channel, or do not fit the decoder's model."""
    channels, first = np.unique(records.messages[:, CHANNEL], return_index=True)
    new = {k for i, k in zip(channels.tolist(), first.tolist(), strict=True) if i not in known}
    for some in decoder.decode(Batch([records], None)) if decoder else ():
        faulty = some.keys[list(some.faults), 2]  # where the messages start
        new.update(np.flatnonzero(np.isin(records.messages[:, START], faulty)).tolist())
    return sorted(new)


def _reads(decoder: Decoder, message: Message) -> bool:
    """Whether a message has nothing that the decoder's model lacks; faster than learning it."""
    try:
        decoder.decode_message(message.data, channel=message.channel_id)
    except LogError:
        return False
    return True


def _look(
    reader: McapReader,
    info: ChannelInfo,
    decoder: Decoder,
    layout: Layout,
    first: Message,
) -> CameraChannel:
    """Find out the names of a channel's cameras and frames from the first skeletons on it."""
    seen: list[Frame] = []
    failed: LogError | None = None
    for message in _after(first, reader):
        try:
            decoded = decoder.decode_message(message.data, channel=info.id)
        except LogError as error:
            failed = failed or error
            continue
        if not seen or any(frame.n_people for frame in decoded):
            seen = decoded
        if any(frame.n_people for frame in seen):
            break
    if not seen and failed is not None:
        raise LogError(failed.fault, topic=info.topic)
    sources = {frame.source: frame.source for frame in seen}
    frames = tuple({frame.frame_id.lstrip("/"): 0 for frame in seen})
    size = body_size(np.concatenate([frame.positions for frame in seen])) if seen else math.nan
    return CameraChannel(info, layout, sources, frames, size)


def _after(first: Message, reader: McapReader) -> Iterator[Message]:
    """Yield a channel's first message, already at hand, and only if it does not do the others."""
    yield first
    messages = reader.messages({first.channel_id})
    next(messages, None)
    yield from messages


def _name_cameras(seen: Sequence[CameraChannel]) -> list[CameraChannel]:
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
        named.append(replace(camera, sources=names))
    return named


def _transforms(reader: McapReader, begin: int) -> TransformTree:
    """Gather every transform of the log; only the chunks that hold some are read.

    ``begin`` is the log time of the first detection.
    """
    wanted = {
        info.id: info.topic
        for info in channels_of(reader)
        if info.topic in TF_TOPICS
        and info.has_type(hiros_schemas.TF_MESSAGE)
        and info.encoding == "cdr"
        and info.count
    }
    tree = TransformTree(begin)
    if wanted:
        for message in reader.messages(wanted.keys()):
            topic, logged = wanted[message.channel_id], min(message.log_time, _LATEST)
            with _named(reader.path, topic):
                transforms = parse_tf(message.data)
            for transform in transforms:
                tree.add(transform, static=topic == "/tf_static", log_time=logged)
    return tree


def _coincide(frames: Sequence[str]) -> str:
    return (
        f"{', '.join(frames[:-1])} and {frames[-1]} stand at the same place with the same "
        "orientation; unless they are one camera, pass the camera poses with --extrinsics FILE"
    )


@contextmanager
def _named(path: Path | str, topic: str | None = None) -> Iterator[None]:
    """Give the LogErrors of a block the name of the file."""
    try:
        yield
    except LogError as error:
        if error.path is not None:
            raise
        raise type(error)(error.fault, path=path, topic=error.topic or topic) from None
