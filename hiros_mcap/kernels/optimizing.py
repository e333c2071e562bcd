"""Limb lengths: measuring them, judging markers by them, and the Levenberg-Marquardt solve.

The energy of one skeleton (Hi-ROS 2023, eq. 14 to 19), with one row ``w`` of weights per link::

    E = sum of w[0] (|d| - l)^2 + w[1] |p - p0|^2 + w[2] |c - c0|^2 + w[3] phi(d, d0)^2

over the links from marker ``p`` to marker ``c``, where ``d = c - p``, ``l`` is the nominal length,
``0`` marks the start and ``phi`` is the angle between two directions. A link of zero weights takes
no part. Loops, not slices: numba compiles them several times faster.
"""

from __future__ import annotations

from math import atan2, pi, sqrt
from typing import Any, NamedTuple

import numpy as np
from numba import njit, types

from hiros_mcap.kernels.compile import kernel, named_tuple
from hiros_mcap.skeletons import Floats, Ints

# Weights of an outlier's position and of its links' directions: just enough to make its place
# unique where the lengths alone do not.
_DOUBT_POSITION = 1e-4
_DOUBT_DIRECTION = 0.01

# To find which marker is wrong: displacements, m, that count a quarter of their weight, round by
# round of weighing and solving. The narrower ones alone leave it to chance whom they doubt (Blake
# and Zisserman's graduated non-convexity).
_DOUBT_SCALES = (0.2, 0.14, 0.1, 0.07, 0.05)
# What is left of a weight at the least: with next to nothing, rounding decides where a marker goes.
_LEAST_SHARE = 0.003

# How many steps in a row may raise the energy before the solver returns to the best point.
_PATIENCE = 6


_F1, _F2, _F3 = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]


class Topology(NamedTuple):
    """Links (L, 2), and what ``Elimination`` of hiros_mcap.stages.elimination says of them."""

    links: Ints
    order: Ints
    first: Ints
    row: Ints
    first_pair: Ints
    target: Ints
    link_slot: Ints


_TOPOLOGY = named_tuple(Topology, types.int32[:, ::1], *[types.int32[::1]] * 6)


class Work(NamedTuple):
    """Room of the solver for one skeleton of M markers and L links.

    It is the caller's: a kernel that makes arrays is slower.
    """

    diagonal: Floats
    inverse: Floats
    """(M, 3, 3)."""
    blocks: Floats
    scaled: Floats
    """(S, 3, 3), S of them off the diagonal."""
    slope: Floats
    step: Floats
    here: Floats
    found: Floats
    """(M, 3)."""
    aims: Floats
    """(L, 3)."""
    geometry: Floats
    """(L, 9)."""
    weights: Floats
    """(L, 4)."""
    tension: Floats
    """(L,)."""

    @classmethod
    def of(cls, n_markers: int, topology: Topology) -> Work:
        """Make room."""
        m, n, k = n_markers, len(topology.links), len(topology.row)
        shapes = [*[(m, 3, 3)] * 2, *[(k, 3, 3)] * 2, *[(m, 3)] * 4, (n, 3), (n, 9), (n, 4), (n,)]
        return cls(*[np.empty(shape) for shape in shapes])


_WORK = named_tuple(Work, *[_F3] * 4, *[_F2] * 7, _F1)


@kernel
def _distance(a: Floats, b: Floats) -> float:
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return sqrt(x * x + y * y + z * z)


@kernel("void(float64[:,:,::1], float64[:,::1], int32[:,::1], float64[:,::1], float64[:,::1])")
def measure(
    markers: Floats, confidences: Floats, links: Ints, lengths: Floats, weights: Floats
) -> None:
    """Write each link's length (P, L), m, NaN = not seen, and how much it counts, 0..1.

    A link counts as the harmonic mean of its markers' confidences: the variances of the two ends
    add up, and each is taken as inverse to the confidence (1 where none is given).
    """
    for i in range(markers.shape[0]):
        for k in range(links.shape[0]):
            p, c = links[k, 0], links[k, 1]
            lengths[i, k] = np.nan
            weights[i, k] = 0.0
            if p < 0 or c < 0 or p == c:
                continue
            length = _distance(markers[i, p], markers[i, c])
            if np.isnan(length):
                continue
            a, b = confidences[i, p], confidences[i, c]
            a = 1.0 if np.isnan(a) else a
            b = 1.0 if np.isnan(b) else b
            lengths[i, k] = length
            weights[i, k] = 2.0 * a * b / (a + b) if a > 0.0 and b > 0.0 else 0.0


@kernel
def _certainty(confidence: float) -> float:
    """Weight of a position: its confidence, 1 if not given; never 0, which would set it free."""
    return 1.0 if np.isnan(confidence) else min(max(confidence, 0.01), 1.0)


@kernel  # without a signature: not compiled unless it is wanted
def judge(
    points: Floats, nominal: Floats, links: Ints, outward: Ints, max_error: float, outlier: Ints
) -> int:
    """Find the outliers as the paper does (section 3.3.2) and set them to NaN in ``points``.

    From the roots outwards, a link whose length is off by more than ``max_error`` accuses its
    distal marker; a link that touches a marker already found out accuses nobody. Returns how many.
    """
    found = 0
    for i in range(points.shape[0]):
        for m in range(points.shape[1]):
            outlier[i, m] = 0
        for k in outward:
            p, c = links[k, 0], links[k, 1]
            if outlier[i, c] or outlier[i, p]:
                continue
            if abs(_distance(points[i, p], points[i, c]) - nominal[i, k]) > max_error:
                outlier[i, c] = 1
        for m in range(points.shape[1]):
            if outlier[i, m]:
                found += 1
                for j in range(3):
                    points[i, m, j] = np.nan
    return found


@kernel(
    "void(float64[:,:,::1], float64[:,::1], float64[:,::1], int32[:,::1], int32[::1],"
    " int32[:,::1], float64, float64, float64, float64[:,:,::1])"
)
def weigh(
    points: Floats,
    nominal: Floats,
    confidences: Floats,
    links: Ints,
    degree: Ints,
    outlier: Ints,
    max_error: float,
    stiffness: float,
    direction: float,
    weights: Floats,
) -> None:
    """Write the weights (P, L, 4): of length, parent, child and orientation.

    ``stiffness`` 0: eq. 18. Otherwise: ``stiffness`` for the length, ``direction`` for the
    orientation, and for each marker its confidence, shared out among the links that end in it.
    Outliers have (next to) no say in where they are put.
    """
    for i in range(points.shape[0]):
        for k in range(links.shape[0]):
            p, c = links[k, 0], links[k, 1]
            for j in range(4):
                weights[i, k, j] = 0.0
            if p < 0 or c < 0 or p == c:
                continue
            error = abs(_distance(points[i, p], points[i, c]) - nominal[i, k])
            if np.isnan(error):
                continue
            w = weights[i, k]
            if stiffness > 0.0:
                w[0], w[3] = stiffness, direction
                w[1] = _certainty(confidences[i, p]) / degree[p]
                w[2] = _certainty(confidences[i, c]) / degree[c]
            else:
                w[0] = min(error / max_error, 1.0) ** 0.2
                w[3] = (1.0 - w[0]) / 2.0
                w[1] = w[2] = max(w[3], _DOUBT_POSITION)  # else a pair on its own could fly off
            if outlier[i, p]:
                w[1] = _DOUBT_POSITION
            if outlier[i, c]:
                w[2] = _DOUBT_POSITION
            if outlier[i, p] or outlier[i, c]:
                w[0], w[3] = max(w[0], 1.0), _DOUBT_DIRECTION


@kernel
def _aim(start: Floats, links: Ints, weights: Floats, aims: Floats) -> None:
    """Write each link's direction at the start (L, 3); zeros where it has none or no weight."""
    for k in range(links.shape[0]):
        p, c = links[k, 0], links[k, 1]
        length = _distance(start[p], start[c]) if weights[k, 3] > 0.0 else 0.0
        for j in range(3):
            aims[k, j] = (start[c, j] - start[p, j]) / length if length > 1e-9 else 0.0


@kernel
def _look(x: Floats, p: int, c: int, aims: Floats, k: int, geometry: Floats) -> None:
    """Write |d|, unit d, phi, the unit tangent from d towards its aim, and phi cot phi (9)."""
    dx, dy, dz = x[c, 0] - x[p, 0], x[c, 1] - x[p, 1], x[c, 2] - x[p, 2]
    length = max(sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
    dx, dy, dz = dx / length, dy / length, dz / length
    ax, ay, az = aims[k, 0], aims[k, 1], aims[k, 2]
    cosine = dx * ax + dy * ay + dz * az
    ax, ay, az = ax - cosine * dx, ay - cosine * dy, az - cosine * dz
    sine = sqrt(ax * ax + ay * ay + az * az)
    share = 1.0 / sine if sine > 1e-14 else 0.0
    geometry[k, 0], geometry[k, 1], geometry[k, 2], geometry[k, 3] = length, dx, dy, dz
    geometry[k, 4] = phi = atan2(sine, cosine)
    geometry[k, 5], geometry[k, 6], geometry[k, 7] = ax * share, ay * share, az * share
    # The curvature of half the squared angle across the motion: 1 at 0, cut off below 0.
    if phi < 0.01:
        geometry[k, 8] = 1.0 - phi * phi / 3.0
    else:
        geometry[k, 8] = phi * cosine * share if phi < 0.5 * pi else 0.0


@njit(cache=True, nogil=True)  # makes arrays
def energy(x: Floats, start: Floats, nominal: Floats, links: Ints, weights: Floats) -> float:
    """Energy of one skeleton at ``x`` (M, 3), eq. 14 to 19."""
    total = 0.0
    aims, g = np.empty((links.shape[0], 3)), np.empty((links.shape[0], 9))
    _aim(start, links, weights, aims)
    for k in range(links.shape[0]):
        w = weights[k]
        if w[0] + w[1] + w[2] + w[3] == 0.0:
            continue
        p, c = links[k, 0], links[k, 1]
        _look(x, p, c, aims, k, g)
        moved_p, moved_c = _distance(x[p], start[p]), _distance(x[c], start[c])
        total += w[0] * (g[k, 0] - nominal[k]) ** 2 + w[1] * moved_p**2
        total += w[2] * moved_c**2 + w[3] * g[k, 4] ** 2
    return total


@kernel
def _assemble(
    x: Floats,
    start: Floats,
    aims: Floats,
    nominal: Floats,
    links: Ints,
    weights: Floats,
    link_slot: Ints,
    tension: Floats,
    geometry: Floats,
    diagonal: Floats,
    blocks: Floats,
    slope: Floats,
) -> float:
    """Write half the gradient, and half the Hessian kept positive semidefinite; return E.

    The angle's curvature is 1 along the motion and phi cot phi across it, the length's is its
    ``tension`` over the length across it: with both, steps converge as Newton's do.
    """
    diagonal[:] = 0.0
    blocks[:] = 0.0
    slope[:] = 0.0
    total = 0.0
    for k in range(links.shape[0]):
        w0, w1, w2, w3 = weights[k, 0], weights[k, 1], weights[k, 2], weights[k, 3]
        if w0 + w1 + w2 + w3 == 0.0:
            continue
        p, c, s = links[k, 0], links[k, 1], link_slot[k]
        _look(x, p, c, aims, k, geometry)
        length, phi = geometry[k, 0], geometry[k, 4]
        stretch = length - nominal[k]
        total += w0 * stretch * stretch + w3 * phi * phi
        pull, twist, turn = w0 * stretch, w3 * phi / length, w3 / (length * length)
        hold = 0.95 * w1 * w2 / (w1 + w2) if w1 + w2 > 0.0 else 0.0
        bend = turn * geometry[k, 8]
        across = max(tension[k] / length, -hold) + bend
        along, toward = w0 - across, turn - bend
        for i in range(3):
            ui, ti = geometry[k, 1 + i], geometry[k, 5 + i]
            force = pull * ui - twist * ti
            moved_p, moved_c = x[p, i] - start[p, i], x[c, i] - start[c, i]
            total += w1 * moved_p * moved_p + w2 * moved_c * moved_c
            slope[p, i] += w1 * moved_p - force
            slope[c, i] += w2 * moved_c + force
            diagonal[p, i, i] += w1 + across
            diagonal[c, i, i] += w2 + across
            blocks[s, i, i] -= across
            for j in range(3):
                stiff = along * ui * geometry[k, 1 + j] + toward * ti * geometry[k, 5 + j]
                diagonal[p, i, j] += stiff
                diagonal[c, i, j] += stiff
                blocks[s, i, j] -= stiff
    return total


@kernel
def _predict_tension(
    step: Floats, nominal: Floats, links: Ints, weights: Floats, geometry: Floats, tension: Floats
) -> None:
    """Write what the linear model says that each length's pull will be after the step.

    It is the Lagrange multiplier of sequential quadratic programming. With stiff lengths the pull
    measured after a step is mostly the curvature that the step left out, and useless.
    """
    for k in range(links.shape[0]):
        tension[k] = 0.0
        if weights[k, 0] == 0.0:
            continue
        p, c = links[k, 0], links[k, 1]
        stretch = geometry[k, 0] - nominal[k]
        for j in range(3):
            stretch += geometry[k, 1 + j] * (step[c, j] - step[p, j])
        tension[k] = weights[k, 0] * stretch


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


@kernel
def _eliminate(
    topology: Topology,
    damping: float,
    diagonal: Floats,
    blocks: Floats,
    slope: Floats,
    inverse: Floats,
    scaled: Floats,
    step: Floats,
) -> None:
    """Solve (Hessian + damping) step = -slope by block LDL^T; overwrites all but the plan."""
    order, first, row = topology.order, topology.first, topology.row
    first_pair, target = topology.first_pair, topology.target
    for k in range(order.shape[0]):
        m = order[k]
        _invert(diagonal, m, damping, inverse)
        pair = first_pair[k]
        for s in range(first[k], first[k + 1]):
            _scale(blocks, inverse, s, m, scaled)
        for s in range(first[k], first[k + 1]):
            r = row[s]
            _subtract(scaled, blocks, s, s, diagonal, r)
            for t in range(s + 1, first[k + 1]):
                _subtract(scaled, blocks, t, s, blocks, target[pair])
                pair += 1
            for i in range(3):
                for j in range(3):
                    slope[r, i] -= scaled[s, i, j] * slope[m, j]
    for k in range(order.shape[0] - 1, -1, -1):
        m = order[k]
        for s in range(first[k], first[k + 1]):
            r = row[s]
            for i in range(3):
                for j in range(3):
                    slope[m, i] += blocks[s, j, i] * step[r, j]
        for i in range(3):
            step[m, i] = 0.0
            for j in range(3):
                step[m, i] -= inverse[m, i, j] * slope[m, j]


@kernel
def _solve_one(
    start: Floats,
    nominal: Floats,
    weights: Floats,
    topology: Topology,
    tolerance: float,
    max_steps: int,
    warm: bool,
    work: Work,
    x: Floats,
) -> int:
    """Minimize one skeleton's energy into ``x``; return 1 if ``max_steps`` were not enough.

    Begins at ``start``; with ``warm``, where it ended for other weights, which ``x`` and ``work``
    still hold.
    ``x`` is always the best point so far. Undamped steps may raise the energy a few times in a
    row (the watchdog of Chamberlain et al. 1982: along a stiff, curved valley every good step
    does at first); when that does not pay, the solver goes on from ``x`` with damped, strictly
    descending ones, which is Levenberg and Marquardt's method.
    """
    markers, links = start.shape[0], topology.links
    diagonal, inverse, blocks, scaled = work.diagonal, work.inverse, work.blocks, work.scaled
    slope, step, here = work.slope, work.step, work.here
    aims, geometry, tension = work.aims, work.geometry, work.tension
    if not warm:
        tension[:] = 0.0
        geometry[:] = 0.0
        for m in range(markers):
            for j in range(3):
                x[m, j] = start[m, j]
    _aim(start, links, weights, aims)
    for m in range(markers):
        for j in range(3):
            here[m, j] = x[m, j]
    best, damping, size, worse = np.inf, 0.0, np.inf, 0
    for _ in range(max_steps):
        cost = _assemble(
            here, start, aims, nominal, links, weights, topology.link_slot, tension,
            geometry, diagonal, blocks, slope,
        )  # fmt: skip
        if cost < best:
            best, worse, damping = cost, 0, damping / 10.0 if damping > 1e-6 else 0.0
            for m in range(markers):
                for j in range(3):
                    x[m, j] = here[m, j]
        elif size > tolerance and cost > best:
            worse += 1
            if damping > 0.0 or worse > _PATIENCE:
                damping = max(damping * 10.0, 1e-4)
                tension[:] = 0.0
                for m in range(markers):
                    for j in range(3):
                        here[m, j] = x[m, j]
                size = np.inf
                continue
        if size <= tolerance or cost == 0.0:
            return 0
        _eliminate(topology, damping, diagonal, blocks, slope, inverse, scaled, step)
        _predict_tension(step, nominal, links, weights, geometry, tension)
        size = 0.0
        for m in range(markers):
            for j in range(3):
                here[m, j] += step[m, j]
                size = max(size, abs(step[m, j]))
    return 1


@kernel(types.int64(_F3, _F2, _F3, _TOPOLOGY, types.float64, types.int64, _WORK, _F3))
def solve(
    start: Floats,
    nominal: Floats,
    weights: Floats,
    topology: Topology,
    tolerance: float,
    max_steps: int,
    work: Work,
    x: Floats,
) -> int:
    """Minimize the energy of each person (P, M, 3) by Levenberg-Marquardt, into ``x``.

    Starts at ``start``. Only steps that lower the energy are taken. Converged = the largest
    coordinate of a taken step is below ``tolerance``, m. Returns how many people did not converge.
    """
    failed = 0
    for i in range(start.shape[0]):
        failed += _solve_one(
            start[i], nominal[i], weights[i], topology, tolerance, max_steps, False, work, x[i]
        )
    return failed


@kernel
def _suspect(points: Floats, nominal: Floats, links: Ints, max_error: float) -> bool:
    """Whether a link's length is off by more than ``max_error``."""
    for k in range(links.shape[0]):
        p, c = links[k, 0], links[k, 1]
        if p >= 0 and c >= 0 and abs(_distance(points[p], points[c]) - nominal[k]) > max_error:
            return True
    return False


@kernel
def _doubt(
    x: Floats, start: Floats, links: Ints, trusted: Floats, scale: float, weights: Floats
) -> None:
    """Weigh down what had to move far (Geman and McClure's estimator, one round)."""
    for k in range(links.shape[0]):
        least = 1.0
        for end in range(2):
            m = links[k, end]
            if m >= 0:
                moved = _distance(x[m], start[m]) / scale
                share = max(1.0 / (1.0 + moved * moved) ** 2, _LEAST_SHARE)
                weights[k, 1 + end] = trusted[k, 1 + end] * share
                least = min(least, share)
        weights[k, 3] = trusted[k, 3] * least


@kernel(types.int64(_F3, _F2, _F3, _TOPOLOGY, types.float64, types.int32[:, ::1], _WORK))
def relocate(
    points: Floats,
    nominal: Floats,
    trusted: Floats,
    topology: Topology,
    max_error: float,
    outlier: Ints,
    work: Work,
) -> int:
    """Find the markers that are wrong, and put them where the others and the lengths want them.

    Only people with a link off by more than ``max_error``. Which of its ends is wrong, the other
    links tell: the skeleton is solved with the weights ``trusted``, what moved far counts less,
    and again. A marker that ends up further than half of ``max_error`` from where it was measured
    is an outlier. Returns how many.
    """
    found = 0
    steps: Any = np.int64(30)  # a literal would make a second version of the solver
    links, x, weights = topology.links, work.found, work.weights
    for i in range(points.shape[0]):
        for m in range(points.shape[1]):
            outlier[i, m] = 0
        if not _suspect(points[i], nominal[i], links, max_error):
            continue
        for k in range(links.shape[0]):
            for j in range(4):
                weights[k, j] = trusted[i, k, j]
        for k in range(len(_DOUBT_SCALES) + 1):
            if k > 0:
                _doubt(x, points[i], links, trusted[i], _DOUBT_SCALES[k - 1], weights)
            # From the measured place of a marker that has little say, there is no telling where
            # Newton's steps would lead.
            _solve_one(points[i], nominal[i], weights, topology, 1e-4, steps, k > 0, work, x)
        for m in range(points.shape[1]):
            if _distance(x[m], points[i, m]) > 0.5 * max_error:
                outlier[i, m] = 1
                found += 1
                for j in range(3):
                    points[i, m, j] = x[m, j]
    return found


@kernel
def _turn(state: Floats, u: Floats, v: Floats, dot: float) -> None:
    """Multiply the orientation in ``state[3:7]`` from the left by the least rotation u -> v."""
    w = 1.0 + dot
    x = u[1] * v[2] - u[2] * v[1]
    y = u[2] * v[0] - u[0] * v[2]
    z = u[0] * v[1] - u[1] * v[0]
    size = sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / size, x / size, y / size, z / size
    qx, qy, qz, qw = state[3], state[4], state[5], state[6]
    state[3] = w * qx + x * qw + y * qz - z * qy
    state[4] = w * qy - x * qz + y * qw + z * qx
    state[5] = w * qz + x * qy - y * qx + z * qw
    state[6] = w * qw - x * qx - y * qy - z * qz


@kernel
def _move(
    state: Floats, p: Floats, c: Floats, new_p: Floats, new_c: Floats, turning: bool, work: Floats
) -> None:
    """Carry a link's position, and orientation if asked, from the ends p, c to new_p, new_c.

    ``work`` (2, 3) holds the two directions.
    """
    length, new_length = _distance(p, c), _distance(new_p, new_c)
    if not (length > 1e-9 and new_length > 1e-9):
        return
    share = dot = 0.0
    u, v = work[0], work[1]
    for x in range(3):
        u[x], v[x] = (c[x] - p[x]) / length, (new_c[x] - new_p[x]) / new_length
        share += u[x] * (state[x] - p[x]) / length
        dot += u[x] * v[x]
    share = min(max(share, 0.0), 1.0)
    for x in range(3):
        state[x] += (1.0 - share) * (new_p[x] - p[x]) + share * (new_c[x] - c[x])
    if turning and dot > -1.0 + 1e-12:
        _turn(state, u, v, dot)


@kernel(
    "void(float64[:,:,::1], float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1],"
    " int32[:,::1], float64[:,:,::1], int32[:,::1], int64, boolean, float64[:,::1])"
)
def apply(
    solved: Floats,
    markers: Floats,
    marker_confidences: Floats,
    states: Floats,
    link_confidences: Floats,
    links: Ints,
    weights: Floats,
    outlier: Ints,
    remove: bool,
    turning: bool,
    work: Floats,
) -> None:
    """Write the solved positions (P, M, 3) into the states of markers and links, in place.

    The position of a link of some weight, if it has one, moves along with its two ends; with
    ``turning`` it is also turned by the least rotation that takes its measured direction to the
    solved one. With ``remove``, outliers and the links that touch them become absent. ``work`` is
    room of (2, 3).
    """
    for i in range(solved.shape[0]):
        for k in range(links.shape[0]):
            p, c = links[k, 0], links[k, 1]
            if p < 0 or c < 0:
                continue
            if remove and (outlier[i, p] or outlier[i, c]):
                for j in range(states.shape[2]):
                    states[i, k, j] = np.nan
                link_confidences[i, k] = np.nan
            elif weights[i, k, 0] + weights[i, k, 3] > 0.0:
                _move(
                    states[i, k], markers[i, p], markers[i, c], solved[i, p], solved[i, c],
                    turning, work,
                )  # fmt: skip
        for m in range(markers.shape[1]):
            if remove and outlier[i, m]:
                for j in range(markers.shape[2]):
                    markers[i, m, j] = np.nan
                marker_confidences[i, m] = np.nan
            else:
                for j in range(3):
                    markers[i, m, j] = solved[i, m, j]
