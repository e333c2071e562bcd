"""How wrong the cameras' poses are, as the cameras themselves show."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.kernels.fusing import Sightings
from hiros_mcap.skeletons import Floats
from hiros_mcap.stages.pose_error import PoseError

NAMES = ("a", "b", "c")
PLACES = {name: np.array([np.cos(k), np.sin(k), 0.0]) * 3 for k, name in enumerate(NAMES)}
BODY = np.random.default_rng(0).normal(0, 0.3, (12, 3))
ASSUMED = 0.01
"""m; with no error of the orientation."""


def learned(shifts: Floats, moved: Mapping[str, Rigid] | None = None) -> PoseError:
    """Three cameras see a body, each shifted by a row of ``shifts`` (3, 3)."""
    error = PoseError(0.0, ASSUMED, PLACES, moved or {})
    views = Sightings.allocate(3, 12)._replace(
        cameras=np.arange(3), positions=BODY + shifts[:, None]
    )
    error.learn(views, np.full((3, 12), 1e-4), np.broadcast_to(BODY, (3, 12, 3)), NAMES)
    return error


def stated(error: PoseError, seen: int) -> float:
    """Variance, m2, of a marker that some cameras see."""
    return float(error.variances(BODY[None, :1], np.array([[seen]]), NAMES)[0, 0])


def test_without_evidence_the_variance_is_that_assumed() -> None:
    error = PoseError(0.0, ASSUMED, PLACES, {})
    assert stated(error, 0b1) == pytest.approx(ASSUMED**2)
    assert stated(error, 0b111) == pytest.approx(ASSUMED**2 / 3)


def test_a_rotation_counts_more_from_afar() -> None:
    near, far = (PoseError(0.01, 0.0, {"a": np.array([x, 0.0, 0.0])}, {}) for x in (2.0, 4.0))
    positions, seen = np.zeros((1, 1, 3)), np.array([[1]])
    ratio = far.variances(positions, seen, ["a"]) / near.variances(positions, seen, ["a"])
    assert ratio == pytest.approx(4.0)


def test_cameras_that_agree_have_better_poses_than_assumed() -> None:
    assert learned(np.zeros((3, 3))).ratio == pytest.approx(3 / 9)


def test_cameras_that_disagree_as_assumed_change_nothing_and_others_do() -> None:
    shifts = np.random.default_rng(1).normal(0, 1, (3, 3))
    shifts *= ASSUMED * np.sqrt(6 / ((shifts - shifts.mean(axis=0)) ** 2).sum())
    assert learned(shifts).ratio == pytest.approx(1.0)
    assert learned(2 * shifts).ratio == pytest.approx(3.0)


def test_refined_cameras_share_the_mean_of_the_errors_that_were_given() -> None:
    moved = {
        name: Rigid(np.array([0.0, 0, 0, 1]), np.array([0.02 * k, 0, 0]))
        for k, name in enumerate(NAMES)
    }
    refined, given = learned(np.zeros((3, 3)), moved), learned(np.eye(3)[[0] * 3] * 0.0)
    assert refined.ratio > 1 > given.ratio
    assert stated(refined, 0b1) == pytest.approx(stated(refined, 0b111))


def test_a_confused_identity_does_not_make_the_poses_arbitrarily_bad() -> None:
    far, farther = (learned(np.eye(3) * metres) for metres in (1.0, 2.0))
    assert far.ratio == farther.ratio < 30
