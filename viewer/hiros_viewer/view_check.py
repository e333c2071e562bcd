"""How each camera's detections compare with the result: what it sees, mirrors, and gets wrong.

The result looks ahead, so it is seconds behind the detections and the stages before it: they wait
for the result of their time.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.evaluate.match import MATCH_DISTANCE
from hiros_mcap.evaluate.statistics import nan_mean
from hiros_mcap.frames import rows_between
from hiros_mcap.kernels.distance import nearest
from hiros_mcap.skeletons import Flags, Floats, Ints, Stamps, nearest_stamps
from hiros_viewer.columns import GONE_NS
from hiros_viewer.poses import Poses

MIRRORED, FAR_OFF = "mirrored", "far off"
FAULTS = (MIRRORED, FAR_OFF)
_MIRRORED_M, _MIRRORED_SHARE = 0.1, 0.6
"""A detection is mirrored if it is this far from the result, and much nearer with sides swapped."""
_FAR_OFF_M = 0.2
_LAPSE_NS = 250_000_000  # a fault goes on if it is seen again within this time
_SHORTEST_NS = 100_000_000  # a shorter fault is noise
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


FaultySpan = tuple[str, Stamps, Stamps]
"""When a camera's view was wrong: the kind of fault, (2,) first and last stamp and log time, ns."""


@dataclass(slots=True)
class ViewCheck:
    """Compares one camera's detections with the result."""

    mirror: Ints  # (M,) Marker on the other side
    seen: int = 0  # people of the result whom the camera reports, over all messages
    people: int = 0  # people of the result, over all messages
    seconds: dict[str, float] = field(default_factory=dict)  # by kind: how long the view was wrong
    distances: list[Floats] = field(default_factory=list)
    """Of each message: mean distance to the result, mm."""
    _open: dict[str, Stamps] = field(default_factory=dict)
    """By kind: (K, 2) times at which a fault that may go on was seen."""

    def compare(
        self, detections: Poses, people: Floats, rows: Stamps
    ) -> tuple[Floats, Mapping[str, Flags]]:
        """Compare the detections of N frames with the result.

        Parameters
        ----------
        people : (Q, M, 3) joints of the result, m.
        rows : (N, 2) first row of the people of each frame's instant, and the row after the last.

        Returns
        -------
        (N,) mean distance, mm, NaN where nobody of the result is near; and kind of fault -> (P,)
        which detections have it.
        """
        frames, poses = detections.frames, detections.positions
        plain, swapped = np.empty(len(poses)), np.empty(len(poses))
        nearest(poses, people, rows[frames], plain)
        nearest(np.ascontiguousarray(poses[:, self.mirror]), people, rows[frames], swapped)
        expected = rows[:, 1] - rows[:, 0]
        metres = np.empty(int(expected.sum()))
        indices = np.repeat(detections.rows, expected, axis=0)
        nearest(people[rows_between(rows)], poses, indices, metres)
        self.seen += int((metres < MATCH_DISTANCE).sum())
        self.people += len(metres)
        near = plain < MATCH_DISTANCE
        total, n = (
            np.bincount(frames[near], weights, len(rows)) for weights in (1000 * plain[near], None)
        )
        distances = np.where(n > 0, total / np.maximum(n, 1), np.nan)
        self.distances.append(distances[n > 0])
        mirrored = near & (plain > _MIRRORED_M) & (swapped < _MIRRORED_SHARE * plain)
        return distances, {MIRRORED: mirrored, FAR_OFF: near & ~mirrored & (plain > _FAR_OFF_M)}

    def spans(self, detections: Poses, faults: Mapping[str, Flags]) -> Iterator[FaultySpan]:
        """Note the faults of frames; yield those that are over at the last frame."""
        for kind, wrong in faults.items():
            times = detections.times[np.unique(detections.frames[wrong])]
            if kind in self._open:
                times = np.concatenate([self._open.pop(kind), times])
            breaks = np.flatnonzero(np.diff(times[:, 0]) > _LAPSE_NS) + 1
            *over, last = np.split(times, breaks)
            if len(last) and detections.stamps[-1] - last[-1, 0] <= _LAPSE_NS:
                self._open[kind] = last
            else:
                over.append(last)
            yield from self._long(kind, over)

    def finish(self) -> Iterator[FaultySpan]:
        """Yield the faults that go on until the end."""
        for kind, times in self._open.items():
            yield from self._long(kind, [times])
        self._open.clear()

    def _long(self, kind: str, spans: list[Stamps]) -> Iterator[FaultySpan]:
        """Yield spans (K, 2) that are no noise."""
        for times in spans:
            if len(times) and times[-1, 0] - times[0, 0] >= _SHORTEST_NS:
                seconds = float(times[-1, 0] - times[0, 0]) / 1e9
                self.seconds[kind] = self.seconds.get(kind, 0.0) + seconds
                yield kind, times[0], times[-1]

    def row(self) -> tuple[str, ...]:
        """Return coverage, median distance, and how long the view was wrong, as text."""
        coverage = f"{self.seen / self.people:.0%}" if self.people else "-"
        distances = np.concatenate([*self.distances, np.zeros(0)])
        distance = f"{np.median(distances):.0f} mm" if len(distances) else "-"
        return (coverage, distance, *(f"{self.seconds.get(kind, 0.0):.1f} s" for kind in FAULTS))
