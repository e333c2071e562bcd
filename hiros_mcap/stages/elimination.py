"""In which order the markers of a skeleton are eliminated from the optimizer's equations.

Each link couples two markers, so the normal equations of a skeleton are 3x3 blocks on the graph of
its links. Which blocks a Cholesky factorization touches depends on that graph alone: it is worked
out here once per model, and the kernel only follows the plan. A tree of any shape fills no new
block (leaves first); each loop costs a few (George & Liu, "Computer Solution of Large Sparse
Positive Definite Systems", 1981, chapter 5: minimum degree).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hiros_mcap.skeletons import Ints, SkeletonModel


@dataclass(frozen=True, eq=False)
class Elimination:
    """Plan of a block Cholesky factorization; all arrays int32 and C-contiguous.

    Step ``k`` eliminates marker ``order[k]``, whose neighbours that are still there occupy the
    block slots ``first[k]`` up to ``first[k + 1]``: slot ``s`` is the block of row ``row[s]``
    (eliminated later) and column ``order[k]``. Every pair ``s < t`` of these slots updates
    slot ``target[j]``, where ``j`` runs through the pairs from ``first_pair[k]`` on.
    """

    order: Ints
    """(M,) marker slots."""
    first: Ints
    """(M + 1,) first block slot of each step."""
    row: Ints
    """(S,) marker slot of each block's row."""
    first_pair: Ints
    """(M + 1,) first pair of each step."""
    target: Ints
    """(number of pairs,) block slot that a pair updates."""
    link_slot: Ints
    """(L,) block slot of each link, -1 for a link that couples nothing."""

    @property
    def n_slots(self) -> int:
        """Number of off-diagonal blocks, those of the links and the fill."""
        return len(self.row)


def coupled(model: SkeletonModel) -> list[tuple[int, int] | None]:
    """Return the two markers that each link couples; None if one is absent or both are one."""
    pairs = zip(model.link_parents, model.link_children, strict=True)
    return [(p, c) if p >= 0 and c >= 0 and p != c else None for p, c in pairs]


def plan(model: SkeletonModel) -> Elimination:
    """Choose the elimination order (minimum degree, ties by slot) and lay out the blocks."""
    links = coupled(model)
    near: list[set[int]] = [set() for _ in range(model.n_markers)]
    for a, b in filter(None, links):
        near[a].add(b)
        near[b].add(a)
    order, later = _minimum_degree(near)
    place = {marker: k for k, marker in enumerate(order)}
    slots: dict[tuple[int, int], int] = {}
    first, row = [0], list[int]()
    for k, marker in enumerate(order):
        for other in sorted(later[k], key=place.__getitem__):
            slots[marker, other] = len(row)
            row.append(other)
        first.append(len(row))
    first_pair, target = [0], list[int]()
    for k in range(len(order)):
        nodes = row[first[k] : first[k + 1]]
        target += [slots[a, b] for i, a in enumerate(nodes) for b in nodes[i + 1 :]]
        first_pair.append(len(target))
    ends = [pair and sorted(pair, key=place.__getitem__) for pair in links]
    link_slot = [slots[pair[0], pair[1]] if pair else -1 for pair in ends]
    arrays = (order, first, row, first_pair, target, link_slot)
    return Elimination(*(np.array(a, dtype=np.int32) for a in arrays))


def _minimum_degree(near: list[set[int]]) -> tuple[list[int], list[set[int]]]:
    """Eliminate the marker with fewest neighbours, join these, repeat; ``near`` is used up."""
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


def outward(model: SkeletonModel) -> Ints:
    """Order of the links from the roots outwards: a link comes after the one into its parent.

    Links of a cycle that no root leads to come last, in the order of the model. Links that
    couple nothing are left out.
    """
    todo = [i for i, pair in enumerate(coupled(model)) if pair]
    ordered: list[int] = []
    while todo:
        waiting = {model.link_children[i] for i in todo}
        ready = [i for i in todo if model.link_parents[i] not in waiting] or [todo[0]]
        ordered += ready
        todo = [i for i in todo if i not in ready]
    return np.array(ordered, dtype=np.int32)
