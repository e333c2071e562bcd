"""Link orientations that agree with the bones, as far as the markers are surer.

Every detector has link axes of its own, and a link's orientation may be that of the bone before or
after it. So the direction in which a bone lies in a link's frame is measured: its mean over the
person's poses so far. The bone that lies most steadily turns with the link.

Where the fused bone deviates from that direction, either is wrong. The deviation has the variance
of the orientation and of the bone's direction together; the latter is known from the markers'. The
link turns by the rest, along the shortest way (Wiener's estimate). Markers stay where they are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from hiros_mcap.frames import Block
from hiros_mcap.kernels.array_types import F2, F4, I1, J3
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.kernels.points import norm3, step_between
from hiros_mcap.kernels.quaternions import (
    Quaternion,
    Vector,
    conjugate,
    exponential,
    multiply,
    normalize,
)
from hiros_mcap.skeletons import UNTRACKED, Floats, Ints, People, SkeletonModel
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.fuse.constrain import UNKNOWN_DEVIATION, unshared_variances

FEWEST, MOST = 30, 1800
"""Poses that show how a bone lies in a link's frame, and those that the mean covers at most."""
_LARGEST = 0.03  # variance, rad2, from which a link does not turn with a bone: 10 degrees
_ORIENTATION = 3  # first column of a quaternion
_COUNT = 3  # column of the axes
_FORGET = 10.0  # s
_CAREFUL = 1.2  # times the variance; to turn a link too far costs more than not far enough


def align_blocks(blocks: Iterable[Block], model: SkeletonModel) -> Iterator[Block]:
    """Turn the links of everybody; each pose is corrected by those before it.

    Parameters
    ----------
    blocks : with positions, m, and link orientations; the uncertainty of markers is used if known.
    model : the skeleton.

    Yields
    ------
    The same frames with other link orientations, at the same times.
    """
    bones = candidates(model)
    shape = model.n_links, bones.shape[1], 4
    bank = Bank((np.zeros((0, *shape)),), _FORGET)
    for block in blocks:
        rows = np.full(len(block.people.ids), -1, np.int64)
        for stamp, (begin, end) in zip(block.stamps.tolist(), block.rows.tolist(), strict=True):
            bank.expire(stamp)
            for row in range(begin, end):
                person = int(block.people.ids[row])
                if person != UNTRACKED:
                    rows[row] = bank.row(person, stamp)
        people = block.people._replace(links=block.people.links.copy())
        align_links(people, rows, _variances(block), bones, *bank.past)
        yield replace(block, people=people)
        del block, people  # else they lie in memory until the next block is made


def candidates(model: SkeletonModel) -> Ints:
    """(L, C, 2) Slots of the ends of the bones that may turn with each link; -1 = none.

    Its own first, then those that end where it begins and those that begin where it ends.
    """
    links = [tuple(ends) for ends in model.links.tolist()]
    bones_of_links = []
    for parent, child in links:
        before = [ends for ends in links if ends[1] == parent >= 0]
        after = [ends for ends in links if ends[0] == child >= 0]
        bones_of_links.append([(parent, child), *before, *after])
    most = max(map(len, bones_of_links), default=1)
    rows = [
        ends_of_link + [(-1, -1)] * (most - len(ends_of_link)) for ends_of_link in bones_of_links
    ]
    return np.array(rows, np.int32).reshape(len(links), most, 2)


def _variances(block: Block) -> Floats:
    """(P, M) Variance of each marker across a bone, m2: known lengths reduce that along it only."""
    if block.uncertainty is None:
        return _CAREFUL * unshared_variances(block)
    return _CAREFUL * np.nan_to_num(block.uncertainty.deviations, nan=UNKNOWN_DEVIATION) ** 2


# The compiled loop.


@inlined
def _turned(q: Quaternion, v: Vector) -> Vector:
    """Rotate a vector."""
    p = multiply(multiply(q, (v[0], v[1], v[2], 0.0)), conjugate(q))
    return p[0], p[1], p[2]


@inlined
def _step(markers: Floats, a: int, b: int) -> Vector:
    """Vector from one marker to another, m; NaN where one is absent or there is no such marker."""
    if a < 0 or b < 0:
        return np.nan, np.nan, np.nan
    return step_between(markers, a, b)


@inlined
def _quaternion(states: Floats, k: int) -> Quaternion:
    """Orientation of a link."""
    i = _ORIENTATION
    return states[k, i], states[k, i + 1], states[k, i + 2], states[k, i + 3]


@kernel
def _observe(people: People, p: int, k: int, bones: Ints, axes: Floats) -> None:
    """Add a pose to the mean directions of all candidates (C, 4) of a link."""
    q = _quaternion(people.links[p], k)
    for c in range(len(bones)):
        x, y, z = _step(people.markers[p], bones[c, 0], bones[c, 1])
        length = norm3(x, y, z)
        if not length > 0.01 or math.isnan(q[0]):
            continue
        x, y, z = _turned(conjugate(q), (x / length, y / length, z / length))
        axes[c, _COUNT] = min(axes[c, _COUNT] + 1.0, MOST)
        gain = 1.0 / axes[c, _COUNT]
        axes[c, 0] += gain * (x - axes[c, 0])
        axes[c, 1] += gain * (y - axes[c, 1])
        axes[c, 2] += gain * (z - axes[c, 2])


@kernel
def _steadiest(axes: Floats) -> int:
    """Return the candidate (C, 4) that lies most steadily in the link; -1 = none does.

    The length of the mean of unit vectors is 1 - v, where v is the variance about each of the two
    axes that they deviate about, to second order (Mardia and Jupp 2000, section 9.2).
    """
    best, least = -1, _LARGEST
    for c in range(len(axes)):
        variance = 1.0 - norm3(axes[c, 0], axes[c, 1], axes[c, 2])
        # The link's own bone comes first; another one has to be clearly steadier.
        if axes[c, _COUNT] >= FEWEST and variance < (least if best < 0 else 0.5 * least):
            best, least = c, variance
    return best


@kernel
def _align(people: People, p: int, k: int, bone: Ints, axis: Floats, variances: Floats) -> None:
    """Turn a link by the share of its deviation from a bone that the link has caused.

    ``axis`` (4,) is the bone's mean direction in the link's frame, ``variances`` (P, M) those of
    the markers, m2. The deviation has the variance of the link's orientation and of the bone's
    direction together; Wiener's estimate of the link's part is that share of the whole.
    """
    step = _step(people.markers[p], bone[0], bone[1])
    length, mean = norm3(*step), norm3(axis[0], axis[1], axis[2])
    q = _quaternion(people.links[p], k)
    if not length > 0.01 or math.isnan(q[0]):
        return
    marker = (variances[p, bone[0]] + variances[p, bone[1]]) / (length * length)
    share = 1.0 - marker / max(1.0 - mean, 1e-9)
    if not share > 0.0:
        return
    u = _turned(q, (axis[0] / mean, axis[1] / mean, axis[2] / mean))
    v = (step[0] / length, step[1] / length, step[2] / length)
    cross = (
        u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0],
    )  # fmt: skip
    sine, cosine = norm3(*cross), u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
    if sine < 1e-9 or cosine < 0.0:  # more than 90 degrees: one of them is wrong
        return
    scale = share * math.atan2(sine, cosine) / sine
    turn = exponential(scale * cross[0], scale * cross[1], scale * cross[2])
    q = normalize(multiply(turn, q))
    for c in range(4):
        people.links[p, k, _ORIENTATION + c] = q[c]


@entry
def align_links(people: People, rows: I1, variances: F2, bones: J3, axes: F4) -> None:
    """Turn the links of people in place, one person after the other.

    Parameters
    ----------
    rows : (P,) row of each person in ``axes``; -1 = nobody known.
    variances : (P, M) of the markers along each axis, m2.
    bones : (L, C, 2) slots of markers: which bones may turn with a link; -1 = none.
    axes : (R, L, C, 4) how bones lay so far: mean direction in the link's frame, number of poses.
    """
    for p in range(len(rows)):
        if rows[p] < 0:
            continue
        for k in range(len(bones)):
            lay = axes[rows[p], k]
            _observe(people, p, k, bones[k], lay)
            best = _steadiest(lay)
            if best >= 0:
                _align(people, p, k, bones[k, best], lay[best], variances)
