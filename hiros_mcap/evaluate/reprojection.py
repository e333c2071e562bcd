"""How far the keypoints of RGB cameras are from a result that is projected into their images.

It needs no truth. It is no error of the result either: it contains the detector's own error, and
what all cameras get wrong alike does not show. Poses and lenses are those of the log, so a wrong
pose of one camera shows in its row.
"""

from __future__ import annotations

import glob
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.evaluate.match import MATCH_DISTANCE
from hiros_mcap.evaluate.mot import best_pairs
from hiros_mcap.evaluate.statistics import ErrorStats, nan_mean
from hiros_mcap.evaluate.truth import Truth, shared_markers
from hiros_mcap.io.log import Source, open_log, reading
from hiros_mcap.io.rgb_cameras import RgbCamera, poses_of, read_rgb_cameras
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, SkeletonModel

_CHUNK = 256  # images whose people are projected at once


@dataclass(frozen=True, slots=True)
class Reprojection:
    """An RGB camera against a result; see :data:`measures.REPROJECTION`, in px."""

    topic: str
    detections: int
    unmatched: int
    distance: ErrorStats
    joints: Mapping[str, ErrorStats] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ImageScores:
    """An RGB camera against results; see :data:`measures.REPROJECTION`."""

    topic: str
    result: Reprojection  # against the result of all cameras
    left_out: Reprojection | None = None
    """Against the result of the others; None if it was not left out."""


def image_scores(
    cameras: Sequence[RgbCamera],
    poses: Mapping[str, Rigid],
    frames: Sequence[Frame],
    model: SkeletonModel,
) -> tuple[ImageScores, ...]:
    """Compare all RGB cameras whose optical frames have poses in that of a result."""
    return tuple(
        ImageScores(camera.topic, reprojection(camera, poses[camera.name], frames, model))
        for camera in cameras
        if camera.name in poses
    )


def image_scores_of(
    source: Source, topic: str, frames: Sequence[Frame], model: SkeletonModel
) -> tuple[ImageScores, ...]:
    """Compare the RGB cameras of a log with a result in it, by the poses in the log."""
    with reading(source) as reader:
        rgb = read_rgb_cameras(reader)
    if not (rgb and frames):
        return ()
    with open_log(source, topics=[glob.escape(topic)], output_prefix="/none") as log:
        poses = poses_of(rgb, log.transforms, frames[0].frame_id)
    return image_scores(rgb, poses, frames, model)


def reprojection(
    camera: RgbCamera, pose: Rigid, frames: Sequence[Frame], model: SkeletonModel
) -> Reprojection:
    """Compare the keypoints of a camera with a result.

    Parameters
    ----------
    camera : its lens and what it found. pose : of its optical frame in that of the result.
    frames : the result, interpolated to the time of each image. model : of its skeletons.

    A detection belongs to the person who is nearest in the image, if that is less than
    MATCH_DISTANCE where the person stands; else to nobody.
    """
    slots = shared_markers(model, camera.model)
    names = [camera.model.marker_names[joint] for joint in slots.values()]
    distances, people, unmatched = [np.zeros((0, len(slots)))], 0, 0
    for pixels, true, metre in _views(camera, pose, frames, model, list(slots)):
        found = np.linalg.norm(pixels[None, :, list(slots.values())] - true[:, None], axis=-1)
        far = nan_mean(found / metre[:, None], -1)
        pairs = best_pairs(np.where(far < MATCH_DISTANCE, far, np.inf))
        distances += [found[pair][None] for pair in pairs]
        people, unmatched = people + len(pixels), unmatched + len(pixels) - len(pairs)
    rows = np.concatenate(distances)
    joints = ErrorStats.by_name(names, rows)
    return Reprojection(camera.topic, people, unmatched, ErrorStats.of(rows), joints)


def _views(
    camera: RgbCamera,
    pose: Rigid,
    frames: Sequence[Frame],
    model: SkeletonModel,
    markers: Sequence[int],
) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Yield keypoints (P, J, 2), the result's joints (N, K, 2), and px per metre (N, K) there."""
    known = [frame for frame in frames if (frame.ids != UNTRACKED).any()]
    truth = Truth.of(known or [Frame.empty(0, model)], model)
    to_camera = pose.inverse()
    for start in range(0, len(camera.frames), _CHUNK):
        images = camera.frames[start : start + _CHUNK]
        stamps = np.array([image.stamp for image in images], np.int64)
        points = to_camera.moved(truth.at(stamps)[0][:, :, markers])
        metre = camera.lens.focal / points[..., 2]
        true = camera.lens.pixels(points)
        for image, joints, scale in zip(images, true, metre, strict=True):
            if len(image.pixels):
                yield image.pixels, joints, scale
