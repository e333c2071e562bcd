"""Results for a ROS 2 graph: publish the bytes that a file would get."""

from __future__ import annotations

from typing import Any

import hiros_schemas
from hiros_mcap.errors import LogError
from hiros_mcap.io.channels import LATCHED_QOS
from hiros_mcap.io.container.live_output import MessageSink
from hiros_mcap.io.container.records import Channel, Schema
from hiros_mcap.io.ros_node import ADDRESS, RosNode, definition_of, message_class, not_installed

_DEPTH = 10
_FAREWELL_S = 0.5  # for subscribers to take what is left


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
        self.note = ""
        if message_class(hiros_schemas.SKELETON_GROUP) is None:
            self.note = f"skeletons are not published: {not_installed(hiros_schemas.SKELETON_GROUP)}"
            if not others:
                raise LogError(f"{self.note}; or publish --markers", path=ADDRESS)

    def commit(self) -> None:
        """Give reliable subscribers a moment to take what is left."""
        from rclpy.duration import Duration

        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=_FAREWELL_S))

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
        self._publishers[channel.id] = self._node.node.create_publisher(
            message_class(schema.name), channel.topic.removeprefix("/"), quality
        )

    def _send(self, ident: int, log_time: int, data: bytes) -> None:
        if ident in self._publishers:
            self._publishers[ident].publish(data)


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
