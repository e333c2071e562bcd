"""Which channels of a log hold skeletons, and how the ones that hiros writes are declared.

Whether the messages of a channel are SkeletonGroups tells its schema: their fields must be the
published ones, by name, type and order.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import hiros_schemas
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.errors import LogError, SchemaError
from hiros_mcap.io.container import McapReader, McapWriter, Schema
from hiros_mcap.io.container.records import Channel
from hiros_mcap.io.ros_cdr import CdrWriter, definition
from hiros_mcap.wording import quantity

OUTPUT_PREFIX = "/hiros"
OUTPUT_TOPICS = tuple(
    f"{OUTPUT_PREFIX}/{stage}" for stage in ("tracked", "merged", "optimized", "filtered")
)
"""Of the stages' channels, in the order of the chain."""
EVENTS_ATTACHMENT = "hiros/events.json"
CONFIG_ATTACHMENT = "hiros/config.toml"
"""The parameters in effect."""
REPORT_ATTACHMENT = "hiros/report.json"
"""The summary, without what differs from run to run."""
PROVENANCE = "hiros.provenance"
"""Metadata of how a result came about."""
OTHER_TYPES = (
    "nor another type that hiros reads; for messages of another detector, write a reader of your "
    "own (docs/detectors.md; entry point hiros.detectors)"
)
TRUTH_PREFIX = "/truth"
TF_TOPICS = ("/tf_static", "/tf")
TRANSFORM_TYPES = "tf2_msgs/TFMessage", "tf/tfMessage"
"""``pkg/Type`` of ROS 2 and of ROS 1."""
HUMANS = "hri_msgs/"
"""Package of the types of ROS4HRI, whose bodies are on /tf."""
_TF_NAMES = tuple(topic.strip("/") for topic in TF_TOPICS)
_LISTED = 20
MAX_SCHEMA = 1 << 20
_NAME = hiros_schemas.SKELETON_GROUP
_ENCODINGS = "ros2msg", "ros2idl"
_TIME = "builtin_interfaces/Time"
# The quality of service that rosbag2 offers when it plays a channel: reliable, volatile, keep
# last 10, no deadlines. Numbers, because Humble cannot read the names that later versions write.
RELIABLE_QOS = """\
- history: 1
  depth: 10
  reliability: 1
  durability: 2
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""
LATCHED_QOS = RELIABLE_QOS.replace("depth: 10", "depth: 1").replace(
    "durability: 2", "durability: 1"
)
"""The same for /tf_static, which late subscribers need, too: transient local."""


@dataclass(frozen=True, slots=True)
class ChannelInfo:
    """A channel of a log, whether hiros reads it or not."""

    id: int
    topic: str
    schema: str  # name of the message type, "" if the channel has none
    encoding: str
    count: int  # messages in the file
    metadata: Mapping[str, str]  # as recorded; rosbag2 keeps the quality of service here

    @property
    def type(self) -> str:
        """Type as ``pkg/Type``; "" if it has none, or a name that is none."""
        with suppress(hiros_schemas.DefinitionError):
            return hiros_schemas.short_name(self.schema)
        return ""

    def has_type(self, name: str) -> bool:
        """Whether messages are of a type, ``pkg/msg/Type``; the form ``pkg/Type`` is the same."""
        return self.schema in (name, hiros_schemas.short_name(name))


@dataclass(frozen=True, slots=True)
class CameraChannel:
    """A skeleton channel that is read."""

    channel: ChannelInfo
    sources: Mapping[str, str]
    """The name that each of its cameras goes by; usually there is one camera."""
    frames: tuple[str, ...]  # coordinate frames of its detections; none if nobody is on it
    size: float = math.nan  # size of the first people on it, m; NaN if nobody is
    own_frame: str = ""
    """The frame that its detections are taken to be in, whatever frame its messages name; "" for
    the frame that they name."""
    lag: int = 0  # log time minus stamp, ns, of its first people with a stamp; 0 if there are none
    begin: int = 0  # log time, ns, of the first people on it

    @property
    def topic_frame(self) -> str:
        """The frame that is called as the topic: it is the camera's wherever there is one."""
        return self.channel.topic.strip("/")

    def in_frame(self, name: str) -> CameraChannel:
        """Return the channel with its detections in another frame."""
        return replace(self, frames=(name,), own_frame=name)


def channels_of(reader: McapReader) -> tuple[ChannelInfo, ...]:
    """List the channels of a file in the order of their topics."""
    channels = (info_of(reader, ident) for ident in reader.channels)
    return tuple(sorted(channels, key=lambda info: (info.topic, info.id)))


def skeleton_channels(reader: McapReader) -> list[ChannelInfo]:
    """List the channels of SkeletonGroups, of cameras, results and truths."""
    return [i for i in channels_of(reader) if i.has_type(hiros_schemas.SKELETON_GROUP)]


def info_of(reader: McapReader, ident: int) -> ChannelInfo:
    """Return a channel of a file by its number."""
    channel = reader.channels[ident]
    return ChannelInfo(
        id=ident,
        topic=channel.topic,
        schema=type_name(reader, channel),
        encoding=channel.message_encoding,
        count=reader.counts.get(ident, 0),
        metadata=channel.metadata,
    )


def type_name(reader: McapReader, channel: Channel) -> str:
    """Return the type of a channel, "" if it has none; /tf and /tf_static need not say theirs.

    Channels of one type and different uses have different types here, see ``McapReader.types``.
    """
    if channel.id in reader.types:
        return reader.types[channel.id]
    schema = reader.schema(channel)
    if schema is None:
        moves = channel.message_encoding == "cdr" and is_transform_topic(channel.topic)
        return hiros_schemas.TF_MESSAGE if moves else ""
    return schema.name


def without_definition(reader: McapReader, types: Collection[str]) -> Iterator[str]:
    """Yield a note on each type, of ``types`` (``pkg/Type``), whose definition was not recorded."""
    topics: dict[str, list[str]] = {}
    for channel in reader.channels.values():
        schema, name = reader.schema(channel), type_name(reader, channel)
        if not (schema and schema.data.strip()) and name.replace("/msg/", "/") in types:
            topics.setdefault(name, []).append(channel.topic)
    for name, of_type in topics.items():
        yield (
            f"{', '.join(sorted(of_type))}: recorded without the definition of {name}; hiros takes "
            "the one that it knows"
        )


def select_skeletons(
    channels: Iterable[ChannelInfo],
    topics: Sequence[str] | None = None,
    output_prefix: str = OUTPUT_PREFIX,
) -> tuple[ChannelInfo, ...]:
    """Choose the channels that are the input.

    Parameters
    ----------
    channels : all channels of the log.
    topics : globs of the topics to take; None takes every SkeletonGroup channel but ground truths
        (below /truth).
    output_prefix : first part of the topics that hiros writes. They are never taken, or a person
        would be processed twice.

    Raises
    ------
    LogError
        no channel is left, a glob fits none, or none is in CDR; the message lists what the log has.
    """
    channels = tuple(channels)
    skeletons = [info for info in channels if info.has_type(hiros_schemas.SKELETON_GROUP)]
    if not skeletons:
        raise LogError(f"has no SkeletonGroup channel, {OTHER_TYPES}", listing=_listing(channels))
    detections = [i for i in skeletons if not _is_below(i.topic, output_prefix.rstrip("/"))]
    if topics is None:
        chosen = [i for i in detections if not _is_below(i.topic, TRUTH_PREFIX)]
        if not chosen:
            raise LogError(
                f"has only results below {output_prefix} or truths below {TRUTH_PREFIX}, no "
                "detections of cameras; name the recording instead",
                listing=_listing(channels),
            )
    else:
        for glob in topics:
            if any(fnmatchcase(info.topic, glob) for info in detections):
                continue
            if any(fnmatchcase(info.topic, glob) for info in skeletons):
                raise LogError(
                    f"{glob!r} names only results of hiros, which are not detections of cameras",
                    listing=_listing(channels),
                )
            raise LogError(f"no skeleton channel matches {glob!r}", listing=_listing(channels))
        chosen = [i for i in detections if is_selected(i.topic, topics, output_prefix)]
    chosen = readable(chosen)
    # Without any message, the room was empty.
    return tuple(info for info in chosen if info.count) or tuple(chosen)


def readable(
    channels: Sequence[ChannelInfo], encodings: Collection[str] = ("cdr",)
) -> list[ChannelInfo]:
    """Return the channels of some encodings; raises LogError if there are only others."""
    chosen = [info for info in channels if info.encoding in encodings]
    if channels and not chosen:
        raise not_cdr(channels[0])
    return chosen


def not_used(info: ChannelInfo) -> str:
    """Return a warning that nothing of a channel is used, because of its encoding."""
    count = f"{quantity(info.count, 'message')} " if info.count else ""
    return (
        f"{info.topic}: {count}not used, encoded as {info.encoding!r} and not as CDR; record it "
        "anew, or choose the other channels with --topic"
    )


def not_cdr(info: ChannelInfo) -> LogError:
    """Return the error of a channel whose messages cannot be read."""
    return LogError(
        f"is encoded as {info.encoding!r}, not as CDR; record it anew, or choose other channels "
        "with --topic",
        topic=info.topic,
    )


def is_transform_topic(topic: str) -> bool:
    """Whether a topic is /tf or /tf_static, or one of these in a namespace."""
    return topic.rpartition("/")[2] in _TF_NAMES


def is_static_topic(topic: str) -> bool:
    """Whether a topic is /tf_static, or that in a namespace."""
    return topic.rpartition("/")[2] == _TF_NAMES[0]


def needs_latching(info: ChannelInfo) -> bool:
    """Whether a channel is /tf_static and late subscribers would not get it."""
    profiles = info.metadata.get("offered_qos_profiles", "")
    durabilities = re.findall(r"^[- ]*durability: (\w+)", profiles, re.MULTILINE)
    latched = bool(durabilities) and {*durabilities} <= {"1", "transient_local"}
    return is_static_topic(info.topic) and info.encoding == "cdr" and not latched


def kept_for_late(channel: Channel) -> Channel:
    """Return a channel with the quality of service that keeps it for late subscribers."""
    return replace(channel, metadata={**channel.metadata, "offered_qos_profiles": LATCHED_QOS})


def is_ours(topic: str) -> bool:
    """Whether a topic has results of hiros, or a truth: neither is of a camera."""
    return topic.startswith((f"{OUTPUT_PREFIX}/", f"{TRUTH_PREFIX}/"))


def namespace_of(topic: str) -> str:
    """Return the topic of transforms in a namespace as TransformTree.add takes it."""
    return "" if topic in TF_TOPICS else topic


def is_selected(topic: str, topics: Sequence[str] | None, output_prefix: str) -> bool:
    """Whether :func:`select_skeletons` would take a skeleton channel of this name."""
    if _is_below(topic, output_prefix.rstrip("/")):
        return False
    if topics is None:
        return not _is_below(topic, TRUTH_PREFIX)
    return any(fnmatchcase(topic, glob) for glob in topics)


def add_skeleton_channel(writer: McapWriter, topic: str) -> int:
    """Declare a channel of SkeletonGroup messages as rosbag2 would, return its id."""
    return add_ros_channel(writer, topic, hiros_schemas.SKELETON_GROUP)


def add_static_poses(
    writer: McapWriter, poses: Mapping[str, Rigid], parent: str, stamp: int
) -> None:
    """Write poses of frames in ``parent`` to /tf_static; ``stamp`` in ns is the log time, too."""
    idents = (ident for ident, channel in writer.channels.items() if channel.topic == "/tf_static")
    channel = next(idents, None)
    if channel is None:
        channel = add_ros_channel(writer, "/tf_static", hiros_schemas.TF_MESSAGE, LATCHED_QOS)
    out = CdrWriter()
    out.uint32(len(poses))
    for child, pose in poses.items():
        out.header(stamp, parent)
        out.string(child)
        out.array(pose.translation)
        out.array(pose.xyzw)
    writer.write(channel, stamp, out.finish())


def add_ros_channel(
    writer: McapWriter, topic: str, name: str, qos: str = RELIABLE_QOS, **metadata: str
) -> int:
    """Declare a channel of one of hiros_schemas' types as rosbag2 would, return its id."""
    text = hiros_schemas.text(name).encode()
    idents = (s.id for s in writer.schemas.values() if s.name == name and s.data == text)
    schema = next(idents, None) or writer.add_schema(name, text)
    metadata |= {
        "offered_qos_profiles": qos,
        "topic_type_hash": hiros_schemas.type_hash(name),
    }
    return writer.add_channel(topic, schema, metadata=metadata)


def _is_below(topic: str, prefix: str) -> bool:
    return topic == prefix or topic.startswith(prefix + "/")


def _listing(channels: Sequence[ChannelInfo]) -> str:
    if not channels:
        return "it has no channel at all"
    rows = [f"{i.topic} ({i.schema or 'no type'}, {i.count})" for i in channels[:_LISTED]]
    more = f" and {len(channels) - _LISTED} more" if len(channels) > _LISTED else ""
    return f"its channels: {', '.join(rows)}{more}"


def check_schema(schema: Schema | None, topic: str) -> None:
    """Compare a channel's schema with the published SkeletonGroup, field by field.

    Comments, constants, default values, upper bounds and the names of nested types do not matter.

    Raises SchemaError if the schema is missing, cannot be parsed or has other fields.
    """
    try:
        if schema is None:
            raise hiros_schemas.DefinitionError("has no message definition")
        if difference := _difference(_leaves(schema)):
            raise hiros_schemas.DefinitionError(
                f"schema is not that of {_NAME}: {difference}; convert the messages, or write a "
                "reader of your own (docs/detectors.md)"
            )
    except hiros_schemas.DefinitionError as error:
        raise SchemaError(str(error), topic=topic) from error


def _leaves(schema: Schema) -> list[tuple[str, str]]:
    """Path and type of each field of a schema; raises DefinitionError."""
    if schema.encoding not in _ENCODINGS and schema.data:
        raise hiros_schemas.DefinitionError(
            f"schema encoding {schema.encoding!r} is neither ros2msg nor ros2idl; record it with "
            "rosbag2"
        )
    if hiros_schemas.short_name(schema.name) != hiros_schemas.short_name(_NAME):
        raise hiros_schemas.DefinitionError(f"schema {schema.name!r} is not {_NAME}")
    if len(schema.data) > MAX_SCHEMA:
        raise hiros_schemas.DefinitionError(f"schema is larger than {MAX_SCHEMA} bytes")
    try:
        text = definition(schema.name, schema.encoding, bytes(schema.data).decode())
    except UnicodeDecodeError as error:
        raise hiros_schemas.DefinitionError("schema is not UTF-8 text") from error
    except LogError as error:
        raise hiros_schemas.DefinitionError(error.fault) from error
    # Recorders may leave out the types that every ROS 2 system has built in.
    types = {_TIME: _PUBLISHED[_TIME], **hiros_schemas.parse(schema.name, text)}
    return hiros_schemas.leaves(types, schema.name)


def _difference(leaves: list[tuple[str, str]]) -> str:
    """Name the first field that differs from the published ones, "" if none does."""
    for (path, kind), (expected_path, expected_kind) in zip(leaves, _LEAVES, strict=False):
        if path != expected_path:
            return f"field {path} where {expected_path} is expected"
        if kind != expected_kind:
            return f"field {path} is {kind} instead of {expected_kind}"
    if len(leaves) == len(_LEAVES):
        return ""
    longer = max(leaves, _LEAVES, key=len)[min(len(leaves), len(_LEAVES))][0]
    return f"field {longer} is {'unknown' if len(leaves) > len(_LEAVES) else 'missing'}"


_PUBLISHED = hiros_schemas.parse(_NAME, hiros_schemas.text(_NAME))
_LEAVES = hiros_schemas.leaves(_PUBLISHED, _NAME)
