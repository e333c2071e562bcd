"""How wrong the cameras' poses are, as the cameras themselves show."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_mcap.body.rotations import Rigid, from_vector, rotate
from hiros_mcap.stages.fuse.fusing import Sightings
from hiros_mcap.stages.fuse.pose_error import PoseError
from hiros_mcap.stages.known_cameras import KnownCameras

NAMES = ("a", "b", "c")
PLACES = {name: np.array([np.cos(k), np.sin(k), 0.0]) * 3 for k, name in enumerate(NAMES)}
BODY = np.random.default_rng(0).normal(0, 0.3, (12, 3))
ASSUMED = 0.01
"""m; with no error of the orientation."""


def learned(*moments, angle=0.0, shift=ASSUMED, away=3.0):
    """Three cameras see a body, at each moment shifted by the rows of an array (3, 3)."""
    error = PoseError(angle, shift, KnownCameras(PLACES, {}))
    for second, shifts in enumerate(moments):
        views = Sightings.allocate(3, 12)._replace(
            people=np.zeros(3, int),
            cameras=np.arange(3),
            stamps=np.full(3, second * 10**9),
            positions=BODY + shifts[:, None],
            distances=np.full(3, away),
        )
        error.learn(views, shifts)
    return error


def stated(error, seen):
    """Variance, m2, of a marker that some cameras see."""
    ratios = np.array([error.ratio])
    return float(error.variances(BODY[None, :1], np.array([[seen]]), NAMES, ratios)[0, 0])


def test_without_evidence_the_variance_is_that_assumed():
    error = PoseError(0.0, ASSUMED, KnownCameras(PLACES, {}))
    assert stated(error, 0b1) == pytest.approx(ASSUMED**2)
    assert stated(error, 0b111) == pytest.approx(ASSUMED**2 / 3)


def test_a_rotation_counts_more_from_afar():
    near, far = (
        PoseError(0.01, 0.0, KnownCameras({"a": np.array([x, 0.0, 0.0])}, {})) for x in (2.0, 4.0)
    )
    marker = np.zeros((1, 1, 3)), np.array([[1]]), ["a"], np.ones(1)
    ratio = far.variances(*marker) / near.variances(*marker)
    assert ratio == pytest.approx(4.0)


def test_from_afar_the_same_disagreement_shows_a_smaller_error_of_orientations():
    shifts = np.random.default_rng(4).normal(0, 0.01, (3, 3))
    near, far = (learned(shifts, angle=0.01, shift=0.0, away=away).ratio for away in (2.0, 4.0))
    assert 9 * far - 3 == pytest.approx((9 * near - 3) / 4)


def test_cameras_that_agree_have_better_poses_than_assumed():
    assert learned(np.zeros((3, 3))).ratio == pytest.approx(3 / 9)


def test_cameras_that_disagree_as_assumed_change_nothing_and_others_do():
    shifts = np.random.default_rng(1).normal(0, 1, (3, 3))
    median = 5.348  # of a chi-square distribution with six degrees of freedom
    shifts *= ASSUMED * np.sqrt(median / ((shifts - shifts.mean(axis=0)) ** 2).sum())
    assert learned(shifts).ratio == pytest.approx(1.0, abs=0.01)
    assert learned(2 * shifts).ratio == pytest.approx(3.0, abs=0.01)


def test_a_moment_of_confusion_changes_nothing():
    shifts = np.random.default_rng(2).normal(0, ASSUMED, (3, 3))
    usual = learned(*[shifts] * 5).ratio
    assert learned(*[shifts] * 3, 50 * shifts, shifts, shifts).ratio == usual


def refined(angle, shift, bad=0.0):
    """Cameras whose given poses deviate from the refined rig by rad and m; c by more."""
    rng = np.random.default_rng(3)
    moved = {}
    for name in NAMES:
        size = bad if name == "c" and bad else angle
        turn = Rigid(from_vector(size * unit(rng)), np.zeros(3))
        place = PLACES[name]
        moved[name] = Rigid(turn.xyzw, place + shift * unit(rng) - rotate(turn.xyzw, place))
    return PoseError(0.005, 0.006, KnownCameras(PLACES, moved))


def unit(rng):
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def test_refined_cameras_share_the_placement_of_the_rig():
    error = refined(0.005, 0.006)
    assert stated(error, 0b1) == pytest.approx(stated(error, 0b111))


def test_a_rig_whose_given_poses_deviate_more_is_less_sure():
    small, turned, shifted = (refined(a, s) for a, s in ((0.0, 0.0), (0.05, 0.0), (0.0, 0.05)))
    assert stated(turned, 0b111) > stated(small, 0b111)
    # Positions that are right hold the rig, whatever the orientations are.
    assert stated(turned, 0b111) < 3 * stated(small, 0b111)
    assert stated(shifted, 0b111) > 5 * stated(small, 0b111)


def test_one_bad_camera_does_not_count_as_all():
    usual, one_bad = refined(0.005, 0.006), refined(0.005, 0.006, bad=0.07)
    assert stated(one_bad, 0b111) < 1.5 * stated(usual, 0b111)


def test_refined_poses_add_their_standard_errors():
    moved = {name: Rigid.identity() for name in NAMES}
    exact = PoseError(0.005, 0.006, KnownCameras(PLACES, moved))
    error = PoseError(0.005, 0.006, KnownCameras(PLACES, moved, {"a": 0.03, "b": 0.03, "c": 0.03}))
    more = stated(error, 0b111) - stated(exact, 0b111)
    assert more == pytest.approx(0.03**2 / 3 / 3)  # an axis of three, and the mean of three cameras
    assert stated(error, 0b1) - stated(exact, 0b1) == pytest.approx(0.03**2 / 3)


def test_a_camera_whose_pose_was_not_refined_adds_its_own_error():
    moved = {name: Rigid.identity() for name in NAMES[:2]}
    error = PoseError(0.005, 0.006, KnownCameras(PLACES, moved))
    assert stated(error, 0b100) > stated(error, 0b11)


def test_a_confused_identity_does_not_make_the_poses_arbitrarily_bad():
    far, farther = (learned(np.eye(3) * metres) for metres in (1.0, 2.0))
    assert far.ratio == farther.ratio < 30
