import itertools
import math

import numpy as np
import pytest
from builders import at_once
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from hiros_mcap.events import Events
from hiros_mcap.frames import Block, by_frame, frames_of, join
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.stages.filter.filter import FilterParams, _SkeletonFilter, filter_blocks
from hiros_mcap.stages.filter.link_lengths import project

filter_frames = at_once(filter_blocks)
streamed = by_frame(filter_blocks)

MODEL = SkeletonModel.of(["root", "hand"], [("arm", 0, 1)])
METHODS = [("state_space", 2), ("state_space", 3)] + [("butterworth", n) for n in (1, 2, 3, 4, 8)]
LOOKAHEADS = [0.0, 0.3]
START = 1_700_000_000_000_000_000


def params(method="state_space", order=2, **others):
    return FilterParams(method=method, order=order, **{"keep_lengths": False, **others})


def frame_at(time, root=(0, 0, 0), hand=(0, 0, 0), turn=(0, 0, 0, 1), ids=(7,)):
    frame = Frame.empty(len(ids), MODEL, stamp=START + round(time * 1e9), source="world")
    frame.ids[:] = ids
    frame.markers[:, 0, :3], frame.markers[:, 1, :3] = root, hand
    frame.links[:, 0, 3:7] = turn
    return frame


def along(times, values, turns=None):
    """Frames whose root's x is ``values``."""
    turns = itertools.repeat((0, 0, 0, 1)) if turns is None else turns
    return [
        frame_at(t, (x, 0, 0), (x, 0.3, 0), q)
        for t, x, q in zip(times, values, turns, strict=False)
    ]


def run(frames, p, column=0, row="markers"):
    return np.array([getattr(f, row)[0, 0, column] for f in filter_frames(frames, MODEL, p)])


def amplitude(times, values, frequency):
    """Amplitude of the sine of ``frequency`` in ``values``, by least squares."""
    phase = 2 * np.pi * frequency * times
    basis = np.stack([np.sin(phase), np.cos(phase), np.ones_like(phase)], axis=1)
    return np.hypot(*np.linalg.lstsq(basis, values, rcond=None)[0][:2])


def turned(angles):
    """Quaternions of rotations about z."""
    half = np.asarray(angles) / 2
    return np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=-1)


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
@pytest.mark.parametrize(("method", "order"), METHODS)
@pytest.mark.parametrize(("rate", "cutoff"), [(30, 4.5), (30, 8.0), (100, 6.0), (15, 3.0)])
def test_minus_3_db_at_the_cutoff_by_sine_sweep(method, order, lookahead, rate, cutoff):
    times = np.arange(int(4 * rate)) / rate
    p = params(method, order, lookahead=lookahead, cutoff=cutoff)
    middle, frequencies = slice(rate, 3 * rate), (0.98 * cutoff, 1.02 * cutoff)
    waves = [np.sin(2 * np.pi * f * times) for f in frequencies]
    frames = [frame_at(t, (x, y, 0)) for t, x, y in zip(times, *waves, strict=True)]
    out = np.array([f.markers[0, 0, :2] for f in filter_frames(frames, MODEL, p)])[middle]
    below, above = (amplitude(times[middle], x, f) for x, f in zip(out.T, frequencies, strict=True))
    assert below > np.sqrt(0.5) > above


@pytest.mark.parametrize(
    ("method", "lookahead", "highest"),
    [("state_space", 0.0, 1.14), ("butterworth", 0.0, 1.0), ("state_space", 0.3, 1.0)],
)
def test_no_lag_without_looking_ahead_costs_a_resonance(method, lookahead, highest):
    """At 6 Hz, as in the preset paper: of a causal filter without lag, the peak is at 2.5 Hz."""
    times = np.arange(180) / 30
    middle, gains = slice(60, 150), {}
    for f in (0.5, 1.5, 2.5, 3.5):
        p = params(method, cutoff=6.0, lookahead=lookahead)
        out = run(along(times, np.sin(2 * np.pi * f * times)), p)
        gains[f] = amplitude(times[middle], out[middle], f)
    assert max(gains.values()) == pytest.approx(highest, abs=0.01)
    assert highest == 1.0 or max(gains, key=gains.get) == 2.5


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
@pytest.mark.parametrize(("method", "order"), METHODS)
def test_links_have_the_same_cutoff(method, order, lookahead):
    times = np.arange(150) / 30
    p = params(method, order, lookahead=lookahead, cutoff=4.5)
    turns = turned(0.2 * np.sin(2 * np.pi * 4.5 * times))
    out = list(filter_frames(along(times, times, turns), MODEL, p))
    angles = np.array([2 * np.arcsin(f.links[0, 0, 5]) for f in out])
    assert amplitude(times[45:130], angles[45:130], 4.5) == pytest.approx(
        0.2 * np.sqrt(0.5), rel=0.02
    )


@pytest.mark.parametrize("lookahead", [0.0, 0.1, 0.3])
@pytest.mark.parametrize(("method", "order"), METHODS)
def test_the_future_beyond_the_lookahead_changes_nothing(method, order, lookahead):
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.02, 0.05, 80))
    values = rng.normal(size=80)
    other = np.where(np.arange(80) < 50, values, 9.0)
    p = params(method, order, lookahead=lookahead)
    complete = times + lookahead <= times[49]
    a, b = run(along(times, values), p), run(along(times, other), p)
    assert complete.sum() > 35
    np.testing.assert_array_equal(a[complete], b[complete])
    assert a[60] != b[60]


def test_output_is_logged_when_its_lookahead_is_complete():
    out = list(filter_frames(along(np.arange(8) / 10, np.zeros(8)), MODEL, params(lookahead=0.3)))
    assert [round((f.stamp - START) / 1e8) for f in out] == list(range(8))
    assert [round((f.log_time - START) / 1e8) for f in out] == [3, 4, 5, 6, 7, 7, 7, 7]


def test_frames_come_out_as_soon_as_they_can():
    taken = []
    frames = (taken.append(f) or f for f in along(np.arange(9) / 10, np.zeros(9)))
    stream = streamed(frames, MODEL, params(lookahead=0.3))
    next(stream)
    assert len(taken) == 4
    next(stream)
    assert len(taken) == 5


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
@pytest.mark.parametrize("order", [2, 3])
def test_state_space_has_no_lag_on_steady_motion(order, lookahead):
    times = np.cumsum(np.random.default_rng(2).uniform(0.02, 0.05, 60))
    p = params(order=order, lookahead=lookahead)
    np.testing.assert_allclose(run(along(times, 1.5 * times), p), 1.5 * times, atol=2e-5)
    np.testing.assert_allclose(run(along(times, 1.5 * times), p, 7)[3:], 1.5, atol=2e-3)


def test_causal_butterworth_lags_by_its_group_delay_and_no_more():
    times = np.arange(90) / 30
    out = run(along(times, times), params("butterworth", 2, lookahead=0, cutoff=4.5))
    analogue = np.sqrt(2) / (2 * np.pi * 4.5)
    assert 0.8 * analogue < times[-1] - out[-1] < 1.01 * analogue


@pytest.mark.parametrize(("method", "order"), METHODS)
def test_lookahead_has_no_phase_lag(method, order):
    times = np.arange(200) / 30
    out = run(along(times, np.sin(6 * times)), params(method, order, lookahead=0.5))[30:-30]
    basis = np.stack([np.sin(6 * times), np.cos(6 * times)], axis=1)[30:-30]
    in_phase, quadrature = np.linalg.lstsq(basis, out, rcond=None)[0]
    assert abs(np.arctan2(quadrature, in_phase) / 6) < 0.001


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
@pytest.mark.parametrize(("method", "order"), METHODS)
def test_no_start_transient(method, order, lookahead):
    frames = along(np.arange(40) / 30, np.full(40, 3.0), turned(np.full(40, 1.0)))
    out = list(filter_frames(frames, MODEL, params(method, order, lookahead=lookahead)))
    for f in out:
        np.testing.assert_allclose(f.markers[0, 0, :3], (3, 0, 0), atol=1e-12)
        np.testing.assert_allclose(f.links[0, 0, 3:7], turned(1.0), atol=1e-12)
        np.testing.assert_allclose(f.markers[0, 0, 7:10], 0, atol=1e-9)


@pytest.mark.parametrize(("method", "order"), METHODS)
def test_first_causal_output_is_the_first_input(method, order):
    values = np.random.default_rng(3).normal(size=10)
    out = run(along(np.arange(10) / 30, values), params(method, order, lookahead=0))
    assert out[0] == values[0]


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
@pytest.mark.parametrize(("method", "order"), METHODS)
def test_sign_of_a_quaternion_does_not_matter(method, order, lookahead):
    times = np.arange(60) / 30
    turns = turned(3 * times)
    flipping = turns * np.where(np.arange(60) % 2, -1, 1)[:, None]
    p = params(method, order, lookahead=lookahead)
    same = list(filter_frames(along(times, times, turns), MODEL, p))
    out = list(filter_frames(along(times, times, flipping), MODEL, p))
    for a, b in zip(same, out, strict=True):
        np.testing.assert_allclose(a.links[0, 0, 3:7], b.links[0, 0, 3:7], atol=1e-12)


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
@pytest.mark.parametrize(("method", "order"), METHODS)
def test_orientations_are_unit_quaternions(method, order, lookahead):
    turns = np.random.default_rng(4).normal(size=(60, 4))  # neither smooth nor of unit length
    frames = along(np.arange(60) / 30, np.zeros(60), turns)
    out = np.array(
        [
            f.links[0, 0, 3:7]
            for f in filter_frames(frames, MODEL, params(method, order, lookahead=lookahead))
        ]
    )
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1, atol=1e-12)


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
def test_angular_velocity_is_in_the_fixed_frame(lookahead):
    times, tilt = np.arange(60) / 30, np.array([np.sin(0.5), 0, 0, np.cos(0.5)])
    z, w = turned(2 * times)[:, 2], turned(2 * times)[:, 3]
    turns = np.stack(
        [w * tilt[0], z * tilt[0], z * tilt[3], w * tilt[3]], axis=-1
    )  # about the fixed z after a tilt about x
    out = list(filter_frames(along(times, times, turns), MODEL, params(lookahead=lookahead)))
    np.testing.assert_allclose(out[40].links[0, 0, 10:13], (0, 0, 2), atol=1e-3)
    np.testing.assert_allclose(out[40].links[0, 0, 16:19], 0, atol=1e-2)
    np.testing.assert_allclose(out[40].links[0, 0, 3:7], turns[40], atol=1e-4)


@pytest.mark.parametrize(("method", "order"), METHODS)
def test_velocity_on_sines_within_10_percent_of_the_peak(method, order):
    times = np.arange(150) / 30
    omega = 2 * np.pi * 0.8
    p = params(method, order, cutoff=6.0)
    out = run(along(times, np.sin(omega * times)), p, 7)
    error = (out - omega * np.cos(omega * times))[30:]
    assert np.sqrt(np.mean(error**2)) < 0.1 * omega


@pytest.mark.parametrize(("method", "order"), METHODS)
def test_acceleration_on_sines_within_10_percent_of_the_peak(method, order):
    times = np.arange(150) / 30
    omega = 2 * np.pi * 0.5
    p = params(method, order, cutoff=8.0)
    out = run(along(times, np.sin(omega * times)), p, 13)
    error = (out + omega**2 * np.sin(omega * times))[30:-15]
    assert np.sqrt(np.mean(error**2)) < 0.1 * omega**2


@pytest.mark.parametrize(("method", "order"), METHODS)
def test_varying_sample_times_give_the_same_trajectory(method, order):
    rng = np.random.default_rng(5)
    even = np.arange(300) / 60
    uneven = np.sort(even + rng.uniform(-0.005, 0.005, 300))
    p = params(method, order, cutoff=4.0, lookahead=1.0)
    a = run(along(even, np.sin(9 * even)), p)
    b = run(along(uneven, np.sin(9 * uneven)), p)
    np.testing.assert_allclose(np.interp(even, uneven, b)[20:-20], a[20:-20], atol=0.01)


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
@pytest.mark.parametrize(("method", "order"), METHODS)
def test_stable_at_any_mixture_of_sample_times(method, order, lookahead):
    rng = np.random.default_rng(6)
    times = np.cumsum(10 ** rng.uniform(-3, 0, 200))
    out = run(
        along(times, np.where(rng.random(200) < 0.5, -1.0, 1.0)),
        params(method, order, lookahead=lookahead, max_gap=1.5, cutoff=3.0),
    )
    assert np.abs(out).max() < 20


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
@pytest.mark.parametrize(("method", "order"), METHODS)
def test_marker_that_is_away_for_5_frames_comes_back_in_place(method, order, lookahead):
    times = np.arange(60) / 30
    frames = along(times, 0.5 * times, turned(times))
    for f in frames[30:35]:
        f.markers[0, 0] = f.links[0, 0] = np.nan
    p = params(method, order, lookahead=lookahead, bridge=0.0, cutoff=6.0)
    out = list(filter_frames(frames, MODEL, p))
    x = np.array([f.markers[0, 0, 0] for f in out])
    assert np.isnan(x[30:35]).all() and np.isnan(out[32].links[0, 0]).all()
    there = [f for k, f in enumerate(out) if not 30 <= k < 35]
    assert not any(np.isnan(f.links[0, 0, 3:7]).any() for f in there)
    np.testing.assert_allclose(x[35:], 0.5 * times[35:], atol=0.5 * 0.3)
    assert np.abs(np.diff(x[35:]) - 0.5 / 30).max() < 0.02


@pytest.mark.parametrize("method", ["state_space", "butterworth"])
def test_short_gap_is_bridged_and_a_long_one_is_not(method):
    times = np.arange(90) / 30
    frames = along(times, np.sin(2 * times))
    for f in frames[20:24] + frames[50:60]:
        f.markers[0, 0] = f.marker_confidences[0, 0] = np.nan
    for f in frames[:20]:
        f.marker_confidences[0, 0] = 0.8
    out = list(filter_frames(frames, MODEL, params(method, cutoff=6.0, bridge=0.2)))
    x = np.array([f.markers[0, 0, 0] for f in out])
    np.testing.assert_allclose(x[20:24], np.sin(2 * times[20:24]), atol=0.02)
    assert out[21].marker_confidences[0, 0] == 0.4
    assert np.isnan(x[50:60]).all() and not np.isnan(x[60:]).any()


def test_causal_filter_bridges_with_what_it_knows():
    times = np.arange(40) / 30
    frames = along(times, 2 * times)
    for f in frames[30:]:
        f.markers[0, 0] = np.nan
    x = run(frames, params(lookahead=0, bridge=0.21))
    np.testing.assert_allclose(x[30:35], 2 * times[30:35], atol=1e-3)
    assert np.isnan(x[36:]).all()


def test_what_an_earlier_stage_has_smoothed_stays_with_its_gaps():
    """It left the marker out because it no longer knows where that is."""
    frames = along(np.arange(40) / 30, 2 * np.arange(40) / 30)
    for f in frames[30:32]:
        f.markers[0, 0] = np.nan
    out = list(filter_frames(frames, MODEL, params(lookahead=0, bridge=0.2), keep_positions=True))
    for before, after in zip(frames, out, strict=True):
        np.testing.assert_array_equal(after.positions, before.positions)
        np.testing.assert_array_equal(np.isnan(after.velocities), np.isnan(after.positions))


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
@pytest.mark.parametrize(("method", "order"), METHODS)
def test_person_starts_anew_after_a_long_gap(method, order, lookahead):
    times = np.concatenate([np.arange(30) / 30, 20 + np.arange(30) / 30])
    values = np.where(times < 10, times, 50.0)
    p = params(method, order, lookahead=lookahead)
    out = run(along(times, values), p)
    np.testing.assert_array_equal(out[:30], run(along(times[:30], values[:30]), p))
    np.testing.assert_allclose(out[30:], 50.0, atol=1e-9)


def test_nothing_waits_over_a_gap():
    times = [0.0, 0.1, 0.2, 20.0]
    out = list(filter_frames(along(times, np.zeros(4)), MODEL, params()))
    assert [(f.log_time - START) // 10**8 for f in out] == [2, 2, 2, 200]


def test_untracked_people_pass_unchanged():
    rng = np.random.default_rng(7)
    frames = [frame_at(k / 30, rng.normal(size=3), ids=(-1, 3)) for k in range(20)]
    for before, after in zip(frames, filter_frames(frames, MODEL, params()), strict=True):
        np.testing.assert_array_equal(before.markers[0], after.markers[0])
        assert not np.array_equal(before.markers[1], after.markers[1])


def test_people_are_independent_and_may_come_and_go():
    rng = np.random.default_rng(8)
    both = [frame_at(k / 30, rng.normal(size=3), ids=(1, 2)) for k in range(60)]
    mixed = [f.select([1, 0]) if k % 2 else f for k, f in enumerate(both)]
    mixed = [f.select(f.ids == 1) if 20 <= k < 30 else f for k, f in enumerate(mixed)]
    alone = list(filter_frames([f.select([0]) for f in both], MODEL, params()))
    out = list(filter_frames(mixed, MODEL, params()))
    assert [list(f.ids) for f in out] == [list(f.ids) for f in mixed]
    for a, b in zip(alone, out, strict=True):
        np.testing.assert_array_equal(a.markers[0], b.markers[b.ids == 1][0])


def test_second_row_of_one_id_passes_unchanged_and_is_counted():
    events = Events()
    frames = [frame_at(k / 30, (k % 2, 0, 0), ids=(4, 4)) for k in range(9)]
    out = list(filter_frames(frames, MODEL, params(), events))
    assert all(f.markers[1, 0, 0] == k % 2 for k, f in enumerate(out))
    assert events.total("filter: time not increasing") == 9


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
def test_it_does_not_matter_how_frames_are_cut_even_if_an_id_comes_often(lookahead):
    frames, p = [], FilterParams(lookahead=lookahead)
    for k in range(64):
        frame = frame_at(k / 30, (math.sin(k), 0, 0), ids=(4, 4, 4, 4))
        frame.stamps[:] = frame.stamp + np.arange(4) * 8_000_000
        frames.append(frame)
    block = join([Block.of(frame) for frame in frames])
    found = frames_of(filter_blocks([block], MODEL, p))
    for one, other in zip(streamed(frames, MODEL, p), found, strict=True):
        np.testing.assert_array_equal(one.markers, other.markers)


def test_persons_own_time_counts():
    times = np.arange(60) / 30
    late = np.random.default_rng(9).uniform(0, 0.02, 60)
    frames = along(times, times + late)
    for f, delay in zip(frames, late, strict=True):
        f.stamps[0] = f.stamp + round(delay * 1e9)
    out = run(frames, params(lookahead=0))
    np.testing.assert_allclose(out, times + late, atol=2e-5)


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
def test_swinging_limb_keeps_its_length(lookahead):
    times = np.arange(120) / 30
    hands = 0.3 * np.stack([np.cos(12 * times), np.sin(12 * times), 0 * times], axis=1)
    frames = [frame_at(t, (0, 0, 0), hand) for t, hand in zip(times, hands, strict=True)]

    def lengths(**others):
        out = filter_frames(frames, MODEL, FilterParams(lookahead=lookahead, **others))
        return [np.linalg.norm(f.markers[0, 1, :3] - f.markers[0, 0, :3]) for f in out]

    assert abs(lengths(keep_lengths=False)[60] - 0.3) > 0.001
    np.testing.assert_allclose(lengths(), 0.3, rtol=0.0025)


def test_lengths_are_restored_on_a_graph_with_a_loop_and_missing_ends():
    links = np.array([[0, 1], [1, 2], [2, 0], [-1, 2], [2, 3]], np.int32)
    lengths = np.array([[1.0, 1]] * 5)
    markers = np.full((1, 4, 19), np.nan)
    markers[0, :3, :3] = [(0, 0, 0), (1.2, 0, 0), (0.5, 0.7, 0)]
    middle = markers[0, :3, :3].mean(axis=0)
    project(markers[0], links, lengths, np.zeros(0), 100, 1e-9)
    sides = markers[0, [1, 2, 0], :3] - markers[0, :3, :3]
    np.testing.assert_allclose(np.linalg.norm(sides, axis=1), 1, atol=1e-8)
    np.testing.assert_allclose(markers[0, :3, :3].mean(axis=0), middle, atol=1e-12)
    assert np.isnan(markers[0, 3]).all()


def test_marker_orientation_and_link_position_are_filtered_too():
    times = np.arange(60) / 30
    frames = along(times, times)
    for f, q, x in zip(frames, turned(times), times, strict=True):
        f.markers[0, 0, 3:7], f.links[0, 0, :3] = q, (x, 0, 1)
    out = list(filter_frames(frames, MODEL, params()))
    np.testing.assert_allclose(out[30].markers[0, 0, 10:13], (0, 0, 1), atol=1e-3)
    np.testing.assert_allclose(out[30].links[0, 0, 7:10], (1, 0, 0), atol=1e-3)


def test_cutoff_is_lowered_where_the_rate_is_too_low_for_it():
    events = Events()
    frames = along(np.arange(40) / 5, np.sin(np.arange(40)))
    out = list(filter_frames(frames, MODEL, params(cutoff=6.0), events))
    assert events.total("filter: cut-off lowered") > 0
    assert np.isfinite([f.markers[0, 0, 0] for f in out]).all()


@pytest.mark.parametrize("order", [1, 4])
def test_state_space_is_of_order_2_or_3(order):
    with pytest.raises(ValidationError, match="2 or 3"):
        FilterParams(method="state_space", order=order)


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
@pytest.mark.parametrize(("method", "order"), METHODS)
@pytest.mark.parametrize(("away", "restarts"), [(0.8, False), (1.2, True)])
def test_marker_goes_on_after_a_gap_shorter_than_max_gap(method, order, lookahead, away, restarts):
    times = np.arange(90) / 30
    frames = along(times, times)
    for f in frames:
        if 1.0 < (f.stamp - START) * 1e-9 < 1.0 + away:
            f.markers[0, 0] = np.nan
    p = params(method, order, lookahead=lookahead, bridge=0.0)
    back = int(30 * (1.0 + away) + 0.999)
    velocity = [f.markers[0, 0, 7] for f in filter_frames(frames[: back + 1], MODEL, p)]
    assert np.isnan(velocity[back - 1])
    assert velocity[back] == pytest.approx(0.0 if restarts else 1.0, abs=0.35)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 8])
def test_butterworth_does_not_ring_after_a_long_interval(order):
    times = np.concatenate([np.arange(30) / 30, 1.8 + np.arange(30) / 30])
    out = run(
        along(times, np.where(times > 1.5, 1.0, 0.0)), params("butterworth", order, lookahead=0)
    )
    assert np.abs(out[30:] - 1.0).max() < 0.25


@pytest.mark.parametrize("method", ["state_space", "butterworth"])
def test_confidence_of_what_is_filled_in_is_half_of_the_last_and_others_keep_theirs(method):
    frames = along(np.arange(30) / 30, np.zeros(30))
    for f in frames:
        f.marker_confidences[0] = 0.6, 0.9
    frames[10].markers[0, 0], frames[10].marker_confidences[0, 0] = np.nan, np.nan
    out = list(filter_frames(frames, MODEL, params(method)))
    assert out[10].marker_confidences[0].tolist() == [0.3, 0.9]
    assert out[11].marker_confidences[0].tolist() == [0.6, 0.9]


@pytest.mark.parametrize("bridge", [0.1, 0.2])
@pytest.mark.parametrize(("method", "order"), METHODS)
def test_gap_is_filled_in_if_and_only_if_it_is_no_longer_than_bridge(method, order, bridge):
    """A gap of k frames at 30 Hz lasts (k + 1) / 30 s."""
    for k in range(1, 8):
        frames = along(np.arange(60) / 30, np.zeros(60))
        for f in frames[20 : 20 + k]:
            f.markers[0, 0] = np.nan
        x = run(frames, params(method, order, bridge=bridge + 1e-6))
        assert np.isnan(x).sum() == (0 if (k + 1) / 30 <= bridge + 1e-6 else k)


@pytest.mark.parametrize(("method", "order"), METHODS)
def test_gap_on_a_straight_line_is_filled_in_on_it(method, order):
    times = np.arange(90) / 30
    frames = along(times, times, turned(times))
    for f in frames[50:54]:
        f.markers[0, 0] = f.links[0, 0] = np.nan
    out = list(filter_frames(frames, MODEL, params(method, order)))[50:54]
    np.testing.assert_allclose([f.markers[0, 0, 0] for f in out], times[50:54], atol=0.02)
    angles = [2 * np.arcsin(f.links[0, 0, 5]) for f in out]
    np.testing.assert_allclose(angles, times[50:54], atol=0.02)
    np.testing.assert_allclose([f.markers[0, 0, 7] for f in out], 1.0, atol=0.1)


def test_lengths_follow_the_input_with_their_time_constant():
    """A limb of .3 m that is .4 m from 5 s on: 1 - 1/e of the change after length_time, 2 s."""
    frames = [frame_at(k / 30, hand=(0.3 if k < 150 else 0.4, 0, 0)) for k in range(240)]
    out = list(filter_frames(frames, MODEL, FilterParams(lookahead=0.0)))
    lengths = [f.markers[0, 1, 0] - f.markers[0, 0, 0] for f in out]
    assert lengths[149] == pytest.approx(0.3, abs=1e-6)
    assert lengths[209] == pytest.approx(0.4 - 0.1 / math.e, abs=0.002)


def test_rings_of_many_people_hold_no_more_than_the_look_ahead_needs():
    """Four steps of 10 Hz; for few people, more are filtered in one call."""
    for people, slots in ((300, 8), (2, 16)):
        skeletons = _SkeletonFilter(MODEL, FilterParams(), Events())
        frames = [frame_at(k / 10, ids=range(people)) for k in range(40)]
        list(skeletons.update(join(list(map(Block.of, frames)))))
        assert skeletons._bank.past.ring.shape[1] == slots


def test_people_who_left_are_forgotten():
    skeletons = _SkeletonFilter(MODEL, FilterParams(), Events())
    for k in range(600):
        list(skeletons.update(Block.of(frame_at(k / 5, ids=(k // 5,)))))
    assert len(skeletons._numbers) == len(skeletons._bank.rows) <= 3
    assert len(skeletons._bank.past.ring) <= 4


@pytest.mark.parametrize(
    "change",
    [
        {"method": "butterworth"}, {"cutoff": 6.0}, {"lookahead": 0.1}, {"order": 3},
        {"bridge": 0.0}, {"max_gap": 0.2}, {"keep_lengths": False},
    ],
    ids=lambda change: next(iter(change)),
)  # fmt: skip
def test_every_parameter_changes_something(change):
    points = np.random.default_rng(12).normal(size=(60, 3))
    frames = [frame_at(k / 30, p, -p) for k, p in enumerate(points)]
    for f in frames[20:24] + frames[40:50]:
        f.markers[0, 0] = np.nan
    some, others = (
        [f.markers for f in filter_frames(frames, MODEL, p)]
        for p in (FilterParams(), FilterParams.model_validate(change))
    )
    assert not np.array_equal(some, others, equal_nan=True)


# Laws, for any method, sample times and noise.
CHOICES = st.builds(
    lambda method, lookahead: params(*method, lookahead=lookahead),
    st.sampled_from(METHODS), st.sampled_from([0.0, 0.1, 0.3]),
)  # fmt: skip
INTERVALS = st.lists(st.floats(0.01, 0.3), min_size=25, max_size=40)
COORDINATES = st.tuples(*[st.floats(-5, 5)] * 3)
ROTATIONS = st.integers(0, 2**32 - 1).map(lambda seed: Rotation.random(rng=seed))
few = settings(max_examples=25, deadline=None)


@few
@given(CHOICES, INTERVALS, COORDINATES, ROTATIONS)
def test_constant_pose_stays(p, intervals, place, rotation):
    times = np.cumsum(intervals)
    frames = [frame_at(t, place, place, rotation.as_quat()) for t in times]
    for f in filter_frames(frames, MODEL, p):
        np.testing.assert_allclose(f.markers[0, :, :3], [place, place], atol=1e-6)
        assert abs(f.links[0, 0, 3:7] @ rotation.as_quat()) > 1 - 1e-12
        np.testing.assert_allclose(f.markers[0, :, 7:10], 0, atol=1e-4)
        np.testing.assert_allclose(f.links[0, 0, 10:13], 0, atol=1e-4)


@few
@given(CHOICES, COORDINATES, st.floats(0.02, 0.05))
def test_straight_motion_has_its_velocity_and_no_acceleration(p, velocity, interval):
    frames = [frame_at(k * interval, np.multiply(velocity, k * interval)) for k in range(100)]
    middle = list(filter_frames(frames, MODEL, p))[75]
    np.testing.assert_allclose(middle.markers[0, 0, 7:10], velocity, atol=0.01)
    np.testing.assert_allclose(middle.markers[0, 0, 13:16], 0, atol=0.1)


@few
@given(CHOICES, ROTATIONS, COORDINATES, st.integers(0, 2**32 - 1))
def test_rigid_motion_moves_the_result(p, rotation, shift, seed):
    p = p.model_copy(update={"keep_lengths": True})
    rng = np.random.default_rng(seed)
    points, turns = rng.normal(size=(30, 2, 3)), Rotation.from_rotvec(rng.normal(size=(30, 3)))
    here = [frame_at(k / 30, *points[k], turns[k].as_quat()) for k in range(30)]
    moved = rotation.apply(points.reshape(-1, 3)).reshape(-1, 2, 3) + shift
    there = [frame_at(k / 30, *moved[k], (rotation * turns[k]).as_quat()) for k in range(30)]
    for a, b in zip(filter_frames(here, MODEL, p), filter_frames(there, MODEL, p), strict=True):
        expected = rotation.apply(a.markers[0, :, :3]) + shift
        np.testing.assert_allclose(b.markers[0, :, :3], expected, atol=1e-6)
        for columns in (slice(7, 10), slice(13, 16)):
            expected = rotation.apply(a.markers[0, :, columns])
            np.testing.assert_allclose(b.markers[0, :, columns], expected, atol=1e-3)
        expected = (rotation * Rotation.from_quat(a.links[0, 0, 3:7])).as_quat()
        assert abs(b.links[0, 0, 3:7] @ expected) > 1 - 1e-9
        expected = rotation.apply(a.links[0, 0, 10:13])
        np.testing.assert_allclose(b.links[0, 0, 10:13], expected, atol=1e-3)


@pytest.mark.parametrize(("lookahead", "n_averaged"), [(0.0, 1), (0.1, 4), (0.3, 10)])
def test_mean_length_counts_every_frame_until_the_end_of_the_lookahead(lookahead, n_averaged):
    """The first limb is .3 m long, all others are .4 m."""
    frames = [frame_at(k / 30, hand=(0.3 if k == 0 else 0.4, 0, 0)) for k in range(30)]
    out = list(filter_frames(frames, MODEL, FilterParams(lookahead=lookahead)))
    for k in (0, 1):
        mean = 0.4 - 0.1 / (n_averaged + k)
        assert out[k].markers[0, 1, 0] - out[k].markers[0, 0, 0] == pytest.approx(mean, abs=8e-4)


def test_lengths_start_anew_after_a_long_gap():
    times = np.concatenate([np.arange(60) / 30, 5 + np.arange(30) / 30])
    frames = [frame_at(t, hand=(0.3 if t < 4 else 0.5, 0, 0)) for t in times]
    out = list(filter_frames(frames, MODEL))
    assert out[60].markers[0, 1, 0] - out[60].markers[0, 0, 0] == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize("lookahead", LOOKAHEADS)
@pytest.mark.parametrize("order", [2, 3])
def test_constant_acceleration_is_found(order, lookahead):
    times = np.arange(120) / 30
    out = run(along(times, times**2), params(order=order, lookahead=lookahead), 13)
    np.testing.assert_allclose(out[60:100], 2.0, atol=0.02)


def test_first_interval_sets_the_sample_time():
    """A cut-off of 9 Hz is too high for 20 Hz and not for the 30 Hz that are assumed at first."""
    events = Events()
    list(filter_frames(along([0.0, 0.05], [0, 0]), MODEL, params(cutoff=9.0), events))
    assert events.total("filter: cut-off lowered") == 1
