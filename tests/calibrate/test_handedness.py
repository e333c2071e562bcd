"""Cameras whose axes are left-handed are found, and nobody else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from odd_logs import changed, published, scaled

from hiros_cli.app import run as command
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.body.transforms import TransformTree
from hiros_mcap.calibrate.handedness import left_handed
from hiros_mcap.calibrate.people import calibrate_people
from hiros_mcap.calibrate.survey import Survey
from hiros_mcap.errors import LogError
from hiros_mcap.io.log import open_log

SIGNS = {"x": (-1, 1, 1), "y": (1, -1, 1), "z": (1, 1, -1)}


def negated(source, target, axis, camera=""):
    """Copy a log with an axis of a camera, or of all, negated."""

    def change(frame, _):
        return scaled(frame, np.array(SIGNS[axis])) if frame.source.startswith(camera) else frame

    return changed(source, target, change)


def said(path, *, fixed=True):
    with open_log(path) as log:
        return Survey(log, fixed=fixed).left_handed


@pytest.mark.parametrize("axis", SIGNS)
@pytest.mark.parametrize("camera", ["", "camera_2"])
def test_the_axis_and_the_option_are_named(axis, camera, crossing, tmp_path, capsys):
    log = negated(crossing, tmp_path / "log.mcap", axis, camera)
    cameras = camera or "camera_0, camera_1 and camera_2"
    option = f"/{camera}/skeletons={axis}" if camera else axis
    message = (
        f"the axes of {cameras} are left-handed: negate {axis} (--negate {option}, or input.negate"
    )
    assert command(["info", str(log)]) == 0
    assert message in capsys.readouterr().err
    assert command(["process", "-q", str(log), "-o", str(tmp_path / "out.mcap")]) == 2
    assert message in capsys.readouterr().err
    mended = ["process", "-q", str(log), "--negate", option, "-o", str(tmp_path / "out.mcap")]
    assert command(mended) == 0
    assert "left-handed" not in capsys.readouterr().err


@pytest.mark.parametrize("axis", SIGNS)
def test_without_poses_people_stand_upright_before_the_camera(axis, crossing, tmp_path):
    message = said(negated(crossing, tmp_path / "log.mcap", axis), fixed=False)
    assert f"left-handed: negate {axis} (--negate {axis}, or input.negate" in message


def test_info_says_it_of_a_log_without_poses(crossing, tmp_path, capsys):
    log = published(negated(crossing, tmp_path / "log.mcap", "y"), tmp_path / "bare.mcap", {})
    assert command(["info", str(log)]) == 0
    assert "left-handed: negate y (--negate y, or" in capsys.readouterr().err


@pytest.mark.parametrize("axis", SIGNS)
def test_a_camera_that_fits_nowhere_is_left_handed(axis, whole_crossing, tmp_path):
    log = negated(whole_crossing, tmp_path / "log.mcap", axis, "camera_2")
    with open_log(log) as opened:
        bare = replace(opened, transforms=TransformTree())
        with pytest.raises(LogError, match=f"axes of camera_2 are left-handed: negate {axis}"):
            calibrate_people(bare)


def test_runs_that_keep_poses_warn(crossing, tmp_path, capsys):
    log = negated(crossing, tmp_path / "log.mcap", "x")
    for options in (["--calibrate", "off"], ["--system", "fuse-realtime"]):
        assert command(["process", "-q", str(log), *options, "-o", str(tmp_path / "o.mcap")]) == 0
        assert "left-handed: negate x" in capsys.readouterr().err


@pytest.mark.parametrize("fixed", [True, False])
@pytest.mark.parametrize("name", ["crossing", "walking"])
def test_healthy_logs_are_silent(name, fixed, request):
    assert said(request.getfixturevalue(name), fixed=fixed) == ""


def test_names_that_are_exchanged_are_no_matter_of_axes(crossing, tmp_path):
    def exchanged(frame, _):
        return frame.replace(markers=np.ascontiguousarray(frame.markers[:, mirror]))

    with open_log(crossing) as log:
        mirror = symmetry_of(log.model).mirror
    assert said(changed(crossing, tmp_path / "log.mcap", exchanged)) == ""


def test_labels_that_are_wrong_from_behind_are_no_matter_of_axes(crossing):
    with open_log(crossing) as log:
        model, seen = log.model, Survey(log, fixed=False).seen["camera_1"]
    symmetry, up = symmetry_of(model), seen.positions[:, model.marker_names.index("NECK")]
    left, right = (seen.positions[:, symmetry.lateral[0, k]] for k in (0, 1))
    up = up - seen.positions[:, model.marker_names.index("PELVIS")]
    backs = (np.cross(left - right, up) * left).sum(axis=1) > 0  # away from the camera
    frames, mirror = np.ones(backs.sum(), np.int64), symmetry.mirror
    assert len(frames) > 20
    positions = seen.positions[backs][:, mirror]
    behind = seen._replace(stamps=frames, counts=frames, positions=positions)
    assert left_handed({"camera_1": behind}, {}, model).axes == {}
