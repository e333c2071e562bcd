"""Malaguti et al. 2019: association, filter, limb lengths, against the paper's equations."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares, linear_sum_assignment
from scipy.stats import chi2
from stick_figures import MODEL, POSE, SECOND, START, at, person, seen

from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.calibrate.noise import measure_noise
from hiros_mcap.config import load_config
from hiros_mcap.events import Events
from hiros_mcap.kernels import joint_filter as kernels
from hiros_mcap.skeletons import Floats, Frame, SkeletonModel
from hiros_mcap.stages.associate import AssociateParams, Centroid, associate, centroids
from hiros_mcap.stages.kalman import KalmanParams, kalman
from hiros_mcap.stages.moving_average import MovingAverageParams, moving_average
from hiros_mcap.stages.straighten import StraightenParams, link_order, straighten
from hiros_mcap.systems import chain_of

AT_ONCE = AssociateParams(confirm_detections=1)


def numbers(**changes: object) -> Floats:
    params = KalmanParams().model_copy(update=changes)
    return np.array([
        params.measurement_noise**2, params.process_noise**2, params.step, params.min_confidence,
        params.outlier_factor, params.max_outliers, params.use_confidence,
    ], float)  # fmt: skip


def measure(
    bank: Sequence[np.ndarray],
    counters: Sequence[np.ndarray],
    positions: Floats,
    confidences: Floats,
    values: Floats,
    dt: float = 0.0,
) -> int:
    """Feed one person's joints (M, 3) to the filters in row 0."""
    markers = np.full((1, len(positions), 19), np.nan)
    markers[0, :, :3] = positions
    zero = np.zeros(1, np.int64)
    return int(
        kernels.update(
            *bank, *counters, zero, zero.copy(), np.array([dt]), markers,
            np.ascontiguousarray(confidences)[None], np.zeros(1), values,
        )
    )  # fmt: skip


# -- association ---------------------------------------------------------------------------------


def test_m05_m06_cost_is_the_mahalanobis_distance_of_the_states() -> None:
    """The closed form equals eq 2 and 3 on the dense 4-state filter."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        root = rng.normal(size=(2, 2))
        p = root @ root.T
        track = Centroid(0, 0, *rng.normal(size=4), p[0, 0], p[0, 1], p[1, 1])
        covariance = np.kron(p, np.eye(2))
        place, noise = rng.normal(size=2), rng.uniform(0.05, 0.5)
        gain = covariance[:, :2] @ np.linalg.inv(covariance[:2, :2] + noise**2 * np.eye(2))
        moved = gain @ (place - [track.x, track.y])
        expected = moved @ np.linalg.inv(covariance) @ moved
        assert track.cost(*place, noise) == pytest.approx(expected, rel=1e-9)


def test_m05_prediction_and_correction_are_the_dense_filters() -> None:
    track = Centroid.at(0, 1.0, 2.0, 0.1)
    state, covariance = np.array([1.0, 2.0, 0, 0]), np.diag([0.01, 0.01, 1.0, 1.0])
    for k, (x, y) in enumerate([(1.1, 2.0), (1.3, 2.1), (1.4, 2.3)], start=1):
        dt, q = 0.1, 9.0 / 30
        move = np.eye(4)
        move[0, 2] = move[1, 3] = dt
        noise = q * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
        state, covariance = move @ state, move @ covariance @ move.T + noise
        gain = covariance[:, :2] @ np.linalg.inv(covariance[:2, :2] + 0.01 * np.eye(2))
        state = state + gain @ (np.array([x, y]) - state[:2])
        covariance = covariance - gain @ covariance[:2]
        track.predict(k * SECOND // 10, 3.0)
        track.correct(x, y, 0.1)
        assert [track.x, track.y, track.vx, track.vy] == pytest.approx(state.tolist(), abs=1e-12)
        assert [track.p00, track.p01, track.p11] == pytest.approx(
            [covariance[0, 0], covariance[0, 2], covariance[2, 2]], abs=1e-12
        )


def test_m08_gate_is_the_chi_squared_quantile() -> None:
    assert AssociateParams().gate == pytest.approx(chi2.ppf(0.999, 4), abs=5e-4)


def test_m07_assignment_has_the_least_sum() -> None:
    """Two people pass each other; each keeps the id that the dense Hungarian algorithm gives."""
    frames = [
        seen([person(-1 + 0.05 * k), person(1 - 0.05 * k, 0.3)], at(k), ids=[-1, -1])
        for k in range(40)
    ]
    for frame in associate(frames, MODEL, AT_ONCE):
        assert frame.ids.tolist() == [0, 1]
    cost = np.array([[0.3, 0.2], [0.2, 5.0]])
    assert linear_sum_assignment(cost)[1].tolist() == [1, 0]


def test_m08_somebody_beyond_the_gate_is_new() -> None:
    frames = [seen([person()], at(k)) for k in range(10)]
    frames += [seen([person(), person(4.0)], at(10 + k)) for k in range(3)]
    ids = [frame.ids.tolist() for frame in associate(frames, MODEL, AT_ONCE)]
    assert ids[:10] == [[0]] * 10
    assert ids[10:] == [[0, 1]] * 3


def test_a_track_counts_after_three_detections_and_ends_after_the_gap() -> None:
    frames = [seen([person()], at(k)) for k in (0, 1, 2, 3, 33, 34, 120, 121, 122)]
    ids = [int(f.ids[0]) for f in associate(frames, MODEL)]
    assert ids == [-1, -1, 0, 0, 0, 0, -1, -1, 1]


def test_a_second_body_on_somebody_is_nobody() -> None:
    events = Events()
    frames = [seen([person(), person(0.1)], at(k)) for k in range(10)]
    frames = list(associate(frames, MODEL, AT_ONCE, events))
    assert [sorted(f.ids.tolist()) for f in frames[1:]] == [[-1, 0]] * 9
    assert events.total("duplicate") == 10


def test_centroids_are_means_of_what_is_known() -> None:
    poses = np.stack([POSE, POSE])
    poses[1, 2:] = np.nan
    assert centroids(poses)[1] == pytest.approx(POSE[:2, :2].mean(axis=0))
    assert np.isnan(centroids(np.full((1, 8, 3), np.nan))).all()


# -- filter --------------------------------------------------------------------------------------


def dense_step(
    x: Floats, p: Floats, dt: float, q: float, z: Floats, variances: Floats
) -> tuple[Floats, Floats]:
    """One step of the 6M-state filter; state is all positions, then all velocities."""
    n = len(x) // 2
    move = np.eye(2 * n)
    move[:n, n:] = dt * np.eye(n)
    noise = q * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(n))
    x, p = move @ x, move @ p @ move.T + noise
    known = ~np.isnan(z)
    h = np.eye(2 * n)[:n][known]
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + np.diag(variances[known]))
    return x + gain @ (z[known] - h @ x), p - gain @ h @ p


def test_m04_blocks_equal_the_dense_filter_to_1e_9() -> None:
    """15 joints, 90 states, 40 messages at uneven times, noise and gaps of their own per joint."""
    rng = np.random.default_rng(1)
    m = 15
    bank = [np.zeros((1, m, kernels.STATE)), np.zeros((1, m), bool), np.zeros((1, m, 0))]
    counters = [np.zeros((1, m), np.int64), np.zeros((1, m), np.int64)]
    values = numbers(history=0)
    first = rng.normal(size=(m, 3))
    confidences = np.ones(m)
    measure(bank, counters, first, confidences, values)
    x = np.concatenate([first.ravel(), np.zeros(3 * m)])
    p = np.diag(np.concatenate([np.full(3 * m, values[0]), np.ones(3 * m)]))
    for _ in range(40):
        dt = rng.uniform(0.001, 0.1)
        z = first + rng.normal(scale=0.1, size=(m, 3))
        z[rng.random(m) < 0.2] = np.nan
        confidences = rng.uniform(0.5, 1, m)
        measure(bank, counters, z, confidences, values, dt)
        variances = np.repeat(values[0] / confidences, 3)
        x, p = dense_step(x, p, dt, values[1] / 30, z.ravel(), variances)
    state = bank[0][0]
    assert np.abs(state[:, :3].ravel() - x[: 3 * m]).max() < 1e-9
    assert np.abs(state[:, 3:6].ravel() - x[3 * m :]).max() < 1e-9
    assert np.abs(state[:, 6] - np.diag(p)[: 3 * m : 3]).max() < 1e-9
    off = (
        p
        - np.diag(np.diag(p))
        - np.diag(np.diag(p, 3 * m), 3 * m)
        - np.diag(np.diag(p, -3 * m), -3 * m)
    )
    assert np.abs(off).max() == 0


def one_joint(state: Sequence[float]) -> tuple[Floats, Floats]:
    return np.array(state, float).reshape(1, 1, 9), np.ones((1, 1), bool)


def test_m10_five_steps_at_once_are_five_steps() -> None:
    start = [1, 2, 3, 0.1, -0.2, 0.3, 0.01, 0.002, 0.05]
    (once, known), (often, _) = one_joint(start), one_joint(start)
    kernels.predict(once, known, 0, 5 * 0.033, 64.0, 0.033)
    for _ in range(5):
        kernels.predict(often, known, 0, 0.033, 64.0, 0.033)
    assert (once == often).all()
    assert once[0, 0, :3] == pytest.approx([1 + 0.165 * 0.1, 2 - 0.165 * 0.2, 3 + 0.165 * 0.3])


def test_m09_process_noise_of_a_step_is_g_g_transposed() -> None:
    state, known = one_joint([0, 0, 0, 0, 0, 0, 0, 0, 0])
    kernels.predict(state, known, 0, 0.033, 4.0, 0.033)
    g = np.array([0.033**2 / 2, 0.033])
    expected = 4.0 * np.outer(g, g)
    assert state[0, 0, 6:] == pytest.approx([expected[0, 0], expected[0, 1], expected[1, 1]])


def corrected(
    state: Sequence[float], z: Sequence[float], confidence: float, **changes: object
) -> Floats:
    bank, known = one_joint(state)
    size = int(str(changes.get("history", 0)))
    zeros = np.zeros((1, 1), np.int64)
    banks, counters = [bank, known, np.zeros((1, 1, size))], [zeros, zeros.copy()]
    measure(banks, counters, np.array([z], float), np.array([confidence]), numbers(**changes))
    return bank[0, 0]


def test_m13_half_the_confidence_doubles_the_variance() -> None:
    """p = r: the gain is 1/2 at full confidence, 1/3 at one half."""
    r = 0.03**2
    assert corrected([0] * 6 + [r, 0, 1], [0.3, 0, 0], 1.0)[0] == pytest.approx(0.15)
    assert corrected([0] * 6 + [r, 0, 1], [0.3, 0, 0], 0.5)[0] == pytest.approx(0.1)
    assert corrected([0] * 6 + [r, 0, 1], [0.3, 0, 0], math.nan)[0] == pytest.approx(0.15)


def test_m14_below_one_half_the_prediction_stands() -> None:
    state = [1, 2, 3, 4, 5, 6, 0.01, 0.02, 0.03]
    assert corrected(state, [9, 9, 9], 0.49).tolist() == state


class Joint:
    """One joint with its history, fed with distances along x."""

    def __init__(self, **changes: object) -> None:
        self.values = numbers(**changes)
        self.bank = np.zeros((1, 1, 9))
        self.known = np.ones((1, 1), bool)
        self.history = np.zeros((1, 1, 15))
        self.filled = np.zeros((1, 1), np.int64)
        self.strikes = np.zeros((1, 1), np.int64)

    def take(self, distance: float, confidence: float) -> int:
        banks, counters = [self.bank, self.known, self.history], [self.filled, self.strikes]
        z = np.array([[distance, 0, 0.0]])
        return measure(banks, counters, z, np.array([confidence]), self.values)

    def feed(self, distance: float, variance: float = 0.0009) -> tuple[int, float]:
        """Measure ``distance`` from the state, whose variance is set; outliers and gain."""
        self.bank[0, 0] = [0, 0, 0, 0, 0, 0, variance, 0, 1]
        found = self.take(distance, 1.0)
        return found, float(self.bank[0, 0, 0] / distance)


def test_m15_m16_a_jump_of_four_thresholds_has_four_times_the_variance() -> None:
    joint = Joint()
    for k in range(15):
        assert joint.feed(0.01 if k else 0.02) == (0, pytest.approx(0.5))
    assert joint.feed(0.024) == (0, pytest.approx(0.5))  # the threshold is 1.25 x 20 mm
    for k in range(14):
        joint.feed(0.02 if k == 3 else 0.01)
    highest = joint.history.max()
    found, gain = joint.feed(4 * 1.25 * highest)
    assert found == 1
    assert gain == pytest.approx(1 / 5)


def test_m17_after_two_outliers_the_third_is_believed() -> None:
    joint = Joint()
    for _ in range(15):
        joint.feed(0.01)
    outcomes = [joint.feed(0.5) for _ in range(4)]
    assert [found for found, _ in outcomes] == [1, 1, 0, 0]
    assert outcomes[2][1] == pytest.approx(0.5)


def test_m17_a_real_fast_motion_is_followed_after_two_samples() -> None:
    """Still for a second, then a metre to the side for good."""
    frames = [seen([person(0.0 if k < 30 else 1.0)], at(k), ids=[0]) for k in range(36)]
    noisy = np.random.default_rng(2)
    for frame in frames:
        frame.positions[0] += noisy.normal(scale=0.005, size=(8, 3))
    x = [f.positions[0, :, 0].mean() for f in kalman(frames, MODEL)]
    assert x[30] < 0.5
    assert x[33] > 0.8


def test_m18_confidence_comes_before_outliers() -> None:
    """A joint that is not trusted neither counts as an outlier nor enters the history."""
    joint = Joint()
    for _ in range(15):
        joint.feed(0.01)
    before = joint.history.copy()
    found = joint.take(5.0, 0.3)
    assert found == 0
    assert (joint.history == before).all()


def moving(k: float) -> Floats:
    return person(0.4 * math.sin(0.1 * k), 0.01 * k)


@pytest.mark.parametrize("rates", [(30,), (15, 50), (15, 30, 50, 15, 30)])
def test_m02_one_output_per_message_and_no_delay(rates: tuple[int, ...]) -> None:
    """Cameras of any number and rate without a common clock: each message updates at once."""
    stamped = sorted(
        (at(0) + k * SECOND // rate + c * 1_000_003, f"c{c}")
        for c, rate in enumerate(rates)
        for k in range(rate)
    )
    frames = [seen([moving((t - at(0)) * 30e-9)], t, c, ids=[0]) for t, c in stamped]
    fused = list(kalman(frames, MODEL))
    assert [f.stamp for f in fused] == [f.stamp for f in frames]
    assert [f.log_time for f in fused] == [f.log_time for f in frames]
    assert not any((new.positions == old.positions).all() for old, new in pairwise(fused))


def test_at_a_fixed_rate_on_request() -> None:
    frames = [seen([moving(k)], at(k), ids=[0]) for k in range(60)]
    stamps = [f.stamp for f in kalman(frames, MODEL, KalmanParams(rate=50.0))]
    assert np.diff(stamps).tolist() == [20_000_000] * (len(stamps) - 1)
    assert 97 < len(stamps) <= 100


def test_velocities_are_filled_and_right() -> None:
    frames = [seen([person(0.03 * k)], at(k), ids=[0]) for k in range(90)]
    (*_, last) = kalman(frames, MODEL)
    assert last.velocities[0, 0] == pytest.approx([0.9, 0, 0], abs=0.02)


def test_m23_two_people_are_two_single_runs_bit_for_bit() -> None:
    both = [seen([moving(k), person(2.0, 0.02 * k)], at(k), ids=[0, 1]) for k in range(50)]
    alone = [[f.select([row]) for f in both] for row in (0, 1)]
    together = list(kalman(both, MODEL))
    for row in (0, 1):
        for one, two in zip(kalman(alone[row], MODEL), together, strict=True):
            assert (one.markers[0] == two.markers[row]).all(where=~np.isnan(two.markers[row]))


def test_a_late_message_is_counted_and_left_out() -> None:
    events = Events()
    frames = [seen([person()], at(k), ids=[0]) for k in (0, 1, 2, 1, 3)]
    assert len(list(kalman(frames, MODEL, events=events))) == 4
    assert events.total("too late to be merged") == 1


def test_somebody_who_is_gone_is_not_carried_on() -> None:
    frames = [
        seen([person()] if k < 10 else [], at(k), ids=[0] if k < 10 else []) for k in range(30)
    ]
    counts = [f.n_people for f in kalman(frames, MODEL, KalmanParams(hold=0.2))]
    assert counts[:16] == [1] * 16
    assert counts[17:] == [0] * 13


# -- limb lengths ---------------------------------------------------------------------------------


def link_residuals(parent: Floats, theta: Floats, length: float) -> Callable[[Floats], Floats]:
    """Length and direction of equation 12, of one link."""

    def residuals(child: Floats) -> Floats:
        bone = child - parent
        size = float(np.linalg.norm(bone))
        return np.append(bone / size - theta, size - length)

    return residuals


def test_m20_m22_closed_form_is_the_minimum_of_eq12() -> None:
    """Levenberg-Marquardt, link by link from the root, ends where the closed form is."""
    rng = np.random.default_rng(3)
    links, order = np.ascontiguousarray(MODEL.links), link_order(MODEL)
    lengths = rng.uniform(0.2, 0.6, MODEL.n_links)
    for _ in range(5):
        given = POSE + rng.normal(scale=0.05, size=POSE.shape)
        block = np.full((1, len(given), 19), np.nan)
        block[0, :, :3] = given
        zero = np.zeros(1, np.int64)
        kernels.straighten(block, zero, lengths[None].copy(), np.array([1]), links, order, 1, 0.0)
        closed = block[0, :, :3]
        solved = given.copy()
        for k in order:
            parent, child = links[k]
            theta = given[child] - solved[parent]
            theta /= np.linalg.norm(theta)
            residuals = link_residuals(solved[parent].copy(), theta, float(lengths[k]))
            assert np.sum(residuals(closed[child]) ** 2) < 1e-20
            found = least_squares(residuals, given[child], method="lm", xtol=1e-15, ftol=1e-15)
            solved[child] = found.x
        assert np.abs(solved - closed).max() < 1e-9
        bones = np.linalg.norm(closed[links[:, 0]] - closed[links[:, 1]], axis=-1)
        assert np.abs(bones - lengths).max() < 1e-9


def test_m20_links_are_walked_from_the_root() -> None:
    assert link_order(MODEL).tolist() == [0, 3, 4, 1, 2, 5, 6]
    loop = SkeletonModel.of(
        ["a", "b", "c"], [("ab", 0, 1), ("bc", 1, 2), ("ca", 2, 0), ("ac", 0, 2)]
    )
    assert link_order(loop).tolist() == []  # nobody is a root in a ring
    fork = SkeletonModel.of(["a", "b", "c"], [("ab", 0, 1), ("bc", 1, 2), ("ac", 0, 2)])
    assert sorted(link_order(fork).tolist()) == [0, 2]


def scaled(size: float, n: int = 1) -> list[Frame]:
    frames = []
    for k in range(n):
        frame = seen([person()], at(k), ids=[0])
        frame.positions[0] *= size
        frames.append(frame)
    return frames


def test_m21_wrong_lengths_decay_steadily() -> None:
    """Lengths start 10 % too long; the error falls with every frame."""
    frames = scaled(1.1, 30) + [f.replace(stamp=f.stamp + SECOND) for f in scaled(1.0, 300)]
    result = list(straighten(frames, MODEL, StraightenParams(rate=0.01)))
    bones = [np.linalg.norm(f.positions[0, 1] - f.positions[0, 0]) - 0.5 for f in result[30:]]
    assert bones[0] == pytest.approx(0.05, rel=0.02)
    assert (np.diff(bones) < 0).all()
    assert bones[-1] < 0.1 * bones[0]


def test_m21_people_pass_unchanged_until_their_lengths_are_known() -> None:
    frames = scaled(1.0, 40)
    frames[3].markers[0, 6] = np.nan  # not a whole skeleton: does not count
    result = list(straighten(frames, MODEL))
    assert all((a.positions == b.positions).all() for a, b in zip(frames[:3], result, strict=False))
    table = LimbTable()
    list(straighten(scaled(1.0, 40), MODEL, limbs=table))
    assert table.people[0]["NECK"].length == pytest.approx(0.5)


def test_m19_chest_is_the_middle_of_shoulders_and_hips() -> None:
    names = ["chest", "LShoulder", "RShoulder", "LHip", "RHip"]
    model = SkeletonModel.of(names, [("", 0, k) for k in range(1, 5)])
    frame = Frame.empty(1, model, stamp=START)
    frame.ids[:], frame.positions[0] = 0, np.arange(15).reshape(5, 3)
    (out,) = straighten([frame], model, StraightenParams(chest_midpoint=True))
    assert out.positions[0, 0].tolist() == frame.positions[0, 1:].mean(axis=0).tolist()


# -- noise, baselines ------------------------------------------------------------------------------


def test_m12_noise_of_one_centimetre_is_found() -> None:
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


def test_openptrack_has_the_numbers_of_its_public_code() -> None:
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


def test_m34_mean_of_the_last_five_detections() -> None:
    frames = [seen([person(float(k))], at(k), ids=[0]) for k in range(10)]
    x = [f.positions[0, 0, 0] for f in moving_average(frames, MODEL)]
    assert x == pytest.approx([0, 0.5, 1, 1.5, 2, 3, 4, 5, 6, 7])
    late = [frames[0], frames[9].replace(stamp=at(0) + SECOND)]
    assert [f.positions[0, 0, 0] for f in moving_average(late, MODEL)] == [0, 9]
    params = MovingAverageParams(window=1)
    assert [f.positions[0, 0, 0] for f in moving_average(frames, MODEL, params)] == list(range(10))
