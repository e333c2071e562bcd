"""Runs over logs with a camera whose clock is wrong: what is used, what is found, what is said."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from odd_logs import changed, later, shifted

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.calibrate.verdict import UNLINKED
from hiros_mcap.config import load_config
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate import load_truth
from hiros_mcap.evaluate.logs import evaluate_log, read_channel
from hiros_mcap.events import events_from_json
from hiros_mcap.io.camera_clock import DRIFT, LATE, OFFSET, CameraTimes, ClockFault
from hiros_mcap.io.channels import EVENTS_ATTACHMENT, add_static_poses
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.running.clock_alignment import STILL, ClockAlignment, clock_notes, clock_warnings
from hiros_mcap.running.overview import overview_of
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.running.summary import PoseSummary
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.skeletons import Frame

S = 10**9
HALF = 75  # messages of a camera before the middle
FIRST_STAGE = ProcessOptions(stages="T")
"""Poses and clocks are found before it; the other stages would take most of the time."""


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Three cameras see somebody walk for 10 s."""
    path = tmp_path_factory.mktemp("clocks") / "walk.mcap"
    scene = {"people": 1, "cameras": 3, "seconds": 10.0, "seed": 4, "rig": {"rate": 15.0}}
    write_log(path, SimulateParams.model_validate(scene))
    return path


def step(seconds):
    return lambda f, sent: later_people(f, seconds if sent >= HALF else 0)


def offset(seconds):
    return lambda f, sent: later_people(f, seconds)


def later_people(frame, seconds):
    return later(frame, round(seconds * S)) if frame.source == "camera_1" else frame


def error(out, truth):
    found = evaluate_log(out, load_truth(truth), ["/hiros/filtered"])
    return found["/hiros/filtered"].scores.mean


def run(walk, folder, change, *settings, system="hiros"):
    source = changed(walk, folder / "wrong.mcap", change)  # type: ignore[arg-type]
    config = load_config(None, settings, system=system)
    return process(source, folder / "out.mcap", config=config, options=ProcessOptions(system))


@pytest.fixture(scope="module")
def without(walk):
    """Error, mm, of a run without the camera."""
    out = walk.with_name("without.mcap")
    topics = ("/camera_0/*", "/camera_2/*")
    process(walk, out, options=ProcessOptions("hiros", topics=topics))
    return error(out, walk)


@pytest.mark.parametrize("seconds", [-0.1, 2.0])
def test_a_step_of_one_clock_costs_nothing(seconds, walk, without, tmp_path):
    summary = run(walk, tmp_path, step(seconds))
    assert summary.skipped == 0
    assert error(tmp_path / "out.mcap", walk) < 1.05 * without
    (fault,) = summary.cameras[1].clock
    assert fault.seconds == pytest.approx(seconds, abs=0.005)
    assert summary.cameras[0].clock == summary.cameras[2].clock == ()
    assert summary.warnings[0].startswith("the clock of camera_1 was set")


@pytest.mark.parametrize("seconds", [-1.5, 0.1])
def test_people_who_walk_prove_an_offset(seconds, walk, without, tmp_path):
    summary = run(walk, tmp_path, offset(seconds))
    assert summary.skipped == 0
    assert error(tmp_path / "out.mcap", walk) < 1.05 * without
    (fault,) = summary.cameras[1].clock
    assert (fault.kind, fault.corrected) == ("clock offset", True)
    assert fault.seconds == pytest.approx(seconds, abs=0.008)
    assert "--clock camera_1=" in summary.warnings[0]


def test_people_who_stand_still_prove_nothing_and_nothing_is_changed(walk, tmp_path):
    first: dict[str, Frame] = {}

    def frozen(frame, _):
        if frame.n_people:
            pose = first.setdefault(frame.source, frame)
            frame = pose.replace(stamp=frame.stamp, stamps=pose.stamps - pose.stamp + frame.stamp)
        return later_people(frame, 0.5)

    summary = run(walk, tmp_path, frozen)
    assert summary.skipped == 0
    (fault,) = summary.cameras[1].clock
    assert (fault.corrected, round(fault.seconds, 1)) == (False, 0.5)
    assert "nobody moves enough to tell" in summary.warnings[0]
    assert f"--clock camera_1={-fault.seconds:.3f}" in summary.warnings[0]


def test_a_correction_by_the_user_is_taken_as_right(walk, tmp_path):
    summary = run(walk, tmp_path, offset(1.5), "clock.camera_1=-1.5")
    assert summary.warnings == ()
    plain = process(walk, tmp_path / "plain.mcap", options=ProcessOptions("hiros"))
    assert summary.written == plain.written
    for name in ("plain.mcap", "out.mcap"):
        frames, _, _ = read_channel(tmp_path / name, "/hiros/filtered")
        poses = np.concatenate([frame.positions for frame in frames])
        assert np.isfinite(poses).all()
    assert error(tmp_path / "out.mcap", walk) == error(tmp_path / "plain.mcap", walk)


def test_a_camera_goes_by_its_topic_too_and_others_are_refused(walk, tmp_path):
    assert run(walk, tmp_path, offset(1.0), "clock./camera_1/skeletons=-1.0").warnings == ()
    with pytest.raises(ConfigError, match=r"no camera 'x' \(there are: camera_0, camera_1, cam"):
        process(walk, config=load_config(None, ["clock.x=1"]))


def test_the_correction_of_a_camera_that_sent_nothing_is_no_fault(walk, tmp_path):
    empty = changed(walk, tmp_path / "empty.mcap", offset(0.0), keep=False)
    assert process(empty, config=load_config(None, ["clock.camera_1=1"])).people == ()


def test_the_output_has_right_stamps_and_the_input_as_it_was(walk, tmp_path):
    run(walk, tmp_path, step(30.0))
    tracked, _, _ = read_channel(tmp_path / "out.mcap", "/hiros/tracked")
    assert max(frame.stamp for frame in tracked) - min(frame.stamp for frame in tracked) < 11 * S
    assert max(int(frame.stamps.max(initial=0)) for frame in tracked) == tracked[-1].stamp
    with McapReader(tmp_path / "wrong.mcap") as given, McapReader(tmp_path / "out.mcap") as copy:
        topic = {c.topic: i for i, c in given.channels.items()}["/camera_1/skeletons"]
        also = {c.topic: i for i, c in copy.channels.items()}["/camera_1/skeletons"]
        sent = [bytes(message.data) for message in given.messages({topic})]
        assert [bytes(message.data) for message in copy.messages({also})] == sent


def test_a_fault_is_an_event_and_in_info(walk, tmp_path):
    summary = run(walk, tmp_path, step(2.0))
    with McapReader(tmp_path / "out.mcap") as reader:
        events = events_from_json((reader.attachment(EVENTS_ATTACHMENT) or b"").decode())
    (event,) = (event for event in events if event.kind == "clock step")
    assert (event.source, event.detail) == ("camera_1", "+2.00 s")
    (text,) = overview_of(tmp_path / "wrong.mcap").clocks
    assert summary.warnings[0].startswith(f"{text}; ")
    assert overview_of(walk).clocks == ()


def ahead(seconds):
    """Camera 1 by so much in stamps and log times, so that no lag shows it."""
    return lambda topic: seconds if topic.startswith("/camera_1/") else 0.0


@pytest.fixture(scope="module")
def healthy(walk):
    """Error, mm, of a run of the whole chain without a fault."""
    process(walk, walk.with_name("healthy.mcap"))
    return error(walk.with_name("healthy.mcap"), walk)


@pytest.mark.parametrize("seconds", [-0.09, 0.03])
def test_an_offset_that_log_times_hide_is_found_with_the_poses_and_corrected(
    seconds, walk, healthy, tmp_path
):
    source, out = shifted(walk, tmp_path / "w.mcap", ahead(seconds)), tmp_path / "out"
    summary = process(source, out)
    (fault,) = summary.cameras[1].clock
    assert (fault.kind, fault.corrected) == ("clock offset", True)
    assert fault.seconds == pytest.approx(seconds, abs=0.008)
    assert summary.cameras[0].clock == summary.cameras[2].clock == ()
    told = summary.warnings if abs(seconds) > 0.05 else summary.notes
    assert any(line.startswith("the clock of camera_1 is ") for line in told)
    assert error(out, walk) == pytest.approx(healthy, rel=0.02)


def test_an_offset_of_most_of_a_second_is_found_in_a_crowd(tmp_path):
    """Six people walk at one pace: where each is fits others a moment later, and steps repeat."""
    scene = {"people": 6, "cameras": 4, "seconds": 14.0, "seed": 8, "rig": {"rate": 10.0}}
    write_log(tmp_path / "crowd.mcap", SimulateParams.model_validate(scene))
    source = shifted(tmp_path / "crowd.mcap", tmp_path / "w.mcap", ahead(0.8))
    summary = process(source, options=FIRST_STAGE)
    (fault,) = summary.cameras[1].clock
    assert fault.corrected
    assert fault.seconds == pytest.approx(0.8, abs=0.008)


def test_a_clock_that_the_user_gave_is_right_and_the_others_are_compared_with_it(walk, tmp_path):
    source = shifted(walk, tmp_path / "w.mcap", ahead(0.09))
    given = load_config(overrides=["clock.camera_1=0.0"])
    summary = process(source, config=given, options=FIRST_STAGE)
    assert summary.cameras[1].clock == ()
    for k in (0, 2):
        (fault,) = summary.cameras[k].clock
        assert fault.seconds == pytest.approx(-0.09, abs=0.01)


def test_stamps_that_are_taken_as_they_are_stay_whatever_the_people_show(walk, tmp_path):
    source = shifted(walk, tmp_path / "w.mcap", ahead(0.09))
    config = load_config(overrides=["input.clocks=off"])
    assert process(source, config=config, options=FIRST_STAGE).cameras[1].clock == ()


def test_a_healthy_log_keeps_all_stamps(walk):
    summary = process(walk, options=FIRST_STAGE)
    assert all(0.0 < abs(pose.clock_ms) < 10.0 for pose in summary.poses if pose.clock_ms)
    assert [camera.clock for camera in summary.cameras] == [()] * 3


def three(**lags):
    """Cameras with messages every tenth of a second that are logged so late, s."""
    stamps = S + np.arange(0, 10 * S, S // 10)
    times = {name: CameraTimes(stamps, stamps + round(lag * S)) for name, lag in lags.items()}
    return ClockAlignment(times=times)


@pytest.mark.parametrize(
    ("ms", "error_ms", "verdict", "corrected"),
    [
        (40, 1, "good", True),
        (4, 1, "good", None),
        (6, 1, "good", True),
        (40, 14, "good", None),
        (40, 1, "doubtful", False),
    ],
)
def test_a_significant_offset_is_corrected_or_a_fault_says_why_not(
    ms, error_ms, verdict, corrected
):
    clocks = three(right=0.0, wrong=0.0)
    reason = "only 3 s of common view" if verdict == "doubtful" else ""
    clocks.take_offsets([
        PoseSummary("right", "good", clock_ms=0.0, error_ms=1.0),
        PoseSummary("wrong", verdict, reason, clock_ms=ms, error_ms=error_ms),
    ])  # fmt: skip
    assert [(f.camera, f.corrected, f.reason) for f in clocks.faults] == (
        [] if corrected is None else [("wrong", corrected, reason)]
    )
    moved = clocks.corrected_times("wrong").stamps - clocks.times["wrong"].stamps
    assert (moved == (round(ms * 1e6) if corrected else 0)).all()


@pytest.mark.parametrize(("late", "wait"), [(0.0, 0.1), (0.25, 0.35), (0.5, 0.6), (59.95, 60.0)])
def test_messages_of_a_file_wait_until_the_latest_has_come(late, wait):
    clocks = three(right=0.0, wrong=0.0)
    clocks.reorder = 0.25
    stamps = clocks.times["right"].stamps
    sent = np.sort(stamps + 100 * S)
    late_ones = CameraTimes(np.array([sent[-1] - round(late * S)]), sent[-1:] + 1)
    clocks.times = {**clocks.times, "long": CameraTimes(sent, sent), "late": late_ones}
    clocks.take_offsets([
        PoseSummary("right", "good", clock_ms=0.0, error_ms=1.0),
        PoseSummary("wrong", "good", clock_ms=40.0, error_ms=1.0),
    ])  # fmt: skip
    assert clocks.wait == pytest.approx(wait)


@pytest.mark.parametrize(
    ("kind", "seconds", "corrected", "reason", "grave"),
    [
        (OFFSET, 0.05, True, "", True),
        (OFFSET, 0.049, True, "", False),
        (OFFSET, -0.05, False, "only 3 s of common view", True),
        (OFFSET, 0.2, False, STILL, True),
        (OFFSET, -0.199, False, STILL, False),
        (DRIFT, 1e-4, True, "", True),
        (LATE, 30.0, True, "", False),
    ],
)
def test_a_fault_is_a_warning_or_a_note_by_its_size_and_kind(
    kind, seconds, corrected, reason, grave
):
    """A camera that nobody moves before may only deliver late: that is no warning so soon."""
    faults = [ClockFault("a", kind, seconds, S, corrected, reason=reason)]
    assert (len([*clock_warnings(faults, 0)]), len([*clock_notes(faults, 0)])) == (grave, not grave)


def test_a_camera_that_was_moved_has_the_surer_of_its_two_clocks():
    clocks = three(moved=0.0, a=0.0, b=0.0)
    clocks.take_offsets([
        PoseSummary("moved", "good", clock_ms=40.0, error_ms=1.0),
        PoseSummary("moved", "good", clock_ms=60.0, error_ms=9.0),
        PoseSummary("a", "good", clock_ms=0.0, error_ms=1.0),
        PoseSummary("b", "good", clock_ms=0.0, error_ms=1.0),
    ])  # fmt: skip
    assert [fault.seconds for fault in clocks.faults] == [-0.04]


@pytest.mark.parametrize(("error_ms", "corrected"), [(9.0, True), (11.0, False)])
def test_the_error_of_a_clock_is_that_of_its_difference_from_the_other(error_ms, corrected):
    clocks = three(a=0.0, b=0.03)
    clocks.take_offsets([
        PoseSummary("a", "good", clock_ms=-15.0, error_ms=error_ms),
        PoseSummary("b", "good", clock_ms=15.0, error_ms=error_ms),
    ])  # fmt: skip
    assert bool(clocks.faults) == corrected


def test_of_two_cameras_the_one_logged_nearer_to_its_stamps_is_right():
    clocks = three(a=-0.07, b=0.03)
    cameras = clocks.take_offsets([
        PoseSummary("a", "good", clock_ms=-50.0, error_ms=1.0),
        PoseSummary("b", "good", clock_ms=50.0, error_ms=1.0),
    ])  # fmt: skip
    assert [(fault.camera, fault.seconds) for fault in clocks.faults] == [("a", 0.1)]
    assert [camera.clock_ms for camera in cameras] == [-100.0, 0.0]  # as the note says


def test_the_lag_of_a_camera_that_shares_no_view_is_named_with_the_reason():
    clocks = three(a=0.0, b=0.0, alone=0.3)
    clocks.take_offsets([
        PoseSummary("a", "good", clock_ms=0.0, error_ms=1.0),
        PoseSummary("b", "good", clock_ms=0.0, error_ms=1.0),
        PoseSummary("alone", "impossible", UNLINKED),
    ])  # fmt: skip
    (fault,) = clocks.faults
    assert (fault.camera, fault.corrected, fault.reason) == ("alone", False, f"it {UNLINKED}")


@pytest.mark.parametrize("poses", ["absent", "wrong"])
def test_a_clock_that_is_found_with_poses_from_nothing_is_used(poses, walk, tmp_path):
    source = shifted(walk, tmp_path / "w.mcap", ahead(0.09))
    with open_log(source) as log, McapWriter(tmp_path / "poses.mcap") as writer:
        kept = {i: c for i, c in log.reader.channels.items() if c.topic != "/tf_static"}
        writer.copy_definitions(log.reader, kept)
        if poses == "wrong":
            frames = dict.fromkeys(("camera_0", "camera_1", "camera_2"), Rigid.identity())
            add_static_poses(writer, frames, "world", log.span[0])
        for m in log.reader.messages(kept):
            writer.write(m.channel_id, m.log_time, bytes(m.data))
        writer.commit()
    process(tmp_path / "poses.mcap", tmp_path / "out.mcap")
    stamps = {source: [] for source in ("/camera_1/skeletons", "/hiros/tracked")}
    for topic in stamps:
        frames, _, _ = read_channel(tmp_path / "out.mcap", topic)
        stamps[topic] = sorted(f.stamp for f in frames if f.source == "camera_1")
    given, used = (np.array(times, float) for times in stamps.values())
    assert np.median(given[:100] - used[:100]) == pytest.approx(0.09 * S, abs=0.008 * S)


def late_delivery(walk, target):
    """Copy the log; 3 s of one camera are logged 3 s later."""
    with open_log(walk) as log, McapWriter(target) as writer:
        writer.copy_definitions(log.reader, log.reader.channels)
        begin = log.span[0] + 4 * S
        rows = []
        for m in log.reader.messages():
            named = log.reader.channels[m.channel_id].topic == "/camera_1/skeletons"
            is_late = named and begin < m.log_time < begin + 3 * S
            rows.append((m.log_time + 3 * S * is_late, m.channel_id, bytes(m.data)))
        for time, channel, data in sorted(rows):
            writer.write(channel, time, data)
        writer.commit()
    return target


def test_late_messages_of_a_file_are_waited_for(walk, tmp_path):
    summary = process(late_delivery(walk, tmp_path / "late.mcap"), tmp_path / "out.mcap")
    assert (summary.skipped, summary.warnings) == (0, ())
    (note,) = (note for note in summary.notes if "late" in note)
    assert note.startswith("camera_1: ")
    assert "arrived up to 3.0" in note


def test_late_messages_of_a_live_system_are_lost_and_told(walk, tmp_path):
    source = late_delivery(walk, tmp_path / "late.mcap")
    config = load_config(system="hiros-realtime")
    summary = process(source, config=config, options=ProcessOptions("hiros-realtime"))
    assert summary.cameras[0].skipped == summary.cameras[2].skipped == {}
    assert summary.cameras[1].skipped["too late to be merged"] > 35
    assert summary.warnings[0].startswith("/camera_1/skeletons: 30 % of 149 messages")


@pytest.mark.parametrize("seconds", [-5.0, 0.5])
def test_a_live_system_corrects_a_step_from_the_past(seconds, walk, tmp_path):
    summary = run(walk, tmp_path, step(seconds), system="hiros-realtime")
    assert summary.cameras[0].skipped == summary.cameras[2].skipped == {}
    assert sum(summary.cameras[1].skipped.values()) <= (40 if seconds < 0 else 0)
    (fault,) = summary.cameras[1].clock
    assert fault.seconds == pytest.approx(seconds, abs=0.01)


@pytest.mark.parametrize("seconds", [0.2, 7200.0])
def test_a_live_system_is_not_carried_away_by_a_clock_that_is_ahead(seconds, walk, tmp_path):
    summary = run(walk, tmp_path, offset(seconds), system="hiros-realtime")
    assert summary.skipped == 0
    (fault,) = summary.cameras[1].clock
    assert fault.seconds == pytest.approx(seconds, abs=0.01)


def test_a_live_system_leaves_healthy_clocks_alone(walk, tmp_path):
    options, out = ProcessOptions("hiros-realtime", calibrate="off"), []
    for clocks in ("causal", "off"):
        config = load_config(None, [f"input.clocks={clocks}"], system="hiros-realtime")
        process(walk, tmp_path / clocks, config=config, options=options)
        with McapReader(tmp_path / clocks) as reader:
            by_channel = defaultdict(list)
            for m in reader.messages():
                by_channel[m.channel_id].append((m.log_time, bytes(m.data)))
            out.append(by_channel)
    assert out[0] == out[1]
