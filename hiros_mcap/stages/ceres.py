"""The optimizer's energy minimized by Ceres Solver, as the paper does (section 3.3.3).

One cost function per skeleton with an analytic Jacobian, and one Problem for the whole run: the
numbers of each skeleton are written into its arrays. A cost function per link costs ten times
more, all of it in crossing from C++ to Python.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.skeletons import Floats, SkeletonModel

_ROWS = 10  # residuals of a link: 1 length, 3 + 3 positions of its ends, 3 orientation


def import_pyceres() -> ModuleType:
    """Return the module.

    Raises
    ------
    ConfigError
        With the command that installs it.
    """
    try:
        import pyceres
    except ImportError as error:
        raise ConfigError("solver ceres needs pyceres: pip install 'hiros-mcap[ceres]'") from error
    module: ModuleType = pyceres
    return module


class Residuals:
    """Residuals of one skeleton, half whose squared norm is half the energy, and their Jacobian.

    The unknowns are the displacements (M, 3) of the markers from the start, m. The angle between
    two directions enters as the rotation vector from one to the other, whose norm it is: three
    smooth residuals instead of one that has a kink where it vanishes.
    """

    def __init__(self, model: SkeletonModel) -> None:
        self.parents, self.children = model.links[:, 0], model.links[:, 1]
        self._columns = 3 * model.n_markers
        self.start = np.zeros((model.n_markers, 3))
        self.nominal = np.zeros(model.n_links)
        self.roots = np.zeros((model.n_links, 4))

    def load(self, start: Floats, nominal: Floats, weights: Floats) -> None:
        """Set the skeleton: start (M, 3), nominal (L,), weights (L, 4); absent is NaN or 0."""
        used = weights.any(axis=1)
        self.start[:] = np.nan_to_num(start)
        self.nominal[:] = np.where(used, nominal, 0.0)
        self.roots[:] = np.sqrt(weights)

    def __call__(self, moved: Floats) -> tuple[Floats, Floats]:
        """Residuals (10 L,) and Jacobian (10 L, 3 M) at displacements ``moved`` (M, 3)."""
        p, c, root = self.parents, self.children, self.roots
        d0, change = self.start[c] - self.start[p], moved[c] - moved[p]
        length, u = _direction(d0 + change)
        across = (np.eye(3) - u[:, :, None] * u[:, None, :]) / length[:, None, None]
        turn, turn_by_u = _rotation_vector(u, _direction(d0)[1])
        residuals = np.empty((len(p), _ROWS))
        residuals[:, 0] = root[:, 0] * (length - self.nominal)
        residuals[:, 1:4] = root[:, 1, None] * moved[p]
        residuals[:, 4:7] = root[:, 2, None] * moved[c]
        residuals[:, 7:] = root[:, 3, None] * turn
        by_d = np.zeros((len(p), _ROWS, 3))
        by_d[:, 0] = root[:, 0, None] * u
        by_d[:, 7:] = root[:, 3, None, None] * (turn_by_u @ across)
        by_p, by_c = -by_d, by_d
        by_p[:, 1:4] += root[:, 1, None, None] * np.eye(3)
        by_c[:, 4:7] += root[:, 2, None, None] * np.eye(3)
        return residuals.ravel(), self._scatter(by_p, by_c)

    def _scatter(self, by_p: Floats, by_c: Floats) -> Floats:
        jacobian = np.zeros((len(by_p), _ROWS, self._columns // 3, 3))
        rows = np.arange(len(by_p))
        jacobian[rows, :, self.parents] += by_p
        jacobian[rows, :, self.children] += by_c
        return jacobian.reshape(-1, self._columns)


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
    bend = np.where(small, 1.0 / 3.0 + phi**2 / 5.0, (sine - phi * cosine) / safe**3)
    cross = np.cross(np.eye(3), u0[:, None, :]).transpose(0, 2, 1)  # column i: e_i x u0
    derivative = stretch[:, None, None] * cross - bend[:, None, None] * (
        axis[:, :, None] * u0[:, None, :]
    )
    return stretch[:, None] * axis, derivative


class CeresSolver:
    """Callable like the compiled solver: (start, nominal, weights) -> (solution, failures).

    Raises
    ------
    ConfigError
        If pyceres is not installed.
    """

    def __init__(self, model: SkeletonModel, tolerance: float) -> None:
        self._ceres = import_pyceres()
        self._residuals = Residuals(model)
        self._moved = np.zeros((model.n_markers, 3))
        # Ceres takes the address of whatever it is given: it would write over the neighbours of
        # a strided array.
        if not self._moved.flags.c_contiguous:
            raise ValueError("the parameter array must be C-contiguous")
        self._problem = self._ceres.Problem()
        # The Problem does not keep Python's half of the cost alive.
        self._cost = _cost_function(self._ceres, self._residuals, model)
        if model.n_links:
            self._problem.add_residual_block(self._cost, None, [self._moved.reshape(-1)])
        self._options = _options(self._ceres, tolerance)

    def __call__(self, start: Floats, nominal: Floats, weights: Floats) -> tuple[Floats, int]:
        """Minimize the energy of each person; see :func:`hiros_mcap.kernels.optimizing.solve`."""
        solved, failed = start.copy(), 0
        for i in range(len(start)):
            if not weights[i].any():
                continue
            self._residuals.load(start[i], nominal[i], weights[i])
            self._moved[:] = 0.0
            summary = self._ceres.SolverSummary()
            self._ceres.solve(self._options, self._problem, summary)
            failed += summary.termination_type != self._ceres.TerminationType.CONVERGENCE
            solved[i] += self._moved
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
    class Skeleton(ceres.CostFunction):  # type: ignore[misc] # a class of the optional pyceres
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
