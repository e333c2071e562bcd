"""The fixed frame and the cameras' poses by a board of four ArUco markers (Lee et al. 2022, 2.1.2).

::

    report = calibrate_board(Path("board.mcap"))

The board lies still where the cameras see it. Marker 1 is the origin, x points from it to marker 2,
y towards marker 0, and z is up. A camera is a colour image, a depth image and the CameraInfo of
both, as for the ball.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hiros_mcap.body.intrinsics import opencv
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import TransformTree, read_extrinsics
from hiros_mcap.calibrate.ball_image import DepthCamera, points_of_labels
from hiros_mcap.calibrate.gauge import WORLD
from hiros_mcap.calibrate.image_search import (
    Finder,
    ImageSearch,
    is_chosen,
    pair_channels,
    search_images,
    static_transforms,
)
from hiros_mcap.calibrate.registration import board_frame, rigid_fit
from hiros_mcap.calibrate.verdict import TargetCalibration, TargetCamera
from hiros_mcap.errors import ConfigError, RegistrationError, naming
from hiros_mcap.io.ros_messages import Bytes, open_messages
from hiros_mcap.skeletons import Floats

DICTIONARY = "DICT_4X4_50"
MARKERS = 4
LEAST_FRAMES = 5
LEAST_PIXELS = 12
"""Depth pixels of a marker."""
NEAR_M = 0.03
"""Depth pixels that are further from a marker's median are not on it."""
WRONG_M, DOUBTFUL_M = 0.04, 0.012
"""Root mean square distance of the markers in two cameras."""
MOVED_M = 0.02
"""A board that lies still scatters by less, from frame to frame."""


def calibrate_board(
    path: Path,
    *,
    dictionary: str = DICTIONARY,
    extrinsics: Path | None = None,
    topics: Sequence[str] = (),
) -> TargetCalibration:
    """Find the poses of a log's cameras in the frame of the board.

    Where transforms join the cameras (of the log, or ``extrinsics``, for example those of the
    ball), they stay as they are to each other, and one camera that sees the board is enough.
    Otherwise each camera has to see it.

    Raises
    ------
    LogError
        The log has no suitable channels, or cannot be read.
    ConfigError
        OpenCV is needed and not installed; there is no such dictionary; ``extrinsics`` lacks a
        camera.
    RegistrationError
        The board does not tell the pose of a camera. The line says what to record.
    """
    find = marker_finder(dictionary)
    with naming(path), open_messages(path) as log:
        tree = static_transforms(log)
        chosen = {t: k for t, k in log.types.items() if is_chosen(t, topics)}
        searches = search_images(log, pair_channels(log, chosen), tree, find)
    if extrinsics is not None:
        tree = read_extrinsics(extrinsics)
        _check_names(tree, [search.channels.colour_frame for search in searches])
    try:
        return _report(searches, tree)
    except RegistrationError as error:
        raise RegistrationError(f"{path}: {error}") from None


def _check_names(tree: TransformTree, frames: Sequence[str]) -> None:
    """Raise ConfigError if a file has no pose of the frame of a camera's colour images."""
    if lacking := [frame for frame in frames if frame.lstrip("/") not in tree.frames]:
        raise ConfigError(
            f"{tree.source}: has no pose of the frame {', '.join(lacking)}; the file has "
            f"{', '.join(tree.frames)}, the colour images of the log are in {', '.join(frames)}. "
            "Correct the names, or choose other cameras with --topic"
        )


def marker_finder(dictionary: str = DICTIONARY) -> Finder:
    """Return what finds the centres of markers 0 to 3 in a colour and a depth image.

    Raises ConfigError if OpenCV has no such dictionary.
    """
    cv2 = opencv()

    names = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
    if dictionary not in names:
        raise ConfigError(f"--dictionary: there is no {dictionary!r}, only {', '.join(names)}")
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    detector = cv2.aruco.ArucoDetector(words, cv2.aruco.DetectorParameters())

    def find(colour: Bytes, depth: Floats, camera: DepthCamera) -> Floats | None:
        """(4, 3) centroids of the markers' depth pixels in the colour frame, m (Lee, 2.1.2).

        None unless each of the four is seen once.
        """
        corners, ids, _ = detector.detectMarkers(colour)
        markers = [] if ids is None else [int(i) for i in ids.ravel()]
        if sorted(i for i in markers if i < MARKERS) != list(range(MARKERS)):
            return None
        labels = np.zeros(colour.shape[:2], np.int32)
        for marker, quad in zip(markers, corners, strict=True):
            if marker < MARKERS:
                cv2.fillConvexPoly(labels, np.rint(quad[0]).astype(np.int32), marker + 1)
        points, numbers = points_of_labels(labels, depth, camera)
        centres = np.stack([_centroid(points[numbers == k + 1]) for k in range(MARKERS)])
        if np.isnan(centres).any():
            return None
        return camera.to_colour.moved(centres)

    return find


def _centroid(points: Floats) -> Floats:
    """(3,) mean of the points near their median; NaN for too few."""
    if len(points) < LEAST_PIXELS:
        return np.full(3, np.nan)
    depths = points[:, 2]
    reach = NEAR_M + 0.5 * float(np.ptp(points[:, :2], axis=0).max())  # it may be tilted
    kept = points[np.abs(depths - np.median(depths)) < reach]
    return np.asarray(kept.mean(axis=0))


def _report(searches: Sequence[ImageSearch], tree: TransformTree) -> TargetCalibration:
    """Put the cameras into the board's frame."""
    centres = {
        search.channels.colour_frame: np.stack([centre for _, centre in search.hits])
        for search in searches
        if len(search.hits) >= LEAST_FRAMES
    }
    if not centres:
        raise RegistrationError(
            f"no camera sees markers 0 to 3 in {LEAST_FRAMES} images; lay the board where they "
            "see all of it, or pass its --dictionary"
        )
    given = _joined(searches, centres, tree)
    middles = {frame: np.median(each, axis=0) for frame, each in centres.items()}
    poses = _by_transforms(middles, given) if given else _by_board(searches, middles)
    world = np.mean([poses[frame].moved(each) for frame, each in middles.items()], axis=0)
    cameras = []
    for search in searches:
        frame = search.channels.colour_frame
        camera = TargetCamera(search.channels.name, frame, pose=poses[frame], seen=len(search.hits))
        if frame in centres:
            camera = _with_verdict(camera, poses[frame], centres[frame], world)
        cameras.append(camera)
    skipped = {s.channels.name: dict(s.skipped) for s in searches}
    return TargetCalibration.of(WORLD, cameras, "transforms" if given else "board", skipped)


def _joined(
    searches: Sequence[ImageSearch], centres: Mapping[str, Floats], tree: TransformTree
) -> dict[str, Rigid]:
    """Return the poses of all cameras in the root of the transforms; empty unless all have one."""
    frames = [search.channels.colour_frame for search in searches]
    if len(frames) < 2 or any(frame not in tree.frames for frame in frames):
        return {}
    root = tree.root(next(iter(centres)))
    poses = {frame: tree.at_rest(frame, root) for frame in frames}
    placed = {frame: pose for frame, pose in poses.items() if pose is not None}
    return placed if len(placed) == len(frames) else {}


def _by_transforms(middles: Mapping[str, Floats], given: Mapping[str, Rigid]) -> dict[str, Rigid]:
    """Return the given poses, in the frame of the board as all cameras see it."""
    board = board_frame(np.mean([given[f].moved(each) for f, each in middles.items()], axis=0))
    return {frame: board.inverse() @ pose for frame, pose in given.items()}


def _by_board(searches: Sequence[ImageSearch], middles: Mapping[str, Floats]) -> dict[str, Rigid]:
    """Return the pose of each camera from its own view of the board."""
    unseen = [s.channels.name for s in searches if s.channels.colour_frame not in middles]
    if unseen:
        raise RegistrationError(
            f"{', '.join(unseen)} never saw the board, and no transforms join the cameras; turn "
            "the board towards all of them, or pass the ball's poses with --extrinsics FILE"
        )
    first = next(iter(middles))
    axes = board_frame(middles[first]).inverse()
    world = axes.moved(middles[first])
    others = {frame: rigid_fit(each, world) for frame, each in middles.items()}
    return {**others, first: axes}


def _with_verdict(
    camera: TargetCamera, pose: Rigid, centres: Floats, world: Floats
) -> TargetCamera:
    """Compare a camera's markers (K, 4, 3) with the mean of all cameras.

    Raises RegistrationError if they are far apart.
    """
    places = pose.moved(np.median(centres, axis=0))
    residual = float(np.sqrt(np.mean(np.sum((places - world) ** 2, axis=1))))
    scatter = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=2)))
    if residual > WRONG_M:
        raise RegistrationError(
            f"{camera.name} has the board's markers {100 * residual:.0f} cm from the other "
            "cameras; lay the board still, flat and with one marker of each number in view"
        )
    reason = ""
    if scatter > MOVED_M:
        reason = f"the board moves by {100 * scatter:.0f} cm; let it lie still"
    elif residual > DOUBTFUL_M:
        reason = f"the markers are {1000 * residual:.0f} mm from those in other cameras"
    error_m = scatter / math.sqrt(len(centres) * MARKERS)
    arm = float(np.linalg.norm(world - world.mean(axis=0), axis=1).mean())
    return replace(
        camera,
        verdict="doubtful" if reason else "good",
        reason=reason,
        residual_mm=1000.0 * residual,
        error_deg=math.degrees(error_m / arm),
        error_mm=1000.0 * error_m,
    )
