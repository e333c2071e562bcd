"""The assignment problem: pairs of rows and columns with the least total cost (Munkres 1957).

Shortest augmenting paths with potentials, the modern form of Munkres' algorithm. Where many pairs
are forbidden, the problem falls apart into independent ones, which are solved one by one: the work
then grows with the size of the largest, not of the whole. Outside hot loops scipy's
``linear_sum_assignment`` does the same for costs without forbidden pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from hiros_mcap.kernels.compile import B1, F1, F2, I1, inlined, kernel, named_tuple
from hiros_mcap.skeletons import Flags, Floats, Stamps

_INFINITE = 1e18


class AssignmentWork(NamedTuple):
    """Scratch of :func:`solve` for at most N rows and N columns.

    The search for augmenting paths counts from 1 and keeps 0 for its start: (N + 1,).
    """

    row_potential: Floats
    column_potential: Floats
    least: Floats
    row_of: Stamps
    before: Stamps
    visited: Flags
    leader: Stamps
    """(2 N,) a member of the component of each row, and then of each column."""
    place: Stamps
    """(2 N,) where the next member of each component goes; who waits for a partner."""
    members: Stamps
    """(2 N,) rows, and columns + n_rows; those of a component are neighbours and increase."""

    @classmethod
    def allocate(cls, size: int) -> AssignmentWork:
        """Arrays for at most ``size`` rows and columns."""
        n = size + 1
        floats, indices = np.empty((3, n)), np.empty((2, n), np.int64)
        return cls._make(
            [*floats, *indices, np.empty(n, np.bool_), *np.empty((3, 2 * n), np.int64)]
        )


ASSIGNMENT_WORK = named_tuple(AssignmentWork, F1, F1, F1, I1, I1, B1, I1, I1, I1)


# Components: rows and columns that allowed pairs connect


@inlined
def _leader_of(leader: Stamps, node: int) -> int:
    """Return the first node of a component; the way there becomes shorter."""
    while leader[node] != node:
        leader[node] = leader[leader[node]]
        node = leader[node]
    return node


@kernel
def _find_components(cost: Floats, n_rows: int, n_columns: int, work: AssignmentWork) -> None:
    """Fill ``leader`` with the least member of each node's component."""
    leader = work.leader
    for node in range(n_rows + n_columns):
        leader[node] = node
    for i in range(n_rows):
        for j in range(n_columns):
            if cost[i, j] < _INFINITE:
                one, other = _leader_of(leader, i), _leader_of(leader, n_rows + j)
                leader[max(one, other)] = min(one, other)
    for node in range(n_rows + n_columns):  # leaders come first, so one step is enough
        leader[node] = leader[leader[node]]


@kernel
def _sort_components(n_nodes: int, work: AssignmentWork) -> None:
    """Fill ``members`` with the nodes, component by component."""
    leader, place, members = work.leader, work.place, work.members
    for node in range(n_nodes):
        place[node] = 0
    for node in range(n_nodes):
        place[leader[node]] += 1
    begin = 0
    for node in range(n_nodes):
        size = place[node]
        place[node] = begin
        begin += size
    for node in range(n_nodes):
        members[place[leader[node]]] = node
        place[leader[node]] += 1


# One component. Its shorter side, rows or columns, is given partners of the longer side.


@inlined
def _entry(
    cost: Floats, n_rows: int, shorter: Stamps, longer: Stamps, i: int, j: int, forbidden: float
) -> float:
    """Cost of the i-th node of the shorter side with the j-th of the longer side."""
    one, other = shorter[i], longer[j]
    entry = cost[one, other - n_rows] if one < n_rows else cost[other, one - n_rows]
    return entry if entry < _INFINITE else forbidden


@kernel
def _begin(
    cost: Floats, n_rows: int, shorter: Stamps, longer: Stamps, work: AssignmentWork
) -> tuple[float, int]:
    """Give each node its cheapest partner if that is still free; ``place`` names the others.

    Returns the cost of a forbidden pair, which is more than that of any set of allowed pairs
    together, and how many others there are.
    """
    u, v, row_of = work.row_potential, work.column_potential, work.row_of
    for j in range(len(longer) + 1):
        v[j], row_of[j] = 0.0, 0
    largest, waiting = 0.0, 0
    for i in range(len(shorter)):
        cheapest, u[i + 1] = 0, np.inf
        for j in range(len(longer)):
            entry = _entry(cost, n_rows, shorter, longer, i, j, np.inf)
            if entry < np.inf:
                largest = max(largest, abs(entry))
            if entry < u[i + 1]:
                cheapest, u[i + 1] = j + 1, entry
        if row_of[cheapest] == 0:
            row_of[cheapest] = i + 1
        else:
            work.place[waiting] = i + 1
            waiting += 1
    return (2.0 * largest + 1.0) * (len(longer) + 1), waiting


@kernel
def _augment(
    cost: Floats,
    n_rows: int,
    shorter: Stamps,
    longer: Stamps,
    forbidden: float,
    row: int,
    work: AssignmentWork,
) -> None:
    """Give a node (from 1) a partner, along the cheapest path of changes to the others."""
    u, v, least, row_of = work.row_potential, work.column_potential, work.least, work.row_of
    before, visited, size = work.before, work.visited, len(longer)
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
            entry = _entry(cost, n_rows, shorter, longer, i0 - 1, j - 1, forbidden)
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


@kernel
def _solve_component(
    cost: Floats,
    n_rows: int,
    members: Stamps,
    n_row_members: int,
    work: AssignmentWork,
    row_of_column: Stamps,
) -> None:
    """Write the rows of the columns of a component; its rows come first in ``members``."""
    shorter, longer = members[:n_row_members], members[n_row_members:]
    if len(shorter) > len(longer):
        shorter, longer = longer, shorter
    forbidden, waiting = _begin(cost, n_rows, shorter, longer, work)
    for k in range(waiting):
        _augment(cost, n_rows, shorter, longer, forbidden, work.place[k], work)
    for j in range(len(longer)):
        if work.row_of[j + 1] == 0:
            continue
        one, other = shorter[work.row_of[j + 1] - 1], longer[j]
        row, column = min(one, other), max(one, other) - n_rows
        if cost[row, column] < _INFINITE:
            row_of_column[column] = row


@kernel(types.void(F2, types.int64, types.int64, ASSIGNMENT_WORK, I1))
def solve(
    cost: Floats, n_rows: int, n_columns: int, work: AssignmentWork, row_of_column: Stamps
) -> None:
    """Do what :func:`assign` does for a part of ``cost``, without new arrays.

    ``cost[:n_rows, :n_columns]`` counts; ``row_of_column`` (at least n_columns,) is written.
    """
    n_nodes, members = n_rows + n_columns, work.members
    for j in range(n_columns):
        row_of_column[j] = -1
    _find_components(cost, n_rows, n_columns, work)
    _sort_components(n_nodes, work)
    begin = 0
    while begin < n_nodes:
        leader = work.leader[members[begin]]
        end = middle = begin
        while end < n_nodes and work.leader[members[end]] == leader:
            end += 1
            middle += members[end - 1] < n_rows
        if end - begin == 2:  # one row, one column: most people, most of the time
            row_of_column[members[end - 1] - n_rows] = members[begin]
        elif end - begin > 2:
            _solve_component(cost, n_rows, members[begin:end], middle - begin, work, row_of_column)
        begin = end


def assign(cost: Floats) -> Stamps:
    """Row assigned to each column: as many allowed pairs as possible, then the least total cost.

    ``cost`` is (R, C), C-contiguous; infinite entries are never assigned. Returns (C,), -1 = none.
    """
    row_of_column = np.empty(cost.shape[1], np.int64)
    solve(cost, *cost.shape, AssignmentWork.allocate(max(cost.shape)), row_of_column)
    return row_of_column
