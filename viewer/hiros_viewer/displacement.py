"""How far a stage moved each joint: poses before it wait for the result of the same instant."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.skeletons import Floats, Stamps

_MOST = 10_000


def _no_stamps() -> Stamps:
    return np.zeros(0, np.int64)


@dataclass(slots=True)
class EarlierPoses:
    """Poses of one person at one stage, in the order of time, that the result has not reached."""

    stamps: Stamps = field(default_factory=_no_stamps)
    """(T,) ns."""
    poses: Floats | None = None
    """(T, M, 3) m; None before there are any."""

    def add(self, stamps: Stamps, poses: Floats) -> None:
        """Append poses (T, M, 3); only the newest are kept if the result never comes."""
        joined = poses if self.poses is None else np.concatenate([self.poses, poses])
        self.stamps = np.concatenate([self.stamps, stamps])[-_MOST:]
        self.poses = joined[-_MOST:]

    def at(self, stamps: Stamps, n_markers: int) -> Floats:
        """(T, M, 3) poses at increasing times, NaN where absent; earlier ones are forgotten."""
        positions = np.full((len(stamps), n_markers, 3), np.nan)
        if self.poses is None or not len(stamps):
            return positions
        _, rows, asked = np.intersect1d(self.stamps, stamps, return_indices=True)
        positions[asked] = self.poses[rows]
        later = self.stamps > stamps[-1]
        self.stamps, self.poses = self.stamps[later], self.poses[later]
        return positions


def mean_distances(first: Floats, second: Floats) -> Floats:
    """(T,) Mean distance over joints between poses (T, M, 3), m; NaN without a common joint."""
    apart = np.linalg.norm(first - second, axis=2)
    seen = ~np.isnan(apart)
    total = np.where(seen, apart, 0.0).sum(axis=1)
    return np.asarray(np.where(seen.any(axis=1), total / np.maximum(seen.sum(axis=1), 1), np.nan))
