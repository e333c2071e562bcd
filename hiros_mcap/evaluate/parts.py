"""Parts of the body, by the names of markers: torso, upper limbs, lower limbs."""

from __future__ import annotations

import numpy as np

from hiros_mcap.body.symmetry import split_side
from hiros_mcap.skeletons import Flags, SkeletonModel

PARTS = ("torso", "upper limbs", "lower limbs")
_UPPER = ("elbow", "wrist", "hand", "thumb", "finger", "palm", "forearm", "lowerarm")
_LOWER = ("knee", "ankle", "foot", "toe", "heel", "shin", "lowerleg", "calf")


def part_of(name: str) -> str:
    """Part that a marker belongs to, as Lee et al. (2022, section 3.1) group their joints.

    Elbows, wrists and hands are upper limbs, knees, ankles and feet lower limbs; shoulders, hips
    and the head belong to the torso.
    """
    bare = split_side(name)[0]
    if any(word in bare for word in _UPPER):
        return "upper limbs"
    return "lower limbs" if any(word in bare for word in _LOWER) else "torso"


def parts_of(model: SkeletonModel) -> dict[str, Flags]:
    """Part -> (M,) which markers belong to it; parts without a marker are left out."""
    names = np.array([part_of(name) for name in model.marker_names])
    return {part: names == part for part in PARTS if (names == part).any()}
