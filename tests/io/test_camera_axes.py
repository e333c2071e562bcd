"""Detections in another unit or with left-handed axes, and the options that mend them."""

from __future__ import annotations

import numpy as np
import pytest
from odd_logs import changed, poses_of, scaled

from hiros_cli.app import run as command
from hiros_mcap.io.detectors.conversion import Selection
from hiros_mcap.io.joints.mapping import FileMapping
from hiros_mcap.io.log import open_log


def in_camera(frame, factors, camera=""):
    """A frame with other numbers, if it is of the camera; "" = of any."""
    return scaled(frame, np.array(factors)) if frame.source.startswith(camera) else frame


def positions(path, **selection):
    with open_log(path, skeletons=Selection(**selection)) as log:
        return [frame.positions for frame in log.frames()]


@pytest.mark.parametrize("camera", ["", "camera_1"])
@pytest.mark.parametrize(
    ("factors", "selection"), [((1e3,) * 3, {"unit": "mm"}), ((1, -1, 1), {"negate": "y"})]
)
def test_a_unit_or_a_sign_is_mended_for_all_or_for_one(
    camera, factors, selection, crossing, tmp_path
):
    log = changed(crossing, tmp_path / "log.mcap", lambda f, _: in_camera(f, factors, camera))
    prefix = f"{camera}=" if camera else ""
    mended = positions(log, **{name: prefix + value for name, value in selection.items()})
    for one, other in zip(mended, positions(crossing), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_the_unit_of_one_camera_is_named(crossing, tmp_path, capsys):
    log = changed(crossing, tmp_path / "log.mcap", lambda f, _: in_camera(f, 1e3, "camera_1"))
    assert command(["info", str(log)]) == 0
    assert "with --unit /camera_1/skeletons=mm" in capsys.readouterr().err
    assert command(["process", "-q", str(log), "--unit", "/camera_1/skeletons=mm"]) == 0
    assert "--unit" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "fault"),
    [("--unit=left=mm", "there is no camera 'left'"), ("--negate=w", "x, y, z")],
)
def test_options_that_mean_nothing_are_refused(option, fault, crossing, capsys):
    assert command(["process", str(crossing), option]) == 2
    assert fault in capsys.readouterr().err


def test_a_left_handed_file_is_imported_with_a_sign_changed():
    points = np.array([[1.0, 2.0, 3.0]])
    mapping = FileMapping(axes=["x", "-z", "y"], negate="x")
    assert mapping.rotated(points).tolist() == [[-1.0, -3.0, 2.0]]


def test_a_file_with_poses_may_negate_an_axis(crossing, tmp_path):
    flip = (-1.0, 1.0, 1.0)
    log = changed(crossing, tmp_path / "log.mcap", lambda f, _: in_camera(f, flip, "camera_1"))
    entry = '[[camera]]\nframe = "{}"\ntranslation = {}\nquaternion_xyzw = {}\n{}\n'
    cameras = tmp_path / "cameras.toml"
    cameras.write_text(
        "".join(
            entry.format(child, list(place), list(turn), 'negate = "x"' * (child == "camera_1"))
            for _, child, place, turn in poses_of(crossing)
        )
    )
    with open_log(log, extrinsics=cameras) as mended, open_log(crossing) as healthy:
        for one, other in zip(mended.detections(), healthy.detections(), strict=True):
            np.testing.assert_allclose(one.positions, other.positions, atol=1e-9)


def test_orientations_of_left_handed_axes_are_left_out(crossing):
    with open_log(crossing, skeletons=Selection(negate="x")) as log:
        frame = next(frame for frame in log.frames() if frame.n_people)
    assert np.isnan(frame.markers[:, :, 3:7]).all()
    assert np.isnan(frame.links[:, :, 3:7]).all()
