"""Laws of the point where rays meet: they hold wherever the cameras stand and however many."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hiros_mcap.rays.triangulation import Rays, Triangulated, triangulate

JOINTS = 6
PLACES = np.random.default_rng(3).uniform([-1, -1, 0], [1, 1, 2], (JOINTS, 3))
CENTRES = np.array([[4.0, 0.2, 1.5], [0.3, 4.0, 1.9], [-4.0, -0.5, 1.6], [0.1, -4.0, 2.2]])
NOISES = np.array([[0.01], [0.02], [0.015], [0.01]]) * np.linspace(1.0, 1.5, JOINTS)


def rays_at(places, centres=CENTRES, noises=NOISES):
    """Exact rays of all cameras."""
    ways = places[None] - centres[:, None]
    return Rays(centres, ways / np.linalg.norm(ways, axis=2)[:, :, None], noises)


def met(rays, expected=None):
    """Points, deviations, distances and whether each ray agrees."""
    out = Triangulated.allocate(*rays.noises.shape)
    wanted = np.full((rays.noises.shape[1], 3), np.nan) if expected is None else expected
    triangulate(Rays(*map(np.ascontiguousarray, rays)), np.ascontiguousarray(wanted), out)
    return out


@pytest.fixture
def real():
    """Rays with noise; one camera is wrong about a joint and does not see another."""
    noise = np.random.default_rng(5).normal(0.0, 1.0, (4, JOINTS, 3))
    directions = rays_at(PLACES).directions + noise * (NOISES / 4.0)[:, :, None]
    directions[1, 2] += [0.3, 0.0, 0.2]
    directions /= np.linalg.norm(directions, axis=2)[:, :, None]
    directions[3, 4] = np.nan
    return Rays(CENTRES, directions, NOISES)


def assert_same(one, other, cameras=slice(None), size=1.0):
    np.testing.assert_allclose(other.points, size * one.points, atol=1e-9)
    np.testing.assert_allclose(other.deviations, size * one.deviations, rtol=1e-9)
    np.testing.assert_allclose(other.distances, size * one.distances[cameras], atol=1e-9)
    np.testing.assert_array_equal(other.agrees, one.agrees[cameras])


def test_the_wrong_ray_is_left_out_and_the_errors_are_as_stated(real):
    out = met(real)
    assert np.argwhere(~out.agrees).tolist() == [[1, 2], [3, 4]]
    off = np.linalg.norm(out.points - PLACES, axis=1) / (np.sqrt(3) * out.deviations)
    assert 0.3 < np.sqrt(np.mean(off**2)) < 1.7


def test_neither_the_order_of_cameras_nor_one_that_sees_nothing_counts(real):
    order = [2, 0, 3, 1]
    assert_same(met(real), met(Rays(*(a[order] for a in real))), order)
    blind = Rays(*(np.concatenate([a[:1] * np.nan, a]) for a in real))
    blind.centres[0], blind.noises[0] = 1.0, 0.01
    out = met(blind)
    assert not out.agrees[0].any()
    assert_same(met(real), out._replace(agrees=out.agrees[1:], distances=out.distances[1:]))


def test_a_turned_or_a_larger_room_has_turned_or_larger_points(real):
    turn, shift = Rotation.from_euler("xyz", [0.3, -0.5, 1.2]), np.array([3.0, -1.0, 0.5])
    directions = turn.apply(real.directions.reshape(-1, 3)).reshape(real.directions.shape)
    there = met(Rays(turn.apply(CENTRES) + shift, directions, NOISES))
    assert_same(met(real), there._replace(points=turn.inv().apply(there.points - shift)))
    assert_same(met(real), met(Rays(3.0 * CENTRES, real.directions, 3.0 * NOISES)), size=3.0)


@pytest.mark.parametrize("angle", [0.3, 0.03, 3e-3, 3e-4, 1e-4])
def test_the_deviation_grows_as_the_angle_of_two_rays_shrinks(angle):
    place, noise = np.array([[0.5, 3.0, 1.0]]), 1e-6
    centres = [0.5, 0.0, 1.0] + 3.0 * np.tan(angle / 2) * np.array([[-1, 0, 0], [1, 0, 0]])
    out = met(rays_at(place, centres, np.full((2, 1), noise)))
    variances = 1 / np.array([2.0, 2 * np.cos(angle / 2) ** 2, 2 * np.sin(angle / 2) ** 2])
    assert out.points == pytest.approx(place, abs=1e-6)
    assert out.deviations[0] == pytest.approx(noise * np.sqrt(variances.mean()), rel=1e-3)


def test_parallel_rays_and_rays_backwards_meet_nowhere():
    centres = CENTRES[:2]
    parallel = np.broadcast_to([0.0, 0.0, 1.0], (2, 1, 3))
    backwards = -rays_at(PLACES[:1], centres, NOISES[:2, :1]).directions
    for directions in (parallel, backwards):
        out = met(Rays(centres, directions, NOISES[:2, :1]))
        assert np.isnan(out.points).all()
        assert not out.agrees.any()


@pytest.mark.parametrize("expected", [0, 1])
def test_of_two_pairs_that_agree_the_one_near_the_expected_place_counts(expected):
    rays = rays_at(PLACES[:1], noises=NOISES[:, :1])
    rays.directions[2:] = rays_at(PLACES[1:2]).directions[2:, :1]
    assert met(rays, PLACES[[expected]]).points == pytest.approx(PLACES[[expected]], abs=1e-6)
