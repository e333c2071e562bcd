"""A log of skeletons that is still being written: a pipe, or a file that grows.

::

    with open_live(McapInput(0, "standard input")) as log:
        for frame in log.detections():
            ...
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from glob import escape
from itertools import chain
from pathlib import Path
from typing import Any, Self

import hiros_schemas
from hiros_mcap.body.transforms import read_extrinsics
from hiros_mcap.errors import LogError, SchemaError, naming
from hiros_mcap.io.camera_frames import is_read
from hiros_mcap.io.channels import (
    OUTPUT_PREFIX,
    CameraChannel,
    ChannelInfo,
    channels_of,
    info_of,
    is_selected,
    is_static_topic,
    is_transform_topic,
    not_used,
)
from hiros_mcap.io.codec import OtherSkeletonError
from hiros_mcap.io.container import Message
from hiros_mcap.io.container.live_input import LiveInput
from hiros_mcap.io.container.live_reader import LiveReader
from hiros_mcap.io.detectors.conversion import is_of_other_detector
from hiros_mcap.io.detectors.live_conversion import LiveConversion
from hiros_mcap.io.log import skeletons_of
from hiros_mcap.io.log_times import LiveLogTimes
from hiros_mcap.io.opened_log import Log, Reading
from hiros_mcap.wording import quantity

LISTEN_S = 1.0
"""s of the log's own time: a camera sends several messages in it."""
_PATIENCE_S = 10.0  # how long after the first skeletons transforms may come
_MOST = 20_000  # messages that are kept while nobody is there: about two minutes of five cameras


class LiveReading(Reading):
    """The one reading of a log that is still being written.

    Cameras may join. What they send counts from when their place is known: ``log`` is the log as it
    is known so far.
    """

    log: LiveLog

    def __init__(self, log: LiveLog, **how: Any) -> None:
        super().__init__(log, **how)
        self._known = {camera.channel.id for camera in log.cameras if camera.frames}
        """Channels of which no message tells anything new; others may have shown nobody yet."""
        self._refused: list[str] = []
        """Why channels are not read."""
        self._waiting: Counter[str] = Counter()
        """Messages of cameras that could not be used yet, by topic."""
        log.reader.listeners.append(self._hear)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to doubt the result, with their remedies."""
        waiting = (
            f"{topic}: {quantity(n, 'message')} not used, since no transform joins their frame to "
            f"{self.log.fixed_frame}; record /tf_static, or pass the camera poses with "
            "--extrinsics FILE"
            for topic, n in self._waiting.items()
        )
        reader = self.log.reader
        faults = (*self._refused, reader.fault or reader.source.fault)
        late = (
            f"joints that nobody had shown when the results began, and that are not in them: "
            f"{', '.join(names)}; start hiros while somebody is seen whole"
            for names in [self.decoder.left_out]
            if names
        )
        converted = self.log.conversion.warnings()
        return (*super().warnings, *waiting, *filter(None, faults), *late, *converted)

    def _hear(self, message: Message) -> None:
        """Learn of new cameras from a message before it is handed out."""
        if message.channel_id in self._known:
            return
        info = info_of(self.log.reader, message.channel_id)
        is_people = info.has_type(hiros_schemas.SKELETON_GROUP)
        is_wanted = is_people and may_be_read(info, self.log.topics)
        if is_wanted and info.encoding == "cdr":
            self._join(info, message)
            return
        self._known.add(info.id)
        self._refused += [not_used(replace(info, count=0))] if is_wanted else []

    def _join(self, info: ChannelInfo, message: Message) -> None:
        """Read a camera from its first message on that holds somebody in a known place."""
        log = self.log
        log.reader.preface = [message]
        try:
            (camera,), _, _ = skeletons_of(log.reader, log.transforms, [escape(info.topic)])
        except LogError as error:
            self._known.add(info.id)
            self._refused.append(f"{info.topic}: not used: {error.fault}")
            return
        if not camera.frames:
            return
        try:
            for frame in camera.frames:
                log.transforms.lookup(frame, log.fixed_frame, 0)
        except LogError:
            self._waiting[info.topic] += 1
            self._inputs.pop(info.id, None)
            return
        del self._waiting[info.topic]
        self._known.add(info.id)
        rest = [camera for camera in log.cameras if camera.channel.id != info.id]
        taken = {name for camera in rest for name in camera.sources.values()}
        if taken & set(camera.sources.values()):
            names = {source: f"{info.topic}:{source}" for source in camera.sources}
            camera = replace(camera, sources=names)
        self.log = log.joined_by(camera)
        self._use(camera)


@dataclass(frozen=True, eq=False, repr=False)
class LiveLog(Log):
    """A log that is still being written, as known when it was opened by :func:`open_live`."""

    reader: LiveReader
    conversion: LiveConversion = field(kw_only=True)
    """Converts messages of other detectors to SkeletonGroups."""
    log_times: LiveLogTimes = field(kw_only=True)  # corrects log times that cannot be right
    topics: Sequence[str] | None = None  # globs of the channels that are wanted

    is_live = True
    reading = LiveReading

    @property
    def span(self) -> tuple[int, int]:
        """Log times, ns, of the first and the latest message of the cameras."""
        return self.reader.span

    @property
    def remarks(self) -> tuple[str, ...]:
        """Notes about the log."""
        notes = self.conversion.remarks(), self.log_times.remarks()
        remarks = (*super().remarks, *chain(*notes))
        if not self.reader.forgotten:
            return remarks
        n = quantity(self.reader.forgotten, "message")
        return (*remarks, f"{n} from before the first person neither read nor copied")

    def joined_by(self, camera: CameraChannel) -> Self:
        """Return the log with a camera more, or one that has shown nobody until now.

        Results stay in the frame in which they began.
        """
        rest = (known for known in self.cameras if known.channel.id != camera.channel.id)
        return self._but(keep=["fixed_frame"], cameras=(*rest, camera))


def may_be_read(info: ChannelInfo, topics: Sequence[str] | None) -> bool:
    """Whether a channel may show people: as SkeletonGroups, or as another detector's messages.

    For ``topics`` see select_skeletons.
    """
    shows_people = info.has_type(hiros_schemas.SKELETON_GROUP) or is_of_other_detector(info)
    return shows_people and is_selected(info.topic, topics, OUTPUT_PREFIX)


def open_live(
    source: LiveInput,
    *,
    topics: Sequence[str] | None = None,
    extrinsics: str | os.PathLike[str] | None = None,
    fixed_frame: str | None = None,
    rays: Collection[str] = (),
) -> LiveLog:
    """Listen to an MCAP until it is known what is in it: people, cameras, and where they stand.

    That takes a second of the log, or longer if nobody is there. For the parameters see
    :func:`hiros_mcap.io.log.open_log`; ``rays`` are of :class:`LiveConversion`.

    Raises
    ------
    LogError
        the input is not MCAP or damaged; it ends, or ten seconds pass, and there are no skeletons
        or transforms are missing.
    SchemaError
        a camera's message definition is not that of SkeletonGroup.
    ConfigError
        the extrinsics file is wrong.
    """
    tree = None if extrinsics is None else read_extrinsics(Path(extrinsics))
    reader = LiveReader(source)
    selects = partial(is_selected, topics=topics, output_prefix=OUTPUT_PREFIX)
    conversion = LiveConversion(reader, selects, tree, rays)
    log_times = LiveLogTimes(reader)
    reader.steps, reader.faults = [log_times.right, conversion.converted], conversion.faults

    def attempt() -> LiveLog:
        try:
            parts = skeletons_of(reader, tree, topics)
        except OtherSkeletonError:
            reader.preface = conversion.unite(reader.preface)
            parts = skeletons_of(reader, tree, topics)
        cameras, model, transforms = parts
        transforms.unheard = _unheard(reader)
        return LiveLog(
            *(reader, cameras, conversion.known(model), transforms, fixed_frame),
            conversion=conversion,
            log_times=log_times,
            topics=topics,
        )

    log = _listen(reader, attempt)
    with naming(reader.path):
        try:
            log = log or attempt()
        except LogError:
            if conversion.hint:
                raise LogError(conversion.hint) from None
            raise
    conversion.settle(log.model, log.transforms)
    return log


def _listen(reader: LiveReader, attempt: Callable[[], LiveLog]) -> LiveLog | None:
    """Try every now and then to open the log, until there are people, and cameras have places.

    None if the input ends before, or if nobody says for too long where cameras stand. Raises
    SchemaError.
    """
    due = people_since = 0  # log times, ns; 0 before the first skeletons, and people
    for message in reader.listening(_MOST, is_transform_topic):
        now, info = message.log_time, info_of(reader, message.channel_id)
        if not due and info.has_type(hiros_schemas.SKELETON_GROUP):
            due = now + int(LISTEN_S * 1e9)
        if not due or now < due:
            continue
        due = now + int(0.25 * 1e9)
        try:
            log = attempt()
            if any(camera.frames for camera in log.cameras):
                people_since = people_since or now
                _ = log.fixed_frame  # raises if transforms are missing
                return log
        except SchemaError:
            raise
        except LogError:
            if people_since and now - people_since > _PATIENCE_S * 1e9:
                break
    return None


def _unheard(reader: LiveReader) -> str:
    """Say which static transforms are advertised, and came before anybody listened; "" if none."""
    infos = [i for i in channels_of(reader) if is_read(i) and is_static_topic(i.topic)]
    topics = sorted(info.topic for info in infos if not info.count)
    if not topics:
        return ""
    return (
        f"No message of {', '.join(topics)} has come: it was sent before hiros listened, and the "
        "server keeps nothing for those who come later; publish it again, or start hiros first"
    )
