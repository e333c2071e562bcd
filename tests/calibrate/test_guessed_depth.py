"""Cameras whose 3D skeletons have a depth that the detector guesses are taken as rays."""

from __future__ import annotations

import numpy as np
import pytest
from rooms import simulated, write

from hiros_mcap.body.rotations import Rigid, from_vector
from hiros_mcap.config import load_config
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.logs import evaluate_log
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.io.container.live_input import McapInput
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.running.process_live import process_live

NAMES = ("camera_0", "camera_1", "camera_2")
AS_THEY_ARE = load_config(None, ["input.rays=none"])
FOUND = "the detector guesses depths"


@pytest.fixture(scope="module")
def scene():
    return simulated(cameras=3, seconds=6.0, seed=3)


@pytest.fixture(scope="module")
def poses(scene):
    return {camera.name: camera.pose for camera in scene.cameras}


def guessed(scene, names):
    """The detections, where these cameras guess each joint's depth, 6 % wrong for long."""
    rng = np.random.default_rng(1)
    model = scene.model
    factors = {name: 1.0 + 0.06 * rng.normal(size=(model.n_markers, 1)) for name in names}
    for frame in scene.detections:
        markers = frame.markers.copy()
        markers[:, :, :3] *= factors.get(frame.source, 1.0)
        yield frame.replace(markers=markers)


def run(path, scene, frames, poses, config=None):
    """Return the mean error, mm, and the summary."""
    out = path / "out.mcap"
    log = write(path / "log.mcap", list(frames), scene.model, poses)
    summary = process(log, out, config=config)
    truth = Truth.of(scene.truth)
    (result,) = evaluate_log(out, truth, ["/hiros/filtered"]).values()
    return result.scores.mean, summary


def test_only_directions_count_of_cameras_that_guess_depths(scene, poses, tmp_path):
    frames = [*guessed(scene, NAMES)]
    rays, summary = run(tmp_path, scene, frames, poses)
    skeletons, alone = run(tmp_path, scene, frames, poses, AS_THEY_ARE)
    assert rays < 0.4 * skeletons
    assert [camera.topic for camera in summary.cameras] == ["/rgb/skeletons"]
    assert sum(FOUND in note for note in summary.notes) == 1
    assert not any(FOUND in note for note in alone.notes)


def test_a_camera_may_look_along_any_axis_of_its_frame(scene, poses, tmp_path):
    turn = Rigid(from_vector(np.array([0.3, -1.4, 1.0])), np.zeros(3))
    frames = []
    for frame in guessed(scene, NAMES):
        markers = frame.markers.copy()
        markers[:, :, :3] = turn.moved(markers[:, :, :3])
        frames.append(frame.replace(markers=markers))
    there = {name: pose @ turn.inverse() for name, pose in poses.items()}
    straight, _ = run(tmp_path, scene, guessed(scene, NAMES), poses)
    turned, summary = run(tmp_path, scene, frames, there)
    assert turned == pytest.approx(straight, rel=0.1)
    assert any(FOUND in note for note in summary.notes)


@pytest.mark.parametrize("names", [(), ("camera_1",)])
def test_without_two_cameras_that_guess_all_stays_as_it_is(names, scene, poses, tmp_path):
    frames = [*guessed(scene, names)]
    found, summary = run(tmp_path, scene, frames, poses)
    as_they_are, _ = run(tmp_path, scene, frames, poses, AS_THEY_ARE)
    assert found == as_they_are
    assert len(summary.cameras) == 3


def test_poses_that_are_kept_leave_the_choice_of_rays(scene, poses, tmp_path):
    log = write(tmp_path / "log.mcap", list(guessed(scene, NAMES)), scene.model, poses)
    options = ProcessOptions(calibrate="off", stages="T")
    rays, alone = (process(log, config=c, options=options) for c in (None, AS_THEY_ARE))
    assert (len(rays.cameras), len(alone.cameras)) == (1, 3)


def test_a_wrong_pose_is_no_guess(scene, poses, tmp_path):
    tilted = Rigid(from_vector(np.array([0.0, 0.09, 0.0])), np.array([0.0, 0.0, 0.1]))
    wrong = poses | {"camera_1": poses["camera_1"] @ tilted}
    _, summary = run(tmp_path, scene, scene.detections, wrong)
    assert not any(FOUND in note for note in summary.notes)


def test_depths_that_are_guessed_are_told_where_rays_fail(scene, poses, tmp_path):
    """All cameras are turned by 5 degrees, so that nobody is where their rays meet."""
    turn = Rigid(from_vector(np.array([0.0, 0.087, 0.0])), np.zeros(3))
    turned = {name: pose @ turn.inverse() for name, pose in poses.items()}
    turned["camera_1"] = poses["camera_1"] @ turn
    _, summary = run(tmp_path, scene, guessed(scene, NAMES), turned)
    (warning,) = (text for text in summary.warnings if FOUND in text)
    assert "but the depths count, as triangulation failed: " in warning
    assert len(summary.cameras) == 3
    assert not any(FOUND in note for note in summary.notes)


def test_cameras_are_named_beforehand_by_name_or_topic(scene, poses, tmp_path):
    config = load_config(None, ['input.rays=["camera_0", "/camera_1/people"]'])
    _, summary = run(tmp_path, scene, scene.detections, poses, config)
    assert {c.topic for c in summary.cameras} == {"/rgb/skeletons", "/camera_2/people"}
    assert any("taken as rays, as input.rays says" in note for note in summary.notes)
    unknown = load_config(None, ['input.rays=["camera_7"]'])
    with pytest.raises(ConfigError, match="has no camera 'camera_7'"):
        process(tmp_path / "log.mcap", None, config=unknown)


def test_a_live_run_takes_the_named_cameras_as_rays(scene, poses, tmp_path):
    errors = []
    log = write(tmp_path / "log.mcap", list(guessed(scene, NAMES)), scene.model, poses)
    for rays in ("found", '["camera_0", "/camera_1/people", "camera_2"]'):
        config = load_config(None, [f"input.rays={rays}"], system="fuse-realtime")
        with log.open("rb") as source:
            live = McapInput(source.fileno(), "pipe")
            process_live(live, tmp_path / "live.mcap", config=config)
        results = evaluate_log(tmp_path / "live.mcap", Truth.of(scene.truth), ["/hiros/filtered"])
        errors += [result.scores.mean for result in results.values()]
    assert errors[1] < 0.5 * errors[0]


def test_given_poses_that_are_right_stay_where_bodies_are_guessed(scene, poses, tmp_path):
    _, summary = run(tmp_path, scene, guessed(scene, NAMES), poses)
    assert any("stay as given" in note for note in summary.notes)
    tilted = Rigid(from_vector(np.array([0.0, 0.04, 0.0])), np.zeros(3))
    off = poses | {"camera_1": poses["camera_1"] @ tilted}
    _, summary = run(tmp_path, scene, guessed(scene, NAMES), off)
    assert any("come from the people" in note for note in summary.notes)
