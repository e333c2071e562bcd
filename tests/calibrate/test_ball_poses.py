"""Poses from the centres of a ball that several cameras saw."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hiros_mcap.body.rotations import Rigid, angle
from hiros_mcap.calibrate.ball_poses import (
    BallTrack,
    Placement,
    _described,
    calibrate_centres,
    robust_fit,
)
from hiros_mcap.calibrate.verdict import TargetCamera
from hiros_mcap.errors import RegistrationError

PERIOD = 33_333_333


def pose_of(k):
    """Camera k stands 2.5 m from the middle of the room."""
    turn = Rotation.random(random_state=k)
    return Rigid(turn.as_quat(), turn.apply([0.0, 0.0, -2.5]))


def path(n, seed=0):
    """Where somebody carried the ball, smoothly."""
    t, rng = np.linspace(0, 12, n)[:, None], np.random.default_rng(seed)
    return np.sin(t * [1.0, 0.73, 1.9] + rng.uniform(0, 6, 3)) * [1.5, 1.2, 0.9]


def track(k, points, noise, seed=0):
    """Camera k's view, at pose_of(k), of points in the world."""
    seen = Rotation.from_quat(pose_of(k).xyzw).inv().apply(points - pose_of(k).translation)
    seen += np.random.default_rng([seed, k]).normal(0, noise, seen.shape)
    return BallTrack(f"camera_{k}", f"frame_{k}", np.arange(len(points)) * PERIOD + k, seen)


def errors(pose, true):
    """Degrees and m."""
    turn = float(np.degrees(angle(pose.xyzw, true.xyzw)))
    return turn, float(np.linalg.norm(pose.translation - true.translation))


def between(a, b):
    return pose_of(a).inverse() @ pose_of(b)


@pytest.mark.parametrize("seed", range(8))
def test_a_thousand_centres_with_five_mm_of_noise(seed):
    tracks = [track(k, path(1000, seed), 0.005, seed) for k in range(3)]
    found = calibrate_centres(tracks)
    for k in (1, 2):
        turn, shift = errors(found.cameras[k].pose, between(0, k))
        assert turn < 0.1
        assert shift < 0.002
    assert found.verdict == "good"


def test_a_third_of_gross_outliers():
    rng, first, second = np.random.default_rng(5), *(track(k, path(300), 0.004) for k in (0, 1))
    wrong = rng.permutation(300)[:100]
    second.centres[wrong] += rng.normal(0, 0.8, (100, 3))
    pose, kept = robust_fit(second.centres, first.centres)
    turn, shift = errors(pose, between(0, 1))
    assert turn < 0.1
    assert shift < 0.003
    assert set(np.flatnonzero(~kept)) <= set(wrong)


def test_the_standard_errors_hold():
    """As stated, 90 % of the errors lie within twice the standard error."""
    within = []
    for seed in range(30):
        found = calibrate_centres([track(k, path(120, seed), 0.005, seed) for k in (0, 1)])
        camera = found.cameras[1]
        turn, shift = errors(camera.pose, between(0, 1))
        within += [turn < 2 * camera.error_deg, shift < 0.002 * camera.error_mm]
    assert np.mean(within) >= 0.9


def test_cameras_that_share_no_view_with_the_first_hang_on_another():
    one, two, three = (track(k, path(200), 0.002) for k in range(3))
    one.centres[100:] = np.nan
    three.centres[:100] = np.nan
    found = calibrate_centres([one, two, three])
    assert [camera.against for camera in found.cameras] == ["", "camera_0", "camera_1"]
    turn, shift = errors(found.cameras[2].pose, between(0, 2))
    assert turn < 0.2
    assert shift < 0.01
    assert found.cameras[2].error_deg > found.cameras[1].error_deg


def test_given_poses_place_the_rig():
    tracks = [track(k, path(200), 0.001) for k in range(3)]
    given = {f"frame_{k}": pose_of(k) for k in range(3)}
    found = calibrate_centres(tracks, given=given)
    assert found.gauge == "transforms"
    assert max(errors(found.cameras[k].pose, pose_of(k))[1] for k in range(3)) < 0.003


def test_a_path_in_a_plane_is_doubtful_and_right():
    flat = path(200) * [1, 1, 0]
    found = calibrate_centres([track(k, flat, 0.003) for k in (0, 1)])
    assert found.verdict == "doubtful"
    assert "high and low" in found.reason
    assert errors(found.cameras[1].pose, between(0, 1))[0] < 0.3


def disturbed(one, kind, rng):
    """A track with a fault: none, of the clock, or of the ball for some or all of the time."""
    n = len(one.stamps)
    wrong = rng.random(n) < rng.uniform(0.1, 0.8)
    if kind == 1:
        return one._replace(stamps=one.stamps + int(rng.uniform(-0.5, 0.5) * 1e9))
    if kind == 2:  # anything
        one.centres[wrong] += rng.normal(0, 0.5, (wrong.sum(), 3))
    if kind == 3:  # something that stands still
        one.centres[wrong] = np.array([0.5, 0.2, 2.0]) + rng.normal(0, 0.005, (wrong.sum(), 3))
    if kind == 4:  # the ball's twin in somebody's other hand
        one.centres[: int(n * rng.uniform(0.1, 0.45))] += rng.normal(0, 0.3, 3)
    if kind == 5:
        one.centres[:] = rng.permutation(one.centres)
    return one


def test_no_wrong_pose_is_called_good():
    """60 scenes: short, narrow or flat paths, noise, and what :func:`disturbed` does."""
    verdicts = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        points = path(int(rng.integers(15, 300)), seed)
        points *= rng.choice([0.3, 1.0]) * rng.choice([0.02, 0.3, 1.0, 1.0], 3)
        tracks = [track(k, points, rng.choice([0.002, 0.005, 0.015]), seed) for k in (0, 1)]
        tracks[1] = disturbed(tracks[1], seed % 6, rng)
        try:
            found = calibrate_centres(tracks)
        except RegistrationError:
            verdicts.append("refused")
            continue
        verdicts.append(found.verdict)
        turn, shift = errors(found.cameras[1].pose, between(0, 1))
        assert turn < 1.5, seed
        assert shift < 0.06, seed
    assert min(verdicts.count(v) for v in ("good", "doubtful", "refused")) > 4


def test_lengths_are_told_in_mm_and_angles_in_degrees():
    placement = Placement(Rigid.identity(), 40, 38, 0.003, 0.1, 0.002, np.ones(3))
    camera = _described(TargetCamera("camera_1", "camera_1"), "camera_0", placement)
    assert (camera.residual_mm, camera.error_deg, camera.error_mm) == (3.0, 0.1, 2.0)
    assert (camera.common, camera.used) == (40, 38)


def refusal(points, noise=0.002, late=0):
    tracks = [track(0, points, noise), track(1, np.roll(points, late, axis=0), noise)]
    with pytest.raises(RegistrationError) as error:
        calibrate_centres(tracks)
    return str(error.value)


def test_what_does_not_tell_a_pose_is_refused():
    line = np.linspace(-1, 1, 200)[:, None] * [1.0, 0.5, 0.2]
    assert "only 19 common times, 20 needed; carry the ball" in refusal(path(19))
    assert "nearly a line" in refusal(line)
    assert "path is a line" in refusal(line, noise=0.0)
    assert "nearly a line" in refusal(path(200) * 0.02)
    assert "check the cameras' clocks" in refusal(path(200), late=15)


def test_a_ball_that_stands_still_is_refused():
    assert "nearly a line" in refusal(np.ones((200, 3)))


def test_cameras_without_the_ball_or_without_a_frame_of_their_own_are_named():
    one, two = (track(k, path(50), 0.001) for k in (0, 1))
    with pytest.raises(RegistrationError, match="camera_0 and camera_1 share the frame 'frame_0'"):
        calibrate_centres([one, two._replace(frame="frame_0")])
    two.centres[:] = np.nan
    with pytest.raises(RegistrationError, match="camera_1 never saw the ball"):
        calibrate_centres([one, two])
    with pytest.raises(RegistrationError, match="at least 2 cameras needed, found camera_0"):
        calibrate_centres([one])
