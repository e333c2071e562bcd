"""How far the cameras' measurements are from the fused poses, against what the model expects.

A measurement is z = x + b + w, with a slow offset b of variance B and white noise w of variance R.
The error of the best estimate x_s, of variance P_s, is uncorrelated with every measurement that it
used (principle of orthogonality, Bar-Shalom et al. 2001, section 3.3.1). So

    var(z - x_s) = R + B - P_s

holds for a smoother, and for a filter with any look-ahead. |z - x_s|^2 over this variance has a
chi-square distribution with three degrees of freedom if the model is right.

Its square root tells how much cameras scatter. The error of the result is measured by what lasts:
x_s has the weighted mean of the errors of all cameras. If these are independent, and a camera has
the share s of the weight, its residual varies by

    P_s (1 / s - 1)

whatever the law of its errors, where both are means over so long a moment as the smoother averages.
A camera that now and then puts a limb elsewhere draws the result with it: 80 % of the residuals,
not half of them, are as large as expected.
What the residuals of a body's joints have in common is left out: it is the error of the camera's
pose or clock, which the standard deviations hold already. So are joints that a camera guesses: they
hardly count in the result. How much larger or smaller the rest is than expected is the factor of
the standard deviations: of each camera, and of each joint as far as it was seen.

Joints that the rays of RGB cameras give have nobody else to be compared with, but a variance V that
how their rays miss each other tells. It is of all their errors: those that scatter, which average
out, and those that last, which the result has. The first are what their residuals show. So the
result varies by V less the square of a usual residual.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiros_mcap.calibrate.gauge import CHI2_3_MEDIAN
from hiros_mcap.events import COMMON, RESIDUAL, Events
from hiros_mcap.frames import Block, together
from hiros_mcap.kernels.array_types import chosen
from hiros_mcap.rays.keypoints import TRIANGULATED
from hiros_mcap.skeletons import POSITION, VELOCITY, Floats, Ints, Stamps
from hiros_mcap.stages.fuse.fusing import Sightings, joined_out_of
from hiros_mcap.stages.fuse.fusion_noise import FusionNoise
from hiros_mcap.stages.fuse.window_smoother import BATCH, Smoothed

FEWEST = 50  # residuals that give a median
_EVERY = 2  # moments; neighbours tell much the same, and views take much memory
_MEMORY = 60.0  # s; time constant of the mean of a camera's residuals
_LOWEST, _HIGHEST, _PER_OCTAVE = -14, 14, 8
"""Of histograms: log2 of the limits, and bins per factor of 2."""
_BINS = (_HIGHEST - _LOWEST) * _PER_OCTAVE
_FEWEST_JOINTS = 5  # of a body
_MOMENT = 300_000_000  # ns; errors that last for less average out, in the smoother as here
_SHARE, _CHI2_3 = 0.8, 4.64163
"""A share of the residuals, and the quantile of the chi-square distribution with three degrees."""
_ALONE = 0.9  # of the weight: the result follows such a camera, and shows nothing of its error
_LEAST = 0.7  # least factor of the standard deviations: a detector that filters hides its noise


class ResidualMeter:
    """Compares the fused poses with what went into them, a batch of frames at a time.

    Parameters
    ----------
    noise : what the fuser assumes. events : gets a histogram of every camera.
    mirror : (M,) slot of the same joint on the other side: both are as hard to see.
    causal : whether the poses are those of a filter.
    """

    def __init__(
        self, noise: FusionNoise, events: Events, mirror: Ints, *, causal: bool = False
    ) -> None:
        self._is_causal = causal
        self._noise, self._events, self._mirror = noise, events, mirror
        self._held: list[Smoothed] = []  # not yet compared
        self._recent: dict[str, Floats] = {}
        """Camera -> histograms (M, B) of its residuals, of which the old ones count less."""
        self._ratios: dict[str, Floats] = {}
        """Camera -> (M,) size of these as a multiple of the expected one."""
        self._stated = np.zeros(1), np.zeros(1)
        """Histograms (M, B), of joints from rays: squared residual over stated variance; stated
        variance over that of the result."""
        self._last: int | None = None
        self._waiting = 0  # frames in ``_held``

    def compared(self, windows: Iterable[Smoothed]) -> Iterator[Block]:
        """Take the next frames, one for each instant; yield them as :meth:`scaled`.

        Those of a filter are scaled by what the batches before have shown.
        """
        for smoothed in windows:
            fused = smoothed.frames
            used = (smoothed.rows >= 0) & (smoothed.views.stamps // _MOMENT % _EVERY == 0)
            views, rows = chosen(smoothed.views, used), smoothed.rows[used]
            self._held.append(smoothed._replace(views=views, rows=rows))
            self._waiting += len(fused)
            if self._is_causal:
                yield self.scaled(fused)
            if self._waiting >= BATCH:
                self.finish()
            if not self._is_causal:
                yield self.scaled(fused)
            del fused, smoothed  # else they lie in memory until the next ones are made

    def finish(self) -> None:
        """Count what was fused so far."""
        if not self._waiting:
            return
        held, self._held, self._waiting = self._held, [], 0
        people = np.cumsum([0, *(part.frames.sizes.sum() for part in held)])
        rows = [part.rows + first for part, first in zip(held, people[:-1], strict=True)]
        views = joined_out_of([part.views for part in held])
        fused = together([part.frames for part in held])
        self._count(fused, views, np.concatenate(rows), held[-1].names)

    def scaled(self, fused: Block) -> Block:
        """Return a block whose uncertainty allows for how much the cameras scatter.

        The variance of a marker is multiplied by the mean of the squared factors of the cameras
        that saw it.
        """
        uncertainty = fused.uncertainty
        if uncertainty is None or not self._ratios:
            return fused
        unknown = np.full(len(self._mirror), math.nan)
        sizes = np.array([self._ratios.get(name, unknown) for name in uncertainty.names])
        factors = np.maximum(np.nan_to_num(sizes, nan=1.0), _LEAST) ** 2
        count, total = sums_over_cameras(uncertainty.cameras, factors)
        factor = np.where(count > 0, total / np.maximum(count, 1), factors.mean(axis=0))
        return restated(fused, factor * (uncertainty.deviations**2 - uncertainty.shared**2))

    def _count(self, fused: Block, views: Sightings, rows: Stamps, names: tuple[str, ...]) -> None:
        """Add the residuals of views of people, by ``rows``, to the histograms of the cameras."""
        uncertainty = fused.uncertainty
        if uncertainty is None or not len(rows):
            return
        sees = self._noise.sees(views)  # before positions become residuals
        residuals = _residuals(views, fused, rows)
        posterior = uncertainty.deviations[rows] ** 2 - uncertainty.shared[rows] ** 2
        white = self._noise.variances(views, names)
        variances = white + self._noise.offsets**2 - posterior
        # An estimate that no measurement supports is as uncertain as the measurement.
        variances[variances <= 0.1 * white] = np.nan
        squares = (residuals**2).sum(axis=2)
        common = _common_share(residuals, squares)
        for k, name in enumerate(names):
            of_camera = views.cameras == k
            counts = histograms((squares[of_camera] / variances[of_camera]).T)
            self._events.tally(RESIDUAL, name, counts)
            self._events.tally(COMMON, name, histograms(common[None, of_camera]))
        # The result does not rest on cameras that are outvoted, or displaced.
        weights = 1 / (white + self._noise.offsets**2 + views.outvoted)
        there = ~np.isnan(views.positions[:, :, 0])
        total = np.zeros((rows.max() + 1, weights.shape[1]))
        order, begins = _grouped(rows[None])
        total[rows[order[begins]]] = _sums(np.where(there, weights, 0.0)[order], begins)
        shares = np.where(there, weights, np.nan) / np.where(total > 0, total, np.nan)[rows]
        expected = posterior * (1 / shares - 1)
        expected[~sees | (shares > _ALONE) | (views.outvoted > 0)] = np.nan
        keep = self._kept(int(fused.stamps[-1]))
        self._remember(views, residuals, expected, keep, names)
        if TRIANGULATED in names:
            of_rays = (views.cameras == names.index(TRIANGULATED))[:, None] & (views.outvoted == 0)
            stated = np.where(of_rays & there, white, np.nan)
            self._believe(squares / stated, stated / posterior, keep)

    def _kept(self, stamp: int) -> float:
        """Return how much of the histograms until the last call still counts at ``stamp``, ns."""
        passed = stamp - (stamp if self._last is None else self._last)
        self._last = stamp
        return float(np.exp(-max(passed, 0) * 1e-9 / _MEMORY))

    def _believe(self, shown: Floats, stated: Floats, keep: float) -> None:
        """Let joints from rays err by what they state, but for what shows in their residuals.

        ``shown`` (N, M) are squared residuals over stated variances, ``stated`` (N, M) these over
        the variance of the result. Where other cameras tell their errors, those count.
        """
        new = histograms(shown.T), histograms(stated.T)
        self._stated = new[0] + keep * self._stated[0], new[1] + keep * self._stated[1]
        # Half of the residuals: those that are far off hardly count in the result.
        scatters = self._of_joints(self._stated[0], 0.5, CHI2_3_MEDIAN) ** 2
        whole = self._of_joints(self._stated[1], _SHARE, 1.0) ** 2
        lasting = np.sqrt(np.maximum((1 - scatters) * whole, 1.0))
        compared = self._ratios[TRIANGULATED]
        self._ratios[TRIANGULATED] = np.where(np.isnan(compared), lasting, compared)

    def _remember(
        self, views: Sightings, residuals: Floats, expected: Floats, keep: float,
        names: tuple[str, ...],
    ) -> None:  # fmt: skip
        """Add the means of residuals (N, M, 3) over a moment to the cameras' histograms.

        ``expected`` (N, M), m2, are their variances; where it is NaN, a residual does not count.
        Of the histograms so far, the share ``keep`` counts.
        """
        keys = np.stack([views.cameras, views.people, views.stamps // _MOMENT])
        order, begins = _grouped(keys)
        residuals, expected = residuals[order], expected[order]
        there = ~np.isnan(residuals[:, :, 0] + expected)
        count = _sums(there, begins)
        mean = _sums(np.where(there[:, :, None], residuals, 0.0), begins)
        variance = _sums(np.where(there, expected, 0.0), begins)
        n = np.where(count > 0, count, np.nan)
        joints = np.count_nonzero(count, axis=1, keepdims=True)
        n[joints.ravel() < _FEWEST_JOINTS] = np.nan
        mean /= n[:, :, None]
        mean -= np.nansum(mean, axis=1, keepdims=True) / np.maximum(joints, 1)[:, :, None]
        squares = (mean**2).sum(axis=2) / (variance / n * (1 - 1 / np.maximum(joints, 2)))
        cameras = views.cameras[order[begins]]
        for k, name in enumerate(names):
            counts = histograms(squares[cameras == k].T)
            recent = self._recent[name] = counts + keep * self._recent.get(name, np.zeros(1))
            self._ratios[name] = self._of_joints(recent)

    def _of_joints(self, counts: Floats, share: float = _SHARE, usual: float = _CHI2_3) -> Floats:
        """(M,) Ratios of the joints of a camera: that of all joints until they show their own.

        Each is the root of the value that a ``share`` is below, over the ``usual`` one.
        """
        both = counts + counts[self._mirror]
        shown = counts.sum(axis=1) + counts[self._mirror].sum(axis=1)
        (whole,) = quantiles(counts.sum(axis=0, keepdims=True), share, FEWEST)
        joints = np.where(shown > 0, quantiles(both, share, 1), whole)
        weight = shown / (shown + FEWEST)
        return np.asarray(np.sqrt(whole ** (1 - weight) * joints**weight / usual))


def ratios(counts: NDArray[Any]) -> Floats:
    """(K,) Size of residuals as a multiple of the expected one, from histograms (K, B)."""
    return np.sqrt(medians(counts, FEWEST) / CHI2_3_MEDIAN)


def sums_over_cameras(cameras: Stamps, values: Floats) -> tuple[Stamps, Floats]:
    """(P, M) How many cameras saw each marker, and the sum of their ``values``.

    ``cameras`` (P, M) has a bit for each camera, ``values`` are (C, M). One is added after the
    other: all at once would take C times the memory.
    """
    count, total = np.zeros(cameras.shape, np.int64), np.zeros(cameras.shape)
    for k, value in enumerate(values):
        sees = (cameras >> k) & 1
        count += sees
        total += sees * value
    return count, total


def restated(fused: Block, variances: Floats) -> Block:
    """Return a block whose markers have other ``variances`` (P, M), m2, and confidences."""
    uncertainty, people = fused.uncertainty, fused.people
    if uncertainty is None:
        return fused
    total = variances + uncertainty.shared**2
    confidences = people.marker_confidences
    # 1 / c - 1 is proportional to the variance.
    confidences = 1 / (1 + (1 / confidences - 1) * total / uncertainty.deviations**2)
    there = ~np.isnan(confidences)
    count = there.sum(axis=1)
    whole = np.where(there, confidences, 0.0).sum(axis=1) / np.maximum(count, 1)
    people = people._replace(
        marker_confidences=confidences, confidences=np.where(count > 0, whole, np.nan)
    )
    return replace(
        fused, people=people, uncertainty=uncertainty._replace(deviations=np.sqrt(total))
    )


def _residuals(views: Sightings, fused: Block, rows: Stamps) -> Floats:
    """(N, M, 3) Residuals, m, of views against rows (N,) of a block; written over the views."""
    late = (views.stamps - fused.people.stamps[rows]) * 1e-9
    expected = fused.people.markers[rows, :, VELOCITY]
    expected *= late[:, None, None]
    expected += fused.people.markers[rows, :, POSITION]
    residuals = views.positions
    residuals -= expected
    return residuals


def _grouped(keys: Stamps) -> tuple[Stamps, Stamps]:
    """(N,) Order that puts equal columns of keys (K, N) side by side, and (G,) where they begin."""
    order = np.lexsort(keys[::-1])
    changes = (np.diff(keys[:, order]) != 0).any(axis=0)
    return order, np.flatnonzero(np.append(True, changes))


def _sums(values: NDArray[Any], begins: Stamps) -> Floats:
    """(G, ...) sums of the values (N, ...) of each group; ``begins`` (G,) are their first rows."""
    return np.asarray(np.add.reduceat(values, begins, axis=0, dtype=np.float64))


def _common_share(residuals: Floats, squares: Floats) -> Floats:
    """(N,) Share of the squared residuals (N, M) of each view that its markers have in common."""
    seen = ~np.isnan(squares)
    n = np.maximum(seen.sum(axis=1), 1)
    mean = np.where(seen[:, :, None], residuals, 0.0).sum(axis=1) / n[:, None]
    total = np.where(seen, squares, 0.0).sum(axis=1) / n
    share = (mean**2).sum(axis=1) / np.where(total > 0, total, np.nan)
    return np.where(n >= 5, share, np.nan)


# Histograms over the logarithm of positive values: sums of them, and medians, of any number.


def histograms(values: Floats) -> Stamps:
    """(K, B) How many of the values (K, N) lie in each bin; NaN lie in none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        places = (np.log2(values) - _LOWEST) * _PER_OCTAVE
    k, n = np.nonzero(~np.isnan(places))
    bins = k * _BINS + np.clip(places[k, n], 0, _BINS - 1).astype(np.int64)
    return np.bincount(bins, minlength=len(values) * _BINS).reshape(-1, _BINS)


def medians(counts: NDArray[Any], fewest: int) -> Floats:
    """(K,) Medians of histograms (K, B), within 1 %; NaN where there are fewer values."""
    return quantiles(counts, 0.5, fewest)


def quantiles(counts: NDArray[Any], share: float, fewest: int) -> Floats:
    """(K,) Values of histograms (K, B) that a share is below; NaN of fewer values."""
    total = counts.sum(axis=1)
    before = np.cumsum(counts, axis=1)
    at = (before >= share * total[:, None]).argmax(axis=1)
    k = np.arange(len(counts))
    inside = (share * total - (before[k, at] - counts[k, at])) / np.maximum(counts[k, at], 1)
    middle = 2.0 ** (_LOWEST + (at + inside) / _PER_OCTAVE)
    return np.where(total >= fewest, middle, np.nan)
