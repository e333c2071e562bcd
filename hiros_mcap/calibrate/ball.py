"""Poses of a log's cameras from a coloured ball that somebody carries (Lee et al. 2022, 2.1.1).

::

    found = calibrate_ball(Path("ball.mcap"), BallOptions(radius=0.12))

A camera is a colour image, a depth image and the CameraInfo of both. Where another program has
found the ball already, a camera is a channel of PointStamped messages. Each step is a module:
``ball_image`` finds the ball in an image, ``ball_poses`` registers the centres.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import TransformTree, parse_tf
from hiros_mcap.calibrate.ball_image import ColorRange, DepthCamera, find_ball
from hiros_mcap.calibrate.ball_poses import BallCalibration, BallTrack, calibrate_centres
from hiros_mcap.calibrate.image_channels import ImageChannels, pair_channels
from hiros_mcap.errors import LogError, RegistrationError
from hiros_mcap.io.images import Bytes, Intrinsics, colour_image, depth_image, require_opencv
from hiros_mcap.io.ros_messages import POINT, TRANSFORMS, RosMessage, RosMessages, open_messages
from hiros_mcap.skeletons import Floats

RADIUS_M = 0.24
"""The paper's ball."""
MAX_DELTA_S = 0.017
"""Between the colour and the depth image; half a period of a 30 Hz camera."""
WAITING = 8
"""Images that wait for their partner."""
OTHER_RADIUS = 0.07
"""A radius that differs more from the one measured is doubtful."""
WORLD = "world"


@dataclass(frozen=True, slots=True)
class BallOptions:
    """What to look for."""

    radius: float = RADIUS_M
    """m"""
    color: ColorRange = field(default_factory=ColorRange)
    cameras: Sequence[str] = ()
    """Globs of the topics to read; none = all."""


class BallReport(NamedTuple):
    """The poses, and what became of the images."""

    found: BallCalibration
    radius: float
    """Median radius that was measured, m; NaN without images."""
    skipped: dict[str, dict[str, int]]
    """Depth images without a result, by camera and reason."""
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; numbers that are not known are None."""
        radius = {
            "measured_radius": None if math.isnan(self.radius) else self.radius,
            "skipped": self.skipped,
        }
        return {**self.found.to_dict(), **radius}


class _BallViews:
    """What one camera saw of the ball."""

    def __init__(self, name: str, frame: str) -> None:
        self.name, self.frame = name, frame
        self.stamps: list[int] = []
        self.centres: list[Any] = []
        self.radii: list[float] = []
        self.skipped: Counter[str] = Counter()

    def add(self, stamp: int, centre: Any) -> None:
        self.stamps.append(stamp)
        self.centres.append(centre)

    def track(self) -> BallTrack:
        centres = np.array(self.centres, np.float64).reshape(-1, 3)
        return BallTrack(self.name, self.frame, np.array(self.stamps, np.int64), centres)


def calibrate_ball(path: Path, options: BallOptions | None = None) -> BallReport:
    """Find the poses of a log's cameras from the ball that they see.

    Raises
    ------
    LogError
        The log has no suitable channels, or cannot be read.
    ConfigError
        OpenCV is needed and not installed.
    RegistrationError
        The ball does not tell the pose of a camera. The line says what to record.
    """
    options = options or BallOptions()
    if not 0.01 <= options.radius <= 2.0:
        raise RegistrationError(f"a ball of radius {options.radius:g} m? It is given in m")
    try:
        with open_messages(path) as log:
            tree = _transforms(log)
            chosen = {t: k for t, k in log.types.items() if _is_chosen(t, options.cameras)}
            points = sorted(topic for topic, kind in chosen.items() if kind == POINT)
            if points:
                seen = _ready_centres(log, points)
            else:
                require_opencv()
                seen = _look(log, pair_channels(log, chosen), tree, options)
    except LogError as error:
        if error.path is None:
            raise LogError(error.fault, path=path, topic=error.topic) from None
        raise
    try:
        return _report(seen, tree, options)
    except RegistrationError as error:
        raise RegistrationError(f"{path}: {error}") from None


def _is_chosen(topic: str, globs: Sequence[str]) -> bool:
    return not globs or any(fnmatchcase(topic, glob) for glob in globs)


def _transforms(log: RosMessages) -> TransformTree:
    """Gather the static transforms; cameras that move cannot be calibrated by a ball."""
    tree = TransformTree()
    wanted = [topic for topic, kind in log.types.items() if kind == TRANSFORMS]
    for message in log.read([topic for topic in wanted if topic == "/tf_static"]):
        for transform in parse_tf(message.data):
            tree.add(transform, static=True, log_time=message.log_time)
    return tree


def _ready_centres(log: RosMessages, topics: Sequence[str]) -> list[_BallViews]:
    """Read the centres that another program has found."""
    seen: dict[str, _BallViews] = {}
    for message in log.read(topics):
        point = log.decode(message)
        frame = point.header.frame_id.lstrip("/")
        one = seen.setdefault(message.topic, _BallViews(message.topic, frame))
        if frame != one.frame:
            raise LogError(f"has points in {one.frame!r} and in {frame!r}", topic=message.topic)
        one.add(_stamp(point, message), [point.point.x, point.point.y, point.point.z])
    return [seen[topic] for topic in topics if topic in seen]


def _stamp(content: Any, message: RosMessage) -> int:
    """Return header.stamp, ns; the log time if there is none."""
    stamp = content.header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec or message.log_time


def _look(
    log: RosMessages, cameras: Sequence[ImageChannels], tree: TransformTree, options: BallOptions
) -> list[_BallViews]:
    """Find the ball in all images, in one pass through the log."""
    searches = [_Search(channels, tree, options) for channels in cameras]
    by_topic = {t: s for s in searches for t in (s.channels.depth, s.channels.colour)}
    for message in log.read(by_topic.keys()):
        search = by_topic[message.topic]
        try:
            content = log.decode(message)
        except LogError:
            search.seen.skipped["damaged"] += message.topic == search.channels.depth
        else:
            search.take(message.topic, _stamp(content, message), content)
    for search in searches:
        search.finish()
    return [search.seen for search in searches]


class _Search:
    """Joins the depth and colour images of one camera, and looks for the ball in them.

    Stamps of a channel increase. A depth image waits for a colour image that is not older.
    """

    def __init__(self, channels: ImageChannels, tree: TransformTree, options: BallOptions) -> None:
        self.channels = channels
        self.seen = _BallViews(channels.name, channels.colour_frame)
        self._tree, self._options = tree, options
        self._camera: DepthCamera | None = None
        self._depths: deque[tuple[int, Any]] = deque()
        self._colours: deque[tuple[int, Any]] = deque(maxlen=2 * WAITING)

    def take(self, topic: str, stamp: int, content: Any) -> None:
        """Take an image of the camera."""
        queue = self._depths if topic == self.channels.depth else self._colours
        queue.append((stamp, content))
        depths, colours = self._depths, self._colours
        while depths and ((colours and colours[-1][0] >= depths[0][0]) or len(depths) > WAITING):
            self._join(*depths.popleft())

    def finish(self) -> None:
        """Use the depth images that still wait."""
        while self._depths:
            self._join(*self._depths.popleft())

    def _join(self, stamp: int, depth: Any) -> None:
        nearest = min(self._colours, key=lambda colour: abs(colour[0] - stamp), default=None)
        if nearest is None or abs(nearest[0] - stamp) > MAX_DELTA_S * 1e9:
            self.seen.skipped["no colour image at that time"] += 1
            return
        try:
            images = depth_image(depth), colour_image(nearest[1])
        except LogError:
            self.seen.skipped["damaged"] += 1
            return
        self._search(stamp, *images)

    def _search(self, stamp: int, depth: Floats, colour: Bytes) -> None:
        if self._camera is None:
            self._camera = _camera(self.channels, self._tree, depth.shape, colour.shape[:2])
        if self._camera.rays.shape[:2] != depth.shape:
            self.seen.skipped["of another size"] += 1
            return
        ball = find_ball(colour, depth, self._camera, self._options.radius, self._options.color)
        if ball is None:
            self.seen.skipped["no ball"] += 1
        else:
            self.seen.radii.append(ball.radius)
            self.seen.add(stamp, ball.centre)


def _camera(
    channels: ImageChannels, tree: TransformTree, depth: Sequence[int], colour: Sequence[int]
) -> DepthCamera:
    """Return how depth and colour images belong together.

    Raises LogError if nothing in the log tells it.
    """
    lens = Intrinsics.of(channels.depth_info, channels.depth)
    to_colour: Rigid | None = Rigid.identity()
    if channels.depth_frame != channels.colour_frame:
        to_colour = tree.at_rest(channels.depth_frame, channels.colour_frame)
    if to_colour is None:
        raise LogError(
            f"is in the frame {channels.depth_frame!r}, the colour images are in "
            f"{channels.colour_frame!r}, and /tf_static does not join them; record depth that is "
            "registered to the colour image",
            topic=channels.depth,
        )
    aligned = channels.depth_frame == channels.colour_frame and tuple(depth) == tuple(colour)
    colour_lens = None if aligned else Intrinsics.of(channels.colour_info, channels.colour)
    return DepthCamera(lens.rays(*depth), float(lens.matrix[0, 0]), colour_lens, to_colour)


def _report(seen: Sequence[_BallViews], tree: TransformTree, options: BallOptions) -> BallReport:
    """Register the centres, and check the ball's radius."""
    radii = [radius for one in seen for radius in one.radii]
    radius = float(np.median(radii)) if radii else float("nan")
    for one in seen:
        if not one.stamps and one.skipped["no ball"]:
            raise RegistrationError(
                f"{one.name} never saw a ball of radius {options.radius:g} m and this colour in "
                f"{one.skipped['no ball']} images; pass its --radius and --color, or carry it "
                "where the camera sees it"
            )
    tracks = [one.track() for one in seen]
    roots = [tree.root(t.frame) for t in tracks if t.frame in tree.frames]
    root = max(sorted(set(roots)), key=roots.count) if roots else WORLD
    given = {t.frame: pose for t in tracks if roots and (pose := tree.at_rest(t.frame, root))}
    given = {frame: pose for frame, pose in given.items() if frame != root}
    found = calibrate_centres(tracks, fixed_frame=root if given else WORLD, given=given)
    if abs(radius - options.radius) > OTHER_RADIUS * options.radius:
        other = (
            f"the ball looks like one of radius {radius:.3f} m, not {options.radius:g} m; "
            "measure it and pass --radius"
        )
        reason = "; ".join(filter(None, (other, found.reason)))
        found = replace(found, verdict="doubtful", reason=reason)
    warnings = (f"the poses are doubtful: {found.reason}",) if found.reason else ()
    skipped = {one.name: dict(one.skipped) for one in seen}
    return BallReport(found, radius, skipped, warnings)
