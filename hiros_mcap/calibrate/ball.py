"""Poses of a log's cameras from a coloured ball that somebody carries (Lee et al. 2022, 2.1.1).

::

    report = calibrate_ball(Path("ball.mcap"), radius=0.12)

A camera is a colour image, a depth image and the CameraInfo of both. Where another program has
found the ball already, a camera is a channel of PointStamped messages. Each step is a module:
``ball_image`` finds the ball in an image, ``ball_poses`` registers the centres.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.body.transforms import TransformTree
from hiros_mcap.calibrate.ball_image import BallFit, ColorRange, DepthCamera, find_ball
from hiros_mcap.calibrate.ball_poses import BallCalibration, BallTrack, calibrate_centres
from hiros_mcap.calibrate.image_search import (
    ImageSearch,
    is_chosen,
    pair_channels,
    search_images,
    stamp_of,
    static_transforms,
)
from hiros_mcap.errors import LogError, RegistrationError
from hiros_mcap.io.ros_messages import POINT, Bytes, RosMessages, open_messages, require_opencv
from hiros_mcap.skeletons import Floats

RADIUS_M = 0.24
"""The paper's ball."""
OTHER_RADIUS = 0.07
"""A radius that differs more from the one measured is doubtful."""
RED = ColorRange()
WORLD = "world"


class BallReport(NamedTuple):
    """The poses, and what became of the images."""

    calibration: BallCalibration
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
        return {**self.calibration.to_dict(), **radius}


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


def calibrate_ball(
    path: Path,
    radius: float = RADIUS_M,
    color: ColorRange = RED,
    cameras: Sequence[str] = (),
) -> BallReport:
    """Find the poses of a log's cameras from the ball that they see.

    Parameters
    ----------
    radius : of the ball, m. color : of the ball. cameras : globs of the topics to read; none = all.

    Raises
    ------
    LogError
        The log has no suitable channels, or cannot be read.
    ConfigError
        OpenCV is needed and not installed.
    RegistrationError
        The ball does not tell the pose of a camera. The line says what to record.
    """
    if not 0.01 <= radius <= 2.0:
        raise RegistrationError(f"a ball of radius {radius:g} m? It is given in m")
    try:
        with open_messages(path) as log:
            tree = static_transforms(log)
            chosen = {t: k for t, k in log.types.items() if is_chosen(t, cameras)}
            points = sorted(topic for topic, kind in chosen.items() if kind == POINT)
            if points:
                seen = _ready_centres(log, points)
            else:
                require_opencv()

                def find(colour: Bytes, depth: Floats, camera: DepthCamera) -> BallFit | None:
                    return find_ball(colour, depth, camera, radius, color)

                searches = search_images(log, pair_channels(log, chosen), tree, find)
                seen = [_views_of(search) for search in searches]
    except LogError as error:
        if error.path is None:
            raise LogError(error.fault, path=path, topic=error.topic) from None
        raise
    try:
        return _report(seen, tree, radius)
    except RegistrationError as error:
        raise RegistrationError(f"{path}: {error}") from None


def _ready_centres(log: RosMessages, topics: Sequence[str]) -> list[_BallViews]:
    """Read the centres that another program has found."""
    seen: dict[str, _BallViews] = {}
    for message in log.read(topics):
        point = log.decode(message)
        frame = point.header.frame_id.lstrip("/")
        one = seen.setdefault(message.topic, _BallViews(message.topic, frame))
        if frame != one.frame:
            raise LogError(f"has points in {one.frame!r} and in {frame!r}", topic=message.topic)
        one.add(stamp_of(point, message), [point.point.x, point.point.y, point.point.z])
    return [seen[topic] for topic in topics if topic in seen]


def _views_of(search: ImageSearch) -> _BallViews:
    views = _BallViews(search.channels.name, search.channels.colour_frame)
    views.skipped = search.skipped
    views.skipped["no ball"] = views.skipped.pop("not seen", 0)
    for stamp, ball in search.hits:
        views.radii.append(ball.radius)
        views.add(stamp, ball.centre)
    return views


def _report(seen: Sequence[_BallViews], tree: TransformTree, true_radius: float) -> BallReport:
    """Register the centres, and check the ball's radius."""
    radii = [radius for one in seen for radius in one.radii]
    radius = float(np.median(radii)) if radii else float("nan")
    for one in seen:
        if not one.stamps and one.skipped["no ball"]:
            raise RegistrationError(
                f"{one.name} never saw a ball of radius {true_radius:g} m and this colour in "
                f"{one.skipped['no ball']} images; pass its --radius and --color, or carry it "
                "where the camera sees it"
            )
    tracks = [one.track() for one in seen]
    roots = [tree.root(t.frame) for t in tracks if t.frame in tree.frames]
    root = max(sorted(set(roots)), key=roots.count) if roots else WORLD
    given = {t.frame: pose for t in tracks if roots and (pose := tree.at_rest(t.frame, root))}
    given = {frame: pose for frame, pose in given.items() if frame != root}
    calibration = calibrate_centres(tracks, fixed_frame=root if given else WORLD, given=given)
    if abs(radius - true_radius) > OTHER_RADIUS * true_radius:
        other = (
            f"the ball looks like one of radius {radius:.3f} m, not {true_radius:g} m; "
            "measure it and pass --radius"
        )
        reason = "; ".join(filter(None, (other, calibration.reason)))
        calibration = replace(calibration, verdict="doubtful", reason=reason)
    warnings = (f"the poses are doubtful: {calibration.reason}",) if calibration.reason else ()
    skipped = {one.name: dict(one.skipped) for one in seen}
    return BallReport(calibration, radius, skipped, warnings)
