"""ROS 1 bags, SQLite bags and split bags, by the rosbags library.

hiros reads MCAP. What is recorded otherwise is rewritten once, the skeletons and the transforms
of it, into a temporary MCAP file: ROS 2 messages byte for byte, ROS 1 messages as the ROS 2
messages of the same fields.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hiros_schemas
from hiros_mcap.errors import LogError
from hiros_mcap.io.container import McapReader, McapWriter

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

_MAGIC = {b"#ROSBAG V2.0": "a ROS 1 bag", b"SQLite format 3": "a SQLite bag"}
_FOLDER = "metadata.yaml"  # what makes a folder a rosbag2 recording
_WANTED = {
    hiros_schemas.short_name(name)
    for name in (hiros_schemas.SKELETON_GROUP, hiros_schemas.TF_MESSAGE)
}


def kind_of(path: Path) -> str:
    """Return what kind of bag a path is; "" for a file that is none, such as an MCAP."""
    if path.is_dir():
        return "a rosbag2 folder" if (path / _FOLDER).is_file() else ""
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError:
        return ""
    return next((kind for magic, kind in _MAGIC.items() if start.startswith(magic)), "")


class BagReader(McapReader):
    """Reads the skeletons and transforms of a bag, from an MCAP file that ``close`` removes.

    Attributes
    ----------
    path : the bag.
    left_out : type and number of messages of every topic that was not taken over.

    Raises
    ------
    LogError
        the bag is damaged or holds no skeletons.
    """

    def __init__(self, path: Path, kind: str) -> None:
        self.path = path
        self.left_out: dict[str, tuple[str, int]] = {}
        self._folder = tempfile.TemporaryDirectory(prefix="hiros-")
        try:
            mcap = Path(self._folder.name) / f"{path.stem}.mcap"
            with _readable(path, kind) as bag:
                self._convert(bag, mcap)
            super().__init__(mcap)
        except BaseException:
            self._folder.cleanup()
            raise
        self.path = path

    @property
    def has_checksums(self) -> bool:
        """False: bags have no checksums, and rosbags compares none of the parts of a split one."""
        return False

    def close(self) -> None:
        """Close and remove the file."""
        super().close()
        self._folder.cleanup()

    def _convert(self, bag: Any, mcap: Path) -> None:
        taken = [c for c in bag.connections if hiros_schemas.short_name(c.msgtype) in _WANTED]
        for connection in bag.connections:
            if connection not in taken:
                _, n = self.left_out.get(connection.topic, ("", 0))
                self.left_out[connection.topic] = (connection.msgtype, n + connection.msgcount)
        skeletons = hiros_schemas.short_name(hiros_schemas.SKELETON_GROUP)
        if not any(hiros_schemas.short_name(c.msgtype) == skeletons for c in taken):
            topics = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in bag.connections}))
            raise LogError(f"has no SkeletonGroup topic; it has {topics or 'none'}", path=self.path)
        texts = {connection.msgtype: connection.msgdef.data for connection in taken}
        store = bag.typestore if bag.is2 else _ros2_types(texts)
        with McapWriter(mcap, compression="") as writer:
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
            writer.commit()


@contextmanager
def _readable(path: Path, kind: str) -> Iterator[Any]:
    """Open a bag; whatever rosbags has to say against it becomes one LogError."""
    from rosbags.highlevel import AnyReader

    # SQLite bags of before 2023 do not say what their messages look like.
    name = hiros_schemas.SKELETON_GROUP
    types = _ros2_types({name: hiros_schemas.text(name)})
    try:
        with AnyReader([path], default_typestore=types) as bag:
            yield bag
    except LogError:
        raise
    except Exception as error:  # noqa: BLE001 - dozens of kinds, down to those of sqlite
        reason = " ".join(str(error).split()) or type(error).__name__
        raise LogError(f"is {kind} that cannot be read: {reason}", path=path) from None


def _ros2_types(texts: Mapping[str, str]) -> Typestore:
    """Types of ``texts`` on top of ROS 2's standard ones, whose Header has no ``seq``."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in texts.items():
        types = get_types_from_msg(text, name)
        store.register({k: v for k, v in types.items() if k not in store.fielddefs})
    return store


def _metadata(connection: Connection) -> dict[str, str]:
    """Quality of service as rosbag2 keeps it in a channel, "" where the bag says nothing."""
    from rosbags.rosbag2.metadata import dump_qos_v8

    profiles = getattr(connection.ext, "offered_qos_profiles", [])
    return {"offered_qos_profiles": dump_qos_v8(profiles)}
