"""The optimizer's energy minimized by Ceres Solver, as the paper does (section 3.3.3).

There is one cost function per skeleton, with an analytic Jacobian, and one Problem for the whole
run. Each skeleton's numbers are written into its arrays. A cost function per link is ten times
slower: all that time goes into calls from C++ to Python.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hiros_mcap.skeletons import Floats, SkeletonModel
from hiros_mcap.stages.optimize.energy import W_DISTAL, W_LENGTH, W_ORIENTATION, W_PROXIMAL, Energy

# Residuals of a link: length, positions of its two ends, orientation.
_LENGTH, _PROXIMAL, _DISTAL, _ORIENTATION = 0, slice(1, 4), slice(4, 7), slice(7, 10)
_ROWS = 10


class Residuals:
    """Residuals of one skeleton, whose squares add up to the energy, and their Jacobian.

    The unknowns are the displacements (M, 3) of the markers from the start, m. The angle between
    two directions enters as the rotation vector from one to the other, whose norm it is: three
    smooth residuals instead of one that has a kink where it vanishes.
    """

    def __init__(self, model: SkeletonModel) -> None:
        self.links = model.links
        self.start = np.zeros((model.n_markers, 3))
        self.nominal = np.zeros(model.n_links)
        self.roots = np.zeros((model.n_links, 4))

    def load(self, start: Floats, nominal: Floats, weights: Floats) -> None:
        """Set the skeleton: start (M, 3), nominal (L,), weights (L, 4); absent is NaN or 0."""
        self.start[:] = np.nan_to_num(start)
        self.nominal[:] = np.where(weights.any(axis=1), nominal, 0.0)
        self.roots[:] = np.sqrt(weights)

    def __call__(self, moved: Floats) -> tuple[Floats, Floats]:
        """Residuals (10 L,) and Jacobian (10 L, 3 M) at displacements ``moved`` (M, 3)."""
        (p, d), root = self.links.T, self.roots[:, :, None]
        start = self.start[d] - self.start[p]
        length, u = _direction(start + moved[d] - moved[p])
        phi, phi_by_u = _rotation_vector(u, _direction(start)[1])
        residuals = np.empty((len(p), _ROWS))
        residuals[:, _LENGTH] = root[:, W_LENGTH, 0] * (length - self.nominal)  # eq 14
        residuals[:, _PROXIMAL] = root[:, W_PROXIMAL] * moved[p]  # eq 15
        residuals[:, _DISTAL] = root[:, W_DISTAL] * moved[d]  # eq 15
        residuals[:, _ORIENTATION] = root[:, W_ORIENTATION] * phi  # eq 16
        across = (np.eye(3) - u[:, :, None] * u[:, None, :]) / length[:, None, None]
        by_d = np.zeros((len(p), _ROWS, 3))
        by_d[:, _LENGTH] = root[:, W_LENGTH] * u
        by_d[:, _ORIENTATION] = root[:, W_ORIENTATION, None] * (phi_by_u @ across)
        by_p = -by_d
        by_p[:, _PROXIMAL] += root[:, W_PROXIMAL, None] * np.eye(3)
        by_d[:, _DISTAL] += root[:, W_DISTAL, None] * np.eye(3)
        jacobian, rows = np.zeros((len(p), _ROWS, *moved.shape)), np.arange(len(p))
        jacobian[rows, :, p] += by_p
        jacobian[rows, :, d] += by_d
        return residuals.ravel(), jacobian.reshape(residuals.size, moved.size)


def _direction(d: Floats) -> tuple[Floats, Floats]:
    """Lengths (L,) and unit directions (L, 3)."""
    length = np.maximum(np.linalg.norm(d, axis=1), 1e-12)
    return length, d / length[:, None]


def _rotation_vector(u: Floats, u0: Floats) -> tuple[Floats, Floats]:
    """(L, 3) rotation vector of the least rotation u -> u0, and its derivative (L, 3, 3) by u."""
    axis = np.cross(u, u0)
    sine, cosine = np.linalg.norm(axis, axis=1), np.sum(u * u0, axis=1)
    phi = np.arctan2(sine, cosine)
    small = sine < 1e-4
    safe = np.where(small, 1.0, sine)
    stretch = np.where(small, 1.0 + phi**2 / 6.0, phi / safe)
    decrease = np.where(small, 1.0 / 3.0 + phi**2 / 5.0, (sine - phi * cosine) / safe**3)
    cross = np.cross(np.eye(3), u0[:, None, :]).transpose(0, 2, 1)  # column i: e_i x u0
    derivative = stretch[:, None, None] * cross - decrease[:, None, None] * (
        axis[:, :, None] * u0[:, None, :]
    )
    return stretch[:, None] * axis, derivative


class CeresSolver:
    """Callable like the compiled solver: energy -> (solution (P, M, 3), how many failed)."""

    def __init__(self, model: SkeletonModel, tolerance: float) -> None:
        import pyceres

        self._ceres: Any = pyceres
        self._residuals = Residuals(model)
        # Ceres takes the address of whatever it is given and ignores strides.
        self._moved = np.zeros(3 * model.n_markers)
        self._problem = pyceres.Problem()
        # The Problem does not keep Python's half of the cost alive.
        self._cost = _cost_function(self._ceres, self._residuals, model)
        if model.n_links:
            self._problem.add_residual_block(self._cost, None, [self._moved])
        self._options = _options(self._ceres, tolerance)

    def __call__(self, energy: Energy) -> tuple[Floats, int]:
        """Minimize each skeleton's energy, as :func:`.energy.minimize` does."""
        solved, failed = energy.start.copy(), 0
        for i, (start, nominal, weights) in enumerate(zip(*energy, strict=True)):
            if not weights.any():
                continue
            self._residuals.load(start, nominal, weights)
            self._moved[:] = 0.0
            summary = self._ceres.SolverSummary()
            self._ceres.solve(self._options, self._problem, summary)
            failed += summary.termination_type != self._ceres.TerminationType.CONVERGENCE
            solved[i] += self._moved.reshape(-1, 3)
        return solved, failed


def _options(ceres: Any, tolerance: float) -> Any:
    options = ceres.SolverOptions()
    options.linear_solver_type = ceres.LinearSolverType.DENSE_NORMAL_CHOLESKY
    options.logging_type = ceres.LoggingType.SILENT
    options.num_threads = 1
    options.max_num_iterations = 500
    # Stiff lengths make a narrow curved valley; strictly descending steps would creep along it.
    options.use_nonmonotonic_steps = True
    options.parameter_tolerance = 1e-3 * tolerance
    options.function_tolerance = options.gradient_tolerance = 1e-8 * tolerance
    return options


def _cost_function(ceres: Any, residuals_of: Residuals, model: SkeletonModel) -> Any:
    class Skeleton(ceres.CostFunction):  # type: ignore[misc] # pyceres has no types
        def __init__(self) -> None:
            super().__init__()
            self.set_num_residuals(_ROWS * model.n_links)
            self.set_parameter_block_sizes([3 * model.n_markers])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802
            values, jacobian = residuals_of(parameters[0].reshape(-1, 3))
            residuals[:] = values
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:] = jacobian.ravel()
            return True

    return Skeleton()
