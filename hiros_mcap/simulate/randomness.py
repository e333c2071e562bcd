"""Random numbers: one independent stream per effect, so that switching one off leaves the rest."""

from __future__ import annotations

import zlib

import numpy as np

from hiros_mcap.skeletons import Floats


def stream(seed: int, effect: str, *keys: int) -> np.random.Generator:
    """Return the generator that belongs to an effect (of a camera, of a person)."""
    return np.random.default_rng([seed, zlib.crc32(effect.encode()), *keys])


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
