"""Malaguti et al. 2019: association, filter, limb lengths, against the paper's equations."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from builders import moved, same
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from stick_figures import MODEL, POSE, SECOND, START, at, person, seen

from hiros_mcap.body.limb_table import Limb, LimbTable
from hiros_mcap.body.link_levels import link_levels
from hiros_mcap.calibrate.noise import measure_noise
from hiros_mcap.config import load_config
from hiros_mcap.errors import ConfigError
from hiros_mcap.events import Events
from hiros_mcap.skeletons import Frame, People, SkeletonModel
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.malaguti.associate import (
    AssociateParams,
    Centroids,
    associate,
    association_cost,
    centroids_of,
    correct_track,
    predict_tracks,
    start_track,
)
from hiros_mcap.stages.malaguti.kalman import FilteredPeople, KalmanParams, kalman, update
from hiros_mcap.stages.malaguti.moving_average import MovingAverageParams, moving_average
from hiros_mcap.stages.malaguti.straighten import StraightenParams, straighten, straightened
from hiros_mcap.systems import chain_of

AT_ONCE = AssociateParams(confirm_detections=1)
EPS = 1e-12


# -- association (III-A) -------------------------------------------------------------------------


class Track:
    """One track of the association."""

    def __init__(self, noise=0.1, acceleration=3.0):
        self.past = Centroids(*map(np.zeros, ((1,), (1, 2, 2), (1, 2, 2), (1,))))
        constants = {"position_noise": noise, "acceleration": acceleration}
        self.params = type("Params", (AssociateParams,), constants)(gate=1e9)
        self.state, self.p = self.past.states[0], self.past.covariances[0]

    def start(self, place):
        start_track(self.past, 0, 0, place, self.params)

    def predict(self, stamp):
        predict_tracks(self.past, np.array([0]), stamp, self.params)

    def cost(self, place):
        return float(association_cost(self.past, np.array([0]), place[None], self.params)[0, 0])

    def correct(self, place):
        correct_track(self.past, 0, place, self.params)


def test_the_cost_is_the_mahalanobis_distance_of_the_states():
    """The closed form equals eq 2 and 3 on the dense filter of 4 states."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        root, noise = rng.normal(size=(2, 2)), rng.uniform(0.05, 0.5)
        p = root @ root.T
        track, place = Track(noise), rng.normal(size=2)
        track.state[:], track.p[:] = rng.normal(size=(2, 2)), p
        covariance = np.kron(p, np.eye(2))
        gain = covariance[:, :2] @ np.linalg.inv(covariance[:2, :2] + noise**2 * np.eye(2))
        step = gain @ (place - track.state[0])
        assert track.cost(place) == pytest.approx(step @ np.linalg.inv(covariance) @ step, rel=1e-9)


def test_a_track_is_the_dense_filter():
    track = Track()
    track.start(np.array([1.0, 2.0]))
    state, covariance = np.array([1.0, 2.0, 0, 0]), np.diag([0.01, 0.01, 1.0, 1.0])
    for k, place in enumerate([(1.1, 2.0), (1.3, 2.1), (1.4, 2.3)], start=1):
        z = np.array(place)
        state, covariance = dense_step(state, covariance, 0.1, 9.0 / 30, z, np.full(2, 0.01))
        track.predict(k * SECOND // 10)
        track.correct(z)
        assert track.state.ravel() == pytest.approx(state, abs=EPS)
        assert track.p == pytest.approx(covariance[::2, ::2], abs=EPS)


def test_the_gate_is_the_chi_squared_quantile():
    assert AssociateParams().gate == pytest.approx(chi2.ppf(0.999, 4), abs=5e-4)


def test_the_assignment_has_the_least_sum():
    """The nearest pair is 0.4 m from track 1 to the first detection; the sum wants it for 0."""
    frames = [seen([person(0.0), person(1.0)], at(k)) for k in range(10)]
    frames.append(seen([person(0.6), person(1.5)], at(10)))
    (*_, last) = associate(frames, MODEL, AssociateParams(confirm_detections=1, gate=1e6))
    assert last.ids.tolist() == [0, 1]


def test_somebody_beyond_the_gate_is_new():
    frames = [seen([person()], at(k)) for k in range(10)]
    frames += [seen([person(), person(4.0)], at(10 + k)) for k in range(3)]
    ids = [frame.ids.tolist() for frame in associate(frames, MODEL, AT_ONCE)]
    assert ids[:10] == [[0]] * 10
    assert ids[10:] == [[0, 1]] * 3


def test_a_track_counts_after_three_detections_and_ends_after_the_gap():
    events = Events()
    frames = [seen([person()], at(k)) for k in (0, 1, 2, 3, 33, 34, 120, 121, 122)]
    ids = [int(f.ids[0]) for f in associate(frames, MODEL, events=events)]
    assert ids == [-1, -1, 0, 0, 0, 0, -1, -1, 1]
    noted = [(event.kind, event.person, event.stamp) for event in events.log]
    born, lost, again = ("track born", 0, at(2)), ("track lost", 0, at(34)), at(122)
    assert noted == [born, lost, ("track born", 1, again)]
    assert events.total("not confirmed") == 4


def test_a_tentative_track_ends_without_a_note():
    events = Events()
    frames = [seen([person()], at(0)), seen([person()], at(100))]
    list(associate(frames, MODEL, events=events))
    assert not events.log


@pytest.mark.parametrize(("second", "expected"), [(0.29, [0, -1]), (0.31, [0, 1])])
def test_a_second_report_of_a_person_starts_no_track(second, expected):
    events = Events()
    frames = [seen([person(), person(second)], at(k)) for k in range(2)]
    params = AT_ONCE.model_copy(update={"gate": 0.1})
    assert next(associate(frames, MODEL, params, events)).ids.tolist() == expected
    assert events.total("duplicate") == expected.count(-1)


def test_a_detection_without_markers_is_nobody():
    frames = [seen([POSE * np.nan, person()], at(k)) for k in range(3)]
    assert [f.ids.tolist() for f in associate(frames, MODEL, AT_ONCE)] == [[-1, 0]] * 3


def test_centroids_are_means_of_what_is_known():
    frame = seen([POSE, POSE, POSE * np.nan], at(0))
    frame.markers[1, 2:] = np.nan
    places = centroids_of(frame)
    assert places[0] == pytest.approx(POSE.mean(axis=0))
    assert places[1] == pytest.approx(POSE[:2].mean(axis=0))
    assert np.isnan(places[2]).all()


# -- filter (III-B to III-D) ---------------------------------------------------------------------


def dense_step(x, p, dt, q, z, variances):
    """One step of the filter of all states: all positions, then all velocities."""
    n = len(x) // 2
    move = np.eye(2 * n)
    move[:n, n:] = dt * np.eye(n)
    noise = q * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(n))
    x, p = move @ x, move @ p @ move.T + noise
    known = ~np.isnan(z)
    h = np.eye(2 * n)[:n][known]
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + np.diag(variances[known]))
    return x + gain @ (z[known] - h @ x), p - gain @ h @ p


class Joints:
    """The filter of one person with M joints."""

    def __init__(self, joints=1, **changes):
        self.params = KalmanParams.model_validate(changes)
        bank = Bank(FilteredPeople.empty(joints, 0, self.params.history))
        bank.row(0, 0)
        self.past = bank.past
        self.x, self.p = self.past.states[0], self.past.covariances[0]
        self.now = self.past.stamps[:] = START

    def take(self, z, confidences=1.0, dt=0.0):
        """Measure positions (M, 3) ``dt`` s later; return how many are outliers."""
        people = People.allocate(1, len(z), 0)
        people.markers[:] = np.nan
        people.markers[0, :, :3], people.marker_confidences[0] = z, confidences
        self.now += round(dt * 1e9)
        return update(self.past, [0], people, self.now, np.zeros(1), self.params)

    def measure(self, distance, confidence=1.0):
        """Measure ``distance`` from a state as uncertain as a detection; outliers and gain."""
        self.past.started[:], self.x[:], self.p[:] = True, 0.0, np.diag([0.0009, 1])
        found = self.take(np.array([[distance, 0, 0]]), confidence)
        return found, float(self.x[0, 0, 0] / distance)

    def settle(self):
        """Fill the history with innovations of 10 mm."""
        for _ in range(15):
            assert self.measure(0.01) == (0, pytest.approx(0.5))


def test_joint_by_joint_equals_the_dense_filter():
    """15 joints, 90 states, 40 messages at uneven times, noise and gaps of their own per joint."""
    rng = np.random.default_rng(1)
    m, joints = 15, Joints(15, history=0)
    first = rng.normal(size=(m, 3))
    joints.take(first)
    x = np.concatenate([first.ravel(), np.zeros(3 * m)])
    p = np.diag(np.concatenate([np.full(3 * m, 0.03**2), np.ones(3 * m)]))
    for _ in range(40):
        dt = round(rng.uniform(0.001, 0.1), 9)
        z, confidences = first + rng.normal(scale=0.1, size=(m, 3)), rng.uniform(0.5, 1, m)
        z[rng.random(m) < 0.2] = np.nan
        joints.take(z, confidences, dt)
        x, p = dense_step(x, p, dt, 64.0 / 30, z.ravel(), np.repeat(0.03**2 / confidences, 3))
    assert np.abs(joints.x[:, 0].ravel() - x[: 3 * m]).max() < 1e-9
    assert np.abs(joints.x[:, 1].ravel() - x[3 * m :]).max() < 1e-9
    assert np.abs(joints.p[:, 0, 0] - np.diag(p)[: 3 * m : 3]).max() < 1e-9
    assert np.abs(joints.p[:, 1, 1] - np.diag(p)[3 * m :: 3]).max() < 1e-9
    diagonals = sum(np.diag(np.diag(p, k), k) for k in (0, 3 * m, -3 * m))
    assert np.abs(p - diagonals).max() == 0


NOTHING = np.full((1, 3), np.nan)


def test_five_steps_at_once_are_five_steps():
    once, often = Joints(step=0.033), Joints(step=0.033)
    for joints in (once, often):
        joints.take(np.array([[1.0, 2.0, 3.0]]))
        joints.x[0, 1] = 0.1, -0.2, 0.3
    once.take(NOTHING, dt=5 * 0.033 + 0.01)  # "approximated to an integer multiple"
    for _ in range(5):
        often.take(NOTHING, dt=0.033)
    assert (once.x == often.x).all()
    assert (once.p == often.p).all()
    assert once.x[0, 0] == pytest.approx([1 + 0.165 * 0.1, 2 - 0.165 * 0.2, 3 + 0.165 * 0.3])


def test_the_process_noise_of_a_step_is_g_g_transposed():
    joints = Joints(step=0.033, process_noise=2.0)
    joints.take(np.zeros((1, 3)))
    joints.p[:] = 0.0
    joints.take(NOTHING, dt=0.033)
    g = np.array([0.033**2 / 2, 0.033])
    assert joints.p[0] == pytest.approx(4.0 * np.outer(g, g), rel=1e-12)


@pytest.mark.parametrize(
    ("confidence", "gain"), [(1.0, 1 / 2), (0.5, 1 / 3), (math.nan, 1 / 2), (0.49, 0.0)]
)
def test_the_confidence_divides_the_variance_and_below_one_half_the_prediction_stands(
    confidence, gain
):
    joints = Joints()
    assert joints.measure(0.3, confidence) == (0, pytest.approx(gain))
    if not gain:
        assert joints.p[0].tolist() == [[0.0009, 0], [0, 1]]


def test_confidences_do_not_count_on_request():
    assert Joints(use_confidence=False).measure(0.3, 0.2)[1] == pytest.approx(0.5)


def test_a_confidence_of_zero_hardly_counts_where_all_are_accepted():
    assert Joints(min_confidence=0.0).measure(0.3, 0.0)[1] == pytest.approx(1 / 1001)


def test_a_jump_of_four_thresholds_has_four_times_the_variance():
    joints = Joints()
    assert joints.measure(0.02) == (0, pytest.approx(0.5))
    for _ in range(14):
        joints.measure(0.01)
    assert joints.measure(0.0249) == (0, pytest.approx(0.5))  # the threshold is 1.25 x 20 mm
    assert joints.measure(4 * 1.25 * 0.0249) == (1, pytest.approx(1 / 5))


def test_nothing_is_an_outlier_before_the_history_is_full():
    joints = Joints()
    for _ in range(14):
        joints.measure(0.01)
    assert joints.measure(1.0) == (0, pytest.approx(0.5))


def test_the_history_is_that_of_the_last_fifteen():
    joints = Joints()
    joints.measure(1.0)
    for _ in range(14):
        joints.measure(0.01)
    assert joints.measure(0.5)[0] == 0  # the first one still counts
    for _ in range(15):
        joints.measure(0.01)
    assert joints.measure(0.5)[0] == 1


def test_after_two_outliers_the_third_is_accepted():
    joints = Joints()
    joints.settle()
    outcomes = [joints.measure(0.5) for _ in range(4)]
    assert [found for found, _ in outcomes] == [1, 1, 0, 0]
    assert outcomes[2][1] == pytest.approx(0.5)


def test_after_an_accepted_jump_the_guard_is_on_again():
    joints = Joints()
    joints.settle()
    for _ in range(3):
        joints.measure(0.5)
    joints.settle()
    assert [joints.measure(0.5)[0] for _ in range(3)] == [1, 1, 0]


def test_only_outliers_in_a_row_count():
    joints = Joints()
    joints.settle()
    found = [joints.measure(d)[0] for d in (0.5, 0.01, 0.5, 0.01, 0.5)]
    assert found == [1, 0, 1, 0, 1]


def test_outliers_do_not_raise_the_threshold():
    joints = Joints(max_outliers=100)
    joints.settle()
    assert [joints.measure(0.5)[0] for _ in range(20)] == [1] * 20


def test_a_rejected_joint_neither_counts_as_outlier_nor_enters_the_history():
    joints = Joints()
    joints.settle()
    assert joints.measure(5.0, 0.3) == (0, 0.0)
    assert joints.measure(0.5)[0] == 1


def test_steady_motion_is_no_outlier_at_uneven_times():
    """As printed, with consecutive positions, most long intervals give outliers."""
    rng, events = np.random.default_rng(5), Events()
    ticks = np.cumsum([1 if k % 16 else 9 for k in range(160)]) / 8
    frames = [seen([person(0.03 * k)], at(k), ids=[0]) for k in ticks.tolist()]
    for frame in frames:
        frame.positions[:] += rng.normal(scale=0.001, size=(8, 3))
    list(kalman(frames, MODEL, events=events))
    as_printed = Events()
    list(kalman(frames, MODEL, KalmanParams(consecutive=True), as_printed))
    assert as_printed.total("outlier") >= 9 * 8
    assert events.total("outlier") < as_printed.total("outlier") / 4


@pytest.mark.parametrize(
    ("consecutive", "outliers", "x"), [(False, 0, 0.1 + 0.026 / 2), (True, 1, 0.1 + 0.026 / 3)]
)
def test_d_as_printed_is_between_consecutive_positions(consecutive, outliers, x):
    """The joint was at 0 and is expected at 100 mm, as uncertain as its detection at 126 mm.

    The threshold is 1.25 x 50.4 = 63 mm. The detection is 26 mm from the prediction, which is no
    outlier, and 126 mm from the joint's last position, which is two thresholds.
    """
    joints = Joints(consecutive=consecutive, process_noise=1e-6)
    joints.past.started[:], joints.x[0, 1, 0] = True, 1.0
    joints.p[:] = np.diag([0.0009, 0])
    joints.past.distances[0, 0], joints.past.remembered[0, 0] = 0.0504, 15
    assert joints.take(np.array([[0.126, 0, 0]]), dt=0.1) == outliers
    assert joints.x[0, 0, 0] == pytest.approx(x, abs=1e-9)
    assert joints.past.distances[0, 0, 0] == pytest.approx(x if consecutive else 0.026, abs=1e-9)


def test_as_printed_the_steps_of_outliers_are_in_the_history():
    joints = Joints(consecutive=True, history=2)
    assert [joints.measure(0.01) for _ in range(2)] == [(0, pytest.approx(0.5))] * 2  # 5 mm steps
    assert joints.measure(0.025) == (1, pytest.approx(1 / 5))  # 4 x 6.25 mm: another step of 5 mm
    assert joints.past.distances[0, 0] == pytest.approx([0.005, 0.005])
    assert joints.measure(0.025) == (1, pytest.approx(1 / 5))
    assert joints.measure(0.025) == (0, pytest.approx(1 / 2))  # o_max


def test_a_real_fast_motion_is_followed_after_two_samples():
    """Still for a second, then a metre to the side for good."""
    frames = [seen([person(0.0 if k < 30 else 1.0)], at(k), ids=[0]) for k in range(36)]
    noisy, events = np.random.default_rng(2), Events()
    for frame in frames:
        frame.positions[0] += noisy.normal(scale=0.005, size=(8, 3))
    x = [f.positions[0, :, 0].mean() for f in kalman(frames, MODEL, events=events)]
    assert x[30] < 0.5
    assert x[33] > 0.8
    assert events.counts["outlier", "a"] == events.total("outlier") >= 16


def moving(k):
    return person(0.4 * math.sin(0.1 * k), 0.01 * k)


@pytest.mark.parametrize("rates", [(30,), (15, 50), (15, 30, 50, 15, 30)])
def test_one_output_per_message_and_no_delay(rates):
    """Cameras of any number and rate without a common clock: each message updates at once."""
    stamped = sorted(
        (at(0) + k * SECOND // rate + c * 1_000_003, f"c{c}")
        for c, rate in enumerate(rates)
        for k in range(rate)
    )
    frames = [seen([moving((t - at(0)) * 30e-9)], t, c, ids=[0]) for t, c in stamped]
    fused = list(kalman(frames, MODEL, fixed_frame="lab"))
    assert [(f.stamp, f.log_time) for f in fused] == [(f.stamp, f.log_time) for f in frames]
    assert {(f.source, f.frame_id) for f in fused} == {("lab", "lab")}
    assert not any((new.positions == old.positions).all() for old, new in pairwise(fused))


def test_velocities_are_filled_and_right():
    frames = [seen([person(0.03 * k)], at(k), ids=[0]) for k in range(90)]
    (*_, last) = kalman(frames, MODEL)
    assert last.velocities[0, 0] == pytest.approx([0.9, 0, 0], abs=0.02)
    assert np.isnan(last.accelerations).all()


def test_an_unseen_joint_is_predicted_and_an_unknown_one_is_absent():
    frames = [seen([person(0.03 * k)], at(k), ids=[0]) for k in range(40)]
    for k, frame in enumerate(frames):
        frame.markers[0, 7] = np.nan
        if k >= 35:
            frame.markers[0, 6] = np.nan
    (*_, last) = kalman(frames, MODEL)
    assert last.positions[0, 6, 0] == pytest.approx(0.1 + 0.03 * 39, abs=0.01)
    assert np.isnan(last.markers[0, 7]).all()


def test_openptracks_range_noise_is_squared():
    """A camera 1 m away measures 0, one 3 m away 1: the gain is v1 / (v1 + v3)."""
    model = SkeletonModel.of(["JOINT"], [])
    cameras = {"near": np.array([1.0, 0, 0]), "far": np.array([1.0, 3.0, 0])}
    frames = [Frame.empty(1, model, stamp=START, source=c, frame_id="world") for c in cameras]
    for frame, x in zip(frames, (0.0, 1.0), strict=True):
        frame.ids[:], frame.positions[0, 0] = 0, [x, 0, 0]
    params = KalmanParams(range_noise=0.01)
    (*_, last) = kalman(frames, model, params, cameras=cameras)
    near, far = (0.03**2 + (0.01 * d**2) ** 2 for d in (1, 3))
    assert last.positions[0, 0, 0] == pytest.approx(near / (near + far), rel=1e-9)
    (*_, last) = kalman(frames, model, params)  # cameras whose places are not known
    assert last.positions[0, 0, 0] == pytest.approx(0.5)


@settings(deadline=None, max_examples=20)
@given(st.floats(-math.pi, math.pi), st.floats(-5, 5), st.integers(0, 2**32 - 1))
def test_the_filter_moves_with_its_frame_and_people_do_not_mix(angle, shift, seed):
    rng = np.random.default_rng(seed)
    frames = [seen([moving(k), person(2.0)], at(k), ids=[0, 1]) for k in range(25)]
    for frame in frames:
        frame.positions[:] += rng.standard_t(2, size=(2, 8, 3)) * 0.01
        frame.marker_confidences[:] = rng.random((2, 8))
    rotation, offset = Rotation.from_rotvec([0.3, angle, -angle]), np.array([shift, 1.0, -shift])
    expected = moved(list(kalman(frames, MODEL)), rotation, offset)
    for one, other in zip(kalman(moved(frames, rotation, offset), MODEL), expected, strict=True):
        assert np.allclose(one.markers, other.markers, rtol=0, atol=1e-9, equal_nan=True)
    alone = kalman([frame.select([1]) for frame in frames], MODEL)
    for one, both in zip(alone, kalman(frames, MODEL), strict=True):
        assert same(one, both.select([1]))


def test_a_late_message_is_counted_and_left_out():
    events = Events()
    frames = [seen([person()], at(k), ids=[0]) for k in (0, 1, 2, 1, 2, 3)]
    assert len(list(kalman(frames, MODEL, events=events))) == 5
    assert events.total("too late to be merged") == 1


def test_somebody_who_is_not_detected_is_held_for_a_while():
    """With the links and confidences of the newest detection."""
    frames = [
        seen([person(0.03 * k)] if k < 10 else [], at(k), ids=[0] if k < 10 else [], turns=True)
        for k in range(30)
    ]
    for frame in frames:
        frame.confidences[:], frame.link_confidences[:] = 0.7, 0.6
    out = list(kalman(frames, MODEL, KalmanParams()))
    assert [f.n_people for f in out] == [1] * 16 + [0] * 14
    assert out[15].positions[0, 0, 0] == pytest.approx(0.45, abs=0.05)
    assert same(out[15], out[9].replace(**held(out[15])))
    assert np.array_equal(out[15].links, frames[9].links, equal_nan=True)
    assert out[15].stamps.tolist() == [at(15)]


def held(frame):
    """Columns that a person who is held does not keep."""
    return {n: getattr(frame, n) for n in ("stamp", "log_time", "stamps", "markers")}


@pytest.mark.parametrize(("gap", "anew"), [(29, False), (31, True)])
def test_after_a_second_unseen_a_filter_starts_anew(gap, anew):
    frames = [seen([person()], at(k), ids=[0]) for k in range(10)]
    frames.append(seen([person(1.0)], at(9 + gap), ids=[0]))
    (*_, last) = kalman(frames, MODEL)
    assert bool(last.positions[0, 0, 0] == 1.0) is anew


def test_people_without_an_id_are_left_out_and_the_others_sorted():
    frames = [seen([person(), person(1), person(2)], at(k), ids=[5, -1, 3]) for k in range(3)]
    for frame in kalman(frames, MODEL):
        assert frame.ids.tolist() == [3, 5]
        assert frame.positions[:, 0, 0] == pytest.approx([2.0, 0.0])


# -- limb lengths (III-E) ------------------------------------------------------------------------


def link_residuals(parent, theta, length):
    """Length and direction of equation 12, of one link."""

    def residuals(child):
        link = child - parent
        size = float(np.linalg.norm(link))
        return np.append(link / size - theta, size - length)

    return residuals


def test_the_closed_form_is_the_minimum_of_eq_12():
    """Levenberg-Marquardt, link by link from the root, ends where the closed form is."""
    rng, levels = np.random.default_rng(3), link_levels(MODEL)
    lengths = rng.uniform(0.2, 0.6, MODEL.n_links)
    for _ in range(5):
        noisy = POSE + rng.normal(scale=0.05, size=POSE.shape)
        frame = seen([noisy], START)
        frame.positions[:] = straightened(frame.positions, lengths[None], MODEL.links, levels)
        closed, solved = frame.positions[0], noisy.copy()
        for k in np.concatenate(levels):
            parent, child = MODEL.links[k]
            theta = noisy[child] - solved[parent]
            theta /= np.linalg.norm(theta)
            residuals = link_residuals(solved[parent].copy(), theta, float(lengths[k]))
            assert np.sum(residuals(closed[child]) ** 2) < 1e-20
            found = least_squares(residuals, noisy[child], method="lm", xtol=1e-15, ftol=1e-15)
            solved[child] = found.x
        assert np.abs(solved - closed).max() < 1e-9
        assert np.abs(lengths_of(frame) - lengths).max() < 1e-9


def lengths_of(frame):
    """(L,) measured lengths of the first person's links, m."""
    ends = frame.positions[0][MODEL.links]
    return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)


TRUE = lengths_of(seen([POSE], START))


def test_links_are_walked_from_the_root():
    assert [level.tolist() for level in link_levels(MODEL)] == [[0, 3, 4], [1, 2], [5, 6]]
    loop = SkeletonModel.of(
        ["a", "b", "c"], [("ab", 0, 1), ("bc", 1, 2), ("ca", 2, 0), ("ac", 0, 2)]
    )
    assert link_levels(loop) == []  # nobody is a root in a ring
    fork = SkeletonModel.of(["a", "b", "c"], [("ab", 0, 1), ("bc", 1, 2), ("ac", 0, 2)])
    assert [level.tolist() for level in link_levels(fork)] == [[0, 2]]
    loose = SkeletonModel.of(["a", "b"], [("ab", 0, 1), ("none", -1, 1), ("of these", 0, -1)])
    assert [level.tolist() for level in link_levels(loose)] == [[0]]


def scaled(size, n=1, start=0):
    """Somebody of this size in ``n`` frames from frame ``start`` on."""
    frames = [seen([person()], at(start + k), ids=[0]) for k in range(n)]
    for frame in frames:
        frame.positions[0] *= size
    return frames


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_once_calibrated_all_lengths_are_constant_and_directions_kept(seed):
    rng = np.random.default_rng(seed)
    frames = scaled(1.0, 40)
    for frame in frames[30:]:
        frame.positions[0] += rng.normal(scale=0.05, size=POSE.shape)
    out = list(straighten(frames, MODEL, StraightenParams(rate=0.0)))
    for before, after in zip(frames[30:], out[30:], strict=True):
        assert lengths_of(after) == pytest.approx(TRUE, abs=1e-9)
        assert (after.positions[0, 0] == before.positions[0, 0]).all()  # the root stays
        neck = before.positions[0, 1] - before.positions[0, 0]
        moved_to = after.positions[0, 1] - after.positions[0, 0]
        assert np.cross(neck, moved_to) == pytest.approx(np.zeros(3), abs=EPS)


def test_wrong_lengths_decay_steadily():
    """Lengths start 10 % too long; the error falls with every frame."""
    frames = scaled(1.1, 30) + scaled(1.0, 300, 60)
    result = list(straighten(frames, MODEL, StraightenParams(rate=0.01)))
    errors = [lengths_of(f)[0] - 0.5 for f in result[30:]]
    assert errors == pytest.approx([0.05 * 0.99 ** (k + 1) for k in range(300)], abs=1e-9)


def test_lengths_are_learned_from_whole_frames_only():
    """Half of the frames lack a wrist and show somebody twice as large."""
    partial = scaled(2.0, 60)
    for frame in partial:
        frame.markers[0, 6] = np.nan
    frames = [f for k, whole in enumerate(scaled(1.0, 60)) for f in (partial[k], whole)]
    events, table = Events(), LimbTable()
    out = list(straighten(frames, MODEL, StraightenParams(rate=0.0), events, table))
    assert [(e.kind, e.person, e.stamp) for e in events.log] == [("limbs calibrated", 0, at(29))]
    lengths = [limb.length for limb in table.people[0].values()]
    assert lengths == pytest.approx(TRUE.tolist(), abs=1e-9)
    assert all(map(same, frames[:59], out))
    assert np.nanmax(lengths_of(out[60])) < 0.6  # partial ones are straightened, too
    assert {limb.frames for limb in table.people[0].values()} == {30}


def test_the_first_lengths_are_means():
    table = LimbTable()
    list(straighten(scaled(0.9, 10) + scaled(1.2, 20, 10), MODEL, limbs=table))
    neck = table.people[0]["NECK"]
    assert neck.length == pytest.approx(0.5 * 1.1)
    assert neck.deviation == pytest.approx(0.5 * np.std([0.9] * 10 + [1.2] * 20))


def test_people_without_an_id_pass_unchanged():
    frames = [seen([person(), 1.5 * person()], at(k), ids=[0, -1]) for k in range(40)]
    for before, after in zip(frames, straighten(frames, MODEL), strict=True):
        assert (after.positions[1] == before.positions[1]).all()


def test_who_comes_back_after_ten_seconds_is_measured_again():
    table, events = LimbTable(), Events()
    frames = scaled(1.0, 30) + scaled(1.1, 30, 270) + scaled(1.2, 30, 700)
    out = list(straighten(frames, MODEL, events=events, limbs=table))
    assert lengths_of(out[59])[0] == pytest.approx(0.5, abs=0.005)
    assert lengths_of(out[60])[0] == pytest.approx(0.6)
    assert [e.stamp for e in events.log] == [at(29), at(729)]


def test_lengths_of_who_left_are_in_the_table():
    table = LimbTable()
    later = seen([person()], at(900), ids=[1])
    list(straighten([*scaled(1.0, 40), later], MODEL, limbs=table))
    assert list(table.people) == [0]


def test_the_chest_is_the_middle_of_shoulders_and_hips():
    names = ["chest", "LShoulder", "RShoulder", "LHip", "RHip"]
    model = SkeletonModel.of(names, [("", 0, k) for k in range(1, 5)])
    frame = Frame.empty(1, model, stamp=START)
    frame.ids[:], frame.positions[0] = 0, np.arange(15).reshape(5, 3)
    (out,) = straighten([frame], model, StraightenParams(chest_midpoint=True))
    assert out.positions[0, 0].tolist() == frame.positions[0, 1:].mean(axis=0).tolist()
    (plain,) = straighten([frame], model)
    assert (plain.positions == frame.positions).all()


@pytest.mark.parametrize("name", ["HEAD", "Nose"])
def test_the_head_can_be_left_out_of_the_tree(name):
    """Nobody ever sees it whole; with the head, the lengths of the others stay unknown."""
    model = SkeletonModel.of(
        ["PELVIS", "NECK", name, "EAR"], [("spine", 0, 1), ("head", 1, 2), ("ear", 2, 3)]
    )
    frames = [Frame.empty(1, model, stamp=at(k)) for k in range(40)]
    for k, frame in enumerate(frames):
        frame.ids[:], frame.positions[0] = 0, np.arange(12).reshape(4, 3)
        frame.positions[0, 1] *= 1.5 if k == 39 else 1.0
        frame.markers[0, 3] = np.nan
    *_, without = straighten(frames, model, StraightenParams(head=False, rate=0.0))
    spine = without.positions[0, 1] - without.positions[0, 0]
    assert np.linalg.norm(spine) == pytest.approx(math.sqrt(27))
    assert (without.positions[0, 2] == frames[39].positions[0, 2]).all()
    *_, with_head = straighten(frames, model, StraightenParams(rate=0.0))
    assert same(with_head, frames[39])


def test_a_head_that_is_the_root_can_be_left_out():
    model = SkeletonModel.of(["head", "neck", "hip"], [("", 0, 1), ("", 1, 2)])
    assert [level.tolist() for level in link_levels(model)] == [[0], [1]]
    assert [level.tolist() for level in link_levels(model, [0])] == [[1]]


def test_given_lengths_hold_from_the_first_frame_and_are_kept():
    """Person 0 has all lengths but one; person 1 is measured as usual."""
    frames = [seen([person(), person(2)], at(k), ids=[0, 1]) for k in range(60)]
    given = {name: Limb(1.1 * x, 0.01, 7) for name, x in zip(MODEL.link_names, TRUE, strict=True)}
    del given["WRIST_LEFT"]
    table, events = LimbTable({0: dict(given)}), Events()
    out = list(straighten(frames, MODEL, StraightenParams(rate=0.5), events, table))
    for frame in out:
        assert lengths_of(frame)[:5] == pytest.approx(1.1 * TRUE[:5])
    assert (out[0].positions[0, 6] == frames[0].positions[0, 6]).all()
    assert table.people[0] == given
    assert [(e.kind, e.person) for e in events.log] == [("limbs calibrated", 1)]


def test_given_lengths_of_unknown_links_are_refused():
    table = LimbTable({0: {"TAIL": Limb(0.3)}})
    with pytest.raises(ConfigError, match="person 0: this log has no link 'TAIL'"):
        next(straighten(scaled(1.0), MODEL, limbs=table))


# -- noise, baselines ------------------------------------------------------------------------------


def test_noise_of_one_centimetre_is_found():
    rng = np.random.default_rng(4)
    frames = []
    for k in range(400):
        frame = seen([person()], at(k), f"c{k % 2}", ids=[0])
        frame.positions[0] += rng.normal(scale=0.01, size=(8, 3)) + 0.05 * (k % 2)
        frames.append(frame)
    found = measure_noise(frames, MODEL)
    assert found.deviation == pytest.approx(0.01, rel=0.05)
    assert set(found.cameras) == {"c0", "c1"}
    assert found.detections == 400


def test_openptrack_has_the_numbers_of_its_public_code():
    """Variances 0.036 and 100, gate of 99.9 %, three detections, 8 s; no outliers."""
    config = load_config(system="openptrack")
    kalman_params, association = config.kalman, config.associate
    assert kalman_params.measurement_noise**2 == pytest.approx(0.036, rel=0.01)
    assert kalman_params.process_noise**2 == pytest.approx(100)
    assert kalman_params.range_noise == pytest.approx(0.005 / 1.96, rel=0.02)
    assert not kalman_params.use_confidence
    assert (kalman_params.min_confidence, kalman_params.history) == (0, 0)
    assert association.gate == pytest.approx(chi2.ppf(0.999, 4), abs=5e-4)
    assert association.confirm_detections == 3
    assert association.max_gap == kalman_params.max_gap == 8
    assert chain_of("openptrack") == ("tracked", "merged")


def test_the_moving_average_is_that_of_the_last_five_detections():
    frames = [seen([person(float(k))], at(k), ids=[0]) for k in range(10)]
    x = [f.positions[0, 0, 0] for f in moving_average(frames, MODEL)]
    assert x == pytest.approx([0, 0.5, 1, 1.5, 2, 3, 4, 5, 6, 7])
    params = MovingAverageParams(window=1)
    assert [f.positions[0, 0, 0] for f in moving_average(frames, MODEL, params)] == list(range(10))


@pytest.mark.parametrize(("late", "expected"), [(0.59, 4.0), (0.61, 6.0), (0.91, 9.0)])
def test_detections_count_for_point_six_seconds(late, expected):
    track = (0, 0.0), (3, 0.3), (9, late)
    frames = [seen([person(x)], at(0) + round(t * SECOND), ids=[0]) for x, t in track]
    (*_, last) = moving_average(frames, MODEL)
    assert last.positions[0, 0, 0] == expected


def test_each_joint_of_each_person_is_averaged_on_its_own():
    frames = [seen([person(k), person(9), person(-k)], at(k), ids=[0, -1, 1]) for k in range(3)]
    frames[1].markers[0, 2], frames[1].markers[2] = np.nan, np.nan
    (*_, last) = moving_average(frames, MODEL, fixed_frame="lab")
    assert (last.ids.tolist(), last.source) == ([0, 1], "lab")
    assert last.positions[:, 0, 0].tolist() == [1.0, -1.0]
    assert last.positions[0, 2, 0] == 1.0
    for frame in frames:
        frame.markers[0, 2] = np.nan
    (*_, last) = moving_average(frames, MODEL)
    assert np.isnan(last.positions[0, 2]).all()


# -- all stages ------------------------------------------------------------------------------------


def crossing():
    """Two people, one of whom comes and goes, by two cameras, with noise, gaps and a repeat."""
    rng, frames = np.random.default_rng(7), []
    for k in range(160):
        poses = [person(0.02 * k), person(1.0, 0.8 - 0.02 * k), person(0.02 * k + 0.25)]
        rows = [0, 1] if k % 50 < 25 else [0, 2]
        frame = seen([poses[i] for i in rows], at(k, k % 2), "ab"[k % 2], ids=[0, rows[1]])
        frame.positions[:] += rng.standard_t(2, size=(2, 8, 3)) * 0.02
        frame.marker_confidences[:] = rng.random((2, 8))
        frame.markers[rng.random((2, 8)) < 0.1] = np.nan
        frames.append(frame)
    return [f for k, f in enumerate(frames) if not 60 < k < 100] + frames[90:95]


CHANGES = [
    (associate, AssociateParams, name, value)
    for name, value in {
        "gate": 1e-3, "max_gap": 0.1, "confirm_detections": 1,
    }.items()
] + [
    (kalman, KalmanParams, name, value)
    for name, value in {
        "measurement_noise": 0.1, "process_noise": 1.0, "step": 0.033, "use_confidence": False,
        "min_confidence": 0.1, "history": 3, "outlier_factor": 2.0, "max_outliers": 0,
        "range_noise": 0.1, "max_gap": 0.5, "consecutive": True,
    }.items()
] + [
    (straighten, StraightenParams, "frames", 3), (straighten, StraightenParams, "rate", 0.5),
    (moving_average, MovingAverageParams, "window", 2),
]  # fmt: skip


@pytest.mark.parametrize(
    ("stage", "params", "name", "value"), CHANGES, ids=[f"{c[0].__name__}.{c[2]}" for c in CHANGES]
)
def test_every_parameter_changes_something(stage, params, name, value):
    more = {"cameras": {"a": np.zeros(3), "b": np.ones(3)}} if stage is kalman else {}

    def run(**changes):
        return list(stage(crossing(), MODEL, params.model_validate(changes), **more))

    plain, changed = run(), run(**{name: value})
    assert len(plain) != len(changed) or not all(map(same, plain, changed))


def test_the_parameters_above_are_all():
    named = {(params, name) for _, params, name, _ in CHANGES}
    named |= {(StraightenParams, "chest_midpoint"), (StraightenParams, "head")}
    named.add((AssociateParams, "reorder"))  # orders messages before the first stage
    kinds = AssociateParams, KalmanParams, StraightenParams, MovingAverageParams
    assert named == {(kind, name) for kind in kinds for name in kind.model_fields}
