"""Constant limb lengths, from the root to the leaves (Malaguti et al. 2019, III-E)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import B1, F2, F3, I1, J2
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.kernels.points import point_distance
from hiros_mcap.skeletons import Floats

_SHORTEST = 1e-6  # m; a shorter link has no direction


class LimbLengths(NamedTuple):
    """What is known of people's limbs: R rows, L links."""

    lengths: F2  # (R, L) m
    squares: F2  # (R, L) sum of the squared deviations of the first lengths, m2
    frames: I1  # (R,) frames with the whole skeleton that were measured
    given: B1  # (R,) whether the lengths are known from before; NaN = a link has none


class LinkTree(NamedTuple):
    """The hierarchical model (Fig. 2)."""

    ends: J2  # (L, 2) parent and child marker slot of each link
    order: I1  # links, a parent's before its children's; those that close a loop are left out


class LimbSettings(NamedTuple):
    """Parameters of ``straighten`` that the kernels need."""

    frames: int
    rate: float


@kernel
def _length(pose: Floats, tree: LinkTree, k: int) -> float:
    """Measured length of link k in a pose (M, 19), m; NaN if an end is absent."""
    return point_distance(pose[tree.ends[k, 1]], pose[tree.ends[k, 0]])


@kernel
def _learn(
    pose: Floats, row: int, past: LimbLengths, tree: LinkTree, settings: LimbSettings
) -> None:
    """Average the first whole skeletons; adapt the lengths slowly afterwards."""
    frames = past.frames[row]
    is_whole = True
    for k in tree.order:
        is_whole &= not np.isnan(_length(pose, tree, k))
    for k in tree.order:
        error = _length(pose, tree, k) - past.lengths[row, k]
        if frames < settings.frames:
            if is_whole:
                past.lengths[row, k] += error / (frames + 1)
                past.squares[row, k] += error * error * frames / (frames + 1)
        elif not np.isnan(error):
            past.lengths[row, k] += settings.rate * error
    if frames < settings.frames:
        past.frames[row] += is_whole


@kernel
def _apply(pose: Floats, lengths: Floats, tree: LinkTree) -> None:
    """Give every link its length (L,), m, by moving its child; the parents have moved before.

    The minimum of eq 12 has a closed form. Theta_kf points from the moved parent to the filter's
    child (eq 13), so the point at the link's length in this direction makes both terms 0. A link
    without a length is left alone.
    """
    for k in tree.order:
        parent, child = tree.ends[k, 0], tree.ends[k, 1]
        measured = _length(pose, tree, k)
        if np.isnan(measured + lengths[k]) or measured < _SHORTEST:
            continue
        scale = lengths[k] / measured
        for c in range(3):
            start = pose[parent, c]
            pose[child, c] = start + scale * (pose[child, c] - start)  # eq 12


@entry
def straighten(
    markers: F3, rows: I1, past: LimbLengths, tree: LinkTree, settings: LimbSettings
) -> None:
    """Learn the limb lengths of people (P, M, 19), if they are not given, and apply them in place.

    ``rows`` (P,) are the people's rows in ``past``; -1 = left alone, like anybody with too few
    frames.
    """
    for p in range(len(rows)):
        row = rows[p]
        if row < 0:
            continue
        if not past.given[row]:
            _learn(markers[p], row, past, tree, settings)
        if past.given[row] or past.frames[row] >= settings.frames:
            _apply(markers[p], past.lengths[row], tree)
