"""The measures, on cases that can be worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stick_figures import MODEL, POSE, START, at, person, seen

from hiros_mcap.body.angles import flexions
from hiros_mcap.evaluate import PCK_MM, Truth, evaluate
from hiros_mcap.evaluate.mot import ALPHAS
from hiros_mcap.evaluate.scores import pck_curves
from hiros_mcap.skeletons import Frame, SkeletonModel

ARM = SkeletonModel.of(["Neck", "Pelvis", "LShoulder", "LElbow", "LWrist"], [])


def moving(k):
    return person(0.3 * math.sin(0.2 * k))


def frames(offset=0.0, late=0.0):
    return [
        seen([moving(k - late) + np.array([0, offset, 0]), person(2)], at(k), ids=[5, 7])
        for k in range(60)
    ]


TRUTH = Truth.of(seen([moving(k), person(2)], at(k), ids=[0, 1]) for k in range(60))


def test_a_perfect_result():
    scores = evaluate(frames(), TRUTH, MODEL)
    assert scores.mean == pytest.approx(0, abs=1e-9)
    assert (scores.missing, scores.false, scores.switches, scores.frames) == (0, 0, 0, 60)
    assert scores.limb_variation == pytest.approx(0, abs=1e-12)
    assert scores.lag == pytest.approx(0, abs=1)


def test_an_offset_of_one_person_in_two():
    scores = evaluate(frames(offset=0.02), TRUTH, MODEL)
    assert scores.mean == pytest.approx(10)
    assert scores.deviation == pytest.approx(10)
    assert np.isnan(scores.angle_rmse)  # the figure has no elbows and no knees


def test_a_late_result_has_that_lag():
    late = [f.select([0]) for f in frames(late=1.5)]
    truth = Truth.of(seen([moving(k)], at(k), ids=[0]) for k in range(60))
    assert evaluate(late, truth, MODEL).lag == pytest.approx(50, abs=2)


def test_the_error_at_its_lag_is_that_of_the_places_alone():
    aside = np.array([0.0, 0.03, 0.04])
    late = [seen([moving(k - 1.5) + aside], at(k), ids=[0]) for k in range(60)]
    truth = Truth.of(seen([moving(k)], at(k), ids=[0]) for k in range(60))
    assert evaluate(late, truth, MODEL).mean_at_lag == pytest.approx(50, abs=1)


@pytest.mark.parametrize("late_ms", [-146.5, -31.5, -3.5, 1.5, 3.5, 51.5, 58.5, 165.0])
def test_a_lag_between_those_that_are_tried(late_ms):
    """Lags are tried every 5 ms; the truth at 200 Hz."""
    x = [0.3 * math.sin(0.03 * k) for k in range(400)]
    truth = Truth.of(seen([person(x[k])], START + k * 5_000_000, ids=[0]) for k in range(400))
    late = round(late_ms * 1e6)
    result = [seen([person(x[k])], START + k * 5_000_000 + late, ids=[0]) for k in range(400)]
    scores = evaluate(result, truth, MODEL)
    assert scores.lag == pytest.approx(late_ms, abs=0.2)
    assert scores.mean_at_lag < 0.25 * scores.mean


def test_who_stands_still_has_no_lag_and_no_error_at_it():
    scores = evaluate(still(), Truth.of(still()), MODEL)
    assert np.isnan([scores.lag, scores.mean_at_lag]).all()


def test_who_is_missing_false_or_renamed():
    result = frames()
    result[10] = result[10].select([1])
    result[20] = seen([moving(20), person(2), person(9)], at(20), ids=[5, 7, 8])
    result[30:] = [f.replace(ids=np.array([6, 7], np.int32)) for f in result[30:]]
    scores = evaluate(result, TRUTH, MODEL)
    assert (scores.missing, scores.false, scores.switches) == (1, 1, 1)


def test_untracked_people_do_not_count():
    result = [f.replace(ids=np.array([-1, 7], np.int32)) for f in frames()]
    assert evaluate(result, TRUTH, MODEL).missing == 60


@pytest.mark.parametrize(("frames", "jitter"), [(60, 4), (3, 4), (2, np.nan)])
def test_jitter_is_the_mean_second_difference(frames, jitter):
    zigzag = [seen([person(0.001 * (-1) ** k)], at(k), ids=[0]) for k in range(frames)]
    truth = Truth.of(seen([person()], at(k), ids=[0]) for k in range(60))
    assert evaluate(zigzag, truth, MODEL).jitter == pytest.approx(jitter, nan_ok=True)


def test_limb_variation_is_that_of_the_lengths():
    breathing = [seen([person() * (1 + 0.1 * (-1) ** k)], at(k), ids=[0]) for k in range(60)]
    truth = Truth.of(seen([person()], at(k), ids=[0]) for k in range(60))
    assert evaluate(breathing, truth, MODEL).limb_variation == pytest.approx(0.1)


def test_the_truth_is_interpolated():
    between = [seen([(moving(k) + moving(k + 1)) / 2], at(k + 0.5), ids=[0]) for k in range(59)]
    truth = Truth.of(seen([moving(k)], at(k), ids=[0]) for k in range(60))
    assert evaluate(between, truth, MODEL).mean == pytest.approx(0, abs=1e-4)


def test_nothing_in_common_is_an_error():
    with pytest.raises(ValueError, match="no frame"):
        evaluate([seen([person()], at(1000), ids=[0])], TRUTH, MODEL)


def still(n=60, turn=0.0):
    """Somebody who stands; all links turned about the vertical by ``turn`` rad."""
    result = [seen([person()], at(k), ids=[0], turns=True) for k in range(n)]
    for frame in result:
        frame.links[0, :, 3:7] = [0.0, 0.0, math.sin(turn / 2), math.cos(turn / 2)]
    return result


@pytest.mark.parametrize("part", [slice(None, 3), slice(-3, None)])
def test_the_lag_is_that_of_instants_with_a_truth_at_all_lags(part):
    """At the ends of a truth there are fewer lags to compare."""
    poses = np.array([moving(k - 1.5) for k in range(60)])
    poses[part] += 0.3
    result = [seen([pose], at(k), ids=[0]) for k, pose in enumerate(poses)]
    truth = Truth.of(seen([moving(k)], at(k), ids=[0]) for k in range(60))
    assert evaluate(result, truth, MODEL).lag == pytest.approx(50, abs=2)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_logs_shorter_than_the_lags_that_are_tried(n):
    truth = Truth.of(seen([moving(k)], at(k), ids=[0]) for k in range(n))
    scores = evaluate([seen([moving(k)], at(k), ids=[0]) for k in range(n)], truth, MODEL)
    assert scores.mean == pytest.approx(0, abs=1e-9)
    assert scores.frames == n


def test_frames_outside_the_truth_do_not_count():
    truth = Truth.of(still()[20:40])
    assert evaluate(still(), truth, MODEL).frames == 20


def test_turned_links():
    scores = evaluate(still(turn=0.5), Truth.of(still()), MODEL)
    assert scores.orientation_error == pytest.approx(math.degrees(0.5))


def test_95_percent_of_the_errors_are_below():
    result = still(20)
    for k, frame in enumerate(result):
        frame.positions[0] += [0.001 * k, 0, 0]
    scores = evaluate(result, Truth.of(still(20)), MODEL)
    assert scores.percentile_95 == pytest.approx(np.percentile(np.arange(20).repeat(8), 95))
    assert scores.percentile_99 == pytest.approx(np.percentile(np.arange(20).repeat(8), 99))
    assert (scores.mean, scores.deviation) == pytest.approx((9.5, np.std(np.arange(20))))


def test_a_missing_marker_is_no_error():
    result = still()
    for frame in result:
        frame.markers[0, 6] = np.nan
    assert evaluate(result, Truth.of(still()), MODEL).mean == pytest.approx(0, abs=1e-9)


def test_two_who_swap_ids_are_two_switches():
    result = frames()
    result[30:] = [f.replace(ids=np.array([7, 5], np.int32)) for f in result[30:]]
    assert evaluate(result, TRUTH, MODEL).switches == 2


def test_an_id_that_comes_back_after_a_gap_is_no_switch():
    result = [f for k, f in enumerate(frames()) if not 20 <= k < 40]
    assert evaluate(result, TRUTH, MODEL).switches == 0


def bent(angle):
    """An arm hanging down whose forearm is bent by ``angle``, rad."""
    wrist = [0.3 * math.sin(angle), 0.2, 1.1 - 0.3 * math.cos(angle)]
    return np.array([[0, 0, 1.5], [0, 0, 1], [0, 0.2, 1.4], [0, 0.2, 1.1], wrist])


def arms(angles):
    result = []
    for k, angle in enumerate(angles):
        frame = Frame.empty(1, ARM, stamp=at(k), source="a")
        frame.ids[:], frame.positions[0] = 0, bent(angle)
        result.append(frame)
    return result


def test_eq20_angles_are_off_by_what_the_elbow_is():
    """Shoulder right, elbow off by +4 and -2 degrees in turn: RMSE over both joints, mean SD."""
    off = np.radians([4.0, -2.0] * 10)
    scores = evaluate(arms(1.0 + off), Truth.of(arms(np.full(20, 1.0))), ARM)
    assert scores.angle_rmse == pytest.approx(math.sqrt((16 + 4) / 2 / 2))
    assert scores.angle_deviation == pytest.approx((np.std([4, -2]) + 0) / 2)


def test_constant_offsets_of_two_joints_are_no_deviation():
    """One elbow always 10 degrees too far, the other always 10 degrees too little."""
    model = SkeletonModel.of(
        ["Neck", "Pelvis", "LShoulder", "LElbow", "LWrist", "RShoulder", "RElbow", "RWrist"], []
    )

    def both(left, right):
        frames = []
        for k in range(20):
            frame = Frame.empty(1, model, stamp=at(k), source="a")
            arm = bent(right)[2:] * [1, -1, 1]
            frame.ids[:], frame.positions[0] = 0, np.concatenate([bent(left), arm])
            frames.append(frame)
        return frames

    off = math.radians(10)
    scores = evaluate(both(1 + off, 1 - off), Truth.of(both(1, 1)), model)
    assert scores.angle_rmse == pytest.approx(10 / math.sqrt(2))  # two elbows of four joints
    assert scores.angle_deviation == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(("abduction", "left_out"), [(60.0, 0), (80.0, 20), (-89.0, 20)])
def test_near_singular_link_angles_are_left_out_and_counted(abduction, left_out):
    """A forearm whose x angle nears 90 degrees; the result is rotated by 2 degrees about y."""
    model = SkeletonModel.of(["LShoulder", "LElbow", "LWrist"], [("arm", 0, 1), ("fore", 1, 2)])

    def turned(y):
        frames = arms(np.full(20, 1.0))
        result = []
        for frame in frames:
            new = Frame.empty(1, model, stamp=frame.stamp, source="a")
            new.ids[:], new.positions[0] = 0, frame.positions[0, 2:]
            new.links[0, 0, 3:7] = [0, 0, 0, 1]
            turn = Rotation.from_euler("ZXY", [30, abduction, y], degrees=True)
            new.links[0, 1, 3:7] = turn.as_quat()
            result.append(new)
        return result

    elbow = evaluate(turned(2), Truth.of(turned(0)), model).link_angles["left elbow"]
    assert elbow.singular == left_out
    assert elbow.count == 20 - left_out


def lifted(flexion, abduction):
    """A straight right arm, lifted forwards and sideways by degrees; somebody who faces x."""
    model = ARM_AND_TRUNK
    turn = Rotation.from_euler("YXZ", [-flexion, -abduction, 0], degrees=True)
    shoulder = np.array([0, -0.2, 1.4])
    arm = [shoulder, *(shoulder + turn.apply([0, 0, -length]) for length in (0.3, 0.55))]
    pose = np.array([[0, 0, 1.5], [0, 0, 1], [0, 0.2, 1.4], *arm])
    frames = []
    for k in range(20):
        frame = Frame.empty(1, model, stamp=at(k), source="a")
        frame.ids[:], frame.positions[0] = 0, pose
        frames.append(frame)
    return frames


ARM_AND_TRUNK = SkeletonModel.of(
    ["Neck", "Pelvis", "LShoulder", "RShoulder", "RElbow", "RWrist"], []
)


def test_signed_angles_tell_forwards_from_sideways():
    """Both arms bend by 40 degrees from the trunk; one is lifted forwards, one backwards."""
    scores = evaluate(lifted(40, 0), Truth.of(lifted(-40, 0)), ARM_AND_TRUNK)
    assert scores.angles["right shoulder"].rmse == pytest.approx(0, abs=1e-6)
    assert scores.signed_angles["right shoulder flexion"].bias == pytest.approx(80)
    assert scores.signed_angles["right shoulder abduction"].bias == pytest.approx(0, abs=1e-6)
    assert "left knee flexion" not in scores.signed_angles


def test_the_flexion_of_an_arm_held_sideways_is_left_out_and_counted():
    scores = evaluate(lifted(0, 85), Truth.of(lifted(3, 85)), ARM_AND_TRUNK)
    flexion = scores.signed_angles["right shoulder flexion"]
    assert (flexion.count, flexion.singular) == (0, 20)
    assert scores.signed_angles["right shoulder elevation"].count == 20


@pytest.mark.parametrize("degrees", [0, 45, 90, 179])
def test_flexion_of_an_elbow(degrees):
    angles = flexions(ARM, bent(math.radians(degrees))[None])
    assert np.degrees(angles[0, 1]) == pytest.approx(degrees)


def test_somebody_farther_than_a_metre_is_somebody_else():
    away = [f.replace(markers=f.markers + np.eye(19)[0] * 1.01) for f in still()]
    scores = evaluate(away, Truth.of(still()), MODEL)
    assert (scores.missing, scores.false) == (60, 60)
    assert np.isnan(scores.mean)


def test_pck_parts_and_joints():
    """One wrist is 59 mm off, all else is right: 1 of 8 joints beyond 50 mm."""
    result = still()
    for frame in result:
        frame.positions[0, 6] += [0, 0, 0.059]
    scores = evaluate(result, Truth.of(still()), MODEL)
    assert scores.pck_at(50) == pytest.approx(7 / 8)
    assert scores.pck_at(60) == pytest.approx(1)
    assert scores.pck_at(50, "upper limbs") == pytest.approx(0.5)
    assert scores.joints["WRIST_LEFT"].mean == pytest.approx(59)
    assert scores.parts["upper limbs"].mean == pytest.approx(29.5)
    assert scores.parts["torso"].mean == pytest.approx(0, abs=1e-9)
    assert scores.rmse == pytest.approx(59 / math.sqrt(8))


def test_joints_that_a_result_lacks_are_within_no_threshold():
    """One of two people is missed in half of the frames; a wrist of the other in all but one."""
    result = [f.select([0]) if k % 2 else f for k, f in enumerate(frames())]
    for frame in result[1:]:
        frame.markers[0, 6] = np.nan
    assert evaluate(result, TRUTH, MODEL).pck_at(100) == pytest.approx(1 - (30 * 8 + 59) / 960)
    for frame in result:
        frame.markers[:, 6] = np.nan  # a detector without wrists
    assert evaluate(result, TRUTH, MODEL).pck_at(100) == pytest.approx(1 - 30 * 7 / 840)


def test_limb_error_against_the_true_length():
    """The wrist is moved along its limb by 20 mm: one of seven links is 20 mm too long."""
    result = still()
    limb = POSE[6] - POSE[2]
    for frame in result:
        frame.positions[0, 6] += 0.02 * limb / np.linalg.norm(limb)
    assert evaluate(result, Truth.of(still()), MODEL).limb_error == pytest.approx(20 / 7)


def test_a_constant_bias_of_five_degrees():
    truth = Truth.of(arms(np.full(20, 1.0)))
    elbow = evaluate(arms(np.full(20, 1.0 + math.radians(5))), truth, ARM).angles["left elbow"]
    assert (elbow.rmse, elbow.deviation, elbow.bias) == pytest.approx((5, 0, 5), abs=1e-9)


def test_the_first_frames_of_an_id_that_comes_later():
    """Person 7 appears at frame 20 and is 100 mm off for three frames."""
    result = [f.select([0]) if k < 20 else f for k, f in enumerate(frames())]
    for k in (20, 21, 22):
        result[k].positions[1] += [0, 0.1, 0]
    assert evaluate(result, TRUTH, MODEL).first_frames == pytest.approx(60)


def test_jitter_does_not_count_across_a_pause():
    rest = [f for k, f in enumerate(still()) if k < 20 or k >= 40]
    for frame in rest[20:]:
        frame.positions[0] += [0.5, 0, 0]
    assert evaluate(rest, Truth.of(still()), MODEL).jitter == pytest.approx(0, abs=1e-9)


def test_similarity_falls_to_zero_at_the_matching_distance():
    """Half a metre off: half similar at 1 m, three quarters at 2 m. HOTA counts this."""
    away = [f.replace(markers=f.markers + np.eye(19)[0] * 0.5) for f in still()]
    for distance, similarity in ((1.0, 0.5), (2.0, 0.75)):
        tracking = evaluate(away, Truth.of(still()), MODEL, distance).tracking
        assert tracking.hota == pytest.approx((similarity + 1e-9 >= ALPHAS).mean())


def test_a_joint_at_the_threshold_is_within_it():
    curve = pck_curves(np.full((1, 8), 50.0), MODEL, np.zeros(8))["all"]
    assert (curve[PCK_MM.index(45)], curve[PCK_MM.index(50)]) == (0, 1)


def test_limbs_are_compared_with_the_median_length_of_their_own_person():
    """A child beside an adult; in one true instant of 60 the child is a tenth too large."""
    child = POSE * 0.7 + [2.0, 0, 0]
    result = [seen([person(), child], at(k), ids=[0, 1]) for k in range(60)]
    truth = Truth.of(seen([person(), child], at(k), ids=[0, 1]) for k in range(60))
    truth.positions[30, 1] = 1.1 * child
    assert evaluate(result, truth, MODEL).limb_error == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(("sway_m", "is_known"), [(0.02, True), (0.003, False)])
def test_the_lag_of_somebody_who_sways(sway_m, is_known):
    """Less than 2 mm in 60 ms is noise, from which no lag is read."""
    sway = [seen([person(sway_m * math.sin(0.2 * k))], at(k), ids=[0]) for k in range(60)]
    assert np.isfinite(evaluate(sway, Truth.of(sway), MODEL).lag) == is_known
