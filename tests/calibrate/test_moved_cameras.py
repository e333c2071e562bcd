"""A camera that was moved in the middle of a log, in a run of hiros process."""

from __future__ import annotations

import numpy as np
import pytest
from rooms import simulated, write

from hiros_cli.app import run
from hiros_mcap.body.rotations import Rigid, angle, from_vector
from hiros_mcap.body.transforms import pose_arrays
from hiros_mcap.calibrate import survey
from hiros_mcap.config import load_config
from hiros_mcap.events import events_from_json
from hiros_mcap.io.channels import EVENTS_ATTACHMENT
from hiros_mcap.io.log import open_log
from hiros_mcap.kernels.people_rows import move_messages
from hiros_mcap.running.pipeline import ProcessOptions, process

STEP = Rigid(from_vector(np.radians([3.0, -4.0, 0.0])), np.array([0.16, 0.0, 0.12]))
"""5 degrees and 20 cm, in the camera's own frame."""
FAR = Rigid(from_vector(np.radians([10.0, -30.0, 0.0])), np.array([0.8, 0.0, 0.6]))
"""Afterwards nobody is within reach of where the other cameras see him."""
AT_S = 10.6
FIRST_STAGE = ProcessOptions(stages="T")
"""Poses and clocks are found before it; the other stages would take most of the time."""


@pytest.fixture(scope="module")
def scene():
    return simulated(cameras=3, seed=8, action="eight", seconds=20.0, rig={"rate": 12.0})


@pytest.fixture(scope="module")
def healthy(scene):
    return list(scene.detections)


def moved(frame, start, step=STEP, at_s=AT_S):
    """The frame of a camera that somebody moves."""
    if frame.source != "camera_2" or frame.stamp < start + at_s * 1e9:
        return frame
    people = frame.people.copy()
    move_messages(pose_arrays([step.inverse()]), np.array([[0, len(people.ids)]]), people)
    return frame.replace(people=people)


def logged(path, scene, frames):
    return write(path, frames, scene.model, {c.name: c.pose for c in scene.cameras})


@pytest.fixture(scope="module")
def log(scene, healthy, tmp_path_factory):
    start = min(frame.stamp for frame in healthy)
    frames = [moved(frame, start) for frame in healthy]
    return logged(tmp_path_factory.mktemp("moved") / "lab.mcap", scene, frames)


@pytest.fixture(scope="module")
def done(log):
    out = log.with_name("out.mcap")
    return process(log, out), out


def people(path):
    """Stamp -> markers of the only person."""
    with open_log(path, topics=["/hiros/filtered"], output_prefix="/none") as result:
        return {f.stamp: f.positions[0] for f in result.frames() if f.n_people == 1}


def distance(one, other):
    """Mean distance of the joints of two results, m."""
    a, b = people(one), people(other)
    both = sorted(a.keys() & b.keys())
    assert len(both) > 0.9 * len(a)
    return float(np.nanmean([np.linalg.norm(a[t] - b[t], axis=1) for t in both]))


def test_each_part_of_the_log_gets_its_own_pose(log, done, scene, healthy, tmp_path):
    never, off = tmp_path / "never.mcap", tmp_path / "off.mcap"
    process(logged(tmp_path / "lab.mcap", scene, healthy), never)
    process(log, off, options=ProcessOptions(calibrate="off"))
    assert distance(done[1], never) < 0.003 < 0.005 < distance(off, never)


def test_a_run_that_does_not_look_for_moved_cameras_finds_none(log, tmp_path):
    config = load_config(named={"test": {"input": {"moved": False}}})
    found = process(log, tmp_path / "out.mcap", config=config, options=FIRST_STAGE)
    assert all(np.isnan([pose.since_s, pose.until_s]).all() for pose in found.poses)


@pytest.mark.parametrize("at_s", [6.5, 12.0, 14.0])
def test_a_camera_that_was_moved_far_gets_both_poses(scene, healthy, tmp_path, at_s):
    start = min(frame.stamp for frame in healthy)
    frames = [moved(frame, start, FAR, at_s) for frame in healthy]
    summary = process(logged(tmp_path / "lab.mcap", scene, frames), options=FIRST_STAGE)
    before, after = summary.poses[2:]
    assert before.until_s == after.since_s == pytest.approx(at_s, abs=0.25)
    assert after.moved_mm == pytest.approx(1000, abs=50)


def test_a_move_is_found_where_clocks_are_not_corrected(log, tmp_path):
    config = load_config(named={"test": {"input": {"clocks": "off"}}})
    found = process(log, tmp_path / "out.mcap", config=config, options=FIRST_STAGE)
    assert found.poses[2].until_s == pytest.approx(AT_S, abs=0.25)


def test_the_summary_names_camera_and_time(done):
    before, after = done[0].poses[2:]
    assert (before.name, after.name) == ("camera_2", "camera_2")
    assert before.until_s == after.since_s == pytest.approx(AT_S, abs=0.25)
    assert np.isnan([before.since_s, after.until_s]).all()
    assert (after.moved_deg, after.moved_mm) == (
        pytest.approx(5, abs=0.3),
        pytest.approx(200, abs=20),
    )
    (warning,) = done[0].warnings
    assert warning.startswith("camera_2 was moved by 20 cm and ")
    assert len(done[0].to_dict()["poses"]) == 4


def test_the_result_holds_both_poses_and_an_event(done, scene):
    with open_log(done[1]) as log:
        early, late = (log.transforms.lookup("camera_2", "lab", t, t) for t in log.span)
        events = events_from_json((log.reader.attachment(EVENTS_ATTACHMENT) or b"").decode())
    true = scene.cameras[2].pose
    for pose, wanted in ((early, true), (late, true @ STEP)):
        assert np.degrees(angle(pose.xyzw, wanted.xyzw)) < 0.4
        assert np.linalg.norm(pose.translation - wanted.translation) < 0.03
    (event,) = (event for event in events if event.kind == "camera moved")
    assert (event.source, event.is_warning) == ("camera_2", True)


def test_the_viewer_draws_both_poses(done):
    import rerun.chunk

    drawn = done[1].with_suffix(".rrd")
    assert run(["view", str(done[1]), "--save", str(drawn), "--quiet"]) == 0
    chunks = rerun.chunk.RrdReader(str(drawn)).stream().to_chunks()
    paths = {chunk.entity_path.replace("\\", "") for chunk in chunks}
    name = f"camera_2 from {done[0].poses[3].since_s:.1f} s"
    assert {"/world/cameras/camera_2", f"/world/cameras/{name}"} <= paths


def test_the_terminal_lists_both_parts(log, capsys):
    assert run(["process", str(log), "-o", str(log.with_name("again.mcap")), "--stages", "T"]) == 0
    printed = capsys.readouterr()
    assert "camera_2 to 10." in printed.out
    assert "camera_2 from 10." in printed.out
    assert "hiros: warning: camera_2 was moved" in printed.err


def test_of_two_cameras_the_second_was_moved(scene, healthy, tmp_path):
    """Nobody else tells which one it was."""
    start = min(frame.stamp for frame in healthy)
    frames = [moved(frame, start, FAR) for frame in healthy if frame.source != "camera_1"]
    summary = process(logged(tmp_path / "log.mcap", scene, frames), options=FIRST_STAGE)
    assert [one.name for one in summary.poses] == ["camera_0", "camera_2", "camera_2"]
    assert summary.poses[1].until_s == pytest.approx(AT_S, abs=0.25)


def test_the_time_is_found_in_parts_of_the_log_that_were_not_read_at_first(log, done, monkeypatch):
    monkeypatch.setattr(survey, "MOST_S", 17.0)
    monkeypatch.setattr(survey, "STRETCHES", 2)  # 0.75 to 9.25 s, and 10.75 to 19.25 s
    summary = process(log, options=FIRST_STAGE)
    assert summary.poses[2].until_s == pytest.approx(AT_S, abs=0.25)


def test_the_time_is_that_of_the_log_though_the_clock_is_ahead(scene, healthy, tmp_path):
    ahead_ns, start = 1_500_000_000, min(frame.stamp for frame in healthy)
    frames = [
        f.replace(stamp=f.stamp + ahead_ns, stamps=f.stamps + ahead_ns)
        if f.source == "camera_2"
        else f
        for f in (moved(frame, start) for frame in healthy)
    ]
    summary = process(logged(tmp_path / "log.mcap", scene, frames), options=FIRST_STAGE)
    assert [one.name for one in summary.poses[2:]] == ["camera_2", "camera_2"]
    assert summary.poses[2].until_s == pytest.approx(AT_S, abs=0.25)


@pytest.mark.parametrize("first", [True, False])
def test_somebody_who_stands_still_is_no_camera_that_was_moved(first, scene, healthy, tmp_path):
    middle = min(frame.stamp for frame in healthy) + 10_000_000_000
    frozen = {f.source: f for f in healthy if f.n_people == 1 and f.stamp < middle}
    rng = np.random.default_rng(3)
    frames = []
    for frame in healthy:
        if (frame.stamp < middle) == first and frame.n_people == 1:
            markers = frozen[frame.source].markers.copy()
            markers[:, :, :3] += rng.normal(0.0, 0.007, markers[:, :, :3].shape)
            frame = frozen[frame.source].replace(
                stamp=frame.stamp, log_time=frame.log_time, stamps=frame.stamps, markers=markers
            )
        frames.append(frame)
    summary = process(logged(tmp_path / "log.mcap", scene, frames))
    assert len(summary.poses) == 3
    assert summary.warnings == ()
