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


_Growing = list[tuple[float, Floats, Floats]]
"""A tracklet that may go on: time, pose and weights of each frame."""


def find_tracklets(sightings: Iterable[Sighting], mirror: Ints) -> list[Tracklet]:
    """Join the people of consecutive frames who are nearest to each other, mutually.

    Parameters
    ----------
    sightings : of one camera, by time. mirror : (M,) slot of each joint's counterpart.
    """
    growing: list[_Growing] = []
    done: list[_Growing] = []
    for seconds, positions, weights in sightings:
        done += [one for one in growing if seconds - one[-1][0] > GAP_S]
        growing = [one for one in growing if seconds - one[-1][0] <= GAP_S]
        owners, swapped = _continue(positions, [one[-1][1] for one in growing], mirror)
        for p, owner in enumerate(owners):
            order = mirror if swapped[p] else slice(None)
            if owner < 0:
                growing.append([])
            growing[owner].append((seconds, positions[p, order], weights[p, order]))
    long = (one for one in done + growing if one[-1][0] - one[0][0] >= SHORTEST_S)
    columns = (map(np.array, zip(*one, strict=True)) for one in sorted(long, key=lambda f: f[0][0]))
    return [Tracklet(times, np.nan_to_num(poses), some) for times, poses, some in columns]


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
