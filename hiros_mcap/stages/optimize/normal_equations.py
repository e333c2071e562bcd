"""Normal equations of a skeleton: 3x3 blocks on the graph of its links, solved by block LDL^T.

Each link couples two markers. The graph of the links alone decides which blocks a factorization
touches. A tree of any shape fills no new block (leaves first); each loop costs a few (George & Liu,
"Computer Solution of Large Sparse Positive Definite Systems", 1981, chapter 5: minimum degree).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F2, F3, J1, J2, arrays
from hiros_mcap.kernels.compile import inlined, kernel
from hiros_mcap.skeletons import Floats, SkeletonModel


class Topology(NamedTuple):
    """Links of a model and the order in which its markers are eliminated.

    Step ``k`` eliminates marker ``order[k]``. Its neighbours that are still there have the blocks
    ``first[k]`` up to ``first[k + 1]``: block ``s`` couples marker ``row[s]``, which is eliminated
    later, to ``order[k]``. Every pair of these neighbours is coupled by a block, too.
    """

    links: J2  # (L, 2) proximal and distal marker slot, -1 = absent
    degree: J1  # (M,) number of links that end in each marker
    outward: J1  # (up to L,) links from the roots outwards
    order: J1  # (M,) marker slots
    first: J1  # (M + 1,) first block of each step
    row: J1  # (S,) marker slot of each block's row
    block: J2  # (M, M) block that couples two markers, -1 = none


class NormalEquations(NamedTuple):
    """Hessian * step = -gradient, for M markers and S blocks off the diagonal."""

    diagonal: F3  # (M, 3, 3) of the Hessian
    inverse: F3  # (M, 3, 3) of the diagonal blocks, when they are eliminated
    blocks: F3  # (S, 3, 3) of the Hessian, off the diagonal
    scaled: F3  # (S, 3, 3) blocks times the inverse
    gradient: F2  # (M, 3)
    step: F2  # (M, 3)

    @classmethod
    def of(cls, topology: Topology) -> NormalEquations:
        """Allocate the arrays."""
        m, s = len(topology.order), len(topology.row)
        return arrays(cls, *2 * [(m, 3, 3)], *2 * [(s, 3, 3)], (m, 3), (m, 3))


@inlined
def solve_equations(topology: Topology, damping: float, equations: NormalEquations) -> None:
    """Solve Hessian * step = -gradient; overwrites the equations.

    ``damping`` raises the diagonal of every pivot by that share, which shortens the step.
    """
    order, first, row = topology.order, topology.first, topology.row
    diagonal, inverse, blocks, scaled, gradient, step = equations
    for k in range(order.shape[0]):
        m = order[k]
        _invert(diagonal, m, damping, inverse)
        for s in range(first[k], first[k + 1]):
            _scale(blocks, inverse, s, m, scaled)
        for s in range(first[k], first[k + 1]):
            r = row[s]
            _subtract(scaled, blocks, s, s, diagonal, r)
            for t in range(s + 1, first[k + 1]):
                _subtract(scaled, blocks, t, s, blocks, topology.block[row[t], r])
            for i in range(3):
                for j in range(3):
                    gradient[r, i] -= scaled[s, i, j] * gradient[m, j]
    for k in range(order.shape[0] - 1, -1, -1):
        m = order[k]
        for s in range(first[k], first[k + 1]):
            r = row[s]
            for i in range(3):
                for j in range(3):
                    gradient[m, i] += blocks[s, j, i] * step[r, j]
        for i in range(3):
            step[m, i] = 0.0
            for j in range(3):
                step[m, i] -= inverse[m, i, j] * gradient[m, j]


@kernel
def _invert(a: Floats, m: int, damping: float, out: Floats) -> None:
    """Invert the symmetric block ``m``, (1 + damping) on its diagonal; identity for zeros."""
    scale = a[m, 0, 0] + a[m, 1, 1] + a[m, 2, 2]
    floor = 1e-14 * scale if scale > 0.0 else 1.0
    d0 = a[m, 0, 0] * (1.0 + damping) + floor
    d1 = a[m, 1, 1] * (1.0 + damping) + floor
    d2 = a[m, 2, 2] * (1.0 + damping) + floor
    xy, xz, yz = a[m, 0, 1], a[m, 0, 2], a[m, 1, 2]
    c00, c01, c02 = d1 * d2 - yz * yz, xz * yz - xy * d2, xy * yz - xz * d1
    c11, c12, c22 = d0 * d2 - xz * xz, xy * xz - d0 * yz, d0 * d1 - xy * xy
    share = 1.0 / (d0 * c00 + xy * c01 + xz * c02)
    out[m, 0, 0], out[m, 1, 1], out[m, 2, 2] = c00 * share, c11 * share, c22 * share
    out[m, 0, 1] = out[m, 1, 0] = c01 * share
    out[m, 0, 2] = out[m, 2, 0] = c02 * share
    out[m, 1, 2] = out[m, 2, 1] = c12 * share


@kernel
def _scale(blocks: Floats, inverse: Floats, s: int, m: int, out: Floats) -> None:
    """``out[s] = blocks[s] inverse[m]``, 3x3."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for n in range(3):
                total += blocks[s, i, n] * inverse[m, n, j]
            out[s, i, j] = total


@kernel
def _subtract(a: Floats, b: Floats, s: int, t: int, out: Floats, r: int) -> None:
    """``out[r] -= a[s] b[t]^T``, 3x3."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for n in range(3):
                total += a[s, i, n] * b[t, j, n]
            out[r, i, j] -= total


# The order in which markers are eliminated, worked out once per model.


def topology_of(model: SkeletonModel) -> Topology:
    """Choose the elimination order (minimum degree, ties by slot) and lay out the blocks."""
    near: list[set[int]] = [set() for _ in range(model.n_markers)]
    for p, d in _coupling(model).values():
        near[p].add(d)
        near[d].add(p)
    order, later = _minimum_degree(near)
    block = np.full(2 * [model.n_markers], -1)
    first, row = [0], list[int]()
    for marker, others in zip(order, later, strict=True):
        for other in sorted(others, key=order.index):
            block[marker, other] = block[other, marker] = len(row)
            row.append(other)
        first.append(len(row))
    # Links to a marker that does not exist count for no degree; a link to itself counts twice.
    whole = model.links[(model.links >= 0).all(axis=1)]
    degree = np.bincount(whole.ravel(), minlength=model.n_markers)
    rows = model.links, degree, _outward(model), order, first, row, block
    return Topology(*(np.ascontiguousarray(each, np.int32) for each in rows))


def _coupling(model: SkeletonModel) -> dict[int, tuple[int, int]]:
    """Return the links that couple two markers, and these."""
    return {k: (p, d) for k, (p, d) in enumerate(model.links.tolist()) if min(p, d) >= 0 and p != d}


def _minimum_degree(near: list[set[int]]) -> tuple[list[int], list[set[int]]]:
    """Eliminate the marker with the fewest neighbours and join these, until none is left."""
    order, later, left = list[int](), list[set[int]](), set(range(len(near)))
    while left:
        marker = min(left, key=lambda m: (len(near[m]), m))
        left.remove(marker)
        for other in near[marker]:
            near[other] |= near[marker] - {other}
            near[other].discard(marker)
        order.append(marker)
        later.append(near[marker])
    return order, later


def _outward(model: SkeletonModel) -> list[int]:
    """Order the links from the roots outwards: a link comes after the one into its parent.

    Links of a cycle that no root leads to come last, in the order of the model. Links that couple
    nothing are left out.
    """
    todo, ordered = list(_coupling(model)), list[int]()
    while todo:
        waiting = {model.link_children[i] for i in todo}
        ready = [i for i in todo if model.link_parents[i] not in waiting] or [todo[0]]
        ordered += ready
        todo = [i for i in todo if i not in ready]
    return ordered
