"""The assignment problem: pairs of rows and columns with the least total cost (Munkres 1957).

Shortest augmenting paths with potentials, the modern form of Munkres' algorithm. Outside hot loops
scipy's ``linear_sum_assignment`` does the same for costs without forbidden pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from hiros_mcap.kernels.compile import B1, F1, F2, I1, kernel, named_tuple
from hiros_mcap.skeletons import Flags, Floats, Stamps

_INFINITE = 1e18


class AssignmentWork(NamedTuple):
    """Scratch of :func:`solve`, each (N + 1,) for at most N rows and N columns."""

    row_potential: Floats
    column_potential: Floats
    least: Floats
    row_of: Stamps
    before: Stamps
    visited: Flags

    @classmethod
    def allocate(cls, size: int) -> AssignmentWork:
        """Arrays for at most ``size`` rows and columns."""
        n = size + 1
        floats, indices = np.empty((3, n)), np.empty((2, n), np.int64)
        return cls._make([*floats, *indices, np.empty(n, np.bool_)])


ASSIGNMENT_WORK = named_tuple(AssignmentWork, F1, F1, F1, I1, I1, B1)


@kernel
def _forbidden(cost: Floats, n_rows: int, n_columns: int) -> float:
    """Cost of a forbidden pair, and of padding: more than any set of allowed pairs together."""
    largest = 0.0
    for i in range(n_rows):
        for j in range(n_columns):
            if cost[i, j] < _INFINITE:
                largest = max(largest, abs(cost[i, j]))
    return (2.0 * largest + 1.0) * (max(n_rows, n_columns) + 1)


@kernel
def _augment(
    cost: Floats, n_rows: int, n_columns: int, forbidden: float, row: int, work: AssignmentWork
) -> None:
    """Give a row (from 1) a column, along the cheapest path of changes to the rows before it."""
    u, v, least, row_of, before, visited = work
    size = max(n_rows, n_columns)
    row_of[0] = row
    for j in range(size + 1):
        least[j], visited[j] = np.inf, False
    j0 = 0
    while True:
        visited[j0] = True
        i0 = row_of[j0]
        delta = np.inf
        j1 = 0
        for j in range(1, size + 1):
            if visited[j]:
                continue
            entry = forbidden
            if i0 <= n_rows and j <= n_columns and cost[i0 - 1, j - 1] < _INFINITE:
                entry = cost[i0 - 1, j - 1]
            reduced = entry - u[i0] - v[j]
            if reduced < least[j]:
                least[j] = reduced
                before[j] = j0
            if least[j] < delta:
                delta = least[j]
                j1 = j
        for j in range(size + 1):
            if visited[j]:
                u[row_of[j]] += delta
                v[j] -= delta
            else:
                least[j] -= delta
        j0 = j1
        if row_of[j0] == 0:
            break
    while j0 != 0:
        row_of[j0] = row_of[before[j0]]
        j0 = before[j0]


@kernel(types.void(F2, types.int64, types.int64, ASSIGNMENT_WORK, I1))
def solve(
    cost: Floats, n_rows: int, n_columns: int, work: AssignmentWork, row_of_column: Stamps
) -> None:
    """Do what :func:`assign` does for a part of ``cost``, without new arrays.

    ``cost[:n_rows, :n_columns]`` counts; ``row_of_column`` (at least n_columns,) is written.
    """
    size = max(n_rows, n_columns)
    for j in range(size + 1):
        work.row_potential[j] = work.column_potential[j] = 0.0
        work.row_of[j] = work.before[j] = 0
    forbidden = _forbidden(cost, n_rows, n_columns)
    for row in range(1, size + 1):
        _augment(cost, n_rows, n_columns, forbidden, row, work)
    for j in range(n_columns):
        i = work.row_of[j + 1]
        allowed = 0 < i <= n_rows and cost[i - 1, j] < _INFINITE
        row_of_column[j] = i - 1 if allowed else -1


def assign(cost: Floats) -> Stamps:
    """Row assigned to each column: as many allowed pairs as possible, then the least total cost.

    ``cost`` is (R, C), C-contiguous; infinite entries are never assigned. Returns (C,), -1 = none.
    """
    row_of_column = np.empty(cost.shape[1], np.int64)
    solve(cost, *cost.shape, AssignmentWork.allocate(max(cost.shape)), row_of_column)
    return row_of_column
