"""SkeletonGroup and StampedSkeleton, of ROS 1 and ROS 2.

A log in which all cameras publish SkeletonGroup in CDR with one skeleton model does not come here:
:mod:`hiros_mcap.io.codec` reads it as it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import hiros_schemas
from hiros_mcap.errors import LogError
from hiros_mcap.io.codec import Decoder, ModelBuilder
from hiros_mcap.io.detectors.detector_reader import DetectorMessage, DetectorReader, SeenPeople
from hiros_mcap.io.ros_cdr import long_name, types_of
from hiros_mcap.skeletons import Frame

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

GROUP = "hiros_skeleton_msgs/SkeletonGroup"
SKELETON = "hiros_skeleton_msgs/Skeleton"
STAMPED = "hiros_skeleton_msgs/StampedSkeleton"
_STAMP_AT, _STAMP_END = 4, 12
"""Bytes of header.stamp in a message, behind the encapsulation."""


class SkeletonGroups(DetectorReader):
    """Keeps every number of a message. StampedSkeletons of one stamp become one frame."""

    types = (GROUP, STAMPED)

    def __init__(self) -> None:
        self._builders: dict[str, ModelBuilder] = {}
        self._decoders: dict[str, Decoder] = {}
        self._held: dict[str, list[DetectorMessage]] = {}

    def read(self, message: DetectorMessage) -> Iterable[SeenPeople]:
        """Read a group, or hold back a skeleton until one of another time comes."""
        if message.type == GROUP:
            return list(self._people(message, message.cdr))
        held = self._held.setdefault(message.topic, [])
        if held and _stamp(held[0]) == _stamp(message):
            held.append(message)
            return []
        self._held[message.topic] = [message]
        return list(self._joined(held))

    def rest(self) -> Iterator[SeenPeople]:
        """Return what is held back."""
        for held in self._held.values():
            yield from self._joined(held)

    def _joined(self, held: Sequence[DetectorMessage]) -> Iterator[SeenPeople]:
        if held:
            yield from self._people(held[-1], group_of([message.cdr for message in held]))

    def _people(self, message: DetectorMessage, data: bytes | memoryview) -> Iterator[SeenPeople]:
        builder = self._builders.setdefault(message.topic, ModelBuilder())
        for frame in self._frames(builder, message, data):
            yield SeenPeople(message.topic, self._decoders[message.topic].model, frame)

    def _frames(
        self, builder: ModelBuilder, message: DetectorMessage, data: bytes | memoryview
    ) -> list[Frame]:
        """Decode; a message with a marker or link that is new extends the model."""
        topic = message.topic
        try:
            if topic in self._decoders:
                return self._decoders[topic].decode_message(data, message.log_time)
        except LogError:
            pass  # a new marker, or damaged: the builder tells which
        builder.add(data, topic)
        self._decoders[topic] = Decoder(builder.build())
        return self._decoders[topic].decode_message(data, message.log_time)


def _stamp(message: DetectorMessage) -> bytes:
    return bytes(message.cdr[_STAMP_AT:_STAMP_END])


def group_of(messages: Sequence[bytes | memoryview]) -> bytes:
    """Join StampedSkeletons in CDR, of one time, to a SkeletonGroup; raises LogError if damaged.

    The fields of a StampedSkeleton behind its header are those of a Skeleton.
    """
    store = _types()
    skeleton = store.types[long_name(SKELETON)]
    names = [name for name, _ in store.fielddefs[long_name(SKELETON)][1]]
    try:
        stamped: list[Any] = [store.deserialize_cdr(data, long_name(STAMPED)) for data in messages]
        people = [skeleton(*[getattr(one, name) for name in names]) for one in stamped]
        group = store.types[long_name(GROUP)](stamped[0].header, people)
        return bytes(store.serialize_cdr(group, long_name(GROUP)))
    except Exception as error:  # noqa: BLE001 - damaged bytes raise anything
        raise LogError(f"a message cannot be decoded: {type(error).__name__}") from None


@cache
def _types() -> Typestore:
    names = [long_name(name) for name in (GROUP, STAMPED)]
    return types_of(*((name, hiros_schemas.text(name)) for name in names))
