"""Recordings as people make them: each fault of a recording, at several places, and in pairs.

    PYTHONPATH=.:cli:schemas:viewer:tests python benchmarks/door.py [--system NAME] [--pairs]
    PYTHONPATH=.:cli:schemas:viewer:tests python benchmarks/door.py --only 'zero*' --only 'nobody*'

Prints a Markdown row for each recording: how many people hiros finds, their mean error, mm, by how
much it is worse than that of the healthy recording, and the first line that hiros says about the
fault. An error of hiros is printed in the place of the numbers. The truth is turned and moved to
the result first, because poses that come from people have an origin of their own.

The simulated detector is the ideal one: a fault of a recording shows beside a clean signal.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import itertools
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zstandard
from detector_logs import GROUP, MARKERS, ROS2, TF, Scene, azure_message, default, scene
from mcap.writer import Writer
from rosbag2_recorder import in_idl
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.rosbag2.enums import StoragePlugin

import hiros_mcap
import hiros_schemas
from hiros_mcap.errors import HirosError
from hiros_mcap.evaluate.alignment import align
from hiros_mcap.evaluate.logs import evaluate_channels, read_results
from hiros_mcap.evaluate.truth_files import load_truth
from hiros_mcap.io.channels import TRUTH_PREFIX
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.log import open_log
from hiros_mcap.skeletons import Frame, SkeletonModel

PREFIX = "/camera_"
SECONDS, CAMERAS = 20.0, 3
OTHER = "geometry_msgs/msg/PoseArray"
HANDS = ("HAND_LEFT", "HANDTIP_LEFT", "THUMB_LEFT")


@dataclass(frozen=True)
class Message:
    """A message of a recording: a camera's frame, or the bytes of another topic."""

    topic: str
    kind: str
    log_time: int
    frame: Frame | None = None
    data: bytes = b""

    @property
    def camera(self) -> str:
        """Name of the camera, "" for other topics."""
        return self.topic.split("/")[1] if self.frame is not None else ""


class Place(NamedTuple):
    """Where in a recording a fault is."""

    cameras: str
    """"one" or "each"."""
    begin: float
    end: float
    """Shares of the recording's time."""

    def holds(self, messages: Sequence[Message]) -> list[bool]:
        """Return whether the fault has each of the messages."""
        times = np.array([m.log_time for m in messages if m.frame is not None])
        first, span = times.min(), times.max() - times.min()
        begin, end = first + self.begin * span, first + self.end * span
        last = f"camera_{CAMERAS - 1}"
        return [
            m.frame is not None
            and (self.cameras == "each" or m.camera == last)
            and begin <= m.log_time <= end
            for m in messages
        ]


PLACES = {
    f"{when}, {cameras} camera": Place(cameras, *share)
    for when, share in {"begin": (0, 0.04), "middle": (0.4, 0.5), "all": (0, 1)}.items()
    for cameras in ("one", "each")
}
EVERYWHERE = PLACES["all, each camera"]
Change = Callable[[list[Message], Place], list[Message]]


def of_frames(change: Callable[[Frame, int], Frame]) -> Change:
    """Make a fault of what happens to the messages at a place; the number is their position."""

    def apply(messages: list[Message], place: Place) -> list[Message]:
        rows = zip(messages, place.holds(messages), strict=True)
        return [
            replace(m, frame=change(m.frame, k)) if inside and m.frame is not None else m
            for k, (m, inside) in enumerate(rows)
        ]

    return apply


def nobody(frame: Frame, _: int) -> Frame:
    """A message that shows nobody: without frame and stamp, as some drivers publish it."""
    return frame.select([]).replace(frame_id="", stamp=0)


def unseen(frame: Frame, k: int, *, joints: Sequence[int], share: float) -> Frame:
    """Joints that are not seen are 0 0 0."""
    markers = frame.markers.copy()
    if np.random.default_rng(k).random() < share:
        markers[:, joints, :3] = 0.0
    return frame.replace(markers=markers)


def spare(frame: Frame, _: int) -> Frame:
    """The detector fills a slot that holds nobody with zeros."""
    if not frame.n_people:
        return frame
    slots = frame.select([*range(frame.n_people), 0])
    markers, links = slots.markers.copy(), slots.links.copy()
    markers[-1, :, :3] = 0.0
    links[-1] = np.nan
    return slots.replace(markers=markers, links=links)


def one_frame(frame: Frame, _: int) -> Frame:
    """Several cameras publish in one frame."""
    return frame.replace(frame_id="depth_camera_link")


def logged(messages: list[Message], place: Place, *, at: int) -> list[Message]:
    """The recorder's clock said something else."""
    rows = zip(messages, place.holds(messages), strict=True)
    return [replace(m, log_time=at) if inside else m for m, inside in rows]


def namespaces(messages: list[Message], place: Place) -> list[Message]:
    """Transforms are on a topic in a namespace; those of one camera, or of each, on its own."""
    changed = []
    for m in messages:
        if m.topic != "/tf_static":
            changed.append(m)
        elif place.cameras == "one":
            changed.append(replace(m, topic="/lab/tf_static"))
        else:
            whole = ROS2.deserialize_cdr(m.data, TF)
            for k, transform in enumerate(whole.transforms):
                data = bytes(ROS2.serialize_cdr(ROS2.types[TF]([transform]), TF))
                changed.append(replace(m, topic=f"/robot_{k}/tf_static", data=data))
    return changed


def simulated_time(messages: list[Message], _: Place) -> list[Message]:
    """The clock of a simulator: stamps and log times begin at 52 s."""
    back = min(m.log_time for m in messages) - 52 * 10**9
    return [_earlier(m, back) for m in messages]


def _earlier(m: Message, ns: int) -> Message:
    earlier = replace(m, log_time=m.log_time - ns)
    if m.frame is not None:
        frame = m.frame.replace(stamp=m.frame.stamp - ns, stamps=m.frame.stamps - ns)
        return replace(earlier, frame=frame)
    if m.kind != GROUP:
        return earlier
    group = ROS2.deserialize_cdr(m.data, m.kind)
    for stamp in (group.header.stamp, *(s.src_time for s in group.skeletons)):
        time = stamp.sec * 10**9 + stamp.nanosec - ns
        stamp.sec, stamp.nanosec = divmod(time, 10**9)
    return replace(earlier, data=bytes(ROS2.serialize_cdr(group, m.kind)))


def twice(frame: Frame, _: int) -> Frame:
    """Each person is in the message two times."""
    return frame.select([k for k in range(frame.n_people) for _ in range(2)])


def negated(frame: Frame, _: int, *, axis: int) -> Frame:
    """The camera's axes are left-handed."""
    markers = frame.markers.copy()
    markers[:, :, axis] *= -1.0
    return frame.replace(markers=markers)


def in_mm(frame: Frame, _: int) -> Frame:
    """The camera counts in mm."""
    markers = frame.markers.copy()
    markers[:, :, :3] *= 1000.0
    return frame.replace(markers=markers)


def relayed(messages: list[Message], place: Place) -> list[Message]:
    """Another node publishes what cameras say once more, and the recorder takes both."""
    rows = zip(messages, place.holds(messages), strict=True)
    return [
        copy
        for m, inside in rows
        for copy in [m, *([replace(m, topic=f"/relay{m.topic}")] if inside else [])]
    ]


def unread(messages: list[Message], place: Place) -> list[Message]:
    """A camera publishes a type that hiros does not know."""
    rows = zip(messages, place.holds(messages), strict=True)
    return [
        replace(m, kind=OTHER, frame=None, data=bytes(64)) if inside else m for m, inside in rows
    ]


def transforms_in_mm(messages: list[Message], place: Place) -> list[Message]:
    """Translations on /tf_static are in mm, of all cameras or of the last one."""
    changed = []
    for m in messages:
        if m.topic == "/tf_static":
            whole = ROS2.deserialize_cdr(m.data, TF)
            for transform in whole.transforms:
                last = transform.child_frame_id == f"camera_{CAMERAS - 1}"
                for name in "xyz" if last or place.cameras == "each" else "":
                    shift = transform.transform.translation
                    setattr(shift, name, 1000.0 * getattr(shift, name))
            m = replace(m, data=bytes(ROS2.serialize_cdr(whole, TF)))
        changed.append(m)
    return changed


@dataclass(frozen=True)
class Written:
    """How a recording is written."""

    azure: bool = False
    """Whether cameras publish the Azure Kinect's MarkerArrays, not SkeletonGroups."""
    joints: int = 32
    """Markers a body of such a MarkerArray."""
    drawn: str = ""
    """"text" above the bodies of such an array, or "from 0": joints of each body from 0."""
    definitions: str = ""
    """"idl", "none", or "no transforms": /tf_static without a type."""
    container: str = "mcap"

    def write(self, messages: Sequence[Message], encoder: Encoder, folder: Path) -> Path:
        """Write messages in the order in which the recorder got them; return what to process."""
        rows = [self._encoded(m, encoder) for m in messages]
        if self.container in ("mcap", "messages"):
            return self._mcap(rows, folder)
        return self._bag(rows, folder)

    def _encoded(self, m: Message, encoder: Encoder) -> tuple[str, str, int, bytes]:
        if m.frame is None:
            return m.topic, m.kind, m.log_time, m.data
        if self.azure:
            array = azure_message(m.frame)
            array.markers = [mark for mark in array.markers if mark.id % 100 < self.joints]
            _draw(array.markers, self.drawn)
            data = bytes(ROS2.serialize_cdr(array, MARKERS))
            return f"/{m.camera}/body_tracking_data", MARKERS, m.log_time, data
        return m.topic, m.kind, m.log_time, encoder.encode(m.frame)

    def _mcap(self, rows: Sequence[tuple[str, str, int, bytes]], folder: Path) -> Path:
        """Write one MCAP, or a folder whose messages the recorder compressed one by one."""
        packed = self.container == "messages"
        path = folder / ("bag/bag_0.mcap" if packed else "log.mcap")
        path.parent.mkdir(exist_ok=True)
        counts: dict[str, int] = {}
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start("ros2", "test")
            channels: dict[str, int] = {}
            for topic, kind, time, data in rows:
                if topic not in channels:
                    schema = self._schema(writer, topic, kind)
                    channels[topic] = writer.register_channel(topic, "cdr", schema)
                counts[topic] = counts.get(topic, 0) + 1
                payload = zstandard.compress(data) if packed else data
                writer.add_message(channels[topic], time, payload, time)
            writer.finish()
        if not packed:
            return path
        kinds = {topic: kind for topic, kind, _, _ in rows}
        (path.parent / "metadata.yaml").write_text(_metadata(rows, kinds, counts))
        return path.parent

    def _schema(self, writer: Writer, topic: str, kind: str) -> int:
        """Return the schema of a topic, 0 for none."""
        if self.definitions == "no transforms" and topic == "/tf_static":
            return 0
        if self.definitions == "idl" and kind != OTHER:
            return writer.register_schema(kind, "ros2idl", in_idl(kind).encode())
        text = hiros_schemas.text(kind) if kind != OTHER and self.definitions != "none" else ""
        return writer.register_schema(kind, "ros2msg", text.encode())

    def _bag(self, rows: Sequence[tuple[str, str, int, bytes]], folder: Path) -> Path:
        """Write a folder with an SQLite bag."""
        path = folder / "sqlite"
        with FolderWriter(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
            connections = {}
            for topic, kind, time, data in rows:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
                writer.write(connections[topic], time, data)
        return path


def _draw(markers: list, drawn: str) -> None:
    """Change the markers of an array as a node behind the driver does."""
    bodies = {mark.id // 100: mark for mark in markers}
    if drawn == "from 0":
        for mark in markers:
            mark.ns, mark.id = f"body_{mark.id // 100}", mark.id % 100
    elif drawn == "text":
        name = "visualization_msgs/msg/Marker"
        markers += [default(name, header=m.header, id=9000 + k, type=9) for k, m in bodies.items()]


def _metadata(rows, kinds: Mapping[str, str], counts: Mapping[str, int]) -> str:
    """Return metadata.yaml as rosbag2 writes it (rosbag2_storage/yaml.hpp) for one MCAP."""
    times = [time for _, _, time, _ in rows]
    topics = "".join(
        f"    - topic_metadata: {{name: {topic}, type: {kinds[topic]}, serialization_format: cdr, "
        f"offered_qos_profiles: []}}\n      message_count: {count}\n"
        for topic, count in counts.items()
    )
    begin, span = min(times), max(times) - min(times)
    return (
        "rosbag2_bagfile_information:\n  version: 8\n  storage_identifier: mcap\n"
        f"  duration: {{nanoseconds: {span}}}\n"
        f"  starting_time: {{nanoseconds_since_epoch: {begin}}}\n"
        f"  message_count: {len(rows)}\n  topics_with_message_count:\n{topics}"
        "  compression_format: zstd\n  compression_mode: MESSAGE\n"
        "  relative_file_paths: [bag_0.mcap]\n  files: []\n"
    )


PLAIN = Written()
WRITTEN = {
    "MarkerArray, 26 joints": Written(azure=True, joints=26),
    "MarkerArray with text": Written(azure=True, drawn="text"),
    "MarkerArray, ids from 0": Written(azure=True, drawn="from 0"),
    "definitions in IDL": Written(definitions="idl"),
    "no definitions": Written(definitions="none"),
    "transforms without a type": Written(definitions="no transforms"),
    "messages compressed": Written(container="messages"),
    "SQLite": Written(container="sqlite"),
}


@dataclass(frozen=True)
class Fault:
    """A recording with something wrong in it, and how it is written."""

    name: str
    change: Change
    place: Place
    written: Written


class Outcome(NamedTuple):
    """Outcome of hiros on a recording."""

    people: str
    """How many, or "refused", or "BUG"."""
    error: float = np.nan
    """Mean of the joints, mm."""
    said: tuple[str, ...] = ()
    """Warnings and notes, or the error."""


def faults(messages: Sequence[Message], model: SkeletonModel) -> Iterator[Fault]:
    """Yield every fault at every place where it makes a difference."""
    hands = [model.marker_names.index(name) for name in HANDS]
    begin = min(m.log_time for m in messages)
    changes: dict[str, tuple[Change, str]] = {
        "nobody": (of_frames(nobody), "*"),
        "zero hands, 30 %": (of_frames(partial(unseen, joints=hands, share=0.3)), "all*"),
        "zero hands": (of_frames(partial(unseen, joints=hands, share=1.0)), "*"),
        "zero bodies in spare slots": (of_frames(spare), "*"),
        "one frame_id": (of_frames(one_frame), "all, each*"),
        "transforms in a namespace": (namespaces, "all*"),
        "logged at 0": (partial(logged, at=0), "*"),
        "logged years ahead": (partial(logged, at=begin + 10**17), "*"),
        "simulated time": (simulated_time, "all, each*"),
        "people twice": (of_frames(twice), "all*"),
        "relayed": (relayed, "all*"),
        "a type that is not read": (unread, "all, one*"),
        "x negated": (of_frames(partial(negated, axis=0)), "all*"),
        "y negated": (of_frames(partial(negated, axis=1)), "all*"),
        "detections in mm": (of_frames(in_mm), "all*"),
        "transforms in mm": (transforms_in_mm, "all*"),
    }
    for name, (change, globs) in changes.items():
        for where, place in PLACES.items():
            if fnmatchcase(where, globs):
                yield Fault(f"{name}: {where}", change, place, PLAIN)
    for name, written in WRITTEN.items():
        yield Fault(name, as_it_is, EVERYWHERE, written)
    for where in ("begin, one camera", "begin, each camera", "all, one camera"):
        name, place = f"MarkerArray, nobody: {where}", PLACES[where]
        yield Fault(name, of_frames(nobody), place, Written(azure=True))


def as_it_is(messages: list[Message], _: Place) -> list[Message]:
    """The recording has no fault but how it is written."""
    return messages


def pairs(single: Sequence[Fault]) -> Iterator[Fault]:
    """Yield two faults at once: the first of each kind with the first of each other kind."""
    kinds: dict[str, Fault] = {}
    for fault in single:
        kinds.setdefault(fault.name.partition(":")[0], fault)
    for first, second in itertools.combinations(kinds.values(), 2):
        if PLAIN in (first.written, second.written):
            written = second.written if first.written == PLAIN else first.written
            both = partial(_both, first=first, second=second)
            yield Fault(f"{first.name} + {second.name}", both, EVERYWHERE, written)


def _both(messages: list[Message], _: Place, first: Fault, second: Fault) -> list[Message]:
    return second.change(first.change(messages, first.place), second.place)


def simulated(path: Path) -> tuple[list[Message], SkeletonModel]:
    """Return the messages of a healthy log, by log time."""
    healthy: Scene = scene(
        path,
        people=2,
        cameras=CAMERAS,
        seconds=SECONDS,
        action="cross",
        seed=17,
        rig={"rate": 15.0},
    )
    messages = [Message(topic, GROUP, f.log_time, f) for topic, f in healthy.detections]
    messages += [Message(topic, kind, t, data=data) for topic, kind, t, data in healthy.others]
    with open_log(path) as log:
        return sorted(messages, key=lambda m: m.log_time), log.model


def run(fault: Fault, messages: Sequence[Message], encoder: Encoder, system: str) -> Outcome:
    """Write a recording with a fault, process it, and score it."""
    changed = fault.change(list(messages), fault.place)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        truths = [m for m in changed if m.topic.startswith(TRUTH_PREFIX)]
        truth = load_truth(PLAIN.write(truths, encoder, folder))
        log = fault.written.write(changed, encoder, folder)
        try:
            summary = hiros_mcap.process(log, folder / "out.mcap", system=system, keep=())
            channels = read_results(folder / "out.mcap", ["/hiros/filtered"])
            placed = truth.aligned(align(truth, channels))
            (result,) = evaluate_channels(channels, placed).values()
        except HirosError as error:
            return Outcome("refused", said=(str(error).replace(f"{folder}/", ""),))
        except Exception as bug:  # noqa: BLE001
            return Outcome("BUG", said=(f"{type(bug).__name__}: {bug}",))
    said = (*summary.warnings, *summary.notes)
    return Outcome(str(len(summary.people)), result.scores.mean, said)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--system", default="fuse")
    parser.add_argument("--only", action="append", metavar="GLOB", help="names of faults")
    parser.add_argument("--pairs", action="store_true", help="also two faults at once")
    choices = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        messages, model = simulated(Path(folder) / "simulated.mcap")
    encoder = Encoder(model)
    single = list(faults(messages, model))
    chosen = [
        fault
        for fault in [*single, *(pairs(single) if choices.pairs else ())]
        if any(fnmatchcase(fault.name, glob) for glob in choices.only or ["*"])
    ]
    print("| recording | people | error, mm | worse by | said |\n|---|---|---|---|---|")
    healthy = {
        azure: run(
            Fault("", as_it_is, EVERYWHERE, Written(azure)), messages, encoder, choices.system
        )
        for azure in (False, True)
    }
    for azure, outcome in healthy.items():
        name = "healthy, MarkerArray" if azure else "healthy"
        print(f"| {name} | {outcome.people} | {outcome.error:.2f} | | |", flush=True)
    for fault in chosen:
        outcome, base = run(fault, messages, encoder, choices.system), healthy[fault.written.azure]
        said = next((line for line in outcome.said if line not in base.said), "")
        numbers = ("", "")
        if not np.isnan(outcome.error):
            numbers = (f"{outcome.error:.2f}", f"{outcome.error - base.error:+.2f}")
        print(f"| {fault.name} | {outcome.people} | {' | '.join(numbers)} | {said} |", flush=True)


if __name__ == "__main__":
    main()
