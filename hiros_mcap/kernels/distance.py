"""Distances between people as a whole."""

from __future__ import annotations

from math import isnan, sqrt

import numpy as np
from numba import njit

from hiros_mcap.skeletons import Floats


@njit("void(float64[:,:,::1], float64[:,:,::1], float64[::1])", cache=True, nogil=True)
def nearest(poses: Floats, others: Floats, out: Floats) -> None:
    """Write each person's mean marker distance, m, to the nearest of the others.

    ``poses`` (P, M, 3) and ``others`` (Q, M, 3), m; ``out`` (P,). Markers count that both have;
    infinite where there are none.
    """
    for p in range(poses.shape[0]):
        out[p] = np.inf
        for q in range(others.shape[0]):
            total, known = 0.0, 0
            for m in range(poses.shape[1]):
                x = poses[p, m, 0] - others[q, m, 0]
                y = poses[p, m, 1] - others[q, m, 1]
                z = poses[p, m, 2] - others[q, m, 2]
                distance = sqrt(x * x + y * y + z * z)
                if not isnan(distance):
                    total += distance
                    known += 1
            if known:
                out[p] = min(out[p], total / known)
