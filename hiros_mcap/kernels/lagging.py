"""Correlation of two signatures over lags."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2, arrays
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import Floats


class LagWork(NamedTuple):
    """What is found for each of L lags."""

    correlations: F1
    """(L,) over all features, each less its mean; NaN where the overlap is too short."""
    differences: F1  # (L,) root mean square difference, m
    overlaps: F1  # (L,) samples that both have

    @classmethod
    def allocate(cls, n_lags: int) -> LagWork:
        """Allocate the arrays."""
        return arrays(cls, n_lags, n_lags, n_lags)


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
def correlate(a: F2, b: F2, first: int, sums: F1, work: LagWork) -> None:
    """Correlate signatures (F, T) and (F, U), NaN = absent, at the lags first, first + 1, ...

    At a lag, sample ``i`` of ``a`` belongs to sample ``i + lag`` of ``b``. ``sums`` is (5,)
    scratch.
    """
    for k in range(len(work.overlaps)):
        sums[:] = 0.0
        for f in range(len(a)):
            _add_feature(a, b, f, first + k, sums)
        work.overlaps[k] = sums[0] / len(a)
        work.correlations[k] = np.nan
        work.differences[k] = np.nan
        if sums[0] > 0.0:
            work.differences[k] = np.sqrt(max(0.0, sums[4]) / sums[0])
            if sums[1] > 0.0 and sums[2] > 0.0:
                work.correlations[k] = sums[3] / np.sqrt(sums[1] * sums[2])
