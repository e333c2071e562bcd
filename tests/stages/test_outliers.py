"""Which camera is taken to be wrong about a joint, and for how long."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_mcap.skeletons import SkeletonModel
from hiros_mcap.stages.fuse import fusing
from hiros_mcap.stages.fuse.fuse_params import FuseParams
from hiros_mcap.stages.fuse.fusing import POSE, FusedPoses, FusionWork, JointStates, Steps
from hiros_mcap.stages.fuse.fusion_noise import FusionNoise
from hiros_mcap.stages.fuse.outliers import parents_first

POINT = SkeletonModel.of(["wrist"], [])
ARM = SkeletonModel.of(["wrist", "elbow", "shoulder"], [("a", 2, 1), ("b", 1, 0)])
N = 120  # instants at 30 Hz


def seen(errors, model=POINT, missed=(), truth=0.0, last=0.5):
    """Errors (N, M), m, of the result along x, by those of C cameras (C, N, M), NaN = not seen.

    Joints move as ``truth`` (N,) says; outliers ``last`` s. All cameras measure within 10 ms.
    """
    rng, cameras = np.random.default_rng(3), len(errors)
    offsets = np.linspace(0.0, 0.01, cameras + 1)
    times = (np.arange(N)[:, None] / 30 + offsets).ravel()
    z = rng.normal(0, 0.005, (N, cameras + 1, model.n_markers, 3))
    z[:, :cameras, :, 0] += np.moveaxis(errors, 0, 1) + np.reshape(truth * np.ones(N), (N, 1, 1))
    z[:, cameras] = np.nan
    for camera, instant in missed:
        z[instant, camera] = np.nan
    numbers = np.tile([*range(cameras), POSE], N)
    rows = np.where(numbers == POSE, np.repeat(np.arange(N), cameras + 1), np.arange(len(times)))
    z = z.reshape(-1, model.n_markers, 3)
    steps = Steps(times, numbers, rows, z, np.full(z.shape[:2], 0.007**2))
    noise, states = FusionNoise.default(model), JointStates.unknown(1, model.n_markers, cameras)
    out = FusedPoses.absent(N, model.n_markers)
    work = FusionWork.of(len(times), 2 + cameras, model.n_markers)
    fusing.smooth_joints(
        steps, 0, noise.motion(model, FuseParams(outliers_last=last)), states, 0, out, work
    )
    return np.abs(out.positions[..., 0] - np.reshape(truth * np.ones(N), (N, 1)))


def episodes(*jumps, cameras=2, markers=1):
    """Errors of cameras: (camera, first, last, m) each."""
    errors = np.zeros((cameras, N, markers))
    for camera, first, last, metres in jumps:
        errors[camera, first:last] = metres
    return errors


@pytest.mark.parametrize("wrong", [0, 1])
def test_the_camera_that_jumped_stays_wrong_when_the_other_one_blinks(wrong):
    """A limb is put .4 m away for a second; within it the right camera lacks two pictures."""
    missed = [(1 - wrong, k) for k in (52, 58)]
    assert seen(episodes((wrong, 45, 75, 0.4)), missed=missed).max() < 0.03


def test_outliers_that_do_not_last_are_each_drawn_by_themselves():
    """Then the result goes over to the wrong camera while the right one lacks pictures."""
    wrong, missed = episodes((0, 45, 75, 0.4)), [(1, k) for k in (52, 58)]
    assert seen(wrong, missed=missed, last=0.0).max() > 3 * seen(wrong, missed=missed).max()


def test_who_is_right_is_right_at_once_when_the_episode_ends():
    """The camera that was right slips when the other one is back."""
    assert seen(episodes((0, 40, 60, 0.4), (1, 62, 80, 0.4))).max() < 0.03


@pytest.mark.parametrize("cameras", [1, 2])
def test_a_kick_that_all_cameras_show_is_no_outlier(cameras):
    """The foot is .6 m away within .2 s: 60 m/s2."""
    t = np.arange(N) / 30 - 2
    kick = 0.6 * np.where(abs(t) < 0.2, 0.5 * (1 + np.cos(5 * np.pi * t)), 0.0)
    assert seen(np.zeros((cameras, N, 1)), truth=kick).max() < 0.05


def test_a_lone_camera_that_jumps_for_an_instant_is_not_believed():
    assert seen(episodes((0, 60, 63, 0.6), cameras=1)).max() < 0.03


def test_a_lone_camera_that_shows_somebody_elsewhere_for_good_is_believed():
    errors = seen(episodes((0, 60, N, 0.6), cameras=1))
    assert np.abs(errors[75:] - 0.6).max() < 0.05


def test_who_does_not_agree_for_seconds_is_no_outlier_any_more():
    """Two cameras that come back contradict the third one, which was alone and wrong since then."""
    errors = episodes((0, 20, N, 0.2), cameras=3)
    errors[1:, 20:40] = np.nan
    assert seen(errors)[-1] < 0.1


def test_a_camera_that_is_wrong_is_no_witness_against_the_one_that_comes_back():
    """One camera puts the joint .45 m away. The other one, which is right, lacks five pictures."""
    errors = seen(episodes((1, 40, N, 0.45)), missed=[(0, k) for k in range(50, 55)])
    assert errors[65:].max() < 0.03


def test_a_joint_about_which_most_were_wrong_comes_back():
    """Two of three cameras are wrong at the same place, one after the other comes back."""
    errors = seen(episodes((0, 45, 75, 0.4), (1, 55, 90, 0.4), cameras=3))
    assert errors.max() < 1.2
    assert errors[110:].max() < 0.05


def test_a_limb_follows_the_joint_that_holds_it():
    """The elbow is .4 m off in one view, the wrist 16 cm: alone it would be half believed."""
    errors = np.zeros((2, N, 3))
    errors[0, 45:75, :2] = 0.16, 0.4
    wrist = seen(errors, ARM)[50:70, 0].mean()
    errors[0, 45:75, 1] = 0.0
    assert wrist < 0.5 * seen(errors, ARM)[50:70, 0].mean()


def test_parents_come_first_and_a_circle_of_links_has_none():
    order, parents = parents_first(ARM)
    assert order.tolist() == [2, 1, 0]
    assert parents.tolist() == [1, 2, -1]
    order, parents = parents_first(SkeletonModel.of("abc", [("x", 0, 1), ("y", 1, 0), ("z", 1, 2)]))
    assert sorted(order.tolist()) == [0, 1, 2]
    assert parents.tolist() == [-1, -1, -1]
