"""How far each camera's detections, and the stages before the result, are from the result.

The result looks ahead, so it is seconds behind the detections and the stages before it: they wait
for the result of their time.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.evaluate.match import MATCH_DISTANCE
from hiros_mcap.evaluate.statistics import nan_mean
from hiros_mcap.kernels.distance import nearest
from hiros_mcap.skeletons import Floats, Stamps, nearest_stamps
from hiros_viewer.columns import GONE_NS
from hiros_viewer.poses import Poses

_MOST = 10_000
"""Frames of a camera, or poses of a person, that wait, at most, if the result never comes."""
Compared = tuple[str, Poses, Floats, Stamps]
"""A camera, its detections in N frames, (Q, M, 3) joints of the result, m, and (N, 2) the first row
of the people of each frame's instant, and the row after the last."""


@dataclass(slots=True)
class Waiting:
    """Detections of all cameras that the result has not come to."""

    _parts: defaultdict[str, list[Poses]] = field(default_factory=lambda: defaultdict(list))
    _last: Poses | None = None  # the newest frame of the result

    def add(self, camera: str, detections: Poses) -> None:
        """Let detections wait; the oldest are dropped if there are too many."""
        parts = self._parts[camera]
        parts.append(detections)
        while sum(map(len, parts)) > _MOST and len(parts) > 1:
            parts.pop(0)

    def reached(self, result: Poses) -> Iterator[Compared]:
        """Yield detections up to the newest frame of the result, each with the nearest one."""
        joined = result if self._last is None else Poses.joined([self._last, result])
        self._last = joined.select(np.array([len(joined) - 1]))
        yield from self._up_to(int(joined.stamps[-1]), joined)

    def rest(self) -> Iterator[Compared]:
        """Yield detections soon after the end of the result."""
        if self._last is not None:
            yield from self._up_to(int(self._last.stamps[-1]) + GONE_NS, self._last)

    def _up_to(self, stamp: int, poses: Poses) -> Iterator[Compared]:
        for camera, parts in self._parts.items():
            if parts:
                ready, later = Poses.joined(parts).split(stamp + 1)
                self._parts[camera] = [later] if len(later) else []
                near = nearest_stamps(poses.stamps, ready.stamps)
                chosen = np.flatnonzero(np.abs(poses.stamps[near] - ready.stamps) <= GONE_NS)
                if len(chosen):
                    rows = poses.rows[near[chosen]]
                    yield camera, ready.select(chosen), poses.positions, rows


@dataclass(slots=True)
class EarlierPoses:
    """Poses of one person at one stage, in the order of time, that the result has not reached."""

    stamps: Stamps = field(default_factory=lambda: np.zeros(0, np.int64))  # (T,) ns
    poses: Floats | None = None  # (T, M, 3) m; None before there are any

    def add(self, stamps: Stamps, poses: Floats) -> None:
        """Append poses (T, M, 3); only the newest are kept if the result never comes."""
        joined = poses if self.poses is None else np.concatenate([self.poses, poses])
        self.stamps = np.concatenate([self.stamps, stamps])[-_MOST:]
        self.poses = joined[-_MOST:]

    def at(self, stamps: Stamps, n_markers: int) -> Floats:
        """(T, M, 3) poses at increasing times, NaN where absent; earlier ones are forgotten."""
        poses = np.full((len(stamps), n_markers, 3), np.nan)
        if self.poses is None or not len(stamps):
            return poses
        _, kept, asked = np.intersect1d(self.stamps, stamps, return_indices=True)
        poses[asked] = self.poses[kept]
        later = self.stamps > stamps[-1]
        self.stamps, self.poses = self.stamps[later], self.poses[later]
        return poses


def apart(first: Floats, second: Floats) -> Floats:
    """(T,) Mean distance over joints between poses (T, M, 3), m; NaN without a common joint."""
    return nan_mean(np.linalg.norm(first - second, axis=2), 1)


def mean_distances(detections: Poses, people: Floats, rows: Stamps) -> Floats:
    """(N,) mm, from the detections of each frame to the nearest person of the result.

    Parameters
    ----------
    detections : of N frames. people : (Q, M, 3) joints of the result, m.
    rows : (N, 2) first row of the people of each frame's instant, and the row after the last.

    It is NaN where nobody of the result is near.
    """
    frames, poses = detections.frames, detections.positions
    metres = np.empty(len(poses))
    nearest(poses, people, rows[frames], metres)
    near = metres < MATCH_DISTANCE
    total, n = (
        np.bincount(frames[near], weights, len(rows)) for weights in (1000 * metres[near], None)
    )
    return np.where(n > 0, total / np.maximum(n, 1), np.nan)
