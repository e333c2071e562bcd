"""The causal system fuse-realtime: what it may know, how late it is, and what it learns live."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from builders import at_once, room, same

from hiros_mcap.config import load_config
from hiros_mcap.evaluate import evaluate
from hiros_mcap.stages.fuse import fusing
from hiros_mcap.stages.fuse.constrain import ConstrainParams, constrain_blocks
from hiros_mcap.stages.fuse.fusing import (
    POSE,
    FusedPoses,
    FusionWork,
    JointNoise,
    JointStates,
    Steps,
)
from hiros_mcap.stages.fuse.pair_lengths import RunningLengths, measured_lengths
from hiros_mcap.stages.fuse.pose_prior import RecentMotion
from hiros_mcap.stages.known_cameras import KnownCameras
from hiros_mcap.systems import Run, system

MS = 1_000_000


@cache
def walk(cameras=4):
    return room(people=2, cameras=cameras, seconds=3, seed=62, action="cross")


def result(where, frames, name="fuse-realtime"):
    config = load_config(system=name)
    run = Run(
        where.model, config, known=KnownCameras(where.cameras), fixed_frame="world", system=name
    )
    stages = system(name).stages(run)
    for channel in ("tracked", "merged", "optimized", "filtered"):
        frames = list(at_once(stages[channel])(frames)) if channel in stages else frames
    return frames


@cache
def usual(name="fuse-realtime", cameras=4):
    return result(walk(cameras), walk(cameras).frames, name)


@pytest.mark.parametrize("seconds", [1.0, 2.7])
def test_what_is_logged_later_changes_nothing(seconds):
    """Until a time, the cameras report the same; then everybody is elsewhere and half are gone."""
    frames = walk().frames
    now = frames[0].log_time + round(seconds * 1e9)
    altered = [f if f.log_time <= now else f.select([0] if f.n_people else []) for f in frames]
    for frame in altered:
        if frame.log_time > now:
            frame.markers[:, :, :3] += 0.3
    before, after = (
        [f for f in some if f.log_time <= now] for some in (usual(), result(walk(), altered))
    )
    assert len(before) == len(after) > 25 * (seconds - 0.1)
    assert all(map(same, before, after))


@pytest.mark.parametrize("cameras", [1, 2, 4, 8])
def test_no_result_is_later_than_a_tenth_of_a_second(cameras):
    frames = usual(cameras=cameras)
    late = np.array([f.log_time - f.stamp for f in frames])
    assert len(frames) > 80
    assert (late > 0).all()
    assert np.percentile(late, 98) < 100 * MS


def test_results_of_late_messages_look_as_far_ahead():
    frames = walk().frames
    late = [frame.replace(log_time=frame.log_time + 200 * MS) for frame in frames]
    before, after = (
        [f.replace(log_time=0) for f in some] for some in (usual(), result(walk(), late))
    )
    assert len(before) == len(after)
    assert all(map(same, before, after))


def test_it_is_nearer_to_the_truth_than_hiros_realtime():
    where = walk()
    ours, theirs = (
        evaluate(usual(name), where.truth, where.model)
        for name in ("fuse-realtime", "hiros-realtime")
    )
    assert ours.mean < 0.9 * theirs.mean
    assert ours.jitter < theirs.jitter


def test_every_marker_says_how_well_it_is_known():
    for frame in usual():
        assert frame.uncertainty is not None
        known = ~np.isnan(frame.positions[:, :, 0])
        assert (frame.uncertainty.deviations[known] > 0.001).all()
        assert np.isnan(frame.uncertainty.deviations[~known]).all()


def start_to_run():
    """Errors of estimates by what was measured so far: somebody stands, and runs from 1 s on.

    The second is that of a filter whose density does not change.
    """
    times = np.repeat(np.arange(60) / 30, 2)
    x = np.where(times > 1, 3 * (times - 1), 0.0)[:, None, None] * [1.0, 0.0, 0.0]
    cameras = np.tile([0, POSE], 60)
    rows = np.arange(120) * (cameras != POSE)  # the only pose that is wanted is that of row 0
    steps = Steps(times, cameras, rows, x, np.full((120, 1), 0.01**2))
    alone = np.array([0]), np.array([-1])
    noise = JointNoise(np.array([1.0]), np.array([1e-8]), 1.7, 8, 0.0, 0.5, *alone)
    states, out = JointStates.unknown(1, 1, 1), FusedPoses.absent(1, 1)
    for k in range(60):
        some = Steps(*[array[2 * k : 2 * k + 2] for array in steps[:3]], *steps[3:])
        fusing.smooth_joints(some, 2, noise, states, 0, out, FusionWork.of(2, 3, 1))
        x[2 * k + 1] = out.positions[0]
    return x[1::2, 0, 0] - x[::2, 0, 0], steady(x[::2, 0, 0])


def steady(z):
    """Errors of a Kalman filter of constant density, with the same numbers, at 30 Hz."""
    x, p, dt = np.array([z[0], 0.0]), np.diag([0.05, 1.0]), 1 / 30
    f, q = np.array([[1, dt], [0, 1]]), np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    errors = []
    for k, measured in enumerate(z):
        if k:
            x, p = f @ x, f @ p @ f.T + q
        gain = p[:, 0] / (p[0, 0] + 0.01**2)
        x, p = x + gain * (measured - x[0]), p - np.outer(gain, p[0])
        errors.append(x[0] - measured)
    return np.array(errors)


def test_a_filter_whose_predictions_fail_follows_faster():
    agile, usual = start_to_run()
    assert np.abs(agile[:30]).max() < 1e-9
    assert np.abs(agile[34:36]).mean() < 0.7 * np.abs(usual[34:36]).mean()


def test_running_lengths_become_those_of_the_whole():
    rng = np.random.default_rng(1)
    ends = np.zeros((600, 2, 3))
    ends[:, 1, 0] = 0.25
    poses, variances = ends + rng.normal(0, 0.02, ends.shape), np.full((600, 2), 0.02**2)
    poses[300, 1] += 5.0
    poses[17] = np.nan
    pairs = np.array([[0, 1]], np.int32)
    running = RunningLengths(pairs, np.arange(2, dtype=np.int32))
    running.update(poses, variances)
    lengths = running.result()[0]
    assert lengths == pytest.approx(measured_lengths(poses, variances, pairs), abs=0.002)
    assert lengths == pytest.approx(0.25, abs=0.003)


def swinging(seconds):
    """Noisy and true poses of twelve markers that swing together at 30 Hz."""
    rng = np.random.default_rng(2)
    times = np.arange(round(30 * seconds)) / 30
    swing = np.sin(5 * times)[:, None, None] * rng.normal(0, 0.1, (1, 12, 3))
    pose = rng.normal(0, 0.5, (1, 12, 3)) + swing
    return pose + rng.normal(0, 0.02, pose.shape), pose


def shrunk(poses):
    return RecentMotion().shrink(poses, np.full((len(poses), 12), 0.02**2), MS * times(poses))


def times(poses):
    """Times of poses at 30 Hz, ms."""
    return 33 * np.arange(len(poses))


def test_the_motion_so_far_takes_noise_off():
    noisy, pose = swinging(6)
    found = shrunk(noisy)
    np.testing.assert_array_equal(found[:60], noisy[:60])  # nothing known for 2 s
    assert (found - pose)[90:].std() < 0.7 * (noisy - pose)[90:].std()


def test_a_motion_that_was_never_seen_is_not_held_back():
    noisy, pose = swinging(4)
    noisy[110:, 3, 2] += 0.5
    pose = pose.copy()
    pose[110:, 3, 2] += 0.5
    assert np.abs(shrunk(noisy) - pose)[110:, 3].max() < 0.12


def test_lengths_stay_once_they_are_known():
    frames = usual("hiros-realtime")
    params = ConstrainParams(window=0.0, enough=1.5)
    out = list(at_once(constrain_blocks)(frames, walk().model, params))
    assert [f.log_time for f in out] == [f.log_time for f in frames]
    links = walk().model.links
    poses = np.array([f.positions[f.ids == 0][0] for f in out[60:] if 0 in f.ids])
    lengths = np.linalg.norm(poses[:, links[:, 0]] - poses[:, links[:, 1]], axis=2)
    assert (np.nanstd(lengths, axis=0) / np.nanmean(lengths, axis=0) < 0.02).all()
