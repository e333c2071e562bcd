"""An open log of skeletons, and one reading of it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain
from pathlib import Path
from typing import ClassVar, Self

import numpy as np

from hiros_mcap.body.body_size import unit_of, unit_warning
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import (
    Mover,
    PoseChange,
    TimedPoses,
    TransformTree,
    far_apart,
    same_place,
)
from hiros_mcap.errors import LogError, explained, naming
from hiros_mcap.frames import Block, frames_of
from hiros_mcap.io.camera_clock import CameraTimes
from hiros_mcap.io.channels import (
    OUTPUT_PREFIX,
    OUTPUT_TOPICS,
    CameraChannel,
    ChannelInfo,
    channels_of,
    not_used,
    skeleton_channels,
)
from hiros_mcap.io.codec import Decoded, Decoder, RestPoses
from hiros_mcap.io.container import LogOrder, McapReader, Recovery
from hiros_mcap.io.container.losses import RECOVERY_METADATA
from hiros_mcap.io.detectors.rgb_keypoints import RgbRig
from hiros_mcap.io.log_accounts import (
    DAMAGED,
    LATEST,
    Account,
    CameraInput,
    Row,
    Spacing,
    times_in,
    times_of,
)
from hiros_mcap.io.unread_channels import not_read
from hiros_mcap.skeletons import Frame, SkeletonModel, Stamps
from hiros_mcap.wording import instead, quantity

_MILLIMETRES_M = 1000.0
"""Cameras of one room that seem to be farther apart have poses in mm; in cm, it would be large."""

Spans = Sequence[tuple[int, int]]
"""Log times, ns: first and last of each part of a log."""


class Reading:
    """One reading of a log: its blocks, and what becomes of the messages.

    Iterate over it once, or take :meth:`blocks` or :meth:`frames`.

    A thread reads and decodes, chunk by chunk. Here the messages are put in order, and what depends
    on their order is done: repeats are left out, and every message is accounted for.

    Attributes
    ----------
    log : what is read.
    accounts : what became of the messages so far, by topic.
    decoder : reads the messages.
    """

    def __init__(
        self, log: Log, *, fixed: bool, spans: Spans | None, step: int, times: list[Stamps] | None,
        slim: bool,
    ) -> None:  # fmt: skip
        self.log = log
        self.accounts: dict[str, Account] = {}
        self._fixed, self._spans, self._step, self._times = fixed, spans, step, times
        self._slim = slim
        self.decoder = Decoder(log.model)
        self._inputs: dict[int, CameraInput] = {}
        self._own_frames: dict[int, str] = {}
        self._names: dict[str, int] = {}
        """Of cameras and coordinate frames, to their numbers in blocks."""
        for camera in sorted(log.cameras, key=lambda camera: camera.channel.topic):
            self._use(camera)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to doubt the result, with their remedies; see :attr:`Log.warnings`."""
        return self.log.warnings

    @property
    def remarks(self) -> tuple[str, ...]:
        """Notes about the log."""
        return self.log.remarks

    def frames(self) -> Iterator[Frame]:
        """Yield the frames."""
        return frames_of(self.blocks())

    def blocks(self) -> Iterator[Block]:
        """Yield the frames as blocks, some chunks' messages at once where that can be."""
        for _, block in self:
            yield block

    def __iter__(self) -> Iterator[tuple[Sequence[str], Block]]:
        """Yield the messages as blocks, with the topic of each frame."""
        with naming(self.log.path):
            if not self._fixed:
                yield from self._blocks(None)
                return
            transforms, fixed = self.log.transforms, self.log.fixed_frame
            mover = Mover(transforms, fixed)
            poses = RestPoses(fixed, partial(transforms.at_rest, fixed=fixed))
            for topics, block in self._blocks(poses):
                yield topics, mover.move_block(block)

    def _blocks(self, poses: RestPoses | None) -> Iterator[tuple[Sequence[str], Block]]:
        """Yield the messages, those of cameras at rest moved to ``poses``."""
        reader, times = self.log.reader, self._times
        decoder = self.decoder = Decoder(
            self.log.model, poses=poses, slim=self._slim, own_frames=self._own_frames,
            is_open=self.log.is_live,
        )  # fmt: skip
        batches = reader.batches(self._inputs, spans=self._spans if times is None else None)
        if self._step:
            spans = None if times is None else self._spans
            spacing = Spacing(self._step, self.log.cameras, spans)
            batches = spacing.thinned(batches, decoder, times)
        decoded = chain.from_iterable(map(decoder.decode, batches))
        order = LogOrder[Decoded]()
        for some in reader.ahead(decoded):
            order.add(some, some.keys)
            for part, messages in order.before(some.until):
                yield from self._accounted(part, messages)
        for topic, (n, first) in reader.faults.items():  # could not be converted
            if topic in self.accounts:
                account = self.accounts[topic]
                account.read += n
                account.skipped[DAMAGED] += n
                account.first_error = account.first_error or first

    def _use(self, camera: CameraChannel) -> None:
        """Read the messages of a camera from here on."""
        topic = camera.channel.topic
        account = self.accounts.setdefault(topic, Account(topic))
        self._inputs[camera.channel.id] = CameraInput(camera, account)
        if camera.own_frame:
            self._own_frames[camera.channel.id] = camera.own_frame

    def _accounted(
        self, decoded: Decoded, messages: Sequence[int]
    ) -> Iterator[tuple[Sequence[str], Block]]:
        """Yield the frames of some messages, in this order, as a block."""
        rows: list[Row] = []
        times = decoded.keys[:, 0].tolist(), decoded.people.stamps.tolist()
        for i in messages:
            rows += self._inputs[decoded.channels[i]].take(decoded, i, *times)
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


@dataclass(frozen=True, eq=False, repr=False)
class Log:
    """An open log; made by :func:`hiros_mcap.io.log.open_log`, used as a context manager.

    It does not change: methods such as :meth:`only` return another one of the same open file.
    """

    reader: McapReader  # its container
    cameras: Sequence[CameraChannel]  # the skeleton channels that are read
    model: SkeletonModel  # the skeleton model of all cameras
    transforms: TransformTree  # where the cameras stand
    wanted_frame: str | None = None  # the frame that results are to be in, if the user named one
    unread: Sequence[ChannelInfo] = ()
    """Channels that show people in an encoding that cannot be read."""
    strangers: Sequence[ChannelInfo] = ()
    """Channels of a type that is not read, though they look like another camera."""
    owns_file: bool = True  # whether :meth:`close` closes the file; otherwise it was open before

    is_live: ClassVar[bool] = False
    """Whether the log is still being written, so that it is read once."""
    reading: ClassVar[type[Reading]] = Reading  # class that reads it

    def __repr__(self) -> str:
        return f"<Log {self.path}: {len(self.cameras)} skeleton channels, {self.model!r}>"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file, unless it was open before."""
        if self.owns_file:
            self.reader.close()

    # -- what is in it -------------------------------------------------------------------------

    @property
    def path(self) -> Path | str:
        """The file."""
        return self.reader.path

    @property
    def rig(self) -> RgbRig | None:
        """The RGB cameras whose keypoints are triangulated; None if there are none."""
        return getattr(self.reader, "rig", None)

    @cached_property
    def channels(self) -> tuple[ChannelInfo, ...]:
        """Every channel of the file."""
        return channels_of(self.reader)

    @property
    def left_out(self) -> Mapping[str, tuple[str, int]]:
        """Topics of a bag that are not in ``channels``, with their type and count."""
        return self.reader.left_out

    @cached_property
    def span(self) -> tuple[int, int]:
        """Log times, ns, between which the skeletons lie; see :func:`span_of`."""
        return span_of(self.reader)

    @cached_property
    def fixed_frame(self) -> str:
        """The frame that results are to be in: the root of the cameras' tree unless named.

        Raises LogError if the cameras' frames are not all joined to it.
        """
        frames = [name for camera in self.cameras for name in camera.frames]
        self.check_fixed_frame()
        if not frames:  # no camera shows anybody
            return self.wanted_frame or self.transforms.only_root
        self._check_names()
        try:
            fixed = self.wanted_frame or self.transforms.common_root(frames)
            for name in frames:
                self.transforms.lookup(name, fixed, 0)
        except LogError as error:
            fault = explained(error, self.reader.warnings).fault
            raise LogError(fault, path=self.path, topic=error.topic) from None
        return fixed

    def _check_names(self) -> None:
        """Raise LogError if some cameras name their frames, and others do not."""
        nameless = [c.channel.topic for c in self.cameras if "" in c.frames]
        named = sorted({name for c in self.cameras for name in c.frames if name})
        if nameless and named:
            raise LogError(
                f"{', '.join(nameless)}: header.frame_id is empty, while the other cameras are in "
                f"{', '.join(named)}; set it, or pass the camera poses with --extrinsics FILE, "
                "which may name cameras by their topics",
                path=self.path,
            )

    def check_fixed_frame(self) -> None:
        """Raise LogError if results are to be in a frame that the log does not have."""
        frames = {name for camera in self.cameras for name in camera.frames}
        frames |= set(self.transforms.frames)
        if self.wanted_frame and self.wanted_frame not in frames and any(frames):
            names = sorted(filter(None, frames))
            raise LogError(
                f"has no frame {self.wanted_frame!r} for the results to be in"
                f"{instead(self.wanted_frame, names)}",
                path=self.path,
            )

    def pose_of(self, camera: CameraChannel) -> Rigid | None:
        """Pose in the fixed frame at the start; None for no or several frames, or the fixed one."""
        if len(camera.frames) != 1 or camera.frames[0] == self.fixed_frame:
            return None
        return self.transforms.lookup(camera.frames[0], self.fixed_frame, 0)

    @cached_property
    def far_apart(self) -> str:
        """Which cameras' poses cannot be in m, in words; "" if all can, or if one lacks."""
        frames = sorted({name for camera in self.cameras for name in camera.frames})
        try:
            fixed = self.fixed_frame
            far = far_apart({name: self.transforms.lookup(name, fixed, 0) for name in frames})
        except LogError:
            return ""
        metres = max(far.values(), default=0.0)
        unit, factor = ("mm", 1000) if metres > _MILLIMETRES_M else ("cm", 100)
        if not far:
            return ""
        return (
            f"cameras are {metres / 1000.0:.2g} km apart ({', '.join(far)}): the translations look "
            f"like {unit}, not m; divide them by {factor}, or pass the camera poses with "
            "--extrinsics FILE"
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to doubt the cameras' messages or poses, with their remedies.

        Raises LogError if the cameras' frames are not all joined to the fixed frame.
        """
        return tuple(self._warnings())

    def _warnings(self) -> Iterator[str]:
        fixed = self.fixed_frame
        yield from self.reader.warnings
        if self.cameras and not self._sent:
            yield "the room is empty: the cameras sent no message; check the detectors"
        frames = sorted({name for camera in self.cameras for name in camera.frames} - {fixed})
        poses = {name: self.transforms.lookup(name, fixed, 0) for name in frames}
        yield from filter(None, [self.far_apart])
        yield from map(not_used, self.unread)
        yield from map(not_read, self.strangers)
        units = {c.channel.topic: unit_of(c.size) for c in self.cameras if c.frames}
        alike = len(set(units.values())) < 2
        sizes = ((c.channel.topic, c.size) for c in self.cameras)
        yield from filter(None, (unit_warning(*size, alike=alike) for size in sizes))
        changes: dict[str, list[PoseChange]] = {}
        for change in self.transforms.changes_above([*frames, fixed]):
            changes.setdefault(change.child, []).append(change)
        for first, *later in changes.values():
            seconds = (first.log_time - self.span[0]) * 1e-9
            more = f" and then {quantity(len(later), 'time')} more" if later else ""
            yield (
                f"the pose of {first.child} in {first.parent} changes by {first.distance} at "
                f"{seconds:.1f} s{more}; hiros uses the new pose from then on. If nobody moved or "
                "calibrated it, pass the right poses with --extrinsics FILE"
            )
        for same in same_place(poses):
            yield (
                f"{', '.join(same[:-1])} and {same[-1]} stand at the same place with the same "
                "orientation; unless they are one camera, pass the camera poses with "
                "--extrinsics FILE"
            )

    @property
    def _sent(self) -> int:
        """Messages of all cameras."""
        return sum(camera.channel.count for camera in self.cameras)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Notes about the log."""
        return (*self.reader.remarks, *self._remarks())

    def _remarks(self) -> Iterator[str]:
        yield from self.transforms.remarks
        if self._sent and not any(camera.frames for camera in self.cameras):
            yield "the room is empty: no camera sees anybody"
        elif blind := [c.channel.topic for c in self.cameras if c.channel.count and not c.frames]:
            yield f"{', '.join(blind)}: nobody is in view in the whole log"
        if topics := [camera.channel.topic for camera in self.cameras if "" in camera.frames]:
            unused = " and does not use the log's transforms" if len(self.transforms) else ""
            yield (
                f"channels without a coordinate frame: {', '.join(topics)}; hiros assumes that "
                f"their skeletons share one frame{unused}"
            )
        if former := [info.topic for info in self.channels if info.topic in OUTPUT_TOPICS]:
            yield (
                f"the log holds results of hiros already ({', '.join(former)}); a run reads the "
                "cameras again and its results replace them"
            )
        if self.left_out:
            others = [
                f"{topic} ({kind}, {n})" for topic, (kind, n) in sorted(self.left_out.items())
            ]
            yield f"not copied from the bag: {', '.join(others)}"

    @property
    def recovery(self) -> Recovery | None:
        """Losses of a damaged file; None if the log was opened without ``recover``."""
        return self.reader.recovery

    @property
    def recovery_mark(self) -> Mapping[str, str]:
        """Metadata that mark a result with the losses of this log, or of an earlier recovery."""
        if self.recovery is not None and self.recovery.damages:
            return self.recovery.metadata()
        marks = (v for name, v in self.reader.contents.metadata if name == RECOVERY_METADATA)
        return next(marks, {})

    @property
    def losses(self) -> str:
        """Losses of the recording in one line; "" if there are none."""
        return self.recovery_mark.get("loss", "")

    # -- another log of the same file ----------------------------------------------------------

    def with_poses(self, poses: Mapping[str, TimedPoses], fixed: str) -> Self:
        """Return the log with other poses of some cameras' frames in the frame ``fixed``."""
        return self._but(transforms=self.transforms.with_poses(poses, fixed))

    def with_own_frames(self, topics: Collection[str]) -> Self:
        """Return the log with the detections on some channels in frames called as the topics."""
        cameras = [
            c.in_frame(c.topic_frame) if c.channel.topic in topics else c for c in self.cameras
        ]
        return self._but(cameras=tuple(cameras))

    def only(self, topics: Collection[str]) -> Self:
        """Return the log with these skeleton channels alone."""
        return self._but(cameras=tuple(c for c in self.cameras if c.channel.topic in topics))

    def _but(self, *, keep: Collection[str] = ("channels", "span"), **changes: object) -> Self:
        """Return the log with some facts changed; the answers to ``keep`` stay."""
        other = replace(self, **changes)  # type: ignore[arg-type]
        other.__dict__.update({k: v for k, v in self.__dict__.items() if k in keep})
        return other

    # -- reading -------------------------------------------------------------------------------

    def frames(self) -> Iterator[Frame]:
        """Yield the detections of all cameras in the order of their log times.

        They are in the coordinates of the camera; ``frame_id`` names them. ``stamp`` is the
        latest source time of the people in it, or header.stamp where the detector gives none, or
        the log time; a time of 0 or before 1970 is none. A skeleton that repeats one of the
        camera's previous message in every number and in its source time is left out; a message of
        nothing else gives no frame.

        Raises LogError where the file is damaged. A message that cannot be decoded is skipped and
        counted in the accounts of the :class:`Reading`, see :meth:`read`.
        """
        return self.read(fixed=False).frames()

    def detections(self) -> Iterator[Frame]:
        """Yield what :meth:`frames` does, in the fixed frame (Hi-ROS 2023, eq 5).

        Raises LogError also for a frame that no transform joins to the fixed frame.
        """
        return self.read().frames()

    def blocks(self) -> Iterator[Block]:
        """Yield what :meth:`detections` does, some chunks' messages at once where that can be."""
        return self.read().blocks()

    def read(
        self,
        *,
        fixed: bool = True,
        spans: Spans | None = None,
        step: int = 0,
        times: list[Stamps] | None = None,
        slim: bool = False,
    ) -> Reading:
        """Return a reading of the log, which begins when blocks are taken from it.

        Parameters
        ----------
        fixed : in the fixed frame, as :meth:`detections`; otherwise as :meth:`frames`.
        spans : only the parts of the file in which they lie are read.
        step : ns; of a channel of one camera, about one message in each such interval is decoded.
            0 = all.
        times : gets the times of all messages of the log, for :meth:`times`; the whole file is
            then read.
        slim : without the columns of velocities and accelerations, unless the log has some.
        """
        return self.reading(self, fixed=fixed, spans=spans, step=step, times=times, slim=slim)

    @property
    def has_plain_times(self) -> bool:
        """Whether the beginnings of the messages show the cameras and the times."""
        return all(len(camera.sources) == 1 for camera in self.cameras)

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
            return times_of(self.frames())
        names = {c.channel.id: next(iter(c.sources.values())) for c in self.cameras}
        decoder = Decoder(self.model)
        with naming(self.path):
            return times_in(tables or map(decoder.read_times, self.reader.batches(names)), names)


def span_of(reader: McapReader) -> tuple[int, int]:
    """Return the log times, ns, between which a file's skeletons lie, without results of hiros.

    Not those of all messages: /tf_static and whatever else is kept for late listeners may be
    logged with a time of 0. In a file with nothing else, all messages count.
    """
    inputs = [
        i.id
        for i in skeleton_channels(reader)
        if i.count and not i.topic.startswith(f"{OUTPUT_PREFIX}/")
    ]
    wanted = inputs or list(reader.channels)
    first = next(reader.messages(wanted), None)
    if first is None:
        return 0, 0
    ends = (chunk.end_time for chunk in reader.contents.chunks if chunk.holds(wanted))
    return first.log_time, max((end for end in ends if end <= LATEST), default=first.log_time)
