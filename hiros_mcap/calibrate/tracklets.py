"""One person in one camera, as long as the camera sees them: no id, no pose of the camera needed.

A tracklet ends where it is not certain how it goes on. Left and right are consistent in it: a
detector that confuses them may have swapped all of it, but not parts of it.
"""

from __future__ import annotations

from collections.abc import Iterable
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


class _Growing:
    """A tracklet that may go on."""

    def __init__(self, seconds: float, pose: Floats, weights: Floats) -> None:
        self.seconds = [seconds]
        self.poses = [pose]
        self.weights = [weights]

    def add(self, seconds: float, pose: Floats, weights: Floats) -> None:
        self.seconds.append(seconds)
        self.poses.append(pose)
        self.weights.append(weights)

    def finish(self) -> Tracklet:
        positions, weights = np.stack(self.poses), np.stack(self.weights)
        return Tracklet(np.array(self.seconds), np.nan_to_num(positions), weights)


def find_tracklets(sightings: Iterable[Sighting], mirror: Ints) -> list[Tracklet]:
    """Join the people of consecutive frames who are nearest to each other, mutually.

    Parameters
    ----------
    sightings : of one camera, by time. mirror : (M,) slot of each joint's counterpart.
    """
    growing: list[_Growing] = []
    done: list[_Growing] = []
    for seconds, positions, weights in sightings:
        done += [one for one in growing if seconds - one.seconds[-1] > GAP_S]
        growing = [one for one in growing if seconds - one.seconds[-1] <= GAP_S]
        owners, swapped = _continue(positions, [one.poses[-1] for one in growing], mirror)
        for p, owner in enumerate(owners):
            order = mirror if swapped[p] else slice(None)
            pose, weight = positions[p, order], weights[p, order]
            if owner >= 0:
                growing[owner].add(seconds, pose, weight)
            else:
                growing.append(_Growing(seconds, pose, weight))
    long = (one for one in done + growing if one.seconds[-1] - one.seconds[0] >= SHORTEST_S)
    return sorted((one.finish() for one in long), key=lambda track: float(track.seconds[0]))


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
