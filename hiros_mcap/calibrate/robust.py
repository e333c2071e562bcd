"""Fits that outliers hardly move, and errors of what was fitted."""

from __future__ import annotations

import numpy as np

from hiros_mcap.calibrate.registration import kabsch
from hiros_mcap.skeletons import Floats

ROUNDS = 5


def cauchy(errors: Floats, scale: float = 1.0) -> Floats:
    """Return Cauchy weights of errors: 1 / (1 + (e / s)^2), s in median absolute errors."""
    usual = float(np.median(np.abs(errors))) if errors.size else 0.0
    return np.asarray(1.0 / (1.0 + (errors / (scale * usual + 1e-9)) ** 2))


def robust_kabsch(
    source: Floats, target: Floats, weights: Floats, rounds: int = ROUNDS
) -> tuple[Floats, Floats]:
    """Return the rotation (3, 3) and shift (3,) of :func:`kabsch` with Cauchy weights.

    Parameters
    ----------
    source, target : (N, 3) corresponding points, m. weights : (N,) besides those of the errors.
    """
    robust = weights
    for _ in range(rounds):
        rotation, shift = kabsch(source, target, robust)
        errors = np.linalg.norm(target - source @ rotation.T - shift, axis=1)
        robust = weights * cauchy(errors)
    return rotation, shift


def jackknife(deviations: Floats) -> Floats:
    """(F,) variances, from the deviations (N, F) of the estimates without each of N parts."""
    n = len(deviations)
    return np.asarray((n - 1) / n * np.sum(deviations**2, axis=0))
