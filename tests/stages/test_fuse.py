"""The fuser on points whose answer is known, and on a simulated room."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from builders import at_once, room, same
from scipy.signal import lfilter

from hiros_mcap.config import load_config
from hiros_mcap.evaluate import evaluate
from hiros_mcap.frames import Block, by_frame, frames_of, join
from hiros_mcap.skeletons import VELOCITY, Frame, SkeletonModel
from hiros_mcap.stages.filter.link_lengths import project_all
from hiros_mcap.stages.fuse import fusing
from hiros_mcap.stages.fuse.constrain import ConstrainParams, StepMeter, constrain_blocks
from hiros_mcap.stages.fuse.fuse import FuseParams, fuse_blocks
from hiros_mcap.stages.fuse.fusing import (
    POSE,
    FusedPoses,
    FusionWork,
    JointNoise,
    JointStates,
    Sightings,
    Steps,
)
from hiros_mcap.stages.fuse.pair_lengths import RATE, LastMinute, RunningLengths, measured_lengths
from hiros_mcap.stages.fuse.pose_prior import (
    MotionPrior,
    body_frames,
    estimated,
    has_heading,
    local_frames,
    shrink_noise,
)
from hiros_mcap.stages.fuse.window_smoother import (
    ComparedViews,
    FusionWindows,
    StepWork,
    smooth_people,
)
from hiros_mcap.stages.known_cameras import KnownCameras
from hiros_mcap.systems import Run, system

fuse = at_once(fuse_blocks)
constrain = at_once(constrain_blocks)

START = 1_700_000_000_000_000_000  # ns
TREE = np.array([0]), np.array([-1])  # one joint, without a parent
NOISE = JointNoise(np.array([5.0]), np.array([0.02**2]), 2.0, 10**9, 0.0, 0.5, *TREE)


def numbered(times, cameras, positions, variances):
    """Steps of which each has a row of its own in the positions."""
    is_pose = cameras == POSE
    rows = np.where(is_pose, np.cumsum(is_pose) - 1, np.arange(len(times)))
    return Steps(times, cameras, rows, positions, variances)


def part_of(steps, which):
    """Some of the steps that ``numbered`` returned."""
    arrays = steps.times, steps.cameras, steps.positions, steps.variances
    return numbered(*[array[which] for array in arrays])


def steps_of(seed=0):
    """Two cameras in turn with noise of 1 cm, a pose wanted after every second measurement."""
    rng = np.random.default_rng(seed)
    times = np.repeat(np.arange(60) / 30, 3) + np.tile([0.0, 0.011, 0.015], 60)
    cameras = np.tile([0, 1, POSE], 60)
    truth = np.stack([times, np.sin(times), times * 0], axis=1)[:, None]
    z = truth + rng.normal(0, 0.01, truth.shape)
    z[cameras == POSE] = np.nan
    return numbered(times, cameras, z, np.full((180, 1), 0.01**2))


def smoothed(steps, keep=10**9, states=None, work=None):
    states = states or JointStates.unknown(1, 1, 2)
    out = FusedPoses.absent(int((steps.cameras == POSE).sum()), 1)
    work = work or FusionWork.of(len(steps.times), 4, 1)
    fusing.smooth_joints(steps, keep, NOISE, states, 0, out, work)
    return out


def test_views_are_filtered_in_the_order_of_their_times_person_by_person():
    """Whatever the order in which they come: two people, who have the steps of two seeds."""
    parts = [steps_of(seed) for seed in (3, 4)]
    both = Steps(*map(np.concatenate, zip(*parts, strict=True)))
    people, is_pose = np.repeat([7, 9], 180), both.cameras == POSE
    stamps = np.round(both.times * 1e9).astype(np.int64)
    order = np.random.default_rng(1).permutation(np.flatnonzero(~is_pose))
    views = Sightings.allocate(len(order), 1)._replace(
        people=people[order], cameras=both.cameras[order], stamps=stamps[order],
        positions=both.positions[order],
    )  # fmt: skip
    n, variances, ids = len(order), both.variances[order], np.array([7, 9], np.int32)
    windows = FusionWindows(
        views, variances, np.full(n, -1), people[is_pose].astype(np.int32), stamps[is_pose],
        np.array([[0, n, 0, 120, 0, 10**9]]), ids, np.array([1, 0]), 0,
    )  # fmt: skip
    states, out = JointStates.unknown(2, 1, 2), FusedPoses.absent(120, 1)
    compared, work = ComparedViews.none(n, 120, 1), StepWork.of(180, 4, 1)
    smooth_people(windows, 0, 2, NOISE, states, out, compared, work)
    for k, (steps, row) in enumerate(zip(parts, (1, 0), strict=True)):
        alone = JointStates.unknown(1, 1, 2)
        expected = smoothed(steps, keep=int((steps.times < 1).sum()), states=alone)
        for array, wanted in zip(out, expected, strict=True):
            np.testing.assert_allclose(array[60 * k : 60 * k + 60], wanted, atol=1e-7)
        for array, wanted in zip(states, alone, strict=True):
            np.testing.assert_allclose(array[row], wanted[0], atol=1e-7)


def dense_solution(steps, factors):
    """Positions and variances by one Gaussian regression over all states at once.

    ``factors`` (T,) are those of the density of the acceleration before each step.
    """
    n, t = 4, len(steps.times)
    prior = np.diag([0.05, 1.0, NOISE.offsets[0], NOISE.offsets[0]])
    covariance = np.zeros((t * n, t * n))
    block = [slice(k * n, k * n + n) for k in range(t)]
    covariance[block[0], block[0]] = prior
    for k in range(1, t):
        dt, q = steps.times[k] - steps.times[k - 1], NOISE.accelerations[0] * factors[k]
        keep = np.exp(-dt / NOISE.time)
        measured = steps.times[:k][steps.cameras[:k] >= 0]
        slowing = np.clip(steps.times[k] - measured[-1] - fusing._GOES_ON, 0.0, dt)
        left = np.exp(-slowing / fusing._STOPS)
        f = np.diag([1.0, left, keep, keep])
        f[0, 1] = dt - slowing + fusing._STOPS * (1.0 - left)
        noise = np.diag([q * dt**3 / 3, q * dt, *[NOISE.offsets[0] * (1 - keep**2)] * 2])
        noise[0, 1] = noise[1, 0] = q * dt**2 / 2
        for j in range(k):
            covariance[block[k], block[j]] = f @ covariance[block[k - 1], block[j]]
            covariance[block[j], block[k]] = covariance[block[k], block[j]].T
        covariance[block[k], block[k]] = f @ covariance[block[k - 1], block[k - 1]] @ f.T + noise
    seen = np.flatnonzero(steps.cameras >= 0)
    h = np.zeros((len(seen), t * n))
    h[np.arange(len(seen)), seen * n] = 1
    h[np.arange(len(seen)), seen * n + 2 + steps.cameras[seen]] = 1
    mean = np.zeros((t * n, 3))
    mean[::n] = steps.positions[0, 0]
    gain = (
        covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + np.diag(steps.variances[seen, 0]))
    )
    found = mean + gain @ (steps.positions[seen, 0] - h @ mean)
    variances = np.diag(covariance - gain @ h @ covariance)
    poses = np.flatnonzero(steps.cameras < 0) * n
    return found[poses], variances[poses]


@pytest.mark.parametrize(("unseen", "pace"), [(0.0, 1), (0.7, 1), (0.0, 20)])
def test_the_smoother_equals_regression_over_all_states(unseen, pace):
    """Also where nobody is seen for a while in the middle, and in a log of 13 s."""
    all_steps = steps_of()
    all_steps = all_steps._replace(times=pace * all_steps.times)
    away = (all_steps.times > 0.2) & (all_steps.times < 0.2 + unseen) & (all_steps.cameras >= 0)
    steps = part_of(all_steps, np.flatnonzero(~away)[:60])
    work = FusionWork.of(len(steps.times), 4, 1)
    found = smoothed(steps, work=work)
    positions, variances = dense_solution(steps, work.factors)
    np.testing.assert_allclose(found.positions[:, 0], positions, atol=1e-9)
    np.testing.assert_allclose(found.variances[:, 0], variances, rtol=1e-6)


def test_a_window_goes_on_where_the_last_one_ended():
    steps, states = steps_of(), JointStates.unknown(1, 1, 2)
    smoothed(steps, 90, states)
    rest = smoothed(part_of(steps, slice(90, None)), states=states)
    # The levels of the acceleration start from the filter, not from the filters of each level.
    np.testing.assert_allclose(rest.positions, smoothed(steps).positions[30:], atol=2e-4)


@pytest.mark.parametrize("speed", [1.5, 5.0])
def test_who_is_not_seen_any_more_stops_within_half_a_second(speed):
    times = np.repeat(np.arange(60) / 30, 2)
    cameras = np.tile([0, POSE], 60)
    z = np.stack([speed * times, 0 * times, 0 * times], axis=1)[:, None]
    seen = (cameras == POSE) | (times < 1.0)
    z[cameras == POSE] = np.nan
    out = smoothed(numbered(times[seen], cameras[seen], z[seen], np.full((seen.sum(), 1), 1e-4)))
    last = int(np.flatnonzero(np.arange(60) / 30 < 1.0)[-1])
    x, v = out.positions[:, 0, 0], out.velocities[:, 0, 0]
    np.testing.assert_allclose(v[last : last + 6], speed, rtol=0.02)
    assert v[last + 16] < 0.15 * speed
    assert x[-1] - x[last] < 0.4 * speed
    assert (np.diff(out.variances[last:, 0]) > 0).all()


def moving(x):
    """Errors, m, of one who moves along ``x`` (T,), m, at 30 Hz, and the chosen factors."""
    rng = np.random.default_rng(4)
    times = np.repeat(np.arange(len(x)) / 30, 2)
    z = np.stack([x, 0 * x, 0 * x], axis=1) + rng.normal(0, 0.01, (len(x), 3))
    steps = numbered(
        times,
        np.tile([0, POSE], len(x)),
        np.repeat(z, 2, axis=0)[:, None],
        np.full((len(times), 1), 0.01**2),
    )
    noise = JointNoise(np.array([3.0]), np.array([1e-6]), 2.0, 4, 20.0, 0.5, *TREE)
    work, out = FusionWork.of(len(times), 3, 1), FusedPoses.absent(len(x), 1)
    fusing.smooth_joints(steps, 0, noise, JointStates.unknown(1, 1, 1), 0, out, work)
    return np.asarray(np.abs(out.positions[:, 0, 0] - x)), work.factors[::2]


def test_a_fast_limb_gets_a_higher_level_for_as_long_as_it_is_fast():
    """A kick of 60 m/s2 lasts for half a second; before and after, the foot is at rest."""
    t = np.arange(120) / 30
    kick = np.where(abs(t - 2) < 0.25, 0.5 * (1 + np.cos(4 * np.pi * (t - 2))), 0.0)
    errors, factors = moving(0.75 * kick)
    at_rest = (t > 0.5) & (abs(t - 2) > 1)
    assert factors[at_rest].max() < 3
    assert factors[abs(t - 2) < 0.2].min() > 5
    assert errors[abs(t - 2) < 0.3].max() < 0.03
    assert errors[at_rest].mean() < 0.007


def test_one_outlier_is_no_fast_motion():
    z = np.zeros(120)
    z[60] = 0.5
    errors, factors = moving(z)
    assert factors[30:].max() < 20
    assert errors[[58, 59, 61, 62]].max() < 0.05


@pytest.mark.parametrize("wrong", [0, 1])
def test_a_joint_that_one_of_two_cameras_sees_elsewhere_stays(wrong):
    """For half a second, whichever camera sends first: that is no fast motion."""
    rng, n = np.random.default_rng(5), 90
    times = np.repeat(np.arange(n) / 30, 3) + np.tile([0.0, 0.005, 0.006], n)
    cameras = np.tile([0, 1, POSE], n)
    z = rng.normal(0, 0.01, (3 * n, 1, 3))
    z[(cameras == wrong) & (times > 1.5) & (times < 2), 0, 2] += 0.5
    steps = numbered(times, cameras, z, np.full((3 * n, 1), 0.01**2))
    noise = JointNoise(np.array([3.0]), np.array([0.01**2]), 1.7, 4, 20.0, 0.5, *TREE)
    work, out = FusionWork.of(3 * n, 4, 1), FusedPoses.absent(n, 1)
    fusing.smooth_joints(steps, 0, noise, JointStates.unknown(1, 1, 2), 0, out, work)
    assert np.abs(out.positions).max() < 0.1


def test_a_gross_outlier_moves_nothing():
    steps, robust = steps_of(), NOISE._replace(freedom=20)
    spoilt = steps._replace(positions=steps.positions.copy())
    spoilt.positions[90] += 1.0
    states = JointStates.unknown(1, 1, 2)
    out = FusedPoses.absent(60, 1)
    fusing.smooth_joints(spoilt, 10**9, robust, states, 0, out, FusionWork.of(180, 4, 1))
    assert np.abs(out.positions - smoothed(steps).positions).max() < 0.01


def test_lengths_are_right_in_spite_of_noise_and_never_shortened_by_a_wrong_one():
    rng = np.random.default_rng(1)
    ends = np.zeros((4000, 2, 3))
    ends[:, 1, 0] = 0.1
    noisy, pairs = ends + rng.normal(0, 0.02, ends.shape), np.array([[0, 1]], np.int32)
    right = measured_lengths(noisy, np.full((4000, 2), 0.02**2), pairs)
    assert right == pytest.approx(0.1, abs=0.004)
    assert measured_lengths(ends, np.full((4000, 2), 0.02**2), pairs) == pytest.approx(0.1)


def told(limbs, poses):
    """Give poses at 15 Hz that are known to 0.1 mm."""
    stamps, variances = np.arange(len(poses)) * 66_666_667, np.full(poses.shape[:2], 1e-8)
    limbs.update(*((stamps,) if isinstance(limbs, LastMinute) else ()), poses, variances)


@pytest.mark.parametrize("meter", [LastMinute, RunningLengths])
def test_the_sides_of_a_body_draw_each_other_half_of_the_way_together(meter):
    poses = np.zeros((100, 5, 3))
    poses[:, :, 0] = [0.0, 0.20, 0.24, 1.0, np.nan]  # a middle, left and right, a head, nothing
    pairs = np.array([[0, 1], [0, 2], [0, 3], [0, 4]], np.int32)
    limbs = meter(pairs, np.array([0, 2, 1, 3, 4], np.int32))
    told(limbs, poses)
    lengths, _, counts = limbs.result()
    assert lengths == pytest.approx([0.21, 0.23, 1.0, 0.0], abs=1e-5)
    assert counts.tolist() == [100, 100, 100, 0]


@pytest.mark.parametrize("meter", [LastMinute, RunningLengths])
def test_a_limb_that_is_never_seen_is_as_long_as_that_of_the_other_side(meter):
    poses = np.zeros((100, 3, 3))
    poses[:, :, 0] = [0.0, 0.20, np.nan]
    limbs = meter(np.array([[0, 1], [0, 2]], np.int32), np.array([0, 2, 1], np.int32))
    told(limbs, poses)
    assert limbs.result()[0] == pytest.approx([0.20, 0.20], abs=1e-5)


def test_an_exact_distance_weighs_more_than_an_uncertain_one():
    """By the inverse of its variance; 5 mm of each end are never known: 3 to 1 here."""
    ends = np.zeros((400, 2, 3))
    ends[:200, 1, 0], ends[200:, 1, 0] = 0.100, 0.102
    variances = np.repeat([0.0, 2 * 0.005**2], 200)[:, None] * np.ones(2)
    found = measured_lengths(ends, variances, np.array([[0, 1]], np.int32))
    assert found == pytest.approx(np.sqrt((3 * 0.100**2 + 0.102**2) / 4), abs=1e-4)


def shrunk(poses, minute=None):
    """Move poses at 30 Hz, with 2 cm of noise, towards what they or a ``minute`` show."""
    minute = poses if minute is None else minute
    variances = np.full(minute.shape[:2], 0.02**2)
    return shrink_noise(poses, variances[: len(poses)], (minute, variances), 30.0)


def test_the_prior_takes_noise_off_and_keeps_motion():
    rng = np.random.default_rng(2)
    swing = np.sin(np.arange(90) / 8)[:, None, None] * rng.normal(0, 0.1, (1, 12, 3))
    pose = rng.normal(0, 0.5, (1, 12, 3)) + swing
    noisy = pose + rng.normal(0, 0.02, pose.shape)
    found = shrunk(noisy)
    assert (found - pose).std() < 0.6 * (noisy - pose).std()


def test_a_prior_takes_off_as_much_variance_as_its_steps_show():
    """Three joints that move by 2, 1 and 0 cm, seen with noise of 1 cm."""
    rng = np.random.default_rng(4)
    prior, noise = np.array([0.02, 0.01, 1e-9])[:, None], 0.01
    true = prior * rng.normal(size=(4000, 3, 3))
    seen = true + noise * rng.normal(size=true.shape)
    steps = -seen * noise**2 / (prior**2 + noise**2)
    left = StepMeter().left(steps, np.full((4000, 3), noise**2), 0)
    assert left[:2] == pytest.approx(
        ((seen + steps - true) ** 2).mean(axis=(0, 2))[:2] / 1e-4, abs=0.03
    )
    assert 0 < left[2] < 0.3


def test_who_was_not_moved_keeps_the_variance_and_old_steps_fade():
    still, variances, meter = np.zeros((5, 2, 3)), np.full((5, 2), 1e-4), StepMeter()
    assert (meter.left(still, variances, 0) == 1).all()
    after_a_step = meter.left(still + 0.007, variances, 1)
    assert (after_a_step < 0.8).all()
    assert (meter.left(still, variances, 10**12) > 0.99).all()


@pytest.mark.parametrize("together", [0.0, 0.7])
def test_lengths_leave_as_much_variance_as_they_do(together):
    """A chain of three joints and a rigid head of five, whose errors have a part in common."""
    rng = np.random.default_rng(7)
    body = rng.normal(0, 0.15, (8, 3))
    head = [(i, j) for i in range(3, 8) for j in range(i + 1, 8)]
    pairs = np.array([(0, 1), (1, 2), *head], np.int32)
    lengths = np.ones((1, len(pairs), 2))
    lengths[0, :, 0] = np.linalg.norm(body[pairs[:, 0]] - body[pairs[:, 1]], axis=1)
    own, common = rng.normal(0, 0.005, (2000, 8, 3)), rng.normal(0, 0.005, (2000, 1, 3))
    markers = np.zeros((2000, 8, 19))
    seen = body + np.sqrt(1 - together) * own + np.sqrt(together) * common
    markers[:, :, :3] = seen
    variances = np.full((2000, 8), 0.005**2)
    project_all(markers, np.zeros(2000, int), variances, pairs, lengths, 20, 1e-3)
    left = ((markers[:, :, :3] - body) ** 2).mean(axis=(0, 2)) / 0.005**2
    stated = StepMeter().left(markers[:, :, :3] - seen, variances, 0)
    np.testing.assert_allclose(stated, left, atol=0.07)


def test_a_minute_tells_slow_errors_from_a_motion_and_some_seconds_do_not():
    rng = np.random.default_rng(6)
    phases = np.arange(1800)[:, None] / rng.uniform(5, 20, 6) + rng.uniform(0, 6, 6)
    swings = 0.1 * np.sin(phases) @ rng.normal(0, 1, (6, 36))
    pose = rng.normal(0, 0.5, (1, 12, 3)) + swings.reshape(-1, 12, 3)
    stays = np.exp(-1 / (1.7 * 30))  # errors that change within 1.7 s, at 30 Hz
    steps = np.sqrt(1 - stays**2) * rng.normal(0, 0.02, pose.shape)
    noisy = pose + lfilter([1.0], [1.0, -stays], steps, axis=0)
    soon, later = shrunk(noisy[600:690]), shrunk(noisy[600:690], noisy)
    before, some, most = (
        np.sqrt(np.mean((poses - pose[600:690]) ** 2)) for poses in (noisy[600:690], soon, later)
    )
    assert some > 0.8 * before
    assert most < 0.7 * some


def test_the_last_minute_forgets_what_was_before_and_thins_what_comes_fast():
    pairs, mirror = np.array([[0, 1]], np.int32), np.arange(2, dtype=np.int32)
    minute = LastMinute(pairs, mirror, 10.0)
    for start in range(0, 40, 5):  # pieces of 5 s at 200 Hz
        stamps = start * 10**9 + 5_000_000 * np.arange(1000)
        minute.update(stamps, np.full((1000, 2, 3), float(start)), np.ones((1000, 2)))
    poses, variances = minute.poses()
    assert len(poses) == len(variances) == pytest.approx(10 * RATE, abs=2)
    assert np.unique(poses).tolist() == [30.0, 35.0]


LATERAL = np.array([[0, 1], [2, 3]], np.int32)


def rolling(degrees, seed=4):
    """One still pose of 12 markers, turned about the axis of y while it moves: (T, 12, 3)."""
    pose = np.random.default_rng(seed).normal(0, 0.5, (12, 3))
    pose[:4] = [[-0.2, 0.5, 0], [0.2, 0.5, 0], [-0.1, 0, 0], [0.1, 0, 0]]
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    zero, unit = np.zeros_like(c), np.ones_like(c)
    turns = np.stack([c, zero, s, zero, unit, zero, -s, zero, c], axis=1).reshape(-1, 3, 3)
    return pose @ turns + np.stack([degrees / 300, zero, zero], axis=1)[:, None]


def test_in_its_own_frame_a_rigid_body_that_rolls_does_not_move():
    poses = rolling(np.linspace(0, 360, 90))
    poses[20, 5:], variances = np.nan, np.full((90, 12), 0.02**2)
    variances[:, 7] = 0.3**2
    frames, origins = body_frames(poses, variances)
    local = (poses - origins) @ frames
    assert np.nanmax(np.abs(local - np.nanmean(local, axis=0))) < 1e-9
    assert (local @ np.swapaxes(frames, 1, 2) + origins) == pytest.approx(poses, nan_ok=True)
    assert np.linalg.det(frames) == pytest.approx(1.0)


def test_who_rolls_has_no_heading_and_who_turns_or_is_wrong_for_an_instant_has_one():
    level = rolling(np.linspace(-20, 20, 90))
    assert has_heading(level, LATERAL)
    assert not has_heading(rolling(np.linspace(0, 360, 90)), LATERAL)
    level[40] = rolling(np.full(1, 90.0))[0]
    assert has_heading(level, LATERAL)
    assert has_heading(np.full((5, 12, 3), np.nan), LATERAL)
    assert has_heading(level, np.empty((0, 2), np.int32))


def test_the_prior_takes_more_noise_off_who_rolls_in_the_frame_of_the_body():
    truth, variances = rolling(np.linspace(0, 360, 90)), np.full((90, 12), 0.02**2)
    noisy = truth + np.random.default_rng(5).normal(0, 0.02, truth.shape)
    errors = []
    for frames, origins in (body_frames(noisy, variances), local_frames(noisy, LATERAL)):
        found = shrunk((noisy - origins) @ frames)
        errors.append((found @ np.swapaxes(frames, 1, 2) + origins - truth).std())
    assert errors[0] < 0.75 * errors[1]


def test_the_prior_leaves_small_movements_of_who_stands_to_them():
    rng = np.random.default_rng(3)
    sway = 0.004 * np.sin(np.arange(90) / 6)[:, None, None] * rng.normal(0, 1, (1, 12, 3))
    pose = rng.normal(0, 0.5, (1, 12, 3)) + sway
    found = shrunk(pose)
    assert (found - pose).std() < 0.2 * sway.std()


def test_the_prior_leaves_alone_a_marker_that_is_absent_for_a_window():
    pose = np.random.default_rng(4).normal(0, 0.5, (200, 12, 3))
    absent = pose.copy()
    absent[:150, 2] = np.nan
    found = shrunk(absent)
    assert (np.isnan(found) == np.isnan(absent)).all()
    nobody = shrunk(np.full((90, 12, 3), np.nan))
    assert np.isnan(nobody).all()


def test_the_prior_takes_a_pose_that_never_changes():
    still = np.ones((90, 12, 3))
    assert shrunk(still) == pytest.approx(still)


def test_the_prior_estimates_as_wiener_does():
    """mu + P (P + V)^-1 (y - mu), where an absent marker has a variance of 1 m2."""
    rng = np.random.default_rng(5)
    mean, basis = rng.normal(size=12), 0.05 * rng.normal(size=(12, 3))
    measured = mean.reshape(4, 3) + rng.normal(0, 0.05, (2, 4, 3))
    measured[1, 2] = np.nan
    variances = rng.uniform(1e-6, 4e-4, (2, 4))
    poses = estimated(MotionPrior(mean, basis), measured, variances)
    p = basis @ basis.T + 0.003**2 * np.eye(12)
    for pose, y, v in zip(poses, measured, variances, strict=True):
        absent = np.isnan(y.ravel())
        off = np.where(absent, 0, y.ravel() - mean)
        noise = np.diag(np.where(absent, 1.0, np.repeat(v, 3)))
        expected = mean + p @ np.linalg.inv(p + noise) @ off
        np.testing.assert_allclose(pose.ravel()[~absent], expected[~absent], atol=1e-12)
        assert np.isnan(pose.ravel()[absent]).all()


def test_results_wait_for_lengths_that_other_poses_show():
    """The forearm that a detector shows grows from 0.2 to 0.3 m; the result has one length."""
    model = SkeletonModel.of(["A", "B"], [("forearm", 0, 1)])
    frames = []
    for k in range(240):
        stamp = START + k * 100_000_000
        frame = Frame.empty(1, model, stamp=stamp, log_time=stamp, source="a", frame_id="world")
        frame.ids[:] = 0
        frame.markers[0, :, :3] = [[0, 0, 1], [0.2 + 0.1 * min(k / 120, 1.0), 0, 1]]
        frames.append(frame)
    params = ConstrainParams(window=2.0, enough=12.0, prior=False)
    out = list(by_frame(constrain_blocks)(frames, model, params))
    lengths = [np.linalg.norm(np.subtract(*frame.positions[0])) for frame in out]
    assert [frame.stamp for frame in out] == [frame.stamp for frame in frames]
    assert np.ptp(lengths) < 1e-4
    assert 0.24 < lengths[0] < 0.26
    late = [(frame.log_time - frame.stamp) * 1e-9 for frame in out]
    assert max(late) <= params.enough + 2 * params.window
    assert max(late[150:]) <= params.window
    blocks = (join([Block.of(f) for f in frames[k : k + 35]]) for k in range(0, 240, 35))
    assert all(map(same, frames_of(constrain_blocks(blocks, model, params)), out))


# -- a room ----------------------------------------------------------------------------------------


@cache
def walk():
    return room(people=1, cameras=4, seconds=5, seed=61, action="walk")


def fused(where, **changes):
    stages = system("fuse").stages(run_of(where))
    frames = list(at_once(stages["tracked"])(where.frames))
    return list(fuse(frames, where.model, FuseParams(**changes), known=KnownCameras(where.cameras)))


def tracked_of(where):
    tracked = at_once(system("fuse").stages(run_of(where))["tracked"])
    return [Block.of(frame) for frame in tracked(where.frames)]


def run_of(where, name="fuse"):
    config = load_config(system=name)
    return Run(
        where.model, config, known=KnownCameras(where.cameras), fixed_frame="world", system=name
    )


def result(where, name):
    frames = where.frames
    for stage in system(name).stages(run_of(where, name)).values():
        frames = list(at_once(stage)(frames))
    return frames


def test_it_is_nearer_to_the_truth_than_hiros_and_keeps_lengths():
    where = walk()
    ours, theirs = (evaluate(result(where, n), where.truth, where.model) for n in ("fuse", "hiros"))
    assert ours.mean < theirs.mean
    assert ours.limb_variation < 0.002
    assert ours.jitter < theirs.jitter


def test_cores_change_nothing(monkeypatch):
    where, frames = room(people=3, cameras=3, seconds=3, seed=62), []
    for n in (1, 3):
        monkeypatch.setattr("hiros_mcap.threads.cores", lambda n=n: n)
        frames.append(result(where, "fuse"))
    assert all(map(same, *frames))


def test_more_cameras_give_more_confidence_and_smaller_deviations():
    where = walk()
    few = sorted(where.cameras)[:2]
    fewer = replace(where, frames=[f for f in where.frames if f.source in few])
    all_, two = (fused(some)[60] for some in (where, fewer))
    assert np.nanmean(all_.marker_confidences) > np.nanmean(two.marker_confidences) + 0.05
    assert np.nanmean(all_.uncertainty.deviations) < np.nanmean(two.uncertainty.deviations)
    assert set(np.unique(two.uncertainty.cameras)) <= {0, 1, 2, 3}


def test_clocks_that_were_corrected_make_whoever_moves_less_certain():
    """No stamp tells the common time base; it takes a marker along with its speed."""
    where = walk()
    ahead = zip(sorted(where.cameras), (0.0, 0.04, -0.05, 0.07), strict=True)
    clocks = [(0, name, seconds) for name, seconds in ahead]
    run = run_of(where)
    plain, corrected = (
        frames_of(
            system("fuse").stages(replace(run, known=KnownCameras(where.cameras, clocks=c)))[
                "merged"
            ](tracked_of(where))
        )
        for c in ([], clocks)
    )
    one, other = list(plain)[60], list(corrected)[60]
    more = other.uncertainty.deviations**2 - one.uncertainty.deviations**2
    speeds = np.linalg.norm(one.markers[:, :, VELOCITY], axis=-1)
    sd = np.sqrt(3 * np.nanmedian(more / speeds**2))
    assert 0.02 < sd < 0.06
    np.testing.assert_allclose(more, sd**2 / 3 * speeds**2, rtol=1e-3, atol=1e-9)


def test_the_common_time_is_within_a_standard_deviation_as_often_as_it_says():
    """A thousand rigs of four clocks, of which the middle counts as right."""
    rng, names = np.random.default_rng(5), ("a", "b", "c", "d")
    within = []
    for _ in range(1000):
        ahead = rng.normal(0, 0.05, 4)
        middle = np.median(ahead)
        off = zip(names, ahead - middle, strict=True)
        clocks = KnownCameras(clocks=[(1, name, seconds) for name, seconds in off])
        before, after = clocks.time_variances(names, np.array([0, 1]))
        assert before == 0.0, "not known yet"
        within.append(abs(middle) < np.sqrt(after))
    assert 0.6 < np.mean(within) < 0.75


@pytest.mark.parametrize("name", ["fuse", "fuse-realtime"])
def test_everybody_is_where_the_cameras_saw_them(name):
    where = room(people=3, cameras=4, seconds=3, seed=63)
    assert evaluate(result(where, name), where.truth, where.model).mean < 20  # mm


@pytest.mark.parametrize("changes", [{"window": 1.0}, {"window": 0.0, "lookahead": 1.0}])
def test_the_window_hardly_matters(changes):
    for one, other in zip(fused(walk()), fused(walk(), **changes), strict=True):
        assert np.nanmedian(np.abs(one.positions - other.positions)) < 0.004


def test_no_result_is_logged_before_its_look_ahead():
    frames = fused(walk(), window=0.0, lookahead=0.1)
    late = np.array([f.log_time - f.stamp for f in frames[:-10]])
    assert (late >= 100_000_000).all()
    assert np.median(late) < 400_000_000  # of which the tracker has a part


def test_the_causal_variant_knows_nothing_of_the_future():
    """The results before a cut are the same without the rest of the log."""
    where = walk()
    cut = replace(where, frames=where.frames[:300])
    end = max(frame.log_time for frame in cut.frames)
    whole = [f for f in result(where, "fuse-realtime") if f.log_time < end]
    part = [f for f in result(cut, "fuse-realtime") if f.log_time < end]
    assert len(whole) == len(part) > 40
    assert all(map(same, whole, part))
    assert np.median([f.log_time - f.stamp for f in whole]) < 300_000_000
