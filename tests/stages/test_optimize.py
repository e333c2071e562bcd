"""The optimizer (Hi-ROS 2023, section 3.3): weights, outliers, energy, and moving people."""

import numpy as np
import pytest
from builders import at_once
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from skeleton_makers import (
    energies,
    energy_of,
    lengths_of,
    minimized,
    random_model,
    random_poses,
    scene_of,
)

from hiros_mcap.body.limb_table import Limb, LimbTable
from hiros_mcap.config import load_config
from hiros_mcap.events import Events
from hiros_mcap.skeletons import UNTRACKED, Frame, SkeletonModel
from hiros_mcap.stages.optimize.energy import (
    W_DISTAL,
    W_LENGTH,
    W_PROXIMAL,
    Energy,
    exact_weights,
    paper_weights,
)
from hiros_mcap.stages.optimize.normal_equations import (
    NormalEquations,
    solve_equations,
    topology_of,
)
from hiros_mcap.stages.optimize.optimize import OptimizeParams, optimize_blocks

optimize = at_once(optimize_blocks)

MODEL = SkeletonModel.of(
    ["pelvis", "chest", "shoulder", "elbow", "wrist", "hand", "hip", "knee"],
    [
        ("spine", 0, 1),
        ("clavicle", 1, 2),
        ("upper arm", 2, 3),
        ("forearm", 3, 4),
        ("palm", 4, 5),
        ("pelvis side", 0, 6),
        ("thigh", 6, 7),
    ],
)
POSE = np.array(
    [
        [0, 0, 1.0],
        [0, 0, 1.5],
        [0.2, 0, 1.5],
        [0.2, 0.1, 1.2],
        [0.2, 0.3, 1.1],
        [0.2, 0.4, 1.1],
        [0.1, 0, 1.0],
        [0.1, 0.1, 0.6],
    ]
)
LIMBS = LimbTable(
    {
        0: {
            name: Limb(float(np.linalg.norm(POSE[c] - POSE[p])))
            for name, (p, c) in zip(MODEL.link_names, MODEL.links, strict=True)
        }
    }
)
REMOVE = OptimizeParams(outliers="remove")
PAPER = load_config(preset="paper", system="hiros").optimize


def person(points=POSE, ids=(0,)):
    frame = Frame.empty(len(ids), MODEL)
    frame.ids[:] = ids
    frame.markers[:, :, :3] = points
    frame.links[:, :, 3:7] = [0, 0, 0, 1]
    return frame


def optimized(frame, params=OptimizeParams(), events=None):  # noqa: B008 - immutable
    return next(optimize([frame], MODEL, params, events, LIMBS))


def displaced(**offsets):
    points = POSE.copy()
    for name, offset in offsets.items():
        points[MODEL.marker_names.index(name)] += offset
    return points


# Weights, eq. 18


@pytest.mark.parametrize(
    ("ratio", "expected"), [(0.01, 0.398), (0.1, 0.631), (0.5, 0.871), (1.0, 1.0)]
)
def test_length_weight_is_the_papers(ratio, expected):
    model = SkeletonModel.of("ab", [("link", 0, 1)])
    start = np.array([[[0.0, 0, 0], [0.3 + 0.1 * ratio, 0, 0]]])
    w = energy_of(model, start, np.array([[0.3]])).weights[0, 0]
    assert w[0] == pytest.approx(expected, abs=5e-4)
    assert w[0] + w[1] + w[3] == pytest.approx(1.0, abs=2e-4)
    assert w[1] == w[2] == pytest.approx(w[3], abs=2e-4)


# Solver, eq. 14 to 19


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("loops", [0, 3])
def test_solution_is_a_minimum(loops, exact):
    rng = np.random.default_rng(loops)
    model = random_model(rng, loops=loops)
    energy = energy_of(model, *random_poses(model, 10, rng), exact)
    solved, failed = minimized(model, energy, 1e-9)
    lowest = energies(model, solved, energy)
    assert failed == 0
    assert (lowest <= energies(model, energy.start, energy)).all()
    for _ in range(20):
        near = solved + rng.normal(size=solved.shape) * 1e-5
        assert (energies(model, near, energy) >= lowest).all()


def test_two_markers_meet_where_the_hand_calculation_says():
    """E = w_l (0.12 - 2 x - 0.1)^2 + 2 w_p x^2 is least at x = 0.04 w_l / (4 w_l + 2 w_p)."""
    model = SkeletonModel.of("ab", [("link", 0, 1)])
    start, nominal = np.array([[[0.0, 0, 0], [0.12, 0, 0]]]), np.array([[0.1]])
    energy = energy_of(model, start, nominal)
    w_l, w_p = energy.weights[0, 0, :2]
    x = 0.04 * w_l / (4 * w_l + 2 * w_p)
    solved, _ = minimized(model, energy, 1e-12)
    np.testing.assert_allclose(solved[0], [[x, 0, 0], [0.12 - x, 0, 0]], atol=1e-12)


def test_marker_that_nothing_holds_stays():
    rng = np.random.default_rng(0)
    model = random_model(rng)
    start, nominal = random_poses(model, 1, rng, missing=0.0)
    nominal[:, model.links[:, 1] == 19] = np.nan
    solved, _ = minimized(model, energy_of(model, start, nominal), 1e-9)
    np.testing.assert_array_equal(solved[0, 19], start[0, 19])


@pytest.mark.parametrize("loops", [0, 1, 6])
def test_trees_fill_no_block(loops):
    rng = np.random.default_rng(1)
    for _ in range(20):
        model = random_model(rng, loops=loops)
        coupled = {tuple(sorted(pair)) for pair in model.links.tolist()}
        blocks = len(topology_of(model).row)
        assert blocks >= len(coupled)
        assert loops or blocks == len(coupled)


def test_outliers_are_sought_from_the_roots_outwards():
    model = SkeletonModel.of("abcd", [("tip", 2, 3), ("mid", 1, 2), ("base", 0, 1)])
    assert topology_of(model).outward.tolist() == [2, 1, 0]
    ring = SkeletonModel.of("abc", [("ab", 0, 1), ("bc", 1, 2), ("ca", 2, 0)])
    assert sorted(topology_of(ring).outward) == [0, 1, 2]


# Outliers, section 3.3.2


def test_stretched_forearm_removes_the_wrist_and_its_links_only():
    along = (POSE[4] - POSE[3]) / np.linalg.norm(POSE[4] - POSE[3])
    events = Events()
    result = optimized(person(displaced(wrist=0.15 * along)), REMOVE, events)
    absent = np.isnan(result.markers[0]).all(axis=1)
    assert [MODEL.marker_names[m] for m in np.flatnonzero(absent)] == ["wrist"]
    absent = np.isnan(result.links[0]).all(axis=1)
    assert [MODEL.link_names[k] for k in np.flatnonzero(absent)] == ["forearm", "palm"]
    assert events.counts["optimizer outlier", "wrist"] == 1


@pytest.mark.parametrize(("excess", "removed"), [(0.099, 0), (0.101, 1)])
def test_threshold_is_the_largest_length_error(excess, removed):
    frame = person(displaced(knee=(POSE[7] - POSE[6]) * excess / np.linalg.norm(POSE[7] - POSE[6])))
    assert np.isnan(optimized(frame, REMOVE).positions[0, 7]).all() == bool(removed)


@pytest.mark.parametrize("marker", MODEL.marker_names)
def test_any_displaced_marker_is_restored(marker):
    events = Events()
    result = optimized(person(displaced(**{marker: [0.4, 0.3, 0.2]})), events=events)
    slot = MODEL.marker_names.index(marker)
    error = np.linalg.norm(result.positions[0] - POSE, axis=1)
    assert events.counts["optimizer outlier", marker] == 1
    assert np.delete(error, slot).max() < 0.03
    assert lengths_of(MODEL, result.positions[0]) == pytest.approx(
        lengths_of(MODEL, POSE), abs=1e-3
    )


@pytest.mark.parametrize(("excess", "found"), [(0.099, 0), (0.102, 1)])
def test_only_a_larger_length_error_starts_the_search_for_outliers(excess, found):
    events = Events()
    away = (POSE[5] - POSE[4]) / np.linalg.norm(POSE[5] - POSE[4])
    optimized(person(displaced(hand=excess * away)), events=events)
    assert events.total("optimizer outlier") == found


def test_a_marker_that_moves_half_of_the_limit_is_an_outlier():
    """Two ends of a link, each off by less than half of the limit: neither is one."""
    away = (POSE[7] - POSE[6]) / np.linalg.norm(POSE[7] - POSE[6])
    events = Events()
    optimized(person(displaced(knee=0.14 * away)), OptimizeParams(max_length_error=0.13), events)
    assert events.counts["optimizer outlier", "knee"] == 1
    optimized(person(displaced(knee=0.14 * away, hip=-0.13 * away)), events=(events := Events()))
    assert events.total("optimizer outlier") == 2


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("wrong", range(8))
def test_the_measured_place_of_an_outlier_counts_next_to_nothing(wrong, exact):
    """At whichever end of a link it is; the links to it keep their lengths."""
    topology, outlier = topology_of(MODEL), np.zeros((1, 8), np.int32)
    outlier[0, wrong] = 1
    energy = Energy(POSE[None] * 1.05, lengths_of(MODEL, POSE[None]), np.empty((1, 7, 4)))
    if exact:
        exact_weights(energy, topology, outlier, np.ones((1, 8)))
    else:
        paper_weights(energy, topology, outlier, 0.1)
    ends = energy.weights[0, :, [W_PROXIMAL, W_DISTAL]].T
    assert (ends[MODEL.links == wrong] < 1e-3).all()
    assert (ends[MODEL.links != wrong] > 0.01).all()
    assert (energy.weights[0, (MODEL.links == wrong).any(axis=1), W_LENGTH] >= 1.0).all()


def test_confidence_decides_which_end_is_wrong():
    away = (POSE[7] - POSE[6]) / np.linalg.norm(POSE[7] - POSE[6])
    model = SkeletonModel.of("ab", [("link", 0, 1)])
    for wrong in (0, 1):
        frame = Frame.empty(1, model)
        frame.ids[:], frame.marker_confidences[:] = 0, 1.0
        frame.marker_confidences[0, wrong] = 0.1
        frame.markers[0, :, :3] = [[0, 0, 0], 0.6 * away]
        events, limbs = Events(), LimbTable({0: {"link": Limb(0.4)}})
        next(optimize([frame], model, events=events, limbs=limbs))
        assert events.counts == {("optimizer outlier", "ab"[wrong]): 1}


def test_where_outliers_are_put_does_not_hang_on_rounding():
    """Else a log gives other results on another machine, and neighbouring frames jump."""
    rng = np.random.default_rng(5)
    model = random_model(rng, markers=25)
    truth, nominal = random_poses(model, 300, rng, sd=0.0, missing=0.0)
    points = truth + rng.normal(size=truth.shape) * 0.02
    for pose in points:
        wrong = rng.choice(25, 4, replace=False)
        pose[wrong] += 0.5 * rng.normal(size=(4, 3))

    def restored(points):
        frame, limbs = scene_of(model, points, nominal)
        return next(optimize([frame], model, limbs=limbs)).positions

    usual = restored(points)
    other = restored(points * (1 + 1e-13 * rng.normal(size=points.shape)))
    difference = np.linalg.norm(usual - other, axis=2).max(axis=1)
    assert np.mean(difference > 1e-3) < 0.02
    assert np.median(np.linalg.norm(usual - truth, axis=2)) < 0.03


# For any skeleton


@given(st.integers(0, 10_000), st.integers(0, 3))
@settings(max_examples=20, deadline=None)
def test_skeletons_that_have_their_lengths_stay(seed, loops):
    rng = np.random.default_rng(seed)
    model = random_model(rng, loops=loops)
    start, nominal = random_poses(model, 3, rng, sd=0.0)
    frame, limbs = scene_of(model, start, nominal)
    for params in (OptimizeParams(), PAPER):
        result = next(optimize([frame], model, params, limbs=limbs)).positions
        np.testing.assert_allclose(result, start, atol=1e-7)


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_lengths_are_those_of_the_table(seed):
    rng = np.random.default_rng(seed)
    model = random_model(rng)
    start, nominal = random_poses(model, 3, rng)
    frame, limbs = scene_of(model, start, nominal)
    lengths = lengths_of(model, next(optimize([frame], model, limbs=limbs)).positions)
    np.testing.assert_array_equal(np.isnan(lengths), np.isnan(lengths_of(model, start)))
    assert np.nanmax(np.abs(lengths - nominal), initial=0.0) < 1e-3


@given(st.integers(0, 10_000), st.sampled_from([OptimizeParams(), PAPER]))
@settings(max_examples=20, deadline=None)
def test_a_rigid_motion_of_the_input_moves_the_result(seed, params):
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(random_state=seed), rng.normal(size=3)
    points = POSE + 0.02 * rng.normal(size=POSE.shape)
    moved = optimized(person(turn.apply(points) + shift), params).positions[0]
    expected = turn.apply(optimized(person(points), params).positions[0]) + shift
    np.testing.assert_allclose(moved, expected, atol=1e-6)


@given(st.integers(0, 10_000), st.integers(0, 5))
@settings(max_examples=20, deadline=None)
def test_steps_solve_the_normal_equations(seed, loops):
    rng = np.random.default_rng(seed)
    model = random_model(rng, markers=8, loops=loops)
    topology = topology_of(model)
    equations, dense = NormalEquations.of(topology), 20.0 * np.eye(24)
    equations.diagonal[:], equations.blocks[:] = 20.0 * np.eye(3), 0.0
    for p, d in topology.links:
        block = topology.block[p, d]
        coupling = rng.normal(size=(3, 3))
        coupling += coupling.T
        equations.blocks[block] += coupling
        for a, b in ((p, d), (d, p)):
            dense[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] += coupling
    equations.gradient[:] = rng.normal(size=(8, 3))
    expected = np.linalg.solve(dense, -equations.gradient.ravel())
    solve_equations(topology, 0.0, equations)
    np.testing.assert_allclose(equations.step.ravel(), expected, rtol=1e-6, atol=1e-6)


# The stage


@pytest.mark.parametrize("params", [OptimizeParams(), PAPER])
def test_perfect_pose_stays(params):
    np.testing.assert_allclose(optimized(person(), params).positions[0], POSE, atol=1e-9)


def test_lengths_become_exact():
    noisy = POSE + np.random.default_rng(2).normal(size=POSE.shape) * 0.015
    result = optimized(person(noisy))
    assert lengths_of(MODEL, result.positions[0]) == pytest.approx(
        lengths_of(MODEL, POSE), abs=1e-4
    )


def test_untracked_and_uncalibrated_people_are_byte_identical():
    frame = person(displaced(wrist=0.05), ids=(UNTRACKED, 0, 8))
    result = optimized(frame)
    for row in (0, 2):
        assert result.markers[row].tobytes() == frame.markers[row].tobytes()
        assert result.links[row].tobytes() == frame.links[row].tobytes()
    assert not np.array_equal(result.positions[1], frame.positions[1])


def test_people_do_not_influence_each_other():
    one, two = person(displaced(wrist=0.05)), person(displaced(knee=0.3))
    both = person(ids=(0, 0))
    both.markers[0], both.markers[1] = one.markers[0], two.markers[0]
    result = optimized(both)
    for row, frame in enumerate((one, two)):
        assert result.markers[row].tobytes() == optimized(frame).markers[0].tobytes()


def test_missing_markers_stay_missing():
    points = POSE.copy()
    points[3] = np.nan
    result = optimized(person(points)).positions[0]
    assert np.isnan(result).all(axis=1).tolist() == [False] * 3 + [True] + [False] * 4


def test_confident_markers_move_less():
    frame = person(displaced(knee=[0, 0, -0.05]))
    frame.marker_confidences[:] = 1.0
    frame.marker_confidences[0, 7] = 0.1
    moved = np.linalg.norm(optimized(frame).positions[0] - frame.positions[0], axis=1)
    assert moved[7] > 5 * moved[6] > 0


@pytest.mark.parametrize(("confidence", "counts_as"), [(np.nan, 1.0), (0.0, 0.01), (1.5, 1.0)])
def test_a_confidence_that_is_absent_or_beyond_its_limits_counts_as(confidence, counts_as):
    def positions(value):
        frame = person(displaced(wrist=[0.03, 0.0, 0.02], knee=[0.0, 0.03, 0.0]))
        frame.marker_confidences[:] = 0.5
        frame.marker_confidences[0, [4, 7]] = value
        return optimized(frame).positions

    np.testing.assert_array_equal(positions(confidence), positions(counts_as))
    assert np.abs(positions(0.5) - positions(counts_as)).max() > 1e-4


@pytest.mark.parametrize(("confidence", "share"), [(0.01, 1 / 2), (0.03, 3 / 4), (1.0, 100 / 101)])
def test_a_marker_of_no_confidence_moves_as_one_of_a_hundredth(confidence, share):
    model = SkeletonModel.of("ab", [("link", 0, 1)])
    frame, limbs = scene_of(model, np.array([[[0, 0, 0], [0.45, 0, 0]]]), np.array([[0.4]]))
    frame.marker_confidences[:] = 0.0, confidence
    moved = next(optimize([frame], model, limbs=limbs)).positions[0, 0, 0]
    assert moved == pytest.approx(share * 0.05, abs=1e-4)


def test_link_with_a_zero_length_or_no_marker_is_harmless():
    model = SkeletonModel.of("ab", [("link", 0, 1), ("nowhere", -1, 1), ("self", 1, 1)])
    frame = Frame.empty(1, model)
    frame.ids[:] = 0
    frame.markers[0, :, :3] = 1.0
    limbs = LimbTable({0: {"link": Limb(0.3)}})
    result = next(optimize([frame], model, limbs=limbs)).positions
    assert np.isfinite(result).all()


def test_models_without_links_and_frames_without_people_pass():
    model = SkeletonModel.of("ab", [])
    frames = [Frame.empty(n, model, stamp=n) for n in (0, 1, 2)]
    for frame in frames:
        frame.ids[:] = range(frame.n_people)
    for one, other in zip(optimize(frames, model), frames, strict=True):
        np.testing.assert_array_equal(one.markers, other.markers)
        assert one.stamp == other.stamp


def test_links_move_with_their_ends_and_keep_their_orientations():
    frame = person(displaced(hand=[0.03, 0.0, 0.0]))
    frame.links[0, 4, :3] = 0.5 * (frame.positions[0, 4] + frame.positions[0, 5])
    result = optimized(frame)
    middle = 0.5 * (result.positions[0, 4] + result.positions[0, 5])
    np.testing.assert_allclose(result.links[0, 4, :3], middle)
    np.testing.assert_array_equal(result.orientations, frame.orientations)


def test_a_link_of_the_right_length_moves_with_its_ends():
    """Its length has no weight (eq 18), but its neighbour moves an end."""
    frame = person(displaced(wrist=[0.02, 0.0, 0.0], hand=[0.02, 0.0, 0.0]))
    frame.links[0, 4, :3] = frame.positions[0, 4:6].mean(axis=0)
    result = optimized(frame, OptimizeParams(lengths="paper"))
    assert np.linalg.norm(result.positions[0, 4] - frame.positions[0, 4]) > 1e-4
    np.testing.assert_allclose(
        result.links[0, 4, :3], result.positions[0, 4:6].mean(axis=0), rtol=0, atol=1e-9
    )


def test_links_keep_their_measured_orientation_by_default():
    frame = person(displaced(hand=[0.03, 0.0, 0.0]))
    np.testing.assert_array_equal(optimized(frame).orientations, frame.orientations)


# On a moving person with coloured noise


def moving_people(count=450, sd=0.012, seed=3):
    """(truth, measured) of swinging limbs, with noise of 12 mm that is correlated over 0.3 s."""
    rng = np.random.default_rng(seed)
    truth = np.empty((count, *POSE.shape))
    noise = rng.normal(size=POSE.shape) * sd
    measured = np.empty_like(truth)
    ways = POSE[MODEL.links[:, 1]] - POSE[MODEL.links[:, 0]]
    for k in range(count):
        truth[k, 0] = POSE[0] + [0.01 * k, 0, 0]
        for link, (p, c) in enumerate(MODEL.links):
            angle = 0.5 * np.sin(0.1 * k + link)
            turn = [
                [1, 0, 0],
                [0, np.cos(angle), -np.sin(angle)],
                [0, np.sin(angle), np.cos(angle)],
            ]
            truth[k, c] = truth[k, p] + np.array(turn) @ ways[link]
        noise = 0.9 * noise + np.sqrt(1 - 0.9**2) * rng.normal(size=POSE.shape) * sd
        measured[k] = truth[k] + noise
    return truth, measured


def angle_rmse(points, truth):
    """RMSE, degrees, of the angles at shoulder and elbow."""

    def angles(x):
        u, v = x[:, [2, 3]] - x[:, [1, 2]], x[:, [3, 4]] - x[:, [2, 3]]
        cosine = np.sum(u * v, -1) / np.linalg.norm(u, axis=-1) / np.linalg.norm(v, axis=-1)
        return np.degrees(np.arccos(cosine))

    return np.sqrt(np.mean((angles(points) - angles(truth)) ** 2))


@pytest.mark.parametrize(
    ("lengths", "less"), [("exact", 10.0), ("paper", 3.0)], ids=["exact", "paper"]
)
def test_lengths_settle_while_angles_and_positions_keep_right(lengths, less):
    truth, measured = moving_people()
    frames = [person(points) for points in measured]
    frames = [frame.replace(stamp=k * 33_333_333) for k, frame in enumerate(frames)]
    result = np.array(
        [f.positions[0] for f in optimize(frames, MODEL, OptimizeParams(lengths=lengths))]
    )
    variation = [
        np.std(lengths_of(MODEL, x), 0) / np.mean(lengths_of(MODEL, x), 0)
        for x in (measured, result)
    ]
    error = [np.linalg.norm(x - truth, axis=-1).mean() for x in (measured, result)]
    assert np.mean(variation[1]) < np.mean(variation[0]) / less
    assert angle_rmse(result, truth) < angle_rmse(measured, truth) + 0.3
    assert error[1] < error[0]
