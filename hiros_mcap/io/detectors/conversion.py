"""A log of other detectors as one of SkeletonGroups of one model.

What is not a SkeletonGroup in CDR, or not of the model that results are to have, is rewritten once
in memory. From there on it is read as any log.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import hiros_schemas
from hiros_mcap.body.body_size import factors_of
from hiros_mcap.body.transforms import parse_tf
from hiros_mcap.body.units import AXES, METRES, by_camera, is_called
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.bags import MemoryReader
from hiros_mcap.io.channels import (
    HUMANS,
    LATCHED_QOS,
    TRANSFORM_TYPES,
    ChannelInfo,
    add_ros_channel,
    add_skeleton_channel,
    channels_of,
    check_schema,
    is_static_topic,
    is_transform_topic,
    not_cdr,
    readable,
)
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapReader, McapWriter, Message
from hiros_mcap.io.detectors import detector_readers, types_read
from hiros_mcap.io.detectors.body_models import name_of
from hiros_mcap.io.detectors.detector_reader import DetectorMessage, DetectorReader, SeenPeople
from hiros_mcap.io.detectors.keypoint_messages import (
    DETECTIONS_IN_SPACE,
    JOINTS,
    KEYPOINT_TYPES,
    LATE,
    has_keypoints_in_space,
)
from hiros_mcap.io.detectors.model_fitting import UNION, Fit, chosen_model
from hiros_mcap.io.detectors.rgb_keypoints import RGB_TOPIC, RgbKeypoints, RgbRig
from hiros_mcap.io.ros_cdr import (
    RosMessage,
    cdr_of,
    decoder_of,
    definition,
    long_name,
    types_of,
)
from hiros_mcap.rays.skeleton_rays import NONE_GUESSED
from hiros_mcap.skeletons import Floats, SkeletonModel
from hiros_mcap.wording import quantity

SKELETONS = hiros_schemas.short_name(hiros_schemas.SKELETON_GROUP)
TRANSFORMS = hiros_schemas.short_name(hiros_schemas.TF_MESSAGE)
LENSES = hiros_schemas.short_name(hiros_schemas.CAMERA_INFO)
ENCODINGS = "cdr", "ros1"
"""Of messages that can be read, as they are or converted."""
_PROBED = 16 * 2**20
"""Bytes of a channel that are looked at to learn whether it shows people, and which joints."""
_PEOPLE = 30
"""Messages with people that tell whether a detector has depths."""
_LISTED = 12


class Selection(NamedTuple):
    """The topics to read, the unit of their positions, and the skeleton of the results."""

    model: str = ""
    """As in :func:`hiros_mcap.io.detectors.model_fitting.chosen_model`."""
    unit: str = "m"
    """Of the positions in the log; as :func:`~hiros_mcap.body.body_size.by_camera` reads it."""
    negate: str = ""
    """Axis whose sign is changed, in the same way."""
    selects: Callable[[str], bool] = lambda _: True
    """Says of a topic whether its skeletons are wanted."""
    several: bool = False
    """The log is known to have several models."""
    rig: RgbRig | None = None
    """The RGB cameras of the log; None = their keypoints are not read."""
    refine: bool = True
    """Whether poses and clocks of RGB cameras may be those that the people tell."""

    @property
    def is_usual(self) -> bool:
        """Whether SkeletonGroups can stay as they are."""
        guesses = self.rig is not None and bool(self.rig.guessed.models)
        plain = (self.model, self.unit, self.negate) == ("", "m", "")
        return plain and not (self.several or guesses)


class InputChannel(NamedTuple):
    """A channel that may hold skeletons, or that is copied."""

    info: ChannelInfo
    type: str
    """``pkg/Type``."""
    selected: bool
    """Whether its skeletons are wanted; others are copied."""
    is_native: bool
    """Whether it has a type and an encoding that hiros reads without a conversion."""
    cdr: Callable[[Any], Any]
    decode: Callable[[Any], Any]

    @property
    def needs_conversion(self) -> bool:
        """Whether a log with this channel is converted; transforms may show humans."""
        return not self.is_native or (self.selected and self.type == TRANSFORMS)

    def message(self, message: Message) -> DetectorMessage:
        """Return a message of it as readers take it; raises LogError for damaged bytes."""
        return DetectorMessage(
            self.info.topic, self.type, message.log_time, self.cdr(message.data), self.decode
        )


def is_of_other_detector(info: ChannelInfo) -> bool:
    """Whether a channel has a type that a reader converts; transforms do not count."""
    return info.type in types_read() - {SKELETONS, *TRANSFORM_TYPES}


def converted(reader: McapReader, selection: Selection) -> McapReader:
    """Return a reader of the same log in SkeletonGroups: itself if it holds nothing else.

    ``reader`` stays open. Raises LogError, and ConfigError for a model that is not there.
    """
    sources = _sources(reader, selection)
    _check_names(selection, [source.info.topic for source in sources if source.selected])
    if selection.is_usual and not any(source.needs_conversion for source in sources):
        return reader
    layouts, hints = _probe(reader, sources, selection.rig)
    if hints and not layouts and not any(s.type == SKELETONS and s.selected for s in sources):
        raise LogError(hints[0])
    chosen = [
        s._replace(selected=s.selected and s.info.topic in layouts)
        for s in sources
        if s.info.topic in layouts or not s.selected or s.type == TRANSFORMS
    ]
    if not layouts:
        return reader
    if selection.is_usual and not any(source.needs_conversion for source in chosen):
        return reader
    conversion = Conversion(reader, selection, chosen, layouts)
    new = MemoryReader(Path(reader.path), conversion.write, reader.memory)
    new.checked, new.recovery = reader.has_checksums, reader.recovery
    new.left_out = {**reader.left_out, **conversion.left_out}
    new.remarks = (*reader.remarks, *conversion.remarks())
    new.warnings = (*reader.warnings, *conversion.warnings())
    new.rig = selection.rig
    new.faults = conversion.faults
    return new


def _check_names(selection: Selection, topics: Sequence[str]) -> None:
    """Raise ConfigError if a unit or an axis is of a camera that is not there."""
    units, axes = by_camera(selection.unit, METRES), by_camera(selection.negate, AXES)
    for name, named in (("--unit", units), ("--negate", axes)):
        for camera in named:
            if camera and not any(is_called(topic, camera) for topic in topics):
                raise ConfigError(
                    f"{name}: there is no camera {camera!r}; name a topic or a part of it: "
                    f"{', '.join(sorted(topics))}"
                )


def of_people(reader: McapReader, selects: Callable[[str], bool]) -> list[ChannelInfo]:
    """Return the wanted channels with messages of the types that readers take; no transforms."""
    types = types_read()
    infos = (i for i in channels_of(reader) if i.count and i.type in types)
    return [info for info in infos if info.type not in TRANSFORM_TYPES and selects(info.topic)]


def _sources(reader: McapReader, selection: Selection) -> list[InputChannel]:
    """Return the channels that may show people, and those that are copied as they are."""
    types = types_read()
    types |= {LENSES} if selection.rig is not None else set()
    infos = [i for i in channels_of(reader) if i.count and i.type in types]
    selected_infos = readable(of_people(reader, selection.selects), ENCODINGS)
    sources = []
    for info in infos:
        moves = info.type in TRANSFORM_TYPES
        selected = info in selected_infos
        if selection.rig is not None and info.topic == RGB_TOPIC:
            continue  # of a former run, which made it of the same keypoints
        copied = info.type in (SKELETONS, LENSES) and info.encoding in ENCODINGS
        if selected or (moves and is_transform_topic(info.topic)) or copied:
            sources.append(source_of(reader, info, selected=selected))
    # Every log has transforms. Those of humans are looked for where something hints at them.
    hints = any(i.schema.startswith(HUMANS) for i in channels_of(reader))
    if hints or not any(source.selected for source in sources):
        sources = [s._replace(selected=True) if s.type == TRANSFORMS else s for s in sources]
    return sources


def name_detections(reader: McapReader) -> None:
    """Let ``reader.types`` tell channels of detections whose keypoints are in space.

    They are told by the first people on them.
    """
    for info in channels_of(reader):
        is_named = info.has_type(hiros_schemas.DETECTION_ARRAY)
        if not (is_named and info.count and info.encoding in ENCODINGS):
            continue
        source, found = source_of(reader, info, selected=True), list[bool]()
        for message in reader.messages({info.id}):
            with suppress(LogError):
                in_space = has_keypoints_in_space(source.message(message))
                found += [] if in_space is None else [in_space]
            if len(found) >= _PEOPLE or any(found):
                break
        if any(found):
            reader.types = {**reader.types, info.id: DETECTIONS_IN_SPACE}


def source_of(reader: McapReader, info: ChannelInfo, *, selected: bool) -> InputChannel:
    """Prepare a channel; raises LogError for a definition that cannot be used."""
    schema = reader.schema(reader.channels[info.id])
    name = info.type
    kind = TRANSFORMS if name in TRANSFORM_TYPES else name
    if info.encoding not in ENCODINGS:
        raise not_cdr(info)
    if schema is None or (info.encoding == "cdr" and name == TRANSFORMS):
        return InputChannel(info, kind, selected, is_native=True, cdr=_same, decode=_same)
    if info.encoding == "cdr" and name == SKELETONS:
        if selected:
            check_schema(schema, info.topic)
        return InputChannel(info, kind, selected, is_native=True, cdr=_same, decode=_same)
    text = definition(name, schema.encoding, bytes(schema.data).decode(errors="replace"))
    store = types_of((name, text))
    cdr: Callable[[Any], Any] = cdr_of(store, name) if info.encoding == "ros1" else _same
    return InputChannel(info, kind, selected, False, cdr, decoder_of(store, name))


def _same(data: Any) -> Any:
    return data


def _read(readers: Iterable[DetectorReader], message: DetectorMessage) -> list[SeenPeople] | None:
    """Return what the first reader that does not decline finds; None if all do."""
    for reader in readers:
        if message.type in reader.types:
            people = reader.read(message)
            if people is not None:
                return _checked(reader, people)
    return None


def _checked(reader: DetectorReader, people: Any) -> list[SeenPeople]:
    """Return what a reader gives; raises ConfigError, which names it, where that is no people."""
    given = list(people) if isinstance(people, Iterable) else [people]
    for one in given:
        fits = isinstance(one, SeenPeople) and one.frame.markers.shape[1] == one.model.n_markers
        if not fits:
            kind = type(reader)
            raise ConfigError(
                f"the detector reader {kind.__module__}.{kind.__qualname__} gives "
                f"{type(one).__name__} where SeenPeople of its model are due; mend its read()"
            )
    return given


def _probe(
    reader: McapReader, sources: Iterable[InputChannel], rig: RgbRig | None
) -> tuple[dict[str, dict[str, SkeletonModel]], list[str]]:
    """Look at the beginning of the channels: topic -> output topic -> model of its skeletons.

    Also return why messages that look like skeletons are none.

    A channel is not in there if no message of its first _PROBED bytes shows people; transforms
    are looked at to their end.
    """
    selected = [source for source in sources if source.selected]
    filmed = rig.models if rig is not None else {}
    others = [s for s in selected if s.type not in (TRANSFORMS, *KEYPOINT_TYPES)]
    groups = [[s] for s in others if s.info.topic not in filmed]
    transforms = [s for s in selected if s.type == TRANSFORMS]
    layouts = {topic: {RGB_TOPIC: model} for topic, model in filmed.items()}
    hints: list[str] = []
    for group in [*groups, transforms] if transforms else groups:
        readers = [kind() for kind in detector_readers()]
        models = _models_of(reader, group, readers)
        hints += (reader.hint for reader in readers if reader.hint)
        if models:
            layouts |= {source.info.topic: models for source in group}
    return layouts, hints


def _models_of(
    reader: McapReader, group: Iterable[InputChannel], readers: Sequence[DetectorReader]
) -> dict[str, SkeletonModel]:
    """Return the models that channels show, by output topic."""
    sources = {source.info.id: source for source in group}
    models: dict[str, SkeletonModel] = {}
    size = 0
    for message in reader.messages(sources):
        source = sources[message.channel_id]
        size += len(message.data)
        with suppress(LogError):
            for people in _read(readers, source.message(message)) or ():
                models[people.topic] = people.model
        whole = all(model.is_whole for model in models.values()) if models else False
        if source.type != TRANSFORMS and (whole or size > _PROBED):
            break
    for people in (s for r in readers for s in _checked(r, r.rest())) if not models else ():
        models[people.topic] = people.model
    return models


class Conversion:
    """Turns the skeletons of a log into SkeletonGroups of one model, and copies its transforms.

    Attributes
    ----------
    target : the model; None = each topic keeps its own.
    left_out : type and number of messages of every topic that is not taken over.
    faults : by topic, number of messages that cannot be decoded, and why the first one cannot.
    copies_images : whether keypoints are copied beside the skeletons that they become.
    """

    copies_images = True

    def __init__(
        self,
        reader: McapReader,
        selection: Selection,
        sources: Iterable[InputChannel],
        layouts: Mapping[str, Mapping[str, SkeletonModel]],
    ) -> None:
        self._reader, self._layouts = reader, dict(layouts)
        self._selection = selection
        self._sources = {source.info.id: source for source in sources}
        self._models = {t: m for models in layouts.values() for t, m in models.items()}
        self.target: SkeletonModel | None = None
        if layouts:
            self.target = chosen_model(self._selection.model, self._models)
        self._readers = [kind() for kind in detector_readers()]
        self.rgb = next(r for r in self._readers if isinstance(r, RgbKeypoints))
        self.rgb.rig = selection.rig
        self._guessed = selection.rig.guessed if selection.rig else NONE_GUESSED
        self._fits: dict[tuple[str, SkeletonModel, SkeletonModel], tuple[Fit, Encoder]] = {}
        self._ids: dict[str, int] = {}
        self._missing: dict[str, Counter[str]] = {}
        self._declined: Counter[str] = Counter()
        self.faults: dict[str, tuple[int, str]] = {}
        self.left_out = {
            info.topic: (info.schema or "no type", info.count)
            for info in channels_of(reader)
            if info.id not in self._sources
        }

    def write(self, writer: McapWriter) -> None:
        """Write the log; a message that cannot be decoded is counted."""
        writer.append_extras(self._reader)
        messages = self._reader.messages(self._sources)
        rewritten = (self.rewritten(self._sources[m.channel_id], m) for m in messages)
        for outgoing in chain(rewritten, [self.rest()]):
            for topic, kind, log_time, data in outgoing:
                writer.write(self._channel(writer, topic, kind), log_time, data)

    def rewritten(self, source: InputChannel, message: Message) -> Iterator[RosMessage]:
        """Yield what a message becomes; one that cannot be decoded is counted.

        Transforms are copied, and may show humans besides. Others either are copied, or become the
        skeletons in them.
        """
        topic, moves = source.info.topic, source.type == TRANSFORMS
        images = source.type in KEYPOINT_TYPES
        copies = (
            moves
            or (images and self.copies_images)
            or not source.selected
            or (self._fits_target(source) and topic not in self._guessed.models)
        )
        reads = source.selected and (moves or images or not copies)
        try:
            converted = source.message(message)
            people = _read(self._readers, converted) if reads else None
            if copies and not (moves and people is not None and _is_of_one_body(converted.cdr)):
                yield RosMessage(topic, source.type, message.log_time, bytes(converted.cdr))
        except LogError as error:
            n, first = self.faults.get(topic, (0, error.fault))
            self.faults[topic] = n + 1, first
            return
        if reads and people is None and not moves:
            self._declined[topic] += 1
        yield from self._groups(people or ())

    @property
    def hint(self) -> str:
        """Why messages that look like skeletons are none, if no channel shows any; else ""."""
        hints = (reader.hint for reader in self._readers if reader.hint)
        return "" if self._models else next(hints, "")

    def known(self, model: SkeletonModel) -> SkeletonModel:
        """Return the detector's model, or the target, that has all of ``model``; itself if none.

        Joints that nobody has shown yet may come.
        """
        for whole in filter(None, (self.target, *self._models.values())):
            if set(_named_slots(model)) <= set(_named_slots(whole)):
                return whole
        return model

    def rest(self) -> Iterator[RosMessage]:
        """Yield what is held back until the end of the log."""
        for reader in self._readers:
            yield from self._groups(_checked(reader, reader.rest()))

    def _channel(self, writer: McapWriter, topic: str, kind: str) -> int:
        """Return the channel of a topic, which is added when it is first needed."""
        if topic not in self._ids:
            if kind == SKELETONS:
                self._ids[topic] = add_skeleton_channel(writer, topic)
            elif kind == TRANSFORMS:
                qos = [LATCHED_QOS] if is_static_topic(topic) else []
                self._ids[topic] = add_ros_channel(writer, topic, hiros_schemas.TF_MESSAGE, *qos)
            else:
                self._ids[topic] = add_ros_channel(
                    writer, topic, long_name(kind), **self._said(topic)
                )
        return self._ids[topic]

    def _said(self, topic: str) -> Mapping[str, str]:
        """Return what the metadata of a channel of keypoints say, and by how much it is late."""
        info = next(s.info for s in self._sources.values() if s.info.topic == topic)
        said = {JOINTS: info.metadata[JOINTS]} if JOINTS in info.metadata else {}
        late = self.rgb.rig.late.get(topic, 0.0) if self.rgb.rig else 0.0
        return said | ({LATE: f"{late:.6f}"} if late else {})

    def _fits_target(self, source: InputChannel) -> bool:
        """Whether a channel has SkeletonGroups of the model that results are to have, in m."""
        model = self._models.get(source.info.topic)
        fits = self.target in (None, model) and (self._factors(source.info.topic) == 1.0).all()
        return source.type == SKELETONS and bool(fits)

    def _factors(self, topic: str) -> Floats:
        """(3,) factors of the positions on a topic; that of RGB cameras is made by hiros."""
        if topic == RGB_TOPIC:
            return np.ones(3)
        return factors_of(topic, self._selection.unit, self._selection.negate)

    def _groups(self, people: Iterable[SeenPeople]) -> Iterator[RosMessage]:
        """Yield people as SkeletonGroups."""
        for topic, model, frame in people:
            if not (self._selection.selects(topic) or topic == RGB_TOPIC):
                continue
            if topic in self._guessed.models:
                fit, _ = self._fit(topic, model, self._guessed.models[topic])
                yield from self._groups(self.rgb.take(topic, fit(frame)))
                continue
            self._models.setdefault(topic, model)
            fit, encoder = self._fit(topic, model, self.target or model)
            if names := fit.left_out(frame):
                self._missing.setdefault(topic, Counter()).update(names)
            yield RosMessage(topic, SKELETONS, frame.log_time, encoder.encode(fit(frame)))

    def _fit(self, topic: str, model: SkeletonModel, target: SkeletonModel) -> tuple[Fit, Encoder]:
        """Return what turns frames of a topic into those, and into messages, of another model."""
        key = topic, model, target
        if key not in self._fits:
            self._fits[key] = Fit(model, target, self._factors(topic)), Encoder(target)
        return self._fits[key]

    def remarks(self) -> Iterator[str]:
        """Say what was converted, and what was left out."""
        topics: dict[tuple[str, str], dict[str, None]] = {}
        for source in self._sources.values():
            for topic, model in self._layouts.get(source.info.topic, {}).items():
                if source.needs_conversion:
                    key = source.info.schema, _named(model)
                    topics.setdefault(key, {})[topic] = None
        for (schema, name), of_model in topics.items():
            yield f"{', '.join(of_model)}: {schema} read as skeletons ({name})"
        yield from self._fusion()
        for topic, missing in self._missing.items():
            names = ", ".join([*missing][:_LISTED]) + (", ..." if len(missing) > _LISTED else "")
            yield (
                f"{topic}: the skeleton model of the results has no place for "
                f"{quantity(len(missing), 'joint')}, left out of "
                f"{quantity(max(missing.values()), 'message')}: {names}"
            )
        for reader in self._readers:
            yield from reader.remarks()
        for topic, n in self._declined.items():
            if n:
                yield f"{topic}: {quantity(n, 'message')} without skeletons left out"

    def warnings(self) -> Iterator[str]:
        """Say which transforms were left out; those of cameras are in their accounts."""
        yield from self.rgb.warnings()
        for topic, (n, first) in self.faults.items():
            if topic not in self._models:
                yield f"{topic}: {quantity(n, 'message')} left out; the first one: {first}"

    def _fusion(self) -> Iterator[str]:
        """Say which models became one."""
        by_model: dict[SkeletonModel, list[str]] = {}
        for topic, model in self._models.items():
            by_model.setdefault(model, []).append(topic)
        if self.target is None or set(by_model) <= {self.target}:
            return
        models = "; ".join(f"{_named(m)}: {', '.join(t)}" for m, t in by_model.items())
        which = "their union" if self._selection.model in ("", UNION) else _named(self.target)
        yield (
            f"skeletons are fused by the names of their joints ({models}); results have {which}, "
            f"{self.target.n_markers} markers. Orientations are left out, since every detector has "
            "its own axes; --model chooses another skeleton"
        )


def _is_of_one_body(transforms: Any) -> bool:
    """Whether all frames of a message belong to one human, so that no camera needs them."""
    return len({t.child.rpartition("_")[2] for t in parse_tf(transforms)}) == 1


def _named_slots(model: SkeletonModel) -> Iterator[tuple[int, str]]:
    """Yield id and name of each marker and each link."""
    yield from zip(model.marker_ids, model.marker_names, strict=True)
    yield from zip(model.link_ids, model.link_names, strict=True)


def _named(model: SkeletonModel) -> str:
    return name_of(model) or quantity(model.n_markers, "marker")
