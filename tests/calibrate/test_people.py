"""Poses and clocks from the people in a log, from the log to the verdict."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from builders import moved as moved_by
from rooms import late, mirrored, simulated, write
from scipy.spatial.transform import Rotation

from hiros_cli.app import run
from hiros_mcap.body.rotations import Rigid, angle
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.body.transforms import read_extrinsics
from hiros_mcap.calibrate.camera_views import Sighting
from hiros_mcap.calibrate.joint_refinement import (
    Points,
    free_unknowns,
    normal_equations,
    residuals_of,
    standard_errors,
)
from hiros_mcap.calibrate.people import calibrate_people
from hiros_mcap.calibrate.sampling import Rig
from hiros_mcap.calibrate.survey import Survey, _seconds_with_people
from hiros_mcap.calibrate.verdict import GOOD, Evidence, weakness_of
from hiros_mcap.errors import LogError
from hiros_mcap.io.log import open_log
from hiros_mcap.running.pipeline import process
from hiros_mcap.wording import number

CLOCKS = {"camera_0": 0.0, "camera_1": 0.8, "camera_2": -1.3}
"""s by which the stamps are late."""


@pytest.fixture(scope="module")
def scene():
    return simulated(cameras=3, seed=3, action="eight")


@pytest.fixture(scope="module")
def nothing(scene, tmp_path_factory):
    """A log without transforms, of three cameras with wrong clocks."""
    frames = [late(frame, CLOCKS[frame.source]) for frame in scene.detections]
    return write(tmp_path_factory.mktemp("log") / "lab.mcap", frames, scene.model)


@pytest.fixture(scope="module")
def found(nothing):
    """The calibration from the people in that log."""
    return calibrated(nothing)


def calibrated(path):
    with open_log(path) as log:
        return calibrate_people(log)


def errors(scene, found):
    """Degrees and m of each camera in the first one's frame."""
    true = {camera.name: camera.pose for camera in scene.cameras}
    first = found.cameras[0]
    rows = []
    for camera in found.cameras[1:]:
        got = first.pose.inverse() @ camera.pose
        wanted = true[first.name].inverse() @ true[camera.name]
        off = float(np.linalg.norm(got.translation - wanted.translation))
        rows.append((float(np.degrees(angle(got.xyzw, wanted.xyzw))), off))
    return rows


def test_poses_and_clocks_from_nothing(scene, found):
    assert (found.verdict, found.gauge, found.fixed_frame) == ("good", "floor", "world")
    for degrees, metres in errors(scene, found):
        assert degrees < 0.7
        assert metres < 0.03
    for camera in found.cameras:  # the median clock, of camera_0, is taken for right
        assert camera.clock_s == pytest.approx(-CLOCKS[camera.name], abs=0.005)


def test_without_transforms_the_people_stand_on_the_floor(found):
    first = found.cameras[0].pose
    assert first.translation == pytest.approx([0.0, 0.0, 2.0], abs=0.08)
    level = [camera.pose.translation[2] for camera in found.cameras]
    assert level == pytest.approx([2.0] * 3, abs=0.15)


def test_a_detector_that_takes_left_for_right_does_not_matter(scene, tmp_path):
    mirror = symmetry_of(scene.model).mirror
    frames = [
        mirrored(frame, mirror) if frame.source == "camera_1" else frame
        for frame in scene.detections
    ]
    found = calibrated(write(tmp_path / "lab.mcap", frames, scene.model))
    assert found.verdict == "good"
    assert max(degrees for degrees, _ in errors(scene, found)) < 0.7


def test_cameras_that_see_people_one_after_the_other_give_no_pose(scene, tmp_path, capsys):
    frames = list(scene.detections)
    half = np.median([frame.stamp for frame in frames])
    apart = [
        frame
        for frame in frames
        if frame.source != "camera_2" and (frame.stamp < half) == (frame.source == "camera_0")
    ]
    log, target = write(tmp_path / "lab.mcap", apart, scene.model), tmp_path / "cameras.toml"
    assert run(["calibrate", "people", str(log), "-o", str(target)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "record 20 s of one or two people who walk about over 2 m or more where camera_1" in line
    assert not target.exists()


def test_a_camera_that_sees_nobody_leaves_the_others(scene, tmp_path):
    frames = [
        frame.select([]) if frame.source == "camera_0" else frame for frame in scene.detections
    ]
    found = calibrated(write(tmp_path / "lab.mcap", frames, scene.model))
    assert [camera.verdict for camera in found.cameras] == ["impossible", "good", "good"]
    assert found.verdict == "doubtful"
    assert found.reason.startswith("camera_0: sees nobody")
    assert found.cameras[0].pose is None


def test_another_person_in_each_camera_is_not_believed(scene, tmp_path):
    other = simulated(cameras=3, seed=502)
    frames = [frame for frame in scene.detections if frame.source == "camera_0"]
    frames += [frame for frame in other.detections if frame.source == "camera_1"]
    found = calibrated(write(tmp_path / "lab.mcap", frames, scene.model))
    assert {camera.verdict for camera in found.cameras} <= {"doubtful", "impossible"}


def test_who_walks_round_and_round_on_another_clock_may_be_a_stranger(tmp_path):
    round_and_round = simulated(cameras=2, seed=3, action="walk")
    for seconds, verdict in ((0.0, "good"), (0.8, "doubtful")):
        frames = [
            late(frame, seconds * (frame.source == "camera_1"))
            for frame in round_and_round.detections
        ]
        found = calibrated(write(tmp_path / "lab.mcap", frames, round_and_round.model))
        assert found.verdict == verdict, found.reason


def test_standard_errors_hold_where_errors_last():
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(20):
        seconds, joints = np.repeat(np.arange(60) / 2.0, 20), np.tile(np.arange(20), 60)
        truth = rng.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 4.0], (1200, 3))
        lasting = rng.normal(0, 0.01, (2, 20, 3))[:, joints]
        seen = truth + lasting + rng.normal(0, 0.005, (2, 1200, 3))
        points = Points(seconds, joints * 0, joints, seen, np.zeros_like(seen), np.ones((2, 1200)))
        free = free_unknowns(2, clocks=False)
        rig = Rig.alone(2)
        residuals = residuals_of(points, rig)
        hessian, slope = normal_equations(residuals, free)
        step = np.linalg.solve(hessian, slope)
        errors = standard_errors(residuals, points, free, rig)[0]
        ratios.append(step / errors[free])
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.3


def test_a_camera_that_a_moment_tells_has_no_standard_error():
    """Without that moment nothing tells its pose; rounding gave 1e20 mm."""
    rng = np.random.default_rng(0)
    seconds, joints = np.repeat(np.arange(60) / 2.0, 20), np.tile(np.arange(20), 60)
    seen = rng.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 4.0], (1200, 3))
    seen = seen + rng.normal(0, 0.01, (3, 1200, 3))
    weights = np.ones((3, 1200))
    weights[2, seconds > 1.9] = 0.0
    points = Points(seconds, joints * 0, joints, seen, np.zeros_like(seen), weights)
    rig, free = Rig.alone(3), free_unknowns(3, clocks=False)
    errors, people = standard_errors(residuals_of(points, rig), points, free, rig)
    assert (errors[:2, :6] < 0.005).all()
    assert np.isinf(errors[2, :6]).all()
    assert np.isinf(people)
    assert number(1000.0 * errors[2, 3], 0) == "-"
    sure = Evidence(share=1.0, residual=0.03, seconds=60.0, spread=1.0)
    assert weakness_of(sure, GOOD) == ""
    evidence = replace(sure, error_deg=np.inf, error_m=np.inf)
    assert "standard error is unknown" in weakness_of(evidence, GOOD)


def test_somebody_who_stands_still_tells_no_clock(scene, tmp_path):
    rng = np.random.default_rng(5)
    pose = next(scene.truth).markers
    cameras = {camera.name: camera for camera in scene.cameras}
    frames = []
    for frame in scene.detections:
        markers = np.full_like(frame.markers, np.nan)
        places = cameras[frame.source].points(pose[:, :, :3])
        markers[:, :, :3] = places + rng.normal(0, 0.005, (len(markers), *places.shape[1:]))
        frames.append(late(frame.replace(markers=markers), CLOCKS[frame.source] / 10))
    found = calibrated(write(tmp_path / "lab.mcap", frames, scene.model))
    assert found.verdict != "impossible"
    assert max(degrees for degrees, _ in errors(scene, found)) < 0.7
    assert all(np.isnan(camera.clock_s) for camera in found.cameras)


def test_a_second_counts_in_which_two_cameras_see_somebody():
    some, none = np.zeros((1, 1, 3)), np.zeros((0, 1, 3))
    seen = {
        "left": [Sighting(at, some, some[..., 0]) for at in (-0.9, 0.0, 0.99, 2.5)],
        "right": [Sighting(at, some, some[..., 0]) for at in (-0.1, 0.5, 1.0)],
    }
    assert _seconds_with_people(seen) == 2
    blind = [Sighting(at, none, none[..., 0]) for at in (1.5, 2.6)]
    assert _seconds_with_people({**seen, "blind": blind}) == 2
    assert _seconds_with_people({**seen, "third": seen["left"]}) == 3


@pytest.mark.parametrize("hours", [-1, 1])
def test_what_a_camera_stamps_at_quite_another_time_is_compared_with_nobody(hours, scene, tmp_path):
    ns = hours * 3600 * 10**9
    frames = [
        f.replace(stamp=f.stamp + ns, stamps=f.stamps + ns) if f.source == "camera_2" else f
        for f in scene.detections
    ]
    with open_log(write(tmp_path / "log.mcap", frames, scene.model)) as log:
        sightings = Survey(log, fixed=False).sightings({})
    assert [name for name, some in sorted(sightings.items()) if some] == ["camera_0", "camera_1"]


def test_one_camera_is_refused(scene, tmp_path):
    frames = [frame for frame in scene.detections if frame.source == "camera_0"]
    with pytest.raises(LogError, match="one camera only"):
        calibrated(write(tmp_path / "lab.mcap", frames, scene.model))


def test_cameras_in_one_frame_are_refused_where_people_are_at_one_place_in_it(scene, tmp_path):
    true = {camera.name: camera.pose for camera in scene.cameras}
    frames = [
        moved_by([frame.replace(frame_id="lab")], Rotation.from_quat(pose.xyzw), pose.translation)
        for frame in scene.detections
        for pose in [true[frame.source]]
    ]
    frames = [frame for some in frames for frame in some]
    with pytest.raises(LogError, match=r"same frame 'lab', so their poses are already applied"):
        calibrated(write(tmp_path / "lab.mcap", frames, scene.model))


@pytest.mark.parametrize("transforms", ["none", "of the frame"])
def test_cameras_in_one_frame_get_poses_that_process_takes(transforms, scene, tmp_path):
    """From a log of one frame to right results: the file names the channels."""
    frames = [frame.replace(frame_id="depth") for frame in scene.detections]
    given = {"depth": Rigid.identity()} if transforms == "of the frame" else None
    log, file = write(tmp_path / "lab.mcap", frames, scene.model, given), tmp_path / "rig.toml"
    assert run(["calibrate", "people", str(log), "-o", str(file)]) == 0
    assert 'frame = "camera_1/people"' in file.read_text()
    with open_log(log, extrinsics=file) as opened:
        poses = [opened.pose_of(camera) for camera in opened.cameras]
    true = [camera.pose for camera in scene.cameras]
    for k in (1, 2):
        found, wanted = (rig[0].inverse() @ rig[k] for rig in (poses, true))
        metres, degrees = found.apart(wanted)
        assert metres < 0.04
        assert degrees < 0.7
    out = tmp_path / "out.mcap"
    arguments = ["process", str(log), "-q", "-o", str(out), "--extrinsics", str(file)]
    assert run([*arguments, "--stages", "T"]) == 0


def test_a_camera_that_defines_the_frame_of_others_stays_there(scene, tmp_path):
    true = {camera.name: camera.pose for camera in scene.cameras}
    joined = {"camera_1": true["camera_0"].inverse() @ true["camera_1"]}
    frames = list(scene.detections)
    log = write(tmp_path / "lab.mcap", frames, scene.model, joined, "camera_0")
    file = tmp_path / "rig.toml"
    assert run(["calibrate", "people", str(log), "-o", str(file)]) == 0
    assert read_extrinsics(file).root("camera_2") == "camera_0"
    summary = process(log, tmp_path / "out.mcap", stages="T")
    assert [camera.used for camera in summary.poses] == [True] * 3


def test_a_log_without_transforms_is_processed_with_the_poses_found(nothing, tmp_path, capsys):
    target, out = tmp_path / "cameras.toml", tmp_path / "out.mcap"
    assert run(["calibrate", "people", str(nothing), "-o", str(target)]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in (*CLOCKS, "Clock ms", "Residual mm", "z is up"))
    assert read_extrinsics(target).frames == ["camera_0", "camera_1", "camera_2", "world"]
    assert "[clock]" in target.read_text()
    arguments = ["process", str(nothing), "-o", str(out), "-q", "--extrinsics", str(target)]
    assert run([*arguments, "--stages", "T"]) == 0


def test_json_has_poses_clocks_and_errors(nothing, capsys):
    assert run(["calibrate", "people", str(nothing), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["verdict"] == "good"
    for camera in data["cameras"]:
        assert len(camera["translation"]) == 3
        assert len(camera["quaternion_xyzw"]) == 4
        assert camera["clock_s"] == pytest.approx(-CLOCKS[camera["name"]], abs=0.005)
    assert data["joints"]["PELVIS"] < 60.0
