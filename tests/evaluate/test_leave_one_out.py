"""A log without truth, against itself."""

from __future__ import annotations

import numpy as np
import pytest
from builders import FAULTLESS
from stick_figures import MODEL, at, person, seen

from hiros_cli.app import run
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.leave_one_out import leave_one_out
from hiros_mcap.evaluate.logs import consistency
from hiros_mcap.running.pipeline import ProcessOptions
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.simulate.simulation import write_log


def write_cameras(path, params, moved, metres):
    """Write the poses of cameras, one of them so many metres too high."""
    blocks = []
    for name, pose in simulate(params).transforms.items():
        shift = np.array([0.0, 0.0, metres if name == moved else 0.0])
        blocks.append(f"""[[camera]]
            frame = "{name}"
            parent = "world"
            translation = {(pose.translation + shift).tolist()}
            quaternion_xyzw = {pose.xyzw.tolist()}""")
    path.write_text("\n".join(blocks))


def test_a_shifted_camera_is_the_one_that_disagrees(tmp_path):
    """Without faults every camera agrees; one whose published pose is wrong stands out."""
    log = tmp_path / "log.mcap"
    faultless = {"noise": 0.0, "occlusion": 0.0, "flips": 0.0, "dropouts": 0.0, "phantoms": 0.0}
    params = {"people": 1, "cameras": 4, "seconds": 3, "action": "walk", "clock_jitter": 0.0}
    write_log(log, SimulateParams.model_validate({**faultless, **params, "calibration_error": 0}))
    clean = leave_one_out(log)
    assert [c.topic for c in clean.cameras] == [f"/camera_{k}/skeletons" for k in range(4)]
    assert all(c.distance.median < 10 and c.offset < 5 for c in clean.cameras)
    assert all(c.unmatched == c.mirrored == 0 for c in clean.cameras)
    write_log(log, SimulateParams.model_validate({**faultless, **params, "calibration_error": 10}))
    assert leave_one_out(log).cameras[0].offset > 2 * clean.cameras[0].offset


def test_the_camera_left_out_is_in_nothing_it_is_compared_with(tmp_path):
    """Four cameras without faults, one said to stand 10 cm off: it is 10 cm off, not less."""
    log, extrinsics = tmp_path / "log.mcap", tmp_path / "cameras.toml"
    faultless = {**FAULTLESS, "people": 1, "cameras": 4, "seconds": 2, "action": "wave"}
    params = SimulateParams.model_validate(faultless)
    write_log(log, params)
    write_cameras(extrinsics, params, "camera_3", 0.1)
    *_, shifted = leave_one_out(log, options=ProcessOptions(extrinsics=extrinsics)).cameras
    assert shifted.distance.median == pytest.approx(100, abs=3)
    assert shifted.offset == pytest.approx(100, abs=3)
    assert shifted.spread < 10


def test_mirrored_detections_count_as_they_are(tmp_path):
    """To strike out what contradicts a result would flatter the result that is wrong."""
    log = tmp_path / "log.mcap"
    flipping = {"flips_per_minute": 40.0, "flip_seconds": (0.2, 0.6), "reversal_share": 0.0}
    faultless = {**FAULTLESS, "people": 1, "cameras": 3, "seconds": 4, "action": "walk"}
    params = {**faultless, "flips": 1.0, "detector": flipping}
    write_log(log, SimulateParams.model_validate(params))
    cameras = [c for c in leave_one_out(log).cameras if c.mirrored > 0.06 * c.detections]
    assert cameras
    for each in cameras:
        assert each.distance.percentile_95 > 100
        assert each.distance.count > 31 * (each.detections - each.unmatched)
        assert each.distance.median < 15


def test_rgb_cameras_are_compared_with_the_result_in_their_images(tmp_path):
    """Two depth cameras and an RGB camera without faults; then its pose is said to be elsewhere."""
    log, rig = tmp_path / "log.mcap", {"kinds": ("depth", "depth", "rgb")}
    scene = {**FAULTLESS, "people": 2, "cameras": 3, "seconds": 2, "action": "cross", "rig": rig}
    params = SimulateParams.model_validate(scene)
    write_log(log, params)
    (clean,) = leave_one_out(log).images
    assert clean.topic == "/camera_2/keypoints"
    assert clean.result.unmatched <= 2  # an image before the first result
    assert clean.result.distance.median < 2
    assert set(clean.result.joints) > {"left_wrist", "right_ankle", "nose"}
    options = ProcessOptions(extrinsics=tmp_path / "cameras.toml")
    write_cameras(options.extrinsics, params, "camera_2", 0.2)
    scores = leave_one_out(log, options=options)
    assert scores.images[0].result.distance.median > 30
    assert len(scores.cameras) == 2


def test_two_cameras_are_needed(walking):
    with pytest.raises(ConfigError, match="at least two cameras"):
        leave_one_out(walking, options=ProcessOptions(topics=("/camera_0/*",)))


def test_the_result_alone():
    """Limbs that do not change, an id that lives for 29 frames, one joint that shakes by 2 cm."""
    frames = [seen([person()], at(k), ids=[4]) for k in range(30)]
    for k, frame in enumerate(frames):
        frame.positions[0, 1, 2] += 0.01 * (-1) ** k
    own = consistency(frames, MODEL)
    assert [(p.id, p.frames) for p in own.people] == [(4, 30)]
    assert own.people[0].seconds == pytest.approx(29 / 30, abs=1e-3)
    assert own.jitters["NECK"] == pytest.approx(40)
    assert own.jitter == pytest.approx(40 / 8)
    assert own.limbs["HIP_LEFT"] == pytest.approx(0, abs=1e-12)
    assert own.limbs["NECK"] == pytest.approx(0.01 / 0.5)
    assert np.isclose(own.limb_variation, np.mean(list(own.limbs.values())))


def test_each_rgb_camera_is_left_out_of_what_it_is_compared_with(tmp_path, capsys):
    """A camera is nearer to a result that it has a part in: its own noise is in both."""
    log = tmp_path / "log.mcap"
    scene = {**FAULTLESS, "people": 1, "cameras": 4, "seconds": 2, "rig": {"kinds": ("rgb",)}}
    write_log(log, SimulateParams.model_validate({**scene, "noise": 1.0}))
    scores = leave_one_out(log)
    assert len(scores.images) == 4
    assert not scores.cameras
    for camera in scores.images:
        assert camera.left_out is not None
        assert camera.left_out.detections == camera.result.detections
        assert camera.left_out.distance.median > camera.result.distance.median  # its own noise
        assert camera.left_out.distance.median < 20
    assert run(["eval", str(log), "--leave-one-out"]) == 0
    printed = capsys.readouterr()
    assert "Left out: median" in printed.out
    assert "not read" not in printed.err
