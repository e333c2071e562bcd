"""Noise of the detectors: of people who stand still (Malaguti 2019, III-B), and a model of it.

The model is that of white noise by camera, joint, range and confidence: the variance of a joint
along each axis is ``c (f s (r / 2 m)^p k^g)^2``. s is that of the median joint at 2 m, f the
joint's factor, r its distance from the camera, g whether it is guessed, and c the camera's factor.
Slow errors are left out: they do not average out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from hiros_mcap.skeletons import Floats, Frame, SkeletonModel, Stamps

REFERENCE_M = 2.0
GUESSED_BELOW, GUESSED_SHARE = 0.5, 0.75
"""Confidence below which a detector guesses, at most, and as a share of its greatest confidences.
Azure Kinect gives 0.66 to joints that it sees and 0.33 to those that it guesses. A detector that is
never surer than 0.4 does not guess everything."""
LONGEST_S = 0.1
"""Three frames in a row last at most this; motion would count as noise otherwise."""
LEAST_SAMPLES = 30
CHI2_MEDIAN = 2.366
"""Median of chi squared with three degrees of freedom."""
USUAL_POWER = 1.0
"""As the fuser assumes, too, of a log that was not looked at: an error of an angle. With 1.4, as
simulated detectors have whose joints err by themselves, those that err by limbs get 3 % worse."""
BIN = 1.25
"""Ratio of the far to the near end of a range bin."""
WIDE = 1.4
"""Ratio of a camera's ranges from which on they tell the power."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of the detectors, from a log of people who stand still."""

    deviation: float
    """m: SD per axis of a joint, mean over joints, cameras and people; NaN without data."""
    joints: dict[str, float]
    """The same by joint, m."""
    cameras: dict[str, float]
    """The same by camera, m."""
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


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """The measured table; NaN where nothing was measured."""

    sigma: float
    """SD along each axis of the median joint at 2 m, m."""
    power: float
    """The SD grows with this power of the range; the usual one where the ranges do not tell."""
    guessed: float
    """Factor of the SD of joints that the detector guesses; NaN without any."""
    joints: dict[str, float]
    """Factor of the SD of each joint."""
    cameras: dict[str, float]
    """Factor of the variance of each camera."""

    def toml(self) -> str:
        """Return it as the section ``[noise]`` of a configuration."""
        lines = ["[noise]", f"sigma = {self.sigma:.5f}  # m, along each axis at 2 m"]
        lines.append(f"power = {self.power:.2f}  # of the range")
        if not np.isnan(self.guessed):
            # A guess errs slowly, too, which averages out no more than it shows in white noise.
            lines.append(f"# guessed = {self.guessed:.2f}: of white noise only, so it is not used")
        for name, table in (("joints", self.joints), ("cameras", self.cameras)):
            lines += ["", f"[noise.{name}]"]
            lines += [f'"{key}" = {factor:.4g}' for key, factor in table.items()]
        return "\n".join(lines)


def measure_noise_model(
    frames: Iterable[Frame], model: SkeletonModel, places: Mapping[str, Floats]
) -> NoiseModel:
    """Fit the model to the second differences of three frames in a row.

    They cancel position and velocity; people may move slowly.

    Parameters
    ----------
    frames : with ids, in the fixed frame. places : camera -> (3,) its position there, m.
    """
    names = sorted(places)
    rows = _cells(*_differences(frames, model, places, names))
    if rows is None:
        nan = float("nan")
        return NoiseModel(nan, nan, nan, {}, {})
    cells, deviations, counts, log_range = rows
    camera, joint, guessed, _ = cells.T
    # Between cameras, a range cannot be told from the camera's own factor.
    is_wide = max(float(np.ptp(log_range[camera == c])) for c in np.unique(camera)) > np.log(WIDE)
    target = np.log(deviations) - (0.0 if is_wide else USUAL_POWER) * log_range
    n, m = len(names), model.n_markers
    design = np.zeros((len(cells), n + m + 2))
    at = np.arange(len(cells))
    design[at, camera], design[at, n + joint] = 1.0, 1.0
    design[:, n + m] = guessed
    design[:, n + m + 1] = log_range if is_wide else 0.0
    root = np.sqrt(counts)
    fit = np.linalg.lstsq(design * root[:, None], target * root, rcond=None)[0]
    seen_cameras, seen_joints = np.unique(camera), np.unique(joint)
    by_camera, by_joint = fit[:n], fit[n : n + m]
    middle = np.median(by_camera[seen_cameras]), np.median(by_joint[seen_joints])
    return NoiseModel(
        sigma=float(np.exp(sum(middle))),
        power=float(fit[-1]) if is_wide else USUAL_POWER,
        guessed=float(np.exp(fit[-2])) if guessed.any() and not guessed.all() else float("nan"),
        joints={model.marker_names[k]: float(np.exp(by_joint[k] - middle[1])) for k in seen_joints},
        cameras={names[k]: float(np.exp(2 * (by_camera[k] - middle[0]))) for k in seen_cameras},
    )


def _differences(
    frames: Iterable[Frame], model: SkeletonModel, places: Mapping[str, Floats], names: list[str]
) -> tuple[Stamps, Floats, Floats]:
    """Return (N, 3) camera, joint and whether it is guessed, of N second differences.

    Beside them (N,) ranges, m, and (N,) squared lengths over 6, m2: chi squared of 3 times the
    variance along an axis.
    """
    last: dict[tuple[str, int], list[tuple[int, Floats, Floats]]] = {}
    parts: list[list[Floats]] = []
    for frame in frames:
        if frame.source not in places:
            continue
        for row, person in frame.tracked():
            three = last.setdefault((frame.source, person), [])
            three.append((frame.stamp, frame.positions[row], frame.marker_confidences[row]))
            if len(three) < 3:
                continue
            (t0, a, _), (t1, b, confidence), (t2, c, _) = three
            del three[0]
            early, late = (t1 - t0) / 1e9, (t2 - t1) / 1e9
            if not 0.0 < early + late < LONGEST_S or not 0.8 < early / max(late, 1e-9) < 1.25:
                continue
            squares = np.sum((a - 2.0 * b + c) ** 2, axis=1) / 6.0
            pairs = np.flatnonzero(squares > 0.0)  # False for NaN
            ranges = np.linalg.norm(b[pairs] - places[frame.source], axis=1)
            guessed = (confidence[pairs] < GUESSED_BELOW).astype(np.float64)
            camera = np.full(len(pairs), float(names.index(frame.source)))
            parts.append([camera, pairs.astype(np.float64), guessed, ranges, squares[pairs]])
    columns = [np.concatenate(each) for each in zip(*parts, strict=True)] or [np.zeros(0)] * 5
    return np.stack(columns[:3], axis=1).astype(np.int64), columns[3], columns[4]


def _cells(
    kinds: Stamps, ranges: Floats, squares: Floats
) -> tuple[Stamps, Floats, Floats, Floats] | None:
    """Return what is alike in each of K cells, and its SD, m, samples, and log (range / 2 m).

    Camera, joint, guessed and range bin (K, 4) are alike.
    """
    log_ranges = np.log(np.maximum(ranges, 0.1) / REFERENCE_M)
    bins = np.floor(log_ranges / np.log(BIN))
    keys = np.column_stack([kinds, bins.astype(np.int64)])
    cells, owner, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    kept = np.flatnonzero(counts >= LEAST_SAMPLES)
    if not len(kept):
        return None
    order = np.argsort(owner.ravel(), kind="stable")
    groups = np.split(squares[order], np.cumsum(counts)[:-1])
    medians = np.array([np.median(groups[k]) for k in kept])
    middles = np.bincount(owner.ravel(), log_ranges)[kept] / counts[kept]
    return (
        cells[kept],
        np.sqrt(medians / CHI2_MEDIAN),
        counts[kept].astype(np.float64),
        middles,
    )
