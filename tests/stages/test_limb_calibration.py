"""Limb calibration (Hi-ROS 2023, section 3.3.1), and the table of limbs."""

import numpy as np
import pytest
from builders import at_once
from hypothesis import given, settings
from hypothesis import strategies as st

from hiros_mcap.body.limb_table import Limb, LimbTable, link_keys
from hiros_mcap.errors import ConfigError
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, by_frame
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.stages.optimize.limb_calibration import (
    Calibration,
    calibrate_limbs,
    mean_lengths,
    moments_of,
)
from hiros_mcap.stages.optimize.optimize import OptimizeParams, optimize_blocks

optimize = at_once(optimize_blocks)
streamed = by_frame(optimize_blocks)

ARM = SkeletonModel.of(
    ["shoulder", "elbow", "wrist", "hand"], [("upper arm", 0, 1), ("forearm", 1, 2), ("palm", 2, 3)]
)
LENGTHS = np.array([0.30, 0.25, 0.20])


def arm_frames(count, sd=0.01, seed=0, ids=(0,), forearm_sd=0.0, rate=30.0, start=0.0):
    """An arm that turns in space, lengths constant but for the noise of its joints."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        frame = Frame.empty(len(ids), ARM, stamp=int((start + k / rate) * 1e9))
        frame.ids[:] = ids
        for row in range(len(ids)):
            steps = rng.normal(size=(3, 3))
            steps *= (LENGTHS / np.linalg.norm(steps, axis=1))[:, None]
            steps[1] *= 1.0 + rng.normal() * forearm_sd
            frame.markers[row, 1:, :3] = np.cumsum(steps, axis=0)
            frame.markers[row, 0, :3] = 0.0
            frame.markers[row, :, :3] += rng.normal(size=(4, 3)) * sd
        yield frame


def measured_limbs(frames, *args, **kwargs):
    return calibrate_limbs(map(Block.of, frames), ARM, *args, **kwargs)


def notes(events, kind):
    return [event for event in events.log if event.kind == kind]


def lengths(frames, row=0):
    points = np.array([frame.positions[row] for frame in frames])
    return np.linalg.norm(np.diff(points, axis=1), axis=2)


def test_rigid_arm_is_measured_within_the_error_of_the_mean():
    limbs = measured_limbs(arm_frames(100)).people[0]
    for name, truth in zip(ARM.link_names, LENGTHS, strict=True):
        limb = limbs[name]
        assert abs(limb.length - truth) < 2 * limb.deviation / np.sqrt(100)
        assert limb.deviation == pytest.approx(0.01 * np.sqrt(2), rel=0.3)
        assert limb.frames == 100


def test_noise_does_not_lengthen_limbs():
    rng = np.random.default_rng(1)
    d = np.array([0.1, 0.0, 0.0]) + rng.normal(size=(20000, 3)) * 0.02
    moments = moments_of(np.linalg.norm(d, axis=1)[:, None], np.ones((20000, 1)))
    assert mean_lengths(moments, debias=True)[0][0] == pytest.approx(0.1, abs=5e-4)
    assert mean_lengths(moments, debias=False)[0][0] == pytest.approx(0.104, abs=5e-4)


def test_measurements_count_by_confidence():
    frames = list(arm_frames(90, sd=0.0))
    for frame in frames[60:]:
        frame.markers[0, 3, :3] += 0.01 * (frame.markers[0, 3, :3] - frame.markers[0, 2, :3])
        frame.marker_confidences[0, 3] = 0.0
    assert measured_limbs(frames).people[0]["palm"].length == pytest.approx(0.2, abs=1e-9)


def test_a_link_counts_by_the_confidences_of_its_two_ends():
    frame = next(arm_frames(1))
    frame.marker_confidences[0] = [1.0, 0.25, np.nan, 0.0]
    calibration = Calibration(ARM, OptimizeParams(), Events(), LimbTable())
    _, weights = calibration.measure(Block.of(frame).people)
    assert weights[0] == pytest.approx([0.4, 0.4, 0.0])


def test_lengths_are_weighted_means():
    moments = moments_of(np.array([[0.20], [0.21]]), np.array([[1.0], [0.25]]))
    assert mean_lengths(moments, debias=False)[0] == pytest.approx(0.202, abs=1e-5)
    assert mean_lengths(moments, debias=False)[1] == pytest.approx(0.004, abs=1e-4)


@given(st.integers(0, 10_000), st.floats(0.05, 2.0))
@settings(max_examples=20, deadline=None)
def test_rigid_limbs_are_measured_exactly(seed, scale):
    frames = [f.replace(markers=scale * f.markers) for f in arm_frames(20, sd=0.0, seed=seed)]
    limbs = measured_limbs(frames, OptimizeParams(calibration_frames=10)).people[0]
    assert [limb.length for limb in limbs.values()] == pytest.approx(scale * LENGTHS)


@pytest.mark.parametrize(("short_link", "calibrated"), [(0.15, True), (0.0, False)])
def test_noise_of_a_joint_does_not_reject_a_short_link(short_link, calibrated):
    """A hand of 5 cm with 1.4 cm of noise varies by 28 %: more than max_variation."""
    frames = list(arm_frames(200, sd=0.01))
    for frame in frames:
        frame.markers[0, 3] = frame.markers[0, 2] + 0.25 * (
            frame.markers[0, 3] - frame.markers[0, 2]
        )
        frame.markers[0, 3, 0] += 0.02 * (-1) ** (frame.stamp // 33_000_000)
    params = OptimizeParams(short_link=short_link, max_free=0.0)
    assert (0 in measured_limbs(frames, params).people) == calibrated


@pytest.mark.parametrize(("max_free", "calibrated"), [(0.34, True), (0.32, False)])
def test_a_share_of_the_links_may_fail_the_gate(max_free, calibrated):
    params, events = OptimizeParams(max_free=max_free), Events()
    limbs = measured_limbs(arm_frames(100, forearm_sd=0.4), params, events).people
    assert (0 in limbs) == calibrated
    if calibrated:
        assert list(limbs[0]) == ["upper arm", "palm"]
        assert events.counts == {("limbs left free", ""): 1}


def test_a_few_wild_frames_do_not_matter():
    frames = list(arm_frames(100, sd=0.001))
    for frame in frames[::20]:
        frame.markers[0, 3, :3] += 1.0
    assert measured_limbs(frames).people[0]["palm"].length == pytest.approx(0.2, abs=0.002)


def test_noisy_forearm_is_rejected_by_name():
    events = Events()
    assert not measured_limbs(arm_frames(100, forearm_sd=0.4), events=events).people
    (note,) = notes(events, "calibration rejected")
    assert (note.person, note.detail) == (0, "measured lengths vary too much: forearm")


def test_rejected_person_is_tried_again():
    noisy = arm_frames(110, forearm_sd=0.4)
    events = Events()
    frames = [*noisy, *arm_frames(250, start=4.0)]
    list(optimize(frames, ARM, OptimizeParams(lookahead=3.0), events))
    assert notes(events, "calibration rejected")
    assert notes(events, "limbs calibrated")


def test_frames_before_the_calibration_get_the_same_lengths():
    frames = list(optimize(arm_frames(600), ARM))
    variation = lengths(frames).std(axis=0) / lengths(frames).mean(axis=0)
    assert variation.max() < 0.005
    assert lengths(frames)[0] == pytest.approx(LENGTHS, abs=0.004)


def test_refinement_moves_little_and_towards_the_truth():
    early, late = arm_frames(100, sd=0.0), arm_frames(900, sd=0.0, start=4.0)
    late = [frame.replace(markers=frame.markers * 1.005) for frame in late]
    frames = list(optimize([*early, *late], ARM, OptimizeParams(lookahead=3.4)))
    result = lengths(frames) / LENGTHS
    assert result[50] == pytest.approx(1.0, abs=1e-3)
    assert result[-1] == pytest.approx(1.0045, abs=1e-3)
    assert np.abs(np.diff(result, axis=0)).max() < 1e-3


@pytest.mark.parametrize("sign", [1, -1])
def test_refined_lengths_stay_within_one_per_cent(sign):
    """Whatever is measured later, 5 % here, lengths are constant within a person."""
    early, late = arm_frames(100, sd=0.0), arm_frames(900, sd=0.0, start=4.0)
    late = [frame.replace(markers=frame.markers * (1 + 0.05 * sign)) for frame in late]
    result = lengths(optimize([*early, *late], ARM, OptimizeParams(lookahead=3.4)))
    assert result[-1] / LENGTHS == pytest.approx(1 + 0.01 * sign, abs=1e-3)


def test_somebody_who_left_is_forgotten_but_keeps_their_lengths_in_the_table():
    limbs, params = LimbTable(), OptimizeParams(lookahead=1.0)
    calibration = Calibration(ARM, params, Events(), limbs)
    for frame in [*arm_frames(120, sd=0.0), *arm_frames(130, ids=(1,), start=5.0, rate=2.0)]:
        calibration.observe(
            frame.stamp, frame.ids.tolist(), *calibration.measure(Block.of(frame).people)
        )
    assert (list(calibration.people), list(limbs.people)) == ([1], [0, 1])
    assert calibration.nominal([0])[0] == pytest.approx(LENGTHS)


def test_somebody_who_comes_back_keeps_their_lengths():
    gone = [*arm_frames(120, sd=0.0), *arm_frames(130, ids=(1,), start=5.0, rate=2.0)]
    back = [f.replace(markers=1.03 * f.markers) for f in arm_frames(400, sd=0.0, start=80.0)]
    events = Events()
    result = list(optimize([*gone, *back], ARM, OptimizeParams(lookahead=1.0), events))
    assert lengths(result[-400:]) == pytest.approx(np.tile(LENGTHS, (400, 1)), abs=1e-3)
    assert [note.person for note in notes(events, "limbs calibrated")] == [0, 1]


def test_two_passes_settle_those_who_left_long_ago():
    frames = [*arm_frames(40, sd=0.0), *arm_frames(150, ids=(1,), start=5.0, rate=2.0)]
    events = Events()
    assert list(measured_limbs(frames, events=events).people) == [0, 1]
    assert notes(events, "limbs calibrated")[0].detail == "40 frames"


@pytest.mark.parametrize("lookahead", [0.0, 1.0, 10.0])
def test_no_frame_is_lost_or_overtaken(lookahead):
    frames = [*arm_frames(40), *arm_frames(40, ids=(0, 1), start=2.0), *arm_frames(9, ids=())]
    result = list(optimize(frames, ARM, OptimizeParams(lookahead=lookahead)))
    assert [frame.stamp for frame in result] == [frame.stamp for frame in frames]


def test_frames_are_held_back_no_longer_than_the_lookahead():
    pulled = []
    source = (pulled.append(frame.stamp) or frame for frame in arm_frames(300))
    stage = streamed(source, ARM, OptimizeParams(lookahead=2.0))
    first = next(stage)
    assert pulled[-1] - first.stamp == pytest.approx(2e9, abs=1e9 / 30)


def test_held_frames_are_logged_when_they_are_released():
    late = 50_000_000  # ns; every other message overtakes the one before it
    frames = list(arm_frames(90))
    frames = [f.replace(log_time=f.stamp + late * (k % 2 == 0)) for k, f in enumerate(frames)]
    result = list(optimize(frames, ARM, OptimizeParams(lookahead=1.0)))
    assert {frame.log_time for frame in result[:30]} == {frames[30].log_time}
    log_times = [frame.log_time for frame in result]
    assert log_times == sorted(log_times)


def test_a_buffer_takes_three_seconds_at_least():
    frames = list(arm_frames(400, rate=100.0))
    result = optimize(frames, ARM, OptimizeParams(lookahead=0.0))
    same = [np.array_equal(a.positions, b.positions) for a, b in zip(frames, result, strict=True)]
    assert same.index(False) in (300, 301)


def test_a_link_that_is_seen_later_gets_its_length_then():
    frames = list(arm_frames(500, sd=0.01))
    for frame in frames[:120]:
        frame.markers[0, 3] = np.nan
    result = lengths(optimize(frames, ARM, OptimizeParams(lookahead=3.0)))
    assert np.std(result[-200:, 2]) < 1e-3 < np.std(result[130:180, 2])


def test_somebody_who_left_is_not_waited_for():
    frames = [*arm_frames(60, ids=(7,)), *arm_frames(300, ids=(), start=2.0)]
    pulled = []
    stage = streamed((pulled.append(f.stamp) or f for f in frames), ARM)
    next(stage)
    assert pulled[-1] < 5e9


ARMS = SkeletonModel.of(
    ["chest", "elbow_left", "hand_left", "elbow_right", "hand_right"],
    [("left", 0, 1), ("left arm", 1, 2), ("right", 0, 3), ("right arm", 3, 4)],
)


def result_of(changes):
    """The last numbers of two swinging arms, one a little longer, with some displaced hands."""
    rng = np.random.default_rng(0)
    frames = [Frame.empty(1, ARMS, stamp=k * 33_333_333) for k in range(400)]
    for k, frame in enumerate(frames):
        ways = rng.normal(size=(4, 3))
        ways *= (np.array([0.3, 0.1, 0.31, 0.2]) / np.linalg.norm(ways, axis=1))[:, None]
        frame.ids[:], frame.links[0, :, 3:7] = 0, [0, 0, 0, 1]
        frame.markers[0, :, :3] = 0.012 * rng.normal(size=(5, 3))
        frame.markers[0, 1:, :3] += [ways[0], ways[0] + ways[1], ways[2], ways[2] + ways[3]]
        frame.markers[0, 2, :3] += 0.3 * (k % 50 == 49)
        frame.markers[0, 4, :3] += 0.02 * rng.normal(size=3) if k % 7 else 0.0
    out = list(optimize(frames, ARMS, OptimizeParams(**changes)))
    return b"".join(frame.markers.tobytes() + frame.links.tobytes() for frame in out[-200:])


CHANGES = {
    "calibration": "two-pass", "calibration_frames": 30, "lookahead": 1.0,
    "calibration_windows": ((1.0, 5.0),), "max_variation": 0.05, "short_link": 0.01,
    "max_free": 0.0, "debias": False, "refine": False,
    "lengths": "paper", "max_length_error": 0.05, "outliers": "remove",
}  # fmt: skip
# Without these, nothing fails the quality gate, or nothing is left to refine.
WITH = {
    "max_free": {"max_variation": 0.1, "short_link": 0.2, "lookahead": 3.3},
    "short_link": {"max_variation": 0.15},
    "refine": {"lookahead": 3.0},
}


@pytest.mark.parametrize("name", [name for name in OptimizeParams.model_fields if name != "solver"])
def test_each_parameter_changes_something(name):
    others = WITH.get(name, {})
    assert result_of({**others, name: CHANGES[name]}) != result_of(others)


def test_too_short_a_visit_passes_unchanged():
    frames, events = list(arm_frames(20)), Events()
    result = list(optimize(frames, ARM, events=events))
    assert all(
        a.markers.tobytes() == b.markers.tobytes() for a, b in zip(frames, result, strict=True)
    )
    assert notes(events, "calibration rejected")[0].detail == "only 20 frames"


def test_without_lookahead_frames_change_once_calibrated():
    frames = list(arm_frames(150))
    result = list(optimize(frames, ARM, OptimizeParams(lookahead=0.0)))
    same = [
        np.array_equal(a.markers, b.markers, equal_nan=True)
        for a, b in zip(frames, result, strict=True)
    ]
    assert same == [True] * 99 + [False] * 51


def test_windows_choose_the_frames():
    frames = [*arm_frames(60, sd=0.0), *arm_frames(60, sd=0.0, start=2.0)]
    frames[60:] = [frame.replace(markers=frame.markers * 1.1) for frame in frames[60:]]
    params = OptimizeParams(calibration_windows=((2.0, 5.0),))
    assert measured_limbs(frames, params).people[0]["palm"].length == pytest.approx(0.22)


def test_two_passes_give_strictly_constant_lengths():
    params, limbs = OptimizeParams(calibration="two-pass"), measured_limbs(arm_frames(200))
    result = optimize(arm_frames(200), ARM, params, limbs=limbs)
    assert lengths(result).std(axis=0).max() < 2e-4


def test_off_leaves_everybody_alone():
    frames = list(arm_frames(120))
    result = optimize(frames, ARM, OptimizeParams(calibration="off"))
    for before, after in zip(frames, result, strict=True):
        np.testing.assert_array_equal(before.markers, after.markers)


def test_second_session_loads_and_gives_identical_output(tmp_path):
    frames, limbs = list(arm_frames(120)), LimbTable()
    first = list(optimize(frames, ARM, OptimizeParams(refine=False), limbs=limbs))
    limbs.save(tmp_path / "limbs.toml")
    second = optimize(frames, ARM, limbs=LimbTable.load(tmp_path / "limbs.toml"))
    assert all(
        a.markers.tobytes() == b.markers.tobytes() for a, b in zip(first, second, strict=True)
    )


def test_loaded_limbs_follow_a_person_of_another_id():
    limbs = LimbTable({5: measured_limbs(arm_frames(100)).people[0]})
    assert list(limbs.people) == [5]
    result = list(optimize(arm_frames(3, ids=(5,)), ARM, limbs=limbs))
    assert lengths(result)[0] == pytest.approx(limbs.lengths(5, ARM), abs=1e-4)


def test_links_without_a_name_of_their_own_go_by_id():
    model = SkeletonModel.of("abcd", [("", 0, 1), ("x", 1, 2), ("x", 2, 3)])
    assert link_keys(model) == ("link 0", "link 1", "link 2")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("person = 3", "person: should be a valid dictionary"),
        ("", "person: is missing"),
        ("x = 1\n[person.0]", "x: there is no such key"),
        ("[person.x.palm]\nlength = 1", "person.x: should be a valid integer"),
        ("[person.-1.palm]\nlength = 1", "person.-1: should be greater than or equal to 0"),
        ("[person.0.palm]\nlength = -1", "person.0.palm.length: should be greater than 0, is -1"),
        ("[person.0.palm]\nlength = 0", "person.0.palm.length: should be greater than 0"),
        ("[person.0.palm]\nlength = inf", "person.0.palm.length: should be a finite number"),
        ("[person.0.palm]\nlength = 'long'", "person.0.palm.length: should be a valid number"),
        ("[person.0.palm]\nlength = true", "person.0.palm.length: should be a valid number"),
        ("[person.0.palm]\nlength = 1\ndeviation = -1", "palm.deviation: should be greater"),
        ("[person.0.palm]\nlength = 1\nframes = -1", "palm.frames: should be greater"),
        ("[person.0.palm]\nheight = 1", "person.0.palm.length: is missing"),
        ("[person.0.palm]\nlength = 1\nheight = 1", "person.0.palm.height"),
        ("[person.0]\npalm = 1", "person.0.palm: should be a dictionary"),
        ("[[", "not TOML: "),
    ],
)
def test_bad_limb_file_names_file_and_link(tmp_path, text, message):
    path = tmp_path / "limbs.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as error:
        LimbTable.load(path)
    assert str(path) in str(error.value)


@given(
    st.dictionaries(
        st.integers(0, 99),
        st.dictionaries(
            st.text("aZ_0 .]#='\"\\é", min_size=1),
            st.builds(Limb, st.floats(0.001, 2), st.floats(0, 1), st.integers(0, 999)),
        ),
    )
)
@settings(max_examples=30, deadline=None)
def test_a_table_is_read_as_it_was_written(people):
    assert LimbTable.from_toml(LimbTable(people).to_toml(), "x").people == people


def test_missing_limb_file_is_an_error_that_names_it(tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere\.toml: cannot be read: No such file"):
        LimbTable.load(tmp_path / "nowhere.toml")
    with pytest.raises(ConfigError, match="No such file"):
        LimbTable().save(tmp_path / "nowhere" / "limbs.toml")


def test_limb_of_another_model_is_an_error_that_names_it():
    limbs = LimbTable({0: {"tail": Limb(0.3)}}, "cat.toml")
    with pytest.raises(ConfigError, match=r"cat\.toml: person 0: this log has no link 'tail'"):
        next(optimize(arm_frames(1), ARM, limbs=limbs))


def test_window_must_not_end_before_it_starts():
    with pytest.raises(ValueError, match="start must precede end"):
        OptimizeParams(calibration_windows=((3.0, 2.0),))
