"""A ROS 2 graph as input and output: nodes in processes of their own, on this computer alone."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from detector_logs import azure, humans, scene, write_ros2, zed
from mcap_logs import tf_bytes
from odd_logs import changed, poses_of
from scipy.spatial.transform import Rotation

import hiros_schemas
from hiros_cli.app import run as hiros
from hiros_mcap.config import load_config
from hiros_mcap.io.channels import TF_TOPICS, add_ros_channel
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.io.result import open_result
from hiros_mcap.running.pipeline import ProcessOptions, process

HERE = Path(__file__).parent
GROUP, ARRAY = hiros_schemas.SKELETON_GROUP, hiros_schemas.MARKER_ARRAY
PACKAGES = "rclpy, hiros_cli, hiros_skeleton_msgs.msg, tf2_msgs.msg, rosgraph_msgs.msg"
LIVE = ProcessOptions(system="fuse-realtime")
AS_KNOWN = load_config(None, ["output.log_time=causal"], system="fuse-realtime")
DISCOVERY = 1.5
"""s in which the programs of a graph find each other, also on two cores with other work."""
_domains = itertools.count(os.getpid() % 90 + 1, 7)


@cache
def ros_python(packages=PACKAGES):
    """Return a Python with ROS 2 and hiros, and which of some packages it lacks, "" for none."""
    python = os.environ.get("HIROS_ROS2_PYTHON", sys.executable)
    if not Path(python).exists():
        return python, f"{python} is not there"
    found = subprocess.run(
        [python, "-c", f"import {packages}"], capture_output=True, text=True, check=False
    )
    lines = found.stderr.splitlines()
    return python, lines[-1] if found.returncode else ""


class Graph:
    """A graph of its own, and its programs."""

    def __init__(self, folder, stack):
        self.python, missing = ros_python()
        if missing:
            pytest.skip(f"no ROS 2 here: {missing}")
        self.folder, self._stack = folder, stack
        self._env = os.environ | {
            "ROS_DOMAIN_ID": str(next(_domains) % 100 + 1),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder / "ros"),
        }

    def start(self, *arguments, **env):
        """Start a program that is killed at the end of the test if it still runs."""
        program = subprocess.Popen(
            [self.python, *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=self.folder,
            env=self._env | env,
        )

        def end():
            program.kill()
            program.communicate()

        self._stack.callback(end)
        return program

    def hiros(self, *arguments, **env):
        """Start ``hiros process ros2://`` and wait until it listens."""
        program = self.start("-m", "hiros_cli", "process", "ros2://", *arguments, **env)
        assert "listening" in program.stderr.readline()
        time.sleep(DISCOVERY)
        return program

    def player(self, log, *how, speed=1.0):
        """Start the player, which waits until everything has a subscriber."""
        return self.start(HERE / "player.py", log, speed, *how)

    def play(self, log, *how, speed=1.0):
        """Play a log to its end; the player stays."""
        player = self.player(log, *how, speed=speed)
        for line in ("begins\n", "ends\n"):
            assert player.stdout.readline() == line, player.stderr.read()
        return player

    def listener(self, out, *topics):
        """Start a listener and wait until it listens."""
        listener = self.start(HERE / "listener.py", out, *topics)
        assert listener.stdout.readline() == "listens\n"
        time.sleep(DISCOVERY)
        return listener

    def heard(self, listener, out):
        """End a listener; return what it heard: topic -> messages."""
        listener.communicate("", timeout=60)
        rows = json.loads((self.folder / out).read_text())
        return {t: [bytes.fromhex(d) for topic, _, d in rows if topic == t] for t, _, _ in rows}


@pytest.fixture
def graph(tmp_path):
    with contextlib.ExitStack() as stack:
        yield Graph(tmp_path, stack)


def stopped(program):
    """Stop as Ctrl-C does; return what is on stderr."""
    program.send_signal(signal.SIGINT)
    _, err = program.communicate(timeout=120)
    assert program.returncode == 0, err
    return err


def messages(path):
    """Topic -> messages, in the order of the file."""
    with McapReader(path) as reader:
        topics = {i: channel.topic for i, channel in reader.channels.items()}
        found = {}
        for message in reader.messages():
            found.setdefault(topics[message.channel_id], []).append(bytes(message.data))
    return found


def padded(rows):
    """Return messages as the middleware hands them out: of whole words."""
    return [row + bytes(-len(row) % 4) for row in rows]


def log_times(path):
    """Of the messages of a camera, ns."""
    with McapReader(path) as reader:
        chosen = [i for i, c in reader.channels.items() if c.topic == "/camera_0/skeletons"]
        return np.array([m.log_time for m in reader.messages(chosen)])


def by_camera(found):
    return {topic: rows for topic, rows in found.items() if topic.startswith("/camera")}


def test_a_graph_gives_what_a_file_gives_and_gets_the_results(crossing, graph, tmp_path):
    """One camera is best effort. All arrives, and a file of the same messages gives the same."""
    heard = graph.listener("heard.json", f"/hiros/filtered={GROUP}", f"/hiros/markers={ARRAY}")
    run = graph.hiros("-o", "out.mcap", "-o", "ros2://", "--markers")
    graph.play(crossing, "/camera_1/skeletons=best_effort")
    time.sleep(0.5)
    late = graph.listener("late.json", f"/hiros/summary={hiros_schemas.DIAGNOSTICS}=latched")
    time.sleep(1)
    stopped(run)
    out = messages(tmp_path / "out.mcap")
    for topic, sent in by_camera(messages(crossing)).items():
        assert out[topic] == padded(sent)
    taken = graph.heard(heard, "heard.json")
    assert taken == {topic: padded(out[topic]) for topic in ("/hiros/filtered", "/hiros/markers")}
    assert b"2 people" in graph.heard(late, "late.json")["/hiros/summary"][-1]
    process(tmp_path / "out.mcap", tmp_path / "again.mcap", config=AS_KNOWN, options=LIVE)
    live, again = (open_result(tmp_path / name).motions for name in ("out.mcap", "again.mcap"))
    assert sorted(live) == sorted(again) == [0, 1]
    for person, motion in live.items():
        assert np.nanmax(np.abs(motion.positions - again[person].positions)) < 1e-3


@pytest.mark.parametrize("make", [azure, humans, zed("zed-38")])
def test_other_detectors_are_read(make, graph, tmp_path):
    """MarkerArrays of an Azure Kinect, the frames of ROS4HRI on /tf, and bodies of a ZED."""
    if make not in (azure, humans) and (missing := ros_python("zed_msgs.msg")[1]):
        pytest.skip(f"no zed_msgs here: {missing}")
    made = scene(tmp_path / "scene.mcap", people=1, cameras=2, seconds=2)
    log = write_ros2(tmp_path / "log.mcap", made, make)
    run = graph.hiros("-o", "out.mcap")
    graph.play(log, "/humans/bodies/tracked=off")
    time.sleep(1)
    stopped(run)
    assert len(messages(tmp_path / "out.mcap")["/hiros/filtered"]) > 40


def test_a_camera_may_come_late_die_and_return(whole_crossing, graph, tmp_path):
    """Also of less quality than before; and a topic of another type is beside them."""
    run = graph.hiros("-o", "out.mcap")
    first = graph.play(whole_crossing, "/camera_0/skeletons=to:2", "/camera_2/skeletons=late:1")
    first.kill()
    again = graph.play(
        whole_crossing, *(f"/camera_{k}/skeletons=off" for k in (1, 2)), "/tf_static=off",
        "/camera_0/skeletons=from:3,best_effort",
    )  # fmt: skip
    time.sleep(1)
    err = stopped(run)
    again.kill()
    sent, got = by_camera(messages(whole_crossing)), by_camera(messages(tmp_path / "out.mcap"))
    assert got["/camera_1/skeletons"] == padded(sent["/camera_1/skeletons"])
    assert 90 < len(got["/camera_0/skeletons"]) < len(sent["/camera_0/skeletons"])
    assert 110 < len(got["/camera_2/skeletons"]) < len(sent["/camera_2/skeletons"])
    assert "lost on the way" not in err


def written(source, target, *, static, moving=(), since=0):
    """Copy a log from some ns on with other transforms; the moving ones are (stamp, ...)."""
    with McapReader(source) as reader, McapWriter(target) as writer:
        others = {i: c for i, c in reader.channels.items() if not c.topic.startswith("/tf")}
        writer.copy_definitions(reader, others)
        rows = list(reader.messages(others))
        begin = rows[0].log_time + since
        fixed = add_ros_channel(writer, "/tf_static", hiros_schemas.TF_MESSAGE)
        writer.write(fixed, begin, tf_bytes(*((0, *row) for row in static)))
        for stamp, *row in moving:
            tf = add_ros_channel(writer, "/tf", hiros_schemas.TF_MESSAGE)
            writer.write(tf, stamp, tf_bytes((stamp, *row)))
        for message in rows:
            if message.log_time >= begin:
                writer.write(message.channel_id, message.log_time, bytes(message.data))
        writer.commit()
    return target


def test_a_camera_that_starts_five_seconds_later_counts_from_then_on(graph, tmp_path):
    """Its transform is as late as itself: it comes from another node."""
    made = scene(tmp_path / "scene.mcap", people=1, cameras=3, seconds=8).path
    poses = poses_of(made)
    first = written(made, tmp_path / "first.mcap", static=poses[:-1])
    later = written(made, tmp_path / "later.mcap", static=poses[-1:], since=5 * 10**9)
    run = graph.hiros("-o", "out.mcap")
    early = graph.player(first, "/camera_2/skeletons=off")
    assert early.stdout.readline() == "begins\n"
    time.sleep(5)
    graph.play(later, *(f"{t}=off" for t in by_camera(messages(made)) if "camera_2" not in t))
    time.sleep(1)
    stopped(run)
    out, sent = messages(tmp_path / "out.mcap"), messages(later)
    assert out["/camera_2/skeletons"] == padded(sent["/camera_2/skeletons"])
    assert len(out["/hiros/tracked"]) == sum(map(len, by_camera(out).values()))


def test_a_camera_that_moves_is_followed(crossing, graph, tmp_path):
    """It rides 30 cm to and fro, once in two seconds. /tf says so, and no other camera helps."""
    poses = {row[1]: row for row in poses_of(crossing)}
    world, frame, at, xyzw = poses.pop(min(poses))

    def place(stamp):
        return np.array([0.3 * np.sin(np.pi * stamp * 1e-9), 0.0, 0.0])

    def ride(seen, _):
        markers = seen.markers.copy()
        if seen.frame_id == frame:
            markers[:, :, :3] -= Rotation.from_quat(xyzw).inv().apply(place(seen.stamp))
        return seen.replace(markers=markers)

    ridden = changed(crossing, tmp_path / "ridden.mcap", ride)
    with McapReader(ridden) as reader:
        times = sorted(m.log_time for m in reader.messages())
    still = (0.0, 0.0, 0.0, 1.0)
    steps = range(times[0], times[-1], 20_000_000)
    moved = written(
        ridden, tmp_path / "log.mcap", static=[*poses.values(), ("dolly", frame, at, xyzw)],
        moving=[(t, world, "dolly", place(t), still) for t in steps],
    )  # fmt: skip
    with open_log(crossing) as log:
        (topic,) = (c.channel.topic for c in log.cameras if frame in c.frames)
    run = graph.hiros("-o", "out.mcap", "--topic", topic)
    graph.play(moved, *(f"{t}=off" for t in messages(moved) if t not in (topic, *TF_TOPICS)))
    time.sleep(1)
    stopped(run)
    alone = replace(LIVE, topics=[topic])
    process(crossing, tmp_path / "still.mcap", config=AS_KNOWN, options=alone)
    live, fixed = (open_result(tmp_path / name).motions for name in ("out.mcap", "still.mcap"))
    assert sorted(live) == sorted(fixed) == [0, 1]
    for person, motion in live.items():
        mine, theirs = (np.round(m.times - m.times[-1], 3) for m in (motion, fixed[person]))
        _, i, k = np.intersect1d(mine, theirs, return_indices=True)
        apart = motion.positions[i] - fixed[person].positions[k]
        assert np.nanmedian(np.linalg.norm(apart, axis=-1)) < 0.02


def test_a_run_that_is_held_up_keeps_the_times_of_the_clock_and_says_so(crossing, graph, tmp_path):
    """Messages have the time of /clock when they came, not when they were taken."""
    sim_time = "--ros-args", "-p", "use_sim_time:=true"
    run = graph.hiros("-o", "-", "-o", "out.mcap", *sim_time)
    graph.play(crossing, "/clock=on")
    time.sleep(12)  # nobody reads the pipe
    threading.Thread(target=drained, args=(run.stdout.fileno(),)).start()
    time.sleep(3)
    run.send_signal(signal.SIGINT)
    assert run.wait(60) == 0
    assert "too slow for 5 topics: messages wait for 1" in run.stderr.read()
    sent, got = (log_times(path) for path in (crossing, tmp_path / "out.mcap"))
    assert np.abs(got - sent).max() < 0.3e9


def drained(descriptor):
    """Read a pipe to its end."""
    while os.read(descriptor, 1 << 16):
        pass


def test_arguments_of_ros(crossing, graph, tmp_path):
    """Names, namespace and the simulated time; the clock of the log is far from this one's."""
    rules = "-r /left:=/camera_0/skeletons -r __ns:=/lab -r hiros/filtered:=people"
    heard = graph.listener("heard.json", f"/lab/people={GROUP}")
    run = graph.hiros(
        "-o", "ros2://", "-o", "out.mcap",
        "--ros-args", *rules.split(), "-p", "use_sim_time:=true", "--", "--json",
    )  # fmt: skip
    graph.play(crossing, "/clock=on", "/truth/skeletons=off")
    time.sleep(1)
    assert "camera_0" in stopped(run)
    out, sent = messages(tmp_path / "out.mcap"), messages(crossing)
    assert out["/left"] == padded(sent["/camera_0/skeletons"])
    assert graph.heard(heard, "heard.json")["/lab/people"] == padded(out["/hiros/filtered"])
    with McapReader(crossing) as reader, McapReader(tmp_path / "out.mcap") as written:
        spans = [[m.log_time for m in log.messages()] for log in (reader, written)]
    assert abs(min(spans[1]) - min(spans[0])) < 1e9
    assert abs(max(spans[1]) - max(spans[0])) < 1e9


def test_a_topic_of_an_unknown_type_does_not_matter(crossing, graph, tmp_path):
    hidden = tmp_path / "hidden" / "diagnostic_msgs"
    hidden.mkdir(parents=True)
    (hidden / "__init__.py").write_text("raise ImportError")
    paths = os.pathsep.join([str(hidden.parent), os.environ.get("PYTHONPATH", "")])
    run = graph.hiros("-o", "out.mcap", "--keep", "/odd", PYTHONPATH=paths)
    odd = graph.listener("odd.json", f"/odd={hiros_schemas.DIAGNOSTICS}")
    graph.start("-c", ODD)
    graph.play(crossing)
    time.sleep(1)
    assert "/odd: not read: the message package diagnostic_msgs is not installed" in stopped(run)
    assert graph.heard(odd, "odd.json")
    assert len(messages(tmp_path / "out.mcap")["/hiros/filtered"]) > 50


ODD = """
import time, rclpy
from diagnostic_msgs.msg import DiagnosticArray
rclpy.init()
publisher = rclpy.create_node("odd").create_publisher(DiagnosticArray, "/odd", 10)
for _ in range(300):
    publisher.publish(DiagnosticArray())
    time.sleep(0.1)
"""


def test_a_message_package_that_is_missing_is_named(crossing, graph, tmp_path):
    hidden = tmp_path / "hidden" / "hiros_skeleton_msgs"
    hidden.mkdir(parents=True)
    (hidden / "__init__.py").write_text("raise ImportError")
    paths = os.pathsep.join([str(hidden.parent), os.environ.get("PYTHONPATH", "")])
    graph.player(crossing)
    run = graph.hiros("-o", "out.mcap", PYTHONPATH=paths)
    _, err = run.communicate(timeout=60)
    assert run.returncode == 2
    assert "the message package hiros_skeleton_msgs is not installed; build it" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out.mcap").exists()


def test_a_graph_without_people(graph):
    run = graph.hiros("-o", "out.mcap")
    run.send_signal(signal.SIGINT)
    _, err = run.communicate(timeout=60)
    assert run.returncode == 2
    assert "no topic that may show people was found" in err


def test_without_ros_the_remedy_is_said(tmp_path, monkeypatch, capfd):
    (tmp_path / "rclpy").mkdir()
    (tmp_path / "rclpy" / "__init__.py").write_text("raise ImportError('no rclpy here')")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert hiros(["process", "ros2://", "-o", str(tmp_path / "out.mcap"), "-q"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "needs rclpy (no rclpy here)" in line
    assert 'pip install "hiros-mcap[ros2]"' in line


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["ros2:///camera", "-o", "x.mcap"], "the ROS 2 graph is named ros2://"),
        (["ros2://"], "name the output"),
        (["-", "-o", "x.mcap", "--ros-args", "-r", "/a:=/b"], "they are for ros2://"),
        (["-", "-o", "x.mcap", "-o", "x.mcap"], "an output is named twice"),
        (["LOG", "-o", "x.mcap", "-o", "y.mcap"], "several -o are for live input"),
        (["LOG", "-o", "ros2://"], "add --follow"),
    ],
)
def test_what_cannot_be_asked_of_a_graph(arguments, fault, crossing, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    given = [str(crossing) if text == "LOG" else text for text in arguments]
    assert hiros(["process", *given]) == 2
    assert fault in capfd.readouterr().err
    assert not list(tmp_path.iterdir())


def test_two_outputs_get_the_same(crossing, tmp_path):
    """A pipe and a file."""
    with crossing.open("rb") as file:
        done = subprocess.run(
            [sys.executable, "-m", "hiros_cli", "process", "-", "-o", "-", "-o", "out.mcap", "-q"],
            stdin=file, capture_output=True, check=True, cwd=tmp_path,
        )  # fmt: skip
    (tmp_path / "piped.mcap").write_bytes(done.stdout)
    assert messages(tmp_path / "piped.mcap") == messages(tmp_path / "out.mcap")
    assert len(messages(tmp_path / "out.mcap")["/hiros/filtered"]) > 50
