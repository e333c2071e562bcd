"""Bags that are no MCAP: the tables of a SQLite bag, and ROS 1 bags by the rosbags library.

Only the types of messages that are read are parsed: a recorder also stores types whose definition
it did not find (rosbag2_cpp/local_message_definition_source.cpp: encoding "unknown", or empty),
services, and types that nobody but their owner understands.
"""

from __future__ import annotations

import json
import os
import sqlite3
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from hiros_mcap.errors import LogError, naming
from hiros_mcap.io.channels import ChannelInfo
from hiros_mcap.io.container import McapWriter, Recovery
from hiros_mcap.io.container.file import is_packed, unpack_message
from hiros_mcap.io.container.losses import ChannelLoss, Damage, Lost, merged
from hiros_mcap.io.container.reader import PACKED_MESSAGES
from hiros_mcap.io.ros_cdr import definition, exact_types, types_of

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Row = tuple[ChannelInfo, int, bytes]
"""A message: its topic, log time in ns, and bytes."""


class Bag(ABC):
    """An open bag, a context manager.

    Attributes
    ----------
    path : what errors call it. kind : as :func:`hiros_mcap.io.bag_files.kind_of` tells.
    topics : of the bag; one with several publishers of ROS 1 comes several times. Types are
        ``pkg/msg/Type``.
    remarks : notes about the file.
    """

    topics: Sequence[ChannelInfo]
    remarks: Sequence[str] = ()

    def __init__(self, kind: str, path: Path) -> None:
        self.kind, self.path = kind, path

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Close the file."""

    def messages(self, topics: Collection[ChannelInfo]) -> Iterator[Row]:
        """Yield the messages of some topics in the order of their log times.

        Raises LogError if the bag is damaged.
        """
        with _one_error(self.kind, self.path):
            yield from self._messages({topic.id: topic for topic in topics})

    @abstractmethod
    def _messages(self, topics: Mapping[int, ChannelInfo]) -> Iterator[Row]:
        """Yield the messages of some topics; raises any error."""

    def types(self, topics: Collection[ChannelInfo]) -> Mapping[str, Typestore]:
        """Return the types of some topics by their names, and what they contain.

        Raises LogError for a definition that is missing or cannot be parsed.
        """
        with _one_error(self.kind, self.path):
            return self._types({topic.schema: topic.id for topic in topics})

    @abstractmethod
    def _types(self, ids: Mapping[str, int]) -> Mapping[str, Typestore]:
        """Return types, each of which the topic with an id has; raises any error."""


def open_bag(path: Path, kind: str, name: Path) -> Bag:
    """Open a bag of a kind that :func:`hiros_mcap.io.bag_files.kind_of` tells.

    ``name`` is what errors call it. Raises LogError.
    """
    with _one_error(kind, name):
        return _SqliteBag(path, kind, name) if "SQLite" in kind else _Ros1Bag(path, kind, name)


@contextmanager
def _one_error(kind: str, path: Path) -> Iterator[None]:
    """Make one LogError of whatever rosbags or SQLite have to say against a bag."""
    try:
        yield
    except LogError:
        raise
    except Exception as error:  # noqa: BLE001 - dozens of kinds
        reason = " ".join(str(error).split()) or type(error).__name__
        raise LogError(f"is {kind} that cannot be read: {reason}", path=path) from None


def append_bag(bag: Bag, topics: Sequence[ChannelInfo], writer: McapWriter) -> None:
    """Write the messages of some topics of a bag as those of ROS 2; raises LogError."""
    stores = bag.types(topics)
    channels = {topic.id: _channel(topic, stores[topic.schema], writer) for topic in topics}
    for topic, time, data in bag.messages(topics):
        cdr = data
        if topic.encoding == "ros1":
            with _one_error(bag.kind, bag.path):
                cdr = bytes(stores[topic.schema].ros1_to_cdr(data, topic.schema))
        writer.write(channels[topic.id], time, cdr)


def _channel(topic: ChannelInfo, store: Typestore, writer: McapWriter) -> int:
    """Return the channel of a topic and its type; it is added unless a former part has it."""
    text = store.generate_msgdef(topic.schema, ros_version=2)[0].encode()
    schemas = writer.schemas.values()
    same = (s.id for s in schemas if s.name == topic.schema and s.data == text)
    schema = next(same, None) or writer.add_schema(topic.schema, text)
    for ident, channel in writer.channels.items():
        if channel.topic == topic.topic and channel.schema_id == schema:
            return ident
    return writer.add_channel(topic.topic, schema, metadata=topic.metadata)


def recover_bag(bag: Bag, topics: Sequence[ChannelInfo], writer: McapWriter) -> Recovery:
    """Write what can be read of a bag; return what is lost."""
    known, damages = [], []
    for topic in topics:
        with suppress(LogError):
            bag.types([topic])
            known.append(topic)
    before = writer.counts.copy()
    try:
        append_bag(bag, known, writer)
    except LogError as error:
        if error.path != bag.path:
            raise
        damages = [Damage(0, bag.path.stat().st_size, error.fault, Lost.REST)]
    kept: Counter[str] = Counter()
    for ident, n in (writer.counts - before).items():
        kept[writer.channels[ident].topic] += n
    counts: Counter[str] = Counter()
    for topic in topics:
        counts[topic.topic] += topic.count
    losses = (ChannelLoss(topic, kept[topic], n - kept[topic]) for topic, n in counts.items())
    return Recovery(tuple(damages), merged(losses))


_NO_LOCKS = "win32-none" if os.name == "nt" else "unix-none"
"""SQLite's access to files without locks (sqlite.org/vfs.html)."""


class _SqliteBag(Bag):
    """The tables of rosbag2_storage_sqlite3, versions 1 to 4."""

    def __init__(self, path: Path, kind: str, name: Path) -> None:
        super().__init__(kind, name)
        wal = path.with_name(f"{path.name}-wal")
        waits = wal.is_file() and wal.stat().st_size > 0
        # Nothing beside the bag is written: SQLite makes no lock, and no index of what waits.
        access = f"vfs={_NO_LOCKS}" if waits else "immutable=1"
        address = f"{path.absolute().as_uri()}?mode=ro&{access}"
        self._tables = sqlite3.connect(address, uri=True, check_same_thread=False)
        try:
            if waits:
                self._tables.execute("PRAGMA locking_mode=EXCLUSIVE")
                self.remarks = [f"{wal.name}, which the recorder did not finish, is read, too"]
            self._tables.text_factory = lambda data: data.decode(errors="replace")
            self.topics = self._topics()
        except BaseException:
            self._tables.close()
            raise

    def close(self) -> None:
        self._tables.close()

    def _columns(self, table: str) -> set[str]:
        rows = self._tables.execute("SELECT name FROM pragma_table_info(?)", [table])
        return {str(name) for (name,) in rows}

    def _topics(self) -> Sequence[ChannelInfo]:
        if not self._columns("topics") or not self._columns("messages"):
            raise LogError("is a SQLite database without the tables of a bag", path=self.path)
        query = "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"
        counts = dict(self._tables.execute(query))
        rows = self._tables.execute("SELECT * FROM topics ORDER BY id")
        named = [dict(zip((d[0] for d in rows.description), row, strict=True)) for row in rows]
        return [
            ChannelInfo(
                int(row["id"]),
                str(row["name"]),
                str(row["type"]),
                "cdr",
                counts.get(row["id"], 0),
                {"offered_qos_profiles": str(row.get("offered_qos_profiles", ""))},
            )
            for row in named
        ]

    def _messages(self, topics: Mapping[int, ChannelInfo]) -> Iterator[Row]:
        query = (
            "SELECT topic_id, timestamp, data FROM messages "
            "WHERE topic_id IN (SELECT value FROM json_each(?)) ORDER BY timestamp, id"
        )
        for ident, time, data in self._tables.execute(query, [json.dumps([*topics])]):
            if not 0 <= time < 1 << 63:
                raise ValueError(f"a message has no such time: {time}")
            plain = memoryview(data).tobytes()
            if is_packed(plain):
                self.remarks = [*dict.fromkeys([*self.remarks, PACKED_MESSAGES])]
                plain = unpack_message(plain)
            yield topics[ident], time, plain

    def _types(self, ids: Mapping[str, int]) -> Mapping[str, Typestore]:
        """Return types; bags of before 2023 have no definitions, others may lack one."""
        with naming(self.path):
            return {
                name: exact_types({name: definition(name, *self._definition(name))}) for name in ids
            }

    def _definition(self, name: str) -> tuple[str, str]:
        """Return how the definition of a type is written, and its text; "" if there is none."""
        if not self._columns("message_definitions"):
            return "", ""
        query = (
            "SELECT encoding, encoded_message_definition FROM message_definitions "
            "WHERE topic_type = ? ORDER BY id"
        )
        encoding, text = next(self._tables.execute(query, [name]), ("", ""))
        return str(encoding), str(text)


class _Ros1Bag(Bag):
    """A bag of ROS 1, read by the rosbags library."""

    def __init__(self, path: Path, kind: str, name: Path) -> None:
        from rosbags.rosbag1 import Reader

        super().__init__(kind, name)
        self._reader = Reader(path)
        self._reader.open()
        self._connections: dict[int, Any] = dict(enumerate(self._reader.connections))
        self.topics = [
            ChannelInfo(i, c.topic, c.msgtype, "ros1", c.msgcount, {})
            for i, c in self._connections.items()
        ]

    def close(self) -> None:
        self._reader.close()

    def _messages(self, topics: Mapping[int, ChannelInfo]) -> Iterator[Row]:
        connections = [self._connections[ident] for ident in topics]
        wanted = {self._connections[ident].id: topic for ident, topic in topics.items()}
        # rosbags takes none for all.
        for connection, time, data in self._reader.messages(connections) if connections else ():
            yield wanted[connection.id], time, data

    def _types(self, ids: Mapping[str, int]) -> Mapping[str, Typestore]:
        """Return types, whose Header is that of ROS 2."""
        texts = {name: self._connections[ident].msgdef.data for name, ident in ids.items()}
        return dict.fromkeys(texts, types_of(*texts.items()))
