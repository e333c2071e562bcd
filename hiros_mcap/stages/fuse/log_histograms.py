"""Histograms over the logarithm of positive values: sums of them, and medians, of any number."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiros_mcap.skeletons import Floats, Stamps

_LEAST, _MOST, _PER_OCTAVE = -14, 14, 8  # log2 of the limits, and bins per factor of 2
_BINS = (_MOST - _LEAST) * _PER_OCTAVE


def histograms(values: Floats) -> Stamps:
    """(K, B) How many of the values (K, N) lie in each bin; NaN lie in none."""
    counts = np.zeros((len(values), _BINS), np.int64)
    with np.errstate(divide="ignore", invalid="ignore"):
        places = (np.log2(values) - _LEAST) * _PER_OCTAVE
    k, n = np.nonzero(~np.isnan(places))
    np.add.at(counts, (k, np.clip(places[k, n], 0, _BINS - 1).astype(np.int64)), 1)
    return counts


def medians(counts: NDArray[Any], fewest: int) -> Floats:
    """(K,) Medians of histograms (K, B), within 1 %; NaN where there are fewer values."""
    total = counts.sum(axis=1)
    before = np.cumsum(counts, axis=1)
    at = (2 * before >= total[:, None]).argmax(axis=1)
    k = np.arange(len(counts))
    inside = (total / 2 - (before[k, at] - counts[k, at])) / np.maximum(counts[k, at], 1)
    middle = 2.0 ** (_LEAST + (at + inside) / _PER_OCTAVE)
    return np.where(total >= fewest, middle, np.nan)
