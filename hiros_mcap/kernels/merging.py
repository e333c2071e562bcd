"""Kernels of the merger: votes and weighted means over cameras (Hi-ROS 2023, section 3.2).

A *view* is what one camera reports of one person. N views of a buffer lie in arrays (N, ...);
``members`` are the indices of one person's views. What is remembered of each person lies in a bank
of arrays with one row per person:

- ``positions``, ``velocities`` (S, M, 3), ``turns`` (S, L, 4): the last merged pose
- ``bias`` (S, C, M, 3): slow offset of each camera's markers from the merged ones, m
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import types

from hiros_mcap.kernels.averaging import (
    load_views,
    mean_columns,
    mean_confidence,
    mean_people,
    mean_turn,
)
from hiros_mcap.kernels.compile import kernel, named_tuple
from hiros_mcap.kernels.distance import norm3
from hiros_mcap.kernels.quaternions import angle_of
from hiros_mcap.skeletons import Flags, Floats, Ints, Stamps

_I1, _I2, _F1 = types.int64[::1], types.int64[:, ::1], types.float64[::1]
_F2, _F3, _F4 = types.float64[:, ::1], types.float64[:, :, ::1], types.float64[:, :, :, ::1]

KEPT, FLIPPED, RELABELLED = 0, 1, 2
AGREED, TURNED, HELD = 0, 1, 2

# A way of facing that was seen for so long is held against others this many times as long.
_TRUST = 3.0

# Against the past alone, swapping has to leave less than this share of a view's distance to it.
_CLEARLY = 0.75


class Work(NamedTuple):
    """Room for what is between input and output, for up to N views, K of them of one person.

    It is the caller's: a kernel that makes arrays is twice as slow.
    """

    members: Stamps
    """(K,)."""
    verdicts: Stamps
    outliers: Stamps
    """(N,)."""
    flags: Flags
    weights: Floats
    """(2, K)."""
    powers: Floats
    link_powers: Floats
    """(N, M) and (N, L)."""
    past: Floats
    past_turn: Floats
    reference: Floats
    """(M, 3), (L, 4) and (M, 3)."""
    points: Floats
    """(2, 3)."""
    places: Floats
    turns: Floats
    """(K + 1, 3) and (K + 1, 4)."""
    apart: Floats
    alone: Floats
    """((K + 1)^2,) each, of which what is needed is taken as a square."""

    @classmethod
    def of(cls, views: int, members: int, n_markers: int, n_links: int) -> Work:
        """Make room."""
        n, k, m, links = views, members, n_markers, n_links
        shapes = (
            (2, k), (n, m), (n, links), (m, 3), (links, 4), (m, 3), (2, 3), (k + 1, 3), (k + 1, 4),
        )  # fmt: skip
        numbers = [np.empty(shape) for shape in shapes]
        verdicts, outliers = np.empty((2, n), np.int64)
        flags, squares = np.empty((2, k), np.bool_), np.empty((2, (k + 1) ** 2))
        return cls(np.empty(k, np.int64), verdicts, outliers, flags, *numbers, *squares)


_WORK = named_tuple(Work, _I1, _I1, _I1, types.boolean[:, ::1], *[_F2] * 9, _F1, _F1)


@kernel
def _dot4(a: Floats, i: int, b: Floats, j: int) -> float:
    """Scalar product of rows of two (N, 4) arrays."""
    dot: float = a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2] + a[i, 3] * b[j, 3]
    return dot


@kernel
def _lateral(poses: Floats, view: int, pairs: Ints, out: Floats, row: int) -> None:
    """Write the direction from left to right, the mean over shoulders and hips; NaN if unknown."""
    x = y = z = 0.0
    for i in range(pairs.shape[0]):
        a, b = pairs[i, 0], pairs[i, 1]
        dx = poses[view, b, 0] - poses[view, a, 0]
        dy = poses[view, b, 1] - poses[view, a, 1]
        dz = poses[view, b, 2] - poses[view, a, 2]
        length = norm3(dx, dy, dz)
        if length > 1e-6:  # false for NaN
            x += dx / length
            y += dy / length
            z += dz / length
    length = norm3(x, y, z)
    if length < 1e-6:
        length = np.nan
    out[row, 0], out[row, 1], out[row, 2] = x / length, y / length, z / length


@kernel
def _facing_angles(sides: Floats, pelvis: Floats, out: Floats) -> None:
    """(N, N) angles, rad, between the facing directions of N poses; NaN = unknown.

    ``sides`` (N, 3) are the directions from left to right, ``pelvis`` (N, 4) the orientations of
    the pelvis (compared by eq 10), NaN where unknown. Where both are known the larger angle
    counts, since a detector may flip either.
    """
    n = sides.shape[0]
    for a in range(n):
        for b in range(n):
            d = np.nan
            if not (math.isnan(pelvis[a, 0]) or math.isnan(pelvis[b, 0])):
                d = angle_of(_dot4(pelvis, a, pelvis, b))
            if not (math.isnan(sides[a, 0]) or math.isnan(sides[b, 0])):
                dot = (
                    sides[a, 0] * sides[b, 0]
                    + sides[a, 1] * sides[b, 1]
                    + sides[a, 2] * sides[b, 2]
                )
                angle = math.acos(min(1.0, max(-1.0, dot)))
                d = angle if math.isnan(d) else max(d, angle)
            out[a, b] = d


@kernel("int64(float64[:,::1], float64[::1], boolean, float64)")
def largest_group(apart: Floats, weights: Floats, has_past: bool, limit: float) -> int:
    """Index whose neighbours, at a distance below ``limit``, are the right views; -1 = no view.

    ``apart`` (N, N) are distances, NaN on the diagonal for an absent view; with ``has_past`` the
    last index is the previous merged pose, which has a vote like any camera but is not a view.
    The largest group wins; of equal ones that nearest to the past, then that of most confidence,
    then the tightest: never the order of the cameras.
    """
    n = apart.shape[0]
    views = n - 1 if has_past else n
    best = -1
    best_votes, best_past, best_weight, best_spread = 0, 0.0, 0.0, 0.0
    for k in range(views):
        if math.isnan(apart[k, k]):
            continue
        votes, weight, spread = 0, 0.0, 0.0
        for j in range(n):
            if apart[k, j] < limit:
                votes += 1
                spread += apart[k, j]
                if j < views:
                    weight += weights[j]
        past = 0.0
        if has_past and not math.isnan(apart[k, n - 1]):
            past = apart[k, n - 1]
        better = votes > best_votes
        if votes == best_votes and best >= 0:
            if past != best_past:
                better = past < best_past
            elif abs(weight - best_weight) > 1e-12:
                better = weight > best_weight
            else:
                better = spread < best_spread
        if best < 0 or better:
            best, best_votes, best_past, best_weight, best_spread = k, votes, past, weight, spread
    return best


@kernel
def _is_tied(apart: Floats, best: int, limit: float) -> bool:
    """Whether somebody not among those who agree with ``best`` has as many; the past included."""
    n = apart.shape[0]
    most = 0
    for j in range(n):
        most += int(apart[best, j] < limit)
    for k in range(n):
        if not math.isnan(apart[k, k]) and not apart[best, k] < limit:
            votes = 0
            for j in range(n):
                votes += int(apart[k, j] < limit)
            if votes >= most:
                return True
    return False


@kernel
def _raise(members: Stamps, confidences: Floats, power: float, out: Floats) -> None:
    """Fill ``out`` with the weights of eq 12: confidences to a power, 1 where not given."""
    for k in members:
        for m in range(out.shape[1]):
            c = confidences[k, m]
            if math.isnan(c):
                out[k, m] = 1.0
            elif power == 2.0:  # the power function takes twenty times as long
                out[k, m] = c * c
            else:
                out[k, m] = c**power


@kernel
def _weigh(members: Stamps, powers: Floats, m: int, usable: Flags, out: Floats) -> None:
    """Weight of each usable view; equal if all are zero."""
    total = 0.0
    for k in range(len(members)):
        out[k] = powers[members[k], m] if usable[k] else 0.0
        total += out[k]
    if total <= 0.0:
        for k in range(len(members)):
            out[k] = 1.0 if usable[k] else 0.0


@kernel
def _plain_mean(here: Floats, weights: Floats, out: Floats) -> None:
    """Weighted mean of the rows of ``here``: a start that prefers no camera."""
    norm = x = y = z = 0.0
    for k in range(len(weights)):
        if weights[k] > 0.0:
            norm += weights[k]
            x += weights[k] * here[k, 0]
            y += weights[k] * here[k, 1]
            z += weights[k] * here[k, 2]
    out[0], out[1], out[2] = x / norm, y / norm, z / norm


@kernel
def _robust_mean(
    here: Floats, weights: Floats, robust: Floats, start: Floats, scale: float, out: Floats
) -> None:
    """Weighted mean (eq 12) of the rows of ``here``, by Cauchy weights of ``scale`` m.

    The weights are multiplied by how much each row counts, so that velocities can use them.
    """
    for c in range(3):
        out[c] = start[c]
    for _ in range(3 if scale > 0.0 else 1):
        norm = x = y = z = 0.0
        for k in range(len(weights)):
            robust[k] = weights[k]
            if weights[k] <= 0.0:
                continue
            if scale > 0.0:
                dx, dy, dz = here[k, 0] - out[0], here[k, 1] - out[1], here[k, 2] - out[2]
                robust[k] /= 1.0 + (dx * dx + dy * dy + dz * dz) / (scale * scale)
            norm += robust[k]
            x += robust[k] * here[k, 0]
            y += robust[k] * here[k, 1]
            z += robust[k] * here[k, 2]
        out[0], out[1], out[2] = x / norm, y / norm, z / norm
    for k in range(len(weights)):
        weights[k] = robust[k]


@kernel
def _vote(
    apart: Floats, weights: Floats, voter: bool, limit: float, drop: bool, usable: Flags,
    lost: Flags,
) -> int:  # fmt: skip
    """Strike out the views that are not in the largest group; return its centre.

    With ``drop``, all of them if another group is as large.
    """
    n = len(usable)
    best: int = largest_group(apart, weights, voter, limit)
    none = drop and _is_tied(apart, best, limit)
    for k in range(n):
        if usable[k] and (none or not apart[best, k] < limit):
            usable[k] = False
            lost[k] = True
    return best


@kernel
def _first(usable: Flags) -> int:
    k = 0
    while not usable[k]:
        k += 1
    return k


@kernel
def _agree(here: Floats, usable: Flags, voter: bool, limit: float) -> bool:
    """Whether all positions lie within ``limit`` of one of them, so that no vote is needed."""
    n = len(usable)
    centre = n if voter else _first(usable)
    for k in range(n):
        if usable[k]:
            dx = here[k, 0] - here[centre, 0]
            dy = here[k, 1] - here[centre, 1]
            dz = here[k, 2] - here[centre, 2]
            if dx * dx + dy * dy + dz * dz >= limit * limit:
                return False
    return True


@kernel
def _aligned(turns: Floats, usable: Flags, voter: bool, near: float) -> bool:
    """Whether all orientations lie near one of them, so that no vote is needed."""
    n = len(usable)
    centre = n if voter else _first(usable)
    for k in range(n):
        if usable[k] and abs(_dot4(turns, k, turns, centre)) <= near:
            return False
    return True


@kernel
def _merge_markers(
    members: Stamps, views: Floats, confidences: Floats, bias: Floats, person: int,
    cameras: Stamps, limit: float, drop: bool, scale: float, learning: float, work: Work, p: int,
    out: Floats, out_confidences: Floats,
) -> None:  # fmt: skip
    """Merge the markers of one person's views (outlier vote, then eq 12).

    Parameters
    ----------
    members : (K,) views of the person. views, confidences : (N, M, 19), (N, M).
    bias, person, cameras : (S, C, M, 3), the person's row in it, (N,) the camera of each view.
    limit : m, views closer than this agree; <= 0 turns the vote off. drop : on a tie, everything.
    scale : m, of the robust mean; <= 0 = plain eq 12.
    learning : fraction by which a camera's bias follows its offset; 0 = no bias.
    work : whose ``powers`` are the confidences to a power, and ``past`` (M, 3) is the previous
        pose, NaN = no vote. Votes lost are added to its ``outliers``.
    p, out, out_confidences : row of the outputs (P, M, 19), (P, M) to fill.
    """
    n = len(members)
    powers, past, here = work.powers, work.past, work.places
    apart = work.apart[: (n + 1) * (n + 1)].reshape((n + 1, n + 1))
    alone = work.alone[: n * n].reshape((n, n))
    weights, robust = work.weights[0, :n], work.weights[1, :n]
    usable, lost = work.flags[0, :n], work.flags[1, :n]
    start, mean = work.points[0], work.points[1]
    for m in range(views.shape[1]):
        count = 0
        for k in range(n):
            v = members[k]
            usable[k] = not math.isnan(views[v, m, 0])
            lost[k] = False
            count += int(usable[k])
            for c in range(3):
                here[k, c] = views[v, m, c] - bias[person, cameras[v], m, c]
        if count == 0:
            continue
        voter = not math.isnan(past[m, 0])
        for c in range(3):
            here[n, c] = past[m, c]
        _weigh(members, powers, m, usable, weights)
        if limit > 0.0 and not _agree(here, usable, voter, 0.5 * limit):
            for a in range(n + 1):
                for b in range(n + 1):
                    apart[a, b] = norm3(
                        here[a, 0] - here[b, 0], here[a, 1] - here[b, 1], here[a, 2] - here[b, 2]
                    )
            if not voter:
                for a in range(n):
                    for b in range(n):
                        alone[a, b] = apart[a, b]
            best = _vote(apart if voter else alone, weights, voter, limit, drop, usable, lost)
            _weigh(members, powers, m, usable, weights)
            voter = voter and apart[best, n] < limit
        else:
            best = _first(usable)
            voter = voter and limit > 0.0
        if voter:
            for c in range(3):
                start[c] = here[n, c]
        else:
            _plain_mean(here, weights, start)
        _robust_mean(here, weights, robust, start, scale, mean)
        for c in range(3):
            out[p, m, c] = mean[c]
        if not math.isnan(views[members[best], m, 6]):
            mean_turn(views, members, m, weights, best, out, p)
        for first in (7, 10, 13, 16):
            mean_columns(views, members, m, first, weights, out, p)
        out_confidences[p, m] = mean_confidence(members, confidences, m, weights)
        heaviest = 0.0
        for k in range(n):
            heaviest = max(heaviest, weights[k])
        for k in range(n):
            work.outliers[members[k]] += int(lost[k])
            if learning > 0.0 and weights[k] > 0.0:
                # In proportion to the weight that the view has: a guess teaches little.
                rate = learning * weights[k] / heaviest
                for c in range(3):
                    bias[person, cameras[members[k]], m, c] += rate * (here[k, c] - mean[c])


@kernel
def _merge_links(
    members: Stamps, views: Floats, confidences: Floats, limit: float, drop: bool, work: Work,
    p: int, out: Floats, out_confidences: Floats,
) -> None:  # fmt: skip
    """Merge the links of one person's views as :func:`_merge_markers` does, by orientation.

    ``limit`` is in rad (eq 10). A link without orientation is averaged without a vote.
    """
    n = len(members)
    powers, past, turns, weights = work.link_powers, work.past_turn, work.turns, work.weights[0, :n]
    apart = work.apart[: (n + 1) * (n + 1)].reshape((n + 1, n + 1))
    alone = work.alone[: n * n].reshape((n, n))
    usable, lost = work.flags[0, :n], work.flags[1, :n]
    near = math.cos(0.25 * max(limit, 0.0))  # of half the angle between two quaternions
    for m in range(views.shape[1]):
        turned = 0
        for k in range(n):
            v = members[k]
            usable[k] = not math.isnan(views[v, m, 3])
            lost[k] = False
            turned += int(usable[k])
            for c in range(4):
                turns[k, c] = views[v, m, 3 + c]
        if turned == 0:
            for k in range(n):
                v = members[k]
                usable[k] = not (math.isnan(views[v, m, 0]) and math.isnan(confidences[v, m]))
        _weigh(members, powers, m, usable, weights)
        if turned > 0:
            voter = not math.isnan(past[m, 0])
            for c in range(4):
                turns[n, c] = past[m, c]
            best = _first(usable)
            if limit > 0.0 and not _aligned(turns, usable, voter, near):
                for a in range(n + 1):
                    for b in range(a + 1):
                        dot = _dot4(turns, a, turns, b)
                        apart[a, b] = apart[b, a] = np.nan if math.isnan(dot) else angle_of(dot)
                if not voter:
                    for a in range(n):
                        for b in range(n):
                            alone[a, b] = apart[a, b]
                best = _vote(apart if voter else alone, weights, voter, limit, drop, usable, lost)
                _weigh(members, powers, m, usable, weights)
            mean_turn(views, members, m, weights, best, out, p)
        for first in (0, 7, 10, 13, 16):
            mean_columns(views, members, m, first, weights, out, p)
        out_confidences[p, m] = mean_confidence(members, confidences, m, weights)
        for k in range(n):
            work.outliers[members[k]] += int(lost[k])


@kernel
def _right_views(
    apart: Floats, trust: Floats, has_past: bool, patient: bool, limit: float, right: Flags
) -> bool:
    """Mark the views that face as the largest group does; whether the past decided against all.

    With ``patient``, the past wins over views that face the other way unless they are more than
    those on its side (it counts as one).
    """
    n = len(trust)
    best = largest_group(apart, trust, has_past, limit)
    if has_past and patient and apart[best, n] >= limit:
        with_best = with_past = 0
        for k in range(n + 1):
            with_best += int(apart[best, k] < limit)
            with_past += int(apart[n, k] < limit)
        if with_past >= with_best:
            best = n
    none = True
    for k in range(n):
        right[k] = not apart[best, k] >= limit
        none = none and not right[k]
    return none


@kernel
def _blank(states: Floats, confidences: Floats) -> None:
    """Make states absent."""
    for p in range(states.shape[0]):
        for m in range(states.shape[1]):
            confidences[p, m] = np.nan
            for c in range(states.shape[2]):
                states[p, m, c] = np.nan


@kernel
def _mend(
    view: int, markers: Floats, confidences: Floats, links: Floats, link_confidences: Floats,
    mirror: Ints, reference: Floats, relabel: bool, drop: bool,
) -> int:  # fmt: skip
    """Swap the sides of a view if that brings it near ``reference``; else drop it, or leave it.

    Where it is not to be dropped, there is only the past to go by, which may be distorted: then
    swapping has to bring the view clearly nearer.
    """
    as_is = swapped = 0.0
    both = 0
    n_markers = markers.shape[1]
    for m in range(n_markers):
        d = norm3(
            markers[view, m, 0] - reference[m, 0],
            markers[view, m, 1] - reference[m, 1],
            markers[view, m, 2] - reference[m, 2],
        )
        s = norm3(
            markers[view, mirror[m], 0] - reference[m, 0],
            markers[view, mirror[m], 1] - reference[m, 1],
            markers[view, mirror[m], 2] - reference[m, 2],
        )
        if not math.isnan(d) and not math.isnan(s):
            as_is += d
            swapped += s
            both += 1
    if relabel and both > 0 and swapped < (1.0 if drop else _CLEARLY) * as_is:
        for m in range(n_markers):
            other = mirror[m]
            if other > m:
                for c in range(markers.shape[2]):
                    value = markers[view, m, c]
                    markers[view, m, c] = markers[view, other, c]
                    markers[view, other, c] = value
                value = confidences[view, m]
                confidences[view, m] = confidences[view, other]
                confidences[view, other] = value
        verdict = RELABELLED
    elif drop:
        for m in range(n_markers):
            markers[view, m, 0] = np.nan
        verdict = FLIPPED
    else:
        return KEPT
    # A detector that turns a body round turns the links' frames, too, each by its own convention:
    # they are unknown now.
    _blank(links[view : view + 1], link_confidences[view : view + 1])
    return verdict


@kernel
def _settle_flips(
    members: Stamps, markers: Floats, confidences: Floats, links: Floats,
    link_confidences: Floats, has_past: bool, patient: bool, mirror: Ints, pairs: Ints,
    pelvis: int, limit: float, relabel: bool, drop: bool, work: Work,
) -> int:  # fmt: skip
    """Mend the views of one person that face the wrong way; with ``drop``, leave all out on a tie.

    Returns AGREED if a view faces as the past does, TURNED if the views outvoted the past, HELD if
    the past outvoted them.
    """
    n = len(members)
    size = n + 1 if has_past else n
    if size == 1:
        return AGREED
    past, verdicts = work.past, work.verdicts
    sides, turns, trust = work.places[:size], work.turns[:size], work.weights[0, :n]
    for k in range(n):
        view = members[k]
        _lateral(markers, view, pairs, sides, k)
        for c in range(4):
            turns[k, c] = links[view, pelvis, 3 + c] if pelvis >= 0 else np.nan
        trust[k] = 0.0
        for m in range(confidences.shape[1]):
            trust[k] += 1.0 if math.isnan(confidences[view, m]) else confidences[view, m]
    if has_past:
        _lateral(past.reshape((1, past.shape[0], 3)), np.int64(0), pairs, sides, n)
        for c in range(4):
            turns[n, c] = work.past_turn[pelvis, c] if pelvis >= 0 else np.nan
    apart = work.apart[: size * size].reshape((size, size))
    _facing_angles(sides, turns, apart)
    conflict = False
    for a in range(size):
        for b in range(size):
            conflict = conflict or apart[a, b] >= limit
    if not conflict:
        return AGREED
    for k in range(size):
        if not math.isnan(apart[k, k]):  # who faces nowhere known leads no group
            apart[k, k] = 0.0
    if drop and _is_tied(apart, largest_group(apart, trust, has_past, limit), limit):
        for k in range(n):
            v = members[k]
            _blank(markers[v : v + 1], confidences[v : v + 1])
            _blank(links[v : v + 1], link_confidences[v : v + 1])
            verdicts[v] = FLIPPED
        return HELD
    right = work.flags[0, :n]
    none = _right_views(apart, trust, has_past, patient, limit, right)
    reference = past if none else work.reference
    if not none:
        for m in range(past.shape[0]):
            reference[m, 0] = np.nan
            count = x = y = z = 0.0
            for k in range(n):
                v = members[k]
                if right[k] and not math.isnan(markers[v, m, 0]):
                    count += 1.0
                    x += markers[v, m, 0]
                    y += markers[v, m, 1]
                    z += markers[v, m, 2]
            if count > 0.0:
                reference[m, 0], reference[m, 1], reference[m, 2] = x / count, y / count, z / count
    for k in range(n):
        if not right[k]:
            verdicts[members[k]] = _mend(
                members[k], markers, confidences, links, link_confidences, mirror, reference,
                relabel, not none,
            )  # fmt: skip
    if none:
        for k in range(n):
            if verdicts[members[k]] != KEPT:
                return HELD
        return TURNED
    if has_past:
        for k in range(n):
            if right[k] and not apart[k, n] >= limit:
                return AGREED
        return TURNED
    return AGREED


@kernel
def _fuse(
    stamp: int,
    n: int,
    whose: Stamps,
    trust: Floats,
    markers: Floats,
    confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    rows: Stamps,
    seen: Stamps,
    facing_seen: Stamps,
    facing_since: Stamps,
    positions: Floats,
    velocities: Floats,
    turns: Floats,
    bias: Floats,
    mirror: Ints,
    pairs: Ints,
    numbers: Floats,
    out_stamps: Stamps,
    out_trust: Floats,
    out: Floats,
    out_confidences: Floats,
    out_links: Floats,
    out_link_confidences: Floats,
    counts: Stamps,
    work: Work,
) -> None:
    """Merge an instant: settle flips, vote, average (H25); see :func:`fuse`."""
    person_of, cameras = whose[0, :n], whose[1, :n]
    n_markers, n_links = markers.shape[1], links.shape[1]
    past, past_turn = work.past, work.past_turn
    for k in range(n):
        work.verdicts[k], work.outliers[k] = KEPT, 0
    no_pairs = pairs[:0]
    for p in range(len(rows)):
        count = 0
        for k in range(n):
            if person_of[k] == p:
                work.members[count] = k
                count += 1
        if count == 0:
            continue
        members = work.members[:count]
        row = rows[p]
        age = (stamp - seen[row]) * 1e-9
        fresh = seen[row] > 0 and age <= numbers[0]
        has_past = fresh and numbers[8] > 0.0
        for m in range(n_markers):
            for c in range(3):
                past[m, c] = np.nan
                if fresh:
                    past[m, c] = positions[row, m, c] + max(age, 0.0) * velocities[row, m, c]
        for k in range(n_links):
            for c in range(4):
                past_turn[k, c] = turns[row, k, c] if fresh else np.nan
        facing = AGREED
        if numbers[3] > 0.0:
            # A facing that was seen for a moment only does not outvote others for long.
            known = (facing_seen[row] - facing_since[row]) * 1e-9
            patience = min(numbers[10], _TRUST * known)
            patient = (stamp - facing_seen[row]) * 1e-9 <= patience
            facing = _settle_flips(
                members, markers, confidences, links, link_confidences, has_past, patient, mirror,
                pairs if numbers[7] > 0.0 else no_pairs, int(numbers[6]), numbers[3],
                numbers[9] > 0.0, numbers[13] > 0.0, work,
            )  # fmt: skip
        if facing == TURNED or seen[row] == 0:
            facing_since[row] = stamp
        if facing != HELD:
            facing_seen[row] = stamp
        if not has_past:
            for m in range(n_markers):
                past[m, 0] = np.nan
            for k in range(n_links):
                past_turn[k, 0] = np.nan
        learning = 0.0
        if numbers[12] > 0.0 and fresh:
            learning = 1.0 - math.exp(-max(age, 0.0) / numbers[12])
        _raise(members, confidences, numbers[4], work.powers)
        _merge_markers(
            members, markers, confidences, bias, row, cameras, numbers[1], numbers[13] > 0.0,
            numbers[5], learning, work, p, out, out_confidences,
        )  # fmt: skip
        _raise(members, link_confidences, numbers[4], work.link_powers)
        _merge_links(
            members, links, link_confidences, numbers[2], numbers[13] > 0.0, work, p, out_links,
            out_link_confidences,
        )  # fmt: skip
        seen[row] = stamp
        for m in range(n_markers):
            for c in range(3):
                positions[row, m, c] = out[p, m, c]
                v = out[p, m, 7 + c]
                velocities[row, m, c] = 0.0 if math.isnan(v) else v
        for k in range(n_links):
            for c in range(4):
                turns[row, k, c] = out_links[p, k, 3 + c]
    for k in range(n):
        counts[0, cameras[k]] += work.outliers[k]
        counts[1, cameras[k]] += work.verdicts[k] != KEPT
    mean_people(stamp, person_of, whose[2, :n], trust[:n], numbers[11] > 0.0, out_stamps, out_trust)


@kernel(
    types.void(
        _I1, _I2, _I2, types.int32[::1], _F1, _F3, _F2, _F3, _F2, _I2, _F1, _F3, _F2, _F3, _F2,
        _I1, _I1, _I1, _I1, _F3, _F3, _F3, _F4, types.int32[::1], types.int32[:, ::1], _F1,
        types.int32[::1], _I1, _F1, _F3, _F2, _F3, _F2, _I2, _WORK,
    ),
)  # fmt: skip
def fuse(
    stamps: Stamps,
    ends: Stamps,
    parts: Stamps,
    ids: Ints,
    trust: Floats,
    markers: Floats,
    confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    whose: Stamps,
    view_trust: Floats,
    view_markers: Floats,
    view_confidences: Floats,
    view_links: Floats,
    view_link_confidences: Floats,
    rows: Stamps,
    seen: Stamps,
    facing_seen: Stamps,
    facing_since: Stamps,
    positions: Floats,
    velocities: Floats,
    turns: Floats,
    bias: Floats,
    mirror: Ints,
    pairs: Ints,
    numbers: Floats,
    out_ids: Ints,
    out_stamps: Stamps,
    out_trust: Floats,
    out: Floats,
    out_confidences: Floats,
    out_links: Floats,
    out_link_confidences: Floats,
    counts: Stamps,
    work: Work,
) -> None:
    """Merge instant after instant: settle flips, vote, average (H25).

    Parameters
    ----------
    stamps, ends : (Q,) merged times, ns; (Q + 1, 2) output row and message before which each
        instant ends, from (0, 0) on.
    parts : (K, 4) of each message its people's first row, the one after the last, time and camera.
    ids, trust, markers, confidences, links, link_confidences : (P, ...) the people.
    whose, view_trust, ..., view_link_confidences : room for the views of any instant, as
        :func:`hiros_mcap.kernels.averaging.load_views` fills it.
    rows : bank row of each output row. The bank, by row: ``seen``, ``facing_seen`` and
        ``facing_since`` (S,) stamps, 0 = never; ``positions``, ``velocities``, ``turns``,
        ``bias``; brought to the last instant that shows the person.
    mirror, pairs : of the skeleton's symmetry.
    numbers : horizon, max_position_delta, max_orientation_delta, max_facing_delta, power, scale,
        pelvis link, by sides, past votes, relabel, flip patience, compensate, bias time, drop
        ties (as stages/merge.py packs them).
    out_ids : says whom each output row is to show. ``out``, ..., ``out_link_confidences`` are
        absent in rows without views, whose ``out_stamps`` and ``out_trust`` stay as they are.
    counts : (2, C) votes lost and flips, by camera; added to.
    work : with room for the views of any instant.
    """
    carry = numbers[11] > 0.0
    for q in range(len(stamps)):
        a, b = ends[q, 0], ends[q + 1, 0]
        _blank(out[a:b], out_confidences[a:b])
        _blank(out_links[a:b], out_link_confidences[a:b])
        n: Any = np.int64(0)  # a literal would make a second version of what it is given to
        for k in range(ends[q, 1], ends[q + 1, 1]):
            c, d = parts[k, 0], parts[k, 1]
            n = load_views(
                n, parts[k, 3], parts[k, 2], stamps[q], carry, out_ids[a:b], ids[c:d], trust[c:d],
                markers[c:d], confidences[c:d], links[c:d], link_confidences[c:d], whose,
                view_trust, view_markers, view_confidences, view_links, view_link_confidences,
            )  # fmt: skip
        _fuse(
            stamps[q], n, whose, view_trust, view_markers, view_confidences, view_links,
            view_link_confidences, rows[a:b], seen, facing_seen, facing_since, positions,
            velocities, turns, bias, mirror, pairs, numbers, out_stamps[a:b], out_trust[a:b],
            out[a:b], out_confidences[a:b], out_links[a:b], out_link_confidences[a:b], counts, work,
        )  # fmt: skip
