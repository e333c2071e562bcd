"""Registration of corresponding points, and the frame of a board (Lee et al. 2022, section 2.1)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hiros_mcap.registration import board_frame, rigid_fit
from hiros_mcap.rotations import from_matrix, rotate, to_matrix
from hiros_mcap.skeletons import Floats

TURN = Rotation.from_euler("xyz", [0.4, -0.9, 2.1])
SHIFT = np.array([1.5, -2.0, 0.7])


def ball(n: int, seed: int = 1) -> Floats:
    """Where a ball was carried through a room."""
    return np.random.default_rng(seed).uniform([-1.5, -1.5, 0.2], [1.5, 1.5, 2.0], (n, 3))


def test_l03_thousand_noisy_points() -> None:
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
def test_l03_too_few_or_collinear_points(points: Floats, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        rigid_fit(points, points)


def test_l03_pairs_that_one_sensor_missed_are_left_out() -> None:
    points = ball(10)
    goal = TURN.apply(points) + SHIFT
    goal[4] = np.nan
    assert rigid_fit(points, goal).translation == pytest.approx(SHIFT)


@given(st.integers(0, 10_000))
def test_l04_never_a_reflection(seed: int) -> None:
    """Flat points with noise, and mirrored ones, tempt the decomposition to mirror the room."""
    rng = np.random.default_rng(seed)
    flat = rng.normal(0, [1.0, 1.0, 1e-6], (5, 3))
    for goal in (flat + rng.normal(0, 0.01, flat.shape), ball(5, seed) * [1, 1, -1]):
        matrix = to_matrix(rigid_fit(flat, goal).xyzw)
        assert np.linalg.det(matrix) == pytest.approx(1.0)
        assert matrix @ matrix.T == pytest.approx(np.eye(3))


def test_x03_not_the_printed_formula() -> None:
    """The printed R is the inverse rotation, and the printed T lacks R."""
    points = ball(20)
    pose = rigid_fit(points, TURN.apply(points) + SHIFT)
    assert to_matrix(pose.xyzw) == pytest.approx(TURN.as_matrix())
    assert rotate(pose.xyzw, points) + pose.translation == pytest.approx(TURN.apply(points) + SHIFT)


def test_no_rigid_transform_fits_better() -> None:
    rng = np.random.default_rng(5)
    points = ball(30)
    goal = TURN.apply(points) + SHIFT + rng.normal(0, 0.1, points.shape)
    pose = rigid_fit(points, goal)

    def cost(turn: Rotation, shift: Floats) -> float:
        return float(np.sum((goal - turn.apply(points) - shift) ** 2))

    best = cost(Rotation.from_quat(pose.xyzw), pose.translation)
    for _ in range(50):
        turn = Rotation.from_rotvec(rng.normal(0, 0.01, 3)) * Rotation.from_quat(pose.xyzw)
        assert cost(turn, pose.translation + rng.normal(0, 0.01, 3)) > best


def test_l05_board_pose() -> None:
    """Markers 0, 1, 2 of a board that lies on the floor, seen from a camera; y a little askew."""
    board = np.array([[0.02, 0.3, 0.0], [0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.4, 0.3, 0.0]])
    pose = board_frame(TURN.apply(board) + SHIFT)
    assert to_matrix(pose.xyzw) == pytest.approx(TURN.as_matrix())
    assert pose.translation == pytest.approx(SHIFT)
    back = pose.inverse()
    up = rotate(back.xyzw, TURN.apply([0.0, 0.0, 1.0]) + SHIFT) + back.translation
    assert up == pytest.approx([0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    "centres", [np.eye(3)[:2], np.full((4, 3), np.nan), np.outer([1, 2, 3], [1, 1, 0])]
)
def test_l05_not_a_board(centres: Floats) -> None:
    with pytest.raises(ValueError, match="markers"):
        board_frame(centres)


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.01))
def test_quaternion_of_a_matrix(q: tuple[float, ...]) -> None:
    matrix = Rotation.from_quat(q).as_matrix()
    xyzw = from_matrix(matrix)
    assert to_matrix(xyzw) == pytest.approx(matrix, abs=1e-12)
    assert np.linalg.norm(xyzw) == pytest.approx(1.0)
    assert xyzw[3] >= 0.0
