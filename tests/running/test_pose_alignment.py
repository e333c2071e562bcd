"""The cameras' poses of a run: refined from the people, found from nothing, or left alone."""

from __future__ import annotations

import re

import numpy as np
import pytest
from builders import moved
from odd_logs import later
from scipy.spatial.transform import Rotation

from hiros_cli.app import run
from hiros_mcap.body.rotations import Rigid, angle
from hiros_mcap.calibrate.survey import in_words, stretches
from hiros_mcap.calibrate.verdict import UNLINKED
from hiros_mcap.config import load_config
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.channels import add_skeleton_channel, add_static_poses
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.running.observe import Stopwatch
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.running.pose_alignment import PoseAlignment
from hiros_mcap.running.preparation import prepare, set_up
from hiros_mcap.running.summary import PoseSummary
from hiros_mcap.simulate import SimulateParams, simulate

NAMES = ("camera_0", "camera_1", "camera_2")
FIRST_STAGE = ProcessOptions(stages="T")
"""Poses and clocks are found before it; the other stages would take most of the time."""


def walk(rate):
    params = {"people": 1, "cameras": 3, "seconds": 12.0, "seed": 5, "rig": {"rate": rate}}
    return simulate(SimulateParams.model_validate(params))


@pytest.fixture(scope="module")
def scene():
    return walk(15.0)


@pytest.fixture(scope="module")
def detections(scene):
    return list(scene.detections)


@pytest.fixture(scope="module")
def true(scene):
    return {camera.name: camera.pose for camera in scene.cameras}


def turned(pose, degrees, metres):
    half = np.radians(degrees) / 2
    turn = Rigid(np.array([np.sin(half), 0.0, 0.0, np.cos(half)]), np.zeros(3))
    return Rigid((turn @ pose).xyzw, pose.translation + metres * np.eye(3)[1])


def write(path, scene, frames, poses, parents=None):
    encoder = Encoder(scene.model)
    with McapWriter(path) as writer:
        for name, pose in poses.items():
            parent = (parents or {}).get(name, "lab")
            add_static_poses(writer, {name: pose}, parent, frames[0].log_time)
        names = sorted({frame.source for frame in frames})
        topics = {name: add_skeleton_channel(writer, f"/{name}/people") for name in names}
        for frame in sorted(frames, key=lambda frame: frame.log_time):
            writer.write(topics[frame.source], frame.log_time, encoder.encode(frame))
        writer.commit()
    return path


def filtered(path):
    with open_log(path, topics=["/hiros/filtered"], output_prefix="/none") as log:
        return list(log.frames())


def poses_in(path):
    with open_log(path) as log:
        return {name: log.transforms.lookup(name, "lab", 0) for name in NAMES}


def apart(one, other):
    """Angle in degrees."""
    return float(np.degrees(angle(one.xyzw, other.xyzw)))


def assert_same(one, other):
    np.testing.assert_allclose(one.translation, other.translation, atol=1e-9)
    assert apart(one, other) < 1e-5


def verdicts(summary):
    return [camera.verdict for camera in summary.poses]


def test_a_camera_that_is_off_is_put_right_and_the_result_says_where_it_stands(
    scene, detections, true, tmp_path
):
    given = true | {"camera_2": turned(true["camera_2"], 3.0, 0.06)}
    log, out = write(tmp_path / "log.mcap", scene, detections, given), tmp_path / "out.mcap"
    summary = process(log, out, options=FIRST_STAGE)
    assert summary.poses[2].verdict == "improved"
    assert summary.poses[2].moved_deg == pytest.approx(3.0, abs=0.4)
    assert summary.poses[2].moved_mm == pytest.approx(60.0, abs=15.0)
    assert apart(poses_in(out)["camera_2"], true["camera_2"]) < 0.4
    assert apart(poses_in(out)["camera_0"], true["camera_0"]) < 0.4  # it does not drag the rig


def test_true_poses_stay_to_the_last_bit(scene, detections, true, tmp_path):
    log = write(tmp_path / "log.mcap", scene, detections, true)
    auto, off = tmp_path / "auto.mcap", tmp_path / "off.mcap"
    assert verdicts(process(log, auto)) == ["good"] * 3
    assert process(log, off, options=ProcessOptions(calibrate="off")).poses == ()
    for name in NAMES:
        assert_same(poses_in(auto)[name], poses_in(off)[name])
    for one, other in zip(filtered(auto), filtered(off), strict=True):
        np.testing.assert_array_equal(one.markers, other.markers)


def test_a_pose_is_replaced_in_the_frame_of_its_own_parent(scene, detections, true, tmp_path):
    tripod = Rigid(true["camera_1"].xyzw, np.array([0.0, 0.0, 0.1]))
    given = {name: turned(pose, 1.5, 0.0) for name, pose in true.items()}
    given |= {"tripod": tripod, "camera_1": tripod.inverse() @ given["camera_1"]}
    log = write(tmp_path / "log.mcap", scene, detections, given, {"camera_1": "tripod"})
    process(log, tmp_path / "out.mcap", options=FIRST_STAGE)
    with open_log(tmp_path / "out.mcap") as result:
        assert_same(result.transforms.lookup("tripod", "lab", 0), tripod)
    used = poses_in(tmp_path / "out.mcap")
    got = used["camera_0"].inverse() @ used["camera_1"]
    assert apart(got, true["camera_0"].inverse() @ true["camera_1"]) < 0.4


def test_a_camera_that_defines_the_fixed_frame_stays(scene, detections, true, tmp_path):
    inverse = true["camera_0"].inverse()
    given = {name: turned(inverse @ true[name], 2.0, 0.0) for name in NAMES[1:]}
    parents = dict.fromkeys(given, "camera_0")
    log = write(tmp_path / "log.mcap", scene, detections, given, parents)
    process(log, tmp_path / "out.mcap", options=FIRST_STAGE)
    with open_log(tmp_path / "out.mcap") as result:
        assert result.fixed_frame == "camera_0"
        found = result.transforms.lookup("camera_1", "camera_0", 0)
    assert apart(found, inverse @ true["camera_1"]) < 0.4


def test_a_short_log_keeps_its_poses(scene, detections, true, tmp_path):
    given = true | {"camera_2": turned(true["camera_2"], 3.0, 0.06)}
    some = [frame for frame in detections if frame.stamp < detections[0].stamp + 1e9]
    log = write(tmp_path / "log.mcap", scene, some, given)
    summary = process(log, tmp_path / "out.mcap", options=FIRST_STAGE)
    assert verdicts(summary) == ["doubtful"] * 3
    assert_same(poses_in(tmp_path / "out.mcap")["camera_2"], given["camera_2"])


def test_cameras_that_see_nobody_in_common_keep_their_poses(scene, detections, true, tmp_path):
    start = detections[0].stamp
    ours = [f for f in detections if int((f.stamp - start) // 4e9) == NAMES.index(f.source)]
    log = write(tmp_path / "log.mcap", scene, ours, true)
    summary = process(log, options=FIRST_STAGE)
    assert verdicts(summary) == ["impossible"] * 3
    assert "shares no view" in summary.poses[0].reason
    assert sum("if it should, its pose is wrong" in text for text in summary.notes) == 3
    assert summary.warnings == ()
    with pytest.raises(LogError, match="--calibrate require: camera_0: impossible"):
        process(log, options=ProcessOptions(calibrate="require"))


@pytest.mark.parametrize("given", [{}, dict.fromkeys(NAMES, Rigid.identity())])
def test_a_log_that_nobody_calibrated_is_processed(given, scene, detections, true, tmp_path):
    log, out = write(tmp_path / "log.mcap", scene, detections, given), tmp_path / "out.mcap"
    summary = process(log, out, options=FIRST_STAGE)
    assert verdicts(summary) == ["good"] * 3
    assert any("poses come from the people" in text for text in summary.warnings)
    assert summary.placement is None  # nothing says where the rig is
    with open_log(out) as result:
        fixed = result.fixed_frame
        one, other = (result.transforms.lookup(name, fixed, 0) for name in NAMES[:2])
    assert apart(one.inverse() @ other, true["camera_0"].inverse() @ true["camera_1"]) < 0.5


def test_two_cameras_at_one_place_are_named_and_the_peoples_rig_is_used(
    scene, detections, true, tmp_path
):
    given = true | {"camera_2": true["camera_1"]}
    log, out = write(tmp_path / "log.mcap", scene, detections, given), tmp_path / "out.mcap"
    summary = process(log, out, options=FIRST_STAGE)
    assert any("one pose for camera_1 and camera_2" in text for text in summary.warnings)
    used = poses_in(out)
    got = used["camera_1"].inverse() @ used["camera_2"]
    assert apart(got, true["camera_1"].inverse() @ true["camera_2"]) < 0.5


def test_every_second_message_may_be_empty(true, tmp_path):
    scene, seen = walk(20.0), []
    for name in NAMES:
        ours = [f for f in scene.detections if f.source == name]
        nobody = [f.replace(people=f.people.at(slice(0, 0))) for f in ours]
        seen += [pair[k % 2] for k, pair in enumerate(zip(nobody, ours, strict=True))]
    summary = process(write(tmp_path / "log.mcap", scene, seen, true))
    assert verdicts(summary) == ["good"] * 3
    assert summary.warnings == ()


def named(frames, frame_id):
    return [frame.replace(frame_id=frame_id) for frame in frames]


def test_clocks_are_found_where_all_detections_are_in_the_room(scene, detections, true, tmp_path):
    def clock(name):
        return 60_000_000 if name == "camera_1" else 0

    seen = [
        later(moved([f], Rotation.from_quat(pose.xyzw), pose.translation)[0], clock(f.source))
        for f in named(detections, "lab")
        for pose in [true[f.source]]
    ]
    summary = process(write(tmp_path / "log.mcap", scene, seen, {"tripod": Rigid.identity()}))
    assert verdicts(summary) == ["good"] * 3
    (text,) = summary.warnings
    assert re.search("clock of camera_1 is (59|60|61) ms ahead", text)
    (note,) = [text for text in summary.notes if "same frame" in text]
    assert note.startswith(
        "camera_0, camera_1 and camera_2 publish in the same frame 'lab' and see"
    )


def sharing_frames(detections, sharing, frame_id):
    """Detections in the cameras' own coordinates, of which some name one frame."""
    return [
        frame.replace(frame_id=frame_id) if frame.source in sharing else frame
        for frame in detections
    ]


def true_distances(poses, true):
    """How far the first two cameras are from each other, against the truth, m."""
    ways = [rig[0].inverse() @ rig[1] for rig in (poses, [true[name] for name in NAMES[:2]])]
    return float(np.linalg.norm(ways[0].translation - ways[1].translation))


@pytest.mark.parametrize(
    ("sharing", "frame_id", "given"),
    [
        (NAMES, "depth_camera_link", "own"),
        (NAMES, "depth_camera_link", "shared"),
        (NAMES, "lab", "own"),  # the fixed frame
        (NAMES, "camera_0", "none"),
        (NAMES[:2], "depth_camera_link", "own"),
        (NAMES[:2], "camera_0", "own"),
        (NAMES[:2], "depth_camera_link", "none"),
    ],
)
def test_cameras_in_one_frame_get_poses_and_a_frame_for_each_channel(
    sharing, frame_id, given, scene, detections, true, tmp_path
):
    poses = {"own": true, "shared": {frame_id: Rigid.identity()}, "none": {}}[given]
    log = write(tmp_path / "log.mcap", scene, sharing_frames(detections, sharing, frame_id), poses)
    out = tmp_path / "out.mcap"
    summary = process(log, out, options=FIRST_STAGE)
    (warning,) = [text for text in summary.warnings if "same frame" in text]
    assert warning.startswith(f"{in_words(sharing)} publish in the same frame {frame_id!r}, but")
    assert "camera_0/people, camera_1/people" in warning
    with open_log(out, topics=["/camera_*"]) as opened:
        found = [opened.pose_of(camera) for camera in opened.cameras[:2]]
    assert true_distances(found, true) < 0.05


def test_cameras_in_one_frame_are_an_error_where_the_people_tell_no_poses(
    scene, detections, true, tmp_path, capsys
):
    start = min(frame.log_time for frame in detections)
    short = [frame for frame in detections if frame.log_time < start + 4 * 10**9]
    log = write(tmp_path / "log.mcap", scene, sharing_frames(short, NAMES, "camera_0"), true)
    assert run(["process", str(log), "-o", str(tmp_path / "out.mcap")]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "publish in the same frame 'camera_0', but do not see the same people" in line
    assert "pass a pose for each topic with --extrinsics FILE" in line
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("system", ["fuse-realtime", "malaguti"])
def test_a_run_that_cannot_look_first_names_cameras_in_one_frame(
    system, scene, detections, true, tmp_path
):
    wrong = sharing_frames(detections, NAMES, "camera_0")
    log = write(tmp_path / "log.mcap", scene, wrong, true)
    options = ProcessOptions(system=system, calibrate="auto" if "real" in system else "off")
    (warning,) = [t for t in process(log, options=options).warnings if "same frame" in t]
    assert "but do not see the same people at the same place in it; set header.frame_id" in warning


def test_info_names_cameras_in_one_frame(scene, detections, true, tmp_path, capsys):
    wrong = sharing_frames(detections, NAMES[1:], "camera_1")
    log = write(tmp_path / "log.mcap", scene, wrong, true)
    assert run(["info", str(log)]) == 0
    error = capsys.readouterr().err
    assert "camera_1 and camera_2 publish in the same frame 'camera_1', but do not see" in error


@pytest.mark.parametrize("seconds", [4.5, 12.0])
def test_two_pairs_of_cameras_that_show_the_same_people_at_two_places_do_not_fit(seconds, tmp_path):
    """Two opposite ones of four are exchanged, so each pair agrees. 4.5 s do not mend that."""
    params = {"people": 1, "cameras": 4, "seconds": 12.0, "seed": 5, "rig": {"rate": 15.0}}
    four = simulate(SimulateParams.model_validate(params))
    first, *_ = frames = list(four.detections)
    true = {camera.name: camera.pose for camera in four.cameras}
    given = true | {"camera_0": true["camera_2"], "camera_2": true["camera_0"]}
    some = [frame for frame in frames if frame.stamp < first.stamp + seconds * 1e9]
    log, out = write(tmp_path / "log.mcap", four, some, given), tmp_path / "out.mcap"
    summary = process(log, out, options=FIRST_STAGE)
    assert any("fit the" in text for text in summary.warnings)
    assert len(summary.people) == 1


def test_one_pose_for_all_cameras_counts_as_none(tmp_path):
    given = dict.fromkeys(NAMES, Rigid.identity())
    _, log = in_place(tmp_path, given, action="squat", seconds=12.0)
    with pytest.raises(LogError, match=r"at the same place .*; record 20 s of one or two people"):
        process(log)


def test_a_camera_that_shows_somebody_else_keeps_its_pose_and_is_named(
    scene, detections, true, tmp_path
):
    """Only where all cameras are at one place are some left out without a word of the user."""
    params = {"people": 1, "cameras": 3, "seconds": 12.0, "seed": 9, "rig": {"rate": 15.0}}
    other = simulate(SimulateParams.model_validate(params))
    frames = [f for f in detections if f.source != "camera_2"]
    frames += [f for f in other.detections if f.source == "camera_2"]
    log = write(tmp_path / "log.mcap", scene, frames, true)
    summary = process(log, options=FIRST_STAGE)
    assert verdicts(summary) == ["good", "good", "impossible"]
    assert [camera.name for camera in summary.cameras] == list(NAMES)
    assert any(w.startswith("camera_2: its pose does not fit") for w in summary.warnings)


def in_place(tmp_path, given=None, **params):
    """A log of somebody who stays in place; without poses unless some are given."""
    settings = {"people": 1, "cameras": 3, "seed": 4, "rig": {"rate": 15.0}, **params}
    scene = simulate(SimulateParams.model_validate(settings))
    return scene, write(tmp_path / "log.mcap", scene, list(scene.detections), given or {})


def test_a_usable_rig_is_used_and_a_warning_says_how_exact_it_is(tmp_path):
    scene, log = in_place(tmp_path, action="walk", seconds=7.5)
    summary = process(log, tmp_path / "out.mcap", options=FIRST_STAGE)
    assert set(verdicts(summary)) == {"usable"}
    (text,) = (text for text in summary.warnings if "usable only" in text)
    assert "expect joints to be " in text
    assert "s of one or two people who walk about over 2 m or more where camera_" in text
    # The test of displaced cameras allows for it.
    with open_log(log) as unposed:
        config, options = load_config(), ProcessOptions()
        errors = set_up(prepare(unposed, config, options, Stopwatch())).known.errors
    assert errors == pytest.approx({c.name: c.error_mm / 1000 for c in summary.poses})
    with open_log(tmp_path / "out.mcap") as result:
        one, other = (result.transforms.lookup(name, result.fixed_frame, 0) for name in NAMES[:2])
    true = {camera.name: camera.pose for camera in scene.cameras}
    assert apart(one.inverse() @ other, true["camera_0"].inverse() @ true["camera_1"]) < 2.5
    with pytest.raises(LogError, match="do not tell them: camera_"):
        process(log, options=ProcessOptions(calibrate="require"))


def test_a_camera_without_a_sure_pose_is_left_out(scene, detections, tmp_path):
    start = detections[0].stamp
    some = [f for f in detections if f.source != "camera_2" or f.stamp < start + 3e9]
    summary = process(write(tmp_path / "log.mcap", scene, some, {}), options=FIRST_STAGE)
    assert verdicts(summary) == ["good", "good", "doubtful"]
    assert any(text.startswith("camera_2 is left out, because") for text in summary.warnings)
    assert [camera.name for camera in summary.cameras] == ["camera_0", "camera_1"]


def test_a_doubtful_rig_is_written_and_its_file_is_used(tmp_path, capsys):
    _, log = in_place(tmp_path, action="squat", cameras=3, seconds=4.0)
    target, out = tmp_path / "cameras.toml", tmp_path / "out.mcap"
    assert run(["process", str(log), "-o", str(out)]) == 2
    said = capsys.readouterr().err
    assert "-o cameras.toml writes what is known" in said
    assert run(["calibrate", "people", str(log), "-o", str(target)]) == 0
    assert 'verdict = "doubtful"' in target.read_text()
    assert "error_deg = " in target.read_text()
    assert run(["process", str(log), "-o", str(out), "-q", "--extrinsics", str(target)]) == 0


def test_too_little_for_poses_from_nothing_says_what_to_record(scene, detections, tmp_path, capsys):
    some = [frame for frame in detections if frame.stamp < detections[0].stamp + 1e9]
    log = write(tmp_path / "log.mcap", scene, some, {})
    assert run(["process", str(log), "-o", str(tmp_path / "out.mcap")]) == 2
    assert "who walk about over 2 m or more where camera_" in capsys.readouterr().err
    assert not (tmp_path / "out.mcap").exists()


def test_a_misspelt_fixed_frame_is_an_error_and_no_reason_to_find_poses(
    scene, detections, true, tmp_path
):
    some = [frame for frame in detections if frame.stamp < detections[0].stamp + 1e9]
    log = write(tmp_path / "log.mcap", scene, some, true)
    config = load_config(overrides=["input.fixed_frame=lap"])
    with pytest.raises(LogError, match=r"has no frame 'lap' .*; did you mean lab\? \(.*\)$"):
        process(log, tmp_path / "out.mcap", config=config)


def test_a_causal_run_cannot_look_first(scene, detections, true, tmp_path):
    log = write(tmp_path / "log.mcap", scene, detections[:90], true)
    assert process(log, options=ProcessOptions("hiros-realtime")).poses == ()
    with pytest.raises(ConfigError, match="a causal run refines poses as it goes on"):
        options = ProcessOptions("hiros-realtime", calibrate="require")
        process(log, config=None, options=options)


@pytest.mark.parametrize("preset", ["paper", "upstream"])
def test_published_methods_take_the_poses_as_given(preset, scene, detections, true, tmp_path):
    given = true | {"camera_2": turned(true["camera_2"], 2.0, 0.05)}
    log = write(tmp_path / "log.mcap", scene, detections[:90], given)
    for name in ("hiros", "malaguti", "lee"):
        config = load_config(preset=preset, system=name)
        assert process(log, config=config, options=ProcessOptions(name)).poses == ()
        with pytest.raises(ConfigError, match="contradicts input.poses=given"):
            process(log, config=config, options=ProcessOptions(name, calibrate="require"))


def test_info_names_the_poses_that_do_not_fit(scene, detections, true, tmp_path, capsys):
    given = true | {"camera_2": turned(true["camera_2"], 4.0, 0.3)}
    assert run(["info", str(write(tmp_path / "log.mcap", scene, detections, given))]) == 0
    fault = r"these poses do not fit the people \(camera_2: (3\.9|4\.[01]) degrees, (29|30|31) cm\)"
    assert re.search(fault, capsys.readouterr().err)
    assert run(["info", str(write(tmp_path / "good.mcap", scene, detections, true))]) == 0
    assert "do not fit" not in capsys.readouterr().err


def test_a_long_log_is_read_in_stretches():
    assert stretches(0, int(10e9), 20.0, 5) == [(0, int(10e9))]
    spans = stretches(0, int(100e9), 20.0, 5)
    assert sum(end - begin for begin, end in spans) == pytest.approx(20e9)
    assert spans[0] == (int(8e9), int(12e9))
    assert spans[-1] == (int(88e9), int(92e9))


def test_where_nobody_is_found_poses_are_told_but_for_views_that_nobody_shares():
    cameras = [PoseSummary(name, "impossible", UNLINKED) for name in ("a", "b")]
    poses = PoseAlignment(cameras, alike=(["a", "b"],))
    (alike,) = poses.warnings()
    assert "one pose for a and b" in alike
    assert [*poses.notes(found=False)] == []
    assert len([*poses.notes(found=True)]) == 2


def corridor(seed, **rig):
    """Three cameras in a row along 14 m; the last one never shows whom the first one shows."""
    facing = Rotation.from_matrix(np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)).as_quat()
    poses = tuple((x, 1.2, 1.8, *facing) for x in (0.0, 3.5, 9.0))
    params = {"people": 3, "cameras": 3, "seconds": 20.0, "seed": seed, "action": "roam"}
    rig = {"poses": poses, "rate": 15.0, "range": (0.5, 5.0), **rig}
    return simulate(SimulateParams.model_validate({**params, "area": (0, 0, 14, 2.4), "rig": rig}))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_cameras_that_see_different_people_are_not_called_wrong(seed, tmp_path):
    scene = corridor(seed)
    path = write(tmp_path / "log.mcap", scene, list(scene.detections), scene.transforms)
    summary = process(path, options=FIRST_STAGE)
    assert summary.warnings == ()
    assert not any(camera.used and camera.moved_deg > 1.0 for camera in summary.poses)


@pytest.mark.parametrize("name", NAMES)
def test_a_camera_that_would_share_a_view_elsewhere_is_put_there(
    name, scene, detections, true, tmp_path
):
    given = true | {name: turned(true[name], 45.0, 2.0)}
    log, out = write(tmp_path / "log.mcap", scene, detections, given), tmp_path / "out.mcap"
    summary = process(log, out, options=FIRST_STAGE)
    assert any("poses come from the people" in text for text in summary.warnings)
    with open_log(out) as result:
        used = {n: result.transforms.lookup(n, result.fixed_frame, 0) for n in NAMES}
    other = NAMES[NAMES.index(name) - 1]
    ways = [rig[other].inverse() @ rig[name] for rig in (used, true)]
    assert apart(*ways) < 0.5


def test_a_camera_whose_people_are_elsewhere_is_named(scene, detections, true, tmp_path):
    short = [f for f in detections if f.stamp < detections[0].stamp + 4.5e9]  # proves no pose
    given = true | {"camera_2": turned(true["camera_2"], 45.0, 2.0)}
    summary = process(write(tmp_path / "log.mcap", scene, short, given), options=FIRST_STAGE)
    named = "camera_2: its pose does not fit the people (its people are those whom"
    assert any(text.startswith(named) for text in summary.warnings)


def test_two_rooms_whose_people_walk_alike_keep_their_poses(tmp_path):
    """People stand on the floor by both poses, so that nothing proves one wrong."""
    params = {"people": 1, "cameras": 2, "seconds": 20.0, "detector": {"kind": "kinect"}}
    here, there = (
        simulate(SimulateParams.model_validate({**params, "seed": seed})) for seed in (405, 1405)
    )
    frames = [frame for frame in here.detections if frame.source == "camera_0"]
    frames += [frame for frame in there.detections if frame.source == "camera_1"]
    one, other = here.transforms["camera_0"], there.transforms["camera_1"]
    away = other._replace(translation=np.add(other.translation, [12.0, 0.0, 0.0]))
    log = write(tmp_path / "log.mcap", here, frames, {"camera_0": one, "camera_1": away})
    summary = process(log, options=FIRST_STAGE)
    assert not any(pose.used for pose in summary.poses)


@pytest.mark.parametrize("ahead", [0.0, 0.2])
def test_two_cameras_one_of_which_is_wrong_show_one_person_all_the_same(ahead, tmp_path):
    """People walk as regularly as strangers might. But here they are proved to be the same."""
    params = {"people": 1, "cameras": 2, "seconds": 14.0, "seed": 5, "rig": {"rate": 15.0}}
    params["detector"] = {"kind": "kinect"}
    two = simulate(SimulateParams.model_validate(params))
    true = {camera.name: camera.pose for camera in two.cameras}
    given = true | {"camera_1": turned(true["camera_1"], 30.0, 1.0)}
    frames = [later(f, round(ahead * 1e9)) if f.source == "camera_1" else f for f in two.detections]
    log, out = write(tmp_path / "log.mcap", two, frames, given), tmp_path / "out.mcap"
    summary = process(log, out, options=FIRST_STAGE)
    assert verdicts(summary) == ["doubtful"] * 2
    assert summary.poses[1].clock_ms == pytest.approx(-1000.0 * ahead, abs=5.0)
    assert any("corrected its stamps" in text for text in summary.warnings) == (ahead > 0.0)
    assert any("the cameras' poses are doubtful: expect" in text for text in summary.warnings)
    assert len(summary.people) == 1
    with open_log(out) as result:
        used = [result.transforms.lookup(name, result.fixed_frame, 0) for name in NAMES[:2]]
    for pose, right in zip(
        used, true.values(), strict=True
    ):  # on the floor: the first one is right
        assert apart(pose, right) < 1.5
        assert pose.translation == pytest.approx(right.translation, abs=0.05)
    with pytest.raises(LogError, match="--calibrate require"):
        process(log, options=ProcessOptions(calibrate="require"))
