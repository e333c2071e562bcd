"""The noise of cameras and joints for the fuser: as assumed, or as the log so far shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from hiros_mcap.body.symmetry import split_side
from hiros_mcap.kernels.array_types import chosen, joined
from hiros_mcap.rays.confidence import TRIANGULATED, variance_of
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel, Stamps
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

# Of RunningNoise.
_STRETCH = 2_000_000_000  # ns that give one factor of each camera
_BIN = 30  # third differences that give one variance
_BIAS = 0.089  # of the log of a mean over a bin
_PRIOR = 1.0  # stretches; how sure it is beforehand that cameras are equal
_LEAST, _MOST = np.log(0.5), np.log(20.0)  # of a factor; a detector that filters hides its noise


@dataclass
class FusionNoise:
    """Noise of the cameras and motion of the joints. The defaults suit depth cameras."""

    joints: Floats  # (M,) variance of the white noise at 2 m along each axis, m2
    accelerations: Floats  # (M,) spectral density of the acceleration, m2/s3
    offsets: Floats  # (M,) standard deviation of the slow offset of a camera, m
    time: float = 1.7  # time constant of the offsets, s
    cameras: dict[str, float] = field(default_factory=dict)
    """Source -> factor of the variances of this camera; 1 where it is missing."""
    power: float = _POWER  # the standard deviation grows with this power of the distance
    guessed: float = 8.0  # factor of the standard deviation where the detector guesses

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

    def white(
        self, distances: Floats, guessed: npt.NDArray[np.bool_], cameras: Floats | float = 1.0
    ) -> Floats:
        """(..., M) Variance of the white noise along each axis, m2: the law.

        ``distances`` and the factors ``cameras`` are (...), ``guessed`` is (..., M).
        """
        scale = cameras * (distances / REFERENCE) ** (2 * self.power)
        factors = np.where(guessed, self.guessed**2, 1.0)
        return np.asarray(self.joints * factors * scale[..., None])

    def take(self, views: Sightings) -> None:
        """Take views that come once: nothing is learned from them."""

    def learn(self, names: Sequence[str]) -> None:
        """Let the noise be as the views so far show: it stays as it is."""

    def variances(
        self, views: Sightings, names: Sequence[str], *, by_instant: bool = False
    ) -> Floats:
        """(N, M) Variance of every measurement along each axis, m2.

        ``names`` are the cameras by index. ``by_instant``: what a detector guesses is told by its
        views of the same instant alone.
        """
        cameras = np.array([self.cameras.get(name, 1.0) for name in names])[views.cameras]
        guessed = _guessed(views, by_instant=by_instant)
        white = self.white(views.distances, guessed, cameras)
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


@dataclass
class RunningNoise(FusionNoise):
    """Noise whose factors of the cameras follow what they have shown so far.

    A causal system starts with equal cameras. Every two seconds or somewhat more, the third
    differences of each camera's stream, which slow motion hardly enters, give a factor of its
    variances, relative to the median camera; the mean of those so far counts. The level of the
    noise stays as assumed: on simulated logs, a level that was learned gave larger errors.
    """

    held: list[Sightings] = field(default_factory=list)
    """Views of the current stretch, which nothing was learned from."""
    logs: dict[str, float] = field(default_factory=dict)
    """Source -> sum of the logarithms of its factors."""
    counts: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, noise: FusionNoise) -> RunningNoise:
        """Start from ``noise``."""
        return cls(**vars(replace(noise, cameras=dict(noise.cameras))))

    def take(self, views: Sightings) -> None:
        """Take views that come once, in the order of instants."""
        if len(views.instants):
            self.held.append(views)

    def learn(self, names: Sequence[str]) -> None:
        """Learn from the views so far, if they are a stretch."""
        if not self.held or self.held[-1].stamps[-1] - self.held[0].stamps[0] < _STRETCH:
            return
        cameras, logs, distances, guesses = _binned(joined(self.held))
        self.held = []
        # The logarithm of :meth:`white`.
        expected = np.log(self.joints) + 2 * self.power * distances[:, None]
        off = np.where(guesses == 0, logs - expected, np.nan)
        known = np.isfinite(off).any(axis=1)
        cameras, middles = cameras[known], np.nanmedian(off[known], axis=1)
        factors = {names[k]: float(middles[cameras == k].mean()) for k in np.unique(cameras)}
        usual = float(np.median(list(factors.values()))) if factors else 0.0
        for name, log in factors.items():
            self.logs[name] = self.logs.get(name, 0.0) + log - usual
            self.counts[name] = self.counts.get(name, 0) + 1
        for name, total in self.logs.items():
            mean = np.clip(total / (self.counts[name] + _PRIOR), _LEAST, _MOST)
            self.cameras[name] = float(np.exp(mean))


def _binned(views: Sightings) -> tuple[Stamps, Floats, Floats, Floats]:
    """Return what B bins of _BIN views of a person by a camera tell.

    (B,) cameras, (B, M) log variances, (B,) log distances / 2 m and (B, M) shares of guesses.
    """
    order = np.lexsort((views.stamps, views.cameras, views.people))
    views = chosen(views, order)
    changes = (np.diff(views.people) != 0) | (np.diff(views.cameras) != 0)
    gaps, even = np.diff(views.stamps), np.zeros(len(changes), np.bool_)
    starts = list[int]()
    for begin, end in pairwise([0, *(np.flatnonzero(changes) + 1).tolist(), len(order)]):
        if end - begin >= _BIN + 3:
            own = gaps[begin : end - 1]
            even[begin : end - 1] = np.abs(own / np.median(own) - 1) < 0.3
            starts += range(begin, end - _BIN - 2, _BIN)
    # Half of the norm has the mean of |D| along an axis, and does not depend on the axes.
    third = np.linalg.norm(np.diff(views.positions, n=3, axis=0), axis=2) / 2
    third[~(even[:-2] & even[1:-1] & even[2:])] = np.nan
    hidden = views.hidden > 0
    third[hidden[:-3] | hidden[1:-2] | hidden[2:-1] | hidden[3:]] = np.nan
    guesses = _guessed(views)
    rows = np.array(starts, np.int64)[:, None] + np.arange(_BIN + 3)
    parts = third[rows[:, :_BIN]]
    counts, sums = np.isfinite(parts).sum(axis=1), np.nansum(parts, axis=1)
    enough = (counts >= _BIN // 2) & (sums > 0)
    means = np.where(enough, sums, np.nan) / np.maximum(counts, 1)
    # The mean of |D| of a normal D with variance 20 R is sqrt(40 R / pi).
    logs = np.log(means**2 * np.pi / 40) + _BIAS
    away = np.log(views.distances / REFERENCE)[rows[:, :_BIN]].mean(axis=1)
    return views.cameras[rows[:, 0]], logs, away, guesses[rows].mean(axis=1)
