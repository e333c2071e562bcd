"""How thick limbs are: the radii of a skeleton's links, as capsules that hide what is behind them.

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

_CIRCUMFERENCES = {
    name: circumference
    for circumference, names in (
        (0.575, "head nose eye ear"),  # not in that table: the middle of the sizes of hats
        (0.380, "neck spineshoulder"),
        (0.926, "spine"),  # of the abdomen
        (1.008, "chest thorax"),
        (0.999, "pelvis midhip spinebase"),
        (0.594, "hip"),  # of the thigh
        (0.323, "clavicle shoulder"),  # of the biceps
        (0.287, "elbow forearm"),
        (0.182, "wrist hand"),
        (0.182 / 3, "thumb"),
        (0.386, "knee"),
        (0.231, "ankle heel foot toe"),
    )
    for name in names.split()
}
"""Part of a marker's name -> circumference there, m; the longest part that fits counts,
of two the first."""


def capsules_of(model: SkeletonModel) -> Capsules:
    """Return the links of a skeleton that have two ends, with the radii of a grown-up's limbs."""
    ends = model.links[(model.links >= 0).all(axis=1)]
    radii = np.array([_radius(split_side(name)[0]) for name in model.marker_names])
    return Capsules(np.ascontiguousarray(ends), np.ascontiguousarray(radii[ends]))


def _radius(name: str) -> float:
    """Radius of the body, m, at a marker, by its name without its side; of the knee by default."""
    plain = name.replace("_", "")
    part = max((part for part in _CIRCUMFERENCES if part in plain), key=len, default="knee")
    return _CIRCUMFERENCES[part] / (2 * np.pi)
