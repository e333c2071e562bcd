"""The tracker against section 3.1 of the paper, and against what goes wrong in rooms."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from stick_figures import MIRROR, MODEL, SECOND, at, person, seen

from hiros_mcap.events import Events
from hiros_mcap.kernels import tracking
from hiros_mcap.skeletons import Floats, Frame
from hiros_mcap.stages.track import TrackParams, in_time_order, track

AT_ONCE = TrackParams(confirm_detections=1, confirm_seconds=0.0, reorder=0.0, lookahead=0.0)
CAMERAS = {name: np.array([x, y, 2.0]) for name, x, y in (("a", 4, 0), ("b", -4, 0), ("c", 0, 4))}


def ids(frames: Iterable[Frame]) -> list[list[int]]:
    return [frame.ids.tolist() for frame in frames]


def distances(
    track_at: Floats, detection: Floats, *, confidence: float = 1.0, exponent: float = 1.0,
    speed: float = 0.0, decay: float = 0.0, velocity_weight: float = 0.0,
) -> tuple[float, float]:  # fmt: skip
    """Eq 8 and the mean distance of one track and one detection, all markers in common."""
    m = len(track_at)
    motion = np.zeros((1, m, 3, 3))
    motion[0, :, 0], motion[0, :, 1, 0] = track_at, speed
    markers = np.full((1, m, 19), np.nan)
    markers[0, :, :3], markers[0, :, 7:10] = detection, 0.0
    out = [np.empty((1, 1)) for _ in range(4)]
    tracking.distances(
        track_at[None].copy(), np.full((1, 0, 4), np.nan), np.zeros(1, np.int64), motion,
        np.zeros((1, 0, 2, 3)), markers, np.full((1, m), confidence), np.full((1, 0, 19), np.nan),
        np.empty((1, 0)), np.arange(m, dtype=np.int32), True, decay > 0, decay, velocity_weight,
        0.0, exponent, 10.0, *out,
    )  # fmt: skip
    return float(out[0][0, 0]), float(out[2][0, 0])


def test_eq8_is_the_weighted_mean_distance() -> None:
    off = np.array([[0.3, 0, 0], [0, 0.1, 0]])
    linear, gap = distances(np.zeros((2, 3)), off, confidence=0.5)
    assert linear == pytest.approx(0.5 * (0.3 + 0.1) / 2, abs=1e-12)
    assert gap == pytest.approx(0.2, abs=1e-12)


def test_eq8_exponent_prefers_more_common_markers() -> None:
    few = distances(np.zeros((2, 3)), np.full((2, 3), 0.1), exponent=2.0)[0]
    many = distances(np.zeros((20, 3)), np.full((20, 3), 0.1), exponent=2.0)[0]
    assert many == pytest.approx(few / 10)


@pytest.mark.parametrize(("speed", "weight"), [(0, 1.0), (10, 0.5491), (100, 0.3154)])
def test_eq11_fast_markers_count_less(speed: float, weight: float) -> None:
    assert distances(
        np.zeros((1, 3)), np.array([[1.0, 0, 0]]), speed=speed, decay=0.25
    )[0] == pytest.approx(weight, abs=1e-4)  # fmt: skip


def test_eq8_adds_the_velocity_difference() -> None:
    linear, _ = distances(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), speed=2, velocity_weight=0.1)
    assert linear == pytest.approx(1.2)


@pytest.mark.parametrize(
    ("dot", "angle"), [(1, 0), (-1, 0), (1.1, 0), (math.sqrt(0.5), math.pi / 2)]
)
def test_eq10(dot: float, angle: float) -> None:
    assert tracking.angle_of(dot) == pytest.approx(angle, abs=1e-12)


def test_assignment_is_optimal() -> None:
    rng = np.random.default_rng(1)
    for _ in range(1000):
        cost = rng.random((rng.integers(1, 7), rng.integers(1, 7)))
        match = tracking.assign(cost)
        total = sum(cost[i, j] for j, i in enumerate(match) if i >= 0)
        assert total == pytest.approx(cost[linear_sum_assignment(cost)].sum())
        assert len(set(match[match >= 0])) == min(cost.shape)


def test_assignment_never_takes_a_forbidden_pair() -> None:
    cost = np.array([[np.inf, 1.0], [np.inf, np.inf]])
    assert tracking.assign(cost).tolist() == [-1, 0]


def test_constant_velocity_is_predicted_exactly() -> None:
    motion, turn, spin = np.zeros((1, 1, 3, 3)), np.zeros((1, 1, 4)), np.zeros((1, 1, 2, 3))
    motion[0, 0, 1] = 1.0, -2.0, 0.5
    turn[0, 0, 3], spin[0, 0, 0, 2] = 1.0, 3.0
    stamps = np.full((1, 1), SECOND)
    position, turned = np.empty((1, 1, 3)), np.empty((1, 1, 4))
    tracking.predict(
        SECOND + SECOND // 10, np.zeros(1, np.int64), motion, stamps, turn, spin, stamps, 0.2,
        position, turned,
    )  # fmt: skip
    assert position[0, 0] == pytest.approx([0.1, -0.2, 0.05], abs=1e-12)
    assert turned[0, 0] == pytest.approx([0, 0, math.sin(0.15), math.cos(0.15)], abs=1e-9)


def test_enter_stay_leave() -> None:
    frames = [seen([person()], at(k)) for k in range(30)]
    frames += [seen([], at(k)) for k in range(30, 90)]
    events = Events()
    tracked = list(track(frames, MODEL, AT_ONCE, events))
    assert ids(tracked) == [[0]] * 30 + [[]] * 60
    assert [event.kind for event in events.log] == ["track born", "track lost"]


@pytest.mark.parametrize(("part", "expected"), [(0.99, 0), (1.01, 1)])
def test_gate(part: float, expected: int) -> None:
    jump = part * AT_ONCE.max_distance
    frames = [seen([person()], at(k)) for k in range(5)] + [seen([person(jump)], at(5))]
    assert ids(track(frames, MODEL, AT_ONCE))[-1] == [expected]


@pytest.mark.parametrize(("more", "expected"), [(-1, 0), (1, 1)])
def test_id_outlives_a_gap_of_max_gap_and_no_longer(more: int, expected: int) -> None:
    gap = round(AT_ONCE.max_gap * 30) + more
    frames = [seen([person()], at(k)) for k in range(5)] + [seen([person()], at(4 + gap))]
    assert ids(track(frames, MODEL, AT_ONCE))[-1] == [expected]


@pytest.mark.parametrize("cameras", [1, 5])
def test_velocities_of_a_sinusoid(cameras: int) -> None:
    """H18, also with cameras 0.2 ms apart, whose finite differences would explode."""
    frames, stamps = [], []
    for k, camera in itertools.product(range(90), range(cameras)):
        stamps.append(at(k) + camera * 200_000)
        t = (stamps[-1] - at(0)) * 1e-9
        frames.append(seen([person(0.3 * math.sin(2 * math.pi * t))], stamps[-1], f"c{camera}"))
    tracked = list(track(frames, MODEL, AT_ONCE))[30 * cameras :]
    peak = 0.3 * 2 * math.pi
    t = (np.array([frame.stamp for frame in tracked]) - at(0)) * 1e-9
    error = np.array([f.velocities[0, 0, 0] for f in tracked]) - peak * np.cos(2 * np.pi * t)
    assert np.sqrt(np.mean(error**2)) < 0.1 * peak


def test_shuffled_channels_give_the_same_tracks() -> None:
    frames = [seen([person(), person(2)], at(k, c), f"c{c}") for k in range(40) for c in range(3)]
    rng = np.random.default_rng(3)
    late = sorted(frames, key=lambda f: f.stamp + rng.uniform(0, 0.08) * SECOND)
    assert late != frames
    expected = [(f.stamp, f.source, f.ids.tolist()) for f in track(frames, MODEL)]
    assert [(f.stamp, f.source, f.ids.tolist()) for f in track(late, MODEL)] == expected


def test_a_frame_too_late_to_sort_is_used_all_the_same() -> None:
    frames = [seen([person()], at(k)) for k in range(30)]
    frames.append(seen([person()], at(2, 1), "b"))
    assert len(list(in_time_order(frames, 0.1))) == 31
    assert all(i == [0] for i in ids(track(frames, MODEL)))


def test_equal_times_and_no_ids_keep_everybody() -> None:
    frames = [seen([person(), person(1)], at(k), c) for k in range(30) for c in "ab"]
    assert all(sorted(i) == [0, 1] for i in ids(track(frames, MODEL)))


@pytest.mark.parametrize("apart", [0.45, 0.6])
def test_people_close_to_each_other_keep_their_ids(apart: float) -> None:
    frames = [seen([person(), person(apart)], at(k, c), f"c{c}") for k in range(60) for c in (0, 1)]
    assert {tuple(i) for i in ids(track(frames, MODEL))} == {(0, 1)}


def test_two_people_crossing_keep_their_ids() -> None:
    frames = [
        seen([person(-1 + 0.03 * k), person(1 - 0.03 * k, 0.4)], at(k, c), f"c{c}")
        for k in range(66)
        for c in (0, 1)
    ]
    assert {tuple(i) for i in ids(track(frames, MODEL))} == {(0, 1)}


def test_a_body_of_a_few_frames_is_nobody() -> None:
    frames = [seen([person()] + [person(3)] * (10 <= k < 18), at(k)) for k in range(90)]
    events = Events()
    assert {i for frame in ids(track(frames, MODEL, events=events)) for i in frame} == {0, -1}
    assert events.counts["not confirmed", "a"] == 8


def test_somebody_confirmed_has_the_id_from_the_first_detection() -> None:
    frames = [seen([person()], at(k)) for k in range(90)]
    assert all(i == [0] for i in ids(track(frames, MODEL)))


def walkers(k: int) -> list[Floats]:
    """Two people who walk up and down in front of everybody."""
    return [person(1.5 * math.sin(k / 20), 1.5), person(1.5 * math.cos(k / 20), -1.5)]


@pytest.mark.parametrize("late", [0, 100])
def test_a_static_phantom_of_one_camera_of_three_is_nobody(late: int) -> None:
    frames = []
    for k in range(300):
        for c, name in enumerate("abc"):
            phantom = [person(0.0, 0.2)] if name == "a" and k >= late else []
            frames.append(seen(walkers(k) + phantom, at(k, c), name))
    tracked = list(track(frames, MODEL, cameras=CAMERAS))
    last = [f.ids.tolist() for f in tracked[-60:] if f.source == "a"]
    assert all(i[2] == -1 and i[0] >= 0 and i[1] >= 0 for i in last)
    assert {i for f in tracked[-60:] for i in f.ids.tolist()} == {0, 1, -1}


@pytest.mark.parametrize("since", [0, 40])
def test_a_second_body_on_a_person_is_not_a_person(since: int) -> None:
    frames = [seen([person()] + [person(0.15)] * (k >= since), at(k)) for k in range(90)]
    events = Events()
    assert all(sorted(i) == [-1, 0] for i in ids(track(frames, MODEL, events=events))[since:])
    assert events.total("second body") + events.total("not confirmed") == 90 - since
    assert events.total("second body") > 30


def test_somebody_who_enters_beside_another_gets_an_own_id() -> None:
    frames = [seen([person()] + [person(0.5)] * (k > 30), at(k)) for k in range(120)]
    assert ids(track(frames, MODEL))[-1] == [0, 1]


def test_a_swapped_body_keeps_its_id_and_does_not_throw_the_track() -> None:
    frames = [seen([person()[MIRROR] if 20 <= k < 40 else person()], at(k)) for k in range(60)]
    tracked = list(track(frames, MODEL))
    assert all(i == [0] for i in ids(tracked))
    assert max(np.nanmax(np.abs(f.velocities)) for f in tracked) < 0.1


def test_no_common_marker_does_not_hang() -> None:
    first, second = person(), person()
    first[4:], second[:4] = np.nan, np.nan
    frames = [seen([first], at(0)), seen([second], at(1))]
    assert ids(track(frames, MODEL, AT_ONCE)) == [[0], [1]]


def test_unknown_confidences_do_no_harm() -> None:
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
def test_what_is_left_out_is_counted(change: Callable[[Frame], None], reason: str) -> None:
    frame, events = seen([person()], at(0)), Events()
    change(frame)
    params = AT_ONCE.model_copy(update={"min_skeleton_confidence": 0.5})
    assert ids(track([frame], MODEL, params, events)) == [[-1]]
    assert events.counts[reason, "a"] == 1


def test_frames_are_not_changed_and_memory_of_the_gone_is_freed() -> None:
    frames = [seen([person(3.0 * (k // 60))], at(k + 60 * (k // 60))) for k in range(600)]
    before = [frame.markers.copy() for frame in frames]
    tracked = list(track(frames, MODEL))
    assert all(
        np.array_equal(f.markers, b, equal_nan=True) for f, b in zip(frames, before, strict=True)
    )
    assert tracked[-1].ids.tolist() == [9]


def test_log_time_is_that_of_the_frame_that_settled_it() -> None:
    frames = [seen([person()], at(k)) for k in range(90)]
    params = TrackParams(lookahead=1.0, reorder=0.0)
    first = next(iter(track(frames, MODEL, params)))
    assert at(30) <= first.log_time <= at(31)
