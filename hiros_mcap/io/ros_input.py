"""Live messages of a ROS 2 graph: subscribe to what may show people, and pass on the bytes.

Topics are taken as they appear, with the quality of service of their publishers. A message's log
time is when the middleware received it, or what /clock said then with ``use_sim_time``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import Any, NamedTuple

from hiros_mcap.errors import LogError
from hiros_mcap.io.channels import LATCHED_QOS, RELIABLE_QOS, is_transform_topic
from hiros_mcap.io.container.live_input import LiveInput
from hiros_mcap.io.container.records import Channel, McapRecord, Message, Schema
from hiros_mcap.io.ros_node import RosNode, definition_of, message_class, not_installed
from hiros_mcap.wording import quantity

_PATIENCE = 0.1  # s: how soon a request to stop is heard
_LOOK_S = 0.2  # between looks at the graph
_QUEUED = 1000
"""Messages of a topic that wait for a busy run; then the oldest ones are lost, and counted."""
_BEHIND, _TOLERATED = 2 * 10**9, 10**10
"""ns that messages may wait, and how long they may do so until the user is told."""
_CLOCK_TYPE, _CLOCK = "rosgraph_msgs/msg/Clock", 0
"""Of /clock: its type, and what stands for the number of a channel."""

Wanted = Callable[[str, str], bool]
"""Tells from topic and message type whether to subscribe, or whether a run needs it."""


class _Quality(NamedTuple):
    """The quality of service of a subscription; publishers that offer more fit, too."""

    reliable: bool
    latched: bool


class _Row(NamedTuple):
    """A message with its time of arrival, ns, our number of its channel, and rclpy's info."""

    at: int
    ident: int
    data: Any
    info: dict[str, Any]


class RosInput(LiveInput):
    """The topics of a graph.

    Parameters
    ----------
    node : of this program.
    wanted : which topics to subscribe to.
    needed : which of them a run cannot do without: their message package has to be installed.
    warn : is told once if the run is too slow.
    """

    def __init__(
        self,
        node: RosNode,
        wanted: Wanted,
        needed: Wanted = lambda *_: False,
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        super().__init__(node.graph)
        self._node, self._wanted, self._needed, self._warn = node, wanted, needed, warn
        self._end = 0  # when somebody asked to stop, ns
        self._names = node.remapped()
        self._clock: Any = None  # subscription to /clock
        self._time: int | None = None
        """Of /clock, ns, 0 before it came; None without ``use_sim_time``."""
        if node.node.get_parameter("use_sim_time").value:
            self._clock, self._time = (
                self._subscribed("/clock", _CLOCK_TYPE, _Quality(False, False), raw=False),
                0,
            )
        self._subscriptions: dict[tuple[str, str, bool], tuple[_Quality, Any]] = {}
        """Topic in the graph, type, and whether for latched messages alone -> subscription."""
        self._ids: dict[tuple[str, str], int] = {}
        """Topic in the graph and type -> our number of the channel."""
        self._counts: dict[int, int] = {}  # channel -> messages so far
        self._refused: dict[tuple[str, str], str] = {}
        """Topic in the graph and type -> why it is not read."""
        self._hashes: dict[str, Any] = {}  # type -> hash of its definition
        self._alone: dict[int, bool] = {}  # channel -> whether it has a single publisher
        self._numbers: dict[tuple[int, bytes], int] = {}
        """Channel and publisher -> number of its latest message."""
        self._lost: dict[int, int] = {}  # channel -> messages that were lost on the way
        self._in_time = time.time_ns()  # when no message had to wait for long, ns

    def stop(self) -> None:
        """End the input here; what has arrived is still taken."""
        self._end = time.time_ns()
        super().stop()

    def close(self) -> None:
        """Leave the graph."""
        self._node.close()

    def records(self) -> Iterator[McapRecord | None]:
        """Subscribe to what is there and to what comes, and yield it until somebody stops it.

        Raises LogError if nobody has published people by then, or a message package is missing.
        """
        due, goes_on = 0.0, True
        while goes_on:
            if not self._stopped and time.monotonic() >= due:
                yield from self._look()
                due = time.monotonic() + _LOOK_S
            arrived = self._arrived()
            self._in_time = self._in_time if arrived else time.time_ns()
            # A busy run has not taken all that came before it was stopped.
            goes_on = not self._stopped or any(row.at < self._end for row in arrived)
            for row in arrived:
                if row.ident == _CLOCK:
                    self._time = row.data.clock.sec * 10**9 + row.data.clock.nanosec
                elif not self._stopped or row.at < self._end:
                    yield self._message(row)
            yield None
        if not self._counts:
            found = [topic for topic, _ in self._node.node.get_topic_names_and_types()]
            listed = ", ".join(found[:20]) or "none"
            clock = "nobody publishes /clock; " if self._time == 0 else ""
            raise LogError(
                f"no topic that may show people was found; {clock}is ROS_DOMAIN_ID that of the "
                f"cameras, and do they run? topics: {listed}",
                path=self.name,
            )

    def _arrived(self) -> list[_Row]:
        """Wait for a message; return all that are there, as they arrived.

        Each topic has a queue of its own.
        """
        queues = [(self._ids[key[:2]], s) for key, (_, s) in self._subscriptions.items()]
        if self._clock is not None:
            queues.append((_CLOCK, self._clock))
        self._node.wait([s for _, s in queues], 0.0 if self._stopped else _PATIENCE)
        return sorted(chain(*(self._taken(*queue) for queue in queues)), key=lambda row: row.at)

    def _taken(self, ident: int, subscription: Any) -> Iterator[_Row]:
        """Yield the messages of a queue in its order, of which a repeated one arrived late."""
        latest = 0
        for _ in range(_QUEUED):
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                break
            latest = max(latest, taken[1]["received_timestamp"] or time.time_ns())
            yield _Row(latest, ident, *taken)

    def _message(self, row: _Row) -> Message:
        """Return a message as a file has it."""
        self._counts[row.ident] += 1
        self._count_lost(row.ident, row.info)
        self._watch(row.at)
        sent = row.info["source_timestamp"] or row.at
        log_time, sent = (row.at, sent) if self._time is None else (self._time, self._time)
        return Message(row.ident, log_time, row.data, sent, self._counts[row.ident])

    def _watch(self, at: int) -> None:
        """Tell the user when a run does not catch up with its messages."""
        now = time.time_ns()
        if now - at < _BEHIND:
            self._in_time = now
        elif now - self._in_time > _TOLERATED and not self._stopped:
            self._warn(
                f"too slow for {len(self._counts)} topics: messages wait for "
                f"{(now - at) * 1e-9:.0f} s by now, and are lost if it goes on; name fewer cameras "
                "(--topic), lower their rate, or use a faster computer"
            )
            self._warn = lambda _: None

    def _look(self) -> Iterator[McapRecord]:
        """Subscribe to the topics that are new in the graph, and yield their definitions."""
        if self._time == 0:  # no message has a time yet
            return
        node = self._node.node
        topics = [(t, kind) for t, kinds in node.get_topic_names_and_types() for kind in kinds]
        for topic, kind in topics:
            name = self._names.get(topic, topic)
            # What a rule gives another topic's name cannot be subscribed to.
            hidden = topic == name and topic in self._names.values()
            if hidden or (topic, kind) in self._refused or not self._wanted(name, kind):
                continue
            publishers = [
                p
                for p in node.get_publishers_info_by_topic(topic)
                if p.topic_type == kind and not self._node.owns(p)
            ]
            if publishers and (reason := _refusal(kind)):
                self._refuse(topic, kind, f"{name}: not read: {reason}")
            elif publishers:
                yield from self._take(topic, name, kind, publishers)

    def _refuse(self, topic: str, kind: str, reason: str) -> None:
        """Go on without a topic; raises LogError for one that is needed, before a run begins."""
        self._refused[topic, kind] = reason
        self._tell()
        if self._needed(self._names.get(topic, topic), kind) and not any(self._counts.values()):
            raise LogError(f"{reason}; --topic chooses other cameras", path=self.name)

    def _take(
        self, topic: str, name: str, kind: str, publishers: Sequence[Any]
    ) -> Iterator[McapRecord]:
        """Subscribe as the publishers offer; yield the definitions when a topic is new."""
        offered = [_offered(publisher.qos_profile) for publisher in publishers]
        quality = _Quality(*map(all, zip(*offered, strict=True)))
        if (topic, kind) not in self._ids:
            ident = self._ids[topic, kind] = len(self._ids) + 1
            self._counts[ident] = 0
            text = definition_of(kind).encode()
            yield Schema(id=ident, name=kind, encoding="ros2msg", data=text)
            yield Channel(ident, name, "cdr", _metadata(quality, publishers[0]), ident)
        self._alone[self._ids[topic, kind]] = len(publishers) == 1
        self._subscribe(topic, kind, quality, latched=False)
        if any(p.topic_type_hash != self._hash(topic, kind) for p in publishers):
            self._node.node.destroy_subscription(self._subscriptions.pop((topic, kind, False))[1])
            self._refuse(
                topic,
                kind,
                f"{name}: not read: its publisher has another definition of {kind} than the "
                "message package installed here; build both from one version",
            )
            return
        if (
            is_transform_topic(name)
            and not quality.latched
            and any(offer.latched for offer in offered)
        ):
            self._subscribe(topic, kind, _Quality(True, True), latched=True)

    def _hash(self, topic: str, kind: str) -> Any:
        """Return the hash of the type as it is installed here."""
        if kind not in self._hashes:
            endpoints = self._node.node.get_subscriptions_info_by_topic(topic)
            ours = [e for e in endpoints if self._node.owns(e) and e.topic_type == kind]
            self._hashes[kind] = ours[0].topic_type_hash
        return self._hashes[kind]

    def _subscribe(self, topic: str, kind: str, quality: _Quality, *, latched: bool) -> None:
        """Subscribe, or anew where a publisher has come that offers less.

        ``latched`` is a second subscription, for what was sent before: publishers that do not keep
        it make the first one do without.
        """
        before, old = self._subscriptions.get((topic, kind, latched), (None, None))
        if before is not None:
            quality = _Quality(*(a and b for a, b in zip(before, quality, strict=True)))
        if before == quality:
            return
        subscription = self._subscribed(self._names.get(topic, topic), kind, quality)
        self._subscriptions[topic, kind, latched] = quality, subscription
        if old is not None:
            self._node.node.destroy_subscription(old)

    def _subscribed(self, name: str, kind: str, quality: _Quality, *, raw: bool = True) -> Any:
        """Return a subscription whose messages are taken, so that it calls nothing."""
        return self._node.node.create_subscription(
            message_class(kind), name, lambda _: None, _profile(quality), raw=raw
        )

    def _count_lost(self, ident: int, info: Any) -> None:
        """Count what is missing between two messages of a publisher.

        With rclpy 9.1.2 and Fast DDS 3.2.3, the event ``message_lost`` says nothing of messages for
        which the queue has no place: of 500 to 100 places, 100 came and it was never called.
        """
        publisher = (info.get("publisher_gid") or {}).get("data", b"")
        number = info.get("publication_sequence_number")
        if not number or not (publisher or self._alone[ident]):  # whose number it is is unknown
            return
        before = self._numbers.get((ident, publisher), number)
        self._numbers[ident, publisher] = number
        if number > before + 1:
            self._lost[ident] = self._lost.get(ident, 0) + number - before - 1
            self._tell()

    def _tell(self) -> None:
        """Say which topics are not read, and which messages were lost."""
        topics = {ident: self._names.get(topic, topic) for (topic, _), ident in self._ids.items()}
        lost = (
            f"{topics[ident]}: {quantity(n, 'message')} lost on the way"
            for ident, n in self._lost.items()
        )
        self.fault = "; ".join([*self._refused.values(), *lost])


def _refusal(kind: str) -> str:
    """Return why messages of a type cannot be read, "" if they can."""
    try:
        return "" if message_class(kind) else not_installed(kind)
    except LogError as error:
        return error.fault


def _offered(profile: Any) -> _Quality:
    """Return what a publisher offers."""
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    return _Quality(
        profile.reliability == ReliabilityPolicy.RELIABLE,
        profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
    )


def _profile(quality: _Quality) -> Any:
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=_QUEUED,
        reliability=[ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE][quality.reliable],
        durability=[DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL][quality.latched],
    )


def _metadata(quality: _Quality, publisher: Any) -> dict[str, str]:
    """Return what rosbag2 keeps beside a channel."""
    qos = LATCHED_QOS if quality.latched else RELIABLE_QOS
    if not quality.reliable:
        qos = qos.replace("reliability: 1", "reliability: 2")
    return {"offered_qos_profiles": qos, "topic_type_hash": str(publisher.topic_type_hash)}
