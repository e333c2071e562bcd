"""A log of skeletons that is still being written: a pipe, or a file that grows.

::

    with open_live(McapInput(0, "standard input")) as log:
        for frame in log.detections():
            ...
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from glob import escape
from itertools import chain
from pathlib import Path
from typing import Any, Self

import hiros_schemas
from hiros_mcap.body.transforms import read_extrinsics
from hiros_mcap.errors import LogError, SchemaError, naming
from hiros_mcap.frames import Block
from hiros_mcap.io.camera_frames import add_transforms, is_read
from hiros_mcap.io.channels import (
    OUTPUT_PREFIX,
    TF_TOPICS,
    CameraChannel,
    ChannelInfo,
    channels_of,
    info_of,
    is_selected,
    is_static_topic,
    is_transform_topic,
    not_used,
    select_skeletons,
)
from hiros_mcap.io.codec import Decoded, Decoder, ModelBuilder, OtherSkeletonError, RestPoses
from hiros_mcap.io.container import Message
from hiros_mcap.io.container.live_input import LiveInput
from hiros_mcap.io.container.live_reader import LiveReader
from hiros_mcap.io.container.reader import Batch
from hiros_mcap.io.detectors.conversion import is_of_other_detector
from hiros_mcap.io.detectors.live_conversion import LiveConversion
from hiros_mcap.io.log import skeletons_of
from hiros_mcap.io.log_accounts import DAMAGED
from hiros_mcap.io.log_times import LiveLogTimes
from hiros_mcap.io.opened_log import Log, Reading
from hiros_mcap.kernels.record_index import START, STOP
from hiros_mcap.skeletons import SkeletonModel
from hiros_mcap.wording import quantity

LISTEN_S = 1.0
"""s of the log's own time: a camera sends several messages in it."""
_PATIENCE_S = 10.0  # how long after the first skeletons transforms may come
_MOST = 20_000  # messages that are kept while nobody is there: about two minutes of five cameras


class LiveDecoder(Decoder):
    """A decoder that leaves out markers and links which the model does not have.

    A recording is read to its end for the model of its skeletons. Live, results begin after a
    second, and some detectors send only the joints that they see. Parameters as of
    :class:`Decoder`.
    """

    def __init__(self, model: SkeletonModel, **options: Any) -> None:
        super().__init__(model, **options)
        self._options = options
        self._builder = ModelBuilder.of(model)
        self._whole = Decoder(model, **options)  # reads all that was ever sent

    @property
    def left_out(self) -> list[str]:
        """Names of the markers that are left out, in the order of their ids."""
        whole, known = self._whole.model, self.model.marker_ids
        pairs = zip(whole.marker_ids, whole.marker_names, strict=True)
        return [name for ident, name in pairs if ident not in known]

    def decode(self, batch: Batch) -> Iterator[Decoded]:
        """Read the messages of a batch; see :meth:`Decoder.decode`."""
        decoded = [*self._whole.decode(batch)]
        if any(some.faults for some in decoded) and self._grow(batch):
            decoded = [*self._whole.decode(batch)]
        is_whole = self._whole.model == self.model
        yield from decoded if is_whole else map(self._reduced, decoded)

    def _grow(self, batch: Batch) -> bool:
        """Learn from messages; say whether they have something new. Damaged ones teach nothing."""
        for records in batch.records:
            for row in records.messages[:, [START, STOP]].tolist():
                start, stop = map(int, row)
                with suppress(LogError):
                    self._builder.add(bytes(records.data[start:stop]), "")
        before, model = self._whole.model, self._builder.build()
        if (model.marker_ids, model.link_ids) == (before.marker_ids, before.link_ids):
            return False
        self._whole = Decoder(model, **self._options)
        return True

    def _reduced(self, decoded: Decoded) -> Decoded:
        """Return what the model has of messages that were read whole."""
        whole, people = self._whole.model, decoded.people
        markers = [whole.marker_ids.index(ident) for ident in self.model.marker_ids]
        links = [whole.link_ids.index(ident) for ident in self.model.link_ids]
        known = people._replace(
            markers=people.markers[:, markers].copy(),
            marker_confidences=people.marker_confidences[:, markers].copy(),
            links=people.links[:, links].copy(),
            link_confidences=people.link_confidences[:, links].copy(),
        )
        zeros = {message: numbers[markers] for message, numbers in decoded.zeros.items()}
        return decoded._replace(people=known, zeros=zeros)


class LiveReading(Reading):
    """The one reading of a log that is still being written.

    Cameras may join. What they send counts from when their place is known: ``log`` is the log as it
    is known so far.
    """

    log: LiveLog

    def __init__(self, log: LiveLog, **how: Any) -> None:
        log = replace(log, transforms=deepcopy(log.transforms))
        self._live: LiveDecoder | None = None  # decoder of the messages; None until the first
        self._faulty: dict[str, str] = {}
        """Topic of no camera yet -> why its first message could not be read."""
        super().__init__(log, **how)
        self._blind = {camera.channel.id for camera in log.cameras if not camera.frames}
        """Channels that have shown nobody yet, so that their frame is not known."""
        self._refused: dict[int, str] = {}
        """Channel -> why it is not read, "" for what holds no detections."""
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
        faults = (*self._refused.values(), reader.fault or reader.source.fault)
        faulty = (f"{topic}: not used: {fault}" for topic, fault in self._faulty.items())
        late, conversion = self._late_joints(), self.log.conversion
        seen = *late, *conversion.seen_lenses.changes.values(), *conversion.rgb.warnings()
        return (*super().warnings, *waiting, *filter(None, faults), *faulty, *seen)

    def _late_joints(self) -> Iterator[str]:
        """Yield which joints came too late for the results."""
        if names := self._live.left_out if self._live else []:
            yield (
                f"joints that nobody had shown when the results began, and that are not in them: "
                f"{', '.join(names)}; start hiros while somebody is seen whole"
            )

    def _decoder(self, model: SkeletonModel, **options: Any) -> Decoder:
        self._live = LiveDecoder(model, **options)
        return self._live

    def _blocks(self, poses: RestPoses | None) -> Iterator[tuple[Sequence[str], Block]]:
        """Account for the messages that could not be converted meanwhile."""
        yield from super()._blocks(poses)
        self._account_for_conversion()

    def _account_for_conversion(self) -> None:
        for topic, (n, first) in self.log.conversion.take_faults().items():
            if topic in self.accounts:
                account = self.accounts[topic]
                account.read += n
                account.skipped[DAMAGED] += n
                account.first_error = account.first_error or first
            else:
                self._faulty[topic] = first

    def _hear(self, message: Message) -> None:
        """Learn from a message before it is handed out: transforms, new cameras."""
        ident = message.channel_id
        if ident in self._refused or (ident in self._inputs and ident not in self._blind):
            return
        info = info_of(self.log.reader, ident)
        topic = info.topic
        if topic in TF_TOPICS or is_read(info):
            if not self.log.transforms.source:
                add_transforms(self.log.transforms, topic, message.data, message.log_time)
            return
        if takes(info, self.log.topics):
            self._join(info, message)
        else:
            is_people = info.has_type(hiros_schemas.SKELETON_GROUP)
            is_wanted = is_people and is_selected(topic, self.log.topics, OUTPUT_PREFIX)
            self._refused[ident] = not_used(replace(info, count=0)) if is_wanted else ""

    def _join(self, info: ChannelInfo, message: Message) -> None:
        """Read a camera from its first message on that holds somebody in a known place."""
        log = self.log
        log.reader.preface = [message]
        try:
            (camera,), _, _ = skeletons_of(log.reader, log.transforms, [escape(info.topic)])
        except LogError as error:
            self._refused[info.id] = f"{info.topic}: not used: {error.fault}"
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
        self._blind.discard(info.id)
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


def takes(info: ChannelInfo, topics: Sequence[str] | None) -> bool:
    """Whether a channel holds detections that are wanted; for ``topics`` see select_skeletons."""
    try:
        return bool(select_skeletons([info], topics))
    except LogError:
        return False


def may_be_read(info: ChannelInfo, topics: Sequence[str] | None) -> bool:
    """Whether a channel may show people: as SkeletonGroups, or as another detector's messages."""
    is_wanted = is_selected(info.topic, topics, OUTPUT_PREFIX)
    return takes(info, topics) or (is_wanted and is_of_other_detector(info))


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
    reader.mend_times, reader.convert = log_times.right, conversion.converted
    reader.rest = conversion.held_back

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

    listener = _Listener(reader, attempt)
    reader.listen(listener.has_heard_enough, _MOST, is_transform_topic)
    with naming(reader.path):
        try:
            log = listener.log or attempt()
        except LogError:
            if conversion.hint:
                raise LogError(conversion.hint) from None
            raise
    conversion.target = log.model  # of cameras of other detectors that come later
    return log


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


class _Listener:
    """Decides when enough was heard: there are people, and it is known where the cameras stand."""

    def __init__(self, reader: LiveReader, attempt: Callable[[], LiveLog]) -> None:
        self.log: LiveLog | None = None
        self._reader = reader
        self._attempt = attempt
        self._next = 0  # log time, ns, of the next attempt; 0 before the first skeletons
        self._people_since = 0

    def has_heard_enough(self, message: Message) -> bool:
        """Try to open the log, every now and then. Raises SchemaError."""
        now = message.log_time
        if not self._next and self._holds_skeletons(message):
            self._next = now + int(LISTEN_S * 1e9)
        if not self._next or now < self._next:
            return False
        self._next = now + int(0.25 * 1e9)
        try:
            log = self._attempt()
            if not any(camera.frames for camera in log.cameras):
                return False
            self._people_since = self._people_since or now
            log.fixed_frame  # noqa: B018  # raises if transforms are missing
        except SchemaError:
            raise
        except LogError:
            since = self._people_since
            return bool(since) and now - since > _PATIENCE_S * 1e9
        self.log = log
        return True

    def _holds_skeletons(self, message: Message) -> bool:
        schema = self._reader.schema(self._reader.channels[message.channel_id])
        name = hiros_schemas.SKELETON_GROUP
        return schema is not None and schema.name in (name, hiros_schemas.short_name(name))
