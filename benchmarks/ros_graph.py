"""hiros in a ROS 2 graph: how late its results are, and a long run.

    python benchmarks/ros_graph.py delay [SECONDS [PEOPLE [CAMERAS]]]
    python benchmarks/ros_graph.py soak [MINUTES [SPEED [PEOPLE [CAMERAS [RATE [GONE]]]]]]

Needs rclpy and hiros_skeleton_msgs. ``delay`` plays a simulated log at its speed, and takes how
long after its last needed message a result reaches another process, through the graph and through
a Foxglove server. ``soak`` plays a minute forwards and backwards with a clock of its own, and
prints for each minute how long it took, how far the results are behind, s, the memory of hiros, MB,
its share of one core, and the results by id; at the end, what was lost. In the middle of each
minute, the node of the first camera dies, and comes back after ``GONE`` seconds.

Only delay, memory and losses count here, so the simulated detector is the ideal one.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np

from hiros_mcap.io.codec import Decoder, Encoder
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.log import open_log
from hiros_mcap.simulate import RigParams, SimulateParams
from hiros_mcap.simulate.body_model import MODEL
from hiros_mcap.simulate.simulation import write_log

TESTS = Path(__file__).parents[1] / "tests" / "ros2"
GROUP = "hiros_skeleton_msgs/msg/SkeletonGroup"
TOPICS = ("/hiros/tracked", "/hiros/merged", "/hiros/filtered")
HIROS = [sys.executable, "-m", "hiros_cli", "process", "ros2://", "-o", "out.mcap"]
_WARM_UP = 3 * 10**9
MINUTE_S = 60


def simulated(folder: Path, seconds: float, people: int, cameras: int, rate: float) -> Path:
    """Write the log that is played."""
    log = folder / "log.mcap"
    rig = RigParams(rate=rate)
    params = SimulateParams(people=people, cameras=cameras, seconds=seconds, seed=1, rig=rig)
    write_log(log, params)
    return log


def started(*command: object, folder: Path) -> subprocess.Popen:
    """Start a program whose pipes are ours."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([str(part) for part in command], text=True, cwd=folder, **pipes)


def machine() -> str:
    """Cores and load, which a figure depends on."""
    return f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"


def await_line(stream, text: str) -> str:
    """Read until a line has a text; return it."""
    while text not in (line := stream.readline()):
        assert line, f"ended before {text!r}"
    return line


def delay(seconds: float = 30.0, people: float = 4, cameras: float = 5) -> None:
    """Print quantiles of the delay, ms, by way and channel."""
    print(f"{people:g} people, {cameras:g} cameras, {machine()}")
    print("delay in ms: median, 95 %, 99 %")
    for way in ("ros2://", "ws://:0"):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            log = simulated(folder, seconds, int(people), int(cameras), 30.0)
            heard, lines = run_once(folder, log, way)
            with McapReader(folder / "out.mcap") as reader:
                topics = {i: channel.topic for i, channel in reader.channels.items()}
                rows = [
                    (topics[m.channel_id], m.log_time, bytes(m.data)) for m in reader.messages()
                ]
        for topic in TOPICS:
            known = {data: t for kind, t, data in rows if kind == topic}
            begin = min(known.values()) + _WARM_UP
            late = [
                (at - known[data]) / 1e6
                for kind, at, data in heard
                if kind == topic and known.get(data, 0) > begin
            ]
            shown = " ".join(f"{q:7.1f}" for q in np.quantile(late, [0.5, 0.95, 0.99]))
            n = sum(t > begin for t in known.values())
            print(f"{way:8} {topic:16} {len(late):6} of {n} {shown}")
        print(*lines, sep="\n")


def run_once(folder: Path, log: Path, way: str) -> tuple[list, list[str]]:
    """Play a log; return topic, time of arrival, ns, and bytes of each result, and notes."""
    listener = None
    if way == "ros2://":
        wanted = [f"{topic}={GROUP}" for topic in TOPICS]
        listener = started(
            sys.executable, TESTS / "listener.py", "heard.json", *wanted, folder=folder
        )
        await_line(listener.stdout, "listens")
    run = started(*HIROS, "-o", way, folder=folder)
    heard: list = []
    if listener is None:
        address = await_line(run.stderr, "serving").split()[-1]
        threading.Thread(target=hear, args=(address, heard), daemon=True).start()
    await_line(run.stderr, "listening")
    player = started(sys.executable, TESTS / "player.py", log, "1", folder=folder)
    await_line(player.stdout, "ends")
    time.sleep(1)
    run.send_signal(signal.SIGINT)
    _, err = run.communicate()
    player.communicate("")
    if listener is not None:
        listener.communicate("")
        rows = json.loads((folder / "heard.json").read_text())
        heard = [(topic, at, bytes.fromhex(data)) for topic, at, data in rows]
    return heard, [line for line in err.splitlines() if "lost" in line]


def hear(address: str, heard: list) -> None:
    """Subscribe to the results of a server, and note when they come."""
    from websockets.sync.client import connect

    names: dict[int, str] = {}
    with connect(address, subprotocols=["foxglove.sdk.v1"], compression=None) as server:
        for data in server:
            at = time.time_ns()
            if isinstance(data, bytes) and data[0] == 1:
                heard.append((names[struct.unpack_from("<I", data, 1)[0]], at, data[13:]))
            elif isinstance(data, str):
                for channel in json.loads(data).get("channels", []):
                    if channel["topic"] in TOPICS:
                        names[channel["id"]] = channel["topic"]
                        pairs = [{"id": channel["id"], "channelId": channel["id"]}]
                        server.send(json.dumps({"op": "subscribe", "subscriptions": pairs}))


def soak(
    minutes: float = 30, speed: float = 5, people: float = 2, cameras: float = 3, rate: float = 15,
    gone: float = 0,
) -> None:  # fmt: skip
    """Print memory, results and ids by minute."""
    import rclpy
    from hiros_skeleton_msgs.msg import SkeletonGroup
    from live import cpu_of
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from rosgraph_msgs.msg import Clock
    from soak import memory_of, repeated
    from tf2_msgs.msg import TFMessage

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log_file = simulated(folder, MINUTE_S, int(people), int(cameras), rate)
        run = started(
            *HIROS, "-o", "ros2://", "--ros-args", "-p", "use_sim_time:=true", folder=folder
        )
        await_line(run.stderr, "listening")
        threading.Thread(target=run.stderr.read, daemon=True).start()
        rclpy.init()
        node = rclpy.create_node("soak", start_parameter_services=False)
        counts: Counter[int] = Counter()
        heard: list[int] = []
        decoder = Decoder(MODEL, exact=True)

        def take(data: bytes) -> None:
            (frame,) = decoder.decode_message(data, 0)
            heard.append(frame.stamp)
            counts.update(frame.ids.tolist())

        node.create_subscription(SkeletonGroup, TOPICS[-1], take, QoSProfile(depth=1000), raw=True)
        threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
        clock = node.create_publisher(Clock, "/clock", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        static = node.create_publisher(TFMessage, "/tf_static", latched)
        rows, publishers = [], {}
        with open_log(log_file) as log:
            names = {i: c.topic for i, c in log.reader.channels.items()}
            cdr, encoder = Decoder(log.model, exact=True), Encoder(log.model)
            for message in log.reader.messages():
                topic, data = names[message.channel_id], bytes(message.data)
                if topic == "/tf_static":
                    static.publish(data)
                elif topic.startswith("/camera"):
                    if topic not in publishers:
                        publishers[topic] = node.create_publisher(SkeletonGroup, topic, 100)
                    (frame,) = cdr.decode_message(data, message.log_time)
                    rows.append((topic, frame))
        first = min(frame.log_time for _, frame in rows)
        while not all(p.get_subscription_count() for p in publishers.values()):
            clock.publish(tick(first))
            time.sleep(0.1)
        begin, sent, minute, mortal = time.monotonic(), 0, 1, min(publishers)
        scene = f"{people:g} people and {cameras:g} cameras"
        print(f"{minutes:g} min of {scene} at {speed:g} times the speed, {machine()}")
        print(f"{'minute':>6} {'took':>6} {'behind':>6} {'MB':>6} {'CPU':>5}  ids", flush=True)
        since, cpu = begin, cpu_of(run.pid)
        for played, (topic, frame) in enumerate(repeated(rows, first, int(minutes)), 1):
            at = (frame.log_time - first) / 1e9
            time.sleep(max(0.0, begin + at / speed - time.monotonic()))
            clock.publish(tick(frame.log_time))
            if topic == mortal:
                is_gone = MINUTE_S / 2 <= at % MINUTE_S < MINUTE_S / 2 + gone
                if is_gone and topic in publishers:
                    node.destroy_publisher(publishers.pop(topic))
                elif not is_gone and topic not in publishers:
                    publishers[topic] = node.create_publisher(SkeletonGroup, topic, 100)
            if topic in publishers:
                publishers[topic].publish(encoder.encode(frame))
                sent += 1
            if at >= minute * MINUTE_S or played == len(rows) * int(minutes):
                now = time.monotonic()
                behind = (frame.stamp - heard[-1]) / 1e9 if heard else float("nan")
                ids = ", ".join(f"{person} ({n})" for person, n in sorted(counts.items()))
                memory, used = memory_of(run.pid), cpu_of(run.pid)
                share = 100 * (used - cpu) / (now - since)
                print(
                    f"{minute:6} {now - since:6.1f} {behind:6.2f} {memory:6.0f} {share:3.0f} %  "
                    f"{ids}",
                    flush=True,
                )
                since, minute, cpu = now, minute + 1, used
                counts.clear()
        time.sleep(2)
        run.send_signal(signal.SIGINT)
        code = run.wait(600)
        with McapReader(folder / "out.mcap") as reader:
            topics = {i: c.topic for i, c in reader.channels.items()}
            by_topic = {topics[i]: n for i, n in reader.counts.items()}
        copied = sum(n for topic, n in by_topic.items() if topic.startswith("/camera"))
        print(
            f"{sent} messages sent, {sent - copied} not copied, "
            f"{sent - by_topic['/hiros/tracked']} not tracked; {by_topic[TOPICS[-1]]} results, "
            f"{by_topic[TOPICS[-1]] - len(heard)} not heard; exit code {code}"
        )


def tick(nanoseconds: int) -> bytes:
    """rosgraph_msgs/Clock in CDR."""
    return b"\0\1\0\0" + struct.pack("<iI", *divmod(nanoseconds, 10**9))


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
    {"delay": delay, "soak": soak}[sys.argv[1]](*map(float, sys.argv[2:]))
