"""Topology of a skeleton: the order in which the optimizer eliminates its markers.

Each link couples two markers. The normal equations of a skeleton are 3x3 blocks on the graph of
its links. That graph alone decides which blocks a Cholesky factorization touches. This module works
it out once per model. A tree of any shape fills no new block (leaves first); each loop costs a few
(George & Liu, "Computer Solution of Large Sparse Positive Definite Systems", 1981, chapter 5:
minimum degree).
"""

from __future__ import annotations

import numpy as np

from hiros_mcap.skeletons import SkeletonModel
from hiros_mcap.stages.optimize.normal_equations import Topology


def topology_of(model: SkeletonModel) -> Topology:
    """Choose the elimination order (minimum degree, ties by slot) and lay out the blocks."""
    couples = _couples(model)
    near: list[set[int]] = [set() for _ in range(model.n_markers)]
    for p, d in filter(None, couples):
        near[p].add(d)
        near[d].add(p)
    order, later = _minimum_degree(near)
    place = {marker: k for k, marker in enumerate(order)}
    blocks: dict[tuple[int, int], int] = {}
    first, row = [0], list[int]()
    for marker, others in zip(order, later, strict=True):
        for other in sorted(others, key=place.__getitem__):
            blocks[marker, other] = len(row)
            row.append(other)
        first.append(len(row))
    first_pair, target = [0], list[int]()
    for k in range(len(order)):
        nodes = row[first[k] : first[k + 1]]
        target += [blocks[a, b] for i, a in enumerate(nodes) for b in nodes[i + 1 :]]
        first_pair.append(len(target))
    ends = [pair and sorted(pair, key=place.__getitem__) for pair in couples]
    link_block = [blocks[pair[0], pair[1]] if pair else -1 for pair in ends]
    # Links to a marker that does not exist count for no degree; a link to itself counts twice.
    whole = model.links[(model.links >= 0).all(axis=1)]
    degree = np.bincount(whole.ravel(), minlength=model.n_markers)
    rows = (model.links, degree, _outward(model), order, first, row, first_pair, target, link_block)
    return Topology(*(np.ascontiguousarray(each, np.int32) for each in rows))


def _couples(model: SkeletonModel) -> list[tuple[int, int] | None]:
    """Return the two markers that each link couples; None if one is absent or both are one."""
    pairs = zip(model.link_parents, model.link_children, strict=True)
    return [(p, d) if p >= 0 and d >= 0 and p != d else None for p, d in pairs]


def _minimum_degree(near: list[set[int]]) -> tuple[list[int], list[set[int]]]:
    """Eliminate the marker with the fewest neighbours and join these, until none is left."""
    order: list[int] = []
    later: list[set[int]] = []
    left = set(range(len(near)))
    while left:
        marker = min(left, key=lambda m: (len(near[m]), m))
        left.remove(marker)
        for other in near[marker]:
            near[other] |= near[marker] - {other}
            near[other].discard(marker)
        order.append(marker)
        later.append(near[marker])
    return order, later


def _outward(model: SkeletonModel) -> list[int]:
    """Order the links from the roots outwards: a link comes after the one into its parent.

    Links of a cycle that no root leads to come last, in the order of the model. Links that couple
    nothing are left out.
    """
    todo = [i for i, pair in enumerate(_couples(model)) if pair]
    ordered: list[int] = []
    while todo:
        waiting = {model.link_children[i] for i in todo}
        ready = [i for i in todo if model.link_parents[i] not in waiting] or [todo[0]]
        ordered += ready
        todo = [i for i in todo if i not in ready]
    return ordered
