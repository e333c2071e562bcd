"""Results of a calibration: a file for ``--extrinsics``, and the log with the poses found."""

from __future__ import annotations

import heapq
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from mcap.records import Message

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import parse_tf
from hiros_mcap.calibrate.ball_poses import BallCalibration
from hiros_mcap.calibrate.board import BoardReport
from hiros_mcap.calibrate.people import PeopleCalibration
from hiros_mcap.calibrate.verdict import CalibratedCamera, CameraResult
from hiros_mcap.io.channels import TF_TOPICS, add_skeleton_channel, add_static_poses
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import Log
from hiros_mcap.outputs import CAMERAS_MARK, write_text
from hiros_mcap.skeletons import Frame

_ERRORS = {
    "error_deg": "standard error of the orientation",
    "error_mm": "standard error of the position",
    "residual_mm": "how far what it sees is from what the others see",
}
"""Keys of a camera, of which each is written if it is known."""


def save_cameras(path: Path, rig: PeopleCalibration | BallCalibration | BoardReport) -> None:
    """Write the file, or nothing at all; raises LogError if it cannot be written."""
    write_text(path, CAMERAS_MARK + cameras_toml(rig))


def cameras_toml(rig: PeopleCalibration | BallCalibration | BoardReport) -> str:
    """Return poses and clocks as TOML: every camera with a pose, every clock that is known.

    A camera whose frame is the fixed one is the parent of the others.
    """
    frame = rig.fixed_frame
    lines = [f"# verdict: {rig.verdict}" + (f" ({rig.reason})" if rig.reason else "")]
    for camera in rig.cameras:
        if camera.pose is not None and camera.frame != frame:
            lines += ["", *_camera(camera, camera.pose, frame)]
    clocks = {c.name: c.clock_s for c in rig.cameras if not math.isnan(c.clock_s)}
    if clocks:
        lines += ["", "[clock]  # s to add to the stamps of each camera"]
    lines += [f"{_text(name)} = {seconds:.4f}" for name, seconds in clocks.items()]
    return "\n".join([*lines, ""])


def _camera(camera: CameraResult, pose: Rigid, parent: str) -> list[str]:
    since = getattr(camera, "since", 0)
    lines = [
        "[[camera]]",
        f"frame = {_text(camera.frame)}",
        f"parent = {_text(parent)}",
        f"translation = [{', '.join(f'{x:.5f}' for x in pose.translation)}]  # m",
        f"quaternion_xyzw = [{', '.join(f'{x:.7f}' for x in pose.xyzw)}]",
    ]
    lines.append(f"verdict = {_text(camera.verdict)}")
    if camera.verdict == "impossible":
        lines[-1] += "  # the pose is the log's"
    if camera.reason:
        lines.append(f"reason = {_text(camera.reason)}")
    for key, comment in _ERRORS.items():
        value = getattr(camera, key)
        if math.isfinite(value) and camera.verdict != "impossible":
            lines.append(f"{key} = {value:.2f}  # {comment}")
    if since:
        lines.append(f"since = {since}  # ns since 1970, log time: the camera was moved then")
    return lines


def _text(value: str) -> str:
    """Return a TOML string; JSON's escapes are TOML's, too."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


_STATIC = TF_TOPICS[0]
Item = tuple[int, Frame | None, Message | None]


def write_corrected_log(log: Log, rig: PeopleCalibration, target: str | os.PathLike[str]) -> None:
    """Write the log with the cameras' poses on /tf_static and corrected stamps.

    All other channels keep their bytes. Log times stay. A camera without a pose keeps what the log
    has; a camera that was moved has a second pose from that time on.

    Raises LogError if ``target`` cannot be written; there is no file then.
    """
    ours = {camera.frame for camera in rig.cameras}
    log = log.with_own_frames([c.channel.topic for c in log.cameras if c.topic_frame in ours])
    topics = {
        name: (camera.channel.topic, source)
        for camera in log.cameras
        for source, name in camera.sources.items()
    }
    read = {camera.channel.id for camera in log.cameras}
    static = {info.id for info in log.channels if info.topic == _STATIC}
    kept = [info.id for info in log.channels if info.id not in read | static]
    by_name = {camera.name: camera for camera in rig.cameras}
    encoder = Encoder(log.model)
    with McapWriter(target, inputs=[log.path]) as writer:
        writer.copy_definitions(log.reader, kept)
        start = log.span[0]
        _write_poses(writer, log, rig, start)
        channels = {
            topic: add_skeleton_channel(writer, topic)
            for topic in sorted({topic for topic, _ in topics.values()})
        }
        middle = sum(log.span) // 2
        for frame, message in _merged(log, kept):
            if message is not None:
                times = {"publish_time": message.publish_time, "sequence": message.sequence}
                writer.write(message.channel_id, message.log_time, message.data, **times)
            if frame is not None:
                topic, source = topics[frame.source]
                moved = in_common_time(frame, by_name.get(frame.source), middle)
                writer.write(channels[topic], frame.log_time, encoder.encode(moved, source))
        writer.commit()


def in_common_time(frame: Frame, camera: CalibratedCamera | None, middle: int) -> Frame:
    """Return a frame with corrected stamps; drifts count from ``middle``, ns.

    Stamps of a camera whose clock is not known stay.
    """
    if camera is None or np.isnan(camera.clock_s):
        return frame
    drift = 1e-6 * camera.drift_ppm * (frame.stamp - middle)
    late = round(1e9 * camera.clock_s + drift)
    stamps = np.where(frame.stamps > 0, frame.stamps + late, frame.stamps)
    return frame.replace(stamp=frame.stamp + late, stamps=stamps)


def _merged(log: Log, kept: list[int]) -> Iterator[tuple[Frame | None, Message | None]]:
    """Yield the detections and the messages of other channels in the order of log times."""
    frames: Iterator[Item] = ((frame.log_time, frame, None) for frame in log.frames())
    messages = log.reader.messages(kept) if kept else iter(())
    others: Iterator[Item] = ((message.log_time, None, message) for message in messages)
    for _, frame, message in heapq.merge(frames, others, key=lambda item: item[0]):
        yield frame, message


def _write_poses(writer: McapWriter, log: Log, rig: PeopleCalibration, start: int) -> None:
    """Write the static poses of the log but the cameras', then those that were found."""
    placed = [c for c in rig.cameras if c.pose is not None and c.frame != rig.fixed_frame]
    ours = {camera.frame for camera in placed}
    others: dict[str, dict[str, Rigid]] = {}
    static = [info.id for info in log.channels if info.topic == _STATIC]
    for message in log.reader.messages(static) if static else ():
        for transform in parse_tf(message.data):
            if transform.child.lstrip("/") not in ours:
                pose = Rigid(np.array(transform.xyzw), np.array(transform.translation))
                others.setdefault(transform.parent, {})[transform.child] = pose
    for parent, poses in others.items():
        add_static_poses(writer, poses, parent, start)
    times = sorted({camera.since for camera in rig.cameras})
    for since in times:
        poses = {c.frame: c.pose for c in placed if c.pose and c.since == since}
        if poses:
            add_static_poses(writer, poses, rig.fixed_frame, since or start)
