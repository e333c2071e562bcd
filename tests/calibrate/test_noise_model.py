"""White noise by camera, joint, range and confidence."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_cli.app import run
from hiros_mcap.calibrate.noise import USUAL_POWER, measure_noise_model
from hiros_mcap.config import load_config, to_toml
from hiros_mcap.io.log import open_log
from hiros_mcap.running.observe import Stopwatch
from hiros_mcap.running.preparation import prepare, set_up
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.stages.fuse.fusion_noise import FusionNoise

MODEL = SkeletonModel.of(["HIP", "HAND"], [("arm", 0, 1)])


def standing(distance, seed, confidence=1.0):
    """One person in camera_0, whose hand is twice as noisy: 4 mm at 2 m, growing with r^1.5."""
    rng, frames = np.random.default_rng(seed), []
    guess = 3.0 if confidence < 0.5 else 1.0
    for k in range(400):
        frame = Frame.empty(1, MODEL, stamp=10**18 + k * 33_333_333, source="camera_0")
        sd = 0.004 * (distance / 2.0) ** 1.5 * guess * np.array([[1.0], [2.0]])
        place = [distance, 0.001 * k, 0.0]  # moves slowly
        frame.markers[0, :, :3] = place + sd * rng.normal(size=(2, 3))
        frame.marker_confidences[0] = confidence
        frames.append(frame.replace(ids=np.array([7])))
    return frames


def test_range_joint_and_confidence():
    frames = standing(1.5, 1) + standing(4.0, 2) + standing(2.0, 3, confidence=0.3)
    found = measure_noise_model(frames, MODEL, {"camera_0": np.zeros(3)})
    assert found.power == pytest.approx(1.5, abs=0.15)
    assert found.guessed == pytest.approx(3.0, rel=0.15)
    assert found.joints["HAND"] / found.joints["HIP"] == pytest.approx(2.0, rel=0.1)
    assert found.sigma * found.joints["HIP"] == pytest.approx(0.004, rel=0.15)


def test_one_range_does_not_tell_the_power():
    found = measure_noise_model(standing(2.0, 1), MODEL, {"camera_0": np.zeros(3)})
    assert found.power == USUAL_POWER
    assert np.isnan(found.guessed)


def test_a_camera_without_a_pose_tells_nothing():
    assert measure_noise_model(standing(2.0, 1), MODEL, {}).joints == {}


def test_between_cameras_the_range_cannot_be_told_from_the_camera():
    frames = [f.replace(source=f"camera_{k}") for k in (0, 1) for f in standing(2.0 + 2 * k, k)]
    places = {f"camera_{k}": np.zeros(3) for k in (0, 1)}
    assert measure_noise_model(frames, MODEL, places).power == USUAL_POWER


def test_cameras_are_compared_with_the_median_one():
    frames = [f.replace(source=f"camera_{k}") for k in range(3) for f in standing(2.0, k)]
    for frame in frames:
        if frame.source == "camera_2":
            frame.markers[:, :, :3] *= 2.0  # seen from 2 m, too, with twice the noise
    places = {f"camera_{k}": np.array([2.0 * (k == 2), 0.0, 0.0]) for k in range(3)}
    found = measure_noise_model(frames, MODEL, places).cameras
    assert found == pytest.approx({"camera_0": 1.0, "camera_1": 1.0, "camera_2": 4.0}, rel=0.15)


@pytest.fixture
def measured(tmp_path):
    frames = standing(1.5, 1) + standing(4.0, 2)
    text = measure_noise_model(frames, MODEL, {"camera_0": np.zeros(3)}).toml()
    (tmp_path / "noise.toml").write_text(text.replace("HIP", "PELVIS").replace("HAND", "HEAD"))
    return tmp_path / "noise.toml"


def test_fuse_reads_what_is_written(measured, walking):
    config = load_config(measured, system="fuse")
    with open_log(walking) as log:
        prepared = prepare(log, config, ProcessOptions("fuse"), Stopwatch())
        noise = set_up(prepared).noise
        pelvis, head = (log.model.marker_names.index(name) for name in ("PELVIS", "HEAD"))
        usual = FusionNoise.default(log.model)
        assert set_up(prepared, options=ProcessOptions("hiros")).noise is None
    assert np.sqrt(noise.joints[pelvis]) == pytest.approx(0.004, rel=0.15)
    assert np.sqrt(noise.joints[head] / noise.joints[pelvis]) == pytest.approx(2.0, rel=0.1)
    assert noise.power == pytest.approx(1.5, abs=0.15)
    assert noise.guessed == usual.guessed
    assert noise.cameras == {"camera_0": 1.0}


def test_the_table_comes_back_from_the_configuration(measured, tmp_path):
    config = load_config(measured, system="fuse")
    (tmp_path / "again.toml").write_text(to_toml(config))
    assert load_config(tmp_path / "again.toml").noise == config.noise


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[noise]\nsigm = 1.0", "there is no such key"),
        ("[noise]\njoints = 1.0", "joints should be a table"),
        ("[noise]\nsigma = -1.0", "noise.sigma"),
        ("[noise.joints]\nTAIL = 2.0", "the skeleton has no joint 'TAIL'"),
    ],
)
def test_a_faulty_table_is_refused(text, fault, walking, tmp_path, capsys):
    (tmp_path / "noise.toml").write_text(text)
    options = ["--system", "fuse", "--config", str(tmp_path / "noise.toml")]
    assert run(["process", str(walking), "-o", str(tmp_path / "out.mcap"), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert fault in line
    assert not (tmp_path / "out.mcap").exists()
