"""Whether one of two cameras was moved, and when, by the distances of the people they see."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.calibrate.camera_change import _step, find_change, located, second_poses
from hiros_mcap.calibrate.camera_views import HALF_WIDTH_S, CameraView
from hiros_mcap.calibrate.joint_refinement import common_points, residuals_of
from hiros_mcap.calibrate.sampling import Rig
from hiros_mcap.kernels.local_line import Tracklet

MIRROR = np.arange(6, dtype=np.int32)
EARLY, LATE = Rigid.identity(), Rigid(np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.1, 0.0, 0.0]))
CLOCK_S = 0.5
"""The second camera's clock is slow."""


def change_of(moved_s):
    """What two cameras with 1 cm of noise tell of a second pose that holds from a time on.

    They see one person walk for 20 s; the time is that of the second camera.
    """
    rng, seconds = np.random.default_rng(2), np.arange(-10.0, 10.0, 1 / 15)
    joints = rng.uniform(-0.5, 0.5, (6, 3))
    path = joints + np.stack([0.3 * seconds, 0.0 * seconds, 3.0 + 0.0 * seconds], 1)[:, None]
    views = []
    for name, late in (("one", 0.0), ("other", CLOCK_S)):
        own = seconds - late
        seen = path + rng.normal(0.0, 0.01, path.shape)
        if late:
            seen[own >= moved_s] -= LATE.translation
        track = Tracklet(own, seen, np.ones(path.shape[:2]))
        views.append(CameraView(name, name, [track], 0.0, HALF_WIDTH_S))
    clocks = np.array([0.0, CLOCK_S])
    early, late_rig = (Rig.of([EARLY, p])._replace(clocks=clocks) for p in (EARLY, LATE))
    return located(views, early, late_rig, MIRROR)


def test_the_time_is_that_of_the_camera_that_was_moved():
    change = change_of(2.0)
    assert change.seconds == pytest.approx(2.0, abs=0.15)
    assert change.end - change.begin < 0.2


@pytest.mark.parametrize("metres", [0.01, 0.1])
def test_a_second_pose_takes_away_the_misfit_of_a_camera_that_was_moved(metres):
    rng, seconds = np.random.default_rng(4), np.arange(0.0, 10.0, 0.1)
    path = rng.uniform(-0.5, 0.5, (6, 3)) + np.stack([0.2 * seconds] * 3, 1)[:, None]
    views = []
    for name in ("one", "other", "moved"):
        seen = path.copy()
        if name == "moved":
            seen[seconds >= 5.0, :, 0] += metres
        tracks = [Tracklet(seconds, seen, np.ones(path.shape[:2]))]
        views.append(CameraView(name, name, tracks, 0.0, HALF_WIDTH_S))
    rig = Rig.alone(3)
    points = common_points(views, rig, np.arange(0.05, 9.9, 0.1), MIRROR, 0.5)
    gained = second_poses(residuals_of(points, rig), points)[2]
    assert gained.share > 0.8
    assert metres / 2 < gained.metres < metres
    assert gained.seconds == pytest.approx(5.0, abs=1.0)


@pytest.mark.parametrize(
    ("degrees", "metres", "moves"), [(0.0, 0.3, 1), (20.0, 0.0, 1), (0.0, 0.0, 0)]
)
def test_a_camera_has_moved_if_it_was_turned_or_shifted(degrees, metres, moves):
    rng, seconds = np.random.default_rng(3), np.arange(0.0, 60.0, 0.1)
    joints = rng.uniform(-0.5, 0.5, (6, 3))
    angle = 0.4 * seconds
    places = np.stack([1.5 * np.cos(angle), 0.3 * np.sin(0.7 * seconds), 3 + np.sin(angle)], 1)
    path = joints + places[:, None]
    turn = Rotation.from_euler("y", degrees * (seconds >= 30.0)[:, None], degrees=True)
    moved = np.einsum("tij,tmj->tmi", turn.as_matrix(), path)
    moved[seconds >= 30.0, :, 0] += metres
    pair = []
    for name, seen in (("one", path), ("other", moved)):
        noisy = seen + rng.normal(0.0, 0.005, path.shape)
        track = Tracklet(seconds, noisy, np.ones(path.shape[:2]))
        pair.append(CameraView(name, name, [track], 0.0, HALF_WIDTH_S))
    change = find_change(pair, MIRROR)
    assert (change is not None) == moves
    if change:
        assert change.begin < 29.95 < change.end + 0.05


@pytest.mark.parametrize("moved_s", [-20.0, 20.0])
def test_a_pose_that_fits_throughout_is_never_replaced(moved_s):
    change = change_of(moved_s)
    assert not np.isfinite([change.begin, change.end]).all()


@pytest.mark.parametrize("before", [40, 80])
def test_a_step_is_told_in_metres_wherever_it_is(before):
    seconds = np.arange(120.0)
    distances = np.where(seconds < before, 0.4, 0.1)
    distances[::7] = np.nan
    assert _step(distances, seconds) == pytest.approx(0.3)
