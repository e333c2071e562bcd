"""Left and right of a skeleton, read from the names of its markers.

Detectors swap the two sides of a person. To detect that, the tracker and the merger need to know
which marker mirrors which, and which markers are the shoulders and hips. Names also tell which
markers keep their distances.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from hiros_mcap.skeletons import Ints, SkeletonModel

# "SHOULDER_LEFT", "ShoulderLeft", "left_shoulder", "LShoulder", "lhip", "Shoulder.L". An initial
# may match too much ("Lumbar"): a side counts only if the other side exists.
_SIDE = re.compile(
    r"left|right|(?<![A-Za-z])[lr](?=[A-Za-z_.\s-])|(?<=[_.\s-])[lr]$", re.IGNORECASE
)


@dataclass(frozen=True)
class Symmetry:
    """The two sides of a skeleton model."""

    mirror: Ints
    """(M,) slot of the marker on the other side; its own for a marker without a counterpart."""
    link_mirror: Ints  # (L,) the same for links, by the markers that they join
    lateral: Ints  # (K, 2) (left, right) slots of shoulders and hips; empty if no names match

    @property
    def has_sides(self) -> bool:
        """Whether any marker has a counterpart."""
        return bool((self.mirror != np.arange(len(self.mirror))).any())


def split_side(name: str) -> tuple[str, str]:
    """Return (name without its side, "left" | "right" | "").

    >>> split_side("ShoulderLeft"), split_side("RKnee"), split_side("Head")
    (('shoulder', 'left'), ('knee', 'right'), ('head', ''))
    """
    match = _SIDE.search(name)
    if match is None:
        return name.lower().strip("_. -"), ""
    rest = (name[: match.start()] + name[match.end() :]).lower().strip("_. -")
    return rest, "left" if match.group().lower().startswith("l") else "right"


def symmetry_of(model: SkeletonModel) -> Symmetry:
    """Pair the markers and links of a model by their names."""
    slots = {split_side(name): slot for slot, name in enumerate(model.marker_names)}
    mirror = np.arange(model.n_markers, dtype=np.int32)
    lateral: list[tuple[int, int]] = []
    for (part, side), slot in slots.items():
        other = slots.get((part, "right" if side == "left" else "left"))
        if side and other is not None:
            mirror[slot] = other
            if side == "left" and part in {"shoulder", "hip", "upleg", "upperarm"}:
                lateral.append((slot, other))
    ends = {(parent, child): link for link, (parent, child) in enumerate(model.links.tolist())}
    link_mirror = np.arange(model.n_links, dtype=np.int32)
    for (parent, child), link in ends.items():
        if parent >= 0 and child >= 0:
            link_mirror[link] = ends.get((int(mirror[parent]), int(mirror[child])), link)
    return Symmetry(mirror, link_mirror, np.array(lateral, np.int32).reshape(-1, 2))


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
