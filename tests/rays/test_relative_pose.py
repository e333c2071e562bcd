"""Poses and lags of RGB cameras from nothing but people."""

import numpy as np
import pytest
from filmed import around, film, walking

from hiros_mcap.rays.bundle import cameras_at, placed, poses_of
from hiros_mcap.rays.image_tracks import views_of
from hiros_mcap.rays.relative_pose import APART_S, rig_from_people

RIG = around(cameras=3)
LAGS = dict(zip(RIG, (0.0, 0.8, -0.5), strict=True))


def found(scene):
    return rig_from_people(views_of(scene.frames, scene.lenses))


@pytest.fixture(scope="module")
def rig():
    return found(film(walking(people=2, seconds=12.0), RIG, lags=LAGS))


def test_people_alone_tell_poses_up_to_the_size(rig):
    assert sorted(rig.cameras) == [0, 1, 2]
    true = [[*RIG.values()][c] for c in rig.cameras]
    at = placed(rig.fit.bundle, cameras_at(true), np.zeros(3, np.bool_))
    apart = [one.apart(other) for one, other in zip(poses_of(at.cameras), true, strict=True)]
    assert max(degrees for _, degrees in apart) < 0.5
    assert max(metres for metres, _ in apart) < 0.03


def test_people_alone_tell_the_lags_to_a_quarter_of_a_frame(rig):
    off = rig.fit.lags - np.array([[*LAGS.values()][c] for c in rig.cameras])
    assert np.ptp(off) < 0.008
    assert rig.rivalry < 0.95


def test_regular_motion_that_fits_at_other_lags_is_said():
    scene = film(walking(people=1, seconds=12.0, action="jump"), RIG, lags=LAGS)
    rig = found(scene)
    late = rig.fit.lags - np.array([[*LAGS.values()][c] for c in rig.cameras])
    assert np.ptp(late) < APART_S or rig.rivalry > 0.95


def test_people_whom_one_camera_sees_alone_tell_nothing():
    scene = film(walking(people=1, seconds=4.0), RIG)
    assert found(scene._replace(frames={**scene.frames, "cam2": [], "cam3": []})) is None
