"""Kernels around the optimizer's solver: they measure lengths, find outliers and write poses.

Hi-ROS 2023, sections 3.3.1 and 3.3.2. Loops, not slices: numba compiles them several times faster.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hiros_mcap.kernels.array_types import F2, F3, J2
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.kernels.points import point_distance
from hiros_mcap.skeletons import Floats, Ints, People
from hiros_mcap.stages.optimize.energy import (
    W_LENGTH,
    W_ORIENTATION,
    W_PROXIMAL,
    Energy,
    SolverScratch,
    length_error,
    minimize_one,
)
from hiros_mcap.stages.optimize.normal_equations import Topology

# The search for outliers: displacements, m, that count a quarter of their weight, round by round
# of reweighting and solving. With the narrow scales alone, chance decides which marker loses its
# weight (Blake and Zisserman's graduated non-convexity).
_SCALES = (0.2, 0.14, 0.1, 0.07, 0.05)
_SEARCH_STEPS = 30
_SEARCH_TOLERANCE = 1e-4  # m
# The smallest factor of a weight: with a smaller one, rounding decides where a marker goes.
_LEAST_FACTOR = 0.003


# Section 3.3.1: calibration


@entry
def measure_lengths(markers: F3, confidences: F2, links: J2, lengths: F2, weights: F2) -> None:
    """Write each link's length (P, L), m, NaN = not seen, and its weight, 0..1.

    The weight is the harmonic mean of the markers' confidences: the variances of the two ends add
    up, and each is taken as inverse to the confidence (1 where none is given).
    """
    for i in range(markers.shape[0]):
        for k in range(links.shape[0]):
            p, d = links[k, 0], links[k, 1]
            lengths[i, k] = np.nan
            weights[i, k] = 0.0
            if p < 0 or d < 0 or p == d:
                continue
            length = point_distance(markers[i, p], markers[i, d])
            if np.isnan(length):
                continue
            a, b = confidences[i, p], confidences[i, d]
            a = 1.0 if np.isnan(a) else a
            b = 1.0 if np.isnan(b) else b
            lengths[i, k] = length
            weights[i, k] = 2.0 * a * b / (a + b) if a > 0.0 and b > 0.0 else 0.0


# Section 3.3.2: outliers


@kernel  # without a signature: not compiled unless it is wanted
def remove_outliers(
    points: Floats, nominal: Floats, topology: Topology, max_error: float, outlier: Ints
) -> int:
    """Find the outliers as the paper does and set them to NaN in ``points``; return how many.

    From the roots outwards, the distal marker of a link whose length is off by more than
    ``max_error`` is an outlier. Links that touch an outlier are not looked at.
    """
    count = 0
    for i in range(points.shape[0]):
        for k in topology.outward:
            p, d = topology.links[k, 0], topology.links[k, 1]
            if outlier[i, d] or outlier[i, p]:
                continue
            if length_error(points[i], nominal[i], topology.links, k) > max_error:
                outlier[i, d] = 1
        for m in range(points.shape[1]):
            if outlier[i, m]:
                count += 1
                points[i, m] = np.nan
    return count


@kernel
def _exceeds(points: Floats, nominal: Floats, links: Ints, max_error: float) -> bool:
    """Whether a link's length is off by more than ``max_error``."""
    for k in range(links.shape[0]):
        if length_error(points, nominal, links, k) > max_error:
            return True
    return False


@kernel
def _reweight(x: Floats, energy: Energy, links: Ints, scale: float, weights: Floats) -> None:
    """Reduce the weights of markers that moved far (Geman and McClure's estimator)."""
    for k in range(links.shape[0]):
        least = 1.0
        for end in range(2):
            m = links[k, end]
            if m >= 0:
                moved = point_distance(x[m], energy.start[m]) / scale
                factor = max(1.0 / (1.0 + moved * moved) ** 2, _LEAST_FACTOR)
                weights[k, W_PROXIMAL + end] = energy.weights[k, W_PROXIMAL + end] * factor
                least = min(least, factor)
        weights[k, W_ORIENTATION] = energy.weights[k, W_ORIENTATION] * least


@kernel
def _fit_robustly(energy: Energy, topology: Topology, scratch: SolverScratch) -> None:
    """Write to ``scratch.solution`` the pose of least energy when far displacements count less."""
    steps: Any = np.int64(_SEARCH_STEPS)  # a literal would make a second version of the solver
    x, weights = scratch.solution, scratch.weights
    robust = Energy(energy.start, energy.nominal, weights)
    for k in range(weights.shape[0]):
        for j in range(4):
            weights[k, j] = energy.weights[k, j]
    minimize_one(robust, topology, _SEARCH_TOLERANCE, steps, False, scratch, x)
    for scale in _SCALES:
        _reweight(x, energy, topology.links, scale, weights)
        # Goes on where the last round ended: from the measured place of a marker of little weight,
        # Newton's steps may lead anywhere.
        minimize_one(robust, topology, _SEARCH_TOLERANCE, steps, True, scratch, x)


@entry
def restore_outliers(
    energy: Energy, topology: Topology, max_error: float, outlier: J2, scratch: SolverScratch
) -> int:
    """Find the outliers by a robust fit and move them, in ``energy.start``; return how many.

    Only people with a link off by more than ``max_error`` are looked at. Which of its ends is
    wrong, the other links tell: the skeleton is solved, markers that moved far get less weight,
    and so on. A marker that ends up further than half of ``max_error`` from where it was measured
    is an outlier, and moves there.
    """
    count = 0
    points, x = energy.start, scratch.solution
    for i in range(points.shape[0]):
        if not _exceeds(points[i], energy.nominal[i], topology.links, max_error):
            continue
        _fit_robustly(Energy(points[i], energy.nominal[i], energy.weights[i]), topology, scratch)
        for m in range(points.shape[1]):
            if point_distance(x[m], points[i, m]) > 0.5 * max_error:
                outlier[i, m] = 1
                count += 1
                for j in range(3):
                    points[i, m, j] = x[m, j]
    return count


# Section 3.3.3: the result


@kernel
def _move_link(state: Floats, before: tuple[Floats, Floats], after: tuple[Floats, Floats]) -> None:
    """Move a link's position with its two ends."""
    length, new_length = point_distance(before[0], before[1]), point_distance(after[0], after[1])
    if not (length > 1e-9 and new_length > 1e-9):
        return
    share = 0.0
    for x in range(3):
        along = (before[1][x] - before[0][x]) / length
        share += along * (state[x] - before[0][x]) / length
    share = min(max(share, 0.0), 1.0)
    for x in range(3):
        shift_p, shift_d = after[0][x] - before[0][x], after[1][x] - before[1][x]
        state[x] += (1.0 - share) * shift_p + share * shift_d


@entry
def write_poses(
    people: People, energy: Energy, solved: F3, outlier: J2, links: J2, remove: bool
) -> None:
    """Write the solved positions (P, M, 3) to markers and links, in place.

    A link of some weight moves with its two ends. With ``remove``, outliers and the links that
    touch them become absent.
    """
    weights = energy.weights
    for i in range(solved.shape[0]):
        for k in range(links.shape[0]):
            p, d = links[k, 0], links[k, 1]
            if p < 0 or d < 0:
                continue
            if remove and (outlier[i, p] or outlier[i, d]):
                people.links[i, k] = np.nan
                people.link_confidences[i, k] = np.nan
            elif weights[i, k, W_LENGTH] + weights[i, k, W_ORIENTATION] > 0.0:
                before = people.markers[i, p], people.markers[i, d]
                after = solved[i, p], solved[i, d]
                _move_link(people.links[i, k], before, after)
        for m in range(solved.shape[1]):
            if remove and outlier[i, m]:
                people.markers[i, m] = np.nan
                people.marker_confidences[i, m] = np.nan
            else:
                for j in range(3):
                    people.markers[i, m, j] = solved[i, m, j]
