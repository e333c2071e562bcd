"""Errors summed up, also by part of the body; NaN never counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hiros_mcap.body.symmetry import split_side
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel, Stamps

_BLOCK_NS = 1_000_000_000
"""Errors within a second hang together; those of different seconds hardly do."""


def nan_mean(values: Floats, axis: int) -> Floats:
    """Mean along an axis without NaN; NaN where there is nothing else (and no warning)."""
    present = ~np.isnan(values)
    total = np.where(present, values, 0.0).sum(axis=axis)
    return np.where(present.any(axis=axis), total / np.maximum(present.sum(axis=axis), 1), np.nan)


def mean_of(values: Floats) -> float:
    """Mean of all values without NaN; NaN if there is nothing else."""
    return float(nan_mean(np.asarray(values).reshape(-1, 1), 0)[0]) if values.size else np.nan


def blocks_of(stamps: Stamps) -> Stamps:
    """(K,) number of the block of a second, 0, 1, ..., in which each of (K,) stamps, ns, lies."""
    return np.unique(stamps // _BLOCK_NS, return_inverse=True)[1]


def block_interval(values: Floats, blocks: Stamps) -> tuple[float, float, float, int]:
    """Mean of values (K,), the ends of its 95 % interval, and the number of blocks.

    Blocks (K,) are numbered 0, 1, ...; their means count with their numbers of values, as in the
    mean over all (a ratio estimate, Cochran 1977, section 6.4), and are taken as independent:
    Student's t. The ends are NaN if there are fewer than two blocks.
    """
    if not values.size:
        return np.nan, np.nan, np.nan, 0
    sums, counts = np.bincount(blocks, values), np.bincount(blocks)
    n, mean = len(counts), float(sums.sum() / counts.sum())
    if n < 2:
        return mean, np.nan, np.nan, n
    from scipy.special import stdtrit  # scipy.stats takes 0.5 s to import

    residuals = sums - mean * counts
    error = np.sqrt(n / (n - 1) * (residuals**2).sum()) / counts.sum()
    half = float(stdtrit(n - 1, 0.975)) * float(error)
    return mean, mean - half, mean + half, n


@dataclass(frozen=True, slots=True)
class ErrorStats:
    """Distances, mm or px; NaN if there are none."""

    mean: float
    median: float
    deviation: float
    rmse: float
    percentile_95: float
    percentile_99: float
    count: int

    @classmethod
    def of(cls, errors: Floats) -> ErrorStats:
        """Summarise errors, whatever their shape."""
        present = errors[~np.isnan(errors)]
        if not present.size:
            return cls(np.nan, np.nan, np.nan, np.nan, np.nan, np.nan, 0)
        median, high, highest = np.percentile(present, [50, 95, 99]).tolist()
        return cls(
            float(present.mean()),
            median,
            float(present.std()),
            float(np.sqrt((present * present).mean())),
            high,
            highest,
            present.size,
        )

    @classmethod
    def by_name(cls, names: Sequence[str], errors: Floats) -> dict[str, ErrorStats]:
        """Summarise each column of errors (R, M); columns without any are left out."""
        stats = {name: cls.of(errors[:, k]) for k, name in enumerate(names)}
        return {name: stat for name, stat in stats.items() if stat.count}


@dataclass(frozen=True, slots=True)
class AngleStats:
    """Errors of a joint's angle, degrees (Hi-ROS eq. 20, with the mean and SD of the error)."""

    rmse: float
    deviation: float  # without the constant offset that two conventions may have
    bias: float
    count: int
    singular: int = 0
    """Angles left out because the true joint is near the singularity of its Euler angles."""

    @classmethod
    def of(cls, errors: Floats, singular: int = 0) -> AngleStats:
        """Summarise errors in degrees."""
        stats = ErrorStats.of(errors)
        return cls(stats.rmse, stats.deviation, stats.mean, stats.count, singular)


PARTS = ("torso", "upper limbs", "lower limbs")
_UPPER = ("elbow", "wrist", "hand", "thumb", "finger", "palm", "forearm", "lowerarm")
_LOWER = ("knee", "ankle", "foot", "toe", "heel", "shin", "lowerleg", "calf")


def part_of(name: str) -> str:
    """Part that a marker belongs to, as Lee et al. (2022, section 3.1) group their joints.

    Elbows, wrists and hands are upper limbs, knees, ankles and feet lower limbs; shoulders, hips
    and the head belong to the torso.
    """
    bare = split_side(name)[0]
    if any(word in bare for word in _UPPER):
        return "upper limbs"
    return "lower limbs" if any(word in bare for word in _LOWER) else "torso"


def parts_of(model: SkeletonModel) -> dict[str, Flags]:
    """Part -> (M,) which markers belong to it; parts without a marker are left out."""
    names = np.array([part_of(name) for name in model.marker_names])
    return {part: names == part for part in PARTS if (names == part).any()}
