"""The links of a skeleton from its roots outwards."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from hiros_mcap.skeletons import SkeletonModel, Stamps


def link_levels(model: SkeletonModel, without: Collection[int] = ()) -> list[Stamps]:
    """Order the links, a parent's before its children's; loops and loose ends are left out.

    Those of a level have their parents in the levels before. A root is a marker that is no link's
    child. Links of the markers ``without`` are left out, too.
    """
    ends = {
        k: (p, c)
        for k, (p, c) in enumerate(model.links.tolist())
        if p not in without and c not in without
    }
    children = {c for _, c in ends.values()}
    placed = {p for p, _ in ends.values() if p >= 0 and p not in children}
    levels: list[Stamps] = []
    waiting = [k for k, (p, c) in ends.items() if p >= 0 and c >= 0]
    while True:
        ready = [k for k in waiting if ends[k][0] in placed and ends[k][1] not in placed]
        if not ready:
            return levels
        nearest = {ends[k][1]: k for k in reversed(ready)}  # the first link to each child
        levels.append(np.array(sorted(nearest.values()), np.int64))
        placed |= nearest.keys()
