"""A log, or two, into a Rerun recording."""

from __future__ import annotations

import glob
import math
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rerun as rr

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.config import Config
from hiros_mcap.errors import ConfigError, LogError, naming
from hiros_mcap.evaluate.logs import (
    find_truth,
    has_cameras,
    has_outputs,
    start_of,
)
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.events import Event
from hiros_mcap.io.channels import OUTPUT_PREFIX, TRUTH_PREFIX, skeleton_channels
from hiros_mcap.io.detectors.rgb_keypoints import RGB_TOPIC
from hiros_mcap.io.log import CameraChannel, Log, open_log, reading
from hiros_mcap.io.result import stored_events
from hiros_mcap.io.rgb_cameras import RgbCamera, poses_of, read_rgb_cameras
from hiros_mcap.io.ros_messages import CHANNELS, VIDEO_CODECS, open_messages, read_pictures
from hiros_mcap.rays.keypoints import TRIANGULATED
from hiros_mcap.running.observe import DETECTIONS
from hiros_mcap.running.pipeline import skeletons_read
from hiros_mcap.skeletons import SkeletonModel
from hiros_mcap.wording import quantity
from hiros_viewer.blueprint import LAYOUTS, Content
from hiros_viewer.entities import Layer, path_part
from hiros_viewer.images import CameraImages
from hiros_viewer.legend import lay_out
from hiros_viewer.overlay import draw_distances
from hiros_viewer.poses import HORIZON_NS, Channel, Gatherer, Poses, Thinner, Uncertainties
from hiros_viewer.scene import STAGES, Scene

LONG_S = 180.0
"""Of a longer log only the stages are drawn that the layout shows."""
WHOLE_S = 600.0
"""Of a longer log not all frames are drawn."""
MOST_FRAMES = 18_000
"""Of a channel of a long log: ten minutes at 30 Hz, an hour at 5 Hz."""
LONGEST_STEP_S = 0.2
"""Between frames that are drawn: people who were not seen for longer are hidden."""
ANGLE_AXIS_DEG = (0.0, 100.0)
"""Range that the axes of angles show: two numbers stand beside each then."""
SOON_NS = 1_000_000_000
"""If somebody is seen within this time, nothing is drawn before."""
EMPTY_ROOM = np.array([[-2.0, -2.0, 0.0], [2.0, 2.0, 1.8]])
"""m; what is looked at before anybody is seen."""
Spans = Sequence[tuple[int, int]]
_EVER = (0, 2**63 - 2)
_NAMES = "AB"


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """Choice of what to show of a log, and how."""

    layout: str = "overview"  # a key of :data:`hiros_viewer.blueprint.LAYOUTS`
    time_range: tuple[float, float] | None = None  # seconds from the log's start; None = all of it
    extrinsics: Path | None = None  # file with the cameras' poses, instead of the log's transforms
    stage: str = ""
    """Stage whose curves are drawn and that two logs are compared by; "" = the last one."""
    truth: str | None = None
    """File with the true people, or a channel of the log; None = the log's own, if it has one."""
    uncertainty: bool = False  # whether to draw how well the joints are known, as ellipsoids
    configs: Sequence[Config] = ()
    """Of each log, how it is read if it is a recording: its frame, skeleton and unit."""
    images: Sequence[str] = ()
    """Logs with the images of RGB cameras, and videos as CAMERA=FILE; none = the log's own."""
    warn: Callable[[str], None] = lambda _: None
    """Is told which images cannot be drawn."""


@dataclass(frozen=True, slots=True)
class Source:
    """A log as the viewer reads it."""

    model: SkeletonModel
    cameras: Mapping[str, Rigid]  # name -> pose in the fixed frame
    names: Mapping[str, str]  # a detection's source -> the camera's name
    stages: tuple[str, ...]
    events: tuple[Event, ...]
    start: int  # ns; what seconds count from
    topics: tuple[str, ...]
    later: Mapping[str, Mapping[float, Rigid]]
    """By camera that was moved: the poses after that, by the seconds from the start of the log."""


def replay(
    logs: list[Path],
    recording: rr.RecordingStream,
    options: ViewOptions | None = None,
    is_open: Callable[[], bool] = lambda: True,
) -> Content:
    """Draw logs into a recording, layout included; several are overlaid.

    It ends early when nobody looks any more: when ``is_open`` returns False.

    Raises LogError or ConfigError if a log cannot be read, lacks a transform or holds no skeletons
    in the time range.
    """
    options = options or ViewOptions()
    if options.layout not in LAYOUTS:
        raise ConfigError(f"no layout {options.layout!r} (there are: {', '.join(LAYOUTS)})")
    logs, options = _truth_apart(logs, options)
    layers = [
        Layer(f"/{name.lower()}", name, k, file=path.name)
        for k, (name, path) in enumerate(zip(_NAMES, logs, strict=False))
    ]
    scenes: list[Scene] = []
    for path, layer in zip(logs, layers if logs[1:] else [Layer()], strict=True):
        first = scenes[0] if scenes else None
        scenes.append(_Replay(path, recording, options, layer).draw(first, is_open))
    if logs[1:]:
        draw_distances(logs[0], logs[1], scenes, options.stage)
    content = content_of(scenes)
    lay_out(recording, content, options.layout)
    return content


def _truth_apart(logs: list[Path], options: ViewOptions) -> tuple[list[Path], ViewOptions]:
    """Return one log and its truth if the other one of two holds nothing but a truth."""
    if len(logs) == 2 and options.truth is None:
        for log, other in (logs, logs[::-1]):
            if not (has_outputs(other) or has_cameras(other)):
                return [log], replace(options, truth=str(other))
    return logs, options


class _Replay:
    """Draws one log.

    Parameters
    ----------
    path, recording, options, layer : as in :func:`replay`.
    """

    def __init__(
        self, path: Path, recording: rr.RecordingStream, options: ViewOptions, layer: Layer
    ) -> None:
        self.path, self.recording, self.options, self.layer = path, recording, options, layer
        self._asked: tuple[int, int] | None = None  # ns; None before the first frame
        self._window: tuple[int, int] | None = None  # what is drawn of it
        self._is_long = False
        self._step = 0
        self._laid_out = False

    def draw(self, first: Scene | None, is_open: Callable[[], bool]) -> Scene:
        """Draw it; seconds count from the start of the first log when two are overlaid."""
        config, topics = Config(), ["*"]
        if has_outputs(self.path):  # in metres; skeletons of keypoints are in it
            topics = _skeletons_of_result(self.path)
        elif self.options.configs:
            config = self.options.configs[self.layer.number]
        with open_log(
            self.path,
            topics=topics,
            output_prefix="/none",
            extrinsics=self.options.extrinsics,
            fixed_frame=config.input.fixed_frame or None,
            skeletons=skeletons_read(config),
        ) as log:
            source = describe(log)
            scene = self._scene(log, source, first)
            only_stages = first is not None and bool(first.cameras)
            self._thin((log.span[1] - log.span[0]) / 1e9)
            if only_stages:
                scene.begin({})
            else:
                scene.begin(source.cameras, source.later)
                scene.show_images(self._rgb_cameras(log))
            log = log.only(self._topics(source, scene.final))
            left_out = {DETECTIONS, "truth"} if only_stages else {"truth"}
            self._laid_out = only_stages  # by the first log, which has the cameras
            drawn = self._draw_frames(scene, log, left_out, is_open)
        self._finish(scene, source, drawn)
        return scene

    def _scene(self, log: Log, source: Source, first: Scene | None) -> Scene:
        """Return an empty scene that knows what the log is compared with."""
        final = self._final(source)
        scene = Scene(self.recording, source.model, final=final, layer=self.layer)
        scene.start = None if first is None else first.start
        scene.truth = self._truth(log)
        scene.shows_truth = self.options.truth is not None
        if self.options.uncertainty:
            scene.uncertainties = Uncertainties.of_result(self.path, source.model)
        return scene

    def _draw_frames(
        self, scene: Scene, log: Log, left_out: Collection[str], is_open: Callable[[], bool]
    ) -> int:
        start, drawn = log.span[0], 0
        unfinished = {kind_of(camera.channel.topic) for camera in log.cameras} - set(left_out)
        for frames in in_time_order(log, left_out, self._step, self._spans(start)):
            first_stamp = min(int(poses.stamps[0]) for poses in frames.values())
            if self._window is None:
                # Outputs alone are logged later than they are stamped: whichever is first.
                start = min(start, first_stamp)
                scene.start = start if scene.start is None else scene.start
                self._asked = self._window = _window(start, self.options.time_range)
            if not is_open():
                break
            if not drawn:
                self._begin_with_people(frames, scene.final or DETECTIONS, start)
            drawn += self._draw(scene, frames)
            if not self._laid_out and scene.bounds:
                self._laid_out = True
                lay_out(self.recording, content_of([scene]), self.options.layout)
            for (kind, _), poses in frames.items():
                if poses.stamps[-1] > self._window[1]:
                    unfinished.discard(kind)
            if not unfinished:
                break  # the time range is over
        return drawn

    def _begin_with_people(self, frames: Mapping[Channel, Poses], kind: str, start: int) -> None:
        """Draw from the first frame with people on, of a stage or a camera, if that is soon.

        The viewer opens at the first row: it would show an empty room.
        """
        begin, end = self._window or _EVER
        begin = max(begin, start)
        stamps = [poses.stamps[poses.counts > 0] for (k, _), poses in frames.items() if k == kind]
        seen = np.concatenate([*stamps, np.zeros(0, np.int64)])
        first = int(seen[seen >= begin].min(initial=end))
        if first < begin + SOON_NS:
            self._window = first, end

    def _rgb_cameras(self, log: Log) -> list[tuple[RgbCamera, Rigid | None]]:
        """Read what RGB cameras found in the time range, and where they stand."""
        begin, end = _window(log.span[0], self.options.time_range)
        span = begin - HORIZON_NS, min(end + HORIZON_NS, _EVER[1])
        with reading(self.path) as reader:
            cameras = read_rgb_cameras(reader, span, self._step)
        poses = poses_of(cameras, log.transforms, log.fixed_frame) if cameras else {}
        return [(camera, poses.get(camera.name)) for camera in cameras]

    def _draw_images(self, scene: Scene) -> None:
        """Draw the keypoints and the pictures of RGB cameras that are in the time range."""
        if not scene.images:
            return
        begin, end = self._window or _EVER
        start, views = scene.start or 0, {view.camera.name: view for view in scene.images}
        for view in views.values():
            view.keypoints([f for f in view.camera.frames if begin <= f.stamp <= end], start)
        for text in self.options.images:
            name, _, film = text.rpartition("=")
            if name and name not in views:
                known = ", ".join(views)
                raise ConfigError(f"{self.path}: no RGB camera {name!r} (there are: {known})")
            if name:
                views[name].film(Path(film), (begin, end), start)
        logs = [Path(text) for text in self.options.images if "=" not in text]
        for log in logs if self.options.images else [self.path]:
            self._draw_pictures(log, views, (begin, end), start)

    def _draw_pictures(
        self, log: Path, views: Mapping[str, CameraImages], span: tuple[int, int], start: int
    ) -> None:
        """Draw the images and videos of a log between two times, ns; of images, one a step."""
        due = dict.fromkeys(views, (self._asked or _EVER)[0])
        unread: Counter[tuple[str, str, str]] = Counter()
        bare = set(views)
        with naming(log), open_messages(log) as messages:
            for picture in read_pictures(messages, unread):
                name = picture.frame_id
                bare.discard(name)
                if name in views and due[name] <= picture.stamp <= span[1]:
                    due[name] = picture.stamp + (0 if picture.is_video else self._step)
                    if not picture.is_video:  # whose frames need those before
                        picture = picture._replace(stamp=max(picture.stamp, span[0]))
                    views[name].picture(picture, start)
        known = ", ".join((*CHANNELS, *VIDEO_CODECS))
        for name, topic, encoding in (key for key in unread if key[0] in bare):
            n = quantity(unread[name, topic, encoding], "image")
            self.options.warn(
                f"{log}: {topic}: {n} of {name} not drawn: {encoding!r} is none of {known}, or "
                "colours as JPEG or PNG"
            )

    def _finish(self, scene: Scene, source: Source, drawn: int) -> None:
        """Draw what is known of the whole log: images, the truth and the events."""
        self._draw_images(scene)
        if scene.truth is not None:
            drawn += self._draw_truth(scene, scene.truth)
        if not drawn:
            raise LogError("holds no skeletons in this time range", path=self.path)
        if self.options.truth is not None and scene.final and not scene.n_true:
            fault = f"the truth {self.options.truth} covers no frame of the result; check its times"
            raise ConfigError(f"{self.path}: {fault}")
        begin, end = self._asked or _EVER
        for event in source.events:
            if begin <= event.stamp <= end:
                scene.event(event)
        scene.finish()

    def _final(self, source: Source) -> str:
        """Return the stage that curves are taken from; "" = there is none."""
        asked = self.options.stage
        only_truth = not (source.stages or source.names)
        if asked and not only_truth and asked not in (*source.stages, "truth"):
            raise LogError(f"holds no stage {asked!r}", path=self.path)
        return asked or (source.stages[-1] if source.stages else "")

    def _truth(self, log: Log) -> Truth | None:
        """Return the truth on the log's markers, at the log's time."""
        has_truth = any(info.topic.startswith(f"{TRUTH_PREFIX}/") for info in log.channels)
        if self.options.truth is None and not has_truth:
            return None  # looking for it in a long log takes a while
        truth = find_truth(self.path, self.options.truth)
        if truth is None:
            return None
        return truth.moved(start=start_of(self.path)).seen_by(log.model)

    def _draw_truth(self, scene: Scene, truth: Truth) -> int:
        """Draw the true people, once if logs are overlaid; return the number of instants."""
        if self.layer.number:
            return 0
        there = ~np.isnan(truth.positions[..., 0]).all(axis=2)
        ids = np.array(truth.people or range(there.shape[1]), np.int64)[np.nonzero(there)[1]]
        positions = truth.positions[there]
        times = np.stack([truth.stamps, truth.stamps], axis=1)
        counts = there.sum(axis=1)
        poses = Poses(times, counts, ids, positions, np.ones(positions.shape[:2]))
        chosen = Thinner(self._step).chosen([""] * len(poses), poses.stamps)
        return self._draw(scene, {("truth", ""): poses.select(np.flatnonzero(list(chosen)))})

    def _draw(self, scene: Scene, frames: Mapping[Channel, Poses]) -> int:
        """Draw the frames that are in the time range; return their number."""
        begin, end = self._window or _EVER
        inside = {
            channel: poses.split(begin)[1].split(end + 1)[0] for channel, poses in frames.items()
        }
        scene.draw({channel: poses for channel, poses in inside.items() if len(poses)})
        return sum(map(len, inside.values()))

    def _thin(self, whole: float) -> None:
        """Leave frames out of a long log: a viewer has no room for an hour at 30 Hz."""
        begin, end = self.options.time_range or (0.0, whole)
        seconds = min(end, whole) - begin
        self._is_long = seconds > LONG_S
        if seconds > WHOLE_S:
            self._step = round(min(seconds / MOST_FRAMES, LONGEST_STEP_S) * 1e9)

    def _spans(self, start: int) -> Spans | None:
        """Return the log times, ns, to be read: the log's first second, and from the range on.

        Nobody knows how much later than its time a result is logged.
        """
        if self.options.time_range is None:
            return None
        begin, _ = _window(start, self.options.time_range)
        return [(start, start + 10**9), (begin - HORIZON_NS, _EVER[1])]

    def _topics(self, source: Source, final: str) -> Sequence[str]:
        """Return what to read: of a long log, what its layout shows."""
        if not self._is_long:
            return source.topics
        shown = {final, *(source.stages if self.options.layout == "stages" else ())}
        left_out = {f"{OUTPUT_PREFIX}/{stage}" for stage in source.stages if stage not in shown}
        return [topic for topic in source.topics if topic not in left_out]


def _window(start: int, seconds: tuple[float, float] | None) -> tuple[int, int]:
    if seconds is None:
        return _EVER
    return start + round(seconds[0] * 1e9), start + round(min(seconds[1], 1e9) * 1e9)


def _skeletons_of_result(path: Path) -> list[str]:
    """Return globs of the skeletons in a result, also of those that were keypoints; no truth."""
    with reading(path) as reader:
        channels = skeleton_channels(reader)
    topics = [info.topic for info in channels if not info.topic.startswith(f"{TRUTH_PREFIX}/")]
    return list(map(glob.escape, topics))


def describe(log: Log) -> Source:
    """Find out what a log holds that can be drawn."""
    kinds = {kind_of(camera.channel.topic) for camera in log.cameras}
    detectors = [c for c in log.cameras if kind_of(c.channel.topic) == DETECTIONS]
    names, poses, later = {}, {}, {}
    for camera in detectors:
        for source in camera.sources.values():
            names[source] = _camera_name(camera, source, detectors)
        is_placed = camera.channel.topic != RGB_TOPIC  # what RGB cameras see together has no place
        if is_placed and (pose := log.pose_of(camera)) is not None:
            poses.update({names[source]: pose for source in camera.sources.values()})
            moved = _later_poses(log, camera)
            later.update({names[source]: moved for source in camera.sources.values() if moved})
    stages = tuple(stage for stage in STAGES if stage in kinds and stage != "truth")
    topics = tuple(dict.fromkeys(camera.channel.topic for camera in log.cameras))
    events = stored_events(log.reader)
    return Source(log.model, poses, names, stages, events, log.span[0], topics, later)


def _later_poses(log: Log, camera: CameraChannel) -> dict[float, Rigid]:
    """Return the poses of a camera after it was moved, by the seconds from the log's start."""
    (frame,), fixed = camera.frames, log.fixed_frame
    return {
        (time - log.span[0]) / 1e9: log.transforms.lookup(frame, fixed, time, time)
        for time in log.transforms.change_times([frame, fixed])
    }


def _camera_name(camera: CameraChannel, source: str, cameras: list[CameraChannel]) -> str:
    """Return the coordinate frame's name if that is enough to tell cameras apart."""
    if camera.channel.topic == RGB_TOPIC:
        return TRIANGULATED  # it has no frame of its own
    shared = sum(camera.frames == other.frames for other in cameras) > 1
    is_enough = len(camera.sources) == len(camera.frames) == 1 and not shared
    return camera.frames[0] if is_enough else source


def kind_of(topic: str) -> str:
    """Return the stage of a topic, or that it holds detections."""
    if topic.startswith(f"{TRUTH_PREFIX}/"):
        return "truth"
    stage = topic.removeprefix(f"{OUTPUT_PREFIX}/")
    return stage if stage != topic and stage in STAGES else DETECTIONS


def in_time_order(
    log: Log, left_out: Collection[str] = (), step: int = 0, spans: Spans | None = None
) -> Iterator[Mapping[Channel, Poses]]:
    """Yield what is drawn of a log, in the fixed frame, many frames at a time in their own order.

    Parameters
    ----------
    left_out : stages, or DETECTIONS, that are not drawn.
    step : ns; of each channel and camera, one frame in each such interval is drawn; 0 = all.
    spans : log times, ns; only there the log is read. None = all of it.
    """
    kinds = {camera.channel.topic: kind_of(camera.channel.topic) for camera in log.cameras}
    names, waiting, thinner = describe(log).names, Gatherer(), Thinner(step)
    for topics, block in log.read(spans=spans, step=step):
        sources = [source for _, source, _ in block.messages()]
        shown = thinner.chosen(list(zip(topics, sources, strict=True)), block.stamps)
        channels = [
            (kinds[topic], names.get(source, source) if kinds[topic] == DETECTIONS else "")
            if is_shown and kinds[topic] not in left_out
            else None
            for topic, source, is_shown in zip(topics, sources, shown, strict=True)
        ]
        waiting.add(channels, block)
        if waiting.is_due and (ready := waiting.ready()):
            yield ready
    if rest := waiting.rest():
        yield rest


def content_of(scenes: list[Scene]) -> Content:
    """Sum up what was drawn, for the layout."""
    stages = [stage for stage in STAGES if any(stage in scene.stages for scene in scenes)]
    return Content(
        stages=stages,
        people=sorted({person for scene in scenes for person in scene.people}),
        cameras=[path_part(name) for name in scenes[0].cameras],
        boxes=np.array([box for scene in scenes for box in scene.bounds] or [EMPTY_ROOM]),
        images={path_part(i.camera.name): i.camera.lens.size for i in scenes[0].images},
        camera_poses={path_part(name): pose for name, pose in scenes[0].camera_poses.items()},
        layers=[scene.layer for scene in scenes],
        shows_truth=any(scene.shows_truth for scene in scenes),
        shows_uncertainty=any(scene.uncertainties is not None for scene in scenes),
        has_error=any(scene.n_true for scene in scenes),
        has_predicted=any(scene.has_predicted for scene in scenes),
        lanes={path: kind for scene in scenes for path, kind in scene.lanes.items()},
        moved={stage for scene in scenes for stage in scene.moved},
        longest=scenes[0].longest,
        ranges=axis_ranges(scenes),
    )


def axis_ranges(scenes: Sequence[Scene]) -> dict[str, tuple[float, float]]:
    """Return the axis of each kind of curve; everybody's is the same."""
    axes = {}
    for kind in {kind for scene in scenes for kind in scene.ranges}:
        ranges = [scene.ranges[kind] for scene in scenes if kind in scene.ranges]
        low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
        if kind == "angles":
            axes[kind] = min(low, ANGLE_AXIS_DEG[0]) - 8.0, max(high, ANGLE_AXIS_DEG[1]) + 8.0
        else:
            axes[kind] = numbered_axis(high)
    return axes


def numbered_axis(high: float) -> tuple[float, float]:
    """Return an axis from 0 to ``high`` or more, on which the viewer writes two numbers at least.

    It writes the multiples of a power of ten, if there is room for three of them.
    """
    step = 10.0 ** math.floor(math.log10(high)) if high > 0 else 1.0
    top = 1.1 * max(step, high) if high < 3.3 * step else 10.5 * step
    return -0.04 * top, top


def recording_name(logs: list[Path | str], layout: str) -> str:
    """Return the name that a recording goes by in the viewer, which shows each name once."""
    names = " + ".join(os.path.basename(str(log)) for log in logs)  # noqa: PTH119
    return names if layout == ViewOptions().layout else f"{names}, {layout}"
