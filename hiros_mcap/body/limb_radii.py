"""How thick limbs are: radii of a skeleton's links, as capsules that hide what is behind them.

The mean half breadth of a convex cross-section over all directions is its circumference over 2 pi
(Cauchy). The circumferences are means of 252 men: R. W. Johnson, "Fitting percentage of body fat to
simple body measurements", Journal of Statistics Education 4(1), 1996 (data of A. G. Fisher). They
are 180 cm tall and 81 kg on average. Women's limbs are up to 1 cm thinner, which the blur of the
silhouette covers.
"""

from __future__ import annotations

import numpy as np

from hiros_mcap.body.symmetry import split_side
from hiros_mcap.kernels.line_of_sight import Capsules
from hiros_mcap.skeletons import SkeletonModel

_NECK, _CHEST, _ABDOMEN, _HIPS, _THIGH = 0.380, 1.008, 0.926, 0.999, 0.594
_KNEE, _ANKLE, _BICEPS, _FOREARM, _WRIST = 0.386, 0.231, 0.323, 0.287, 0.182
_HEAD = 0.575
"""Circumferences, m. The table lacks the head: 57.5 cm is the middle of the sizes of hats."""

_AT = {
    "head": _HEAD, "nose": _HEAD, "eye": _HEAD, "ear": _HEAD, "neck": _NECK,
    "spine": _ABDOMEN, "chest": _CHEST, "thorax": _CHEST, "spineshoulder": _NECK,
    "pelvis": _HIPS, "midhip": _HIPS, "spinebase": _HIPS, "hip": _THIGH,
    "clavicle": _BICEPS, "shoulder": _BICEPS, "elbow": _FOREARM, "forearm": _FOREARM,
    "wrist": _WRIST, "hand": _WRIST, "thumb": _WRIST / 3, "knee": _KNEE, "ankle": _ANKLE,
    "heel": _ANKLE, "foot": _ANKLE, "toe": _ANKLE,
}  # fmt: skip
"""Part of a marker's name -> circumference there, m; the longest part that fits counts."""
_USUAL = _KNEE
"""At a marker of another name."""


def capsules_of(model: SkeletonModel) -> Capsules:
    """Return the links of a skeleton that have two ends, with the radii of a grown-up's limbs."""
    ends = model.links[(model.links >= 0).all(axis=1)]
    radii = np.array([_radius(split_side(name)[0]) for name in model.marker_names])
    return Capsules(np.ascontiguousarray(ends), np.ascontiguousarray(radii[ends]))


def _radius(name: str) -> float:
    """Radius of the body, m, at a marker, by its name without its side."""
    plain = name.replace("_", "")
    part = max((part for part in _AT if part in plain), key=len, default="")
    return float(_AT.get(part, _USUAL) / (2 * np.pi))
