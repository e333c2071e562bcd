"""Live input: the results of a file, as they come, whatever joins, ends early or goes away."""

from __future__ import annotations

import io
import json
import os
import struct
import threading
import time
import tracemalloc
from collections import defaultdict
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from detector_logs import (
    KINDS,
    MARKERS,
    ROS2,
    azure,
    default,
    header,
    kinect_v2,
    only,
    scene,
    together,
    write_ros2,
)
from mcap.reader import NonSeekingReader
from mcap.records import Channel
from mcap.stream_reader import StreamReader
from odd_logs import changed, poses_of, published, shifted

import hiros_schemas
from hiros_cli.run_report import _headline
from hiros_mcap.config import load_config
from hiros_mcap.errors import LogError
from hiros_mcap.io import foxglove
from hiros_mcap.io.channels import add_ros_channel
from hiros_mcap.io.codec import Decoder, ModelBuilder
from hiros_mcap.io.container import McapReader, Message
from hiros_mcap.io.container.file import Pipe
from hiros_mcap.io.container.live_input import McapInput
from hiros_mcap.io.container.live_reader import LiveReader
from hiros_mcap.io.container.writer import LiveWriter
from hiros_mcap.io.foxglove import FoxgloveInput
from hiros_mcap.io.log import open_log
from hiros_mcap.io.result import open_result
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.running.process_live import process_live, subscription
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log

LIVE = ProcessOptions(system="hiros-realtime")
AS_KNOWN = load_config(None, ["output.log_time=causal"], system="hiros-realtime")
"""Results of a file are logged when they were known, as live ones are."""
Messages = dict[str, list[tuple[int, bytes]]]


def recorded(path):
    """Topic and message, in the order of the log."""
    with McapReader(path) as reader:
        return [
            (reader.channels[m.channel_id].topic, replace(m, data=bytes(m.data)))
            for m in reader.messages()
        ]


def results(data):
    """Messages of every result channel, as the mcap library reads them."""
    found: Messages = defaultdict(list)
    reader = NonSeekingReader(io.BytesIO(data), validate_crcs=True)
    for _, channel, message in reader.iter_messages(log_time_order=False):
        if channel.topic.startswith("/hiros/"):
            found[channel.topic].append((message.log_time, message.data))
    return found


@contextmanager
def piped(write):
    """Yield the end of a pipe into which a thread writes."""
    end, begin = os.pipe()

    def run():
        try:
            write(begin)
        except BrokenPipeError:
            pass
        finally:
            os.close(begin)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield McapInput(end, "pipe")
    finally:
        os.close(end)
        thread.join()


def send(path, messages, *, commit=True):
    """Return what writes messages of a log into a pipe; a channel is defined when it is used."""

    def write(descriptor):
        with McapReader(path) as reader, LiveWriter(Pipe(descriptor, "pipe")) as writer:
            for topic, message in messages:
                channel = next(c for c in reader.channels.values() if c.topic == topic)
                writer.write_message(writer.adopt(channel, reader.schema(channel)), message)
                writer.flush()
            if commit:
                writer.commit()

    return write


class OneByOne:
    """An input whose messages come after pauses."""

    def __init__(self, source):
        self._source = source

    def __getattr__(self, name):
        return getattr(self._source, name)

    def records(self):
        for record in self._source.records():
            yield record
            yield None


def run_live(write, options=LIVE, config=None, paced=lambda source: source):
    """Run with a pipe at both ends."""
    taken: list[bytes] = []
    end, begin = os.pipe()

    def drain():
        with open(end, "rb", buffering=0) as file:  # noqa: PTH123
            while data := file.read(1 << 16):
                taken.append(data)

    thread = threading.Thread(target=drain)
    thread.start()
    try:
        with piped(write) as source:
            summary = process_live(paced(source), begin, config=config, options=options)
    finally:
        os.close(begin)
        thread.join()
    return summary, b"".join(taken)


@pytest.fixture(scope="module")
def by_file(crossing, tmp_path_factory):
    out = tmp_path_factory.mktemp("live") / "out.mcap"
    process(crossing, out, config=AS_KNOWN, options=LIVE)
    return results(out.read_bytes())


@pytest.mark.parametrize("paced", [lambda source: source, OneByOne], ids=["at once", "one by one"])
def test_a_pipe_gives_what_a_file_gives(paced, crossing, by_file):
    summary, out = run_live(send(crossing, recorded(crossing)), paced=paced)
    assert results(out) == by_file
    assert [person.id for person in summary.people] == [0, 1]
    assert summary.warnings == ()


@pytest.mark.parametrize(("paced", "most"), [(lambda source: source, 32), (OneByOne, 1)])
def test_what_came_while_a_run_was_busy_is_handed_out_together(paced, most, crossing):
    with crossing.open("rb") as file:
        reader = LiveReader(paced(McapInput(file.fileno(), "pipe")))
        n = [sum(len(part.messages) for part in batch.records) for batch in reader.batches()]
    assert max(n) == most
    assert sum(n) == sum(reader.counts.values()) == len(recorded(crossing))


def test_the_input_is_copied(crossing):
    sent = recorded(crossing)
    _, out = run_live(send(crossing, sent))
    copied = [r.data for r in StreamReader(io.BytesIO(out)).records if isinstance(r, Message)]
    assert [m.data for _, m in sent] == [
        data for data in copied if data in {m.data for _, m in sent}
    ]


def test_results_come_before_the_input_ends(crossing):
    sent = recorded(crossing)
    seen, done = threading.Event(), threading.Event()
    taken = bytearray()
    end, begin = os.pipe()

    def drain():
        with open(end, "rb", buffering=0) as file:  # noqa: PTH123
            while data := file.read(1 << 16):
                taken.extend(data)
                if b"/hiros/filtered" in taken and len(taken) > 1_000_000:
                    seen.set()
        done.set()

    def write(descriptor):
        half = len(sent) // 2
        send(crossing, sent[:half], commit=False)(descriptor)
        assert seen.wait(60)  # the input is still open

    threading.Thread(target=drain).start()
    with piped(write) as source:
        process_live(source, begin, options=LIVE)
    os.close(begin)
    assert done.wait(60)


def test_where_nothing_is_merged_no_message_waits_for_other_cameras(crossing):
    options = ProcessOptions(system="hiros-realtime", stages="T")
    at_once = ["input.max_delay=0", "track.reorder=0"]
    config = load_config(None, at_once, system="hiros-realtime")
    _, out = run_live(send(crossing, recorded(crossing)), options, config, OneByOne)
    topics, order = {}, []
    for record in StreamReader(io.BytesIO(out)).records:
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message):
            order.append(topics[record.channel_id])
    order = [topic for topic in order if topic.startswith(("/camera", "/hiros"))][-60:]
    assert order[1::2] == 30 * ["/hiros/tracked"]  # behind the second of listening
    assert "/hiros/tracked" not in order[::2]


@pytest.mark.parametrize("named", [False, True])
def test_a_camera_may_join_later(named, crossing):
    """Also where topics are ``named``, one by one."""
    sent = recorded(crossing)
    cameras = sorted({topic for topic, _ in sent if topic.startswith("/camera")})
    late, options = cameras[0], replace(LIVE, topics=tuple(cameras) if named else ())
    start = min(m.log_time for topic, m in sent if topic.startswith("/camera"))
    sent = [(t, m) for t, m in sent if t != late or m.log_time > start + 1_000_000_000]
    summary, out = run_live(send(crossing, sent), options)
    camera = next(camera for camera in summary.cameras if camera.topic == late)
    assert camera.used == sum(topic == late for topic, _ in sent)
    assert summary.warnings == ()
    copied = NonSeekingReader(io.BytesIO(out)).iter_messages(topics=[late])
    assert len([*copied]) == camera.used


def test_transforms_may_come_later(crossing, by_file):
    sent = recorded(crossing)
    tf = [pair for pair in sent if pair[0] == "/tf_static"]
    others = [pair for pair in sent if pair[0] != "/tf_static"]
    _, out = run_live(send(crossing, [*others[:120], *tf, *others[120:]]))
    found = results(out)
    assert [m for _, m in found["/hiros/filtered"]] == [m for _, m in by_file["/hiros/filtered"]]


def test_transforms_may_come_in_a_namespace(crossing, by_file, tmp_path):
    topics = {f"/{row[1]}/tf_static": [row] for row in poses_of(crossing)}
    log = published(crossing, tmp_path / "log.mcap", topics)
    summary, out = run_live(send(log, recorded(log)))
    assert results(out) == by_file
    assert any("/camera_1/tf_static" in note for note in summary.notes)
    assert subscription(LIVE)("/robot1/tf_static", hiros_schemas.TF_MESSAGE)


def test_without_transforms_it_gives_up_with_the_remedy(crossing):
    sent = [pair for pair in recorded(crossing) if pair[0] != "/tf_static"]
    with pytest.raises(LogError, match="pass them with --extrinsics"):
        run_live(send(crossing, sent))


@pytest.mark.parametrize("end", [b"", b"\x05" + (1000).to_bytes(8, "little") + b"only a part"])
def test_an_input_that_is_cut_off_gives_what_came(end, crossing, by_file):
    def write(descriptor):
        send(crossing, recorded(crossing), commit=False)(descriptor)
        os.write(descriptor, end)

    summary, out = run_live(write)
    assert results(out) == by_file
    (warning,) = summary.warnings
    assert "without its end mark" in warning


def test_damage_is_named(crossing):
    data = bytearray(crossing.read_bytes())
    data[len(data) // 2] ^= 0xFF

    def write(descriptor):
        rest = memoryview(bytes(data))
        while rest:
            rest = rest[os.write(descriptor, rest) :]

    with pytest.raises(LogError, match="pipe: damaged: "):
        run_live(write)


@pytest.mark.parametrize("data", [b"", b"text that is no MCAP"])
def test_what_is_no_mcap_is_refused(data):
    with pytest.raises(LogError, match="not MCAP"):
        run_live(lambda descriptor: os.write(descriptor, data) and None)


@pytest.fixture(scope="module")
def two_detectors(tmp_path_factory):
    """A log with SkeletonGroups of a Kinect v2 beside an Azure Kinect."""
    folder = tmp_path_factory.mktemp("detectors")
    made = scene(folder / "scene.mcap", people=1, cameras=2, seconds=2.5)
    mixed = together(only("camera_0", azure), only("camera_1", kinect_v2))
    return write_ros2(folder / "mixed.mcap", made, mixed)


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """One scene; how its logs are made by detector; and what a file of each gives."""
    folder = tmp_path_factory.mktemp("detectors")
    made = scene(folder / "scene.mcap", people=2, cameras=2, seconds=1.2, action="cross")

    def of(kind):
        out = folder / f"{kind}.out.mcap"
        log = KINDS[kind](folder / f"{kind}.mcap", made)
        if not out.exists():
            process(log, out, config=AS_KNOWN, options=LIVE)
        return log, results(out.read_bytes())

    return of


def joints_in(messages):
    """(M, 3) by person and stamp in units of 1/30 s."""
    builder = ModelBuilder()
    for _, data in messages:
        builder.add(data, "")
    decoder = Decoder(builder.build())
    frames = [decoder.decode_message(data)[0] for _, data in messages]
    return {
        (person, round(frame.stamp * 30e-9)): joints
        for frame in frames
        for person, joints in zip(frame.ids.tolist(), frame.positions, strict=True)
    }


ELSEWHERE = {"azure kinect in a ros1 bag", "zed 18", "zed 34", "zed 70"}
"""No live input, or read as zed 38 is: ``io/test_detectors.py`` compares all of them."""


def check_same(kind, live, by_file):
    """See that live input gives what the file gives."""
    if kind not in ("stamped skeletons", "ros4hri"):
        assert live == by_file
        return
    # The next instant shows that one is over. So messages come in another order.
    one, other = (joints_in(found["/hiros/filtered"]) for found in (live, by_file))
    assert len(one.keys() & other.keys()) > 0.9 * len(other)
    apart = [np.linalg.norm(one[key] - other[key], axis=1) for key in one.keys() & other.keys()]
    assert np.nanmedian(np.concatenate(apart)) < 0.01


@pytest.mark.parametrize("kind", sorted(KINDS.keys() - ELSEWHERE))
def test_every_detector_is_read_live_as_from_a_file(kind, shown):
    log, by_file = shown(kind)
    summary, data = run_live(send(log, recorded(log)))
    assert len(summary.cameras) == 2
    assert summary.warnings == ()
    check_same(kind, results(data), by_file)


@pytest.mark.parametrize("late", ["", "/camera_0/body_tracking_data", "/camera_1/skeletons"])
def test_cameras_of_two_detectors_are_fused_live(two_detectors, late):
    """Also where one joins when results have the other's skeleton."""
    messages = recorded(two_detectors)
    begin = min(m.log_time for topic, m in messages if not topic.startswith("/tf"))
    some = [(t, m) for t, m in messages if t != late or m.log_time > begin + 1_000_000_000]
    summary, data = run_live(send(two_detectors, some))
    assert summary.warnings == ()
    used = {camera.topic: camera.used for camera in summary.cameras}
    assert len(used) == 2
    assert all(n > 25 for n in used.values())
    (model,) = {joints.shape for joints in joints_in(results(data)["/hiros/filtered"]).values()}
    assert model[0] == {"": 32, "/camera_0/body_tracking_data": 24}.get(late, 32)


def test_messages_of_another_detector_that_are_damaged_are_counted(two_detectors):
    messages = recorded(two_detectors)
    bad = [
        (t, replace(m, data=m.data[: len(m.data) // 2]) if k % 9 == 5 else m)
        for k, (t, m) in enumerate(messages)
    ]
    n = sum(k % 9 == 5 and "body" in t for k, (t, _) in enumerate(messages))
    summary, _ = run_live(send(two_detectors, bad))
    camera = next(camera for camera in summary.cameras if "body" in camera.topic)
    assert camera.skipped["cannot be decoded"] == n
    assert camera.messages == sum("body" in t for t, _ in messages)


def test_what_may_show_people_is_subscribed_to():
    wants = subscription(ProcessOptions())
    named = subscription(ProcessOptions(topics=["/camera_0/*"], extrinsics=Path("cameras.toml")))
    markers, objects = "visualization_msgs/msg/MarkerArray", "zed_msgs/msg/ObjectsStamped"
    assert wants("/camera_0/body_tracking_data", markers)
    assert wants("/zed/body_trk/skeletons", objects)
    assert wants("/tf", "tf2_msgs/msg/TFMessage")
    assert not wants("/hiros/markers", markers)
    assert not wants("/camera_0/image", "sensor_msgs/msg/Image")
    assert named("/camera_0/body_tracking_data", markers)
    assert named("/tf", "tf2_msgs/msg/TFMessage")  # of humans
    assert not named("/camera_1/body_tracking_data", markers)
    two = subscription(ProcessOptions(topics=["/camera_0/*", "/camera_1/*"]))
    groups = [two(f"/camera_{k}/skeletons", hiros_schemas.SKELETON_GROUP) for k in range(3)]
    assert groups == [True, True, False]


def test_other_markers_are_copied_and_no_camera(crossing, by_file):
    """Markers of a robot, for example; nobody has to be told."""
    marker = default(
        "visualization_msgs/msg/Marker", header=header(1_700_000_000_000_000_000, "world"), type=1
    )
    data = bytes(ROS2.serialize_cdr(ROS2.types[MARKERS]([marker]), MARKERS))
    with McapReader(crossing) as reader:
        first = next(m.log_time for m in reader.messages())

    def write(descriptor):
        with LiveWriter(Pipe(descriptor, "pipe")) as writer:
            robot = add_ros_channel(writer, "/robot/markers", MARKERS)
            with McapReader(crossing) as reader:
                for k, message in enumerate(reader.messages()):
                    channel = reader.channels[message.channel_id]
                    ident = writer.adopt(channel, reader.schema(channel))
                    writer.write_message(ident, message)
                    if k % 3 == 0:
                        writer.write(robot, first, data)
                    writer.flush()
            writer.commit()

    options = replace(LIVE, keep=["/robot/*"])
    summary, out = run_live(write, options)
    assert summary.warnings == ()
    assert results(out) == by_file
    copied = NonSeekingReader(io.BytesIO(out)).iter_messages(topics=["/robot/markers"])
    assert {message.data for _, _, message in copied} == {data}


def without(joint, model):
    """Return what takes a joint, and all that ends there, out of a frame."""
    k = model.marker_names.index(joint)
    ends = zip(model.link_parents, model.link_children, strict=True)
    links = [i for i, pair in enumerate(ends) if k in pair]

    def cut(frame):
        people = frame.people.copy()
        for states, slots in ((people.markers, k), (people.links, links)):
            states[:, slots] = np.nan
        people.marker_confidences[:, k] = people.link_confidences[:, links] = np.nan
        return frame.replace(people=people)

    return cut


@pytest.mark.parametrize("alone", [False, True])
def test_a_joint_that_is_seen_late_costs_no_message(alone, crossing, tmp_path):
    """Results have begun without it; ``alone``: at last somebody shows nothing else."""
    with open_log(crossing) as log:
        model = log.model
    cut, k = without("WRIST_LEFT", model), model.marker_names.index("WRIST_LEFT")

    def change(frame, sent):
        if sent < 40 or not alone:
            return cut(frame) if sent < 40 else frame
        people = frame.people.copy()
        people.markers[:, [i for i in range(model.n_markers) if i != k]] = np.nan
        return frame.replace(people=people)

    log = changed(crossing, tmp_path / "late.mcap", change)
    summary, out = run_live(send(log, recorded(log)))
    assert [c.used for c in summary.cameras] == [c.messages for c in summary.cameras]
    (warning,) = [w for w in summary.warnings if "WRIST_LEFT" in w]
    assert warning.startswith("joints that nobody had shown when the results began")
    frames = len(results(out)["/hiros/filtered"])
    assert frames > (40 if alone else 55)


def test_skeletons_in_another_encoding_are_left_out_with_a_warning(crossing, by_file):
    def write(descriptor):
        with LiveWriter(Pipe(descriptor, "pipe")) as writer, McapReader(crossing) as reader:
            ids = {i: writer.adopt(c, reader.schema(c)) for i, c in reader.channels.items()}
            schema = next(s for s in writer.schemas.values() if s.name.endswith("SkeletonGroup"))
            odd = writer.add_channel("/odd", schema.id, encoding="json")
            for message in reader.messages():
                writer.write_message(ids[message.channel_id], message)
                writer.write(odd, message.log_time, b"{}")
                writer.flush()
            writer.commit()

    summary, out = run_live(write)
    (warning,) = summary.warnings
    assert warning.startswith("/odd: not used, encoded as 'json' and not as CDR")
    assert results(out) == by_file


def test_a_reader_that_goes_away_ends_the_run(crossing):
    end, begin = os.pipe()
    os.close(end)
    with piped(send(crossing, recorded(crossing))) as source, pytest.raises(BrokenPipeError):
        process_live(source, begin, options=LIVE)
    os.close(begin)


def test_what_was_waited_for_is_no_work(crossing):
    def write(descriptor):
        time.sleep(1)
        send(crossing, recorded(crossing))(descriptor)

    summary, _ = run_live(write)
    assert 0.9 < summary.waited_s < summary.wall_s
    work = summary.wall_s - summary.waited_s
    assert summary.times_real_time == pytest.approx(summary.log_s / work)
    waited = f"{summary.waited_s:.2f} s of them waiting for the input, with hiros-realtime: "
    assert f"{waited}{summary.log_s / work:.1f} times real time" in _headline(summary)[1]


class Busy:
    """Holds a run up once, for so many seconds."""

    def __init__(self, seconds):
        self.seconds = seconds

    def begin(self, *_):
        pass

    end = begin

    def frame(self, channel, _):
        if channel == "filtered":
            time.sleep(self.seconds)
            self.seconds = 0.0


def test_results_are_later_by_the_time_for_which_the_run_was_busy(crossing):
    messages = recorded(crossing)

    def as_recorded():
        start = time.perf_counter() - messages[0][1].log_time * 1e-9
        for topic, message in messages:
            time.sleep(max(0.0, start + message.log_time * 1e-9 - time.perf_counter()))
            yield topic, message

    most = []
    for seconds in (0.0, 1.5):
        with piped(send(crossing, as_recorded())) as source:
            summary = process_live(source, None, options=LIVE, watcher=Busy(seconds))
        most.append(summary.delay.most_s)
    assert most[1] > most[0] + 0.5


def test_stopping_ends_the_input(crossing, tmp_path):
    out = tmp_path / "out.mcap"

    def write(descriptor):
        send(crossing, recorded(crossing), commit=False)(descriptor)
        source.stop()
        finished.wait(60)  # the pipe stays open

    finished = threading.Event()
    with piped(write) as source:
        summary = process_live(source, out, options=LIVE)
        finished.set()
    assert results(out.read_bytes())["/hiros/filtered"]
    assert summary.warnings == ()


@pytest.mark.parametrize("kind", ["skeleton groups", "ros4hri"])
def test_a_file_is_followed_to_its_end_mark(kind, shown, tmp_path):
    log, by_file = shown(kind)
    growing, out = tmp_path / "growing.mcap", tmp_path / "out.mcap"
    data = memoryview(log.read_bytes())
    growing.write_bytes(data[:1000])

    def grow():
        with growing.open("ab", buffering=0) as file:
            for at in range(1000, len(data), 20_000):
                file.write(data[at : at + 20_000])

    thread = threading.Thread(target=grow)
    thread.start()
    with growing.open("rb", buffering=0) as file:
        process_live(McapInput(file.fileno(), "growing", follow=True), out, options=LIVE)
    thread.join()
    check_same(kind, results(out.read_bytes()), by_file)


@contextmanager
def foxglove_server(path, early=()):
    """Yield the address of a server that publishes a log as soon as all channels have a reader.

    It has sent the topics that are ``early`` before, when nobody was there.
    """
    foxglove = pytest.importorskip("foxglove")
    subscribed, sent = threading.Semaphore(0), recorded(path)

    class Listener(foxglove.ServerListener):
        def on_subscribe(self, client, channel):
            subscribed.release()

    context = foxglove.Context()
    server = foxglove.start_server(
        port=0, message_backlog_size=100_000, server_listener=Listener(), context=context
    )
    with McapReader(path) as reader:
        channels = {
            channel.topic: foxglove.Channel(
                channel.topic,
                message_encoding="cdr",
                schema=foxglove.Schema(
                    name=schema.name, encoding=schema.encoding, data=schema.data
                ),
                context=context,
            )
            for channel in reader.channels.values()
            if (schema := reader.schema(channel))
        }

    def publish(messages):
        for topic, message in messages:
            channels[topic].log(message.data, log_time=message.log_time)

    def publish_to_readers():
        for _ in channels:
            assert subscribed.acquire(timeout=60)
        publish((topic, message) for topic, message in sent if topic not in early)

    publish((topic, message) for topic, message in sent if topic in early)
    thread = threading.Thread(target=publish_to_readers)
    thread.start()
    yield f"ws://127.0.0.1:{server.port}"
    thread.join()
    server.stop()


class FirstMessages(FoxgloveInput):
    """All channels of a server, up to a number of messages."""

    def __init__(self, url, number):
        super().__init__(url, lambda topic, kind: True)
        self._number = number

    def records(self):
        taken = 0
        for record in super().records():
            yield record
            taken += isinstance(record, Message)
            if taken == self._number:
                self.stop()


def test_a_foxglove_server_gives_what_a_file_gives(crossing, by_file, tmp_path):
    out = tmp_path / "out.mcap"
    with foxglove_server(crossing) as url:
        process_live(FirstMessages(url, len(recorded(crossing))), out, options=LIVE)
    assert results(out.read_bytes()) == by_file


def test_transforms_that_came_too_early_are_told_with_the_remedy(crossing, tmp_path):
    later = [topic for topic, _ in recorded(crossing) if topic != "/tf_static"]
    with foxglove_server(crossing, early=["/tf_static"]) as url, pytest.raises(LogError) as error:
        process_live(FirstMessages(url, len(later)), tmp_path / "out.mcap", options=LIVE)
    text = str(error.value)
    assert "the camera poses are unknown; pass them with --extrinsics" in text
    assert "No message of /tf_static has come: it was sent before hiros listened" in text
    assert text.endswith("publish it again, or start hiros first")


def test_a_second_recording_in_a_pipe_is_named(crossing, by_file):
    def write(descriptor):
        send(crossing, recorded(crossing))(descriptor)
        send(crossing, recorded(crossing)[:100])(descriptor)

    summary, out = run_live(write)
    assert results(out) == by_file
    (warning,) = summary.warnings
    assert warning.startswith("the input goes on behind its end mark")


@pytest.mark.parametrize("ends", [True, False])
def test_a_run_ends_where_time_begins_anew_and_bears_single_old_messages(
    ends, crossing, by_file, tmp_path
):
    """Behind the recording comes one of an hour ago; or some messages of it come in between."""
    sent = recorded(crossing)
    past = shifted(crossing, tmp_path / "past.mcap", lambda topic: -3600.0)
    old = [pair for pair in recorded(past) if pair[0].startswith("/camera")]
    mixed = [p for k, pair in enumerate(sent) for p in (pair, *old[k : k + (k % 5 == 4)])]
    summary, out = run_live(send(crossing, sent + old if ends else mixed))
    assert len(results(out)["/hiros/filtered"]) >= 0.95 * len(by_file["/hiros/filtered"])
    late = sum(camera.skipped["too late to be merged"] for camera in summary.cameras)
    assert late == 100 if ends else late > 10
    assert any("time went back by 36" in text for text in summary.warnings) == ends


@pytest.mark.parametrize("places", [{0}, {60}, {0, 1, 30, 31, 32, 90}], ids=str)
def test_single_messages_far_ahead_are_left_out_and_counted(places, crossing, by_file, tmp_path):
    """A message of the next hour comes before some of the recording."""
    ahead = shifted(crossing, tmp_path / "ahead.mcap", lambda topic: 3600.0)
    future = iter([pair for pair in recorded(ahead) if pair[0].startswith("/camera")])
    sent = []
    for k, pair in enumerate(recorded(crossing)):
        sent += [next(future), pair] if k in places else [pair]
    summary, out = run_live(send(crossing, sent))
    assert results(out) == by_file
    notes = [text for text in summary.notes if "ahead of all others" in text]
    counts = [int(text.split(": ")[1].split(" ")[0]) for text in notes]
    assert sum(counts) == len(places)
    assert summary.warnings == ()


@pytest.mark.parametrize("seconds", [3600.0, -3600.0])
def test_a_log_time_that_is_wrong_alone_is_mended_by_the_stamp(seconds, crossing, by_file):
    """All messages of the second half: the recorder's clock was set, those of the cameras not."""
    sent = recorded(crossing)
    half, step = len(sent) // 2, round(1e9 * seconds)
    late = [(t, replace(m, log_time=m.log_time + step)) for t, m in sent[half:]]
    summary, out = run_live(send(crossing, sent[:half] + late))
    found, expected = (messages["/hiros/filtered"] for messages in (results(out), by_file))
    assert [data for _, data in found] == [data for _, data in expected]
    assert any("the stamps fit, so hiros goes by them" in note for note in summary.notes)


def test_nothing_is_lost_where_all_time_goes_on_later(crossing, tmp_path):
    """The recording pauses for a minute, or its computer's clock is set ahead."""
    later = recorded(shifted(crossing, tmp_path / "later.mcap", lambda topic: 60.0))
    sent = recorded(crossing)
    half = len(sent) // 2
    summary, _ = run_live(send(crossing, sent[:half] + later[half:]))
    assert sum(camera.used for camera in summary.cameras) == sum(
        topic.startswith("/camera") for topic, _ in sent
    )
    assert not any("ahead of all others" in note for note in summary.notes)


def chunk(data, size, compression="zstd"):
    """Return an MCAP up to a chunk that claims to have ``size`` bytes."""
    content = struct.pack("<QQQI", 0, 0, size, 0)
    content += struct.pack("<I", len(compression)) + compression.encode()
    content += struct.pack("<Q", len(data)) + data
    head = b"\x89MCAP0\r\n\x01" + struct.pack("<QII", 8, 0, 0)
    return head + b"\x06" + struct.pack("<Q", len(content)) + content


def short_message():
    return chunk(b"\x05" + struct.pack("<Q", 21) + bytes(21), 30, "")


BOMB = zstandard.compress(bytes(300 << 20))
ODD = {
    "claims 314572800 bytes": chunk(BOMB, 300 << 20),
    "does not decompress": chunk(BOMB, 100),
    "a message is shorter": short_message(),
    "a field claims 1099511627776 bytes": b"\x89MCAP0\r\n\x06"
    + struct.pack("<QQQQI", 1000, 0, 0, 0, 0)
    + struct.pack("<IQ", 0, 1 << 40),
    "not UTF-8": b"\x89MCAP0\r\n\x01" + struct.pack("<QI", 9, 1) + b"\xff" + bytes(4),
}


@pytest.mark.parametrize("fault", ODD)
def test_odd_bytes_of_a_pipe_are_damage(fault):
    tracemalloc.start()
    try:
        with pytest.raises(LogError, match=f"pipe: damaged: .*({fault}|codec can't decode)"):
            run_live(lambda descriptor: os.write(descriptor, ODD[fault]) and None)
        assert tracemalloc.get_traced_memory()[1] < 100 << 20
    finally:
        tracemalloc.stop()


@contextmanager
def odd_server(path, end):
    """Yield the address of a server that publishes a log, and then ends as ``end`` does."""
    server = pytest.importorskip("websockets.sync.server")

    def publish(connection):
        with McapReader(path) as reader:
            channels = [
                {
                    "id": channel.id,
                    "topic": channel.topic,
                    "encoding": "cdr",
                    "schemaName": schema.name,
                    "schema": schema.data.decode(),
                }
                for channel in reader.channels.values()
                if (schema := reader.schema(channel))
            ]
            connection.send(json.dumps({"op": "advertise", "channels": channels}))
            wanted = json.loads(connection.recv())["subscriptions"]
            ids = {row["channelId"]: row["id"] for row in wanted}
            for m in reader.messages():
                if m.channel_id in ids:
                    head = struct.pack("<BIQ", 1, ids[m.channel_id], m.log_time)
                    connection.send(head + bytes(m.data))
        end(connection)

    with server.serve(publish, "127.0.0.1", 0, compression=None) as listening:
        thread = threading.Thread(target=listening.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{listening.socket.getsockname()[1]}"
        finally:
            listening.shutdown()
            thread.join()


def huge(connection):
    connection.socket.sendall(b"\x82\x7f" + (1 << 62).to_bytes(8, "big") + bytes(1000))
    connection.recv()


ENDS: dict[str, tuple[Callable[[Any], None], str]] = {
    "farewell": (lambda connection: None, ""),
    "no farewell": (lambda connection: connection.close_socket(), "no close frame received"),
    "error": (lambda connection: connection.close(1011, "boom"), "boom"),
    "garbage": (lambda connection: connection.socket.sendall(b"\xff" * 99), "invalid opcode"),
    "huge": (huge, "exceeds limit of 67108864 bytes"),
}


@pytest.mark.parametrize("name", ENDS)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_connection_that_breaks_is_named(name, crossing):
    end, fault = ENDS[name]
    with odd_server(crossing, end) as url:
        source = FoxgloveInput(url, lambda topic, kind: "image" not in topic)
        summary = process_live(source, None, options=LIVE)
    broken = [text for text in summary.warnings if text.startswith("the connection broke")]
    assert [fault in text for text in broken] == ([True] if fault else [])
    assert summary.source == url


def test_a_run_that_is_busy_keeps_its_server(crossing, monkeypatch):
    """It compiles, or draws; an answer to a ping would lie behind messages that nobody takes."""
    client = pytest.importorskip("websockets.sync.client")
    hasty = partial(client.connect, ping_interval=0.1, ping_timeout=0.1)
    monkeypatch.setattr(client, "connect", hasty)
    with odd_server(crossing, lambda connection: None) as url:
        source = FoxgloveInput(url, lambda topic, kind: True)
        for k, _ in enumerate(source.records()):
            if k == 100:
                time.sleep(1)
    assert source.fault == ""


def test_who_subscribes_too_early_asks_again():
    """foxglove-sdk advertises a channel before it takes subscriptions of it."""
    server = pytest.importorskip("websockets.sync.server")

    def publish(connection):
        channel = {"id": 7, "topic": "/t", "encoding": "cdr", "schemaName": "x/T", "schema": ""}
        connection.send(json.dumps({"op": "advertise", "channels": [channel]}))
        for _ in range(3):
            assert json.loads(connection.recv())["subscriptions"] == [{"id": 1, "channelId": 7}]
            error = {"op": "status", "level": 2, "message": "Unknown channel ID: 7"}
            connection.send(json.dumps(error))
        connection.recv()
        connection.send(struct.pack("<BIQ", 1, 1, 5) + b"data")

    with server.serve(publish, "127.0.0.1", 0) as listening:
        thread = threading.Thread(target=listening.serve_forever)
        thread.start()
        source = FoxgloveInput(
            f"ws://127.0.0.1:{listening.socket.getsockname()[1]}", lambda topic, kind: True
        )
        stopper = threading.Timer(5, source.stop)
        stopper.start()
        got = [record.data for record in source.records() if isinstance(record, Message)]
        stopper.cancel()
        listening.shutdown()
        thread.join()
    assert got == [b"data"]


def test_a_message_may_be_as_large_as_asked(crossing, monkeypatch):
    """The reason is told even where the connection closes before it has been set up."""

    def late(end):
        deadline = time.monotonic() + 5
        while end.fileno() >= 0 and time.monotonic() < deadline:
            time.sleep(0.01)
        set_up(end)

    set_up = foxglove._keep_alive
    monkeypatch.setattr(foxglove, "_keep_alive", late)
    with odd_server(crossing, lambda connection: None) as url:
        source = FoxgloveInput(url, lambda topic, kind: True, largest=1000)
        with pytest.raises(LogError, match=r"has no skeletons|has no SkeletonGroup|no channels"):
            process_live(source, None, options=LIVE)
    assert "exceeds limit of 1000 bytes" in source.fault


def test_nobody_without_a_marker_is_a_result(tmp_path):
    """Somebody walks out of sight: the prediction goes on until nothing is known of it."""
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    room = {"action": "in_out", "rig": {"range": (0.5, 4.0)}, "occlusion": 3}
    write_log(
        log,
        SimulateParams.model_validate({"people": 3, "cameras": 2, "seconds": 6, "seed": 2} | room),
    )
    process(log, out, system="fuse-realtime")
    for channel in ("/hiros/merged", "/hiros/optimized", "/hiros/filtered"):
        shown = open_result(out, channel)
        known = [~np.isnan(m.positions[..., 0]).all(axis=1) for m in shown.motions.values()]
        assert np.concatenate(known).all()
        assert len(np.concatenate(known)) > 100
