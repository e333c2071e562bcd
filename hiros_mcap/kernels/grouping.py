"""Which skeletons of several cameras at one instant are the same person."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import B1, B2, F1, F2, F3, I1, J1, arrays
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.kernels.points import norm3
from hiros_mcap.skeletons import Floats

_SHARE = 0.75  # of two skeletons' joints, this share with the smallest distances is compared
_LEAST = 4  # skeletons with fewer joints in common are not compared
_SURELY = 1.0 + 1e-9  # times the gate: over it, whatever rounding does


class Skeletons(NamedTuple):
    """N skeletons in a common frame, instant by instant."""

    positions: F3  # (N, M, 3) m
    weights: F2  # (N, M) 0 = absent
    cameras: I1  # (N,) index of the camera
    mirror: J1  # (M,) slot of the joint on the other side


class Groups(NamedTuple):
    """Who is who, for N skeletons."""

    people: I1  # (N,) first row of the group that a skeleton belongs to; its own if it is alone
    mirrored: B1  # (N,) whether its sides are swapped against those of that row
    distances: F1  # (N,) mean distance, m, to the skeleton by which it joined; inf for a first row


class GroupingWork(NamedTuple):
    """Scratch for instants of up to S skeletons."""

    distances: F2  # (S, S)
    mirrored: B2  # (S, S)
    joints: F1  # (2 M,)
    nearest: F1  # (S,) least distance to a later skeleton that is not joined yet
    partners: I1  # (S,) which one that is

    @classmethod
    def allocate(cls, n_skeletons: int, n_markers: int) -> GroupingWork:
        """Allocate the arrays."""
        return arrays(cls, *2 * [(n_skeletons, n_skeletons)], 2 * n_markers, *2 * [n_skeletons])


@kernel
def _sum_of_least(values: Floats, n: int, kept: int) -> float:
    """Sum of the ``kept`` smallest of the first n values; some others are gathered behind these.

    To sort all of them takes three times as long.
    """
    end = n
    for i in range(n):
        value, k = values[i], end
        if end < 2 * n - kept:
            end += 1
        elif value <= values[n]:
            continue
        else:  # in place of the least of the largest
            k = n
            while k + 1 < end and values[k + 1] < value:
                values[k] = values[k + 1]
                k += 1
            values[k] = value
            continue
        while k > n and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    total, less = 0.0, 0
    for i in range(n):
        if values[i] < values[n]:
            total += values[i]
            less += 1
    return total + (kept - less) * values[n]


@kernel
def _distance(
    skeletons: Skeletons, a: int, b: int, swapped: bool, gate: float, joints: Floats
) -> float:
    """Mean of the smallest distances of the joints that both have; inf if it is over the gate."""
    n, most = 0, len(skeletons.mirror)
    clipped = 0.0  # sum of the distances, each twice the gate at most
    enough = _SURELY * gate * (2.0 * most - np.ceil(_SHARE * most))
    for m in range(most):
        other = skeletons.mirror[m] if swapped else m
        if skeletons.weights[a, m] > 0.0 and skeletons.weights[b, other] > 0.0:
            p, q = skeletons.positions[a, m], skeletons.positions[b, other]
            joints[n] = norm3(p[0] - q[0], p[1] - q[1], p[2] - q[2])
            clipped += min(joints[n], 2.0 * gate)
            if clipped > enough:  # whatever the other joints are
                return np.inf
            n += 1
    kept = int(np.ceil(_SHARE * n))
    # Those that are left out add twice the gate at most.
    if n < _LEAST or clipped - 2.0 * gate * (n - kept) > _SURELY * gate * kept:
        return np.inf
    total = _sum_of_least(joints, n, kept)
    return total / kept if total <= gate * kept else np.inf


@kernel
def _compare(skeletons: Skeletons, begin: int, end: int, gate: float, work: GroupingWork) -> None:
    """Write the distances of all skeletons of an instant; inf within a camera or over the gate."""
    for a in range(begin, end):
        for b in range(a + 1, end):
            work.distances[a - begin, b - begin] = np.inf
            if skeletons.cameras[a] == skeletons.cameras[b]:
                continue
            straight = _distance(skeletons, a, b, False, gate, work.joints)
            # Only what is nearer counts: most need not be compared any further.
            least = min(gate, _SURELY * straight)
            swapped = _distance(skeletons, a, b, True, least, work.joints)
            work.distances[a - begin, b - begin] = min(straight, swapped)
            work.mirrored[a - begin, b - begin] = swapped < straight


@kernel
def _find_partner(i: int, n: int, work: GroupingWork) -> None:
    """Write which of the later ones of n skeletons is the nearest to one."""
    work.nearest[i], work.partners[i] = np.inf, -1
    for j in range(i + 1, n):
        if work.distances[i, j] < work.nearest[i]:
            work.nearest[i], work.partners[i] = work.distances[i, j], j


@kernel
def _share_a_camera(
    skeletons: Skeletons, groups: Groups, begin: int, end: int, a: int, b: int
) -> bool:
    """Whether the groups of ``a`` and ``b`` both hold a skeleton of one camera."""
    for i in range(begin, end):
        if groups.people[i] == groups.people[a]:
            for j in range(begin, end):
                if groups.people[j] == groups.people[b] and (
                    skeletons.cameras[i] == skeletons.cameras[j]
                ):
                    return True
    return False


@kernel
def _join(groups: Groups, begin: int, end: int, a: int, b: int, mirrored: bool) -> None:
    """Put the group of ``b`` to that of ``a``, or the other way round: the first row leads."""
    lead, other = groups.people[a], groups.people[b]
    swap = mirrored ^ groups.mirrored[a] ^ groups.mirrored[b]
    if other < lead:
        lead, other = other, lead
    for i in range(begin, end):
        if groups.people[i] == other:
            groups.people[i] = lead
            groups.mirrored[i] ^= swap


@entry
def group_people(
    skeletons: Skeletons, begins: I1, gate: float, work: GroupingWork, groups: Groups
) -> None:
    """Join the skeletons of each instant to people, the nearest first, one of each camera.

    Two skeletons are compared as they are and with swapped sides, by the three quarters of their
    joints that are nearest to each other.

    Parameters
    ----------
    begins : (K + 1,) first row of each instant, and N. gate : largest distance, m.
    """
    for k in range(len(begins) - 1):
        begin, end = begins[k], begins[k + 1]
        _compare(skeletons, begin, end, gate, work)
        for i in range(begin, end):
            groups.people[i] = i
            groups.mirrored[i] = False
            groups.distances[i] = np.inf
            _find_partner(i - begin, end - begin, work)
        while True:
            nearest, one = np.inf, -1
            for i in range(end - begin):
                if work.nearest[i] < nearest:
                    nearest, one = work.nearest[i], i
            if one < 0:
                break
            other = work.partners[one]
            work.distances[one, other] = np.inf
            _find_partner(one, end - begin, work)
            a, b = begin + one, begin + other
            if groups.people[a] == groups.people[b]:
                continue
            if _share_a_camera(skeletons, groups, begin, end, a, b):
                continue
            later = max(groups.people[a], groups.people[b])
            _join(groups, begin, end, a, b, work.mirrored[one, other])
            groups.distances[later] = nearest
