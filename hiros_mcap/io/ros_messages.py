"""Messages of ROS's standard types, such as images, from a log of any kind.

A log of skeletons is read by :mod:`hiros_mcap.io.log`, which is much faster.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import hiros_schemas
from hiros_mcap.errors import naming
from hiros_mcap.io.bags import kind_of, open_bag, parts_of
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.ros_cdr import decoder_of, ros2_types

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINT = "geometry_msgs/msg/PointStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
KINDS = (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO, POINT, TRANSFORMS, hiros_schemas.UNCERTAINTY)
"""The types that can be read; their definitions are the same in every release of ROS 2."""


class RosMessage(NamedTuple):
    """A message that is not decoded yet."""

    topic: str
    type: str
    """``pkg/msg/Type``."""
    log_time: int
    """ns."""
    data: bytes | memoryview
    """CDR; valid as long as it is held."""


class RosMessages:
    """The messages of an open log; made by :func:`open_messages`.

    Attributes
    ----------
    types : topic -> type of its messages, of those in ``KINDS``.
    """

    types: Mapping[str, str]

    def __init__(self) -> None:
        ours = hiros_schemas.UNCERTAINTY
        self._store = ros2_types({ours: hiros_schemas.text(ours)})

    def decode(self, message: RosMessage) -> Any:
        """Return a message's fields as attributes, arrays as numpy arrays.

        Raises LogError for damaged bytes.
        """
        with naming(None, message.topic):
            return decoder_of(self._store, message.type)(message.data)

    def read(self, topics: Collection[str]) -> Iterator[RosMessage]:
        """Yield the messages of some topics in the order of their log times."""
        raise NotImplementedError


class _McapMessages(RosMessages):
    """Those of one MCAP file, or of the files of a split recording."""

    def __init__(self, parts: list[McapReader]) -> None:
        super().__init__()
        self._parts = parts
        self.types = {topic: kind for part in parts for topic, kind in self._types_of(part).items()}

    @staticmethod
    def _types_of(part: McapReader) -> dict[str, str]:
        kinds = {name: kind for kind in KINDS for name in (kind, kind.replace("/msg/", "/"))}
        types = {}
        for channel in part.channels.values():
            schema = part.schema(channel)
            if schema and schema.name in kinds and channel.message_encoding == "cdr":
                types[channel.topic] = kinds[schema.name]
        return types

    def read(self, topics: Collection[str]) -> Iterator[RosMessage]:
        for part in self._parts:
            wanted = {c.id: c.topic for c in part.channels.values() if c.topic in topics}
            for message in part.messages(wanted):
                topic = wanted[message.channel_id]
                yield RosMessage(topic, self.types[topic], message.log_time, message.data)


class _BagMessages(RosMessages):
    """Those of a ROS 1 bag or a SQLite bag."""

    def __init__(self, bag: Any) -> None:
        super().__init__()
        self._bag = bag
        self.types = {c.topic: c.msgtype for c in bag.connections if c.msgtype in KINDS}

    def read(self, topics: Collection[str]) -> Iterator[RosMessage]:
        taken = [c for c in self._bag.connections if c.topic in topics]
        if not taken:  # rosbags takes an empty list for all
            return
        for connection, time, data in self._bag.messages(taken):
            kind = connection.msgtype
            cdr = data if self._bag.is2 else self._store.ros1_to_cdr(data, kind)
            yield RosMessage(connection.topic, kind, time, cdr)


@contextmanager
def open_messages(path: Path | McapReader) -> Iterator[RosMessages]:
    """Open an MCAP file, also one that is open, a ROS 1 bag, a SQLite bag or a rosbag2 folder.

    Raises LogError if it cannot be read.
    """
    with ExitStack() as stack:
        if isinstance(path, McapReader):
            yield _McapMessages([path])
            return
        parts = parts_of(path)
        if parts:
            yield _McapMessages([stack.enter_context(McapReader(part)) for part in parts])
        else:
            yield _BagMessages(stack.enter_context(open_bag(path, kind_of(path))))
