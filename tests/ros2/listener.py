"""A node that subscribes to topics and keeps what comes; a program of its own.

    python listener.py OUT TOPIC=TYPE[=latched] ...

Prints a line when it listens. When its input ends, it writes OUT: a JSON list of topic, time of
arrival (ns), and the message in hexadecimal.
"""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
from functools import partial
from importlib import import_module

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("listener", start_parameter_services=False)
    rows: list[tuple[str, int, bytes]] = []

    def take(topic: str, data: bytes) -> None:
        rows.append((topic, time.time_ns(), data))

    for text in sys.argv[2:]:
        topic, kind, *latched = text.split("=")
        package, _, name = kind.split("/")
        quality = QoSProfile(depth=1000)
        if latched:
            quality.durability = DurabilityPolicy.TRANSIENT_LOCAL
        node.create_subscription(
            getattr(import_module(f"{package}.msg"), name), topic, partial(take, topic), quality,
            raw=True,
        )  # fmt: skip

    def end() -> None:
        sys.stdin.read()
        rclpy.try_shutdown()

    threading.Thread(target=end).start()
    print("listens", flush=True)
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)
    with open(sys.argv[1], "w") as file:  # noqa: PTH123
        json.dump([(topic, at, data.hex()) for topic, at, data in rows], file)


if __name__ == "__main__":
    main()
