"""Keypoints of videos become a log of RGB cameras."""

import json

import pytest

from hiros_mcap.errors import ConfigError
from hiros_mcap.io.joints.image_keypoints import import_keypoints

CAMERA = """[cam_0{}]
size = [640, 480]
matrix = [[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 3.0]
"""


def folder(tmp_path, name, n=3):
    """A folder of OpenPose's files of 17 joints."""
    (tmp_path / name).mkdir()
    person = {"pose_keypoints_2d": [v for j in range(17) for v in (100 + j, 200 + j, 0.9)]}
    for k in range(n):
        text = json.dumps({"people": [person]})
        (tmp_path / name / f"{name}_{k:06}.json").write_text(text)
    return tmp_path / name


def test_folders_and_a_calibration_become_a_log(tmp_path):
    (tmp_path / "Calib.toml").write_text(CAMERA.format(1) + CAMERA.format(2))
    sources = [folder(tmp_path, "cam1_json"), folder(tmp_path, "cam2_json")]
    (sources[0] / "cam1_json_000001.json").write_text("{")
    warnings = []
    written = import_keypoints(
        sources, tmp_path / "a.mcap", [tmp_path / "Calib.toml"], {"": 60.0}, warn=warnings.append
    )
    assert written["/cam_01/keypoints"] == 2
    assert written["/cam_02/keypoints"] == 3
    assert "1 file of 3 cannot be read" in warnings[0]
    with pytest.raises(ConfigError, match="Pass --rate"):
        import_keypoints(sources, tmp_path / "b.mcap", [tmp_path / "Calib.toml"], {})
