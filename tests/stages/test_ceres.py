"""The compiled solver and Ceres minimize the same energy to the same pose."""

import numpy as np
import pytest
from skeleton_makers import energies, energy_of, minimized, random_model, random_poses, scene_of

from hiros_mcap.events import Events
from hiros_mcap.frames import by_frame
from hiros_mcap.skeletons import SkeletonModel
from hiros_mcap.stages.optimize import ceres
from hiros_mcap.stages.optimize.ceres import CeresSolver, Residuals
from hiros_mcap.stages.optimize.energy import STIFFNESS, Energy
from hiros_mcap.stages.optimize.optimize import OptimizeParams, optimize_blocks

optimize = by_frame(optimize_blocks)


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("loops", [0, 1, 4])
def test_both_solvers_reach_the_same_minimum(loops, exact):
    rng = np.random.default_rng(loops)
    for _ in range(4):
        model = random_model(rng, loops=loops)
        energy = energy_of(model, *random_poses(model, 8, rng), exact)
        ours, failed = minimized(model, energy, 1e-9)
        theirs, failed_too = CeresSolver(model, 1e-9)(energy)
        assert (failed, failed_too) == (0, 0)
        np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def load_one(seed, exact):
    rng = np.random.default_rng(seed)
    model = random_model(rng, markers=8, loops=1)
    energy = energy_of(model, *random_poses(model, 1, rng, missing=0.0), exact)
    residuals = Residuals(model)
    residuals.load(*[array[0] for array in energy])
    return model, energy, residuals, rng.normal(size=(8, 3)) * 0.05


@pytest.mark.parametrize("exact", [False, True])
def test_jacobian_is_that_of_the_residuals(exact):
    *_, residuals, moved = load_one(0, exact)
    numeric = np.empty((10 * len(residuals.nominal), moved.size))
    for k in range(moved.size):
        step = np.zeros(moved.size)
        step[k] = 1e-6
        step = step.reshape(moved.shape)
        numeric[:, k] = (residuals(moved + step)[0] - residuals(moved - step)[0]) / 2e-6
    atol = 1e-7 * (STIFFNESS if exact else 1.0)
    np.testing.assert_allclose(residuals(moved)[1], numeric, atol=atol)


@pytest.mark.parametrize("exact", [False, True])
def test_squared_residuals_are_the_energy(exact):
    model, energy, residuals, moved = load_one(1, exact)
    expected = energies(model, energy.start + moved, energy)[0]
    assert np.sum(residuals(moved)[0] ** 2) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1e-3, 0.5, 3.0])
def test_orientation_residual_has_the_angle_for_a_norm(angle):
    residuals = Residuals(SkeletonModel.of("ab", [("link", 0, 1)]))
    start = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    residuals.load(start, np.array([1.0]), np.array([[0.0, 0.0, 0.0, 1.0]]))
    moved = np.array([[0.0, 0, 0], [np.cos(angle) - 1.0, np.sin(angle), 0]])
    assert np.linalg.norm(residuals(moved)[0]) == pytest.approx(angle, rel=1e-9)


def test_skeletons_that_ceres_does_not_finish_are_counted(monkeypatch):
    def hasty(*args):
        options = real(*args)
        options.max_num_iterations = 1
        return options

    real = ceres._options
    monkeypatch.setattr(ceres, "_options", hasty)
    rng = np.random.default_rng(3)
    model = random_model(rng)
    start, nominal = random_poses(model, 5, rng)
    start[4] = np.nan  # nothing to solve
    assert CeresSolver(model, 1e-9)(energy_of(model, start, nominal, exact=True))[1] == 4
    frame, limbs = scene_of(model, start, nominal)
    events, params = Events(), OptimizeParams(solver="ceres")
    next(optimize([frame], model, params, events, limbs))
    assert events.total("optimizer not converged") == 4


def test_model_without_links_needs_no_solution():
    model, start = SkeletonModel.of("ab", []), np.ones((1, 2, 3))
    solved, failed = CeresSolver(model, 1e-6)(Energy(start, np.empty((1, 0)), np.empty((1, 0, 4))))
    np.testing.assert_array_equal(solved, start)
    assert failed == 0
