"""The tracker against section 3.1 of the paper, and against what goes wrong in rooms."""

from __future__ import annotations

import itertools
import math
import time
from collections import Counter

import numpy as np
import pytest
from builders import at_once, room
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation
from stick_figures import MIRROR, MODEL, SECOND, at, person, seen

from hiros_mcap.body.limb_thickness import capsules_of
from hiros_mcap.events import Events
from hiros_mcap.frames import by_frame
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.kernels.array_types import settings_of
from hiros_mcap.kernels.assignment import assign
from hiros_mcap.kernels.quaternions import angle_of
from hiros_mcap.skeletons import (
    ANGULAR_VELOCITY,
    ORIENTATION,
    POSITION,
    VELOCITY,
    People,
)
from hiros_mcap.stages.time_order import in_time_order
from hiros_mcap.stages.track import association
from hiros_mcap.stages.track.track import track_blocks
from hiros_mcap.stages.track.track_params import TrackParams

track = at_once(track_blocks)
ordered = by_frame(in_time_order)

settings_of_hypothesis = hypothesis_settings(deadline=None, max_examples=25)
AT_ONCE = TrackParams(
    confirm_detections=1, confirm_seconds=0.0, confirm_alone=0.0, reorder=0.0, lookahead=0.0,
    max_jump=math.inf, gate_growth=0.0, merge_tracks=False, reidentify=0.0,
)  # fmt: skip
CAMERAS = {name: np.array([x, y, 2.0]) for name, x, y in (("a", 4, 0), ("b", -4, 0), ("c", 0, 4))}


def ids(frames):
    return [frame.ids.tolist() for frame in frames]


def about_z(*angles):
    """Quaternions (len, 4), x y z w, of rotations about the vertical, rad."""
    half = np.array(angles) / 2
    return np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=-1)


def settings(**changes):
    """Settings of eq 6 to 11 in their plainest form."""
    plain = {"max_distance": 10.0, "orientation_weight": 1.0, "velocity_weight": 0.0}
    plain |= {"velocity_decay": 0.0, "horizon": 1.0, "flip_aware": False}
    plain |= {"ends": np.empty((0, 2), np.int32), "capsules": capsules_of(MODEL)}
    plain |= {"same": np.zeros(0, np.int32), "mirror": np.zeros(0, np.int32)}
    return settings_of(association.TrackSettings, TrackParams(), **plain | changes)


def compared(tracks, markers, links, confidence=1.0, since=0, **changes):  # fmt: skip
    """Compare tracks at 1 s with detections at rest, markers (P, M, 3) and links (P, L, 4)."""
    (p, m), n = markers.shape[:2], links.shape[1]
    people, same = People.allocate(p, m, n), np.arange(m, dtype=np.int32)
    used = settings(**{"same": same, "mirror": same} | changes)
    people.markers[..., POSITION], people.markers[..., VELOCITY] = markers, 0.0
    people.links[..., ORIENTATION], people.links[..., ANGULAR_VELOCITY] = links, 0.0
    people.marker_confidences[:] = people.link_confidences[:] = confidence
    rows, work = (
        np.arange(len(tracks.seen)),
        association.TrackWork.allocate(len(tracks.seen), p, m, n),
    )
    work.wanted.fill(True)
    association.predict(SECOND, rows, tracks, used, work)
    association.association_cost(rows, since, people, tracks, used, work)
    return work


def predicted_at(stamp, tracks, **changes):
    """Eq 7 of the first track."""
    m, n = tracks.seen.shape[1], tracks.links_seen.shape[1]
    work = association.TrackWork.allocate(1, 1, m, n)
    association.predict(stamp, np.zeros(1, np.int64), tracks, settings(**changes), work)
    return work


def tracks_at(positions, orientations):
    """Tracks (T, M, 3), (T, L, 4) that were seen at 1 s."""
    tracks = association.Tracks.allocate(*positions.shape[:2], orientations.shape[1])
    tracks.positions[:], tracks.orientations[:] = positions, orientations
    tracks.seen[:] = tracks.links_seen[:] = SECOND
    return tracks


def distances(
    track_at, detection, *, confidence=1.0, speed=0.0, decay=0.0, velocity_weight=0.0
):  # fmt: skip
    """Eq 8 and the mean distance of one track and one detection, all markers in common."""
    tracks = tracks_at(track_at[None], np.empty((1, 0, 4)))
    tracks.velocities[0, :, 0] = speed
    pairs = compared(
        tracks, detection[None], np.empty((1, 0, 4)), confidence, velocity_decay=decay,
        velocity_weight=velocity_weight,
    )  # fmt: skip
    return float(pairs.cost[0, 0]), float(pairs.distances[0, 0])


def test_eq8_is_the_weighted_mean_distance():
    off = np.array([[0.3, 0, 0], [0, 0.1, 0]])
    linear, gap = distances(np.zeros((2, 3)), off, confidence=0.5)
    assert linear == pytest.approx(0.5 * (0.3 + 0.1) / 2, abs=1e-12)
    assert gap == pytest.approx(0.2, abs=1e-12)


@pytest.mark.parametrize(("speed", "weight"), [(0, 1.0), (10, 0.5491), (100, 0.3154)])
def test_eq11_fast_markers_count_less(speed, weight):
    assert distances(
        np.zeros((1, 3)), np.array([[1.0, 0, 0]]), speed=speed, decay=0.25
    )[0] == pytest.approx(weight, abs=1e-4)  # fmt: skip


def test_markers_that_only_an_absent_detector_has_do_not_count():
    places = np.arange(24.0).reshape(8, 3)
    tracks = tracks_at(places[None], np.empty((1, 0, 4)))
    tracks.seen[0, 4:] -= SECOND // 2
    tracks.positions[0, 4:] += 2.0
    pairs = compared(tracks, places[None], np.empty((1, 0, 4)), horizon=0.2)
    assert pairs.distances[0, 0] == pytest.approx(0.0, abs=1e-12)
    tracks.seen[0, 2:] -= SECOND // 2  # too few are left, so that all count
    pairs = compared(tracks, places[None], np.empty((1, 0, 4)), horizon=0.2)
    assert pairs.distances[0, 0] > 1.0


def test_a_camera_does_not_confirm_the_sides_that_it_swapped_itself():
    """Four markers were shown by another camera since, four by nobody else."""
    mirror = np.array([1, 0, 3, 2, 5, 4, 7, 6], np.int32)
    places = np.array([[0.3 * (-1) ** m, 0.0, 0.2 * m] for m in range(8)])
    tracks = tracks_at(places[None].copy(), np.empty((1, 0, 4)))
    tracks.positions[0, 4:] = places[mirror][4:]
    tracks.seen[0, 4:] -= 20_000_000
    sides = {"flip_aware": True, "mirror": mirror}
    for since, is_found in ((SECOND - 10_000_000, True), (SECOND - 30_000_000, False)):
        pairs = compared(
            tracks, places[mirror][None], np.empty((1, 0, 4)), since=since, **sides
        )  # fmt: skip
        assert pairs.mirrored[0, 0] == is_found


def test_eq8_adds_the_velocity_difference():
    linear, _ = distances(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), speed=2, velocity_weight=0.1)
    assert linear == pytest.approx(1.2)


@pytest.mark.parametrize(("weight", "expected"), [(0.05, 1), (1.0, 0)])
def test_orientations_of_weight_decide_within_the_gate(weight, expected):
    """Who comes is nearer to 1, and faces as 0 does."""
    frames = [seen([person(), person(0.5)], at(k), turns=True) for k in range(5)]
    for frame in frames:
        frame.links[1, :, 3:7] = about_z(1.0)
    last = seen([person(0.3)], at(5), turns=True)
    assert last_id([*frames, last], orientation_weight=weight) == [expected]


@pytest.mark.parametrize(
    ("dot", "angle"), [(1, 0), (-1, 0), (1.1, 0), (math.sqrt(0.5), math.pi / 2)]
)
def test_eq10(dot, angle):
    assert angle_of(dot) == pytest.approx(angle, abs=1e-12)


def test_assignment_among_many_is_that_of_scipy():
    rng = np.random.default_rng(3)
    for size in ((40, 90), (90, 40), (60, 60)):
        places = [rng.uniform(0, 4, (n, 2)) for n in size]
        cost = np.linalg.norm(places[0][:, None] - places[1], axis=-1)
        padded = np.where(cost > 0.5, 1e4, cost)  # far apart: groups of all sizes
        match = assign(np.where(cost > 0.5, np.inf, cost))
        taken = [cost[i, j] for j, i in enumerate(match) if i >= 0]
        best = padded[linear_sum_assignment(padded)]
        assert len(taken) == np.count_nonzero(best < 1e4)
        assert sum(taken) == pytest.approx(best[best < 1e4].sum())


def test_people_who_are_apart_are_assigned_in_no_time():
    cost = np.full((4000, 400), np.inf)
    cost[np.arange(400) * 10, np.arange(400)] = cost[np.arange(400) * 10 + 1, np.arange(400)] = 0.1
    start = time.perf_counter()
    assert (assign(cost) // 10).tolist() == list(range(400))
    assert time.perf_counter() - start < 2.0  # 0.01 s; all at once would take minutes


def test_pairs_beyond_the_gate_are_infinitely_far_and_the_others_exact():
    rng = np.random.default_rng(4)
    poses, seen_at = rng.normal(size=(30, 12, 3)), rng.normal(size=(40, 12, 3))
    poses[:, :, :2] *= 0.1
    seen_at[:, :, :2] *= 0.1
    poses[:, :, 0] += rng.uniform(0, 3, (30, 1))
    seen_at[:, :, 0] += rng.uniform(0, 3, (40, 1))
    poses[rng.random((30, 12)) < 0.3] = np.nan
    seen_at[rng.random((40, 12)) < 0.3] = np.nan
    pairs = compared(
        tracks_at(poses, np.empty((30, 0, 4))), seen_at, np.empty((40, 0, 4)), max_distance=1.5
    )
    expected = np.nanmean(np.linalg.norm(poses[:, None] - seen_at, axis=-1), axis=-1)
    near = expected <= 1.5
    assert pairs.distances[near] == pytest.approx(expected[near])
    assert (pairs.distances[~near] > 1.5).all() and 20 < near.sum() < 1100


@pytest.mark.parametrize("seed", range(20))
def test_constant_velocity_is_predicted_exactly(seed):
    rng = np.random.default_rng(seed)
    start, twist = Rotation.random(random_state=seed), 3 * rng.normal(size=3)
    tracks = tracks_at(rng.normal(size=(1, 1, 3)), start.as_quat()[None, None])
    tracks.velocities[:], tracks.angular_velocities[:] = rng.normal(size=3), twist
    step = int(rng.integers(0, SECOND // 2))
    predicted = predicted_at(SECOND + step, tracks, horizon=1.0)
    dt = step * 1e-9
    expected = Rotation.from_rotvec(dt * twist) * start
    assert predicted.positions == pytest.approx(tracks.positions + dt * tracks.velocities, abs=1e-9)
    turned = Rotation.from_quat(predicted.orientations[0, 0])
    assert (expected.inv() * turned).magnitude() < 1e-9


def test_enter_stay_leave():
    frames = [seen([person()], at(k)) for k in range(30)]
    frames += [seen([], at(k)) for k in range(30, 90)]
    events = Events()
    tracked = list(track(frames, MODEL, AT_ONCE, events))
    assert ids(tracked) == [[0]] * 30 + [[]] * 60
    assert [event.kind for event in events.log] == ["track born", "track lost"]


def test_the_second_of_two_people_enters_and_leaves_at_its_time():
    frames = [seen([person()] + [person(2)] * (10 <= k < 40), at(k)) for k in range(60)]
    frames += [seen([], at(k)) for k in range(60, 150)]
    events = Events()
    tracked = list(track(frames, MODEL, AT_ONCE, events))
    assert ids(tracked) == [[0]] * 10 + [[0, 1]] * 30 + [[0]] * 20 + [[]] * 90
    # Who is lost was seen last at that time.
    assert sorted((event.stamp, event.kind, event.person) for event in events.log) == [
        (at(0), "track born", 0),
        (at(10), "track born", 1),
        (at(39), "track lost", 1),
        (at(59), "track lost", 0),
    ]


@pytest.mark.parametrize(("part", "expected"), [(0.99, 0), (1.01, 1)])
def test_gate(part, expected):
    jump = part * AT_ONCE.max_distance
    frames = [seen([person()], at(k)) for k in range(5)] + [seen([person(jump)], at(5))]
    assert ids(track(frames, MODEL, AT_ONCE))[-1] == [expected]


@pytest.mark.parametrize(("more", "expected"), [(-1, 0), (1, 1)])
def test_id_outlives_a_gap_of_max_gap_and_no_longer(more, expected):
    gap = round(AT_ONCE.max_gap * 30) + more
    frames = [seen([person()], at(k)) for k in range(5)] + [seen([person()], at(4 + gap))]
    assert ids(track(frames, MODEL, AT_ONCE))[-1] == [expected]


@pytest.mark.parametrize(("cameras", "share"), [(1, 0.13), (5, 0.1)])
def test_velocities_of_a_sinusoid(cameras, share):
    """Also with cameras 0.2 ms apart, where finite differences explode."""
    frames, stamps = [], []
    for k, camera in itertools.product(range(90), range(cameras)):
        stamps.append(at(k) + camera * 200_000)
        t = (stamps[-1] - at(0)) * 1e-9
        frames.append(seen([person(0.3 * math.sin(2 * math.pi * t))], stamps[-1], f"c{camera}"))
    tracked = list(track(frames, MODEL, AT_ONCE))[30 * cameras :]
    peak = 0.3 * 2 * math.pi
    t = (np.array([frame.stamp for frame in tracked]) - at(0)) * 1e-9
    error = np.array([f.velocities[0, 0, 0] for f in tracked]) - peak * np.cos(2 * np.pi * t)
    assert np.sqrt(np.mean(error**2)) < share * peak


def shuffled():
    """Frames of three cameras in order, and up to 80 ms late."""
    frames = [
        seen([person(0.02 * k + 0.001 * c), person(2)], at(k, c), f"c{c}")
        for k in range(40)
        for c in range(3)
    ]
    rng = np.random.default_rng(3)
    late = sorted(frames, key=lambda f: f.stamp + rng.uniform(0, 0.08) * SECOND)
    assert late != frames
    return frames, late


def everything(frames):
    return [
        (f.stamp, f.source, f.ids.tolist(), f.markers.tobytes(), f.links.tobytes()) for f in frames
    ]


def test_shuffled_channels_give_the_same_tracks():
    frames, late = shuffled()
    tracked = [everything(track(ordered(some, 1.0), MODEL)) for some in (late, frames)]
    assert tracked[0] == tracked[1]


def test_shuffled_channels_of_a_log_give_the_same_tracks(tmp_path):
    tracked = []
    for number, frames in enumerate(shuffled()):
        path = tmp_path / f"{number}.mcap"
        encoder, channels = Encoder(MODEL), dict[str, int]()
        with McapWriter(path) as writer:
            for k, frame in enumerate(frames):
                if frame.source not in channels:
                    topic = f"/{frame.source}/skeletons"
                    channels[frame.source] = add_skeleton_channel(writer, topic)
                writer.write(channels[frame.source], at(0) + k, encoder.encode(frame))
            writer.commit()
        with open_log(path) as log:
            tracked.append(everything(track(ordered(log.detections(), 1.0), log.model)))
    assert len(tracked[0]) == 120
    assert tracked[0] == tracked[1]


def test_a_frame_too_late_to_sort_is_used_all_the_same():
    frames = [seen([person()], at(k)) for k in range(30)]
    frames.append(seen([person()], at(2, 1), "b"))
    assert len(list(ordered(frames, 0.1))) == 31
    assert all(i == [0] for i in ids(track(frames, MODEL)))


def order_of(arrivals, delay):
    """(stamp, camera, latest stamp that arrived before it was let go), ms, of such frames."""

    def frames():
        for stamp, camera in arrivals:
            now.append(stamp)
            yield seen([person()], stamp * 1_000_000, camera)

    now: list[int] = []
    found = ordered(frames(), delay)
    return [(frame.stamp // 1_000_000, frame.source, max(now)) for frame in found]


def every(period, start, end, camera):
    return [(stamp, camera) for stamp in range(start, end, period)]


def test_frames_go_in_order_and_wait_no_longer_than_said():
    """Camera b lags by a third of a second: the frames of a wait for it."""
    frames = every(33, 1000, 4000, "a") + every(33, 1001, 4000, "b")
    arrivals = sorted(frames, key=lambda f: f[0] + (330 if f[1] == "b" else 0))
    order = order_of(arrivals, 0.4)
    assert [frame[:2] for frame in order] == sorted(frames)
    assert all(now - stamp < 450 for stamp, _, now in order)


def test_a_camera_that_stalls_is_waited_for_up_to_the_delay():
    """Messages of b from 3 s on arrive 0.9 s late, all at once; from 3.9 s on it is silent."""
    a, b = every(33, 1000, 7000, "a"), every(33, 1001, 3900, "b")
    arrivals = sorted(a + b, key=lambda f: max(f[0], 3900) if f[1] == "b" and f[0] > 3000 else f[0])
    order = order_of(arrivals, 1.0)
    assert [frame[:2] for frame in order] == sorted(a + b)
    assert all(now - stamp < 1034 for stamp, _, now in order)


def test_frames_in_which_nothing_can_change_are_not_held():
    """Two cameras see somebody: once that is settled, the look-ahead has nothing to wait for."""
    params = TrackParams(reorder=0.0)
    arrived, waits = 0, []

    def frames():
        nonlocal arrived
        for k, camera in itertools.product(range(90), "ab"):
            arrived = at(k)
            yield seen([person()], at(k), camera)

    streamed = by_frame(track_blocks)
    for frame in streamed(frames(), MODEL, params):
        assert frame.ids.tolist() == [0]
        waits.append(arrived - frame.stamp)
    assert max(waits[20:]) == 0
    alone = [seen([person()], at(k)) for k in range(90)]
    assert len(list(itertools.takewhile(lambda f: f.stamp < at(30), streamed(alone, MODEL)))) == 30


def test_equal_times_and_no_ids_keep_everybody():
    frames = [seen([person(), person(1)], at(k), c) for k in range(30) for c in "ab"]
    assert all(sorted(i) == [0, 1] for i in ids(track(frames, MODEL)))


@pytest.mark.parametrize("apart", [0.45, 0.6])
def test_people_close_to_each_other_keep_their_ids(apart):
    frames = [seen([person(), person(apart)], at(k, c), f"c{c}") for k in range(60) for c in (0, 1)]
    assert {tuple(i) for i in ids(track(frames, MODEL))} == {(0, 1)}


def test_two_people_crossing_keep_their_ids():
    frames = [
        seen([person(-1 + 0.03 * k), person(1 - 0.03 * k, 0.4)], at(k, c), f"c{c}")
        for k in range(66)
        for c in (0, 1)
    ]
    assert {tuple(i) for i in ids(track(frames, MODEL))} == {(0, 1)}


def test_an_id_lasts_while_one_camera_or_another_sees_the_person():
    """Three cameras see a walker for two seconds each, one after the other (section 4.3)."""
    frames = [seen([person(0.03 * k)], at(k, k // 60), "abc"[k // 60]) for k in range(180)]
    assert ids(track(frames, MODEL)) == [[0]] * 180


def test_a_body_of_a_few_frames_is_nobody():
    frames = [seen([person()] + [person(3)] * (10 <= k < 18), at(k)) for k in range(90)]
    events = Events()
    assert {i for frame in ids(track(frames, MODEL, events=events)) for i in frame} == {0, -1}
    assert events.counts["not confirmed", "a"] == 8


def test_somebody_confirmed_has_the_id_from_the_first_detection():
    frames = [seen([person()], at(k)) for k in range(90)]
    assert all(i == [0] for i in ids(track(frames, MODEL)))


def walkers(k):
    """Two people who walk up and down in front of everybody."""
    return [person(1.5 * math.sin(k / 20), 1.5), person(1.5 * math.cos(k / 20), -1.5)]


@pytest.mark.parametrize("late", [0, 100])
def test_a_static_phantom_of_one_camera_of_three_is_nobody(late):
    frames = []
    for k in range(300):
        for c, name in enumerate("abc"):
            phantom = [person(0.0, 0.2)] if name == "a" and k >= late else []
            frames.append(seen(walkers(k) + phantom, at(k, c), name))
    tracked = list(track(frames, MODEL, cameras=CAMERAS))
    last = [f.ids.tolist() for f in tracked[-60:] if f.source == "a"]
    assert all(i[2] == -1 and i[0] >= 0 and i[1] >= 0 for i in last)
    assert {i for f in tracked[-60:] for i in f.ids.tolist()} == {0, 1, -1}


@pytest.mark.parametrize(("sway", "is_somebody"), [(0.0, False), (0.12, True)])
def test_an_object_beside_people_who_stand_is_nobody(sway, is_somebody):
    """Nobody has been there, but any picture of people so near to it holds it. The living sway."""
    frames = []
    for k in range(300):
        for c, name in enumerate("abc"):
            lone = [person(sway * math.sin(k / 20), 1.0)] if name == "a" else []
            frames.append(seen([person(0.0, 0.3), person(0.0, -0.3), *lone], at(k, c), name))
    tracked = list(track(frames, MODEL, cameras=CAMERAS))
    last = [f.ids.tolist() for f in tracked[-60:] if f.source == "a"]
    assert {i[2] >= 0 for i in last} == {is_somebody}


@pytest.mark.parametrize("since", [0, 40])
def test_a_second_body_on_a_person_is_not_a_person(since):
    frames = [seen([person()] + [person(0.15)] * (k >= since), at(k)) for k in range(90)]
    events = Events()
    assert all(sorted(i) == [-1, 0] for i in ids(track(frames, MODEL, events=events))[since:])
    assert events.total("duplicate") + events.total("not confirmed") == 90 - since
    assert events.total("duplicate") > 30


@pytest.mark.parametrize(
    ("away", "late", "people"), [(1.0, 0, {0}), (1.0, 13, {0}), (4.0, 0, {0, 1}), (1.0, 30, {0, 1})]
)
def test_who_is_shown_elsewhere_from_one_moment_to_the_next_keeps_the_id(away, late, people):
    """One camera may be late to agree. But nobody goes 4 m, and a second is more than a moment."""
    places = {"a": [*60 * [0.0], *60 * [away]], "b": [*(60 + late) * [0.0], *(60 - late) * [away]]}
    frames = [
        seen([person(places[name][k])], at(k, c), name)
        for k in range(120)
        for c, name in enumerate("ab")
    ]
    tracked = track(frames, MODEL, TrackParams(), cameras=CAMERAS)
    assert {i for frame in tracked for i in frame.ids.tolist()} == people


def test_a_second_body_is_found_also_beyond_the_gate():
    frames = [seen([person()] + [person(0.5)] * (k > 60), at(k)) for k in range(90)]
    events = Events()
    tracked = list(track(frames, MODEL, TrackParams(max_distance=0.2, min_distance=0.8), events))
    assert all(sorted(i) == [-1, 0] for i in ids(tracked)[61:])
    assert events.total("duplicate") == 29


def test_somebody_who_enters_beside_another_gets_an_own_id():
    frames = [seen([person()] + [person(0.5)] * (k > 30), at(k)) for k in range(120)]
    assert ids(track(frames, MODEL))[-1] == [0, 1]


def test_two_people_who_enter_close_together_have_their_ids_from_the_start():
    """A detection beside a tentative track is no duplicate: nobody knows yet who is who."""
    apart = [0.2, *[0.6] * 40]
    frames = [seen([person()], at(k)) for k in range(2)]
    frames += [seen([person(), person(x)], at(2 + k)) for k, x in enumerate(apart)]
    assert ids(track(frames, MODEL)) == [[0]] * 2 + [[0, 1]] * 41


def test_a_camera_that_reported_a_person_does_not_contradict_itself():
    """Camera b stops; a alone reports somebody for a second, then for another second does not."""
    frames = [seen(walkers(k), at(k, c), "ab"[c]) for k in range(60) for c in range(2)]
    for k in range(60, 150):
        there = [] if 90 <= k < 120 else [person(0.0, 0.2)]
        frames.append(seen(walkers(k) + there, at(k), "a"))
    events = Events()
    tracked = list(track(frames, MODEL, events=events, cameras=CAMERAS))
    assert {f.ids.tolist()[2] for f in tracked if f.n_people == 3} == {2}
    assert "track withdrawn" not in {event.kind for event in events.log}


def test_a_swapped_body_keeps_its_id_and_does_not_throw_the_track():
    frames = [seen([person()[MIRROR] if 20 <= k < 40 else person()], at(k)) for k in range(60)]
    tracked = list(track(frames, MODEL))
    assert all(i == [0] for i in ids(tracked))
    assert max(np.nanmax(np.abs(f.velocities)) for f in tracked) < 0.1


def test_no_common_marker_does_not_hang():
    first, second = person(), person()
    first[4:], second[:4] = np.nan, np.nan
    frames = [seen([first], at(0)), seen([second], at(1))]
    assert ids(track(frames, MODEL, AT_ONCE)) == [[0], [1]]


def test_unknown_confidences_do_no_harm():
    frames = [seen([person()], at(k)) for k in range(10)]
    for frame in frames:
        frame.marker_confidences[:] = np.nan
    tracked = list(track(frames, MODEL, AT_ONCE))
    assert ids(tracked) == [[0]] * 10
    assert np.isfinite(tracked[-1].velocities).all()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda f: f.markers.fill(np.nan), "no markers"),
        (lambda f: f.confidences.fill(0.1), "low confidence"),
        (lambda f: f.markers[:, 2:].fill(np.nan), "too few markers"),
    ],
)
def test_what_is_left_out_is_counted(change, reason):
    frame, events = seen([person()], at(0)), Events()
    change(frame)
    params = AT_ONCE.model_copy(update={"min_skeleton_confidence": 0.5})
    assert ids(track([frame], MODEL, params, events)) == [[-1]]
    assert events.counts[reason, "a"] == 1


def test_frames_are_not_changed_and_memory_of_the_gone_is_freed():
    frames = [seen([person(3.0 * (k // 60))], at(k + 60 * (k // 60))) for k in range(600)]
    before = [frame.markers.copy() for frame in frames]
    tracked = list(track(frames, MODEL, TrackParams(reidentify=0.0)))
    assert all(
        np.array_equal(f.markers, b, equal_nan=True) for f, b in zip(frames, before, strict=True)
    )
    assert tracked[-1].ids.tolist() == [9]


def test_log_time_is_that_of_the_frame_that_settled_it():
    frames = [seen([person()], at(k)) for k in range(90)]
    params = TrackParams(lookahead=1.0, reorder=0.0)
    first = next(iter(track(frames, MODEL, params)))
    assert at(30) <= first.log_time <= at(31)


def table(
    tracks, turns, detections, links, *, gamma=0.0, omega=0.0, omega_weight=0.0, confidence=1.0
):  # fmt: skip
    """Eq 8, eq 9 and mean distances (T, P) of tracks (T, M, 3), (T, L, 4) and detections."""
    states = tracks_at(tracks, turns)
    states.angular_velocities[..., 2] = omega
    linear, total = (
        compared(
            states, detections, links, confidence, velocity_decay=gamma,
            angular_velocity_weight=omega_weight, orientation_weight=weight,
        )
        for weight in (0.0, 1.0)
    )  # fmt: skip
    return linear.cost, total.cost - linear.cost, linear.distances


def test_eq8_and_eq9_of_two_tracks_and_two_detections():
    """Two markers and two links each; every entry worked out by hand."""
    tracks = np.array([[[0.0, 0, 0], [0, 0, 1]], [[1, 0, 0], [1, 0, 1]]])
    seen_at = np.array([[[0.0, 0, 0], [0, 0.2, 1]], [[1, 0, 0], [1, 0, 1.5]]])
    turns = np.stack([about_z(0.0, 0.0), about_z(0.5, 1.0)])
    links = np.stack([about_z(0.1, 0.3), about_z(0.7, 0.8)])
    linear, angular, gap = table(tracks, turns, seen_at, links)
    across = math.hypot(1, 0.2), math.hypot(1, 0.5)
    assert linear == pytest.approx(
        np.array([[0.1, (1 + across[1]) / 2], [(1 + across[0]) / 2, 0.25]]), abs=1e-12
    )
    assert angular == pytest.approx(np.array([[0.2, 0.75], [0.55, 0.2]]), abs=1e-12)
    assert gap == pytest.approx(linear, abs=1e-12)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, 0.4),
        ({"confidence": 0.5}, 0.2),
        ({"omega": 3.0, "omega_weight": 0.1}, 0.7),
        ({"omega": 3.0, "gamma": 0.5}, 0.2),
    ],
)
def test_eq9(changes, expected):
    here, turned = np.zeros((1, 2, 3)), about_z(0.3, -0.5)[None]
    angular = table(here, about_z(0.0, 0.0)[None], here, turned, **changes)[1]
    assert angular[0, 0] == pytest.approx(expected, abs=1e-12)


def test_unknown_confidences_count_as_1():
    """Eq 11."""
    off = np.array([[0.3, 0, 0], [0, 0.1, 0]])
    linear, _ = distances(np.zeros((2, 3)), off, confidence=math.nan)
    assert linear == pytest.approx(0.2, abs=1e-12)
    here, turned = np.zeros((1, 2, 3)), about_z(0.3, -0.5)[None]
    angular = table(here, about_z(0.0, 0.0)[None], here, turned, confidence=math.nan)[1]
    assert angular[0, 0] == pytest.approx(0.4, abs=1e-12)


def test_a_link_of_opposite_sign_is_the_same_orientation():
    here, turned = np.zeros((1, 1, 3)), about_z(2.0)[None]
    assert table(here, turned, here, -turned)[1][0, 0] == pytest.approx(0, abs=1e-7)


def nearest(places, turns, weight):
    """Which of two tracks, at so many m and turned by so many rad, a detection at 0 is given to."""
    positions = np.zeros((2, 1, 3))
    positions[:, 0, 0] = places
    tracks = tracks_at(positions, np.stack([about_z(angle) for angle in turns]))
    pairs = compared(tracks, np.zeros((1, 1, 3)), about_z(0.0)[None], orientation_weight=weight)
    return int(assign(pairs.cost)[0])


@pytest.mark.parametrize(("weight", "expected"), [(0.0, 1), (1.0, 0)])
def test_eq6_adds_turns_to_distances(weight, expected):
    """The nearer track is turned by 0.5 rad: which one wins is up to the weight of eq 6."""
    assert nearest((0.2, 0.1), (0.0, 0.5), weight) == expected


@pytest.mark.parametrize("weight", [1.0, 0.5])
@pytest.mark.parametrize(("more", "expected"), [(-1e-12, 1), (1e-12, 0)])
def test_eq6_is_the_sum(weight, more, expected):
    """A hair's breadth from the place where a turn of 0.05 rad makes up for the distance."""
    assert nearest((0.2, 0.2 - weight * 0.05 + more), (0.0, 0.05), weight) == expected


def test_assignment_with_forbidden_pairs_is_largest_and_then_cheapest():
    rng = np.random.default_rng(2)
    for _ in range(300):
        n = int(rng.integers(1, 6))
        cost = np.where(rng.random((n, n)) < 0.4, np.inf, rng.random((n, n)))
        sets = [
            [cost[i, j] for j, i in enumerate(rows) if cost[i, j] < np.inf]
            for rows in itertools.permutations(range(n))
        ]
        most = max(map(len, sets))
        cheapest = min(sum(pairs) for pairs in sets if len(pairs) == most)
        taken = [cost[i, j] for j, i in enumerate(assign(cost)) if i >= 0]
        assert len(taken) == most
        assert sum(taken) == pytest.approx(cheapest)


def test_prediction_stands_still_beyond_the_horizon():
    tracks = tracks_at(np.zeros((1, 1, 3)), about_z(0.0)[None])
    tracks.velocities[0, 0, 0] = 2.0
    predicted = predicted_at(3 * SECOND, tracks, horizon=0.2, fade=0.0)
    assert predicted.positions[0, 0] == pytest.approx([0.4, 0, 0])


def test_the_limbs_stop_at_the_horizon_and_the_body_fades_to_a_stop():
    tracks = tracks_at(np.zeros((1, 2, 3)), about_z(0.0)[None])
    tracks.velocities[0, :, 0] = 1.0, 3.0  # the body: 2 m/s
    soon = predicted_at(SECOND + 300_000_000, tracks, horizon=0.2, fade=0.3)
    late = predicted_at(60 * SECOND, tracks, horizon=0.2, fade=0.3)
    fading = 2.0 * 0.3 * (1 - math.exp(-1 / 3))
    assert soon.positions[0, :, 0] == pytest.approx([0.2 + fading, 0.6 + fading])
    assert late.positions[0, :, 0] == pytest.approx([0.2 + 0.6, 0.6 + 0.6])


def test_the_gate_of_an_unseen_track_grows_up_to_twice_its_size():
    tracks = tracks_at(np.zeros((1, 1, 3)), about_z(0.0)[None])
    gates = [
        predicted_at(SECOND + ms * 1_000_000, tracks, max_distance=0.6, horizon=0.2).gates[0]
        for ms in (0, 200, 600, 1000, 3000)
    ]
    assert gates == pytest.approx([0.6, 0.6, 0.9, 1.2, 1.2])


def test_a_track_out_of_reach_is_not_moved():
    far = [seen([person(5.0)], at(k)) for k in range(5, 10)]
    frames = [seen([person()], at(k)) for k in range(5)] + far + [seen([person()], at(10))]
    assert ids(track(frames, MODEL, AT_ONCE)) == [[0]] * 5 + [[1]] * 5 + [[0]]


def test_accelerations_of_a_steady_push():
    frames = [seen([person(0.5 * 2.0 * (k / 30) ** 2)], at(k)) for k in range(45)]
    last = list(track(frames, MODEL, AT_ONCE))[-1]
    assert last.accelerations[0, :, 0] == pytest.approx(np.full(8, 2.0), rel=0.1)


def test_angular_velocities_of_a_steady_turn():
    frames = [seen([person()], at(k), turns=True) for k in range(45)]
    for k, frame in enumerate(frames):
        frame.links[0, :, 3:7] = about_z(3.0 * k / 30)
    last = list(track(frames, MODEL, AT_ONCE))[-1]
    assert last.links[0, :, 10:13] == pytest.approx(np.tile([0, 0, 3.0], (7, 1)), abs=0.1)
    assert last.orientations == pytest.approx(frames[-1].orientations)


def test_links_that_shake_at_a_low_rate_do_not_spin():
    """8 Hz, 23 degrees of noise: what is carried by such a speed must stay near the truth."""
    shaken = np.random.default_rng(5).normal(0.0, 0.4, size=80)
    frames = [seen([person()], at(4 * k), turns=True) for k in range(len(shaken))]
    for frame, angle in zip(frames, shaken, strict=True):
        frame.links[0, :, 3:7] = about_z(angle)
    speeds = [abs(frame.links[0, 0, 12]) for frame in track(frames, MODEL, AT_ONCE)]
    assert max(speeds) <= 25.0
    assert np.median(speeds) < 6.0


def test_a_link_that_was_not_seen_turns_on_for_the_horizon_only():
    frames = [seen([person()], at(k), turns=k < 45 or k == 59) for k in range(60)]
    for k, frame in enumerate(frames[:45]):
        frame.links[0, :, 3:7] = about_z(3.0 * k / 30)
    params = AT_ONCE.model_copy(update={"horizon": 0.2})
    frames[-1].links[0, :, 3:7] = about_z(3.0 * (44 / 30 + params.horizon))  # as predicted
    last = list(track(frames, MODEL, params))[-1]
    assert last.links[0, :, 12] == pytest.approx(np.full(7, 3.0), abs=0.1)


def test_velocities_of_the_detector_are_kept():
    frames = [seen([person()], at(k)) for k in range(10)]
    for frame in frames:
        frame.velocities[:] = [0.5, 0.0, 0.0]
    assert all(np.all(f.velocities == [0.5, 0, 0]) for f in track(frames, MODEL, AT_ONCE))


def test_markers_below_the_threshold_are_absent():
    frame = seen([person()], at(0))
    frame.marker_confidences[0, 6:] = 0.1, np.nan
    params = AT_ONCE.model_copy(update={"min_marker_confidence": 0.2})
    (tracked,) = track([frame], MODEL, params)
    assert np.isnan(tracked.positions[0, 6]).all()
    assert tracked.positions[0, 7] == pytest.approx(person()[7])


@pytest.mark.parametrize("rates", [(15,), (15, 50), (15, 30, 50, 15, 30)])
def test_far_cameras_of_mixed_rates_lose_nothing(rates):
    """15, 30 and 50 Hz together; every message comes out, in order, with the same person."""
    stamped = sorted(
        (at(0) + k * SECOND // rate + c * 1_000_003, f"c{c}")
        for c, rate in enumerate(rates)
        for k in range(2 * rate)
    )
    tracked = list(track([seen([person()], t, c) for t, c in stamped], MODEL))
    assert [(f.stamp, f.source) for f in tracked] == stamped
    assert all(f.ids.tolist() == [0] for f in tracked)


def test_jittered_clocks_lose_nobody():
    rng = np.random.default_rng(4)
    frames = [
        seen([person(0.02 * k), person(0.02 * k, 1.0)], at(k + rng.uniform(-0.6, 0.6)), c)
        for k in range(60)
        for c in "abc"
    ]
    assert {tuple(i) for i in ids(track(frames, MODEL))} == {(0, 1)}


def test_somebody_two_cameras_agree_on_counts_at_once():
    frames = [seen([person()], at(k, c), "ab"[c]) for k in range(3) for c in range(2)]
    assert ids(track(frames, MODEL)) == [[0]] * 6
    assert ids(track(frames[::2], MODEL)) == [[-1]] * 3


def test_a_doubted_person_who_walks_after_all_has_the_old_id():
    """Behind a pillar for two of three cameras: the third alone sees him stand, then walk."""
    frames = []
    for k in range(420):
        hidden = person(max(0.0, (k - 360) * 0.03), 0.2)
        for c, name in enumerate("abc"):
            people = walkers(k) + ([hidden] if name == "a" else [])
            frames.append(seen(people, at(k, c), name))
    events = Events()
    tracked = list(track(frames, MODEL, events=events, cameras=CAMERAS))
    of_hidden = [f.ids[2] for f in tracked if f.n_people == 3]
    assert any(event.kind == "track withdrawn" and event.is_warning for event in events.log)
    assert of_hidden[-1] >= 0
    assert len({i for i in of_hidden if i >= 0}) == 1


# What the switches of eq 8 to 11 do to a run: each scene is close to where another person wins.


def last_id(frames, **changes):
    return ids(track(frames, MODEL, AT_ONCE.model_copy(update=changes)))[-1]


@pytest.mark.parametrize(("confidence", "expected"), [(0.01, 0), (1.0, 1)])
def test_markers_of_little_confidence_need_not_count(confidence, expected):
    odd = person()
    odd[4:] += [0, 2.0, 0]
    last = seen([odd], at(5))
    last.marker_confidences[0, 4:] = confidence
    frames = [*(seen([person()], at(k)) for k in range(5)), last]
    assert last_id(frames) == [expected]


@pytest.mark.parametrize(("weight", "expected"), [(0.0, 1), (1.0, 0)])
def test_velocities_may_tell_people_apart(weight, expected):
    """0 walks at 1 m/s and 1 stands; who comes walks, and is a little nearer to 1."""
    frames = [seen([person(-0.5 + k / 30), person(0.4)], at(k)) for k in range(15)]
    last = seen([person(0.22)], at(15))
    last.velocities[:] = [1.0, 0, 0]
    assert last_id([*frames, last], velocity_weight=weight) == [expected]


@pytest.mark.parametrize(("weight", "expected"), [(0.0, 1), (1.0, 0)])
def test_angular_velocities_may_tell_people_apart(weight, expected):
    """0 turns at 3 rad/s and 1 does not; who comes turns, and is a little nearer to 1."""
    frames = [seen([person(), person(0.5)], at(k), turns=True) for k in range(30)]
    for k, frame in enumerate(frames):
        frame.links[:, :, 3:7] = about_z((k - 30) / 10, 0.0)[:, None]
    last = seen([person(0.26)], at(30), turns=True)
    last.links[:, :, 10:13] = [0, 0, 3.0]
    changes = {"angular_velocity_weight": weight, "orientation_weight": 0.5}
    assert last_id([*frames, last], **changes) == [expected]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [({}, 0), ({"velocity_decay": 0.0}, 1)],
)
def test_markers_that_fly_need_not_count(changes, expected):
    """Some fly at 10 m/s and are 1.4 m from where they were to be; the others stand."""

    def pose(k, more=0.0):
        points = person()
        points[4:, 1] += k / 3 + more
        return points

    frames = [seen([pose(k)], at(k)) for k in range(30)] + [seen([pose(30, 1.4)], at(30))]
    assert last_id(frames, **changes) == [expected]


# When a tentative track counts, and when it is forgotten


def test_one_report_of_a_second_camera_confirms_nobody():
    """A phantom of camera a lasts three frames; b reports it once, too."""
    frames = [seen([person()], at(k), "a") for k in range(4)] + [seen([person()], at(4), "b")]
    frames += [seen([], at(k), "a") for k in range(5, 60)]
    assert {i for frame in ids(track(frames, MODEL)) for i in frame} == {-1}


def test_two_reports_of_a_second_camera_confirm_a_person():
    frames = [seen([person()], at(k), "aabba"[k]) for k in range(5)]
    assert ids(track(frames, MODEL)) == [[0]] * 5


@pytest.mark.parametrize(("gap", "expected"), [(0.45, 0), (0.55, -1)])
def test_a_tentative_track_outlives_a_gap_of_half_a_second(gap, expected):
    """Three detections, a gap, two more: five of one track confirm it, with no time to last."""
    later = round(30 * gap) + 2 if expected else 2 + 13
    frames = [seen([person()], at(k)) for k in (0, 1, 2, later, later + 1)]
    params = TrackParams(confirm_seconds=0.1)
    assert ids(track(frames, MODEL, params))[-1] == [expected]


@pytest.mark.parametrize(("part", "mirrored"), [(0.45, True), (0.55, False)])
def test_a_detection_is_mirrored_only_if_that_halves_its_distance(part, mirrored):
    """A swapped pose, moved until the distances of both readings have that ratio."""
    pose, away = person()[MIRROR], np.linspace(0.0, 0.5, 5001)
    apart = pose - person() + np.stack([away, 0 * away, 0 * away], axis=1)[:, None]
    plain = np.linalg.norm(apart, axis=2).mean(axis=1)
    shift = np.array([away[np.argmin(np.abs(away / plain - part))], 0, 0])
    frames = [seen([person()], at(k)) for k in range(20)]
    frames.append(seen([pose + shift], at(20)))
    last = list(track(frames, MODEL, AT_ONCE))[-1]
    across = np.abs(last.velocities[0, 6:, 1]).max()  # a swap moves the wrists 0.8 m
    assert (across < 0.1) == mirrored


def test_a_leap_corrects_a_track_less_than_its_size_says():
    """Innovations beyond the gate are inflated to it: a leap moves the track less than in full."""

    def velocity(leap, gate):
        frames = [seen([person()], at(k)) for k in range(30)] + [seen([person(leap)], at(30))]
        params = AT_ONCE.model_copy(update={"innovation_gate": gate})
        return float(list(track(frames, MODEL, params))[-1].velocities[0, 0, 0])

    assert velocity(0.05, 3.0) == pytest.approx(velocity(0.05, 1e6))
    assert velocity(0.5, 1e6) == pytest.approx(10 * velocity(0.05, 1e6), rel=1e-6)
    assert velocity(0.5, 3.0) < 0.5 * velocity(0.5, 1e6)


def test_markers_of_little_confidence_move_velocities_little():
    def velocity(confidence):
        frames = [seen([person()], at(k)) for k in range(30)] + [seen([person(0.05)], at(30))]
        frames[-1].marker_confidences[:] = confidence
        return float(list(track(frames, MODEL, AT_ONCE))[-1].velocities[0, 0, 0])

    assert velocity(0.2) < 0.8 * velocity(1.0)
    assert velocity(0.01) == pytest.approx(velocity(0.05))


@pytest.mark.parametrize("scale", [0.5, 1.0])
def test_a_guessed_marker_hardly_moves_its_velocity(scale):
    """Detectors guess a joint five times as wrongly as they see one, at half of the confidence.

    What is half depends on the detector: one that is never surer than 0.33 guesses below 0.25.
    """

    def velocity(confidence):
        frames = [seen([person()], at(k)) for k in range(30)] + [seen([person(0.05)], at(30))]
        for frame in frames:
            frame.marker_confidences[:] = 0.66 * scale
        frames[-1].marker_confidences[0, 0] = confidence * scale
        return float(list(track(frames, MODEL, AT_ONCE))[-1].velocities[0, 0, 0])

    assert velocity(0.33) < 0.3 * velocity(0.66)


@pytest.mark.parametrize(("moved", "expected"), [("guessed", 0), ("seen", -1)])
def test_a_detection_leaps_by_the_markers_that_its_detector_sees(moved, expected):
    """Three guesses 1.5 m off leave the mean beyond max_jump."""
    guessed = np.arange(MODEL.n_markers) >= MODEL.n_markers - 3
    frames = [seen([person()], at(k)) for k in range(31)]
    last = frames[-1]
    last.marker_confidences[0] = np.where(guessed, 0.33, 0.66)
    if moved == "guessed":
        last.markers[0, guessed, 2] += 1.5
    else:
        last.markers[0, ~guessed, 2] += 0.4
    params = AT_ONCE.model_copy(update={"max_jump": 0.3})
    assert ids(track(frames, MODEL, params))[-1] == [expected]


def test_no_marker_is_faster_than_a_person():
    frames = [seen([person(0.5 * k)], at(k)) for k in range(30)]
    params = AT_ONCE.model_copy(update={"max_distance": 5.0, "innovation_gate": 1e6})
    tracked = list(track(frames, MODEL, params))
    speeds = [np.linalg.norm(f.velocities, axis=-1).max() for f in tracked]
    assert max(speeds) == pytest.approx(12.0)
    assert np.all(tracked[-1].accelerations == 0.0)


def test_a_marker_unseen_for_long_starts_anew():
    """Away for a second, a hand is 1 m off: no velocity comes of that."""
    frames = [seen([person()], at(k)) for k in range(60)]
    for k in range(20, 50):
        frames[k].markers[0, 6] = np.nan
    for k in range(50, 60):
        frames[k].markers[0, 6, 2] += 1.0
    tracked = list(track(frames, MODEL, AT_ONCE))
    assert max(np.nanmax(np.abs(f.velocities[0, 6])) for f in tracked[50:]) < 1e-6


@settings_of_hypothesis
@given(st.lists(st.tuples(st.integers(0, 200), st.sampled_from("abc")), max_size=40))
def test_time_order_loses_and_invents_nothing(arrivals):
    order = order_of(arrivals, 0.05)
    assert sorted(found[:2] for found in order) == sorted(arrivals)


@settings_of_hypothesis
@given(st.integers(1, 3), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_every_detection_comes_out_where_it_was(people, cameras, seed):
    rng = np.random.default_rng(seed)
    frames = [
        seen([person(*rng.normal(size=2)) for _ in range(people)], at(k, c), "abc"[c])
        for k in range(8)
        for c in range(cameras)
    ]
    for before, after in zip(frames, track(frames, MODEL), strict=True):
        assert np.array_equal(before.positions, after.positions)
        named = [i for i in after.ids.tolist() if i >= 0]
        assert len(set(named)) == len(named)


@pytest.mark.parametrize("seed", [101, 102, 104])
def test_ids_last_at_10_hz_though_cameras_guess_who_is_half_hidden(seed):
    """A view that is off by .2 to .3 m must not throw the track away from all other views."""
    where = room(
        people=3, cameras=4, seconds=12, seed=seed, action="walk", occlusion=1.5,
        rig={"rate": 10, "range": (0.5, 4.3)}, detector={"guess": 0.12},
    )  # fmt: skip
    params = TrackParams(lookahead=0.0, reidentify=0.0)
    tracked = list(track(where.frames, where.model, params, cameras=where.cameras))
    counts = Counter(itertools.chain(*ids(tracked)))
    assert sum(number >= 0 for number in counts) <= 4


@pytest.mark.parametrize("front", [0.0, 1.5])
def test_a_view_of_somebody_hidden_does_not_throw_out_the_good_one(front):
    """Person 0 stands. Camera a shows him sink, behind person 1 or beside; then b shows him."""
    places = {"a": np.array([-3.0, 0.0, 1.2]), "b": np.array([0.0, -3.0, 1.2])}
    frames = []
    for k in range(63):
        sunk = 0.2 * max(k - 59, 0)
        other = person(-1.0, 1.5 if k < 60 else front)
        views = ("a", [person() - [0, 0, sunk], other]), ("b", [person(), other])
        frames += [seen(view, at(k, c), name) for c, (name, view) in enumerate(views)
                   if name == "a" or k < 60 or k == 62]  # fmt: skip
    last = list(track(frames, MODEL, TrackParams(), None, places))[-1]
    assert (last.ids[0] == 0) == (front == 0.0)
