"""Link orientations against the bones: an arm whose detector has link axes of its own."""

from __future__ import annotations

import numpy as np
import pytest
from builders import same
from scipy.spatial.transform import Rotation

from hiros_mcap.body.rotations import angle
from hiros_mcap.frames import Block, frames_of, join
from hiros_mcap.skeletons import ORIENTATION, Frame, SkeletonModel, Uncertainty
from hiros_mcap.stages.fuse.align_links import align_blocks

ARM = SkeletonModel.of(["s", "e", "w"], [("upper", 0, 1), ("fore", 1, 2)])
AXES = Rotation.from_rotvec([0.4, -1.0, 0.7])
"""The axes of a segment in its link."""


def turns(steps):
    """Orientations of upper arm and forearm."""
    t = np.arange(steps) / 30
    upper = Rotation.from_rotvec(np.stack([np.sin(t), 0.5 * np.cos(2 * t), 0.3 * t], axis=1))
    fore = upper * Rotation.from_rotvec(np.stack([1 + np.sin(3 * t), 0 * t, 0 * t], axis=1))
    return [upper, fore]


def arm(noise, deviation, owners=(0, 1), steps=300):
    """Frames with noisy orientations, rad, and deviations of the markers, m; the true ones."""
    rng, segments = np.random.default_rng(3), turns(steps)
    along = [segment.apply([0.0, 0.0, 0.3]) for segment in segments]
    places = np.stack([np.zeros((steps, 3)), along[0], along[0] + along[1]], axis=1)
    true = np.stack([(segments[k] * AXES).as_quat() for k in owners], axis=1)
    frames = []
    for k in range(steps):
        frame = Frame.empty(1, ARM, stamp=10**9 + k * 33_000_000)
        frame.ids[:] = 4
        frame.markers[0, :, :3] = places[k] + rng.normal(0, deviation, (3, 3))
        error = Rotation.from_rotvec(rng.normal(0, noise, (2, 3)))
        frame.links[0, :, ORIENTATION] = (error * Rotation.from_quat(true[k])).as_quat()
        known = np.full((1, 3), deviation)
        cameras = np.zeros((1, 3), np.int64)
        frames.append(frame.replace(uncertainty=Uncertainty(known, cameras, (), 0 * known)))
    return frames, true


def aligned(frames):
    return list(frames_of(align_blocks(map(Block.of, frames), ARM)))


def errors(frames, true):
    """(T, 2) rad."""
    return angle(np.array([frame.orientations[0] for frame in frames]), true)


@pytest.mark.parametrize("owners", [(0, 1), (0, 0), (1, 1)])
def test_noisy_links_turn_towards_their_bones(owners):
    """Also where a link has the orientation of the bone before or after it."""
    frames, true = arm(0.1, 0.003, owners)
    before, after = errors(frames, true)[60:], errors(aligned(frames), true)[60:]
    assert (after.mean(axis=0) < 0.7 * before.mean(axis=0)).all()


def test_bones_that_are_worse_known_than_links_turn_nothing():
    frames, true = arm(0.02, 0.03)
    before, after = errors(frames, true)[150:], errors(aligned(frames), true)[150:]
    assert after.mean() < 1.15 * before.mean()


def test_links_that_turn_with_no_bone_stay():
    frames, _ = arm(1.5, 0.003)
    assert all(map(same, aligned(frames), frames))


def test_markers_stay_and_the_given_frames_are_not_written_to():
    frames, _ = arm(0.1, 0.003)
    copies = [frame.replace(links=frame.links.copy()) for frame in frames]
    out = aligned(frames)
    assert all(map(same, frames, copies))
    for one, other in zip(out, frames, strict=True):
        np.testing.assert_array_equal(one.markers, other.markers)
        np.testing.assert_allclose(np.linalg.norm(one.orientations, axis=2), 1, atol=1e-9)


def test_blocks_change_nothing_and_absent_numbers_are_passed_over():
    frames, _ = arm(0.1, 0.003)
    for k in range(40, 60):
        frames[k].links[0, 0, ORIENTATION] = np.nan
        frames[k + 30].markers[0, 2] = np.nan
    whole = list(frames_of(align_blocks([join([Block.of(f) for f in frames])], ARM)))
    assert all(map(same, whole, aligned(frames)))
    assert np.isnan(whole[50].orientations[0, 0]).all()
    assert not np.isnan(whole[80].orientations[0]).any()


def test_a_model_without_links_passes():
    model = SkeletonModel.of(["a", "b"], [])
    frame = Frame.empty(1, model, stamp=10**9)
    (out,) = frames_of(align_blocks([Block.of(frame)], model))
    assert same(out, frame)
