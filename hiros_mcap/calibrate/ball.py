"""Poses of a log's cameras from a coloured ball that somebody carries (Lee et al. 2022, 2.1.1).

::

    calibration = calibrate_ball(Path("ball.mcap"), radius=0.12)

A camera is a colour image, a depth image and the CameraInfo of both. Where another program has
found the ball already, a camera is a channel of PointStamped messages. Each step is a module:
``ball_image`` finds the ball in an image, ``ball_poses`` registers the centres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from hiros_mcap.body.transforms import TransformTree
from hiros_mcap.calibrate.ball_image import ColorRange, find_ball
from hiros_mcap.calibrate.ball_poses import BallTrack, calibrate_centres
from hiros_mcap.calibrate.gauge import WORLD
from hiros_mcap.calibrate.image_search import (
    ImageSearch,
    is_chosen,
    pair_channels,
    search_images,
    stamp_of,
    static_transforms,
)
from hiros_mcap.calibrate.verdict import TargetCalibration
from hiros_mcap.errors import LogError, RegistrationError, naming
from hiros_mcap.io.ros_messages import POINT, RosMessages, open_messages

RADIUS_M = 0.24
"""The paper's ball."""
OTHER_RADIUS = 0.07
"""A radius that differs more from the one measured is doubtful."""
RED = ColorRange()


def calibrate_ball(
    path: Path,
    radius: float = RADIUS_M,
    color: ColorRange = RED,
    cameras: Sequence[str] = (),
) -> TargetCalibration:
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
    with naming(path), open_messages(path) as log:
        tree = static_transforms(log)
        chosen = {t: k for t, k in log.types.items() if is_chosen(t, cameras)}
        points = sorted(topic for topic, kind in chosen.items() if kind == POINT)
        if points:
            tracks = _ready_centres(log, points)
        else:
            find = partial(find_ball, radius=radius, color=color)
            searches = search_images(log, pair_channels(log, chosen), tree, find)
            tracks = [_track_of(search) for search in searches]
    try:
        return _calibrated(tracks, tree, radius)
    except RegistrationError as error:
        bad = [f"{t.camera} {t.skipped['damaged']}" for t in tracks if t.skipped.get("damaged")]
        images = f"; damaged images: {', '.join(bad)}" if bad else ""
        raise RegistrationError(f"{path}: {error}{images}") from None


def _ready_centres(log: RosMessages, topics: Sequence[str]) -> list[BallTrack]:
    """Read the centres that another program has found."""
    frames: dict[str, str] = {}
    points: dict[str, list[tuple[int, list[float]]]] = {}
    for message in log.read(topics):
        topic, point = message.topic, log.decode(message)
        frame = point.header.frame_id.lstrip("/")
        if frame != frames.setdefault(topic, frame):
            raise LogError(f"has points in {frames[topic]!r} and in {frame!r}", topic=topic)
        centre = [point.point.x, point.point.y, point.point.z]
        points.setdefault(topic, []).append((stamp_of(point, message), centre))
    return [BallTrack.of(t, frames[t], points[t]) for t in topics if t in points]


def _track_of(search: ImageSearch) -> BallTrack:
    """Return where a camera's images show the ball."""
    points = [(stamp, ball.centre) for stamp, ball in search.hits]
    skipped = dict(search.skipped)
    skipped["no ball"] = skipped.pop("not seen", 0)
    track = BallTrack.of(search.channels.name, search.channels.colour_frame, points)
    return track._replace(radii=[ball.radius for _, ball in search.hits], skipped=skipped)


def _calibrated(
    tracks: Sequence[BallTrack], tree: TransformTree, true_radius: float
) -> TargetCalibration:
    """Register the centres, and check the ball's radius."""
    for track in tracks:
        unseen = track.skipped.get("no ball", 0)
        if not len(track.stamps) and unseen:
            raise RegistrationError(
                f"{track.camera} never saw a ball of radius {true_radius:g} m and this colour in "
                f"{unseen} images; pass its --radius and --color, or carry it where the camera "
                "sees it"
            )
    roots = [tree.root(t.frame) for t in tracks if t.frame in tree.frames]
    root = max(sorted(set(roots)), key=roots.count) if roots else WORLD
    known = {t.frame: pose for t in tracks if roots and (pose := tree.at_rest(t.frame, root))}
    known = {frame: pose for frame, pose in known.items() if frame != root}
    calibration = calibrate_centres(tracks, fixed_frame=root if known else WORLD, given=known)
    if abs(calibration.radius - true_radius) > OTHER_RADIUS * true_radius:
        warning = (
            f"the ball looks like one of radius {calibration.radius:.3f} m, not {true_radius:g} m; "
            "measure it and pass --radius"
        )
        reason = "; ".join(filter(None, (warning, calibration.reason)))
        calibration = replace(calibration, verdict="doubtful", reason=reason)
    return calibration
