"""Lee's Kalman filter against the equations of section 2.2.3."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stick_figures import MODEL, PERIOD, START, person, seen

from hiros_mcap.events import Events
from hiros_mcap.stages.lee.predict import PredictParams, predict

MODELS = {"constant_position": 1, "constant_velocity": 2, "constant_acceleration": 3}
"""Size of the state."""
STEP = 1_000_000_000 / 30


def stream(xs, step=STEP):
    """Person 2 at x = ``xs``, m, one frame per ``step`` ns; NaN = the joints are absent."""
    return [seen([person(x)], START + round(k * step), "world", ids=[2]) for k, x in enumerate(xs)]


def filtered(frames, **params):
    """(K,) x of the pelvis."""
    out = predict(frames, MODEL, PredictParams.model_validate(params))
    return np.array([frame.positions[0, 0, 0] for frame in out])


def by_the_book(xs, size, ratio, steps=()):
    """Predicted and corrected positions by the printed equations, with matrices and R = 1.

    ``steps`` are the steps before each of ``xs`` but the first; Q comes once per step.
    """
    move = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])[:size, :size]
    look, x, p = np.eye(1, size), np.eye(1, size)[0] * xs[0], np.eye(size)
    predicted, corrected = [xs[0]], [xs[0]]
    for z, n in zip(xs[1:], steps or [1] * (len(xs) - 1), strict=True):
        far = np.linalg.matrix_power(move, n)
        x, p = far @ x, far @ p @ far.T + n * ratio * np.eye(size)
        predicted.append(x[0])
        gain = p @ look.T / (look @ p @ look.T + 1)
        x = x + gain[:, 0] * (z - look @ x)
        p = (np.eye(size) - gain @ look) @ p
        corrected.append(x[0])
    return np.array(predicted), np.array(corrected)


def test_trace_of_five_steps():
    """Constant velocity, Q = 0.01, R = 1, by hand.

    P = I at first, so P~ = [[2.01 1] [1 1.01]] and K = (2.01, 1) / 3.01, then P~ = [[2.02 1.01]
    [1.01 0.687774]] and K = (2.02, 1.01) / 3.02, then K = (1.697741, 0.684430) / 2.697741.
    """
    xs = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    predicted = filtered(stream(xs))
    corrected = filtered(stream(xs), output="corrected")
    assert predicted[:2].tolist() == [0.0, 0.0]
    assert corrected[1] == pytest.approx(2.01 / 3.01, abs=1e-6)
    assert predicted[2] == pytest.approx((2.01 + 1.0) / 3.01, abs=1e-6)
    assert predicted == pytest.approx([0.0, 0.0, 1.0, 2.335537, 3.588937], abs=2e-6)


@pytest.mark.parametrize("model", MODELS)
def test_every_model_follows_the_printed_equations(model):
    xs = np.random.default_rng(1).normal(size=40)
    book = by_the_book(xs, MODELS[model], 0.07)
    for output, expected in zip(("predicted", "corrected"), book, strict=True):
        result = filtered(stream(xs), model=model, output=output, noise_ratio=0.07)
        assert result == pytest.approx(expected, abs=1e-6)


@settings(deadline=None, max_examples=30)
@given(
    st.sampled_from(sorted(MODELS)),
    st.lists(st.integers(1, 14), min_size=2, max_size=15),
    st.floats(1e-4, 10.0),
    st.integers(0, 2**32 - 1),
)
def test_q_accumulates_with_the_steps_that_have_passed(model, steps, ratio, seed):
    xs = np.random.default_rng(seed).normal(size=len(steps) + 1)
    times = START + np.round(np.cumsum([0, *steps]) * STEP).astype(np.int64)
    frames = [seen([person(x)], int(t), ids=[2]) for x, t in zip(xs, times, strict=True)]
    book = by_the_book(xs, MODELS[model], ratio, steps)
    for output, expected in zip(("predicted", "corrected"), book, strict=True):
        result = filtered(frames, model=model, output=output, noise_ratio=ratio)
        assert result == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("model", "gain"), [("constant_position", 0.095), ("constant_velocity", 0.37)]
)
def test_gain_of_the_papers_noises(model, gain):
    """The answer to a jump of 1 m after a long rest is the gain."""
    xs = np.zeros(200)
    xs[-1] = 1.0
    assert filtered(stream(xs), model=model, output="corrected")[-1] == pytest.approx(
        gain, abs=5e-3
    )


def test_a_constant_position_lags_by_a_third_of_a_second():
    xs = np.arange(300) / 30  # 1 m/s
    lag = {m: (xs - filtered(stream(xs), model=m, output="corrected"))[-1] for m in MODELS}
    assert lag["constant_position"] == pytest.approx(0.32, abs=0.02)
    assert lag["constant_velocity"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("rate", [15, 60])
def test_other_rates_are_as_smooth_in_seconds(rate):
    """A step seen at another rate is followed as fast, in seconds, as at 30 Hz."""

    def rise(rate):
        times = np.arange(12 * rate) / rate
        smooth = filtered(stream((times >= 10.0) * 1.0, 1e9 / rate), output="corrected")
        return float(np.interp(0.5, smooth[times >= 9.9], times[times >= 9.9]))

    assert rise(rate) - 10.0 == pytest.approx(rise(30) - 10.0, abs=0.05)


def test_velocities_and_accelerations_are_per_second():
    times = np.arange(200) / 30
    frames = stream(0.5 * 2.0 * times**2)
    out = list(predict(frames, MODEL, PredictParams(model="constant_acceleration")))[-1]
    assert out.accelerations[0, 0, 0] == pytest.approx(2.0, rel=1e-3)
    assert out.velocities[0, 0, 0] == pytest.approx(2.0 * times[-1], rel=1e-3)


def test_absent_joints_stay_absent_and_go_on():
    xs = np.arange(40) / 30
    xs[30:33] = np.nan
    result = filtered(stream(xs))
    assert np.isnan(result[30:33]).all()
    assert result[33:] == pytest.approx(np.arange(33, 40) / 30, abs=0.02)


@pytest.mark.parametrize(("gap", "anew"), [(14, False), (16, True), (90, True)])
def test_a_joint_that_is_unseen_for_half_a_second_starts_anew(gap, anew):
    """It stands where it is measured; the person's other joints go on."""
    xs = np.append(np.arange(60) / 30, np.full(gap, 2.0))
    frames = stream(xs)
    for frame in frames[60 : 59 + gap]:
        frame.markers[0, 0] = np.nan
    (*_, last) = predict(frames, MODEL)
    assert bool((last.markers[0, 0, 7:10] == 0.0).all()) is anew
    assert bool(last.positions[0, 0, 0] == 2.0) is anew
    assert (last.velocities[0, 1, 0] != 0.0) and last.positions[0, 1, 0] != 2.0


@pytest.mark.parametrize(("gap", "anew"), [(0.49, False), (0.51, True)])
def test_after_half_a_second_a_person_starts_anew(gap, anew):
    frames = stream(np.arange(60) / 30)
    late = seen([person(7.0)], frames[-1].stamp + round(gap * 1e9), "world", ids=[2])
    assert bool(filtered([*frames, late])[-1] == 7.0) is anew


def test_a_person_has_a_time_of_their_own():
    """Where the message gives none, its own counts."""
    xs = np.random.default_rng(4).normal(size=20)
    frames = stream(xs)
    for frame in frames:
        frame.stamps[:] = 0
    assert filtered(frames).tolist() == filtered(stream(xs)).tolist()
    shifted = [f.replace(stamps=f.stamps.copy()) for f in stream(xs)]
    shifted[10].stamps[:] -= 10_000_000
    assert filtered(shifted)[11] != filtered(stream(xs))[11]


@pytest.mark.parametrize(
    "change", [{"noise_ratio": 0.1}, {"model": "constant_position"}, {"output": "corrected"}]
)
def test_every_parameter_changes_something(change):
    xs = np.random.default_rng(3).normal(size=20)
    assert filtered(stream(xs), **change).tolist() != filtered(stream(xs)).tolist()
    assert len(PredictParams.model_fields) == 3


def test_a_frame_of_the_same_time_passes_unchanged():
    frames = stream(np.arange(5.0))
    events = Events()
    again = frames[-1].replace(markers=frames[-1].markers + 1.0)
    out = list(predict([*frames, again], MODEL, events=events))
    assert np.array_equal(out[-1].markers, again.markers, equal_nan=True)
    assert events.total("predict: time not increasing") == 1


def test_people_do_not_mix_and_strangers_pass():
    frames = []
    for k in range(20):
        poses = [person(0.05 * k), person(-0.03 * k, 1.0), person(5.0)]
        frames.append(seen(poses, START + k * PERIOD, "world", ids=[4, 7, -1]))
    both = list(predict(frames, MODEL))
    for row, number in enumerate((4, 7)):
        alone = predict([frame.select(frame.ids == number) for frame in frames], MODEL)
        for one, two in zip(alone, both, strict=True):
            assert np.array_equal(one.markers[0], two.markers[row], equal_nan=True)
    assert np.array_equal(both[-1].markers[2], frames[-1].markers[2], equal_nan=True)
