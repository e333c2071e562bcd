"""Markers that keep their distances: head, thorax and pelvis, as far as names tell."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from hiros_mcap.body.symmetry import split_side
from hiros_mcap.skeletons import Ints, SkeletonModel

# Shoulders are no part of the thorax: they move by centimetres.
_GROUPS = (
    {"head", "nose", "eye", "ear"},
    {"neck", "chest", "spine_chest", "spinechest", "clavicle"},
    {"pelvis", "spinebase", "spine_base", "midhip", "hips", "hip"},
)


def constant_pairs(model: SkeletonModel, *, rigid: bool = True) -> Ints:
    """(K, 2) Slots of markers with a constant distance: ends of links and, if wanted, groups."""
    names = [split_side(name)[0] for name in model.marker_names]
    pairs = {tuple(sorted(ends)) for ends in model.links.tolist() if min(ends) >= 0}
    for group in _GROUPS if rigid else ():
        slots = [slot for slot, name in enumerate(names) if name in group]
        pairs |= set(combinations(slots, 2))
    return np.array(sorted(pair for pair in pairs if pair[0] != pair[1]), np.int32).reshape(-1, 2)
