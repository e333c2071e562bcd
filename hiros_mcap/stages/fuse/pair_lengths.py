"""Distances of markers that a body keeps constant: of links, and within head, thorax and pelvis.

Noise of variance v along each axis lengthens them: L^2 = mean |d|^2 - 3 v. The other side of the
body tells a part of each (:func:`drawn_together`). They are measured from many poses at once
(:class:`LastMinute`) or on the way (:class:`RunningLengths`).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from hiros_mcap.body.limb_table import Limb, LimbTable, link_keys
from hiros_mcap.skeletons import Floats, Ints, SkeletonModel, Stamps

MINUTE = 60.0  # s
_LENGTH_DEVIATION = 0.005  # m; added to the deviations that weight a length
_OUTLIER = 4.0  # robust standard deviations
_FEWEST = 15  # poses that give a length
RATE = 15.0  # Hz; poses that follow each other faster say the same

MeasuredLengths = tuple[Floats, Floats, Ints]
"""Of the K distances of one person: lengths, m, 0 = unknown; standard deviations of the distances
as they were seen, m; poses with both ends."""


def without_noise(squares: Floats, varied: Floats, stated: Floats) -> Floats:
    """Lengths, m, from mean ``squares`` of distances, m2.

    The variance of the noise is that ``stated``, m2, and at most that by which the distance itself
    ``varied``: an overstated one would shorten.
    """
    return np.asarray(np.sqrt(np.maximum(squares - 3 * np.minimum(stated, varied), 0.0)))


def measured_lengths(positions: Floats, variances: Floats, pairs: Ints) -> Floats:
    """(K,) Distances of markers without the part that noise adds, m; NaN = unknown.

    Parameters
    ----------
    positions : (T, M, 3) m. variances : (T, M) m2 along each axis. pairs : (K, 2) slots.
    """
    a, b = pairs[:, 0], pairs[:, 1]
    squares = ((positions[:, a] - positions[:, b]) ** 2).sum(axis=2)
    noise = variances[:, a] + variances[:, b]
    seen = ~np.isnan(squares)
    squares = np.where(seen, squares, np.nan)
    enough = seen.sum(axis=0) >= _FEWEST
    lengths = np.full(len(pairs), np.nan)
    if not enough.any():
        return lengths
    squares, noise, seen = squares[:, enough], noise[:, enough], seen[:, enough]
    middle = np.nanmedian(squares, axis=0)
    spread = 1.4826 * np.nanmedian(np.abs(squares - middle), axis=0)
    clipped = np.clip(squares, middle - _OUTLIER * spread, middle + _OUTLIER * spread)
    weights = seen / (noise + 2 * _LENGTH_DEVIATION**2)
    mean = np.nansum(weights * clipped, axis=0) / weights.sum(axis=0)
    stated = np.nansum(weights * noise, axis=0) / weights.sum(axis=0)
    lengths[enough] = without_noise(mean, np.nanvar(np.sqrt(clipped), axis=0), stated)
    return lengths


def other_sides(pairs: Ints, mirror: Ints) -> Ints:
    """(K,) The same pair on the other side of the body."""
    places = {(a, b): k for k, (a, b) in enumerate(pairs.tolist())}
    others = np.sort(mirror[pairs], axis=1).tolist()
    return np.array([places.get((a, b), k) for k, (a, b) in enumerate(others)], np.int64)


def drawn_together(lengths: Floats, weights: Floats | Ints, other: Ints) -> Floats:
    """Lengths, m, halfway between what was measured and the weighted mean of both sides.

    The sides of a body differ by some millimetres, and what cameras show of them by as many.
    """
    weights = np.where(lengths > 0, weights, 0.0)
    both = np.maximum(weights + weights[other], 1e-12)
    means = (weights * lengths + weights[other] * lengths[other]) / both
    return np.asarray(np.where(lengths > 0, (lengths + means) / 2, means))


class LastMinute:
    """Poses of a person's last minute, at most RATE, and the distances that they show.

    Parameters
    ----------
    pairs : (K, 2) slots. mirror : (M,) slot of the same joint on the other side.
    seconds : so long is the minute; longer, if lengths are measured for longer.
    """

    def __init__(self, pairs: Ints, mirror: Ints, seconds: float = MINUTE) -> None:
        self._pairs, self._other = pairs, other_sides(pairs, mirror)
        self._length = round(seconds * 1e9)
        self._parts = deque[tuple[Stamps, Floats, Floats]]()

    def update(self, stamps: Stamps, positions: Floats, variances: Floats) -> None:
        """Take poses: (T,) ns, (T, M, 3) m, (T, M) m2 along each axis."""
        kept = np.diff(stamps // round(1e9 / RATE), prepend=-1) != 0
        self._parts.append((stamps[kept], positions[kept], variances[kept]))
        while self._parts[0][0][-1] < stamps[-1] - self._length:
            self._parts.popleft()

    def poses(self) -> tuple[Floats, Floats]:
        """(S, M, 3) m, and (S, M) m2 along each axis."""
        _, positions, variances = zip(*self._parts, strict=True)
        return np.concatenate(positions), np.concatenate(variances)

    def result(self) -> MeasuredLengths:
        """Return what the poses so far show."""
        poses, variances = self.poses()
        lengths = np.nan_to_num(measured_lengths(poses, variances, self._pairs))
        deviations, counts = _deviations(poses, self._pairs)
        return drawn_together(lengths, counts, self._other), deviations, counts


class RunningLengths:
    """Measures distances by running means, so the first poses use what there is.

    Parameters
    ----------
    pairs : (K, 2) slots. mirror : (M,) slot of the same joint on the other side.
    """

    def __init__(self, pairs: Ints, mirror: Ints) -> None:
        self._a, self._b = pairs[:, 0], pairs[:, 1]
        self._other = other_sides(pairs, mirror)
        self._counts = np.zeros(len(pairs), np.int32)
        self._weight = np.zeros(len(pairs))
        self._means = np.zeros((4, len(pairs)))
        """Of the square of the distance, its square, the distance, and the noise."""

    def update(self, positions: Floats, variances: Floats) -> None:
        """Take poses: (T, M, 3) m, (T, M) m2 along each axis."""
        noises = variances[:, self._a] + variances[:, self._b]
        for pose, noise in zip(positions, noises, strict=True):
            squares = ((pose[self._a] - pose[self._b]) ** 2).sum(axis=1)
            seen = ~np.isnan(squares)
            squares = np.where(seen, squares, 0.0)
            mean, mean_square = self._means[:2]
            spread = np.sqrt(np.maximum(mean_square - mean**2, 0.0))
            clipped = np.clip(squares, mean - _OUTLIER * spread, mean + _OUTLIER * spread)
            squares = np.where(self._counts >= _FEWEST, clipped, squares)
            new = seen / (noise + 2 * _LENGTH_DEVIATION**2)
            self._weight += new
            gain = new / np.maximum(self._weight, 1e-12)
            values = np.stack([squares, squares**2, np.sqrt(squares), noise])
            self._means += gain * (values - self._means)
            self._counts += seen

    def result(self) -> MeasuredLengths:
        """Return what the poses so far show."""
        square, _, distance, stated = self._means
        varied = np.maximum(square - distance**2, 0.0)
        lengths = without_noise(square, varied, stated)
        lengths = drawn_together(lengths, self._weight, self._other)
        return lengths, np.sqrt(varied), self._counts


class PairLimbs:
    """The lengths of links in the limb table of a run, as distances of pairs of markers.

    Parameters
    ----------
    model : the skeleton. pairs : (K, 2) slots with a constant distance. limbs : known from before.
    """

    def __init__(self, model: SkeletonModel, pairs: Ints, limbs: LimbTable) -> None:
        self._limbs, self._keys = limbs, link_keys(model)
        places = {(a, b): k for k, (a, b) in enumerate(pairs.tolist())}
        ends = np.sort(model.links, axis=1).tolist()
        self._places = {
            key: places.get((a, b)) for key, (a, b) in zip(self._keys, ends, strict=True)
        }
        self._given = {person: limbs.lengths(person, model) for person in limbs.people}

    def given_or(self, person: int, lengths: Floats) -> Floats:
        """Return (K,) lengths, m, with those that the person had before."""
        if person not in self._given:
            return lengths
        out = lengths.copy()
        for key, length in zip(self._keys, self._given[person].tolist(), strict=True):
            place = self._places[key]
            if place is not None and not np.isnan(length):
                out[place] = length
        return out

    def keep(self, person: int, measured: MeasuredLengths) -> None:
        """Put what was measured into the table, unless the person's lengths were given."""
        if person in self._given:
            return
        lengths, deviations, frames = measured
        self._limbs.people[person] = {
            key: Limb(float(lengths[k]), float(deviations[k]), int(frames[k]))
            for key, k in self._places.items()
            if k is not None and lengths[k] > 0
        }


def _deviations(poses: Floats, pairs: Ints) -> tuple[Floats, Ints]:
    """(K,) Standard deviations of the distances of pairs, m, and the number of poses with each."""
    distances = np.linalg.norm(poses[:, pairs[:, 0]] - poses[:, pairs[:, 1]], axis=2)
    seen = ~np.isnan(distances)
    n = np.maximum(seen.sum(axis=0), 1)
    means = np.where(seen, distances, 0.0).sum(axis=0) / n
    squares = np.where(seen, (distances - means) ** 2, 0.0).sum(axis=0) / n
    return np.sqrt(squares), seen.sum(axis=0).astype(np.int32)
