"""A log, or two, into a Rerun recording."""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.events import Event, events_from_json
from hiros_mcap.io.channels import EVENTS_ATTACHMENT, OUTPUT_PREFIX, TRUTH_PREFIX
from hiros_mcap.io.log import CameraChannel, Log, open_log
from hiros_mcap.running.observe import DETECTIONS
from hiros_mcap.skeletons import SkeletonModel
from hiros_viewer.blueprint import LAYOUTS, Content, blueprint
from hiros_viewer.columns import Poses
from hiros_viewer.entities import path_part
from hiros_viewer.overlay import draw_distances
from hiros_viewer.scene import STAGES, Scene

if TYPE_CHECKING:
    import rerun as rr

HORIZON_NS = 3_000_000_000
"""Frames are put in the order of their own time; most are at most this much later in a log."""


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """What of a log is shown, and how."""

    layout: str = "overview"
    """A key of :data:`hiros_viewer.blueprint.LAYOUTS`."""
    time_range: tuple[float, float] | None = None
    """Seconds from the log's start; None = all of it."""
    extrinsics: Path | None = None
    """File with the cameras' poses, instead of the log's transforms."""
    stage: str = ""
    """Stage whose curves are drawn and that two logs are compared by; "" = the last one."""


@dataclass(frozen=True, slots=True)
class Source:
    """A log as the viewer reads it."""

    model: SkeletonModel
    cameras: Mapping[str, Rigid]
    """Name -> pose in the fixed frame."""
    names: Mapping[str, str]
    """A detection's source -> the camera's name."""
    stages: tuple[str, ...]
    events: tuple[Event, ...]
    start: int
    """ns; what seconds count from."""


def replay(
    logs: list[Path], recording: rr.RecordingStream, options: ViewOptions | None = None
) -> Content:
    """Draw logs into a recording, layout included; several are overlaid.

    Raises LogError or ConfigError if a log cannot be read, lacks a transform or holds no skeletons
    in the time range.
    """
    options = options or ViewOptions()
    if options.layout not in LAYOUTS:
        raise ConfigError(f"no layout {options.layout!r} (there are: {', '.join(LAYOUTS)})")
    scenes: list[Scene] = []
    for k, path in enumerate(logs):
        prefix = f"/{'ab'[k]}" if len(logs) > 1 else ""
        start = scenes[0].start if scenes else None
        scenes.append(_replay_one(path, recording, options, prefix, start))
    if len(logs) > 1:
        draw_distances(logs[0], logs[1], scenes, options.stage)
    content = content_of(scenes, [f"/{'ab'[k]}" for k in range(len(logs))] if logs[1:] else [""])
    recording.send_blueprint(blueprint(content, options.layout))
    return content


def _replay_one(
    path: Path,
    recording: rr.RecordingStream,
    options: ViewOptions,
    prefix: str,
    start: int | None,
) -> Scene:
    """Draw one log; seconds count from ``start``, that of the first log when two are overlaid."""
    with open_log(path, topics=["*"], output_prefix="/none", extrinsics=options.extrinsics) as log:
        source = describe(log)
        final = options.stage or (source.stages[-1] if source.stages else "")
        only_truth = not (source.stages or source.names)
        if options.stage and not only_truth and options.stage not in (*source.stages, "truth"):
            raise LogError(f"holds no stage {options.stage!r}", path=path)
        scene = Scene(
            recording, source.model, final=final, prefix=prefix, is_second=start is not None
        )
        scene.start = start
        scene.begin(source.cameras)
        window, drawn = (0, 0), 0
        for kind, frame in in_time_order(log):
            if not window[1]:
                # Outputs alone are logged later than they are stamped: whichever is first.
                first = min(source.start, frame.stamp)
                window = _window(first, options.time_range)
                scene.start = first if start is None else start
            if window[0] <= frame.stamp <= window[1]:
                drawn += 1
                if kind == DETECTIONS:
                    scene.detections(source.names[frame.source], frame)
                else:
                    scene.stage(kind, frame)
        if not drawn:
            raise LogError("holds no skeletons in this time range", path=path)
        for event in source.events:
            if window[0] <= event.stamp <= window[1]:
                scene.event(event)
        scene.finish()
        return scene


def _window(start: int, seconds: tuple[float, float] | None) -> tuple[int, int]:
    if seconds is None:
        return 0, 2**63 - 1
    return start + round(seconds[0] * 1e9), start + round(min(seconds[1], 1e9) * 1e9)


def describe(log: Log) -> Source:
    """Find out what a log holds that can be drawn."""
    kinds = {kind_of(camera.channel.topic) for camera in log.cameras}
    detectors = [c for c in log.cameras if kind_of(c.channel.topic) == DETECTIONS]
    names, poses = {}, {}
    for camera in detectors:
        for source in camera.sources.values():
            names[source] = _camera_name(camera, source, detectors)
        if (pose := log.pose_of(camera)) is not None:
            poses.update({names[source]: pose for source in camera.sources.values()})
    stages = tuple(stage for stage in STAGES if stage in kinds and stage != "truth")
    return Source(log.model, poses, names, stages, _events(log), log.span[0])


def _camera_name(camera: CameraChannel, source: str, cameras: list[CameraChannel]) -> str:
    """Return the coordinate frame's name if that is enough to tell cameras apart."""
    shared = sum(camera.frames == other.frames for other in cameras) > 1
    return source if shared or len(camera.sources) > 1 else camera.frames[0]


def kind_of(topic: str) -> str:
    """Return the stage of a topic, or that it holds detections."""
    if topic.startswith(f"{TRUTH_PREFIX}/"):
        return "truth"
    stage = topic.removeprefix(f"{OUTPUT_PREFIX}/")
    return stage if stage != topic and stage in STAGES else DETECTIONS


def _events(log: Log) -> tuple[Event, ...]:
    try:
        return tuple(events_from_json((log.reader.attachment(EVENTS_ATTACHMENT) or b"[]").decode()))
    except (ValueError, TypeError):
        fault = f"attachment {EVENTS_ATTACHMENT} is damaged"
        raise LogError(fault, path=log.path) from None


def in_time_order(log: Log) -> Iterator[tuple[str, Poses]]:
    """Yield (stage or detections, poses in the fixed frame) by the frames' own time.

    A log is in the order of its messages, and what a stage that looks ahead says of an instant
    comes later; frames wait until little that is earlier can come.
    """
    kinds = {camera.channel.topic: kind_of(camera.channel.topic) for camera in log.cameras}
    waiting: list[tuple[int, int, str, Poses]] = []
    for k, (topic, frame) in enumerate(log.detections_by_topic()):
        heapq.heappush(waiting, (frame.stamp, k, kinds[topic], Poses.of(frame)))
        while waiting and waiting[0][0] < frame.log_time - HORIZON_NS:
            yield heapq.heappop(waiting)[2:]
    while waiting:
        yield heapq.heappop(waiting)[2:]


def content_of(scenes: list[Scene], prefixes: list[str]) -> Content:
    """Sum up what was drawn, for the layout."""
    spots = [spot for scene in scenes for spot in scene.bounds]
    if spots:
        table = np.stack(spots)
        low, high = np.percentile(table, [3, 97], axis=0)
        centre = np.array([*((low + high) / 2)[:2], 1.0])
        reach = float(np.linalg.norm(high[:2] - low[:2]) / 2)
    else:
        centre, reach = np.array([0.0, 0.0, 1.0]), 3.0
    stages = [stage for stage in STAGES if any(stage in scene.stages for scene in scenes)]
    return Content(
        stages=stages,
        people=sorted({person for scene in scenes for person in scene.people}),
        cameras=[path_part(name) for name in scenes[0].cameras],
        centre=centre,
        reach=reach,
        camera_centre=scenes[0].camera_centre,
        prefixes=prefixes,
    )


def recording_name(logs: list[Path | str]) -> str:
    """Return the name that a recording goes by in the viewer."""
    return " + ".join(os.path.basename(str(log)) for log in logs)  # noqa: PTH119
