"""Mean lengths of links, and markers moved onto them.

To filter each marker on its own shortens links that swing.
"""

from __future__ import annotations

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2, F3, I1, J2
from hiros_mcap.kernels.compile import entry, inlined
from hiros_mcap.skeletons import Floats, People
from hiros_mcap.stages.filter.filtering import FilterPast, FilterSteps, step_of

# Columns of FilterPast.lengths.
LENGTH = 0
DURATION = 1

SWEEPS, TOLERANCE = 30, 2e-3
"""Limit of the sweeps of :func:`project`, and the relative accuracy at which they end."""


@inlined
def _distance(markers: Floats, a: int, b: int) -> float:
    """Distance between two markers, m; NaN where one is absent or there is no such marker."""
    if a < 0 or b < 0:
        return np.nan
    square = 0.0
    for c in range(3):
        square += (markers[b, c] - markers[a, c]) ** 2
    return float(np.sqrt(square))


@entry
def average_lengths(
    people: People, steps: FilterSteps, past: FilterPast, links: J2, length_time: float
) -> None:
    """Continue the mean lengths of everybody's ``links`` (L, 2).

    The plain mean until it covers ``length_time`` s, then a first-order low-pass: no start
    transient, and the least variance that the data so far allow.
    """
    mask = past.ring.shape[1] - 1
    for j in range(len(steps.rows)):
        row, step = steps.rows[j], steps.steps[j]
        interval = step_of(steps, past, j).interval if step > 0 else steps.periods[j]
        before, lengths = past.lengths[row, (step - 1) & mask], past.lengths[row, step & mask]
        for k in range(len(links)):
            mean = before[k, LENGTH] if step > 0 else 0.0
            duration = before[k, DURATION] if step > 0 else 0.0
            length = _distance(people.markers[steps.people[j]], links[k, 0], links[k, 1])
            if np.isfinite(length):
                duration = min(duration + interval, length_time)
                mean += (length - mean) * interval / duration
            lengths[k, LENGTH], lengths[k, DURATION] = mean, duration


@entry
def project(
    markers: F2, links: J2, lengths: F2, variances: F1, sweeps: int, tolerance: float
) -> int:
    """Move markers (M, 19) by as little as it takes to give every link its length.

    Project onto one length after the other (Gauss-Seidel) until none is off by more than
    ``tolerance`` of itself; return the sweeps. Both ends move in proportion to their ``variances``
    (M,), by the same amount if there are none. Any graph; links without both ends or without a
    known length (``lengths`` (L, 2): m, s) are left alone.
    """
    for sweep in range(sweeps):
        worst = 0.0
        for k in range(len(links)):
            a, b, mean = links[k, 0], links[k, 1], lengths[k, LENGTH]
            length = _distance(markers, a, b)
            if lengths[k, DURATION] == 0.0 or mean == 0.0 or not 1e-6 < length < np.inf:
                continue
            worst = max(worst, abs(length - mean) / mean)
            share = 0.5
            if len(variances) > 0:
                share = variances[a] / (variances[a] + variances[b])
            near, far = share * (length - mean) / length, (1.0 - share) * (length - mean) / length
            for c in range(3):
                apart = markers[b, c] - markers[a, c]
                markers[a, c] += near * apart
                markers[b, c] -= far * apart
        if worst <= tolerance:
            return sweep + 1
    return sweeps


@entry
def restore_lengths(people: People, steps: FilterSteps, past: FilterPast, links: J2) -> None:
    """Give everybody's ``links`` (L, 2) the mean lengths of the data until the steps' ends."""
    mask = past.ring.shape[1] - 1
    for j in range(len(steps.rows)):
        lengths = past.lengths[steps.rows[j], (steps.ends[j] - 1) & mask]
        equal = lengths[0, :0]
        project(people.markers[steps.people[j]], links, lengths, equal, SWEEPS, TOLERANCE)


@entry
def project_all(
    markers: F3, which: I1, variances: F2, links: J2, lengths: F3, sweeps: int,
    tolerance: float,
) -> None:  # fmt: skip
    """Do what :func:`project` does with everybody's markers (P, M, 19), variances (P, M).

    ``which`` (P,) says whose ``lengths`` (B, L, 2) a row has; -1 = it stays as it is.
    """
    for row in range(len(which)):
        if which[row] >= 0:
            mine = lengths[which[row]]
            project(markers[row], links, mine, variances[row], sweeps, tolerance)
