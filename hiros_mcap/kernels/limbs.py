"""Limb lengths: measuring them, judging markers by them, and the Levenberg-Marquardt solve.

The energy of one skeleton (Hi-ROS 2023, eq. 14 to 19), with one row ``w`` of weights per link::

    E = sum of w[0] (|d| - l)^2 + w[1] |p - p0|^2 + w[2] |c - c0|^2 + w[3] phi(d, d0)^2

over the links from marker ``p`` to marker ``c``, where ``d = c - p``, ``l`` is the nominal length,
``0`` marks the start and ``phi`` is the angle between two directions. A link of zero weights takes
no part. Loops, not slices: numba compiles them several times faster.
"""

from __future__ import annotations

from math import atan2, sqrt

import numpy as np
from numba import njit

from hiros_mcap.skeletons import Floats, Ints

REMOVE = 0
RESTORE = 1

# Values of ``outlier``: a marker that the link into it accuses, a root that its links accuse.
DISTAL = 1
ROOT = 2

# Of a link that touches an outlier: just enough to make the restored place unique where the
# lengths alone do not.
_DOUBT_POSITION = 1e-4
_DOUBT_DIRECTION = 0.01

# How many steps in a row may raise the energy before the solver returns to the best point.
_PATIENCE = 6


@njit(cache=True, nogil=True)
def _distance(a: Floats, b: Floats) -> float:
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return sqrt(x * x + y * y + z * z)


@njit(
    "void(float64[:,:,::1], float64[:,::1], int32[:,::1], float64[:,::1], float64[:,::1])",
    cache=True,
    nogil=True,
)
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


@njit(cache=True, nogil=True)
def _certainty(confidence: float) -> float:
    """Weight of a position: its confidence, 1 if not given; never 0, which would set it free."""
    return 1.0 if np.isnan(confidence) else min(max(confidence, 0.01), 1.0)


@njit(cache=True, nogil=True)
def _judge_roots(
    points: Floats, nominal: Floats, links: Ints, max_error: float, outlier: Ints
) -> None:
    """Mark a root that most of its three or more links accuse: not all its children."""
    for m in range(points.shape[0]):
        seen = bad = 0
        for k in range(links.shape[0]):
            if links[k, 1] == m:
                seen = -1
                break
            if links[k, 0] == m and links[k, 1] >= 0:
                error = abs(_distance(points[m], points[links[k, 1]]) - nominal[k])
                seen += 0 if np.isnan(error) else 1
                bad += 1 if error > max_error else 0
        if seen >= 3 and 2 * bad > seen:
            outlier[m] = ROOT


@njit(cache=True, nogil=True)
def _restore(
    points: Floats, measured: Floats, p: int, c: int, length: float, max_error: float
) -> None:
    """Put marker c at ``length`` from p, in the measured direction.

    Where p was displaced too and the two were measured at a plausible distance from each other,
    they went astray together, and their own direction is the one to trust.
    """
    own = _distance(measured[p], measured[c])
    together = abs(own - length) <= max_error
    size = own if together else _distance(points[p], points[c])
    for x in range(3):
        start = measured[p, x] if together else points[p, x]
        along = (measured[c, x] - start) / size if size > 1e-9 else np.nan
        points[c, x] = points[p, x] + along * length


@njit(
    "int64(float64[:,:,::1], float64[:,::1], int32[:,::1], int32[::1], float64, int64,"
    " int32[:,::1])",
    cache=True,
    nogil=True,
)
def judge(
    points: Floats,
    nominal: Floats,
    links: Ints,
    outward: Ints,
    max_error: float,
    mode: int,
    outlier: Ints,
) -> int:
    """Find the outliers (section 3.3.2) from the roots outwards, and set them right in ``points``.

    A link whose length is off by more than ``max_error`` accuses its distal marker; a link that
    touches a marker already found out accuses nobody. REMOVE sets the marker to NaN, RESTORE puts
    it at nominal length in the measured direction and carries on from there. Returns how many.
    """
    found = 0
    measured = np.empty_like(points[0]) if len(points) else np.empty((0, 3))
    for i in range(points.shape[0]):
        for m in range(points.shape[1]):
            outlier[i, m] = 0
            for x in range(3):
                measured[m, x] = points[i, m, x]
        if mode == RESTORE:
            _judge_roots(points[i], nominal[i], links, max_error, outlier[i])
        for k in outward:
            p, c = links[k, 0], links[k, 1]
            if outlier[i, c] or (mode == REMOVE and outlier[i, p]):
                continue
            if mode == RESTORE and outlier[i, p] == ROOT:
                continue
            error = abs(_distance(points[i, p], points[i, c]) - nominal[i, k])
            if not error > max_error:
                continue
            outlier[i, c] = DISTAL
            if mode == RESTORE:
                _restore(points[i], measured, p, c, nominal[i, k], max_error)
        for m in range(points.shape[1]):
            if outlier[i, m]:
                found += 1
                if mode == REMOVE:
                    for x in range(3):
                        points[i, m, x] = np.nan
    return found


@njit(
    "void(float64[:,:,::1], float64[:,::1], float64[:,::1], int32[:,::1], int32[::1],"
    " int32[:,::1], float64, float64, float64, float64[:,:,::1])",
    cache=True,
    nogil=True,
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
                w[1] = w[2] = (1.0 - w[0]) / 2.0
                w[3] = 1.0 - w[0] - w[1]
            if outlier[i, p]:
                w[1] = _DOUBT_POSITION
            if outlier[i, c]:
                w[2] = _DOUBT_POSITION
            if outlier[i, p] == ROOT:
                w[3] = _DOUBT_POSITION
            elif outlier[i, p] or outlier[i, c]:
                w[3] = _DOUBT_DIRECTION


@njit(cache=True, nogil=True)
def _link_geometry(
    p: Floats, c: Floats, p0: Floats, c0: Floats, with_angle: bool, out: Floats
) -> None:
    """Write |d|, the unit d, phi, and the unit tangent that leads from d to d0, to ``out`` (8)."""
    length = max(_distance(p, c), 1e-12)
    out[0] = length
    for j in range(3):
        out[1 + j] = (c[j] - p[j]) / length
        out[4 + j] = out[7] = 0.0
    start = _distance(p0, c0) if with_angle else 0.0
    if start <= 1e-9:
        return
    cosine = sine = 0.0
    for j in range(3):
        out[5 + j] = (c0[j] - p0[j]) / start
        cosine += out[1 + j] * out[5 + j]
    for j in range(3):
        out[5 + j] -= cosine * out[1 + j]
        sine += out[5 + j] * out[5 + j]
    sine = sqrt(sine)
    for j in range(3):
        out[5 + j] = out[5 + j] / sine if sine > 1e-14 else 0.0
    out[4] = atan2(sine, cosine)


@njit(
    "float64(float64[:,::1], float64[:,::1], float64[::1], int32[:,::1], float64[:,::1])",
    cache=True,
    nogil=True,
)
def energy(x: Floats, start: Floats, nominal: Floats, links: Ints, weights: Floats) -> float:
    """Energy of one skeleton at ``x`` (M, 3), eq. 14 to 19."""
    total = 0.0
    g = np.empty(8)
    for k in range(links.shape[0]):
        w = weights[k]
        if w[0] + w[1] + w[2] + w[3] == 0.0:
            continue
        p, c = links[k, 0], links[k, 1]
        _link_geometry(x[p], x[c], start[p], start[c], w[3] > 0.0, g)
        moved_p, moved_c = _distance(x[p], start[p]), _distance(x[c], start[c])
        total += w[0] * (g[0] - nominal[k]) ** 2 + w[1] * moved_p**2
        total += w[2] * moved_c**2 + w[3] * g[4] ** 2
    return total


@njit(cache=True, nogil=True)
def _assemble(
    x: Floats,
    start: Floats,
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
        w, g = weights[k], geometry[k]
        if w[0] + w[1] + w[2] + w[3] == 0.0:
            continue
        p, c = links[k, 0], links[k, 1]
        _link_geometry(x[p], x[c], start[p], start[c], w[3] > 0.0, g)
        stretch, phi = g[0] - nominal[k], g[4]
        total += w[0] * stretch * stretch + w[3] * phi * phi
        pull, twist = w[0] * stretch, w[3] * phi / g[0]
        hold = 0.95 * w[1] * w[2] / (w[1] + w[2]) if w[1] + w[2] > 0.0 else 0.0
        bend, turn = max(tension[k] / g[0], -hold), w[3] / (g[0] * g[0])
        across = (1.0 if phi < 1.0 else 0.0) * turn
        if 1e-7 < phi < 3.14159:
            across = max(phi / np.tan(phi), 0.0) * turn
        for i in range(3):
            force = pull * g[1 + i] - twist * g[5 + i]
            moved_p, moved_c = x[p, i] - start[p, i], x[c, i] - start[c, i]
            total += w[1] * moved_p * moved_p + w[2] * moved_c * moved_c
            slope[p, i] += w[1] * moved_p - force
            slope[c, i] += w[2] * moved_c + force
            diagonal[p, i, i] += w[1] + bend + across
            diagonal[c, i, i] += w[2] + bend + across
            blocks[link_slot[k], i, i] -= bend + across
            for j in range(3):
                stiff = (w[0] - bend - across) * g[1 + i] * g[1 + j]
                stiff += (turn - across) * g[5 + i] * g[5 + j]
                diagonal[p, i, j] += stiff
                diagonal[c, i, j] += stiff
                blocks[link_slot[k], i, j] -= stiff
    return total


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _scale(blocks: Floats, inverse: Floats, s: int, m: int, out: Floats) -> None:
    """``out[s] = blocks[s] inverse[m]``, 3x3."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for n in range(3):
                total += blocks[s, i, n] * inverse[m, n, j]
            out[s, i, j] = total


@njit(cache=True, nogil=True)
def _subtract(a: Floats, b: Floats, s: int, t: int, out: Floats, r: int) -> None:
    """``out[r] -= a[s] b[t]^T``, 3x3."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for n in range(3):
                total += a[s, i, n] * b[t, j, n]
            out[r, i, j] -= total


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _eliminate(
    order: Ints,
    first: Ints,
    row: Ints,
    first_pair: Ints,
    target: Ints,
    damping: float,
    diagonal: Floats,
    blocks: Floats,
    slope: Floats,
    inverse: Floats,
    scaled: Floats,
    step: Floats,
) -> None:
    """Solve (Hessian + damping) step = -slope by block LDL^T; overwrites all but the plan."""
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


@njit(cache=True, nogil=True)
def _solve_one(
    start: Floats,
    nominal: Floats,
    weights: Floats,
    links: Ints,
    order: Ints,
    first: Ints,
    row: Ints,
    first_pair: Ints,
    target: Ints,
    link_slot: Ints,
    tolerance: float,
    max_steps: int,
    x: Floats,
) -> int:
    """Minimize one skeleton's energy into ``x``; return 1 if ``max_steps`` were not enough.

    ``x`` is always the best point so far. Undamped steps may raise the energy a few times in a
    row (the watchdog of Chamberlain et al. 1982: along a stiff, curved valley every good step
    does at first); when that does not pay, the solver goes on from ``x`` with damped, strictly
    descending ones, which is Levenberg and Marquardt's method.
    """
    markers, n_links = start.shape[0], links.shape[0]
    diagonal, inverse = np.empty((markers, 3, 3)), np.empty((markers, 3, 3))
    blocks, scaled = np.empty((row.shape[0], 3, 3)), np.empty((row.shape[0], 3, 3))
    slope, step, here = np.empty((markers, 3)), np.empty((markers, 3)), np.empty((markers, 3))
    tension, geometry = np.zeros(n_links), np.zeros((n_links, 8))
    for m in range(markers):
        for j in range(3):
            x[m, j] = here[m, j] = start[m, j]
    best, damping, size, worse = np.inf, 0.0, np.inf, 0
    for _ in range(max_steps):
        cost = _assemble(
            here, start, nominal, links, weights, link_slot, tension,
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
        _eliminate(
            order, first, row, first_pair, target, damping,
            diagonal, blocks, slope, inverse, scaled, step,
        )  # fmt: skip
        _predict_tension(step, nominal, links, weights, geometry, tension)
        size = 0.0
        for m in range(markers):
            for j in range(3):
                here[m, j] += step[m, j]
                size = max(size, abs(step[m, j]))
    return 1


@njit(
    "int64(float64[:,:,::1], float64[:,::1], float64[:,:,::1], int32[:,::1], int32[::1],"
    " int32[::1], int32[::1], int32[::1], int32[::1], int32[::1], float64, int64,"
    " float64[:,:,::1])",
    cache=True,
    nogil=True,
)
def solve(
    start: Floats,
    nominal: Floats,
    weights: Floats,
    links: Ints,
    order: Ints,
    first: Ints,
    row: Ints,
    first_pair: Ints,
    target: Ints,
    link_slot: Ints,
    tolerance: float,
    max_steps: int,
    x: Floats,
) -> int:
    """Minimize the energy of each person (P, M, 3) by Levenberg-Marquardt, into ``x``.

    Starts at ``start``. Only steps that lower the energy are taken. Converged = the largest
    coordinate of a taken step is below ``tolerance``, m. Returns how many people did not converge.
    """
    failed = 0
    for i in range(start.shape[0]):
        failed += _solve_one(
            start[i], nominal[i], weights[i], links, order, first, row, first_pair, target,
            link_slot, tolerance, max_steps, x[i],
        )  # fmt: skip
    return failed


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _move(state: Floats, p: Floats, c: Floats, new_p: Floats, new_c: Floats) -> None:
    """Carry a link's position and orientation from the ends p, c to new_p, new_c."""
    length, new_length = _distance(p, c), _distance(new_p, new_c)
    if not (length > 1e-9 and new_length > 1e-9):
        return
    share = dot = 0.0
    u, v = np.empty(3), np.empty(3)
    for x in range(3):
        u[x], v[x] = (c[x] - p[x]) / length, (new_c[x] - new_p[x]) / new_length
        share += u[x] * (state[x] - p[x]) / length
        dot += u[x] * v[x]
    share = min(max(share, 0.0), 1.0)
    for x in range(3):
        state[x] += (1.0 - share) * (new_p[x] - p[x]) + share * (new_c[x] - c[x])
    if dot > -1.0 + 1e-12:
        _turn(state, u, v, dot)


@njit(
    "void(float64[:,:,::1], float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1],"
    " int32[:,::1], float64[:,:,::1], int32[:,::1], int64)",
    cache=True,
    nogil=True,
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
    mode: int,
) -> None:
    """Write the solved positions (P, M, 3) into the states of markers and links, in place.

    A link of some weight is turned by the least rotation that takes its measured direction to the
    solved one, and its position, if it has one, moves along with its two ends. With REMOVE,
    outliers and the links that touch them become absent.
    """
    for i in range(solved.shape[0]):
        for k in range(links.shape[0]):
            p, c = links[k, 0], links[k, 1]
            if p < 0 or c < 0:
                continue
            if mode == REMOVE and (outlier[i, p] or outlier[i, c]):
                for j in range(states.shape[2]):
                    states[i, k, j] = np.nan
                link_confidences[i, k] = np.nan
            elif weights[i, k, 0] + weights[i, k, 3] > 0.0:
                _move(states[i, k], markers[i, p], markers[i, c], solved[i, p], solved[i, c])
        for m in range(markers.shape[1]):
            if mode == REMOVE and outlier[i, m]:
                for j in range(markers.shape[2]):
                    markers[i, m, j] = np.nan
                marker_confidences[i, m] = np.nan
            else:
                for j in range(3):
                    markers[i, m, j] = solved[i, m, j]
