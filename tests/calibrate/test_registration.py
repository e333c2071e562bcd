"""Calibration by a ball and a board (Lee et al. 2022, section 2.1)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hiros_mcap.body.rotations import rotate, to_matrix
from hiros_mcap.calibrate.registration import (
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


@pytest.mark.parametrize(
    ("points", "fault"),
    [
        (ball(3), "at least 4 points"),
        (np.full((9, 3), np.nan), "at least 4 points"),
        (ball(1000), "no sphere of radius 0.24 m"),  # clutter
        (ball(1000) * [1, 1, 0], "no sphere"),  # a floor
        (np.outer(np.arange(9.0), [1.0, 2.0, 3.0]), "no sphere"),
    ],
)
def test_no_sphere(points, fault):
    with pytest.raises(RegistrationError, match=fault):
        fit_sphere(points, RADIUS)
    assert issubclass(RegistrationError, HirosError)


def stamps_of(*milliseconds):
    return 1_700_000_000_000_000_000 + np.array([round(ms * 1e6) for ms in milliseconds], np.int64)


def common(*sensors):
    """The numbers of the frames in which two sensors saw the ball, of frames at some ms."""
    stamps = tuple(stamps_of(*times) for times in sensors)
    centres = tuple(np.arange(len(times))[:, None] * np.ones(3) for times in sensors)
    return [places[:, 0].tolist() for places in common_frames(stamps, centres)]


def test_only_frames_seen_by_both_sensors():
    """Some ms apart; one misses a message, the other one starts late."""
    assert common([0, 33, 67, 100, 133], [69, 102, 169]) == [[2, 3], [0, 1]]
    assert common([0, 33], []) == common([], [0, 33]) == [[], []]


def test_frames_without_the_ball_do_not_count():
    stamps, centres = stamps_of(0, 33), np.ones((2, 3))
    centres[0] = np.nan
    one, other = common_frames((stamps, stamps), (centres, np.ones((2, 3))))
    assert len(one) == len(other) == 1


def test_the_order_of_frames_and_sensors_does_not_matter():
    assert common([67, 0, 33], [1, 68]) == [[1, 0], [0, 1]]
    assert common([1, 68], [67, 0, 33]) == [[0, 1], [1, 0]]


def test_each_frame_is_used_once():
    """A sensor of twice the rate, and one that repeats a time stamp."""
    fast, slow = [0, 16, 33, 50, 67], [1, 34, 34, 68]
    assert common(fast, slow) == [[0, 2, 4], [0, 1, 3]]
    assert common(slow, fast) == [[0, 1, 3], [0, 2, 4]]


def test_the_span_of_an_instant_is_bounded():
    assert common([0], [20]) == [[], []]
    stamps = stamps_of(0), stamps_of(20)
    assert len(common_frames(stamps, (np.ones((1, 3)),) * 2, max_delta_time=0.02)[0]) == 1


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
