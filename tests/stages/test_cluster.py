"""Lee's merger against section 2.2 of the paper, and the laws that fusing has to obey."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from builders import at_once, moved
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.cluster.hierarchy import fclusterdata
from scipy.spatial.transform import Rotation
from stick_figures import MIRROR, MODEL, SECOND, at, person, seen

from hiros_mcap.events import Events
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.stages.lee.cluster import (
    LEE_JOINTS,
    ClusterParams,
    cluster_blocks,
    lee_joints,
    pairs_of,
)
from hiros_mcap.stages.lee.clustering import ClusterWork, dbscan, reference_positions

cluster = at_once(cluster_blocks)

WRIST, OTHER_WRIST = 6, 7
NO_HELP = ClusterParams(reference_helps=False, previous_helps=False)
TURN, SHIFT = Rotation.from_euler("xyz", [0.3, -0.5, 1.2]), np.array([3.0, -1.0, 0.5])


def with_wrist(*place):
    pose = person()
    pose[WRIST] = place
    return pose


def views(poses, k=0, *, turns=False):
    """One frame per camera, at the same time, of person 0."""
    return [seen([p], at(k), f"c{c}", ids=[0], turns=turns) for c, p in enumerate(poses)]


def merged(poses, params=NO_HELP, confidences=(), events=None):
    """Positions (M, 3) merged from one view per camera."""
    frames = views(poses)
    for frame, confidence in zip(frames, confidences, strict=False):
        frame.marker_confidences[:] = confidence
    every = params.model_copy(update={"cameras": len(poses)})
    (out,) = cluster(frames, MODEL, every, events)
    return np.array(out.positions[0])


def labels_of(points, radius, min_points):
    work = ClusterWork.of(len(points), 1)
    count = dbscan(points, radius, min_points, work)
    labels = work.labels[: len(points)]
    assert count == labels.max(initial=-1) + 1
    return labels


@settings(deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 24), st.integers(1, 5))
def test_dbscan_equals_scikit_learn(seed, n, min_points):
    from sklearn.cluster import DBSCAN

    points = np.random.default_rng(seed).uniform(0, 0.4, (n, 3))
    expected = DBSCAN(eps=0.1, min_samples=min_points).fit(points).labels_
    assert (labels_of(points, 0.1, min_points) == expected).all()


@settings(deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 24))
def test_one_neighbour_is_single_linkage_and_never_noise(seed, n):
    points = np.random.default_rng(seed).uniform(0, 0.4, (n, 3))
    labels = labels_of(points, 0.1, 1)
    linked = fclusterdata(points, 0.1, criterion="distance", method="single")
    assert (labels >= 0).all()
    assert ((labels[:, None] == labels) == (linked[:, None] == linked)).all()


def test_absent_points_belong_to_nothing():
    points = np.array([[0.0, 0.0, 0.0], [np.nan] * 3, [0.05, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert labels_of(points, 0.1, 1).tolist() == [0, -1, 0, 1]
    assert labels_of(points, 0.1, 2).tolist() == [0, -1, 0, -1]


def test_the_sixteen_joints():
    azure = [
        "PELVIS", "SPINE_NAVAL", "SPINE_CHEST", "NECK", "CLAVICLE_LEFT", "SHOULDER_LEFT",
        "ELBOW_LEFT", "WRIST_LEFT", "HAND_LEFT", "HANDTIP_LEFT", "THUMB_LEFT", "CLAVICLE_RIGHT",
        "SHOULDER_RIGHT", "ELBOW_RIGHT", "WRIST_RIGHT", "HAND_RIGHT", "HANDTIP_RIGHT",
        "THUMB_RIGHT", "HIP_LEFT", "KNEE_LEFT", "ANKLE_LEFT", "FOOT_LEFT", "HIP_RIGHT",
        "KNEE_RIGHT", "ANKLE_RIGHT", "FOOT_RIGHT", "HEAD", "NOSE", "EYE_LEFT", "EAR_LEFT",
        "EYE_RIGHT", "EAR_RIGHT",
    ]  # fmt: skip
    model = SkeletonModel.of(azure, [])
    chosen = [name for name, used in zip(azure, lee_joints(model), strict=True) if used]
    assert len(LEE_JOINTS) == 16
    assert sorted(chosen) == sorted(n.replace("NAVEL", "NAVAL") for n in LEE_JOINTS)
    swappable = {azure[left] for left, _ in pairs_of(model)}
    limbs = {f"{part}_LEFT" for part in ("SHOULDER", "ELBOW", "WRIST", "HIP", "KNEE", "ANKLE")}
    assert limbs <= swappable
    assert not swappable & {"EYE_LEFT", "EAR_LEFT", "CLAVICLE_LEFT"}


def test_the_kinect_v2_names_some_joints_otherwise():
    model = SkeletonModel.of(["SpineBase", "SpineMid", "SpineShoulder", "Neck", "HandLeft"], [])
    assert lee_joints(model).tolist() == [True, True, False, True, False]


def test_other_joints_and_their_links_stay_absent():
    model = SkeletonModel.of(["PELVIS", "NECK", "NOSE"], [("a", 0, 1), ("b", 1, 2)])
    frame = Frame.empty(1, model, stamp=SECOND, source="c")
    frame.ids[:], frame.markers[:, :, :3], frame.links[:, :, 3:7] = 4, 1.0, [0.0, 0.0, 0.0, 1.0]
    (out,) = cluster([frame], model, ClusterParams(joints="lee16"))
    assert np.isnan(out.positions[0, :, 0]).tolist() == [False, False, True]
    assert np.isnan(out.orientations[0, :, 0]).tolist() == [False, True]


@pytest.mark.parametrize(
    ("confidences", "expected"),
    [
        ((0.66, 0.66, 0.33), 0.05),  # medium: the low one is not asked
        ((0.33, 0.33, 0.0), 0.05),  # no medium: low, but never none
        ((0.66, 0.33, 0.33), 0.0),
        ((np.nan, 0.33, 1.0), 1.0),  # not given, and high, are medium
        ((0.0, 0.0, 0.0), np.nan),
    ],
)
def test_reference_position_by_level(confidences, expected):
    frames = views([with_wrist(x, 0.0, 1.0) for x in (0.0, 0.1, 2.0)])
    markers = np.concatenate([frame.markers for frame in frames])
    trust = np.repeat(np.array(confidences)[:, None], MODEL.n_markers, axis=1)
    reference = np.zeros((MODEL.n_markers, 3))
    reference_positions(markers, trust, 0.5, 0.17, reference)
    assert reference[WRIST, 0] == pytest.approx(expected, nan_ok=True)


def test_without_a_reference_nothing_is_swapped():
    events = Events()
    merged([person(), person(), person(), person()[MIRROR]], confidences=[0.0] * 4, events=events)
    assert events.total("swap") == 0


def test_one_of_four_cameras_swapped_is_restored():
    poses = [person(0.01 * k) for k in range(4)]
    right = merged(poses)
    events = Events()
    assert merged([*poses[:3], poses[3][MIRROR]], events=events) == pytest.approx(right)
    assert events.counts == {("swap", "c3"): 3}


@pytest.mark.parametrize("rearrange", ["right", "both"])
def test_one_swapped_pair_is_swapped_back_alone(rearrange):
    wrong = person()
    wrong[[WRIST, OTHER_WRIST]] = wrong[[OTHER_WRIST, WRIST]]
    events = Events()
    params = NO_HELP.model_copy(update={"rearrange": rearrange})
    result = merged([person(), person(), wrong], params, events=events)
    assert result == pytest.approx(person())
    assert events.total("swap") == 1


def test_without_a_swap_nothing_changes():
    rng = np.random.default_rng(3)
    events = Events()
    poses = [person() + rng.normal(0, 0.02, (8, 3)) for _ in range(4)]
    assert merged(poses, events=events) == pytest.approx(np.mean(poses, axis=0))
    assert events.total("swap") == 0


def test_a_missing_partner_leaves_a_joint_untouched():
    half = person()[MIRROR]
    half[[2, 4, WRIST]] = np.nan  # the left ones; the right ones are where the left should be
    events = Events()
    result = merged([person(), person(), person(), half], events=events)
    assert events.total("swap") == 0
    assert result == pytest.approx(person())  # the stray right joints lose the vote


def test_off_averages_the_swap_in():
    params = ClusterParams(rearrange="off", method="average")
    result = merged([person(), person(), person(), person()[MIRROR]], params)
    assert result[WRIST] == pytest.approx(0.75 * person()[WRIST] + 0.25 * person()[OTHER_WRIST])


def test_swapped_views_say_nothing_of_orientations():
    frames = views([person(), person(), person(), person()[MIRROR]], turns=True)
    frames[3].links[:, :, 3:7] = [1.0, 0.0, 0.0, 0.0]
    (out,) = cluster(frames, MODEL, ClusterParams(cameras=4))
    assert out.orientations[0] == pytest.approx(np.tile([0.0, 0.0, 0.0, 1.0], (7, 1)))


def test_reference_position_changes_the_winner():
    """Two pairs of candidates; the reference is the mean of the trusted ones and decides."""
    poses = [with_wrist(x, 0.0, 1.0) for x in (0.0, 0.04, 1.0, 1.04, 1.08)]
    trust = (0.66, 0.66, 0.33, 0.33, 0.33)
    far = merged(poses, NO_HELP.model_copy(update={"rearrange": "off"}), trust)
    near = merged(poses, ClusterParams(previous_helps=False, rearrange="off"), trust)
    assert far[WRIST, 0] == pytest.approx(1.04)
    assert near[WRIST, 0] == pytest.approx(0.02)  # 3 points against 3, and more trust


@pytest.mark.parametrize(("helps", "expected"), [(False, 1.02), (True, 0.0)])
def test_previous_position_changes_the_winner(helps, expected):
    """One candidate near the previous position against two trusted ones far away.

    The previous position makes it two against two; a trusted one more each would not.
    """
    first = [with_wrist(0.0, 0.0, 1.0) for _ in range(3)]
    second = [with_wrist(x, 0.0, 1.0) for x in (0.0, 1.0, 1.04)]
    frames = [*views(first, 0), *views(second, 1)]
    for frame, trust in zip(frames[3:], (0.66, 0.33, 0.33), strict=True):
        frame.marker_confidences[:] = trust
    params = NO_HELP.model_copy(update={"cameras": 3, "previous_helps": helps, "rearrange": "off"})
    _, out = cluster(frames, MODEL, params)
    assert out.positions[0, WRIST, 0] == pytest.approx(expected)


def test_a_position_of_long_ago_is_not_the_previous_one():
    frames = [*views([with_wrist(0.0, 0.0, 1.0)] * 3, 0)]
    late = views([with_wrist(x, 0.0, 1.0) for x in (0.0, 1.0, 1.04)], 4)
    for frame, confidence in zip(late, (0.66, 0.33, 0.33), strict=True):
        frame.marker_confidences[:] = confidence  # the previous position would decide
    params = NO_HELP.model_copy(update={"cameras": 3, "previous_helps": True, "rearrange": "off"})
    _, out = cluster([*frames, *late], MODEL, params)
    assert out.positions[0, WRIST, 0] == pytest.approx(1.02)


def test_nobody_has_the_previous_position_of_another():
    """Many people come and go: each is merged as if alone."""
    rng = np.random.default_rng(12)
    frames = []
    for k, present in enumerate(rng.random((40, 30)) < np.linspace(0.1, 0.9, 40)[:, None]):
        ids = np.flatnonzero(present & (np.arange(30) // 3 != k // 4))  # some are away for long
        for c in range(3):
            poses = [person(0.0, 0.2 * i) + rng.normal(0, 0.06, (8, 3)) for i in ids]
            frames.append(seen(poses, at(k), f"c{c}", ids=ids.tolist()))
    together = list(cluster(frames, MODEL, ClusterParams(cameras=3)))
    for number in range(30):
        alone = [frame.select(frame.ids == number) for frame in frames]
        for out, single in zip(
            together, cluster(alone, MODEL, ClusterParams(cameras=3)), strict=True
        ):
            mine = out.select(out.ids == number)
            assert np.array_equal(mine.markers, single.markers, equal_nan=True)


def test_largest_cluster_without_its_helpers():
    """Candidates at 0, 6 and 60 cm; the reference at 22 cm is alone and the first two win."""
    poses = [with_wrist(x, 0.0, 1.0) for x in (0.0, 0.06, 0.6)]
    params = ClusterParams(rearrange="off")
    assert merged(poses, params)[WRIST, 0] == pytest.approx(0.03)


def test_helpers_alone_do_not_win():
    """Reference and previous position side by side, candidates scattered: these decide."""
    first = [with_wrist(0.5, 0.0, 1.0)] * 2
    second = [with_wrist(x, 0.0, 1.0) for x in (0.0, 1.02)]  # their mean is near 0.5
    _, out = cluster([*views(first, 0), *views(second, 1)], MODEL, ClusterParams(cameras=2))
    assert out.positions[0, WRIST, 0] == pytest.approx(0.0)  # nearer to the previous position


def test_clusters_that_are_equal_in_all_win_together():
    poses = [with_wrist(x, 0.0, 1.0) for x in (0.0, 1.0)]
    assert merged(poses, ClusterParams(rearrange="off"))[WRIST, 0] == pytest.approx(0.5)


def test_noise_only_is_averaged():
    poses = [with_wrist(x, 0.0, 1.0) for x in (0.0, 1.0, 2.0)]
    params = NO_HELP.model_copy(update={"min_neighbours": 2, "rearrange": "off"})
    assert merged(poses, params)[WRIST, 0] == pytest.approx(1.0)


def test_outliers_are_counted_by_camera():
    events = Events()
    merged([person(), person(), with_wrist(3.0, 0.0, 1.0)], events=events)
    assert events.counts == {("outlier", "c2"): 1}


def test_links_come_from_the_views_that_placed_their_ends():
    frames = views([person(), person(), with_wrist(3.0, 0.0, 1.0)], turns=True)
    frames[2].links[0, :, 3:7] = [1.0, 0.0, 0.0, 0.0]
    (out,) = cluster(frames, MODEL, ClusterParams(cameras=3))
    assert out.orientations[0, 5] == pytest.approx([0.0, 0.0, 0.0, 1.0])  # ends at the wrist


def test_views_are_carried_to_the_merged_time():
    """Two cameras 20 ms apart, a person at 2 m/s: 4 cm between the views, none once carried."""
    frames = [seen([person(0.04 * c)], at(0) + 20_000_000 * c, f"c{c}", ids=[0]) for c in range(2)]
    for frame in frames:
        frame.markers[:, :, 7:10] = [2.0, 0.0, 0.0]
    (out,) = cluster(frames, MODEL, ClusterParams(cameras=2))
    assert out.stamp == out.stamps[0] == at(0) + 10_000_000
    assert out.positions[0] == pytest.approx(person(0.02))
    assert out.velocities[0, :, 0] == pytest.approx(2.0)


def test_views_that_are_not_carried_are_of_their_mean_time():
    """Person 2 is seen by the later two of three cameras, and one of them gives a confidence."""
    frames = [seen([person()], at(0), "a", ids=[1])]
    frames += [
        seen([person(), person(1.0)], at(0) + late * 10_000_000, source, ids=[1, 2])
        for late, source in ((1, "b"), (2, "c"))
    ]
    for frame, trust in zip(frames, (0.2, 0.4, 0.9), strict=True):
        frame.confidences[0] = trust
    frames[1].confidences[1] = 0.7
    (out,) = cluster(frames, MODEL, ClusterParams(cameras=3, compensate_motion=False))
    assert out.stamp == at(0) + 10_000_000
    assert (out.stamps - at(0)).tolist() == [10_000_000, 15_000_000]
    assert out.confidences == pytest.approx([0.5, 0.7])


def test_every_person_of_the_tracker_is_merged_alone():
    """Two people, in the cameras' messages in different orders, and one without an id."""
    pair = {3: person(0.0, -1.0), 8: person(1.0, 1.0)}
    frames = [
        seen([pair[3], pair[8], person(5.0)], at(0), "a", ids=[3, 8, -1]),
        seen([pair[8], pair[3]], at(0), "b", ids=[8, 3]),
    ]
    (out,) = cluster(frames, MODEL, ClusterParams(cameras=2))
    assert out.ids.tolist() == [3, 8]
    for row, number in enumerate(out.ids.tolist()):
        alone = [frame.select(frame.ids == number) for frame in frames]
        (single,) = cluster(alone, MODEL, ClusterParams(cameras=2))
        assert np.array_equal(out.markers[row], single.markers[0], equal_nan=True)
        assert out.positions[row] == pytest.approx(pair[number])


def random_views(cameras=4, instants=4, seed=9):
    """Noisy views of two people with outliers, gaps and swaps."""
    rng = np.random.default_rng(seed)
    frames = []
    for k, c in itertools.product(range(instants), range(cameras)):
        poses = [person(0.02 * k, y) + rng.normal(0, 0.04, (8, 3)) for y in (-1.0, 1.0)]
        poses[0] = poses[0][MIRROR] if c == k else poses[0]
        poses[1][rng.integers(8)] += rng.normal(0, 0.5, 3)
        poses[1][rng.integers(8)] = np.nan
        frame = seen(poses, at(k), f"c{c}", ids=[1, 2], turns=True)
        frame.marker_confidences[:] = rng.choice([0.0, 0.33, 0.66], (2, 8))
        frames.append(frame)
    return frames


def positions(frames, params=None):
    params = params or ClusterParams(cameras=4)
    return np.stack([out.positions for out in cluster(frames, MODEL, params)])


@pytest.mark.parametrize("rearrange", ["off", "right", "both"])
def test_one_camera_merges_to_itself(rearrange):
    frames = [frame for frame in random_views() if frame.source == "c0"]
    out = list(cluster(frames, MODEL, ClusterParams(rearrange=rearrange)))
    for frame, result in zip(frames, out, strict=True):
        assert np.allclose(frame.positions, result.positions, equal_nan=True)
        assert np.array_equal(frame.marker_confidences[0], result.marker_confidences[0])
        assert np.allclose(frame.orientations, result.orientations)


def test_the_sides_are_alike_if_both_decide():
    """Everybody mirrored, the result is mirrored; as printed, the right side alone decides."""
    frames = random_views()
    mirrored = []
    for frame in frames:
        markers, trust = frame.markers[:, MIRROR].copy(), frame.marker_confidences[:, MIRROR].copy()
        mirrored.append(frame.replace(markers=markers, marker_confidences=trust))
    params = ClusterParams(cameras=4, rearrange="both")
    assert positions(mirrored, params)[:, :, MIRROR] == pytest.approx(
        positions(frames, params), nan_ok=True
    )


def test_an_instant_without_people_gives_an_empty_frame():
    (out,) = cluster([seen([], at(0), ids=[])], MODEL)
    assert out.n_people == 0


def test_the_reference_is_taken_again_after_the_re_arrangement():
    """Three medium candidates and their reference draw with four low ones.

    One of the three called the right wrist the left one, which drew the first reference away.
    """
    poses = [person(), person(), person()[MIRROR], *[person() for _ in range(4)]]
    for k, pose in enumerate(poses[3:]):
        pose[WRIST] = [1.0 + 0.02 * k, 0.4, 1.0]
    params = NO_HELP.model_copy(update={"reference_helps": True})
    result = merged(poses, params, (0.66,) * 3 + (0.33,) * 4)
    assert result[WRIST] == pytest.approx(person()[WRIST])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 9999), st.permutations(range(4)), st.sampled_from([1, 2]))
def test_cameras_commute_and_the_world_may_move(seed, order, neighbours):
    frames = random_views(seed=seed)
    params = ClusterParams(cameras=4, min_neighbours=neighbours)
    renamed = [frame.replace(source=f"c{order[int(frame.source[1])]}") for frame in frames]
    renamed.sort(key=lambda frame: (frame.stamp, frame.source))
    motion = Rotation.random(random_state=seed), SHIFT
    result = positions(moved(renamed, *motion), params).reshape(-1, 3)
    expected = motion[0].apply(positions(frames, params).reshape(-1, 3)) + SHIFT
    assert result == pytest.approx(expected, abs=1e-6, nan_ok=True)


def test_the_previous_position_of_somebody_who_left_is_forgotten():
    """The stamps start at zero, where a row that was never used seems recent."""
    frames = [f.replace(stamp=f.stamp - at(0), log_time=0) for f in views([person()] * 2)]
    far = [with_wrist(0.05, 0.4, 1.0), with_wrist(0.5, 0.4, 1.0)]
    frames[0].markers[0, :, :3], frames[1].markers[0, :, :3] = far
    (out,) = cluster(frames, MODEL, ClusterParams(cameras=2, rearrange="off"))
    assert out.positions[0, WRIST, 0] == pytest.approx(0.275)  # no previous position decides


def test_the_links_of_a_view_stay_if_only_half_of_its_pairs_were_exchanged():
    wrong = person()
    wrong[[WRIST, OTHER_WRIST]] = wrong[[OTHER_WRIST, WRIST]]
    wrong[[4, 5]] = np.nan  # no hips: two pairs are compared
    frames = views([person(), person(), wrong], turns=True)
    frames[2].links[0, 0, 3:7] = Rotation.from_euler("z", 0.3).as_quat()
    (out,) = cluster(frames, MODEL, ClusterParams(cameras=3))
    assert Rotation.from_quat(out.orientations[0, 0]).magnitude() == pytest.approx(0.1, abs=1e-3)
