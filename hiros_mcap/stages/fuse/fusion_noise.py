"""What the fuser assumes of cameras and joints: defaults, or what a log has shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.errors import ConfigError
from hiros_mcap.skeletons import Floats, SkeletonModel
from hiros_mcap.stages.fuse.fusing import JointNoise, Sightings

FREEDOM = 4.0
"""Degrees of freedom of Student's t: gross outliers count little. 4 to 20 differ by 0 to 4 %."""
_REFERENCE = 2.0  # m; distance at which the white noise of a joint is stated
_EXTREMITIES = ("wrist", "hand", "handtip", "hand_tip", "thumb", "ankle", "foot", "toe", "bigtoe")
_WHITE = 0.007  # m; these and the next: median over simulated logs
_EXTREMITY_FACTOR = 1.7


@dataclass
class FusionNoise:
    """Noise of the cameras and motion of the joints. The defaults suit depth cameras."""

    joints: Floats  # (M,) variance of the white noise at 2 m along each axis, m2
    accelerations: Floats  # (M,) spectral density of the acceleration, m2/s3
    offsets: Floats  # (M,) standard deviation of the slow offset of a camera, m
    time: float = 1.7  # Time constant of the offsets, s
    cameras: dict[str, float] = field(default_factory=dict)
    """Source -> factor of the variances of this camera; 1 where it is missing."""
    power: float = 1.4  # The standard deviation grows with this power of the distance
    guessed: float = 5.5  # Factor of the standard deviation where the detector guesses
    guessed_below: float = 0.5  # Confidence below which the detector guesses
    to_given: Mapping[str, Rigid] = field(default_factory=dict)
    """Source -> what takes its people back to the pose that was given, where it was refined."""

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

    def measured(
        self, model: SkeletonModel, numbers: Mapping[str, float], joints: Mapping[str, float],
        cameras: Mapping[str, float],
    ) -> FusionNoise:  # fmt: skip
        """Return the noise with what ``hiros calibrate noise`` has measured.

        Parameters
        ----------
        numbers : those of sigma, power and guessed that are known. joints : factors of the
            deviation sigma, m. cameras : factors of the variance.

        Raises ConfigError for a joint that the skeleton does not have.
        """
        white = self.joints.copy()
        if "sigma" in numbers:
            white *= (numbers["sigma"] / _WHITE) ** 2
        for name, factor in joints.items():
            if name not in model.marker_names:
                raise ConfigError(
                    f"noise.joints: the skeleton has no joint {name!r} (there are: "
                    f"{', '.join(model.marker_names)})"
                )
            white[model.marker_names.index(name)] = (numbers.get("sigma", _WHITE) * factor) ** 2
        power, guessed = numbers.get("power", self.power), numbers.get("guessed", self.guessed)
        return replace(self, joints=white, cameras=dict(cameras), power=power, guessed=guessed)

    def motion(self, freedom: float = FREEDOM) -> JointNoise:
        """Return the part that the filter takes; the number is that of FuseParams."""
        return JointNoise(self.accelerations, self.offsets**2, self.time, freedom)

    def variances(
        self, views: Sightings, names: Sequence[str], places: Mapping[str, Floats]
    ) -> Floats:
        """(N, M) Variance of the white noise of every measurement along each axis, m2.

        ``names`` are the cameras by index, ``places`` their positions, m, as far as known.
        """
        guesses = np.where(views.confidences < self.guessed_below, self.guessed**2, 1.0)
        cameras = np.array([self.cameras.get(name, 1.0) for name in names])
        near = distances(views, names, places) / _REFERENCE
        scale = cameras[views.cameras] * near ** (2 * self.power)
        return np.ascontiguousarray(self.joints * guesses * scale[:, None])


def distances(views: Sightings, names: Sequence[str], places: Mapping[str, Floats]) -> Floats:
    """(N,) Distance of the people from the camera, m; 2 m where its position is unknown."""
    nowhere = np.full(3, np.nan)
    cameras = np.array([places.get(name, nowhere) for name in names]).reshape(-1, 3)
    seen = ~np.isnan(views.positions[:, :, 0])
    sums = np.where(seen[:, :, None], views.positions, 0.0).sum(axis=1)
    centres = sums / np.maximum(seen.sum(axis=1), 1)[:, None]
    away = np.linalg.norm(centres - cameras[views.cameras], axis=1)
    return np.where(np.isnan(away), _REFERENCE, np.maximum(away, 0.3))
