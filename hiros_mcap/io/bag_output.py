"""Output as a ROS 2 bag.

It is a folder ``lab`` with ``lab_0.mcap`` and ``metadata.yaml``, which ``ros2 bag info`` and
``ros2 bag play`` read, with static transforms for late subscribers.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hiros_mcap._version import __version__
from hiros_mcap.errors import LogError
from hiros_mcap.io.bag_files import METADATA
from hiros_mcap.io.channels import LATCHED_QOS, ChannelInfo, channels_of, is_static_topic
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.io.ros_cdr import ros2_types
from hiros_mcap.outputs import BAG_MARK, bag_files, target_kind, write_text

_VERSION = 8  # the releases of ROS 2 from Humble on can read it


@contextmanager
def output_file(target: str | os.PathLike[str] | None) -> Iterator[Path | None]:
    """Yield the MCAP file to write: the target, or that of a rosbag2 folder.

    A folder gets its metadata when the block succeeds. An error leaves no new folder behind.

    Raises LogError if a channel cannot be in a bag, or the folder cannot be written.
    """
    if target is None or target_kind(target) == "log":
        yield None if target is None else Path(target)
        return
    folder = Path(target)
    is_new = not folder.exists()
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise LogError(f"cannot be written: {error.strerror or error}", path=folder) from None
    mcap, _ = bag_files(folder)
    try:
        yield mcap
        write_bag_metadata(mcap)
    except BaseException:
        if is_new:
            with suppress(OSError):
                mcap.unlink(missing_ok=True)
                folder.rmdir()
        raise


def refuse_foreign_encodings(channels: Iterable[ChannelInfo], target: Path) -> None:
    """Raise LogError if a channel is not in CDR, which all of a bag must be in."""
    for info in channels:
        if info.encoding != "cdr":
            raise LogError(
                f"a ROS 2 bag cannot hold {info.topic}, which is encoded as {info.encoding!r}; "
                "choose what is copied with --keep, or write an MCAP file",
                path=target.parent,
            )


def needs_latching(info: ChannelInfo) -> bool:
    """Whether a channel is /tf_static and late subscribers would not get it."""
    profiles = info.metadata.get("offered_qos_profiles", "")
    if not is_static_topic(info.topic) or profiles == LATCHED_QOS or info.encoding != "cdr":
        return False
    if not profiles:
        return True
    from rosbags.interfaces import QosDurability
    from rosbags.rosbag2.errors import ReaderError
    from rosbags.rosbag2.metadata import parse_qos

    try:
        settings = parse_qos(profiles)
    except (ReaderError, KeyError, TypeError):
        return True  # players could not read it either
    return not settings or any(qos.durability != QosDurability.TRANSIENT_LOCAL for qos in settings)


def copy_latched(reader: McapReader, writer: McapWriter, channels: Iterable[ChannelInfo]) -> None:
    """Copy channels whole, with a quality of service that keeps them for late subscribers."""
    for info in channels:
        channel = reader.channels[info.id]
        schema = reader.schema(channel)
        ident = 0 if schema is None else writer.add_schema(schema.name, schema.data)
        metadata = {**channel.metadata, "offered_qos_profiles": LATCHED_QOS}
        copy = writer.add_channel(info.topic, ident, metadata=metadata)
        for message in reader.messages([info.id]):
            writer.write_message(copy, message)


def write_bag_metadata(mcap: Path) -> None:
    """Write metadata.yaml beside an MCAP file, which makes its folder a ROS 2 bag.

    Raises LogError if it cannot be written.
    """
    write_text(mcap.with_name(METADATA), _as_yaml(bag_metadata(mcap)))


def bag_metadata(mcap: Path) -> dict[str, Any]:
    """Describe an MCAP file as rosbag2 does, for metadata.yaml."""
    with McapReader(mcap) as reader:
        topics = [_topic(reader, info) for info in channels_of(reader)]
        chunks = [chunk for chunk in reader.contents.chunks if chunk.start_time or chunk.end_time]
        start = min((chunk.start_time for chunk in chunks), default=0)
        duration = max((chunk.end_time for chunk in chunks), default=0) - start
    count = sum(topic["message_count"] for topic in topics)
    return {
        "version": _VERSION,
        "storage_identifier": "mcap",
        **_times(start, duration, count),
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [mcap.name],
        "files": [{"path": mcap.name, **_times(start, duration, count)}],
        "custom_data": {"hiros": __version__},
        "ros_distro": "rosbags",
    }


def _times(start: int, duration: int, count: int) -> dict[str, Any]:
    return {
        "starting_time": {"nanoseconds_since_epoch": start},
        "duration": {"nanoseconds": duration},
        "message_count": count,
    }


def _topic(reader: McapReader, info: ChannelInfo) -> dict[str, Any]:
    package, _, name = info.schema.rpartition("/")
    kind = f"{package.removesuffix('/msg')}/msg/{name}"
    return {
        "topic_metadata": {
            "name": info.topic,
            "type": kind,
            "serialization_format": info.encoding,
            # rosbags finds no messages of a channel whose own metadata says something else.
            "offered_qos_profiles": info.metadata.get("offered_qos_profiles", ""),
            "type_description_hash": info.metadata.get("topic_type_hash")
            or _type_hash(reader, info, kind),
        },
        "message_count": info.count,
    }


def _type_hash(reader: McapReader, info: ChannelInfo, kind: str) -> str:
    """Return the RIHS01 hash of a channel's definition, "" if it cannot be understood."""
    schema = reader.schema(reader.channels[info.id])
    if schema is None or schema.encoding != "ros2msg":
        return ""
    try:
        return str(ros2_types({kind: schema.data.decode()}).hash_rihs01(kind))
    except (LogError, KeyError, UnicodeDecodeError):
        return ""


def _as_yaml(metadata: dict[str, Any]) -> str:
    from io import StringIO

    from ruamel.yaml import YAML

    yaml, text = YAML(typ="safe", pure=True), StringIO()
    yaml.default_flow_style, yaml.width = False, 200
    yaml.dump({"rosbag2_bagfile_information": metadata}, text)
    return BAG_MARK + text.getvalue()
