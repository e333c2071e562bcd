"""Joints that a camera shows where they are not: how likely that is, and for how long.

A detector that puts a limb to a wrong place leaves it there for a while, and puts the whole limb
there. So a camera's measurements of a joint are outliers, or not, by a Markov chain of two states.
After a last one that was an outlier with probability p, the next one is one with the probability

    p' = SHARE + (p - SHARE) exp(-dt / lasting),  at least FOLLOWS times the parent's.

Its likelihood L against the filter's prediction, and the density of outliers, give the odds

    p' / (1 - p') density / L.

The chain remembers only where it is clear who is wrong: another camera measured the joint just now
and is right, or no joint comes so far since anybody was. Else all may have seen somebody kick, or
the filter follows guesses: then an outlier is as likely as usual. So it is of a camera that has not
agreed for LONGEST: who is wrong for so long may as well be the filter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.link_levels import link_levels
from hiros_mcap.kernels.array_types import F2, arrays
from hiros_mcap.kernels.compile import inlined
from hiros_mcap.skeletons import SkeletonModel, Stamps

_SHARE = 0.02  # of measurements that are off by more than .25 m: 1 to 3 % (Kinect v2)
_FOLLOWS = 0.8  # errors of wrist and hand correlate by .91 to .96, of elbow and wrist by .64 to .83
_MOST, _LARGEST = 0.98, 1e6  # of a probability and of odds that are remembered
_LONGEST = 1.5  # s; somebody is covered for 1.4 to 1.8 s
_RIGHT = 0.1  # probability, or odds, below which a camera is taken to be right
_NOW = 0.15  # s that a measurement counts as one of now
_ACCELERATION = 150.0  # m/s2: between two pictures at 30 Hz, 8 cm besides what was foreseen
_BEYOND = 4.0  # standard deviations of an innovation


class CameraDoubts(NamedTuple):
    """Scratch: the C cameras' last measurements of a joint, as each of K filters takes them."""

    wrong: F2  # (K, C) probability that it was an outlier; 0 = there was none
    times: F2  # (K, C) when that was, s
    agreed: F2  # (K, C) when it was none for the last time, s
    joints: F2  # (M, T) the same of each joint at each step; 0 = not measured

    @classmethod
    def of(cls, filters: int, steps: int, cameras: int, markers: int) -> CameraDoubts:
        """Make room."""
        return arrays(cls, *3 * [(filters, cameras)], (markers, steps))


def parents_first(model: SkeletonModel) -> tuple[Stamps, Stamps]:
    """(M,) and (M,) Markers in an order in which parents come first, and the parent of each.

    A marker without a parent, or on a circle of links, has -1.
    """
    parents = np.full(model.n_markers, -1, np.int64)
    order: list[int] = []
    for links in link_levels(model):
        for parent, child in model.links[links].tolist():
            parents[child] = parent
            order.append(child)
    return np.array([*np.flatnonzero(parents < 0).tolist(), *order], np.int64), parents


@inlined
def _is_contradicted(time: float, camera: int, row: int, doubts: CameraDoubts) -> bool:
    """Whether another camera that is right has measured the joint now."""
    for c in range(doubts.wrong.shape[1]):
        is_right = c != camera and 0.0 < doubts.wrong[row, c] < _RIGHT
        if is_right and time - doubts.times[row, c] < _NOW:
            return True
    return False


@inlined
def _is_jump(time: float, square: float, variance: float, row: int, doubts: CameraDoubts) -> bool:
    """Whether no joint comes so far since any camera was right about it."""
    passed = np.inf
    for c in range(doubts.wrong.shape[1]):
        if doubts.wrong[row, c] > 0.0:
            passed = min(passed, time - doubts.agreed[row, c])
    reach = 0.5 * _ACCELERATION * passed * passed + _BEYOND * math.sqrt(3.0 * variance)
    return square > reach * reach


@inlined
def outlier_odds(
    time: float, camera: int, row: int, innovation: tuple[float, float], ratio: float,
    parent: float, lasting: float, doubts: CameraDoubts,
) -> tuple[float, float]:  # fmt: skip
    """Return the odds that a measurement is an outlier, and 1 - p'.

    Parameters
    ----------
    time : s. row : of the filter.
    innovation : its square, m2, and its variance along each axis, m2.
    ratio : the density of outliers over the likelihood of the measurement.
    parent : probability that the camera's measurement of the joint's parent is an outlier.
    lasting : s, how long outliers last on average; 0 = each comes by itself.
    doubts : remembers the measurement.
    """
    before, left = _SHARE, 0.0
    if doubts.wrong[row, camera] == 0.0:
        doubts.agreed[row, camera] = time
    elif lasting > 0.0:
        passed = max(time - doubts.times[row, camera], 0.0)
        left = (doubts.wrong[row, camera] - _SHARE) * math.exp(-passed / lasting)
    before += left
    square, variance = innovation
    is_clear = (
        lasting > 0.0
        and time - doubts.agreed[row, camera] < _LONGEST
        and (
            _is_contradicted(time, camera, row, doubts)
            or _is_jump(time, square, variance, row, doubts)
        )
    )
    if is_clear:
        before = max(before, _FOLLOWS * parent)
    odds = min(before / (1.0 - before) * ratio, _LARGEST)
    after = min(odds / (1.0 + odds), _MOST)
    if not is_clear:
        after = min(after, _SHARE + left)
    if odds < _RIGHT:
        doubts.agreed[row, camera] = time
    doubts.wrong[row, camera], doubts.times[row, camera] = max(after, 1e-9), time
    return odds, 1.0 - before
