"""Calibrations of other programs: each says the same of one camera."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hiros_mcap.body import rotations
from hiros_mcap.body.foreign_cameras import read_calibration
from hiros_mcap.body.transforms import read_extrinsics
from hiros_mcap.errors import ConfigError

TURN, PLACE = Rotation.from_rotvec([1.2, -0.4, 0.7]), np.array([2.0, -3.0, 1.5])
SHIFT = (-TURN.apply(PLACE)).tolist()
VECTOR, MATRIX = TURN.as_rotvec().tolist(), TURN.as_matrix().tolist()
LENS = "matrix = [[1400, 0, 960], [0, 1410, 540], [0, 0, 1]]\nsize = [1920, 1080]\n"
DISTORTION = [-0.1, 0.05, 0.001, 0.002, 0.01]
ANIPOSE = (
    f'[cam_0]\nname = "left"\n{LENS}distortions = {DISTORTION}\n'
    f"rotation = {VECTOR}\ntranslation = {SHIFT}\n[metadata]\nerror = 0.2\n"
)
CALISCOPE = (
    f'[cameras.0]\nname = "left"\n{LENS}distortions = {DISTORTION}\n'
    f"rotation = {MATRIX}\ntranslation = {SHIFT}\n"
)
ROS = f"""
image_width: 1920
image_height: 1080
camera_name: left
camera_matrix: {{rows: 3, cols: 3, data: [1400, 0, 960, 0, 1410, 540, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: {DISTORTION}}}
"""


def qualisys(turned=0):
    own = np.diag([1, -1, -1]) @ TURN.as_matrix()  # y up, z backwards
    axes = " ".join(f'r{i + 1}{j + 1}="{own[i, j]!r}"' for i in range(3) for j in range(3))
    place = " ".join(f'{axis}="{1000 * x}"' for axis, x in zip("xyz", PLACE, strict=True))
    lens = {"focalLengthU": 1400 * 64, "focalLengthV": 1410 * 64}
    lens |= {"centerPointU": 960 * 64, "centerPointV": 540 * 64}
    names = ["radial1", "radial2", "tangental1", "tangental2", "radial3"]
    lens |= {f"{n[:-1]}Distortion{n[-1]}": d for n, d in zip(names, DISTORTION, strict=True)}
    lens |= {"sensorMaxU": 1919 * 64, "sensorMaxV": 1079 * 64}
    lens = " ".join(f'{name}="{value}"' for name, value in lens.items())
    return (
        f'<calibration><cameras><camera serial="left" viewrotation="{turned}"><transform {axes} '
        f'{place}/><intrinsic {lens}/></camera><camera serial="markers"/></cameras></calibration>'
    )


FILES = {
    "calibration.toml": ANIPOSE,
    "camera_array.toml": CALISCOPE,
    "Calib.qca.txt": qualisys().replace("np.float64(", "").replace(")", ""),
    "left.yaml": ROS,
}


@pytest.mark.parametrize("name", FILES)
def test_a_camera_is_the_same_in_every_file(name, tmp_path):
    (tmp_path / name).write_text(FILES[name])
    (camera,) = read_calibration(tmp_path / name)
    lens = camera.lens
    assert (camera.name, lens.size, lens.model) == ("left", (1920, 1080), "plumb_bob")
    np.testing.assert_allclose(lens.matrix, [[1400, 0, 960], [0, 1410, 540], [0, 0, 1]])
    np.testing.assert_allclose(lens.distortion, DISTORTION)
    if name.endswith("yaml"):
        with pytest.raises(ConfigError, match="has no poses of cameras; it tells their lenses"):
            read_extrinsics(tmp_path / name)
        return
    pose = read_extrinsics(tmp_path / name).lookup("left", "world", 0)
    np.testing.assert_allclose(pose.translation, PLACE, atol=1e-9)
    np.testing.assert_allclose(rotations.to_matrix(pose.xyzw), TURN.inv().as_matrix(), atol=1e-9)


def test_a_fisheye_lens_has_four_coefficients(tmp_path):
    path = tmp_path / "calibration.toml"
    four = f"distortions = {DISTORTION[:4]}\nfisheye = true"
    path.write_text(ANIPOSE.replace(f"distortions = {DISTORTION}", four))
    (camera,) = read_calibration(path)
    assert (camera.lens.model, camera.lens.distortion.tolist()) == ("equidistant", DISTORTION[:4])


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("a.toml", ANIPOSE.replace("1410", "0"), "cam_0: has no focal lengths in px or no"),
        ("a.toml", ANIPOSE.replace("1410", "3"), "cam_0: has no focal lengths in px"),
        (
            "a.toml",
            ANIPOSE.replace("[-0.1", "[1e5"),
            "cam_0: has a distortion that cannot",
        ),
        ("a.qca.txt", FILES["Calib.qca.txt"].replace('"-0.1"', '"1e30"'), "left: has a distort"),
        ("a.yaml", ROS.replace("[-0.1", "[-1e5"), "a.yaml: has a distortion that cannot"),
        ("a.toml", ANIPOSE.replace("[1920, 1080]", "[1920]"), "size should be width and height"),
        (
            "a.toml",
            ANIPOSE.replace("[1400, 0, 960]", "[1400, 0, 0]").replace("[0, 0, 1]", "[960, 0, 1]"),
            "cam_0: has no focal lengths in px or no",
        ),
        (
            "a.toml",
            CALISCOPE.replace("rotation = [[", "rotation = [[-"),
            "0: its matrix is no rotat",
        ),
        (
            "a.qca.txt",
            FILES["Calib.qca.txt"].replace('r11="', 'r11="3'),
            "left: its matrix is no rotation",
        ),
        ("a.toml", ANIPOSE.replace("[0, 0, 1]", "[0, 1]"), "matrix should be 3 x 3 numbers"),
        ("a.toml", ANIPOSE.replace(", 0.01]", ", 0.01, 1]"), "should be 4, 5, 8, 12 or 14 numbers"),
        ("a.qca.txt", qualisys(90), "left: its video is turned by 90 degrees"),
        ("a.qca.txt", qualisys().replace("focalLengthU", "f"), "left: has no lens or no pose"),
        ("a.qca.txt", "<calibration>", "not a calibration of Qualisys"),
        ("a.qca.txt", '<!DOCTYPE c [<!ENTITY a "b">]><c/>', "it defines entities"),
        ("a.yaml", ROS.replace("image_width", "width"), "not a camera_info of ROS"),
        ("a.yaml", "a: [", "not YAML: line 1: expected the node"),
    ],
)
def test_a_faulty_calibration_is_one_line(name, text, fault, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=fault):
        read_calibration(tmp_path / name)
