"""The merger against section 3.2 of the paper, and the laws that fusing has to obey."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from builders import at_once, moved, same
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from stick_figures import MIRROR, MODEL, PERIOD, SECOND, START, at, person, seen

from hiros_mcap.config import load_config
from hiros_mcap.events import SAME_TIME, Events
from hiros_mcap.frames import Block, by_frame, frames_of, join
from hiros_mcap.stages.merge import merging
from hiros_mcap.stages.merge.instants import by_instants
from hiros_mcap.stages.merge.merge import MergeParams, merge_blocks

merge = at_once(merge_blocks)

PLAIN = MergeParams(
    robust_scale=0.0, confidence_power=1.0, past_votes=False, offset_time=0.0, bridge=0.0
)


def views(poses, k=0, *, turns=False):
    """One frame per camera, at the same time, of person 0."""
    return [seen([p], at(k), f"c{c}", ids=[0], turns=turns) for c, p in enumerate(poses)]


def turn_round(frames):
    """Turn the pelvis, with all links, the other way."""
    for frame in frames:
        frame.links[:, :, 3:7] = [0, 0, 1, 0]
    return frames


def both_ways():
    """Two views of a pose that face opposite ways; the second has its sides swapped."""
    one, other = views([person(), person()[MIRROR]], turns=True)
    return [one, *turn_round([other])]


def stream(poses, **changes):
    """Merge what ``poses[k][camera]`` shows."""
    frames = [frame for k, each in enumerate(poses) for frame in views(each, k)]
    return list(merge(frames, MODEL, PLAIN.model_copy(update=changes)))


@pytest.mark.parametrize(
    "preset", [PLAIN, load_config(preset="paper", system="hiros").merge], ids=["plain", "paper"]
)
def test_eq12_weighs_by_confidence(preset):
    frames = views([person(x) for x in (0.0, 10.0, 20.0, 30.0)])
    for frame, confidence in zip(frames, (0.9, 0.3, 0.6, 0.9), strict=True):
        frame.marker_confidences[:] = confidence
    params = preset.model_copy(update={"max_position_delta": 0.0, "cameras": 4})
    (merged,) = merge(frames, MODEL, params)
    assert merged.positions[0, 0, 0] == pytest.approx(15.5556, abs=1e-4)


@pytest.mark.parametrize("confidence", [np.nan, 0.0])
def test_without_confidences_all_count_the_same(confidence):
    frames = views([person(0.0), person(0.1)])
    for frame in frames:
        frame.marker_confidences[:] = confidence
    (merged,) = merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 2}))
    assert merged.positions[0, :, 0].mean() == pytest.approx(person()[:, 0].mean() + 0.05)


def test_partial_skeletons_merge_to_the_union():
    left, right = person(), person()
    left[4:], right[:3] = np.nan, np.nan
    (merged,) = merge(views([left, right]), MODEL, PLAIN.model_copy(update={"cameras": 2}))
    assert merged.positions[0] == pytest.approx(person())


def test_merged_stamp_is_the_mean_of_the_source_times():
    frames = [seen([person()], START + t, f"c{t}", ids=[0]) for t in (0, 10, 1)]
    (merged,) = merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 3}))
    assert (merged.stamp, merged.source, merged.frame_id) == (START + 11 // 3, "world", "world")


def emitted_after(frames, params):
    """How many messages had gone in when each merged frame came out."""
    count = itertools.count(1)
    fed = 0

    def feed():
        nonlocal fed
        for frame in frames:
            fed = next(count)
            yield frame

    return [fed for _ in by_frame(merge_blocks)(feed(), MODEL, params)]


@pytest.mark.parametrize(
    ("last", "cameras", "span", "emitted"),
    [
        ((1, "a"), 9, 9.0, [3, 3]),  # the same camera again
        ((9, "c"), 9, 0.07, [3, 3]),  # a late message
        ((0.2, "c"), 3, 9.0, [3]),  # the last camera
    ],
)
def test_a_buffer_is_merged_as_soon_as_it_is_closed(last, cameras, span, emitted):
    frames = [seen([person()], at(k), c, ids=[0]) for k, c in ((0, "a"), (0.1, "b"), last)]
    params = PLAIN.model_copy(update={"cameras": cameras, "max_delta_time": span})
    assert emitted_after(frames, params) == emitted


def test_flipped_views_are_dropped():
    frames = views([person()] * 3 + [person(0.05)[MIRROR]] * 2, turns=True)
    turn_round(frames[3:])
    events = Events()
    params = PLAIN.model_copy(update={"cameras": 5})
    (merged,) = merge(frames, MODEL, params, events)
    assert merged.positions[0] == pytest.approx(person())
    assert merged.orientations[0] == pytest.approx(np.tile([0, 0, 0, 1.0], (7, 1)))
    assert events.total("flip") == 2


def test_one_bad_marker_of_one_camera_is_left_out():
    """And nothing else of that camera, which is a little aside."""
    poses = [person() for _ in range(4)]
    poses[2] += [0.02, 0, 0]
    poses[2][6] += [0.3, 0, 0]
    events = Events()
    (merged,) = merge(views(poses), MODEL, PLAIN.model_copy(update={"cameras": 4}), events)
    expected = person(0.005)
    expected[6] = person()[6]
    assert merged.positions[0] == pytest.approx(expected)
    assert events.counts == {("outlier", "c2"): 1}


def test_one_bad_link_of_one_camera_is_left_out():
    """And nothing else of that camera, which is turned a little."""
    frames = views([person()] * 4, turns=True)
    frames[1].links[0, :, 3:7] = Rotation.from_euler("z", 0.04).as_quat()
    frames[1].links[0, 3, 3:7] = [0, 0, 1, 0]
    params = PLAIN.model_copy(update={"cameras": 4, "max_facing_delta": 0.0})
    (merged,) = merge(frames, MODEL, params)
    about_z = Rotation.from_quat(merged.orientations[0]).as_rotvec()[:, 2]
    expected = np.full(MODEL.n_links, 0.01)
    expected[3] = 0.0
    assert about_z == pytest.approx(expected, abs=1e-5)


def test_a_tie_keeps_the_view_nearest_to_the_past():
    still = [[person(), person()] for _ in range(5)]
    split = [person(0.25), person(-0.15)]
    merged = stream([*still, split], past_votes=True)
    assert merged[-1].positions[0] == pytest.approx(person(-0.15))


def test_the_more_confident_view_breaks_a_tie():
    frames = views([person(), person()], turns=True)
    frames[1].markers[0, 6, :3] += [0.5, 0, 0]
    frames[1].links[0, 3, 3:7] = turned = Rotation.from_euler("z", 1.5).as_quat()
    frames[0].marker_confidences[0, 6] = frames[0].link_confidences[0, 3] = 0.5
    (merged,) = merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 2}))
    expected = person()
    expected[6] = expected[6] + [0.5, 0, 0]
    assert merged.positions[0] == pytest.approx(expected)
    assert merged.orientations[0, 3] == pytest.approx(turned)
    assert merged.orientations[0, 2] == pytest.approx([0, 0, 0, 1])


def test_the_robust_mean_follows_the_majority():
    poses = [person(), person(), person(), person(0.19)]
    (plain,) = merge(views(poses), MODEL, PLAIN.model_copy(update={"cameras": 4}))
    robust_params = PLAIN.model_copy(update={"cameras": 4, "robust_scale": 0.05})
    (robust,) = merge(views(poses), MODEL, robust_params)
    assert plain.positions[0, 0, 0] == pytest.approx(0.19 / 4)
    assert abs(robust.positions[0, 0, 0]) < 0.01


def test_unsynchronised_views_are_carried_to_the_merged_time():
    frames = [seen([person(3e-9 * c)], START + c, f"c{c}", ids=[0]) for c in (0, 16_000_000)]
    for frame in frames:
        frame.velocities[:] = [3.0, 0.0, 0.0]
    (merged,) = merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 2}))
    assert merged.positions[0] == pytest.approx(person(3 * 0.008))


def test_orientations_are_averaged_whatever_their_sign():
    frames = views([person()] * 2, turns=True)
    frames[0].links[0, :, 3:7] = Rotation.from_euler("z", 0.2).as_quat()
    frames[1].links[0, :, 3:7] = -Rotation.from_euler("z", -0.1).as_quat()
    (merged,) = merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 2}))
    turned = Rotation.from_quat(merged.orientations[0]).as_euler("zyx")
    assert turned[:, 0] == pytest.approx(0.05, abs=1e-9)


def test_somebody_unseen_for_a_moment_is_bridged_and_then_absent():
    frames = [seen([person(), person(2)], at(k), "a", ids=[0, 1]) for k in range(5)]
    frames += [seen([person()], at(k), "a", ids=[0]) for k in range(5, 15)]
    merged = list(merge(frames, MODEL, MergeParams(bridge=0.12)))
    assert [f.n_people for f in merged] == [2] * 5 + [2] * 3 + [1] * 7
    assert merged[7].positions[1] == pytest.approx(person(2))  # no velocity is known


def test_untracked_people_are_left_out():
    (merged,) = merge([seen([person(), person(2)], at(0), "a", ids=[-1, 4])], MODEL)
    assert merged.ids.tolist() == [4]


def test_a_camera_with_an_offset_makes_no_jump_when_it_drops_out():
    poses = [[person(), person(0.06)] for _ in range(300)] + [[person()] for _ in range(5)]
    with_bias, without = stream(poses, offset_time=5.0, cameras=2), stream(poses, cameras=2)
    step = [
        abs(m[300].positions[0, 0, 0] - m[299].positions[0, 0, 0]) for m in (with_bias, without)
    ]
    assert step[1] == pytest.approx(0.03)
    assert step[0] == pytest.approx(0.03 * np.exp(-2), rel=0.02)  # after two time constants


def test_one_camera_merges_to_itself():
    rng = np.random.default_rng(0)
    poses = [[person() + rng.normal(0, 0.02, (8, 3))] for _ in range(50)]
    merged = list(merge([f for k, p in enumerate(poses) for f in views(p, k)], MODEL))
    for frame, (pose,) in zip(merged, poses, strict=True):
        assert frame.positions[0] == pytest.approx(pose, abs=1e-9)


def noisy(seed):
    rng = np.random.default_rng(seed)
    frames = []
    for k, c in itertools.product(range(30), range(3)):
        poses = [person(x) + rng.normal(0, 0.05, (8, 3)) for x in (0.0, 2.0)]
        frames.append(seen(poses, at(k, c), f"c{c}", ids=[0, 1], turns=True))
    return frames


def test_two_people_far_apart_are_two_single_runs():
    frames = noisy(3)
    both = list(merge(frames, MODEL))
    for person_id in (0, 1):
        alone = list(merge([f.select([person_id]) for f in frames], MODEL))
        for one, two in zip(alone, both, strict=True):
            assert np.array_equal(one.markers[0], two.markers[person_id], equal_nan=True)


def faulty_views(seed, cameras):
    """Ten instants of noisy views with flips, outliers, gaps and any confidences."""
    rng = np.random.default_rng(seed)
    frames = []
    for k, c in itertools.product(range(10), range(cameras)):
        pose = person(0.02 * k) + rng.normal(0, 0.03, (8, 3))
        pose = pose[MIRROR] if rng.random() < 0.2 else pose
        pose[rng.integers(8)] += rng.normal(0, 0.5, 3)
        pose[rng.integers(8)] = np.nan
        frame = seen([pose], at(k), f"c{c}", ids=[0], turns=True)
        frame.links[0, :, 3:7] = Rotation.from_rotvec(rng.normal(0, 0.3, (7, 3))).as_quat()
        frame.marker_confidences[:], frame.velocities[:] = rng.random(8), rng.normal(0, 1, (8, 3))
        frames.append(frame)
    return frames


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 9999), st.integers(1, 5), st.permutations("abcde"))
def test_the_order_and_the_names_of_cameras_do_not_matter(seed, cameras, names):
    frames, params = faulty_views(seed, cameras), MergeParams(cameras=cameras)
    renamed = [frame.replace(source=names[int(frame.source[1])]) for frame in frames]
    renamed.sort(key=lambda frame: (frame.stamp, frame.source))
    for one, other in zip(merge(frames, MODEL, params), merge(renamed, MODEL, params), strict=True):
        assert other.markers == pytest.approx(one.markers, abs=1e-9, nan_ok=True)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 9999), st.integers(1, 5))
@example(72, 2)  # two links contradict each other and weigh the same
def test_a_motion_of_the_world_moves_the_result_alike(seed, cameras):
    motion = Rotation.random(random_state=seed), np.array([3.0, -1.0, 0.5])
    frames = faulty_views(seed, cameras)
    expected = moved(list(merge(frames, MODEL)), *motion)
    for one, other in zip(expected, merge(moved(frames, *motion), MODEL), strict=True):
        assert other.markers == pytest.approx(one.markers, abs=1e-6, nan_ok=True)
        dots = np.abs(np.sum(one.orientations * other.orientations, axis=-1))
        assert np.nanmin(dots, initial=1.0) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("cameras", "times", "merged"),
    [
        (9, [("a", 0), ("b", 4), ("a", 8)], [2, 8]),  # the same camera again
        (9, [("a", 0), ("b", 60), ("c", 71)], [30, 71]),  # more than 70 ms
        (9, [("b", 60), ("a", 0), ("c", 71)], [30, 71]),  # the oldest need not be the first
        (2, [("a", 0), ("b", 4), ("c", 8)], [2, 8]),  # all cameras are there
    ],
)
def test_what_closes_a_buffer_does_not_get_into_it(cameras, times, merged):
    frames = [seen([person()], START + ms * 1_000_000, c, ids=[0]) for c, ms in times]
    out = merge(frames, MODEL, PLAIN.model_copy(update={"cameras": cameras}))
    assert [(f.stamp - START) // 1_000_000 for f in out] == merged


def test_cameras_of_random_phase_merge_to_one_set_per_period():
    """The number of cameras is counted while they appear."""
    phases = np.random.default_rng(5).uniform(0, 1, 5)
    stamped = sorted((at(k + phase), f"c{c}") for k in range(30) for c, phase in enumerate(phases))
    merged = list(merge([seen([person()], t, c, ids=[0]) for t, c in stamped], MODEL))
    steps = np.diff([f.stamp for f in merged])
    assert 28 <= len(merged) <= 34
    assert steps[5:-1] == pytest.approx(at(1) - at(0), abs=2)


def test_a_message_out_of_order_is_merged():
    times = [("a", 0.0), ("c", 0.3), ("b", 0.1)]
    frames = [seen([person(i)], at(k), c, ids=[0]) for i, (c, k) in enumerate(times)]
    params = PLAIN.model_copy(update={"cameras": 3, "max_position_delta": 0.0})
    (merged,) = merge(frames, MODEL, params)
    assert merged.positions[0, 0, 0] == pytest.approx(1.0)


def test_a_camera_without_confidences_counts_fully():
    frames = views([person(0.0), person(0.1)])
    frames[0].marker_confidences[:], frames[1].marker_confidences[:] = 0.25, np.nan
    (merged,) = merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 2}))
    assert merged.positions[0, 0, 0] == pytest.approx(0.08)
    assert merged.marker_confidences[0, 0] == pytest.approx(0.25)


@pytest.mark.parametrize(("markers", "expected"), [(np.nan, 0.9), (0.5, 0.5)])
def test_eq12_falls_back_to_the_confidence_of_the_skeleton(markers, expected):
    frames = views([person(0.0), person(0.1)])
    for frame, confidence in zip(frames, (0.1, 0.9), strict=True):
        frame.confidences[:], frame.marker_confidences[:] = confidence, markers
    (merged,) = merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 2}))
    assert merged.positions[0, 0, 0] == pytest.approx(0.1 * expected)
    assert merged.marker_confidences[0, 0] == pytest.approx(markers, nan_ok=True)


def test_of_two_views_that_face_opposite_ways_the_more_confident_skeleton_is_right():
    frames = both_ways()
    for frame, confidence in zip(frames, (0.1, 0.9), strict=True):
        frame.confidences[:], frame.marker_confidences[:] = confidence, np.nan
    (merged,) = merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 2}))
    assert merged.positions[0] == pytest.approx(person()[MIRROR])


@pytest.mark.parametrize("level", ["confidences", "link_confidences"])
def test_orientations_are_weighed_by_confidence_of_the_link_or_else_of_the_skeleton(level):
    frames = views([person()] * 2, turns=True)
    for frame, angle, confidence in zip(frames, (0.0, 0.1), (0.75, 0.25), strict=True):
        frame.links[0, :, 3:7] = Rotation.from_euler("z", angle).as_quat()
        getattr(frame, level)[:] = confidence
    (merged,) = merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 2}))
    turned = Rotation.from_quat(merged.orientations[0]).as_euler("zyx")[:, 0]
    assert turned == pytest.approx(np.full(7, 0.025), abs=1e-4)


def test_flips_lose_their_vote_before_outliers_do_and_both_before_the_mean():
    """A wrong wrist lies where two flipped views have it: three to two if these still had a vote.

    Wrist and flips are counted where they happened, and none of them is in the mean.
    """
    wrong = person()
    wrong[6] = person()[7]
    poses = [person(), person(), wrong, person()[MIRROR], person()[MIRROR]]
    frames = views(poses, turns=True)
    turn_round(frames[3:])
    params = PLAIN.model_copy(update={"cameras": 5, "max_orientation_delta": 0.0})
    events = Events()
    (merged,) = merge(frames, MODEL, params, events)
    assert merged.positions[0] == pytest.approx(person())
    assert events.counts == {("flip", "c3"): 1, ("flip", "c4"): 1, ("outlier", "c2"): 1}
    blind = params.model_copy(update={"max_facing_delta": 0.0})
    (flips_vote,) = merge(frames, MODEL, blind)
    assert flips_vote.positions[0, 6] == pytest.approx(person()[7])


@pytest.mark.parametrize(
    ("switch", "kind"),
    [
        ({"max_position_delta": 0.0}, "outlier"),
        ({"max_position_delta": -1.0}, "outlier"),
        ({"max_facing_delta": 0.0, "max_position_delta": 0.0}, "flip"),
        ({"max_facing_delta": -1.0, "max_position_delta": 0.0}, "flip"),
    ],
)
def test_a_threshold_of_zero_or_less_turns_a_vote_off(switch, kind):
    frames = views([person(), person(0.5), person()[MIRROR]], turns=True)
    turn_round(frames[2:])
    on, off = Events(), Events()
    list(merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 3}), on))
    list(merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 3, **switch}), off))
    assert on.total(kind) > 0 == off.total(kind)


@pytest.mark.parametrize("limit", [0.0, -1.0])
def test_votes_of_links_can_be_turned_off(limit):
    frames = views([person()] * 3, turns=True)
    frames[1].links[0, 3, 3:7] = Rotation.from_euler("z", 1.5).as_quat()
    params = PLAIN.model_copy(update={"cameras": 3, "max_orientation_delta": limit})
    (merged,) = merge(frames, MODEL, params)
    assert 0.3 < Rotation.from_quat(merged.orientations[0, 3]).magnitude() < 0.7


def test_the_first_link_of_the_root_tells_the_facing():
    """One view has the pelvis turned, and only it: "NECK" is that link."""
    frames = views([person()] * 3, turns=True)
    frames[0].links[0, MODEL.link_names.index("NECK"), 3:7] = [0, 0, 1, 0]
    events = Events()
    list(merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 3}), events))
    assert events.total("flip") == 1


def test_the_past_votes_only_if_it_may():
    poses = [[person(), person()]] * 5 + [[person(0.3), person(0.32)]]
    assert stream(poses, cameras=2)[-1].positions[0, 0, 0] == pytest.approx(0.31)
    tie = [[person(), person()]] * 5 + [[person(0.05), person(0.5)]]
    assert stream(tie, cameras=2, past_votes=True)[-1].positions[0, 0, 0] == pytest.approx(0.05)


def test_bridging_carries_on_at_constant_velocity():
    frames = [seen([person(0.02 * k), person(2)], at(k), "a", ids=[0, 1]) for k in range(5)]
    for frame in frames:
        frame.velocities[:] = [[[0.6, 0.0, 0.0]], [[0.0, 0.0, 0.0]]]
    frames += [seen([person(2)], at(k), "a", ids=[1]) for k in range(5, 8)]
    events = Events()
    merged = list(merge(frames, MODEL, MergeParams(bridge=0.12), events))
    assert merged[6].positions[0] == pytest.approx(person(0.02 * 6), abs=1e-6)
    assert events.total("bridged") == 3


@pytest.mark.parametrize("past_votes", [True, False])
@pytest.mark.parametrize("apart", [0.02, 0.08, 0.15])
def test_which_camera_is_called_what_does_not_matter_even_at_first(apart, past_votes):
    poses = [person(), person(apart), person(-0.3 * apart)]
    params = MergeParams(cameras=3, past_votes=past_votes)
    (one,) = merge(views(poses), MODEL, params)
    (other,) = merge(views(poses[::-1]), MODEL, params)
    assert other.positions == pytest.approx(one.positions, abs=1e-9)


def test_two_views_that_hardly_agree_are_averaged():
    (merged,) = merge(views([person(), person(0.15)]), MODEL, MergeParams(cameras=2))
    assert merged.positions[0, 0, 0] == pytest.approx(0.075)


@pytest.mark.parametrize(
    ("apart", "past", "expected"),
    [
        ([0.0, 1.0, 2.0, 3.0], False, 0),  # four of one each: equal weights, equal spread
        ([0.0, 1.0, 1.1, 3.0], False, 1),
        ([0.0, 0.1, 1.0, 1.1, 1.05], False, 4),
        ([0.0, 1.0, 0.9], True, 1),  # a tie goes to the view nearest to the past, the last
    ],
)
def test_largest_group(apart, past, expected):
    at_x = np.array(apart)
    between = np.abs(at_x[:, None] - at_x)
    weights = np.ones(len(apart) - past)
    assert merging.largest_group(between, weights, past, 0.3) == expected


def test_an_absent_view_leads_no_group():
    apart = np.array([[np.nan, np.nan], [np.nan, 0.0]])
    assert merging.largest_group(apart, np.ones(2), False, 0.2) == 1
    assert merging.largest_group(apart[:1, :1].copy(), np.ones(1), False, 0.2) == -1


def test_of_equal_groups_the_more_confident_wins():
    apart = np.array([[0.0, 1.0], [1.0, 0.0]])
    assert merging.largest_group(apart, np.array([0.3, 0.6]), False, 0.2) == 1
    assert merging.largest_group(apart, np.array([0.6, 0.3]), False, 0.2) == 0


def test_a_frame_older_than_the_last_merged_one_is_counted_and_left_out():
    events = Events()
    frames = [seen([person(0.01 * k)], at(k), ids=[0]) for k in range(20)]
    late = seen([person(0.03)], at(3, 1), "b", ids=[0])
    merged = list(merge([*frames[:10], late, *frames[10:]], MODEL, events=events))
    stamps = [frame.stamp for frame in merged]
    assert stamps == sorted(set(stamps))
    assert events.counts["too late to be merged", "b"] == 1


def instants_of(times, **changes):
    """Times, in periods, at which messages of cameras, (period, camera) each, are merged."""
    events = Events()
    frames = [seen([person()], at(k), camera, ids=[0]) for k, camera in times]
    merged = merge(frames, MODEL, PLAIN.model_copy(update=changes), events)
    return [(frame.stamp - START) / PERIOD for frame in merged], events


@pytest.mark.parametrize("span", [0.07, 0.2])
@pytest.mark.parametrize("lost", [[], [(1, "b")], [(2, "a")], [(3, "a"), (3, "d")]])
def test_cameras_that_are_triggered_together_are_merged_trigger_by_trigger(span, lost):
    times = [(k, camera) for k in range(6) for camera in "abcd" if (k, camera) not in lost]
    found, events = instants_of(times, max_delta_time=span)
    assert found == list(range(6))
    assert events.total("too late to be merged") == 0


def test_a_camera_that_joins_others_is_merged_with_them_from_its_second_message_on():
    times = [(k, camera) for k in range(6) for camera in "abcd" if k > 1 or camera != "d"]
    assert instants_of(times)[0] == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("jitter", [0.0, 0.1])
def test_cameras_that_take_turns_are_merged_once_in_a_period(jitter):
    shifts = jitter * np.random.default_rng(1).uniform(-1, 1, (60, 4))
    times = [(k + c / 4 + shifts[k, c], "abcd"[c]) for k in range(60) for c in range(4)]
    found, _ = instants_of(times)
    assert len(found) == 60
    assert np.diff(found) == pytest.approx(1, abs=0.15)


def test_irregular_cameras_that_lose_messages_give_hardly_more_instants_than_frames():
    rng = np.random.default_rng(2)
    times = np.arange(600)[:, None] + rng.uniform(0, 1, 4) + rng.normal(0, 0.15, (600, 4))
    kept = [(k, c) for k, c in np.ndindex(600, 4) if rng.random() > 0.1]
    found, _ = instants_of(sorted((times[k, c], "abcd"[c]) for k, c in kept))
    assert len(found) < 1.04 * 600


def test_a_message_older_than_the_instant_that_it_closes_is_left_out():
    times = [(0, "a"), (1, "b"), (1, "c"), (0.4, "a"), (2, "a"), (2, "b"), (2, "c")]
    found, events = instants_of(times, cameras=9)
    assert found == sorted(found)
    assert events.counts["too late to be merged", "a"] == 1


def test_of_two_views_that_face_opposite_ways_the_more_confident_is_right():
    for right in (0, 1):
        frames = both_ways()
        frames[1 - right].marker_confidences[:] = 0.5
        (merged,) = merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 2}))
        assert merged.positions[0] == pytest.approx(frames[right].positions[0])


def test_views_on_both_sides_of_the_past_that_are_too_far_from_each_other_need_a_vote():
    poses = [[person(), person()]] * 5 + [[person(0.19), person(-0.15)]]
    merged = stream(poses, cameras=2, past_votes=True)
    assert merged[-1].positions[0] == pytest.approx(person(-0.15))


def test_the_past_votes_where_it_is_by_now():
    poses = [[person(0.1 * k)] * 2 for k in range(5)] + [[person(0.61), person(0.38)]]
    frames = [frame for k, each in enumerate(poses) for frame in views(each, k)]
    for frame in frames:
        frame.velocities[:] = [3.0, 0.0, 0.0]
    params = PLAIN.model_copy(update={"cameras": 2, "past_votes": True})
    assert list(merge(frames, MODEL, params))[-1].positions[0] == pytest.approx(person(0.61))


def test_orientations_are_carried_to_the_merged_time():
    """Angular velocities are about the axes of the world, here z, and the links lie across it."""
    lying = Rotation.from_euler("x", 90, degrees=True)
    frames = [seen([person()], START + c, f"c{c}", ids=[0], turns=True) for c in (0, 20_000_000)]
    for frame, early in zip(frames, (-1, 1), strict=True):
        frame.links[0, :, 3:7] = (Rotation.from_euler("z", 0.02 * early) * lying).as_quat()
        frame.links[0, :, 10:13] = [0.0, 0.0, 4.0]
    for angle in (0.0, 0.02):
        (merged,) = merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 2}))
        turned = (Rotation.from_quat(merged.orientations[0]) * lying.inv()).as_rotvec()
        assert turned == pytest.approx(np.tile([0, 0, angle], (7, 1)), abs=1e-6)
        frames[1].links[0, :, 10:13] = 0.0


@pytest.mark.parametrize(("away", "offset"), [(8, 0.03), (12, 0.06)])
def test_the_offsets_for_people_who_left_are_forgotten(away, offset):
    """Camera c1 sees person 0 at 6 cm beside c0; it takes half of that off."""
    frames = [f for k in range(600) for f in views([person(), person(0.06)], k)]
    back = at(600) + away * SECOND
    others = [seen([person(3)], back - s * SECOND, "c1", ids=[1]) for s in (2, 1)]
    frames += [*others, seen([person(0.06)], back, "c1", ids=[0])]
    merged = list(merge(frames, MODEL, PLAIN.model_copy(update={"offset_time": 2.0})))
    assert merged[-1].positions[0, 0, 0] == pytest.approx(offset, abs=1e-4)


def test_a_long_block_gives_what_its_frames_give_one_by_one():
    """Rows of people who left are taken by others meanwhile."""
    frames = [
        seen([person(0.01 * k), person(2)], START + k * SECOND // 2, c, ids=[k // 9, 90 + k // 30])
        for k in range(90)
        for c in "ab"
    ]
    block = join([Block.of(frame) for frame in frames])
    params = MergeParams(bridge=3.0)
    together = frames_of(merge_blocks([block], MODEL, params))
    assert all(map(same, together, by_frame(merge_blocks)(frames, MODEL, params)))


def test_a_row_that_somebody_left_is_not_taken_before_it_is_done_with():
    """Person 0 leaves; person 1, in the same block, does not inherit the offset of camera c1."""
    frames = [f for k in range(60) for f in views([person(), person(0.06)], k)]
    others = [seen([person(3)], at(0) + s * SECOND, "c1", ids=[9]) for s in range(3, 14)]
    new = [seen([person(0.06)], at(0) + s * SECOND, "c1", ids=[1]) for s in (14, 15)]
    block = join([Block.of(frame) for frame in [*frames, *others, *new]])
    params = PLAIN.model_copy(update={"offset_time": 2.0})
    for merged in list(frames_of(merge_blocks([block], MODEL, params)))[-2:]:
        assert merged.ids.tolist() == [1]
        assert merged.positions[0] == pytest.approx(person(0.06))


def test_the_signs_of_orientations_are_aligned_with_their_mean():
    """The first view, of little weight, lies across: by its signs the others would cancel out."""
    frames = views([person()] * 3, turns=True)
    turns = np.radians([0.0, 160.0, 200.0])
    for frame, turn, confidence in zip(frames, turns, (0.1, 1.0, 0.9), strict=True):
        frame.links[0, :, 3:7] = Rotation.from_euler("z", turn).as_quat()
        frame.link_confidences[:] = confidence
    changes = {"cameras": 3, "max_orientation_delta": 0.0, "max_facing_delta": 0.0}
    (merged,) = merge(frames, MODEL, PLAIN.model_copy(update=changes))
    turned = Rotation.from_quat(merged.orientations[0]).magnitude()
    mean = np.angle(np.dot((0.1, 1.0, 0.9), np.exp(0.5j * turns)))  # of half the angles
    assert np.degrees(turned) == pytest.approx(np.full(7, np.degrees(2.0 * mean)))
    assert 170.0 < np.degrees(turned[0]) <= 180.0


def test_bridging_stops_moving_after_a_fifth_of_a_second_and_keeps_the_rest():
    frames = [seen([person(), person(2)], at(0), "a", ids=[0, 1], turns=True)]
    frames += [seen([person(2)], at(k), "a", ids=[1]) for k in range(1, 10)]
    frames[0].velocities[0], frames[0].confidences[0] = [1.0, 0.0, 0.0], 0.7
    frames[0].marker_confidences[0] = 0.8
    last = list(merge(frames, MODEL, PLAIN.model_copy(update={"bridge": 1.0})))[-1]
    assert last.positions[0] == pytest.approx(person(0.2))
    assert last.orientations[0] == pytest.approx(np.tile([0.0, 0.0, 0.0, 1.0], (7, 1)))
    assert (last.confidences[0], last.marker_confidences[0, 3]) == pytest.approx((0.7, 0.8))


def test_a_message_stamped_as_those_merged_before_is_left_out():
    frames = [seen([person()], at(0), c, ids=[k]) for k, c in enumerate("ab")]
    events = Events()
    merged = list(merge(frames, MODEL, PLAIN.model_copy(update={"cameras": 1}), events))
    assert [frame.ids.tolist() for frame in merged] == [[0]]
    assert events.counts[SAME_TIME, "b"] == 1


def test_a_guess_moves_an_offset_less_than_a_sighting():
    """Cameras b and c are alike aside, but c has a tenth of the weight."""
    poses = [person(), person(0.06), person(0.06)]
    frames = [f for k in range(30) for f in views(poses, k)]
    for frame in frames:
        frame.marker_confidences[:] = 0.1 if frame.source == "c2" else 1.0
    late = [seen([person(0.06)], at(30 + k), f"c{1 + k}", ids=[0]) for k in range(2)]
    params = PLAIN.model_copy(update={"offset_time": 5.0, "cameras": 3})
    b, c = [list(merge([*frames, f], MODEL, params))[-1].positions[0, 0, 0] for f in late]
    assert 0.06 - b > 5 * (0.06 - c) > 0


def test_a_faint_view_has_no_vote():
    """With the past, which it led astray, it would win against a view that sees the joint."""
    apart = np.array([[0.0, 1.0, 1.0], [1.0, 0.0, 0.1], [1.0, 0.1, 0.0]])
    assert merging.largest_group(apart, np.array([1.0, 0.05]), True, 0.2) == 0
    assert merging.largest_group(apart, np.array([1.0, 0.5]), True, 0.2) == 1


def test_who_is_carried_does_not_come_apart():
    """A distorted view before an absence gives a limb a velocity that no limb keeps."""
    frames = [seen([person(0.02 * k), person(2)], at(k), "a", ids=[0, 1]) for k in range(5)]
    for frame in frames:
        frame.velocities[:] = [[[0.6, 0.0, 0.0]], [[0.0, 0.0, 0.0]]]
        frame.velocities[0, 7] = [0.6, 0.0, 4.0]
    frames += [seen([person(2)], at(k), "a", ids=[1]) for k in range(5, 10)]
    merged = list(merge(frames, MODEL, MergeParams(bridge=0.2)))
    off = merged[9].positions[0] - person(0.02 * 9)
    assert np.abs(off[:7]).max() < 0.1  # it went on as a whole
    assert 0.2 < off[7, 2] < 0.3  # of 0.8 m at its own velocity


MS = SECOND // 1000


def one_by_one(*messages):
    """A block for each message of (ms, camera)."""
    for ms, camera in messages:
        yield Block.of(seen([person()], ms * MS, camera))


def test_messages_that_come_one_by_one_wait_for_their_instant():
    messages = [(0, "a"), (5, "b"), (33, "a"), (38, "b"), (66, "a")]
    out = [block.stamps.tolist() for block in by_instants(one_by_one(*messages), 2, 0.1)]
    assert out == [[0, 5 * MS], [33 * MS, 38 * MS], [66 * MS]]


def test_a_second_message_of_a_camera_lets_the_first_ones_go():
    messages = [(0, "a"), (5, "b"), (33, "a"), (66, "a")]
    out = [len(block) for block in by_instants(one_by_one(*messages), 3, 0.1)]
    assert out == [3, 1]


def test_blocks_are_cut_behind_the_message_that_completes_an_instant():
    first, second = [(0, "a"), (5, "b"), (33, "a")], [(38, "b"), (66, "a"), (71, "b"), (99, "a")]
    came = [join(list(one_by_one(*messages))) for messages in (first, second)]
    out = [[stamp // MS for stamp in block.stamps.tolist()] for block in by_instants(came, 2, 0.1)]
    assert out == [[0, 5], [33, 38, 66, 71], [99]]
