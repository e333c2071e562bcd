"""Several systems scored on the same detections, and how sure the difference between two is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hiros_mcap.evaluate.statistics import ErrorStats, block_interval, blocks_of, mean_of
from hiros_mcap.skeletons import Flags, Stamps


@dataclass(frozen=True, slots=True)
class Distances:
    """D detections of a camera against what a system makes of the others' views.

    Of a truth: what each true person is in each second, with M = 1.
    """

    stamps: Stamps
    """(D,) ns."""
    joints: npt.NDArray[np.float32]
    """(D, M) distance of each joint, mm; NaN where the system has nobody there, or no such joint.
    Left and right are as the camera has them."""
    varying: npt.NDArray[np.float32]
    """(D, M) the same without the constant displacement of each joint of a person, mm."""


@dataclass(frozen=True, slots=True)
class MeanDifference:
    """Mean distance of a system less that of another, on what both have, mm."""

    against: str
    """The other system."""
    mm: float
    """Negative: this system is nearer."""
    low: float
    """Lower end of the 95 % interval, mm; NaN if there are fewer than two seconds."""
    high: float
    seconds: int
    """Blocks of a second that the interval is made of."""

    @property
    def is_sure(self) -> bool:
        """Whether the interval does not hold 0."""
        return self.low > 0 or self.high < 0

    @property
    def line(self) -> str:
        """Return it with the other system and the time in common."""
        if self.seconds < 2:
            return f"not compared with {self.against}: less than two seconds in common"
        return f"against {self.against}, mm: {self} in {self.seconds} s"

    def __str__(self) -> str:
        ends = sorted((abs(self.low), abs(self.high)))
        if not self.is_sure:
            return f"no difference ({self.low:+.1f} to {self.high:+.1f})"
        word = "better" if self.mm < 0 else "worse"
        return f"{word} by {abs(self.mm):.1f} (95 % {ends[0]:.1f} to {ends[1]:.1f})"


@dataclass(frozen=True, slots=True)
class SameScores:
    """Of one system, on the detections where all systems have somebody."""

    distance: ErrorStats
    disagreement: float
    """Median of these distances, mm."""
    spread: float
    """Mean of the varying distances, mm."""
    misses: int
    """Detections at which the system has nobody, but another one has."""
    detections: int
    """Detections at which some system has somebody."""
    difference: MeanDifference | None
    """From the first system; None for the first itself."""


def on_same_detections(systems: Sequence[Sequence[Distances]], first: str) -> list[SameScores]:
    """Score S systems on the joints that all of them have at the same detections.

    A system that has nobody anywhere does not count for what the others have.

    Parameters
    ----------
    systems : the cameras' distances of each, for all systems in the same order.
    first : name of the first system.

    Raises ValueError if the systems were given different detections.
    """
    each = [np.concatenate([d.joints for d in cameras]) for cameras in systems]
    if len({joints.shape for joints in each}) > 1:
        raise ValueError("the systems were given different detections")
    varying = (np.concatenate([d.varying for d in cameras]) for cameras in systems)
    stamps = np.concatenate([d.stamps for d in systems[0]])
    present: Flags = ~np.isnan(np.stack(each))  # (S, D, M)
    there = np.any(present, axis=2)
    anybody = there.any(axis=0)
    # Without any that has somebody, all is common: nothing is present.
    common = present[there.any(axis=1)].all(axis=0)
    scores = []
    for k, (joints, rest) in enumerate(zip(each, varying, strict=True)):
        shown = common & present[k]
        distances = joints[shown].astype(np.float64)
        score = SameScores(
            distance=ErrorStats.of(distances),
            disagreement=float(np.median(distances)) if distances.size else np.nan,
            spread=mean_of(rest[shown].astype(np.float64)),
            misses=int((anybody & ~there[k]).sum()),
            detections=int(anybody.sum()),
            difference=_difference(joints, each[0], stamps, first) if k else None,
        )
        scores.append(score)
    return scores


def _difference(
    mine: npt.NDArray[np.float32], other: npt.NDArray[np.float32], stamps: Stamps, name: str
) -> MeanDifference:
    """MeanDifference of two systems where both have a joint, with an interval over seconds."""
    apart = mine.astype(np.float64) - other
    rows, columns = np.nonzero(~np.isnan(apart))
    return MeanDifference(name, *block_interval(apart[rows, columns], blocks_of(stamps[rows])))
