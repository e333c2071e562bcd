"""How large the error of a fused joint will be, from the noise of the detectors and the geometry.

The smoother of ``fuse`` is a Wiener filter for each joint (docs/planning.md). At the frequency w,
it assumes the power S_c(w) of the error of camera c, and q / w^4 of the motion. Its weights are

    g_c = (1 / S_c) / (I + w^4 / q),     I = sum of 1 / S_c

If the errors of camera c really have the power A_c(w), the result has

    (sum of A_c / S_c^2  +  w^4 / q) / (I + w^4 / q)^2

of which the second part is motion that was smoothed away. Both sums run over the cameras, so that
a rig is evaluated by adding what each camera contributes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hiros_mcap.body.rotations import Rigid, to_matrix
from hiros_mcap.simulate.body_model import MODEL
from hiros_mcap.simulate.detector import (
    EXTREMITY,
    GUESS_EXTREMITIES,
    REFERENCE_RANGE,
    is_detected,
)
from hiros_mcap.simulate.occlusion import sight_of
from hiros_mcap.simulate.settings import SimulateParams
from hiros_mcap.skeletons import Floats, Stamps
from hiros_mcap.stages.fuse.fuse_params import FuseParams
from hiros_mcap.stages.fuse.fusion_noise import FusionNoise

_SLOWEST = 0.02  # rad/s; what is slower counts as constant
RIGID = 0.49
"""Error after limbs have got constant lengths and poses their prior, to that before: see
benchmarks/planning.py."""
_LIVELY = 1.0
"""Power of ten by which hands and feet are livelier than the trunk: one level of ``fuse``."""
_HIDDEN = 0.5  # s that a joint is hidden: half a stride. A guess is new each time.
MEAN_OF_NORMAL = 2 * np.sqrt(2 / np.pi) / np.sqrt(3)
"""Mean length of a normal error in space, to its root mean square."""


@dataclass(frozen=True, slots=True)
class View:
    """Contribution of one camera, or of several together, to each joint in scenes (n, P)."""

    information: Floats  # (n, P, J, bands) sum of 1 / S_c, s/m2
    error: Floats  # (n, P, J, bands) sum of A_c / S_c^2, of a band's mean
    cameras: Stamps  # (n, P) how many cameras detect the person

    def plus(self, other: View, sign: int = 1) -> View:
        """Return both together, or without the other."""
        return View(
            self.information + sign * other.information,
            self.error + sign * other.error,
            self.cameras + sign * other.cameras,
        )


class ErrorModel:
    """The errors of detectors and poses, what ``fuse`` assumes of them, and how people move."""

    def __init__(self, params: SimulateParams, joints: npt.ArrayLike | None = None) -> None:
        """Take the settings of cameras and detectors; ``joints`` (J,) are the rows that count."""
        self._params = params
        self.joints = np.arange(MODEL.n_markers) if joints is None else np.asarray(joints)
        fuse = FuseParams()
        noise = FusionNoise.default(MODEL, fuse.acceleration, fuse.offset, fuse.offset_time)
        self._noise = noise = noise._replace(
            joints=noise.joints[self.joints],
            accelerations=noise.accelerations[self.joints],
            offsets=noise.offsets[self.joints],
        )
        d, rig = params.detector, params.rig
        lost = params.dropouts * rig.lost_frames
        lost += params.dropouts * d.losses_per_minute / 60 * float(np.mean(d.loss_seconds))
        self._rate = rig.rate * max(1 - lost, 0.01)
        self._edges = np.concatenate([[0.0], np.geomspace(_SLOWEST, np.pi * self._rate, 14)])
        middles = np.sqrt(self._edges[1:] * np.maximum(self._edges[:-1], self._edges[1] / 4))
        lively = noise.accelerations * 10 ** (_LIVELY * EXTREMITY[self.joints])
        self._stiffness = middles**4 / lively[:, None]
        offset = 2 * noise.offsets[:, None] ** 2 * noise.time
        self._offsets = offset / (1 + (middles * noise.time) ** 2)

    def view(self, markers: Floats, pose: Rigid) -> View:
        """Return what a camera at ``pose`` contributes where people (n, P, M, 3), m, are seen."""
        points = (markers - pose.translation) @ to_matrix(pose.xyzw)
        params = self._params
        sight = sight_of(points, params.rig, solid=params.occlusion > 0)
        detected = is_detected(sight)
        guessed = (sight.hidden | ~sight.framed)[..., self.joints] & (params.occlusion > 0)
        distance = np.linalg.norm(points[:, :, 0], axis=-1)
        assumed = self._assumed(distance, guessed)
        information = detected[..., None, None] / assumed
        return View(
            information,
            information / assumed * self._real(distance, guessed),
            detected.astype(np.int64),
        )

    def _assumed(self, distance: Floats, guessed: npt.NDArray[np.bool_]) -> Floats:
        """S_c (n, P, J, bands), m2 s: white noise and an offset that wanders."""
        white = self._noise.white(distance, guessed) / self._rate
        return np.asarray(white[..., None] + self._offsets)

    def _real(self, distance: Floats, guessed: npt.NDArray[np.bool_]) -> Floats:
        """A_c (n, P, J, bands), m2 s, mean of the axes: the detector's errors and the pose's."""
        params, d, rig = self._params, self._params.detector, self._params.rig
        wide = params.noise * (1 + (d.extremities - 1) * EXTREMITY[self.joints])
        far = params.occlusion * (1 + (GUESS_EXTREMITIES - 1) * EXTREMITY[self.joints])
        growth = (distance[..., None] / REFERENCE_RANGE) ** d.range_growth
        slow = -1 / (30 * np.log(max(d.correlation, 1e-6)))
        power = (d.coloured * wide * growth)[..., None] ** 2 * self._wandering(slow)
        power += (d.white * wide * growth)[..., None] ** 2 / self._rate
        power += (d.bias * wide)[:, None] ** 2 * self._wandering(d.bias_seconds)
        hidden = 1 / (1 / d.guess_seconds + 1 / _HIDDEN)
        guess = (far * d.guess)[:, None] ** 2 * self._wandering(hidden)
        power += np.where(guessed[..., None], guess, 0.0)
        # An error of the orientation moves what is seen across two of three axes.
        angle = np.radians(rig.orientation_error) * distance
        constant = params.calibration_error**2 * (rig.position_error**2 + 2 / 3 * angle**2)
        power[..., 0] += constant[..., None] * np.pi / self._edges[1]
        return np.asarray(power)

    def _wandering(self, seconds: float) -> Floats:
        """(bands,) mean power, s, of an error of variance 1 with this time constant."""
        below = 2 * np.arctan(self._edges * seconds)
        return np.diff(below) / np.diff(self._edges)

    def errors(self, view: View) -> Floats:
        """(n, P, J) expected length of the error, m; NaN where no camera sees the person."""
        total = (view.error + self._stiffness) / (view.information + self._stiffness) ** 2
        variance = (total * np.diff(self._edges)).sum(axis=-1) / np.pi
        length = RIGID * MEAN_OF_NORMAL * np.sqrt(3 * variance)
        return np.where(view.cameras[..., None] > 0, length, np.nan)
