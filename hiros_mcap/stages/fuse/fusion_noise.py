"""The noise of cameras and joints that the fuser assumes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.symmetry import split_side
from hiros_mcap.rays.keypoints import TRIANGULATED, variance_of
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel
from hiros_mcap.stages.detections.visibility import GUESSED_BELOW, GUESSED_SHARE
from hiros_mcap.stages.fuse.fuse_params import FuseParams
from hiros_mcap.stages.fuse.fusing import REFERENCE, JointNoise, Sightings
from hiros_mcap.stages.fuse.outliers import parents_first

_ELSEWHERE = 15.0
"""1/m3, beside Student's t without its constant factor, which is .075: outliers lie within a sphere
of .6 m. With 50, realistic logs lose 1 % of their error, and a crowd whose joints are mostly
guessed gets 2 % more."""
_EXTREMITIES = ("wrist", "hand", "handtip", "hand_tip", "thumb", "ankle", "foot", "toe", "bigtoe")
_WHITE = 0.008  # m; at 2 m. Of simulated logs, .007 to .009 are alike within .1 mm
_EXTREMITY_FACTOR = 1.7
_POWER = 1.0
"""Of the distance: an error of an angle. With 1.4, as simulated detectors have whose joints err by
themselves, those that err by limbs get 3 % worse."""
_GUESSED = 8.0  # factor of the standard deviation where the detector guesses


class FusionNoise(NamedTuple):
    """Noise of the cameras and motion of the joints. The defaults suit depth cameras."""

    joints: Floats  # (M,) variance of the white noise at 2 m along each axis, m2
    accelerations: Floats  # (M,) spectral density of the acceleration, m2/s3
    offsets: Floats  # (M,) standard deviation of the slow offset of a camera, m
    time: float = 1.7  # time constant of the offsets, s

    @classmethod
    def default(
        cls, model: SkeletonModel, acceleration: float = 3.0, offset: float = 0.01,
        time: float = 1.7,
    ) -> FusionNoise:  # fmt: skip
        """Return what is assumed of a log that was not looked at: m2/s3, m, s."""
        names = [split_side(name)[0] for name in model.marker_names]
        factors = np.array([_EXTREMITY_FACTOR if n in _EXTREMITIES else 1.0 for n in names])
        m = model.n_markers
        white = (_WHITE * factors) ** 2
        return cls(white, np.full(m, acceleration), np.full(m, offset), time)

    def motion(self, model: SkeletonModel, params: FuseParams) -> JointNoise:
        """Return the part that the filter takes."""
        return JointNoise(
            self.accelerations, self.offsets**2, self.time, params.freedom, _ELSEWHERE,
            params.outliers_last, *parents_first(model),
        )  # fmt: skip

    def white(self, distances: Floats, guessed: Flags) -> Floats:
        """(..., M) Variance of the white noise along each axis, m2: the law.

        ``distances`` are (...), ``guessed`` is (..., M).
        """
        scale = (distances / REFERENCE) ** (2 * _POWER)
        factors = np.where(guessed, _GUESSED**2, 1.0)
        return np.asarray(self.joints * factors * scale[..., None])

    def variances(
        self, views: Sightings, names: Sequence[str], *, by_instant: bool = False
    ) -> Floats:
        """(N, M) Variance of every measurement along each axis, m2.

        ``names`` are the cameras by index. ``by_instant``: what a detector guesses is told by its
        views of the same instant alone.
        """
        white = self.white(views.distances, _guessed(views, by_instant=by_instant))
        if TRIANGULATED in names:
            stated = views.cameras == list(names).index(TRIANGULATED)
            white[stated] = variance_of(views.confidences[stated])
        return white + views.hidden

    def sees(self, views: Sightings) -> Flags:
        """(N, M) Whether a camera sees a joint: nobody hides it, and it is not guessed."""
        there = ~np.isnan(views.positions[:, :, 0])
        return np.asarray(there & ~_guessed(views) & (views.hidden == 0))


def _guessed(views: Sightings, *, by_instant: bool = False) -> Flags:
    """(N, M) Whether the detector guesses a joint, by all views of a camera, or of an instant."""
    groups = views.cameras
    if by_instant and len(groups):
        groups = groups + (views.instants - views.instants[0]) * (groups.max() + 1)
    best = np.fmax.reduce(views.confidences, axis=1, initial=0.0)
    means = np.bincount(groups, best) / np.maximum(np.bincount(groups), 1)
    limits = np.minimum(GUESSED_BELOW, GUESSED_SHARE * means)
    return np.asarray(views.confidences < limits[groups, None])
