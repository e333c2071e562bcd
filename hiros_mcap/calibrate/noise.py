"""Noise of the detectors, from people who stand still (Malaguti 2019, III-B)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from hiros_mcap.skeletons import Floats, Frame, SkeletonModel


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of the detectors, from a log of people who stand still."""

    deviation: float
    """m: SD per axis of a joint, mean over joints, cameras and people; NaN without data."""
    joints: dict[str, float]  # the same by joint, m
    cameras: dict[str, float]  # the same by camera, m
    detections: int


def measure_noise(frames: Iterable[Frame], model: SkeletonModel) -> Noise:
    """Measure how much each joint scatters about its mean, camera by camera.

    The paper takes the standard deviations of all cameras' detections together. Camera by camera,
    the error of the extrinsics does not count as noise: it is the same in every frame. The filter's
    variance is the square of the mean (the paper's text takes the mean itself).

    Parameters
    ----------
    frames : with ids, in the fixed frame; nobody moves.
    model : of the frames.
    """
    poses: dict[tuple[str, int], list[Floats]] = {}
    for frame in frames:
        for row, person in frame.tracked():
            poses.setdefault((frame.source, person), []).append(frame.positions[row])
    table = {key: _scatter(np.stack(each)) for key, each in poses.items() if len(each) > 1}
    every = np.stack(list(table.values())) if table else np.full((1, model.n_markers), np.nan)
    cameras: dict[str, list[Floats]] = {}
    for (camera, _), deviations in table.items():
        cameras.setdefault(camera, []).append(deviations)
    return Noise(
        deviation=_mean(every),
        joints={
            name: _mean(every[:, k])
            for k, name in enumerate(model.marker_names)
            if not np.isnan(every[:, k]).all()
        },
        cameras={camera: _mean(np.stack(rows)) for camera, rows in sorted(cameras.items())},
        detections=sum(len(each) for each in poses.values()),
    )


def _scatter(poses: Floats) -> Floats:
    """(M,) SD per axis of each joint, m; NaN for joints seen less than twice."""
    seen = (~np.isnan(poses[:, :, 0])).sum(axis=0) > 1
    deviations = np.full(poses.shape[1], np.nan)
    deviations[seen] = np.sqrt(np.nanvar(poses[:, seen], axis=0, ddof=1).mean(axis=-1))
    return deviations


def _mean(values: Floats) -> float:
    finite = values[~np.isnan(values)]
    return float(finite.mean()) if finite.size else float("nan")
