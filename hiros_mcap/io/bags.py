"""ROS bags: read, also as recordings of several files, and written for ROS 2 to play.

hiros reads one MCAP file. What is recorded otherwise becomes one in memory, the skeletons and the
transforms of it: ROS 2 messages byte for byte, ROS 1 messages as the ROS 2 messages of the same
fields, by the rosbags library. Chunks are compressed, so that it takes as much memory as the file.

What hiros writes for ROS 2 is a folder ``lab`` with ``lab_0.mcap`` and ``metadata.yaml``, which
``ros2 bag info`` and ``ros2 bag play`` read, with static transforms for late subscribers. Its
version is 8, since the releases from Humble on can read it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hiros_schemas
from hiros_mcap._version import __version__
from hiros_mcap.errors import LogError
from hiros_mcap.io.channels import (
    LATCHED_QOS,
    OTHER_FILES,
    ChannelInfo,
    channels_of,
    is_static_topic,
)
from hiros_mcap.io.container import (
    McapReader,
    McapWriter,
    MemorySink,
    RecoveringReader,
    Recovery,
)
from hiros_mcap.io.container.reader import MEMORY
from hiros_mcap.io.container.salvage import RECOVERY_METADATA, Damage, Lost, joined
from hiros_mcap.io.detectors import detector_readers
from hiros_mcap.io.ros_cdr import ros2_types, types_of
from hiros_mcap.outputs import BAG_MARK, bag_files, check_outputs, target_kind, write_text

if TYPE_CHECKING:
    from rosbags.interfaces import Connection


_MAGIC = {b"#ROSBAG V2.0": "a ROS 1 bag", b"SQLite format 3": "a SQLite bag"}
_FOLDER = "metadata.yaml"  # what makes a folder a rosbag2 recording
_HUMANS = "hri_msgs/"  # its bodies are on /tf


def _wanted() -> set[str]:
    """Types that are taken over: those of the detectors, and transforms."""
    return {name for reader in detector_readers() for name in reader.types}


def _shows_people(name: str) -> bool:
    """Whether a type may hold skeletons, or says that transforms do."""
    short = hiros_schemas.short_name(name)
    transforms = ("tf2_msgs/TFMessage", "tf/tfMessage")
    return short.startswith(_HUMANS) or (short in _wanted() and short not in transforms)


def kind_of(path: Path) -> str:
    """Return what kind of bag a path is; "" for a file that is none, such as an MCAP."""
    if path.is_dir():
        return "a rosbag2 folder" if (path / _FOLDER).is_file() else ""
    if not path.is_file():  # opening a pipe would wait for its writer
        return ""
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError:
        return ""
    return next((kind for magic, kind in _MAGIC.items() if start.startswith(magic)), "")


def parts_of(path: Path, *, recover: bool = False) -> list[Path]:
    """Return the MCAP files of a recording in their order; empty for a bag of another kind.

    A rosbag2 folder lists them in metadata.yaml. After a power loss this file is missing or empty.
    With ``recover``, all MCAP files of the folder are then taken, in the order of their numbers.

    Raises LogError for a folder without a list of files.
    """
    if not path.is_dir():
        return [] if kind_of(path) else [path]
    inside = sorted(path.glob("*.mcap"), key=_numbered)
    listed = _listed(path / _FOLDER)
    if listed is not None and not recover:
        return [path / name for name in listed] if len(listed) > 1 else inside[:1]
    if recover and inside:
        return sorted({*inside, *(path / name for name in listed or ())}, key=_numbered)
    if len(inside) == 1 or (path / _FOLDER).is_file():
        return inside[:1] if len(inside) == 1 else []
    raise LogError(
        f"is a folder with {len(inside)} MCAP files; name one"
        + (", or join them by `hiros recover FOLDER -o OUT`" if inside else ""),
        path=path,
    )


def _numbered(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Key that puts bag_2 before bag_10."""
    parts = re.findall(r"\d+|\D+", path.stem)
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in parts], path.name


def _listed(metadata: Path) -> list[str] | None:
    """Return the names of plain MCAP files in a metadata.yaml; None if it lists none."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        text = metadata.read_text(encoding="utf-8")
        info = YAML(typ="safe").load(text)["rosbag2_bagfile_information"]
        names = [Path(name).name for name in info["relative_file_paths"]]
        compressed = (info.get("compression_mode") or "none").lower() != "none"
    except (OSError, YAMLError, TypeError, KeyError, ValueError, AttributeError):
        return None
    plain = names and not compressed and all(name.endswith(".mcap") for name in names)
    return names if plain else None


class MemoryReader(McapReader):
    """Reads an MCAP in memory that was made of another recording.

    Parameters
    ----------
    path : of the recording. write : writes the MCAP. memory : bytes that reading may take.

    Attributes
    ----------
    checked : whether checksums cover every message of the recording; rosbags compares none.
    """

    checked = False

    def __init__(self, path: Path, write: Callable[[McapWriter], object], memory: int) -> None:
        sink = MemorySink(path)
        with McapWriter(sink) as writer:
            write(writer)
            writer.commit()
        super().__init__(sink.file, memory=memory)

    @property
    def has_checksums(self) -> bool:
        """Whether a damaged message of the recording is noticed."""
        return self.checked


def _takes(wanted: str, topic: str, name: str) -> bool:
    """Whether messages of a topic and a type are taken over: of people, or the wanted topic."""
    return topic == wanted if wanted else hiros_schemas.short_name(name) in _wanted()


def read_bag(path: Path, kind: str, *, memory: int = MEMORY, topic: str = "") -> McapReader:
    """Read the skeletons and transforms of a bag, or the named topic, as an MCAP in memory.

    Raises LogError if the bag is damaged, or holds no skeletons and no topic was named.
    """
    left_out: dict[str, tuple[str, int]] = {}

    def write(writer: McapWriter) -> None:
        with open_bag(path, kind) as bag:
            taken = [c for c in bag.connections if _takes(topic, c.topic, c.msgtype)]
            for connection in bag.connections:
                if connection not in taken:
                    _, n = left_out.get(connection.topic, ("", 0))
                    left_out[connection.topic] = (connection.msgtype, n + connection.msgcount)
            if not topic and not any(_shows_people(c.msgtype) for c in bag.connections):
                topics = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in bag.connections}))
                fault = f"has no SkeletonGroup topic; {OTHER_FILES}; it has {topics or 'none'}"
                raise LogError(fault, path=path)
            if taken:  # else rosbags would yield all messages
                _convert(bag, taken, writer)

    reader = MemoryReader(path, write, memory)
    reader.left_out = left_out
    return reader


def _convert(bag: Any, taken: Sequence[Connection], writer: McapWriter) -> None:
    """Write the messages of some connections of a bag."""
    texts = {connection.msgtype: connection.msgdef.data for connection in taken}
    store = bag.typestore if bag.is2 else types_of(texts)
    channels: dict[tuple[str, str], int] = {}
    schemas: dict[str, int] = {}
    for connection in taken:
        name = connection.msgtype
        if name not in schemas:
            text = store.generate_msgdef(name, ros_version=2)[0]
            schemas[name] = writer.add_schema(name, text.encode())
        key = connection.topic, name
        if key not in channels:
            channels[key] = writer.add_channel(
                connection.topic, schemas[name], metadata=_metadata(connection)
            )
    for connection, time, data in bag.messages(taken):
        channel = channels[connection.topic, connection.msgtype]
        cdr = data if bag.is2 else store.ros1_to_cdr(data, connection.msgtype)
        writer.write(channel, time, bytes(cdr))


def read_parts(
    path: Path,
    parts: list[Path],
    *,
    recover: bool = False,
    memory: int = MEMORY,
    topic: str = "",
) -> McapReader:
    """Read the skeletons and transforms of several MCAP files that are one recording.

    Parameters
    ----------
    path : the folder.
    parts : its files.
    recover : take what can be read of damaged files; ``recovery`` says what is lost.
    memory : bytes that reading may take. topic : what to take instead of skeletons.
    """
    left_out: dict[str, tuple[str, int]] = {}
    checked, recovery = True, Recovery()

    def wanted(part: McapReader) -> Collection[int]:
        """Return the channels of a part that are taken over; note the others."""
        nonlocal checked
        checked &= part.has_checksums
        taken = set()
        for channel in part.channels.values():
            schema = part.schema(channel)
            name, n = schema.name if schema else "no type", part.counts.get(channel.id, 0)
            if schema and _takes(topic, channel.topic, name):
                taken.add(channel.id)
            else:
                n += left_out.get(channel.topic, ("", 0))[1]
                left_out[channel.topic] = name, n
        return taken

    def write(writer: McapWriter) -> None:
        nonlocal recovery
        recovery = join(parts, writer, recover=recover, wanted=wanted)

    reader = MemoryReader(path, write, memory)
    reader.checked, reader.left_out = checked, left_out
    reader.recovery = recovery if recover else None
    return reader


def join(
    parts: list[Path],
    writer: McapWriter,
    *,
    recover: bool = False,
    wanted: Callable[[McapReader], Collection[int]] | None = None,
) -> Recovery:
    """Write the content of files, in this order; return what is lost.

    ``wanted`` chooses channels of a file; without it, everything is written, attachments and
    metadata too. Raises LogError, which names the file, if one is damaged; with ``recover``, only
    if nothing can be read of any.
    """
    recoveries: list[tuple[str, Recovery]] = []
    failed: LogError | None = None
    for path in parts:
        name = path.name if len(parts) > 1 else ""
        try:
            part = RecoveringReader(path) if recover else McapReader(path)
        except LogError as error:
            if not recover:
                raise
            failed = failed or error
            size = path.stat().st_size if path.is_file() else 0
            recoveries.append((name, Recovery((Damage(0, size, error.fault, Lost.REST),))))
            continue
        with part:
            writer.append(part, wanted(part) if wanted else part.channels)
            if wanted is None:
                writer.append_extras(part)
            if part.recovery is not None:
                recoveries.append((name, part.recovery))
    if failed is not None and not any(recovery.recovered for _, recovery in recoveries):
        raise failed
    return joined(recoveries)


@contextmanager
def open_bag(path: Path, kind: str) -> Iterator[Any]:
    """Open a bag; whatever rosbags has to say against it becomes one LogError."""
    from rosbags.highlevel import AnyReader

    # SQLite bags of before 2023 do not say what their messages look like.
    names = (
        hiros_schemas.SKELETON_GROUP,
        hiros_schemas.STAMPED_SKELETON,
        hiros_schemas.OBJECTS_STAMPED,
    )
    types = ros2_types({name: hiros_schemas.text(name) for name in names})
    try:
        with AnyReader([path], default_typestore=types) as bag:
            yield bag
    except LogError:
        raise
    except Exception as error:  # noqa: BLE001 - dozens of kinds, down to those of sqlite
        reason = " ".join(str(error).split()) or type(error).__name__
        raise LogError(f"is {kind} that cannot be read: {reason}", path=path) from None


def _metadata(connection: Connection) -> dict[str, str]:
    """Quality of service as rosbag2 keeps it in a channel, "" where the bag says nothing."""
    from rosbags.rosbag2.metadata import dump_qos_v8

    profiles = getattr(connection.ext, "offered_qos_profiles", [])
    return {"offered_qos_profiles": dump_qos_v8(profiles)}


def recover(
    source: str | os.PathLike[str], target: str | os.PathLike[str], *, force: bool = False
) -> Recovery:
    """Write everything that can be read of a recording to one indexed MCAP file with checksums.

    Messages keep their bytes, times and numbers. A metadata record, ``hiros.recovery``, marks the
    file if anything was damaged.

    Parameters
    ----------
    source : an MCAP file, or a folder with the files of one recording.
    target : the output.
    force : replace a file that hiros did not write.

    Raises
    ------
    LogError
        nothing can be read; ``source`` is a bag of another kind; ``target`` cannot be written.
    """
    path, out = Path(source), Path(target)
    parts = parts_of(path, recover=True)
    if not parts:
        raise LogError(f"is {kind_of(path)}; hiros recovers MCAP files", path=path)
    check_outputs([(out, "log")], [path], force=force)
    with McapWriter(out, inputs=parts) as writer:
        recovery = join(parts, writer, recover=True)
        if recovery.damages:
            writer.add_metadata(RECOVERY_METADATA, recovery.metadata())
        writer.commit()
    return recovery


_VERSION = 8


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
    return not settings or any(one.durability != QosDurability.TRANSIENT_LOCAL for one in settings)


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
    write_text(mcap.with_name("metadata.yaml"), _as_yaml(bag_metadata(mcap)))


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
