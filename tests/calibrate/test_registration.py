"""Calibration by a ball and a board (Lee et al. 2022, section 2.1)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hiros_mcap.body.rotations import rotate, to_matrix
from hiros_mcap.calibrate.registration import (
    _spheres_through,
    board_frame,
    common_frames,
    fit_sphere,
    rigid_fit,
)
from hiros_mcap.errors import HirosError, RegistrationError

TURN = Rotation.from_euler("xyz", [0.4, -0.9, 2.1])
SHIFT = np.array([1.5, -2.0, 0.7])
RADIUS = 0.24  # m, the paper's ball


def ball(n, seed=1):
    """Where somebody carried a ball."""
    return np.random.default_rng(seed).uniform([-1.5, -1.5, 0.2], [1.5, 1.5, 2.0], (n, 3))


def seen_ball(centre, rng, n=2000, outliers=0.3, noise=0.004):
    """Points (n, 3) of the side of the ball that faces a sensor at the origin, and outliers."""
    directions = rng.normal(size=(40 * n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    places = centre + RADIUS * directions
    places = places[np.sum(directions * places, axis=1) < 0.0]
    strays = round(outliers * n)
    around = centre + rng.uniform(-0.5, 0.5, (strays, 3))
    surface = places[: n - strays] + rng.normal(0, noise, (n - strays, 3))
    return rng.permutation(np.concatenate([surface, around]))


@pytest.mark.parametrize("seed", range(20))
def test_partial_sphere_with_outliers(seed):
    """One side only, 30 % outliers, 4 mm of noise: the centre within 3 mm."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform([-1.0, -1.0, 1.5], [1.0, 1.0, 4.0])
    points = seen_ball(centre, rng, n=int(rng.integers(300, 6000)))
    fit = fit_sphere(points, RADIUS)
    assert np.linalg.norm(fit.centre - centre) < 0.003
    assert fit.inliers.mean() == pytest.approx(0.7, abs=0.05)
    assert 0.003 < fit.rms < 0.005


def test_outliers_of_one_kind():
    """A wall behind the ball, the arm that holds it, and half of the ball hidden by somebody."""
    rng = np.random.default_rng(7)
    centre = np.array([0.3, -0.2, 2.5])
    points = seen_ball(centre, rng, outliers=0.0)
    points = points[points[:, 0] > centre[0] - 0.05]
    wall = centre + rng.uniform([-0.4, -0.4, 0.3], [0.4, 0.4, 0.305], (len(points) // 4, 3))
    arm = centre + rng.uniform([-0.04, 0.24, -0.04], [0.04, 0.7, 0.04], (len(points) // 6, 3))
    fit = fit_sphere(np.concatenate([points, wall, arm]), RADIUS)
    assert np.linalg.norm(fit.centre - centre) < 0.003


def test_without_noise_it_is_exact():
    """Far from the origin as well, and absent points are no inliers."""
    rng = np.random.default_rng(3)
    centre = np.array([20.0, -30.0, 40.0])
    points = seen_ball(centre, rng, n=400, outliers=0.0, noise=0.0)
    points[::10] = np.nan
    points[1::10] += [1.0, 0.0, 0.0]
    fit = fit_sphere(points, RADIUS)
    assert fit.centre == pytest.approx(centre, abs=1e-9)
    assert (fit.inliers == (np.arange(400) % 10 > 1)).all()
    assert fit.rms < 1e-9


def test_no_centre_fits_the_inliers_better():
    rng = np.random.default_rng(4)
    points = seen_ball(np.array([0.1, 0.4, 2.0]), rng)
    fit = fit_sphere(points, RADIUS)

    def cost(centre):
        rest = np.linalg.norm(points[fit.inliers] - centre, axis=1) - RADIUS
        return float(np.sqrt(np.mean(rest**2)))

    assert cost(fit.centre) == pytest.approx(fit.rms)
    for _ in range(50):
        assert cost(fit.centre + rng.normal(0, 0.0005, 3)) > fit.rms


def test_the_same_seed_gives_the_same_centre():
    points = seen_ball(np.array([0.0, 0.0, 2.0]), np.random.default_rng(5))
    first, again, other = (fit_sphere(points, RADIUS, seed=seed) for seed in (1, 1, 2))
    assert (first.centre == again.centre).all()
    assert other.centre == pytest.approx(first.centre, abs=1e-4)


def test_two_spheres_pass_through_three_points():
    points = np.array([[0.1, -0.2, 0.5], [0.3, 0.1, 0.6], [-0.1, 0.2, 0.4]])
    centres = _spheres_through(points[None], 0.5)
    distances = np.linalg.norm(centres[:, None] - points, axis=2)
    np.testing.assert_allclose(distances, np.full((2, 3), 0.5), atol=1e-12)
    assert np.linalg.norm(centres[0] - centres[1]) > 0.1


@pytest.mark.parametrize(
    ("points", "options", "fault"),
    [
        (ball(3), {}, "at least 4 points"),
        (np.full((9, 3), np.nan), {}, "at least 4 points"),
        (ball(9)[:, :2], {}, "shape"),
        (ball(9), {"tolerance": 0.0}, "tolerance"),
        (ball(9), {"tolerance": 0.3}, "tolerance"),
        (ball(1000), {}, "no sphere of radius 0.24 m"),  # clutter
        (ball(1000) * [1, 1, 0], {}, "no sphere"),  # a floor
        (np.ones((9, 3)), {}, "no sphere"),
        (np.outer(np.arange(9.0), [1.0, 2.0, 3.0]), {}, "no sphere"),
    ],
)
def test_no_sphere(points, options, fault):
    with pytest.raises(RegistrationError, match=fault):
        fit_sphere(points, RADIUS, **options)
    assert issubclass(RegistrationError, HirosError)


def stamps_of(*milliseconds):
    return 1_700_000_000_000_000_000 + np.array([round(ms * 1e6) for ms in milliseconds], np.int64)


def marked(stamps, sensor):
    """Centres that tell the sensor and the frame that they come from."""
    return np.stack([np.full(len(stamps), float(sensor)), np.arange(len(stamps)), stamps * 0], 1)


def test_only_frames_seen_by_all_sensors():
    """Three sensors a few ms apart; one misses the ball, one a message, one starts late."""
    stamps = [
        stamps_of(0, 33, 67, 100, 133, 167),
        stamps_of(2, 35, 102, 135, 169),  # no message near 67
        stamps_of(64, 97, 130, 164, 197),  # none before
    ]
    centres = [marked(times, sensor) for sensor, times in enumerate(stamps)]
    centres[1][3] = np.nan  # not seen at 135
    times, common = common_frames(stamps, centres)
    assert common[:, :, 0].tolist() == [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]
    assert common[:, :, 1].tolist() == [[3.0, 5.0], [2.0, 4.0], [1.0, 3.0]]
    assert (times - stamps_of(0)).tolist() == [99_666_667, 166_666_667]


def test_the_order_of_frames_and_sensors_does_not_matter():
    rng = np.random.default_rng(8)
    stamps = [stamps_of(*np.sort(33.3 * rng.permutation(50)[:40] + 2.0 * s)) for s in range(3)]
    centres = [marked(times, sensor) for sensor, times in enumerate(stamps)]
    times, common = common_frames(stamps, centres)
    assert 10 < len(times) < 40
    assert (np.diff(times) > 0).all()
    shuffled = [rng.permutation(len(times)) for times in stamps]
    _, again = common_frames(
        [times[order] for times, order in zip(stamps, shuffled, strict=True)],
        [places[order] for places, order in zip(centres, shuffled, strict=True)],
    )
    assert (again == common).all()
    other, turned = common_frames(stamps[::-1], centres[::-1])
    assert (turned[::-1] == common).all()
    assert (other == times).all()


def test_each_frame_is_used_once():
    """A sensor of twice the rate, and one that repeats a time stamp."""
    stamps = [stamps_of(0, 16, 33, 50, 67), stamps_of(1, 34, 34, 68)]
    for order in (slice(None), slice(None, None, -1)):
        centres = [marked(times, sensor) for sensor, times in enumerate(stamps)]
        _, common = common_frames(stamps[order], centres[order])
        fast, slow = common[order]
        assert fast[:, 1].tolist() == [0.0, 2.0, 4.0]
        assert slow[:, 1].tolist() == [0.0, 1.0, 3.0]


def test_the_span_of_an_instant_is_bounded():
    """Each of two sensors is near enough to the first, but not to each other."""
    stamps = [stamps_of(10), stamps_of(0), stamps_of(20)]
    centres = [marked(times, sensor) for sensor, times in enumerate(stamps)]
    assert common_frames(stamps, centres)[1].shape == (3, 0, 3)
    assert common_frames(stamps, centres, max_delta_time=0.02)[1].shape == (3, 1, 3)


def test_nothing_in_common():
    stamps = [stamps_of(0, 33), stamps_of(), stamps_of(0, 33)]
    times, common = common_frames(stamps, [marked(times, 0) for times in stamps])
    assert times.shape == (0,)
    assert common.shape == (3, 0, 3)
    with pytest.raises(RegistrationError, match="at least 3"):
        rigid_fit(common[1], common[0])


@pytest.mark.parametrize(
    ("stamps", "centres", "fault"),
    [
        ([stamps_of(0)], [np.zeros((1, 3))], "at least 2 sensors"),
        ([stamps_of(0)] * 2, [np.zeros((1, 3))], "at least 2 sensors"),
        ([stamps_of(0)] * 2, [np.zeros((1, 3)), np.zeros((2, 3))], "stamps"),
    ],
)
def test_stamps_and_centres_must_fit(stamps, centres, fault):
    with pytest.raises(RegistrationError, match=fault):
        common_frames(stamps, centres)


def test_thousand_noisy_points():
    """1000 points with 5 mm of noise: rotation within 0.1 degrees, translation within 2 mm."""
    points = ball(1000)
    noise = np.random.default_rng(2).normal(0, 0.005, points.shape)
    pose = rigid_fit(points, TURN.apply(points) + SHIFT + noise)
    error = (Rotation.from_quat(pose.xyzw) * TURN.inv()).magnitude()
    assert np.degrees(error) < 0.1
    assert np.linalg.norm(pose.translation - SHIFT) < 0.002


@pytest.mark.parametrize(
    ("points", "fault"),
    [
        (ball(2), "at least 3"),
        (np.outer([0.0, 1.0, 2.0, 5.0], [1.0, 2.0, 3.0]), "on a line"),
        (np.ones((5, 3)), "on a line"),
        (np.where(np.arange(4)[:, None] < 2, np.nan, ball(4)), "at least 3"),
        (ball(4)[:, :2], "shape"),
    ],
)
def test_too_few_or_collinear_points(points, fault):
    with pytest.raises(RegistrationError, match=fault):
        rigid_fit(points, points)


def test_pairs_that_one_sensor_missed_are_left_out():
    points = ball(10)
    goal = TURN.apply(points) + SHIFT
    goal[4] = np.nan
    assert rigid_fit(points, goal).translation == pytest.approx(SHIFT)


@given(st.integers(0, 10_000))
def test_never_a_reflection(seed):
    """Flat points with noise, and mirrored ones, tempt the decomposition to a reflection."""
    rng = np.random.default_rng(seed)
    flat = rng.normal(0, [1.0, 1.0, 1e-6], (5, 3))
    for goal in (flat + rng.normal(0, 0.01, flat.shape), ball(5, seed) * [1, 1, -1]):
        matrix = to_matrix(rigid_fit(flat, goal).xyzw)
        assert np.linalg.det(matrix) == pytest.approx(1.0)
        assert matrix @ matrix.T == pytest.approx(np.eye(3))


def test_no_rigid_transform_fits_better():
    rng = np.random.default_rng(5)
    points = ball(30)
    goal = TURN.apply(points) + SHIFT + rng.normal(0, 0.1, points.shape)
    pose = rigid_fit(points, goal)

    def cost(turn, shift):
        return float(np.sum((goal - turn.apply(points) - shift) ** 2))

    best = cost(Rotation.from_quat(pose.xyzw), pose.translation)
    for _ in range(50):
        turn = Rotation.from_rotvec(rng.normal(0, 0.01, 3)) * Rotation.from_quat(pose.xyzw)
        assert cost(turn, pose.translation + rng.normal(0, 0.01, 3)) > best


def test_board_pose():
    """Markers 0, 1, 2 of a board that lies on the floor, seen from a camera; y a little askew."""
    board = np.array([[0.02, 0.3, 0.0], [0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.4, 0.3, 0.0]])
    pose = board_frame(TURN.apply(board) + SHIFT)
    assert to_matrix(pose.xyzw) == pytest.approx(TURN.as_matrix())
    assert pose.translation == pytest.approx(SHIFT)
    back = pose.inverse()
    up = rotate(back.xyzw, TURN.apply([0.0, 0.0, 1.0]) + SHIFT) + back.translation
    assert up == pytest.approx([0.0, 0.0, 1.0])


def test_three_markers_define_the_board_though_the_fourth_is_hidden():
    board = np.array([[0.02, 0.3, 0.0], [0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [np.nan, np.nan, np.nan]])
    assert np.array_equal(board_frame(board).xyzw, board_frame(board[:3]).xyzw)


@pytest.mark.parametrize(
    "centres", [np.eye(3)[:2], np.full((4, 3), np.nan), np.outer([1, 2, 3], [1, 1, 0])]
)
def test_not_a_board(centres):
    with pytest.raises(RegistrationError, match="markers"):
        board_frame(centres)
