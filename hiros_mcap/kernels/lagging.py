"""Correlation of two signatures over lags."""

from __future__ import annotations

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import Floats


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
    differences : (L,) root mean square difference, m. overlaps : (L,) samples that both have.
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
