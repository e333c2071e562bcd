"""Poses of RGB cameras from rays: equations, recovery, errors."""

from itertools import pairwise

import numpy as np
import pytest
from filmed import around, film, turned, walking

from hiros_mcap.body.rotations import Rigid, from_vector, rotate
from hiros_mcap.kernels.ray_equations import UNKNOWNS, RayPoints, RayWork, ray_loss
from hiros_mcap.rays.bundle import (
    _moved,
    adjust,
    cameras_at,
    centres_of,
    equations,
    placed,
    poses_of,
    standard_errors,
)
from hiros_mcap.rays.image_tracks import instants_of, sample_images, views_of
from hiros_mcap.rays.matching import joints_of, match

NONE = np.zeros(4)
HELD = np.zeros(4, np.bool_)
FOCALS = np.full(4, 900.0)
RIG = around()


def rays_at(places, cameras):
    """What cameras without errors see of places (P, 3)."""
    before = np.einsum("cij,pj->pci", cameras.rotations, places) + cameras.shifts
    rays = np.ascontiguousarray(before[..., :2] / before[..., 2:])
    ones = np.ones(rays.shape[:2])
    return RayPoints(rays, 0.1 * rays, ones)


def crowd(n, seed=0):
    return np.random.default_rng(seed).uniform([-1, -1, 0], [1, 1, 2], (n, 3))


def free_poses():
    free = np.ones((4, UNKNOWNS), np.bool_)
    free[:, 6] = False
    return free


def apart(found, true):
    """Degrees and mm between poses, (C, 2)."""
    pairs = zip(found, true, strict=True)
    return np.array([[deg, 1000 * m] for m, deg in (a.apart(b) for a, b in pairs)])


def test_gradient_is_that_of_the_loss_with_the_joints_where_they_fit_best():
    cameras = cameras_at(list(turned(RIG, 0.3).values()), lags=[0.0, 0.01, -0.02, 0.01])
    cameras = cameras._replace(scales=FOCALS / 4.0)
    points = rays_at(crowd(5), cameras_at(list(RIG.values())))
    places, work = crowd(5), RayWork.allocate(4)
    only_joints = np.zeros((4, UNKNOWNS), np.bool_)
    squares = np.zeros((5, 4))

    def fitted(steps):
        bundle = adjust(points, _moved(cameras, steps), np.full(4, 2250.0), only_joints, rounds=1)
        return ray_loss(points, _moved(cameras, steps), bundle.places, squares), bundle.places

    _, places = fitted(np.zeros((4, UNKNOWNS)))
    slope = equations(points, cameras, places, 0.0, work)[1]
    for k in range(4 * UNKNOWNS):
        step = np.zeros(4 * UNKNOWNS)
        step[k] = 1e-5
        ahead, back = (fitted(sign * step.reshape(4, UNKNOWNS))[0] for sign in (1, -1))
        assert slope[k] == pytest.approx((ahead - back) / 2e-5, rel=2e-2, abs=2.0)


def test_rays_without_noise_give_the_poses():
    true = list(RIG.values())
    points = rays_at(crowd(60), cameras_at(true))
    start = cameras_at(list(turned(RIG, 3.0).values()))
    found = placed(adjust(points, start, FOCALS, free_poses()), cameras_at(true), HELD)
    assert (apart(poses_of(found.cameras), true) < [1e-3, 1e-2]).all()
    assert found.places == pytest.approx(crowd(60), abs=1e-4)


def test_a_rig_stays_where_most_of_its_given_poses_are():
    given = dict(RIG, cam4=turned(RIG, 5.0)["cam4"])
    points = rays_at(crowd(60), cameras_at(list(RIG.values())))
    start = cameras_at(list(given.values()))
    found = placed(adjust(points, start, FOCALS, free_poses()), start, HELD)
    off = apart(poses_of(found.cameras), RIG.values())
    assert off[:, 0].max() < 0.5


def test_a_camera_that_is_held_stays():
    held, free = np.array([False, True, False, False]), free_poses()
    free[1] = False
    points = rays_at(crowd(60), cameras_at(list(RIG.values())))
    start = turned(RIG, 2.0)
    cameras = cameras_at(list(start.values()))
    found = placed(adjust(points, cameras, FOCALS, free), cameras, held)
    poses = poses_of(found.cameras)
    assert apart(poses[1:2], [start["cam2"]]).max() < 1e-6
    between = [a.inverse() @ b for a, b in pairwise(poses)]
    true = [a.inverse() @ b for a, b in pairwise(RIG.values())]
    assert apart(between, true)[:, 0].max() < 1e-3


def bundle_of(scene, given):
    views = views_of(scene.frames, scene.lenses)
    cameras = cameras_at(list(given.values()))
    instants = instants_of(views, 100, NONE)
    samples = sample_images(views, instants, NONE)
    points, rows = joints_of(samples, match(samples, cameras, 0.08), 4)
    found = placed(adjust(points, cameras, FOCALS, free_poses()), cameras, HELD)
    blocks = (instants[rows[:, 0]] - instants[0]) // 2.0
    return found, standard_errors(found, blocks, rows[:, 2])


@pytest.fixture(scope="module")
def truth():
    return walking(people=2, seconds=12.0)


def test_people_before_a_real_detector_give_the_poses_and_their_errors(truth):
    scaled = []
    for seed in range(3):
        found, errors = bundle_of(film(truth, RIG, seed=seed), turned(RIG, 1.5, seed))
        true = cameras_at(list(RIG.values()))
        off = apart(poses_of(placed(found, true, HELD).cameras), RIG.values())
        assert off[:, 0].max() < 0.6
        expected = np.degrees(np.linalg.norm(errors[:, :3], axis=1))
        scaled += list(off[:, 0] / expected)
        assert 3.0 < np.nanmedian(found.distances) < 9.0
    assert 0.3 < np.sqrt(np.mean(np.square(scaled))) < 1.7


@pytest.mark.parametrize("degrees", [1.0, -3.0])
def test_a_rig_whose_place_and_direction_differ_goes_some_of_the_way(degrees):
    true = cameras_at(list(RIG.values()))
    middle, turn = centres_of(true).mean(axis=0), from_vector([0.0, 0.0, np.radians(degrees)])
    elsewhere = [
        Rigid(pose.xyzw, middle + rotate(turn, pose.translation - middle)) for pose in RIG.values()
    ]
    points = rays_at(crowd(20), true)
    start = adjust(points, true, FOCALS, np.zeros((4, UNKNOWNS), np.bool_))
    found = poses_of(placed(start, cameras_at(elsewhere), HELD).cameras)
    ways = apart(found, RIG.values())[:, 0] / abs(degrees)
    assert ways == pytest.approx(np.full(4, ways[0]), abs=1e-6)  # it stays a rig
    assert 0.6 < ways[0] < 0.7  # to where the sum of squares is least
