"""The steps of a calibration from people, one by one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from stick_figures import MIRROR, MODEL, POSE, person

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.calibrate.camera_views import (
    CameraView,
    PeopleFollowed,
    Sighting,
    _continue,
    find_tracklets,
)
from hiros_mcap.calibrate.coarse_clock import lag_candidates, landmarks_of, signatures_of
from hiros_mcap.calibrate.evidence import shared_view
from hiros_mcap.calibrate.gauge import (
    find_floor,
    moved,
    on_transforms,
    placement_error,
    without_tilted,
)
from hiros_mcap.calibrate.joint_refinement import Points, free_unknowns, refine, residuals_of
from hiros_mcap.calibrate.pair_pose import PairFit, chained, coarse_clocks, ranked, spanning_tree
from hiros_mcap.calibrate.people import _only_ambiguous
from hiros_mcap.calibrate.refinement import FROM_GIVEN, _certainty, refine_together
from hiros_mcap.calibrate.registration import kabsch
from hiros_mcap.calibrate.sampling import Rig, instants_of, sample
from hiros_mcap.calibrate.verdict import Evidence, verdict_of
from hiros_mcap.kernels.correlation import correlate
from hiros_mcap.kernels.local_line import Tracklet
from hiros_mcap.rays.image_tracks import lines_at

SIDES = symmetry_of(MODEL).mirror
GOOD = Evidence(share=1.0, residual=0.03, seconds=20.0, spread=1.0)


def walk(seconds):
    """(T, 8, 3) somebody who goes to and fro, and swings his arms."""
    poses = np.tile(POSE, (len(seconds), 1, 1))
    poses[:, :, 0] += (1.2 * np.sin(0.9 * seconds))[:, None]
    poses[:, :, 1] += (0.8 * np.sin(0.5 * seconds + 1.0))[:, None]
    poses[:, 6, 0] += 0.3 * np.sin(5.0 * seconds + 0.2 * seconds**2)
    poses[:, 7, 0] -= 0.3 * np.sin(5.0 * seconds + 0.2 * seconds**2)
    return poses


def view(name, turn, shift, clock=0.0):
    """The walk as an exact camera sees it; its stamps are early by ``clock``."""
    seconds = np.arange(0.0, 10.0, 1 / 30)
    poses = walk(seconds)
    seen = turn.inv().apply((poses - shift).reshape(-1, 3)).reshape(poses.shape)
    tracklet = Tracklet(seconds - clock, np.ascontiguousarray(seen), np.ones(poses.shape[:2]))
    return CameraView(name, name, [tracklet], 0.0, 0.1)


def test_a_tracklet_follows_each_of_two_people_and_ends_in_a_gap():
    seconds = [*np.arange(0, 1, 1 / 30), *np.arange(2, 3, 1 / 30)]
    frames = [Sighting(t, np.stack([person(t), person(-2 - t)]), np.ones((2, 8))) for t in seconds]
    swapped = [
        f._replace(positions=f.positions[::-1]) if k % 2 else f for k, f in enumerate(frames)
    ]
    tracks = find_tracklets(swapped, SIDES)
    assert [len(track.seconds) for track in tracks] == [30, 30, 30, 30]
    assert all(np.abs(np.diff(track.positions[:, 0, 0])).max() < 0.1 for track in tracks)


def test_a_tracklet_undoes_swapped_sides():
    frames = [Sighting(k / 30, person(0.01 * k)[None], np.ones((1, 8))) for k in range(30)]
    frames[10:20] = [f._replace(positions=f.positions[:, MIRROR]) for f in frames[10:20]]
    (track,) = find_tracklets(frames, SIDES)
    assert np.abs(np.diff(track.positions[:, 6], axis=0)).max() < 0.02


def test_two_detections_at_one_place_continue_one_person_and_nobody_comes_from_afar():
    last = [person(0), person(5)]
    poses = np.stack([person(9), person(0.02)[MIRROR], person(0.02)[MIRROR], person(5)])
    assert _continue(poses, last, SIDES) == ([-1, 0, -1, 1], [False, True, False, False])
    poses[1:] = np.nan
    assert _continue(poses, last, SIDES) == ([-1] * 4, [False] * 4)


def test_a_line_gives_position_and_velocity_at_any_time():
    seconds = np.arange(0.0, 1.0, 1 / 30)
    poses = POSE + np.array([0.5, -0.2, 0.1]) * seconds[:, None, None]
    weights = np.ones(poses.shape[:2])
    weights[:, 3] = 0.0
    lines = lines_at(Tracklet(seconds, poses, weights), np.array([0.205, 0.777]), half_width=0.1)
    assert lines.positions[1, 0] == pytest.approx(POSE[0] + 0.777 * np.array([0.5, -0.2, 0.1]))
    assert lines.velocities[0, 5] == pytest.approx([0.5, -0.2, 0.1])
    assert lines.weights[0, 3] == 0.0
    assert lines.weights[0, 0] > 1.0


def test_samples_of_nobody_have_as_many_joints_as_others():
    samples = sample([view("a", Rotation.identity(), np.zeros(3))], np.array([60.0]), Rig.alone(1))
    assert samples.lines.positions.shape == (0, 8, 3)
    assert samples.lines.weights.shape == (0, 8)
    empty = CameraView("a", "a", [], 0.0, 0.1)
    assert sample([empty], np.array([60.0]), Rig.alone(1)).lines.positions.shape == (0, 0, 3)


def test_certainty_is_in_standard_errors_whatever_the_unit_of_the_loss(monkeypatch):
    seconds = np.arange(0.0, 240.0, 0.1)
    losses = np.random.default_rng(2).normal(0.2, 1.0, len(seconds))
    refined: Any = SimpleNamespace(
        points=SimpleNamespace(seconds=seconds), rig=None, start=None, free=np.ones((2, 7), bool),
        residuals=SimpleNamespace(distances=np.ones(3)),
    )  # fmt: skip

    def certainty(values):
        monkeypatch.setattr("hiros_mcap.calibrate.refinement._held_out", lambda *_: values)
        return _certainty(refined, SIDES, 20.0)

    usual = losses.mean() / (losses.std() / np.sqrt(len(losses)))
    assert certainty(losses) == pytest.approx(usual, rel=0.3)
    assert certainty(1000.0 * losses) == pytest.approx(certainty(losses))


def test_the_lag_of_two_clocks_needs_no_pose():
    turn, shift = Rotation.from_euler("xyz", [0.3, 1.2, -0.8]), np.array([1.0, 2.0, 3.0])
    landmarks = landmarks_of(MODEL)
    cameras = [view("a", Rotation.identity(), np.zeros(3)), view("b", turn, shift, clock=1.4)]
    lag, pairs = lag_candidates(*(signatures_of(camera, landmarks) for camera in cameras))[0]
    assert lag == pytest.approx(-1.4, abs=0.05)
    assert pairs == [(0, 0)]


def test_neighbouring_lags_vote_together_and_pairs_add_up(monkeypatch):
    step, lone, side, shared = 0.05, 20, 60, 140
    votes = {"one": {lone: 4.0, side: 3.0, side + 1: 3.0, shared: 3.0}, "two": {shared: 3.0}}
    monkeypatch.setattr(
        "hiros_mcap.calibrate.coarse_clock.alikeness",
        lambda one, _, lags: np.array([votes[one].get(k, 0.0) for k in range(len(lags))]),
    )
    found = lag_candidates(["one", "two"], ["other"])
    places = [lag / step + 100 for lag, _ in found]
    assert places == pytest.approx([shared, side, lone], abs=1.01)
    assert [len(pairs) for _, pairs in found] == [2, 1, 1]


def test_log_times_hint_at_a_lag_that_many_people_hide(monkeypatch):
    monkeypatch.setattr("hiros_mcap.calibrate.pair_pose.lag_candidates", lambda *_: [])
    cameras = [
        view("a", Rotation.identity(), np.zeros(3)),
        view("b", Rotation.identity(), np.zeros(3), clock=6.0),
    ]
    found = coarse_clocks(cameras, Rig.alone(2), [2.0, 8.05], landmarks_of(MODEL), SIDES)
    assert found == pytest.approx([0.0, 6.0], abs=0.06)


@pytest.mark.parametrize(("clock", "hint"), [(1.4, 0.0), (6.0, 6.05), (0.0, 0.2)])
def test_at_given_poses_the_lag_is_where_people_fit(clock, hint):
    turn, shift = Rotation.from_euler("xyz", [0.3, 1.2, -0.8]), np.array([1.0, 2.0, 3.0])
    cameras = [view("a", Rotation.identity(), np.zeros(3)), view("b", turn, shift, clock=clock)]
    rig = Rig.alone(2)
    rig.rotations[1], rig.shifts[1] = turn.as_matrix(), shift
    found = coarse_clocks(cameras, rig, [0.0, hint], landmarks_of(MODEL), SIDES)
    assert found == pytest.approx([0.0, clock], abs=0.06)


def test_people_who_stand_still_fit_at_any_lag_and_the_stamps_stay():
    seconds = np.arange(0.0, 10.0, 1 / 30)
    poses = POSE + np.random.default_rng(1).normal(0, 0.01, (len(seconds), *POSE.shape))
    track = Tracklet(seconds, poses, np.ones(poses.shape[:2]))
    cameras = [CameraView(name, name, [track], 0.0, 0.1) for name in "ab"]
    found = coarse_clocks(cameras, Rig.alone(2), [0.0, 0.5], landmarks_of(MODEL), SIDES)
    assert found.tolist() == [0.0, 0.0]


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
@example(158)  # the start puts people 0.43 m off
def test_exact_cameras_are_found_exactly(seed):
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(random_state=seed), rng.normal(0, 2, 3)
    cameras = [view("a", Rotation.identity(), np.zeros(3)), view("b", turn, shift, clock=0.08)]
    near = Rotation.from_rotvec(rng.normal(0, 0.03, 3)) * turn
    start = Rig(
        np.stack([np.eye(3), near.as_matrix()]),
        np.stack([np.zeros(3), shift + rng.normal(0, 0.03, 3)]),
        np.zeros(2),
    )
    instants = instants_of(cameras, 60)
    rig, _ = refine(cameras, start, instants, SIDES, free=free_unknowns(2))
    assert rig.rotations[1] == pytest.approx(turn.as_matrix(), abs=1e-3)
    assert rig.shifts[1] == pytest.approx(shift, abs=2e-3)
    assert rig.clocks[1] == pytest.approx(0.08, abs=1e-3)


@pytest.mark.parametrize("points", [100, 300])
def test_where_joints_are_many_fewer_instants_are_enough(points):
    turn, shift = Rotation.from_euler("xyz", [0.3, 1.2, -0.8]), np.array([1.0, 2.0, 3.0])
    cameras = [view("a", Rotation.identity(), np.zeros(3)), view("b", turn, shift)]
    start = Rig.alone(2)
    start.rotations[1], start.shifts[1] = turn.as_matrix(), shift + 0.05
    found = refine_together(cameras, start, SIDES, FROM_GIVEN._replace(points=points))
    assert found.rig.shifts[1] == pytest.approx(shift, abs=2e-3)


def test_of_many_cameras_fewer_joints_are_enough_and_each_counts_at_some_instants():
    turns = [Rotation.from_euler("z", angle) for angle in (0.0, 0.5, 1.0, 1.5)]
    shifts = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    cameras = [view(n, t, p) for n, t, p in zip("abcd", turns, shifts, strict=True)]
    start = Rig.alone(4)
    start.rotations[:] = [turn.as_matrix() for turn in turns]
    start.shifts[1:] = shifts[1:] + 0.05
    whole, found = (
        refine_together(cameras, start, SIDES, FROM_GIVEN._replace(points=300, cameras=n))
        for n in (4, 2)
    )
    assert len(found.points.seconds) == pytest.approx(len(whole.points.seconds) / 2, rel=0.1)
    assert set(found.points.joints) == set(whole.points.joints)
    assert found.rig.shifts == pytest.approx(shifts, abs=2e-3)


def test_a_rival_is_a_pose_that_is_as_near_not_one_that_also_fits():
    near, far = np.full(50, 0.03), np.full(50, 0.07)
    turned = Rig.alone(2)
    turned.rotations[1] = np.diag([-1.0, -1.0, 1.0])
    best, rival = ranked([PairFit(turned, far, 50), PairFit(Rig.alone(2), near, 50)])
    assert best.residual == 0.03
    assert rival.quality < 0.2 * best.quality


def test_cameras_need_no_common_view_of_all():
    link = [PairFit(Rig.alone(2), np.full(50, 0.03), 50, quality=40.0)]
    tree, cameras = spanning_tree({(0, 1): link, (1, 2): link, (0, 2): []}, [0, 1, 2, 3])
    assert tree == [(0, 1), (1, 2)]
    assert cameras == [0, 1, 2]


def test_a_link_leads_back_to_a_camera_with_a_smaller_number():
    link = Rig.alone(2)
    link.shifts[1], link.clocks[1] = [1.0, 0.0, 0.0], 0.5
    fits = {pair: [PairFit(link, np.full(50, 0.03), 50, quality=40.0)] for pair in ((0, 2), (1, 2))}
    tree, cameras = spanning_tree(fits, [0, 1, 2])
    assert (tree, cameras) == ([(0, 2), (2, 1)], [0, 1, 2])
    rig = chained(tree, fits, 3)
    assert rig.shifts[:, 0].tolist() == [0.0, 0.0, 1.0]
    assert rig.clocks.tolist() == [0.0, 0.0, 0.5]
    assert not _only_ambiguous(1, tree, fits)


def test_the_rig_stays_though_one_camera_was_moved():
    rng = np.random.default_rng(1)
    turns = Rotation.random(5, random_state=2)
    rig = Rig(turns.as_matrix(), rng.normal(0, 3, (5, 3)), np.zeros(5))
    lab = Rotation.from_euler("z", 1.0)
    given = {c: Rigid((lab * turns[c]).as_quat(), lab.apply(rig.shifts[c]) + 4.0) for c in range(5)}
    given[2] = given[2]._replace(translation=given[2].translation + 0.1)
    placed = moved(rig, on_transforms(rig, given))
    others = [0, 1, 3, 4]
    wanted = np.stack([given[c].translation for c in others])
    assert placed.shifts[others] == pytest.approx(wanted, abs=0.003)


@pytest.mark.parametrize("seed", range(5))
def test_a_rig_that_contradicts_the_given_poses_stays_near_them(seed):
    """Two rooms, of whose people somebody made one: nothing fits, and nothing runs away."""
    turns = Rotation.random(4, random_state=seed)
    rig = Rig(turns[:2].as_matrix(), np.array([[0.0, 0.0, 0.0], [2.4, -0.3, 0.8]]), np.zeros(2))
    places = np.array([[-2.8, 2.3, 2.0], [15.2, 1.7, 2.0]])
    given = {c: Rigid(turns[c + 2].as_quat(), places[c]) for c in range(2)}
    placed = moved(rig, on_transforms(rig, given))
    apart = np.linalg.norm(placed.shifts[:, None] - places, axis=2)
    assert apart.min(axis=1).max() < 20.0


@pytest.mark.parametrize(
    ("lab", "kept"),
    [
        (Rotation.identity(), [0, 2]),
        (Rotation.from_euler("z", 1.0), [0, 2]),
        (Rotation.from_euler("x", 90, degrees=True), [0, 1, 2]),  # z is no way up there
    ],
)
def test_a_camera_by_which_the_floor_is_tilted_does_not_place_the_rig(lab, kept):
    turns = Rotation.random(3, random_state=2)
    rig = Rig(turns.as_matrix(), np.eye(3), np.zeros(3))
    given = {c: Rigid((lab * turns[c]).as_quat(), lab.apply(rig.shifts[c])) for c in range(3)}
    off = Rotation.from_rotvec([np.radians(6.0), 0.0, 0.0])
    given[1] = given[1]._replace(xyzw=(lab * off * turns[1]).as_quat())
    floor = np.array([0.0, 0.0, 1.0]), 0.0
    assert [*without_tilted(rig, given, floor)] == kept
    assert [*without_tilted(rig, given, None)] == [0, 1, 2]


def test_the_rig_stays_though_the_people_hardly_place_one_camera_in_it():
    turns = Rotation.random(3, random_state=2)
    rig = Rig(turns.as_matrix(), np.eye(3), np.zeros(3))
    given = {c: Rigid(turns[c].as_quat(), rig.shifts[c]) for c in range(3)}
    off = Rotation.from_rotvec([np.radians(1.0), 0, 0])
    rig.rotations[2] = (off * turns[2]).as_matrix()
    rig.shifts[2] += 0.03
    errors = np.array([[0.0, 0.0], [0.0, 0.0], [np.radians(2.0), 0.06]])
    placed = moved(rig, on_transforms(rig, given, errors))
    blind = moved(rig, on_transforms(rig, given))
    off = [np.abs(each.shifts[:2] - np.eye(3)[:2]).max() for each in (placed, blind)]
    assert off[0] < 0.5 * off[1]


def still(*places):
    """A view of people who stand at places (2,)."""
    seconds, ones = np.arange(0.0, 4.0, 1 / 30), np.ones((120, 8))
    poses = [np.tile(np.add(POSE, [x, y, 0.0]), (120, 1, 1)) for x, y in places]
    return CameraView("c", "c", [Tracklet(seconds, each, ones) for each in poses], 0.0, 0.1)


def common(*views):
    instants = np.arange(0.5, 3.5, 0.5)
    return shared_view(views, Rig.alone(len(views)), instants, SIDES)[0] / len(instants)


def test_two_cameras_could_have_a_person_in_common_unless_a_third_one_sees_two():
    here, there = still((0, 0)), still((3, 0))
    assert common(here, there)[0, 1] == 1
    assert common(here, there, still((0, 0), (3, 0)))[0, 1] == 0
    # One that shows both elsewhere does not tell that they are two, nor does one that shows one.
    assert common(here, there, still((0, 2), (3, 2)))[0, 1] == 1
    assert common(here, there, still((0, 0)))[0, 1] == 1


@pytest.mark.parametrize("axis", [0, 1])
def test_measured_cameras_have_in_common_whom_both_look_at(axis):
    def view(*times):
        """Somebody who is at a place at (begin, end) s, and nowhere else."""
        tracks = []
        for place, begin, end in times:
            (seen,) = still(np.roll([float(place), 0.0], axis)).tracks
            part = slice(round(30 * begin), round(30 * end))
            tracks.append(Tracklet(*(np.ascontiguousarray(each[part]) for each in seen)))
        return CameraView("c", "c", tracks, 0.0, 0.1)

    def shared(*views):
        instants = np.arange(0.25, 3.5, 0.5)
        return shared_view(views, Rig.alone(2), instants, SIDES, known=True)[0][0, 1]

    whole, other = view((0, 0, 4)), view((3, 0, 4))
    assert shared(whole, other) == 0  # strangers at two ends of a corridor
    # Each was seen where the other one sees somebody now: it would be seen there.
    assert shared(view((0, 0, 2), (3, 2, 4)), view((3, 0, 2), (0, 2, 4))) == 7
    assert shared(whole, whole) == 7


def test_people_in_common_still_count_beside_those_who_are_not():
    both = still((0, 0), (3, 0))
    assert common(both, still((0, 0)), still((3, 0)), both).tolist() == [
        [2, 1, 1, 2], [1, 1, 0, 1], [1, 0, 1, 1], [2, 1, 1, 2]
    ]  # fmt: skip


def test_up_is_where_standing_people_point():
    names = ["PELVIS", "NECK", "ANKLE_LEFT", "ANKLE_RIGHT", "FOOT_LEFT", "FOOT_RIGHT"]
    model = type(MODEL).of(names, [])
    body = np.array(
        [[0, 0, 1.0], [0, 0, 1.5], [0, 0.1, 0.1], [0, -0.1, 0.1], [0.1, 0.1, 0], [0.1, -0.1, 0]]
    )
    places = np.random.default_rng(0).uniform(-2, 2, (40, 1, 3)) * [1, 1, 0]
    tilt = Rotation.from_euler("xy", [0.7, -0.4])
    poses = tilt.apply((body + places + [0, 0, 0.3]).reshape(-1, 3)).reshape(40, 6, 3)
    floor = find_floor(model, poses, np.zeros_like(poses))
    assert floor is not None
    assert floor[0] == pytest.approx(tilt.apply([0, 0, 1]), abs=1e-6)
    assert floor[1] == pytest.approx(0.3, abs=1e-6)
    assert find_floor(MODEL, np.tile(POSE, (3, 1, 1)), np.zeros((3, 8, 3))) is None  # no ankles


def test_cameras_far_apart_tell_the_orientation_of_a_rig_better():
    """Who knows positions to 1 cm knows the turn of a rig of 20 m to less than 0.1 degrees."""
    directions = {"a": [1, 0, 0], "b": [-1, 0, 0], "c": [0, 1, 0], "d": [0, -1, 0]}
    near, far = (
        placement_error(
            {name: size * np.array(at) for name, at in directions.items()}, {}, 0.1, 0.01
        )
        for size in (0.01, 10.0)
    )
    assert near.degrees == pytest.approx(np.degrees(0.1 / 2), rel=0.1)
    assert far.degrees < 0.1
    assert near.metres == far.metres == pytest.approx(0.01 / 2)


def test_weights_leave_outliers_out_of_a_rigid_fit():
    points = np.random.default_rng(3).normal(0, 1, (20, 3))
    turn = Rotation.from_euler("xyz", [1.0, 0.5, -2.0])
    goal = turn.apply(points) + np.array([1.0, 2.0, 3.0])
    goal[:5] += 1.0
    matrix, shift = kabsch(points, goal, np.repeat([0.0, 1.0], [5, 15]))
    assert matrix == pytest.approx(turn.as_matrix())
    assert shift == pytest.approx([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("change", "verdict", "reason"),
    [
        ({}, "good", ""),
        ({"share": 0.6}, "doubtful", "60% of what it shares"),
        ({"share": 0.75, "share_error": 0.04}, "doubtful", "75% of what it shares"),
        ({"share": 0.75, "share_error": 0.18}, "good", ""),  # three of four
        ({"residual": 0.15}, "impossible", "15 cm"),
        ({"rival": True}, "doubtful", "quite different pose"),
        ({"error_deg": 1.0, "error_m": 0.06}, "usable", "1.0 degrees and 6 cm"),
        ({"error_deg": 3.0}, "doubtful", "standard error"),
        ({"error_m": 0.2}, "doubtful", "20 cm"),
        ({"halves_deg": 2.0, "error_deg": 0.1}, "doubtful", "halves"),
        ({"seconds": 6.0}, "usable", "6 s of common view"),
        ({"seconds": 3.0}, "doubtful", "3 s of common view"),
        ({"size": 1.02}, "usable", "2.0% of another size"),
        ({"size": 1.04}, "doubtful", "4.0% of another size"),
        ({"wander": 0.05}, "doubtful", "5 cm"),
        ({"limbs": 0.1}, "doubtful", "limbs"),
        ({"spread": 0.1}, "doubtful", "spread by 10 cm only"),
    ],
)
def test_the_verdict_names_its_reason(change, verdict, reason):
    from dataclasses import replace

    found, why = verdict_of(replace(GOOD, **change), moved=False)
    assert found == verdict
    assert reason in why


def test_a_pose_that_differs_from_the_log_is_an_improvement():
    assert verdict_of(GOOD, moved=True) == ("improved", "")


def test_people_are_followed_while_they_come():
    """Late frames are put in order; what was forgotten is as if it had never come."""
    rng = np.random.default_rng(3)
    base = rng.normal(size=(2, 8, 3)) + np.array([[[0.0, 0, 0]], [[3.0, 0, 0]]])
    seen = [
        Sighting(k / 25, base + 0.01 * k, np.ones((2, 8)))
        for k in range(100)
        if not 50 <= k < 60  # a gap ends the tracklets
    ]
    followed = PeopleFollowed(np.arange(8))
    late = [seen[k + 1 - 2 * (k % 2)] for k in range(len(seen))]  # pairs are exchanged
    for sighting in late:
        followed.add(sighting)
    followed.add(seen[0])  # too late
    for tracks in (followed.tracklets(), find_tracklets(seen, np.arange(8))):
        assert [len(one.seconds) for one in tracks] == [50, 50, 40, 40]
    followed.forget(1.0)
    (first, *_), (other, *_) = (
        followed.tracklets(0.5),
        find_tracklets([s for s in seen if s.seconds > 1.0], np.arange(8)),
    )
    np.testing.assert_allclose(first.seconds, other.seconds + 0.5)
    np.testing.assert_array_equal(first.positions, other.positions)
    followed.forget(9.0)
    assert followed.tracklets() == []


def test_points_move_with_their_velocities_where_a_clock_is_late():
    """A joint at 1 m/s, whom a camera sees 10 ms later."""
    seconds = np.array([1.0, 4.0])
    velocities = np.tile([1.0, 0.0, 0.0], (2, 2, 1))
    positions = np.stack([seconds, seconds + 0.01])[:, :, None] * [1.0, 0.0, 0.0]
    points = Points(seconds, np.arange(2), np.zeros(2, int), positions, velocities, np.ones((2, 2)))
    sampled = Rig.alone(2)
    late = sampled._replace(clocks=np.array([0.0, 0.01]))
    assert residuals_of(points, sampled).distances.max() == pytest.approx(0.005)
    assert residuals_of(points, late, sampled).distances.max() == pytest.approx(0.0, abs=1e-9)


def test_one_common_sample_tells_how_far_signatures_differ_and_nothing_of_how_they_move():
    one, other = np.array([[1.0, np.nan]]), np.array([[3.0, 5.0]])
    correlations, differences, overlaps = np.empty((3, 2))
    correlate(one, other, 0, correlations, differences, overlaps, np.empty(5))
    assert overlaps.tolist() == [1, 1]
    assert differences.tolist() == [2, 4]
    assert np.isnan(correlations).all()
