"""Results for a ROS 2 graph: publish the bytes that a file would get."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import hiros_schemas
from hiros_mcap.errors import LogError
from hiros_mcap.io.channels import LATCHED_QOS
from hiros_mcap.io.container.live_output import MessageSink
from hiros_mcap.io.container.records import Channel, Schema
from hiros_mcap.io.ros_node import ADDRESS, RosNode, definition_of, message_class, not_installed

_DEPTH = 10
_FAREWELL_S = 0.5  # for subscribers to take what is left
_WELCOME_S, _LOOK_S = 0.5, 0.005
_BURST_S, _PAUSE_S = 0.02, 0.05
"""Time of as many messages as wait for a subscriber, and how long to wait for it then."""


class RosOutput(MessageSink):
    """Publishes the results of a run, below ``hiros/`` in the namespace of the node.

    Channels whose message package is not installed are left out. The input is not published again.

    Parameters
    ----------
    node : of this program. others : whether there is more to publish than SkeletonGroups.

    Attributes
    ----------
    note : what is left out, with the remedy; "" if nothing.

    Raises LogError if nothing can be published.
    """

    results_only = True

    def __init__(self, node: RosNode, *, others: bool = False) -> None:
        super().__init__(ADDRESS)
        self._node = node
        self._publishers: dict[int, Any] = {}
        self._recent: dict[int, deque[float]] = {}
        """Channel -> when its latest messages were published, s."""
        self._patience = 0.0
        self.note = ""
        kind = hiros_schemas.SKELETON_GROUP
        if message_class(kind) is None:
            self.note = f"skeletons are not published: {not_installed(kind)}"
            if not others:
                raise LogError(f"{self.note}; or publish --markers", path=ADDRESS)

    def commit(self) -> None:
        """Give reliable subscribers a moment to take what is left."""
        from rclpy.duration import Duration

        latest = time.monotonic() + _FAREWELL_S
        for publisher in self._publishers.values():
            left = max(0.0, latest - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left))

    def discard(self) -> None:
        """Leave the graph."""
        self._node.close()

    def _open(self, channel: Channel, schema: Schema | None) -> None:
        if schema is None or message_class(schema.name) is None:
            return
        _check_definition(schema.name)
        from rclpy.qos import DurabilityPolicy, QoSProfile

        latched = channel.metadata.get("offered_qos_profiles") == LATCHED_QOS
        quality = QoSProfile(
            depth=1 if latched else _DEPTH,
            durability=[DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL][latched],
        )
        self._recent[channel.id] = deque(maxlen=_DEPTH)
        self._patience = time.monotonic() + _WELCOME_S
        self._publishers[channel.id] = self._node.node.create_publisher(
            message_class(schema.name), channel.topic.removeprefix("/"), quality
        )

    def _send(self, ident: int, log_time: int, data: bytes) -> None:
        publisher = self._publishers.get(ident)
        if publisher is None:
            return
        recent, now = self._recent[ident], time.monotonic()
        if not recent:
            self._welcome(publisher)
        elif len(recent) == _DEPTH and now - recent[0] < _BURST_S:
            self._pause(publisher, recent)
        recent.append(now)
        publisher.publish(data)

    def _pause(self, publisher: Any, recent: deque[float]) -> None:
        """Let the subscribers take a burst, which would overwrite itself."""
        from rclpy.duration import Duration

        publisher.wait_for_all_acked(Duration(seconds=_PAUSE_S))
        recent.extend([0.0] * _DEPTH)

    def _welcome(self, publisher: Any) -> None:
        """Wait for subscribers that are in the graph already: they find a new publisher soon."""
        count = self._node.node.count_subscribers(publisher.topic_name)
        while publisher.get_subscription_count() < count and time.monotonic() < self._patience:
            time.sleep(_LOOK_S)


def _check_definition(kind: str) -> None:
    """Raise LogError if the installed definition of a type has other fields than ours."""
    ours, theirs = (
        hiros_schemas.leaves(hiros_schemas.parse(kind, text), kind)
        for text in (hiros_schemas.text(kind), definition_of(kind))
    )
    if ours != theirs:
        raise LogError(
            f"the installed definition of {kind} is another one than that of hiros; update its "
            "package",
            path=ADDRESS,
        )
