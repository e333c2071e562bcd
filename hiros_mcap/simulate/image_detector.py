"""An RGB camera's detector: the keypoints of the people in its image.

It finds, confuses, loses and guesses people as a detector of joints in space does
(:mod:`~hiros_mcap.simulate.detector`), but its errors are in the image. The detector "ideal" has
white noise, errors of two time constants, and outliers; of the detector "kinect", the limbs err as
a whole, and the noise of a keypoint is white. Joints blur with motion, and are absent outside of
the image, where the detector misses them, and of hidden ones where it does not guess.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.intrinsics import PLUMB_BOB, Intrinsics
from hiros_mcap.body.rotations import rotate
from hiros_mcap.io.detectors.body_models import body_model, joints_of
from hiros_mcap.simulate.body_model import MARKERS, SLOT
from hiros_mcap.simulate.cameras import SimulatedCamera, stream
from hiros_mcap.simulate.chance import coloured
from hiros_mcap.simulate.detector import SimulatedDetections, detect
from hiros_mcap.simulate.motion import Person
from hiros_mcap.simulate.occlusion import Mask
from hiros_mcap.simulate.settings import ImageParams, SimulateParams
from hiros_mcap.skeletons import Floats, SkeletonModel, Stamps

_SCALE = 275.0  # px per metre, for which the deviations are given
_DISTORTION = (-0.1, 0.04, 0.0005, -0.0005, 0.0)  # of a plumb_bob lens
_RANGE = (0.5, 20.0)  # m; nearest and farthest people seen
_QUICK_SECONDS, _SLOW_SECONDS = 0.3, 5.0  # time constants of errors
_OUTLIER = 60.0  # px; SD of outliers, per axis
_MISSING = 0.05  # share of keypoints in view that are not found
_HIDDEN_MISSING = 0.4  # share of hidden joints that are not found; the others are guessed
_SCORE_SEEN, _SCORE_GUESSED, _SCORE_SPREAD = 0.85, 0.4, 0.1  # means, SD
_LEAST_SCORE = 0.05
_FEET = {  # Joint -> the marker that it is fixed to, x forward, y up, z to the outside, m
    "bigtoe": ("FOOT", (0.035, -0.005, -0.015)),
    "smalltoe": ("FOOT", (0.005, -0.01, 0.045)),
    "heel": ("ANKLE", (-0.045, -0.055, 0.0)),
}


class SimulatedKeypoints(NamedTuple):
    """The report of P detections of J joints in n images."""

    pixels: Floats  # (n, P, J, 2) px; NaN where a joint was not found
    scores: Floats  # (n, P, J) 0 to 1
    present: Mask  # (n, P) whether the person is reported at all

    def image(self, k: int) -> tuple[Floats, Floats]:
        """Pixels (P, J, 2) and scores (P, J) of one image, those with the best scores first."""
        there = np.flatnonzero(self.present[k])
        there = there[np.argsort(-self.scores[k, there].mean(axis=-1), kind="stable")]
        return self.pixels[k, there], self.scores[k, there]


def lens_of(image: ImageParams) -> Intrinsics:
    """Return the lens of all RGB cameras; the principal point is the middle of the image."""
    width, height = image.size
    matrix = np.array(
        [[image.focal, 0, (width - 1) / 2], [0, image.focal, (height - 1) / 2], [0, 0, 1]]
    )
    return Intrinsics(image.size, matrix, np.array(_DISTORTION), PLUMB_BOB)


def detect_keypoints(
    people: Sequence[Person], camera: SimulatedCamera, params: SimulateParams
) -> SimulatedKeypoints:
    """Return everything that an RGB camera reports, in its nominal frames."""
    lens = lens_of(params.image)
    bodies = detect(people, camera, _without_noise(params, lens))
    points, marker = _joints(bodies, body_model(params.image.joints))
    guessed = bodies.guessed[..., marker]
    pixels = _with_errors(lens, points, camera, params)
    scores = _scores(guessed, camera, params)
    found = _is_found(guessed, camera, params) & _is_inside(lens, points, pixels)
    pixels[~found], scores[~found] = np.nan, 0.0
    return SimulatedKeypoints(pixels, scores, bodies.present & found.any(axis=-1))


def _without_noise(params: SimulateParams, lens: Intrinsics) -> SimulateParams:
    """Return the parameters of a detector that sees what is in the image, without joint noise."""
    width, height = lens.size
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], np.float64)
    half = np.abs(lens.normalized(corners)).max(axis=0)
    fov = tuple(np.degrees(2 * np.arctan(half)).tolist())
    rig = params.rig.model_copy(update={"fov": fov, "range": _RANGE})
    quiet = {"coloured": 0.0, "white": 0.0, "bias": 0.0}
    detector = params.detector.model_copy(update=quiet)
    return params.model_copy(update={"rig": rig, "detector": detector})


def _joints(bodies: SimulatedDetections, model: SkeletonModel) -> tuple[Floats, Stamps]:
    """(n, P, J, 3) joints in the camera's coordinates, m, and (J,) the marker each is fixed to."""
    own = {joint: SLOT[name] for name, joint in zip(MARKERS, joints_of(MARKERS), strict=True)}
    markers, offsets = [], []
    for part, side in joints_of(model.marker_names):
        name, offset = _FEET.get(part, (part, (0.0, 0.0, 0.0)))
        markers.append(own[joints_of([name])[0][0], side])
        offsets.append(np.array(offset) * (1, 1, 1 if side == "right" else -1))
    points = bodies.positions[..., markers, :]
    for joint in np.flatnonzero(np.any(offsets, axis=-1)):
        turned = rotate(bodies.orientations[..., markers[joint] - 1, :], offsets[joint])
        points[..., joint, :] += turned
    return points, np.array(markers)


def _with_errors(
    lens: Intrinsics, points: Floats, camera: SimulatedCamera, params: SimulateParams
) -> Floats:
    """(n, P, J, 2) px where the detector puts joints (n, P, J, 3), m."""
    image, rate = params.image, params.rig.rate
    pixels = lens.pixels(points)
    rng = stream(params.seed, "image errors", camera.index)
    size = (lens.focal / _SCALE / np.maximum(points[..., 2:], _RANGE[0])) * params.noise
    errors = image.white * size * rng.standard_normal(pixels.shape)
    errors += image.pixel * params.noise * rng.standard_normal(pixels.shape)
    streak = np.diff(pixels, axis=0, prepend=pixels[:1]) * rate * image.exposure
    errors += params.noise * streak * rng.uniform(-0.5, 0.5, (*pixels.shape[:-1], 1))
    if params.detector.kind == "ideal":
        for sd, seconds in ((image.quick, _QUICK_SECONDS), (image.slow, _SLOW_SECONDS)):
            errors += sd * size * coloured(rng, pixels.shape, float(np.exp(-1 / (rate * seconds))))
        rng = stream(params.seed, "outliers", camera.index)
        far = rng.random(pixels.shape[:-1]) < image.outliers
        errors[far] += (_OUTLIER * size * rng.standard_normal(pixels.shape))[far]
    return np.asarray(pixels + errors)


def _scores(guessed: Mask, camera: SimulatedCamera, params: SimulateParams) -> Floats:
    """(n, P, J) how sure the detector is of joints, the ``guessed`` ones among them."""
    rng = stream(params.seed, "scores", camera.index)
    mean = np.where(guessed, _SCORE_GUESSED, _SCORE_SEEN)
    scores = mean + _SCORE_SPREAD * rng.standard_normal(guessed.shape)
    return np.asarray(np.clip(scores, _LEAST_SCORE, 1.0))


def _is_found(guessed: Mask, camera: SimulatedCamera, params: SimulateParams) -> Mask:
    """(n, P, J) whether joints are reported; a hidden one is guessed or not for a while."""
    rng = stream(params.seed, "missing", camera.index)
    found: Mask = rng.random(guessed.shape) >= min(1.0, params.dropouts * _MISSING)
    lasts = float(np.exp(-1 / (params.rig.rate * params.detector.guess_seconds)))
    missed = coloured(rng, guessed.shape, lasts) < NormalDist().inv_cdf(_HIDDEN_MISSING)
    return found & ~(guessed & missed)


def _is_inside(lens: Intrinsics, points: Floats, pixels: Floats) -> Mask:
    """(n, P, J) whether joints, and where the detector puts them, are in the image.

    Far outside of it, models of distortion lead back into it.
    """
    width, height = lens.size
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], np.float64)
    widest = 1.1 * np.linalg.norm(lens.normalized(corners), axis=-1).max()
    before = np.linalg.norm(points[..., :2], axis=-1) < widest * points[..., 2]
    inside: Mask = before & ((pixels >= 0) & (pixels < (width, height))).all(axis=-1)
    return inside
