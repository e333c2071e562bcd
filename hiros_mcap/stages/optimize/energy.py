"""The energy of a skeleton and its minimum (Hi-ROS 2023, section 3.3.3, eq 14 to 19).

Levenberg and Marquardt's method on the blocks of the normal equations. Loops, not slices: numba
compiles them several times faster.
"""

from __future__ import annotations

from math import atan2, pi, sqrt
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2, F3, J2, arrays
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.kernels.points import point_distance
from hiros_mcap.skeletons import Floats, Ints
from hiros_mcap.stages.optimize.normal_equations import NormalEquations, Topology, solve_equations

MAX_STEPS = 50

# Columns of the weights (P, L, 4), eq 17: of the length, of the two ends, of the orientation.
W_LENGTH, W_PROXIMAL, W_DISTAL, W_ORIENTATION = range(4)

# Weights of rigid lengths, against 1 for a position of full confidence.
STIFFNESS = 1e3
DIRECTION = 1e-3

# Weights of an outlier's position and of its links' directions: just enough to make its place
# unique where the lengths alone do not.
_OUTLIER_POSITION = 1e-4
_OUTLIER_DIRECTION = 0.01

# How many steps in a row may raise the energy before the solver returns to the best point.
_PATIENCE = 6


class Energy(NamedTuple):
    """The constants of the energy (eq 14 to 19): of P skeletons, or of one without the first axis.

    A link of zero weights takes no part.
    """

    start: F3  # (P, M, 3) measured positions, m; the minimization starts there
    nominal: F2  # (P, L) calibrated lengths, m
    weights: F3  # (P, L, 4) columns W_LENGTH to W_ORIENTATION


class SolverScratch(NamedTuple):
    """Scratch arrays of the solver for one skeleton; a kernel that makes arrays is slower."""

    equations: NormalEquations
    start_direction: F2  # (L, 3) direction of each link at the start
    length: F1  # (L,) of each link at the current positions, m
    direction: F2  # (L, 3) unit vector from the proximal to the distal marker
    angle: F1  # (L,) phi of eq 16, rad
    tangent: F2
    """(L, 3) unit vector at a right angle to the direction, towards the direction at the start."""
    curvature: F1  # (L,) phi cot phi
    multiplier: F1  # (L,) predicted force of each length term
    current: F2  # (M, 3) positions that the solver tries
    solution: F2  # (M, 3) result of the search for outliers
    weights: F2  # (L, 4) weights of that search

    @classmethod
    def of(cls, topology: Topology) -> SolverScratch:
        """Allocate the arrays."""
        m, n = len(topology.order), len(topology.links)
        links = (n, 3), n, (n, 3), n, (n, 3), n, n
        return arrays(cls, NormalEquations.of(topology), *links, (m, 3), (m, 3), (n, 4))


@kernel
def length_error(points: Floats, nominal: Floats, links: Ints, k: int) -> float:
    """How far link ``k`` is off its calibrated length, m; NaN where it is not known."""
    p, d = links[k, 0], links[k, 1]
    if p < 0 or d < 0 or p == d:
        return np.nan
    error: float = point_distance(points[p], points[d]) - nominal[k]
    return abs(error)


@kernel
def _certainty(confidence: float) -> float:
    """Weight of a position: its confidence, 1 if not given; never 0, which would set it free."""
    return 1.0 if np.isnan(confidence) else min(max(confidence, 0.01), 1.0)


@kernel
def _free_outliers(proximal: int, distal: int, w: Floats) -> None:
    """Let the lengths alone decide where outliers go."""
    if proximal:
        w[W_PROXIMAL] = _OUTLIER_POSITION
    if distal:
        w[W_DISTAL] = _OUTLIER_POSITION
    if proximal or distal:
        w[W_LENGTH], w[W_ORIENTATION] = max(w[W_LENGTH], 1.0), _OUTLIER_DIRECTION


@kernel  # without a signature: not compiled unless it is wanted
def paper_weights(energy: Energy, topology: Topology, outlier: Ints, max_error: float) -> None:
    """Write the weights of eq 18."""
    links = topology.links
    for i in range(outlier.shape[0]):
        for k in range(links.shape[0]):
            w = energy.weights[i, k]
            w[:] = 0.0
            error = length_error(energy.start[i], energy.nominal[i], links, k)
            if np.isnan(error):
                continue
            w[W_LENGTH] = min(error / max_error, 1.0) ** 0.2  # eq 18, w_l
            w[W_ORIENTATION] = (1.0 - w[W_LENGTH]) / 2.0  # eq 18, w_o = w_p
            position = max(w[W_ORIENTATION], _OUTLIER_POSITION)  # a pair on its own stays in place
            w[W_PROXIMAL] = w[W_DISTAL] = position  # eq 18, w_p
            _free_outliers(outlier[i, links[k, 0]], outlier[i, links[k, 1]], w)


@entry
def exact_weights(energy: Energy, topology: Topology, outlier: J2, confidences: F2) -> None:
    """Write the weights that make lengths rigid; markers (P, M) count by their confidences.

    A marker's confidence is shared out among the links that end in it.
    """
    links, degree = topology.links, topology.degree
    for i in range(outlier.shape[0]):
        for k in range(links.shape[0]):
            p, d, w = links[k, 0], links[k, 1], energy.weights[i, k]
            w[:] = 0.0
            if np.isnan(length_error(energy.start[i], energy.nominal[i], links, k)):
                continue
            w[W_LENGTH], w[W_ORIENTATION] = STIFFNESS, DIRECTION
            w[W_PROXIMAL] = _certainty(confidences[i, p]) / degree[p]
            w[W_DISTAL] = _certainty(confidences[i, d]) / degree[d]
            _free_outliers(outlier[i, p], outlier[i, d], w)


@kernel
def _copy(source: Floats, target: Floats) -> None:
    for m in range(source.shape[0]):
        for j in range(3):
            target[m, j] = source[m, j]


@inlined
def _write_start_directions(energy: Energy, links: Ints, directions: Floats) -> None:
    """Write each link's direction at the start; zeros where it has none or no weight."""
    for k in range(links.shape[0]):
        p, d = links[k, 0], links[k, 1]
        weighted = energy.weights[k, W_ORIENTATION] > 0.0
        length = point_distance(energy.start[p], energy.start[d]) if weighted else 0.0
        for j in range(3):
            way = energy.start[d, j] - energy.start[p, j]
            directions[k, j] = way / length if length > 1e-9 else 0.0


@inlined
def _write_geometry(x: Floats, p: int, d: int, k: int, scratch: SolverScratch) -> None:
    """Write the geometry of link ``k`` between the markers ``p`` and ``d`` of ``x``."""
    dx, dy, dz = x[d, 0] - x[p, 0], x[d, 1] - x[p, 1], x[d, 2] - x[p, 2]
    length = max(sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
    dx, dy, dz = dx / length, dy / length, dz / length
    start = scratch.start_direction
    ax, ay, az = start[k, 0], start[k, 1], start[k, 2]
    cosine = dx * ax + dy * ay + dz * az
    ax, ay, az = ax - cosine * dx, ay - cosine * dy, az - cosine * dz
    sine = sqrt(ax * ax + ay * ay + az * az)
    share = 1.0 / sine if sine > 1e-14 else 0.0
    direction, tangent = scratch.direction, scratch.tangent
    scratch.length[k] = length
    direction[k, 0], direction[k, 1], direction[k, 2] = dx, dy, dz
    scratch.angle[k] = phi = atan2(sine, cosine)  # eq 16
    tangent[k, 0], tangent[k, 1], tangent[k, 2] = ax * share, ay * share, az * share
    # phi cot phi: 1 at 0, cut off below 0.
    if phi < 0.01:
        scratch.curvature[k] = 1.0 - phi * phi / 3.0
    else:
        scratch.curvature[k] = phi * cosine * share if phi < 0.5 * pi else 0.0


@inlined
def _assemble(x: Floats, energy: Energy, topology: Topology, scratch: SolverScratch) -> float:
    """Write half the gradient and half the Hessian at ``x``; return the energy.

    The Hessian is kept positive semidefinite. The angle's curvature is 1 along the motion and
    phi cot phi across it. The length's is its multiplier over the length across it. With both,
    steps converge as Newton's do.
    """
    start, weights = energy.start, energy.weights
    diagonal, _, blocks, _, gradient, _ = scratch.equations
    diagonal[:] = 0.0
    blocks[:] = 0.0
    gradient[:] = 0.0
    total = 0.0
    for k in range(topology.links.shape[0]):
        w_l, w_o = weights[k, W_LENGTH], weights[k, W_ORIENTATION]
        w_p, w_d = weights[k, W_PROXIMAL], weights[k, W_DISTAL]
        if w_l + w_p + w_d + w_o == 0.0:
            continue
        p, d = topology.links[k, 0], topology.links[k, 1]
        s = topology.block[p, d]
        _write_geometry(x, p, d, k, scratch)
        length, phi = scratch.length[k], scratch.angle[k]
        error = length - energy.nominal[k]
        total += w_l * error * error + w_o * phi * phi  # eq 14 and 16, weighted and summed: 17, 19
        stiffness = w_o / (length * length)
        hold = 0.95 * w_p * w_d / (w_p + w_d) if w_p + w_d > 0.0 else 0.0
        bending = stiffness * scratch.curvature[k]
        across = max(scratch.multiplier[k] / length, -hold) + bending
        along, toward = w_l - across, stiffness - bending
        for i in range(3):
            ui, ti = scratch.direction[k, i], scratch.tangent[k, i]
            force = w_l * error * ui - w_o * phi / length * ti
            moved_p, moved_d = x[p, i] - start[p, i], x[d, i] - start[d, i]
            total += w_p * moved_p * moved_p + w_d * moved_d * moved_d  # eq 15, weighted: 17, 19
            gradient[p, i] += w_p * moved_p - force
            gradient[d, i] += w_d * moved_d + force
            diagonal[p, i, i] += w_p + across
            diagonal[d, i, i] += w_d + across
            blocks[s, i, i] -= across
            for j in range(3):
                uj, tj = scratch.direction[k, j], scratch.tangent[k, j]
                stiff = along * ui * uj + toward * ti * tj
                diagonal[p, i, j] += stiff
                diagonal[d, i, j] += stiff
                blocks[s, i, j] -= stiff
    return total


@inlined
def _predict_multipliers(energy: Energy, links: Ints, scratch: SolverScratch) -> None:
    """Write the force of each length term after the step, as the linear model predicts it.

    It is the Lagrange multiplier of sequential quadratic programming. With stiff lengths the force
    measured after a step is mostly the curvature that the step left out, and useless.
    """
    step, weights = scratch.equations.step, energy.weights
    for k in range(links.shape[0]):
        scratch.multiplier[k] = 0.0
        if weights[k, W_LENGTH] == 0.0:
            continue
        p, d = links[k, 0], links[k, 1]
        error = scratch.length[k] - energy.nominal[k]
        for j in range(3):
            error += scratch.direction[k, j] * (step[d, j] - step[p, j])
        scratch.multiplier[k] = weights[k, W_LENGTH] * error


@kernel
def minimize_one(
    energy: Energy, topology: Topology, tolerance: float, max_steps: int, warm: bool,
    scratch: SolverScratch, x: Floats,
) -> int:  # fmt: skip
    """Minimize one skeleton's energy into ``x``; return 1 if ``max_steps`` were not enough.

    Begins at the start, or with ``warm`` where the last call ended, for other weights: ``x`` and
    ``scratch`` still hold that. ``x`` is always the best point so far. Undamped steps may raise
    the energy a few times in a row (the watchdog of Chamberlain et al. 1982: along a stiff, curved
    valley every good step does at first). When that does not pay, the solver goes on from ``x``
    with damped, strictly descending steps, which is Levenberg and Marquardt's method.
    """
    here, step = scratch.current, scratch.equations.step
    if not warm:
        scratch.multiplier[:] = 0.0
        _copy(energy.start, x)
    _write_start_directions(energy, topology.links, scratch.start_direction)
    _copy(x, here)
    best, damping, size, worse = np.inf, 0.0, np.inf, 0
    for _ in range(max_steps):
        cost = _assemble(here, energy, topology, scratch)
        if cost < best:
            best, worse, damping = cost, 0, damping / 10.0 if damping > 1e-6 else 0.0
            _copy(here, x)
        elif size > tolerance and cost > best:
            worse += 1
            if damping > 0.0 or worse > _PATIENCE:
                damping, size = max(damping * 10.0, 1e-4), np.inf
                scratch.multiplier[:] = 0.0
                _copy(x, here)
                continue
        if size <= tolerance or cost == 0.0:
            return 0
        solve_equations(topology, damping, scratch.equations)
        _predict_multipliers(energy, topology.links, scratch)
        size = 0.0
        for m in range(x.shape[0]):
            for j in range(3):
                here[m, j] += step[m, j]
                size = max(size, abs(step[m, j]))
    return 1


@entry
def minimize(
    energy: Energy, topology: Topology, tolerance: float, scratch: SolverScratch, x: F3
) -> int:
    """Write the poses of least energy to ``x`` (P, M, 3); return how many did not converge.

    A skeleton has converged when no coordinate moves by more than ``tolerance``, m, in a step.
    """
    failed, steps = 0, np.int64(MAX_STEPS)
    for i in range(x.shape[0]):
        skeleton = Energy(energy.start[i], energy.nominal[i], energy.weights[i])
        failed += minimize_one(skeleton, topology, tolerance, steps, False, scratch, x[i])
    return failed
