"""The assignment problem: pairs of rows and columns with the least total cost (Munkres 1957).

Shortest augmenting paths with potentials, the modern form of Munkres' algorithm. Instead of a
partner a row may have none, at a cost above that of all pairs together: so as many rows as possible
have one. Who has no choice is done at once. scipy's ``linear_sum_assignment`` knows no forbidden
pairs, no kernel can call it, and importing it takes some tenths of a second.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import B1, F1, F2, I1, arrays
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.skeletons import Floats, Stamps

_INFINITE = 1e18


class AssignmentWork(NamedTuple):
    """Scratch of :func:`solve` for at most N rows and N columns.

    Rows and columns count from 1; column 0 is the start of a path: (N + 1,).
    """

    row_potential: F1
    column_potential: F1
    least: F1  # reduced cost of the cheapest way to a column
    row_of: I1  # row of each column, 0 = none
    before: I1  # column before each on the cheapest way
    visited: B1

    @classmethod
    def allocate(cls, size: int) -> AssignmentWork:
        """Arrays for at most ``size`` rows and columns."""
        return arrays(cls, *6 * [size + 1])


@inlined
def _price_of_none(cost: Floats, n_rows: int, n_columns: int) -> float:
    """Cost of a row without a partner: more than that of any set of allowed pairs."""
    largest = 0.0
    for i in range(n_rows):
        for j in range(n_columns):
            if cost[i, j] < _INFINITE:
                largest = max(largest, abs(cost[i, j]))
    return (2.0 * largest + 1.0) * (max(n_rows, n_columns) + 1)


@inlined
def _reach(cost: Floats, n_columns: int, j0: int, work: AssignmentWork) -> tuple[int, float]:
    """Go on from column ``j0``'s row; return the nearest column not visited, and how far it is."""
    u, v, least = work.row_potential, work.column_potential, work.least
    i, nearest, delta = work.row_of[j0], -1, np.inf
    for j in range(1, n_columns + 1):
        if work.visited[j]:
            continue
        entry = cost[i - 1, j - 1]
        if entry < _INFINITE and entry - u[i] - v[j] < least[j]:
            least[j], work.before[j] = entry - u[i] - v[j], j0
        if least[j] < delta:
            nearest, delta = j, least[j]
    return nearest, delta


@kernel
def _add_row(cost: Floats, n_columns: int, row: int, price: float, work: AssignmentWork) -> None:
    """Give a row a partner along the cheapest path of changes to the others.

    It ends at a free column, or where it is cheaper that a row has no partner any more.
    """
    u, v, least, row_of = work.row_potential, work.column_potential, work.least, work.row_of
    for j in range(n_columns + 1):
        least[j], work.visited[j] = np.inf, False
    j0, leaver, price_left = 0, 0, np.inf
    row_of[0] = row
    while True:
        work.visited[j0] = True
        nearest, delta = _reach(cost, n_columns, j0, work)
        if price - u[row_of[j0]] < price_left:
            leaver, price_left = j0, price - u[row_of[j0]]
        leaves = price_left <= delta
        delta = min(delta, price_left)
        price_left -= delta
        for j in range(n_columns + 1):
            if work.visited[j]:
                u[row_of[j]] += delta
                v[j] -= delta
            else:
                least[j] -= delta
        j0 = leaver if leaves else nearest
        if leaves or row_of[j0] == 0:
            break
    while j0 != 0:
        row_of[j0] = row_of[work.before[j0]]
        j0 = work.before[j0]


@entry
def solve(cost: F2, n_rows: int, n_columns: int, work: AssignmentWork, row_of_column: I1) -> None:
    """Do what :func:`assign` does for a part of ``cost``, without new arrays.

    ``cost[:n_rows, :n_columns]`` counts; ``row_of_column`` (at least n_columns,) is written.
    """
    price = _price_of_none(cost, n_rows, n_columns)
    work.row_potential[: n_rows + 1] = 0.0
    work.column_potential[: n_columns + 1] = 0.0
    work.row_of[: n_columns + 1] = 0
    for row in range(1, n_rows + 1):
        _add_row(cost, n_columns, row, price, work)
    for j in range(n_columns):
        row_of_column[j] = work.row_of[j + 1] - 1


def assign(cost: Floats) -> Stamps:
    """Row assigned to each column: as many allowed pairs as possible, then the least total cost.

    ``cost`` is (R, C), C-contiguous; infinite entries are never assigned. Returns (C,), -1 = none.
    """
    row_of_column = np.empty(cost.shape[1], np.int64)
    solve(cost, *cost.shape, AssignmentWork.allocate(max(cost.shape)), row_of_column)
    return row_of_column
