"""A node that publishes the messages of an MCAP when their time comes; a program of its own.

    python player.py LOG [SPEED [TOPIC=HOW ...]]

HOW is a list of: ``best_effort``, ``latched``, ``late:SECONDS``, ``from:SECONDS`` and
``to:SECONDS`` of the log, ``off``. ``/clock=on`` also publishes the log's time. Static transforms
are latched. It waits until every topic has a subscriber, prints a line, publishes, waits until all
have arrived, and prints another line. Then it stays until its input ends.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from importlib import import_module

import rclpy
from mcap.reader import make_reader
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

PATIENCE_S = 20.0


def main() -> None:
    log, speed = sys.argv[1], float(sys.argv[2])
    how = defaultdict(dict)
    for text in sys.argv[3:]:
        topic, _, names = text.partition("=")
        how[topic] = {
            name: value for name, _, value in (n.partition(":") for n in names.split(","))
        }
    rclpy.init()
    node = rclpy.create_node("player", start_parameter_services=False)
    with open(log, "rb") as file:  # noqa: PTH123
        messages = [(c.topic, s.name, m) for s, c, m in make_reader(file).iter_messages()]
    messages = [row for row in messages if "off" not in how[row[0]]]
    begin = min(m.log_time for _, _, m in messages)
    publishers = {}
    for topic, kind in dict.fromkeys((topic, kind) for topic, kind, _ in messages):
        late = float(how[topic].get("late", 0))
        if not late:
            publishers[topic] = open_publisher(node, topic, kind, how[topic])
    clock = open_publisher(node, "/clock", "rosgraph_msgs/msg/Clock", {}) if how["/clock"] else None
    await_subscribers(publishers, lambda: clock and clock.publish(clock_message(begin)))
    print("begins", flush=True)
    start, ticked = time.monotonic(), 0.0
    for topic, kind, message in messages:
        at = (message.log_time - begin) / 1e9
        options = how[topic]
        if not float(options.get("from", 0)) <= at < float(options.get("to", "inf")):
            continue
        time.sleep(max(0.0, start + at / speed - time.monotonic()))
        if clock is not None and at >= ticked:
            clock.publish(clock_message(message.log_time))
            ticked = at + 0.01
        if topic not in publishers:
            if at < float(options["late"]):
                continue
            publishers[topic] = open_publisher(node, topic, kind, options)
            await_subscribers({topic: publishers[topic]})
        publishers[topic].publish(message.data)
    for publisher in publishers.values():
        publisher.wait_for_all_acked(Duration(seconds=5))
    print("ends", flush=True)
    sys.stdin.read()


def open_publisher(node, topic: str, kind: str, options: dict):
    """Return a publisher of a topic, as its options say."""
    package, _, name = kind.split("/")
    latched = "latched" in options or topic == "/tf_static"
    quality = QoSProfile(
        depth=100,
        reliability=ReliabilityPolicy.BEST_EFFORT
        if "best_effort" in options
        else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
    return node.create_publisher(getattr(import_module(f"{package}.msg"), name), topic, quality)


def await_subscribers(publishers: dict, meanwhile=lambda: None) -> None:
    """Wait until somebody subscribed to every topic but truths."""
    latest = time.monotonic() + PATIENCE_S
    for topic, publisher in publishers.items():
        while not publisher.get_subscription_count() and not topic.startswith("/truth"):
            meanwhile()
            if time.monotonic() > latest:
                sys.exit(f"nobody subscribed to {topic}")
            time.sleep(0.02)


def clock_message(nanoseconds: int) -> bytes:
    """rosgraph_msgs/Clock in CDR."""
    sec, nanosec = divmod(nanoseconds, 10**9)
    return b"\0\1\0\0" + sec.to_bytes(4, "little") + nanosec.to_bytes(4, "little")


if __name__ == "__main__":
    main()
