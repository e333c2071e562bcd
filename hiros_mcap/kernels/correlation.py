"""How alike two people's signatures are, at each lag of two clocks.

A signature holds numbers that several cameras agree on: distances within a body, or the directions
of a person's joints. All have about the same unit: 0.1 is a large difference.
"""

from __future__ import annotations

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import Floats, Stamps

STEP_S = 0.05
LEAST_OVERLAP_S = 2.0
ENOUGH_OVERLAP_S = 10.0
LEAST_CORRELATION = 0.4
DIFFERENCE = 0.1
"""Signatures of the same person differ by less."""

Signature = tuple[int, Floats]
"""A tracklet as numbers that every camera agrees on: the time of its first sample, in steps of
50 ms, and features (F, T); NaN = unknown."""


@kernel
def _add_feature(a: Floats, b: Floats, f: int, lag: int, sums: Floats) -> None:
    """Add the moments of one feature at one lag: n, variances, covariance, squared difference."""
    n = sa = sb = saa = sbb = sab = 0.0
    for i in range(max(0, -lag), min(a.shape[1], b.shape[1] - lag)):
        x, y = a[f, i], b[f, i + lag]
        if np.isnan(x) or np.isnan(y):
            continue
        n += 1.0
        sa, sb = sa + x, sb + y
        saa, sbb, sab = saa + x * x, sbb + y * y, sab + x * y
    if n > 0.0:
        sums[0] += n
        sums[1] += saa - sa * sa / n
        sums[2] += sbb - sb * sb / n
        sums[3] += sab - sa * sb / n
        sums[4] += saa + sbb - 2.0 * sab


@entry
def correlate(
    a: F2, b: F2, first: int, correlations: F1, differences: F1, overlaps: F1, sums: F1
) -> None:
    """Correlate signatures (F, T) and (F, U), NaN = absent, at the lags first, first + 1, ...

    At a lag, sample ``i`` of ``a`` belongs to sample ``i + lag`` of ``b``.

    Parameters
    ----------
    correlations : (L,) of each lag, over all features, each less its mean; NaN without an overlap.
    differences : (L,) root mean square difference. overlaps : (L,) samples that both have.
    sums : (5,) scratch.
    """
    for k in range(len(overlaps)):
        sums[:] = 0.0
        for f in range(len(a)):
            _add_feature(a, b, f, first + k, sums)
        overlaps[k] = sums[0] / len(a)
        correlations[k] = np.nan
        differences[k] = np.nan
        if sums[0] > 0.0:
            differences[k] = np.sqrt(max(0.0, sums[4]) / sums[0])
            if sums[1] > 0.0 and sums[2] > 0.0:
                correlations[k] = sums[3] / np.sqrt(sums[1] * sums[2])


def alikeness(one: Signature, other: Signature, lags: Stamps) -> Floats:
    """(L,) how alike two tracklets are at each lag; 0 where they are not, or hardly overlap."""
    (first, features), (other_first, other_features) = one, other
    longest = STEP_S * min(features.shape[1], other_features.shape[1])
    if longest < LEAST_OVERLAP_S:
        return np.zeros(len(lags))
    offset = int(lags[0]) + first - other_first
    correlations, differences, samples = np.zeros((3, len(lags)))
    correlate(features, other_features, offset, correlations, differences, samples, np.zeros(5))
    overlaps = STEP_S * samples
    alike = (overlaps >= LEAST_OVERLAP_S) & (correlations > LEAST_CORRELATION)
    similar = np.exp(-((differences / DIFFERENCE) ** 2))
    scores = correlations * np.minimum(overlaps, ENOUGH_OVERLAP_S) * similar
    return np.where(alike, scores, 0.0)
