"""Random series over the frames of a camera, and events among them."""

from __future__ import annotations

import numpy as np

from hiros_mcap.simulate.occlusion import Mask
from hiros_mcap.skeletons import Floats, Stamps


def coloured(rng: np.random.Generator, shape: tuple[int, ...], correlation: float) -> Floats:
    """Stationary first-order autoregression over the first axis: SD 1, lag-1 ``correlation``."""
    series = rng.standard_normal(shape)
    innovation = np.sqrt(1 - correlation**2)
    for k in range(1, shape[0]):
        series[k] = correlation * series[k - 1] + innovation * series[k]
    return series


def episodes(
    rng: np.random.Generator, n: int, per_frame: float, frames: tuple[float, float]
) -> list[tuple[int, int]]:
    """Half-open frame intervals of events that start at random.

    They start in one of ``n`` frames with probability ``per_frame`` and last between the given
    numbers of frames, log-uniformly: short ones are common, long ones happen.
    """
    starts = np.flatnonzero(rng.random(n) < per_frame)
    low, high = np.log(frames)
    lengths = np.maximum(1, np.round(np.exp(rng.uniform(low, high, len(starts))))).astype(int)
    return [
        (int(start), int(min(start + length, n)))
        for start, length in zip(starts, lengths, strict=True)
    ]


def held(rng: np.random.Generator, per_frame: Floats) -> Stamps:
    """(n,) number of the decision that holds in each frame.

    A detector decides anew at random times, so often ``per_frame`` (n,) on average.
    """
    anew = rng.random(len(per_frame)) < -np.expm1(-per_frame)
    anew[0] = False
    decisions: Stamps = np.cumsum(anew)
    return decisions


def runs(wanted: Mask) -> list[tuple[int, int]]:
    """Half-open intervals of frames in which ``wanted`` (n,) is true."""
    changes = np.flatnonzero(np.diff(np.r_[False, wanted, False].astype(int)))
    return [(int(start), int(stop)) for start, stop in changes.reshape(-1, 2)]
