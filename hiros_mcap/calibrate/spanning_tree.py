"""The best links that join all cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Pair = tuple[int, int]


def links_from(root: int, pairs: Sequence[Pair]) -> list[Pair]:
    """Return the links by which cameras are reached from one of them: from where, and where to.

    Of the spanning tree that prefers the first of ``pairs``; cameras that no pair joins to the root
    are left out.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    ends = np.array(pairs, np.int64).reshape(-1, 2)
    n = 1 + max(root, int(ends.max(initial=0)))
    graph = csr_array((np.arange(1.0, len(ends) + 1.0), (ends[:, 0], ends[:, 1])), shape=(n, n))
    order, before = breadth_first_order(minimum_spanning_tree(graph), root, directed=False)
    return [(int(before[c]), int(c)) for c in order[1:]]
