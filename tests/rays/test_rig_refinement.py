"""Poses and lags of RGB cameras before a run: right where people tell them, else left alone."""

import numpy as np
import pytest
from filmed import around, film, turned, walking

from hiros_mcap.kernels.local_line import Tracklet
from hiros_mcap.rays.bundle import cameras_at
from hiros_mcap.rays.image_tracks import views_of
from hiros_mcap.rays.lags import STEP_S, coarse_lags, sampled
from hiros_mcap.rays.rig_refinement import LEAST_RAYS, refine_rig

RIG = around()
LAGS = dict(zip(RIG, (0.0, 1.0, -0.7, 1.9), strict=True))


@pytest.fixture(scope="module")
def people():
    return walking(people=2, seconds=15.0)


def off(rig, film):
    """Largest errors: degrees, m, s."""
    apart = np.array([rig.poses[name].apart(pose) for name, pose in film.poses.items()])
    late = np.array([rig.lags[name] - film.lags[name] for name in film.poses])
    return apart[:, 1].max(), apart[:, 0].max(), np.abs(late - np.median(late)).max()


def test_two_people_tell_poses_and_lags(people):
    scene = film(people, RIG, rate=60.0, lags=LAGS, seed=1)
    rig = refine_rig(scene.frames, scene.lenses, turned(RIG, 1.0, seed=1))
    degrees, metres, seconds = off(rig, scene)
    assert rig.reason == ""
    assert not rig.regular
    assert (degrees, metres) < (0.6, 0.05)
    assert seconds < 0.004  # a quarter of a frame
    assert 0.0 in rig.lags.values()
    assert max(rig.after.values()) < 7.0 < max(rig.before.values())


@pytest.mark.parametrize("begin", [-8.0, -0.4, 0.0, 0.6, 4.0])
@pytest.mark.parametrize("length", [1.3, 4.0, 9.9])
def test_somebody_is_compared_at_every_step_while_he_is_seen(begin, length):
    """The steps are multiples of one time; those at the ends count."""
    seconds = STEP_S * np.linspace(begin, begin + length, 30)
    track = Tracklet(seconds, np.ones((30, 2, 3)), np.ones((30, 2)))
    first, rays = sampled(track, 0.5)
    steps = [step for step in range(-20, 20) if begin <= step <= begin + length]
    assert (first, len(rays)) == (steps[0], len(steps))


@pytest.mark.parametrize("rate", [5.0, 10.0])
def test_slow_detectors_tell_poses_too(rate, people):
    scene = film(people, RIG, rate=rate, lags=dict.fromkeys(RIG, 0.0), seed=4)
    rig = refine_rig(scene.frames, scene.lenses, turned(RIG, 1.0, seed=4))
    degrees, metres, _ = off(rig, scene)
    assert rig.reason == ""
    assert (degrees, metres) < (0.6, 0.06)


def test_the_same_input_gives_the_same_rig(people):
    scene = film(people, RIG, seed=1)
    one, two = (refine_rig(scene.frames, scene.lenses, turned(RIG, 1.0)) for _ in range(2))
    assert [tuple(map(tuple, pose)) for pose in one.poses.values()] == [
        tuple(map(tuple, pose)) for pose in two.poses.values()
    ]


def test_right_poses_stay_nearly(people):
    scene = film(people, RIG, seed=2)
    rig = refine_rig(scene.frames, scene.lenses, RIG)
    degrees, metres, _ = off(rig, scene)
    assert (degrees, metres) < (0.25, 0.02)


def test_poses_a_little_off_do_not_get_worse(people):
    """What people hardly tell, a shift of all cameras, stays as the given poses have it."""
    for seed in range(3):
        given = turned(RIG, 0.25, seed=seed)
        scene = film(people, RIG, seed=seed)
        rig = refine_rig(scene.frames, scene.lenses, given)
        assert off(rig, scene)[0] < 0.3


def test_one_person_on_one_spot_tells_a_lag_and_hardly_a_pose():
    scene = film(walking(people=1, seconds=12.0, action="lunge"), RIG, rate=60.0, lags=LAGS)
    rig = refine_rig(scene.frames, scene.lenses, turned(RIG, 1.0))
    assert off(rig, scene)[0] < 1.1
    assert off(rig, scene)[2] < 0.015


def test_regular_motion_is_said():
    scene = film(walking(people=1, seconds=12.0, action="jump"), RIG, lags=LAGS)
    assert refine_rig(scene.frames, scene.lenses, RIG).regular


def test_whom_only_one_camera_sees_is_nobody(people):
    scene = film(people, RIG)
    alone = {name: every if name == "cam1" else [] for name, every in scene.frames.items()}
    rig = refine_rig(alone, scene.lenses, RIG)
    assert rig.reason == "no two cameras see the same person"
    assert rig.poses == RIG
    assert set(rig.lags.values()) == {0.0}


def test_a_camera_that_sees_too_little_keeps_its_pose(people):
    scene, given = film(people, RIG, seed=4), turned(RIG, 1.5, seed=4)
    scene.frames["cam4"] = scene.frames["cam4"][: LEAST_RAYS // 20]
    rig = refine_rig(scene.frames, scene.lenses, given)
    assert rig.poses["cam4"] == given["cam4"]
    assert rig.poses["cam2"].apart(RIG["cam2"])[1] < 0.7
    assert rig.untimed == ("cam4",)


def test_coarse_lags_need_no_right_poses(people):
    scene = film(people, RIG, lags=LAGS)
    views, given = views_of(scene.frames, scene.lenses), turned(RIG, 3.0)
    lags = coarse_lags(views, cameras_at(list(given.values())))[0][0]
    assert lags == pytest.approx(list(LAGS.values()), abs=0.06)
