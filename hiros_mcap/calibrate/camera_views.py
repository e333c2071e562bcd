"""Each camera's views of the people, as tracklets in its own frame and time."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hiros_mcap.frames import Block, rows_between
from hiros_mcap.kernels.distance import follow_people
from hiros_mcap.kernels.local_line import Tracklet
from hiros_mcap.skeletons import POSITION, Floats, Ints, Stamps

HALF_WIDTH_S = 0.1
"""Half of the time over which a joint's path is taken for a line; more for slow cameras."""
CONFIDENCE_POWER = 3
"""A joint's weight is its confidence to this power: a guess at 1/3 counts an eighth."""


@dataclass(frozen=True, slots=True)
class CameraView:
    """One camera and whom it sees."""

    name: str
    frame: str  # coordinate frame of its detections
    tracks: list[Tracklet]  # tracklets, by time. Seconds count from the middle of the log.
    shift: float
    """s that were added to the camera's stamps because they are far from the log's times."""
    half_width: float  # s, of the lines through a joint's positions


class Seen(NamedTuple):
    """The people whom one camera saw in N frames."""

    stamps: Stamps  # (N,) ns, as logged
    log_times: Stamps  # (N,) ns
    counts: Stamps  # (N,) people in each frame
    positions: npt.NDArray[np.float32]  # (P, M, 3) of all people, m; NaN = absent
    confidences: npt.NDArray[np.float32]  # (P, M) 0..1; NaN = not given


def half_width_of(times: Sequence[float]) -> float:
    """Return half of the time, s, over which a joint's path is taken for a line."""
    period = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return max(HALF_WIDTH_S, 2.0 * period)


def sightings_of(block: Block, frames: Sequence[int], middle: int) -> list[Sighting]:
    """Return whom some frames of a block show. Seconds count from ``middle``, ns."""
    chosen = np.array(frames, np.int64)
    rows = rows_between(block.rows[chosen])
    return sightings_from(
        block.people.markers[rows, :, POSITION],
        block.people.marker_confidences[rows],
        np.diff(block.rows[chosen], axis=1)[:, 0],
        (block.stamps[chosen] - middle) / 1e9,
    )


def sightings_from(
    positions: npt.NDArray[Any], confidences: npt.NDArray[Any], counts: Stamps, seconds: Floats
) -> list[Sighting]:
    """Return N sightings.

    Parameters
    ----------
    positions, confidences : (P, M, 3) and (P, M) of all people. counts : (N,) people of each.
    seconds : (N,).
    """
    confidences = np.where(np.isnan(confidences), 1.0, confidences)
    absent = np.isnan(positions).any(axis=2) | (confidences <= 0.0)
    weights = np.where(absent, 0.0, confidences.astype(np.float64) ** CONFIDENCE_POWER)
    places = np.where(absent[:, :, None], np.nan, positions)
    places, ends = places.astype(np.float64), np.cumsum(counts).tolist()
    spans = zip(seconds.tolist(), [0, *ends], ends, strict=False)
    return [Sighting(time, places[begin:end], weights[begin:end]) for time, begin, end in spans]


GATE_M = 0.35
"""Mean joint distance from frame to frame up to which it is the same person."""
GAP_S = 0.25
"""A tracklet ends if nobody continues it for so long."""
SWAP = 0.8
"""Sides are swapped where that is nearer by a fifth: near to it, noise would decide."""
LATE_S = 0.4
"""So long frames wait to be put in order."""
SHORTEST_S = 0.3
"""A shorter tracklet is mostly somebody who is not there."""


class Sighting(NamedTuple):
    """The people whom a camera sees in one frame."""

    seconds: float  # time on the camera's clock, s
    positions: Floats  # (P, M, 3) in the camera's frame, m; NaN = absent
    weights: Floats  # (P, M) 0 = absent


_Growing = list[tuple[float, Floats, Floats]]
"""A tracklet that may go on: time, pose and weights of each frame."""


class PeopleFollowed:
    """Joins the people of consecutive frames of a camera who are nearest to each other, mutually.

    Parameters
    ----------
    mirror : (M,) slot of each joint's counterpart.
    """

    def __init__(self, mirror: Ints) -> None:
        self._mirror = mirror
        self._growing: list[_Growing] = []
        self._done: list[_Growing] = []
        self._waiting: list[Sighting] = []  # by time
        self.times: list[float] = []  # s, of the frames

    def add(self, sighting: Sighting) -> None:
        """Take a frame; one that comes over LATE_S after a later one is left out."""
        insort(self._waiting, sighting, key=itemgetter(0))
        while self._waiting[-1].seconds - self._waiting[0].seconds > LATE_S:
            self._follow(self._waiting.pop(0))

    def _follow(self, sighting: Sighting) -> None:
        seconds, positions, weights = sighting
        if self.times and seconds < self.times[-1]:
            return
        self.times.append(seconds)
        self._done += [track for track in self._growing if seconds - track[-1][0] > GAP_S]
        growing = [track for track in self._growing if seconds - track[-1][0] <= GAP_S]
        owners, swapped = _continue(positions, [track[-1][1] for track in growing], self._mirror)
        for p, owner in enumerate(owners):
            order = self._mirror if swapped[p] else slice(None)
            if owner < 0:
                growing.append([])
            growing[owner].append((seconds, positions[p, order], weights[p, order]))
        self._growing = growing

    def forget(self, before: float) -> None:
        """Forget what was seen up to a time, s."""
        for tracks in (self._done, self._growing):
            for track in tracks:
                del track[: bisect_right(track, before, key=itemgetter(0))]
            tracks[:] = filter(None, tracks)
        del self.times[: bisect_right(self.times, before)]

    def tracklets(self, shift: float = 0.0) -> list[Tracklet]:
        """Return the tracklets so far; their times are ``shift`` s later than stated."""
        for sighting in self._waiting:
            self._follow(sighting)
        self._waiting.clear()
        tracklets = self._done + self._growing
        long = (track for track in tracklets if track[-1][0] - track[0][0] >= SHORTEST_S)
        ordered = sorted(long, key=lambda frames: frames[0][0])
        columns = (map(np.array, zip(*track, strict=True)) for track in ordered)
        return [Tracklet(times + shift, np.nan_to_num(poses), w) for times, poses, w in columns]


def find_tracklets(sightings: Iterable[Sighting], mirror: Ints) -> list[Tracklet]:
    """Return the tracklets of one camera's sightings, which come by time."""
    followed = PeopleFollowed(mirror)
    for sighting in sightings:
        followed.add(sighting)
    return followed.tracklets()


def _continue(poses: Floats, last: list[Floats], mirror: Ints) -> tuple[list[int], list[bool]]:
    """Return which tracklet each of (P, M, 3) poses continues, -1 = none, and if swapped."""
    n, q = len(poses), len(last)
    if not n or not q:
        return [-1] * n, [False] * n
    distances, swaps = np.empty((n, q)), np.empty((n, q), np.bool_)
    owners, swapped = np.empty(n, np.int64), np.empty(n, np.bool_)
    both = np.ascontiguousarray(poses), np.ascontiguousarray(poses[:, mirror])
    follow_people(*both, np.array(last), SWAP, GATE_M, distances, swaps, owners, swapped)
    return owners.tolist(), swapped.tolist()
