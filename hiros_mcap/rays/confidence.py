"""How the confidence of a triangulated joint says how well it is known.

Skeletons carry one number per joint, its confidence. That of a triangulated joint states the
standard deviation of its position: half is 35 mm.
"""

from __future__ import annotations

import numpy as np

from hiros_mcap.skeletons import Floats

TRIANGULATED = "rgb_cameras"
"""Name of the camera that stands for all RGB cameras."""
_USUAL = 0.02  # m; the deviation at a confidence of .71


def confidence_of(deviations: Floats) -> Floats:
    """Return the confidence, 0 to 1, of joints with a standard deviation along each axis, m."""
    return np.asarray(_USUAL / np.hypot(_USUAL, deviations))


def variance_of(confidences: Floats) -> Floats:
    """Return the variance along each axis, m2: the inverse of :func:`confidence_of`."""
    return np.asarray(_USUAL**2 * (1.0 / np.maximum(confidences, 1e-3) ** 2 - 1.0))
