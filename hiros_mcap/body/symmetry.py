"""Left and right of a skeleton, read from the names of its markers.

Detectors swap the two sides of a body; to notice, one has to know which marker mirrors which, and
which markers span the body sideways (shoulders and hips).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from hiros_mcap.skeletons import Ints, SkeletonModel

# "SHOULDER_LEFT", "ShoulderLeft", "left_shoulder", "LShoulder", "lhip", "Shoulder.L". An initial
# is taken generously ("Lumbar" too): a side counts only if the other side exists.
_SIDE = re.compile(
    r"left|right|(?<![A-Za-z])[lr](?=[A-Za-z_.\s-])|(?<=[_.\s-])[lr]$", re.IGNORECASE
)


@dataclass(frozen=True)
class Symmetry:
    """The two sides of a skeleton model."""

    mirror: Ints
    """(M,) slot of the marker on the other side; a marker without a counterpart is its own."""
    link_mirror: Ints
    """(L,) the same for links, by the markers that they join."""
    lateral: Ints
    """(K, 2) (left, right) slots of shoulders and hips; empty when the names do not tell."""

    @property
    def known(self) -> bool:
        """Whether the names tell left from right at all."""
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
    ends = {
        (parent, child): link
        for link, (parent, child) in enumerate(
            zip(model.link_parents, model.link_children, strict=True)
        )
    }
    link_mirror = np.arange(model.n_links, dtype=np.int32)
    for (parent, child), link in ends.items():
        if parent >= 0 and child >= 0:
            link_mirror[link] = ends.get((int(mirror[parent]), int(mirror[child])), link)
    return Symmetry(
        mirror=mirror,
        link_mirror=link_mirror,
        lateral=np.array(lateral, dtype=np.int32).reshape(-1, 2),
    )
