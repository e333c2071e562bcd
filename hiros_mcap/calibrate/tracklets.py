"""One person in one camera, as long as the camera sees them: no id, no pose of the camera needed.

A tracklet ends where it is not certain how it goes on. Left and right are consistent in it: a
detector that confuses them may have swapped all of it, but not parts of it.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Iterable
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.distance import mean_distances
from hiros_mcap.kernels.local_line import Tracklet
from hiros_mcap.skeletons import Floats, Ints

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
    """What a camera sees in one frame."""

    seconds: float
    """Time on the camera's clock, s."""
    positions: Floats
    """(P, M, 3) in the camera's frame, m; NaN = absent."""
    weights: Floats
    """(P, M) 0 = absent."""


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
        self._waiting: list[Sighting] = []
        """By time."""
        self.times: list[float] = []
        """s, of the frames."""

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
        self._done += [one for one in self._growing if seconds - one[-1][0] > GAP_S]
        growing = [one for one in self._growing if seconds - one[-1][0] <= GAP_S]
        owners, swapped = _continue(positions, [one[-1][1] for one in growing], self._mirror)
        for p, owner in enumerate(owners):
            order = self._mirror if swapped[p] else slice(None)
            if owner < 0:
                growing.append([])
            growing[owner].append((seconds, positions[p, order], weights[p, order]))
        self._growing = growing

    def forget(self, before: float) -> None:
        """Forget what was seen up to a time, s."""
        for some in (self._done, self._growing):
            for one in some:
                del one[: bisect_right(one, before, key=itemgetter(0))]
            some[:] = filter(None, some)
        del self.times[: bisect_right(self.times, before)]

    def tracklets(self, shift: float = 0.0) -> list[Tracklet]:
        """Return the tracklets so far; their times are ``shift`` s later than stated."""
        for sighting in self._waiting:
            self._follow(sighting)
        self._waiting.clear()
        some = self._done + self._growing
        long = (one for one in some if one[-1][0] - one[0][0] >= SHORTEST_S)
        ordered = sorted(long, key=lambda frames: frames[0][0])
        columns = (map(np.array, zip(*one, strict=True)) for one in ordered)
        return [Tracklet(times + shift, np.nan_to_num(poses), w) for times, poses, w in columns]


def find_tracklets(sightings: Iterable[Sighting], mirror: Ints) -> list[Tracklet]:
    """Return the tracklets of one camera's sightings, which come by time."""
    followed = PeopleFollowed(mirror)
    for sighting in sightings:
        followed.add(sighting)
    return followed.tracklets()


def _continue(poses: Floats, last: list[Floats], mirror: Ints) -> tuple[list[int], list[bool]]:
    """Return which tracklet each of (P, M, 3) poses continues, -1 = none, and if swapped."""
    n = len(poses)
    if not n or not last:
        return [-1] * n, [False] * n
    others = np.stack(last)
    straight, swapped = np.empty((n, len(last))), np.empty((n, len(last)))
    mean_distances(np.ascontiguousarray(poses), others, straight)
    mean_distances(np.ascontiguousarray(poses[:, mirror]), others, swapped)
    swap = swapped < SWAP * straight
    distances = np.where(swap, swapped, straight)
    nearest, nearest_of = distances.argmin(axis=1), distances.argmin(axis=0)
    rows = np.arange(n)
    mutual = (nearest_of[nearest] == rows) & (distances[rows, nearest] <= GATE_M)
    owners = np.where(mutual, nearest, -1)
    return owners.tolist(), (mutual & swap[rows, nearest]).tolist()
