"""Which cameras are noisier than others, learned on the way.

A causal system starts with equal cameras. Every two seconds, the third differences of each camera's
own stream, which slow motion hardly enters, give a factor of its variances, relative to the median
camera; the mean of those so far counts. The level of the noise stays as assumed: on simulated logs,
a level that was learned gave larger errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hiros_mcap.kernels.array_types import chosen, joined
from hiros_mcap.skeletons import Floats
from hiros_mcap.stages.fuse.fusing import Sightings
from hiros_mcap.stages.fuse.fusion_noise import FusionNoise, distances

_STRETCH = 2_000_000_000  # ns that give one factor of each camera
_BIN = 30  # third differences that give one variance
_BIAS = 0.089  # of the log of a mean over a bin
_PRIOR = 1.0  # stretches; how sure it is beforehand that cameras are equal
_LEAST, _MOST = np.log(0.5), np.log(20.0)  # of a factor; a detector that filters hides its noise


@dataclass
class RunningNoise(FusionNoise):
    """Noise whose factors of the cameras follow what they have shown so far."""

    held: list[Sightings] = field(default_factory=list)
    """Views of the current stretch, which nothing was learned from."""
    next_instant: int = 0
    logs: dict[str, float] = field(default_factory=dict)
    """Source -> sum of the logarithms of its factors."""
    counts: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, noise: FusionNoise) -> RunningNoise:
        """Start from ``noise``."""
        return cls(**vars(replace(noise, cameras=dict(noise.cameras))))

    def variances(
        self, views: Sightings, names: Sequence[str], places: Mapping[str, Floats]
    ) -> Floats:
        """Do what :meth:`FusionNoise.variances` does, after learning from views that are new.

        Instants are numbered through the log; a view comes again for as long as it is needed.
        """
        new = chosen(views, views.instants >= self.next_instant)
        if len(new.instants):
            self.next_instant = int(new.instants[-1]) + 1
            self.held.append(new)
            if new.stamps[-1] - self.held[0].stamps[0] >= _STRETCH:
                self._learn(joined(self.held), names, places)
                self.held = []
        return super().variances(views, names, places)

    def _learn(self, views: Sightings, names: Sequence[str], places: Mapping[str, Floats]) -> None:
        away = np.log(distances(views, names, places) / 2.0)
        offsets_of: dict[str, list[float]] = {}
        for camera, logs, distance, guesses in _binned(views, away, self.guessed_below):
            expected = np.log(self.joints) + 2 * self.power * distance
            off = np.where(guesses == 0, logs - expected, np.nan)
            if np.isfinite(off).any():
                offsets_of.setdefault(names[camera], []).append(float(np.nanmedian(off)))
        factors = {name: float(np.mean(logs)) for name, logs in offsets_of.items()}
        usual = float(np.median(list(factors.values()))) if factors else 0.0
        for name, log in factors.items():
            self.logs[name] = self.logs.get(name, 0.0) + log - usual
            self.counts[name] = self.counts.get(name, 0) + 1
        for name, total in self.logs.items():
            mean = np.clip(total / (self.counts[name] + _PRIOR), _LEAST, _MOST)
            self.cameras[name] = float(np.exp(mean))


def _binned(
    views: Sightings, away: Floats, guessed_below: float
) -> Iterator[tuple[int, Floats, float, Floats]]:
    """Yield camera, (M,) log variances, log distance / 2 m and (M,) share of guesses of bins."""
    for person, camera in {*zip(views.people.tolist(), views.cameras.tolist(), strict=True)}:
        rows = np.flatnonzero((views.people == person) & (views.cameras == camera))
        rows = rows[np.argsort(views.stamps[rows], kind="stable")]
        gaps = np.diff(views.stamps[rows])
        if len(rows) < _BIN + 3:
            continue
        even = np.abs(gaps / np.median(gaps) - 1) < 0.3
        # Half of the norm has the mean of |D| along an axis, and does not depend on the axes.
        third = np.linalg.norm(np.diff(views.positions[rows], n=3, axis=0), axis=2) / 2
        third[~(even[:-2] & even[1:-1] & even[2:])] = np.nan
        guesses = views.confidences[rows] < guessed_below
        for start in range(0, len(third) - _BIN + 1, _BIN):
            part = third[start : start + _BIN]
            finite = np.isfinite(part)
            enough = (finite.sum(axis=0) >= _BIN // 2) & (np.nan_to_num(part).sum(axis=0) > 0)
            mean = np.nan_to_num(part).sum(axis=0) / np.maximum(finite.sum(axis=0), 1)
            logs = np.full(len(mean), np.nan)
            # The mean of |D| of a normal D with variance 20 R is sqrt(40 R / pi).
            logs[enough] = np.log(mean[enough] ** 2 * np.pi / 40) + _BIAS
            share = guesses[start : start + _BIN + 3].mean(axis=0)
            yield camera, logs, float(away[rows[start : start + _BIN]].mean()), share
