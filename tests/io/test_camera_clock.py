"""Faults of a camera's clock, from the times of its messages; and delays that are none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hiros_mcap.io.camera_clock import (
    DRIFT,
    LATE,
    OFFSET,
    STEP,
    WRONG,
    CameraTimes,
    ClockFault,
    _explained,
    _tenth,
    clock_verdict,
    clocks_in_words,
    find_drifts,
    longest_wait,
    median,
)

START = 1_700_000_000 * 10**9


def usual(rng, sent):
    return rng.uniform(0.02, 0.04, len(sent))


def wifi(rng, sent):
    """0 to 150 ms at random."""
    return rng.uniform(0.0, 0.15, len(sent))


def bursts(rng, sent):
    """Every 5 s nothing comes for 0.4 s."""
    return np.where(sent % 5 < 0.4, 0.4 - sent % 5, 0.0) + rng.uniform(0.005, 0.02, len(sent))


def camera(
    seed, *, rate=30.0, seconds=20.0, begin=0.0, delay=usual, clock=np.zeros_like
):  # fmt: skip
    """A camera that loses some messages; ``clock`` is the error of its clock at true times, s."""
    rng = np.random.default_rng(seed)
    sent = begin + (np.arange(int((seconds - begin) * rate)) + rng.random()) / rate
    sent = (sent + rng.normal(0, 0.001, len(sent)))[rng.random(len(sent)) > 0.02]
    logged = np.maximum.accumulate(sent + delay(rng, sent))
    stamps = np.round((sent + clock(sent)) * 1e9).astype(np.int64)
    return CameraTimes(START + stamps, START + np.round(logged * 1e9).astype(np.int64))


def unordered(times, late_from, late_by):
    """The same, but 3 s of messages come later than those after them."""
    sent = (times.stamps - START) * 1e-9
    is_late = (sent > late_from) & (sent < late_from + 3)
    logged = times.log_times + np.where(is_late, round(late_by * 1e9), 0)
    order = np.argsort(logged, kind="stable")
    return CameraTimes(times.stamps[order], logged[order])


def three(**faulty):
    return {"a": camera(1), "b": camera(2, **faulty), "c": camera(3)}  # type: ignore[arg-type]


def only(verdicts):
    (fault,) = verdicts.faults
    return fault


def worst(cameras, verdicts, right):
    """Largest error of a corrected stamp of camera b, s."""
    stamps = verdicts.corrections["b"].apply(cameras["b"].stamps, cameras["b"].log_times)
    return float(np.abs(stamps - right.stamps).max() * 1e-9)


@pytest.mark.parametrize("seconds", [-5, -2, -0.5, -0.1, 0.1, 0.5, 1, 2, 10, 30, 86400])
def test_a_step_is_found_at_its_message_and_corrected(seconds):
    cameras = three(clock=lambda t: np.where(t > 10, seconds, 0.0))
    verdicts = clock_verdict(cameras)
    fault = only(verdicts)
    assert (fault.camera, fault.kind) == ("b", STEP)
    assert fault.seconds == pytest.approx(seconds, abs=0.005)
    assert fault.at_ns == pytest.approx(START + 10**10, abs=10**8)
    assert worst(cameras, verdicts, camera(2)) < 0.005
    assert not verdicts.corrections["a"].changes(cameras["a"])


def uneven(rng, sent):
    """Usual delays of 20 to 60 ms: next to a step of 40 ms they are mixed."""
    return rng.uniform(0.02, 0.06, len(sent))


@pytest.mark.parametrize("ms", [-40, 40])
@pytest.mark.parametrize("rate", [15.0, 30.0, 60.0])
def test_a_small_step_is_found_among_uneven_deliveries(rate, ms):
    found = []
    for seed in range(8):
        a, c = (camera(100 + 3 * seed + k, rate=rate, delay=uneven) for k in (0, 2))
        clock = lambda t: np.where(t > 10, ms / 1000, 0.0)  # noqa: E731
        b = camera(101 + 3 * seed, rate=rate, delay=uneven, clock=clock)
        found += [f for f in clock_verdict({"a": a, "b": b, "c": c}).faults if f.camera == "b"]
    assert len(found) >= 6
    assert {fault.kind for fault in found} == {STEP}
    assert np.abs([1000 * fault.seconds - ms for fault in found]).max() < 15


def test_two_steps_are_both_corrected():
    cameras = three(clock=lambda t: np.where(t > 6, 2.0, 0.0) - np.where(t > 12, 1.0, 0.0))
    verdicts = clock_verdict(cameras)
    assert [round(fault.seconds, 1) for fault in verdicts.faults] == [2.0, -1.0]
    assert worst(cameras, verdicts, camera(2)) < 0.005


@pytest.mark.parametrize("ahead", [-3.0, 3.0])
@pytest.mark.parametrize("recorder", [-60.0, 0.0, 60.0])
def test_the_part_that_agrees_with_the_other_cameras_keeps_its_stamps(ahead, recorder):
    """Whatever the recorder's clock says, s."""
    cameras = {
        name: CameraTimes(times.stamps, times.log_times + round(recorder * 1e9))
        for name, times in three(clock=lambda t: np.where(t < 10, ahead, 0.0)).items()
    }
    assert worst(cameras, clock_verdict(cameras), camera(2)) < 0.005


@pytest.mark.parametrize("rate", [-5e-3, -1e-3, 1e-3, 5e-3])
def test_a_drift_is_followed(rate):
    cameras = three(clock=lambda t: rate * t)
    verdicts = clock_verdict(cameras)
    fault = only(verdicts)
    assert (fault.camera, fault.kind) == ("b", DRIFT)
    assert fault.seconds == pytest.approx(rate, rel=0.1)
    assert worst(cameras, verdicts, camera(2)) < 0.004


def late_by_chance(seed, seconds=9.0, rate=10.0):
    """Return the times of four cameras whose messages come 80 ms late, a tenth later still."""
    rng, cameras = np.random.default_rng(seed), {}
    for name in "abcd":
        sent = np.arange(0.0, seconds, 1.0 / rate) + rng.uniform(0.0, 1.0 / rate)
        lags = rng.uniform(0.03, 0.13, len(sent))
        lags += (rng.random(len(sent)) < 0.1) * rng.uniform(0.0, 0.35, len(sent))
        times = np.round(1e9 * np.stack([sent, sent + lags])).astype(np.int64)
        cameras[name] = CameraTimes(*times[:, np.argsort(times[1])])
    return cameras


def test_a_few_seconds_of_late_messages_are_no_drift():
    drifts = [find_drifts(late_by_chance(seed)) for seed in range(200)]
    assert not any(drifts)


@pytest.mark.parametrize(("begin", "end"), [(0.0, 28.0), (12.0, 40.0)])
def test_what_changes_in_a_part_of_the_log_only_is_no_drift(begin, end):
    """The line through all of the log fits one of its halves, but not the other."""
    cameras = {name: camera(k, seconds=40.0) for k, name in enumerate("ac")}
    cameras["b"] = camera(2, seconds=40.0, clock=lambda t: 5e-3 * (np.clip(t, begin, end) - begin))
    assert clock_verdict(cameras).faults == ()


@pytest.mark.parametrize("seconds", [-7200.0, 20.0])
def test_clocks_that_no_delivery_explains_are_aligned(seconds):
    cameras = three(clock=lambda t: np.full_like(t, seconds))
    verdicts = clock_verdict(cameras)
    assert (only(verdicts).kind, only(verdicts).camera) == (OFFSET, "b")
    assert worst(cameras, verdicts, camera(2)) < 0.01


@pytest.mark.parametrize("seconds", [-1.5, 0.1])
def test_other_constant_offsets_are_told_and_not_corrected(seconds):
    cameras = three(clock=lambda t: np.full_like(t, seconds))
    assert clock_verdict(cameras).faults == ()
    (text,) = clocks_in_words(cameras, START)
    assert text.startswith("b: messages come ")
    assert ("1.50 s later" if seconds < 0 else " ms sooner") in text


def held(rng, sent):
    """Nothing comes for 3 s, then everything at once."""
    return np.where((sent > 8) & (sent < 11), 11.0 - sent, 0.0) + usual(rng, sent)


LATE_ONES = {
    "1 s": unordered(camera(2), 8, 1.0),
    "3 s": unordered(camera(2), 8, 3.0),
    "all at once": camera(2, delay=held),
}


@pytest.mark.parametrize("name", LATE_ONES)
def test_a_late_delivery_is_no_fault_of_the_clock(name):
    cameras = {**three(), "b": LATE_ONES[name]}
    verdicts = clock_verdict(cameras)
    assert (only(verdicts).kind, only(verdicts).camera) == (LATE, "b")
    assert not any(verdicts.corrections[name].changes(cameras[name]) for name in cameras)
    assert longest_wait(cameras.values()) == pytest.approx(only(verdicts).seconds, abs=0.1)


def test_single_wrong_times_are_replaced():
    cameras = three()
    cameras["b"].stamps[100] += 10**17
    verdicts = clock_verdict(cameras)
    assert (only(verdicts).kind, only(verdicts).messages) == (WRONG, 1)
    assert worst(cameras, verdicts, camera(2)) < 0.04


@pytest.mark.parametrize("seconds", [-30.0, -1.0, 1.0, 30.0])
@pytest.mark.parametrize("delay", [usual, wifi])
@pytest.mark.parametrize("first", [0, 5, 9])  # the log may begin or end with such a stamp
def test_every_tenth_stamp_may_be_wrong(first, delay, seconds):
    cameras, right = three(delay=delay), camera(2, delay=delay)
    cameras["b"].stamps[first::10] += round(seconds * 1e9)
    verdicts = clock_verdict(cameras)
    fault = only(verdicts)
    assert (fault.kind, fault.messages) == (WRONG, len(right.stamps[first::10]))
    assert fault.seconds == pytest.approx(seconds, abs=0.2)
    assert worst(cameras, verdicts, right) < 0.16
    corrected = [times.corrected(verdicts.corrections[name]) for name, times in cameras.items()]
    assert longest_wait(corrected) < 0.2


def test_a_long_log_of_which_two_of_five_stamps_are_wrong_is_read_and_the_camera_named():
    cameras = three(seconds=200)
    rng, stamps = np.random.default_rng(0), cameras["b"].stamps
    wrong = np.flatnonzero(rng.random(len(stamps)) < 0.4)
    stamps[wrong] -= rng.integers(5 * 10**9, 8 * 10**9, len(wrong))
    assert only(clock_verdict(cameras)).camera == "b"


def test_what_the_recorder_does_to_all_cameras_is_no_fault():
    cameras = three()
    for times in cameras.values():
        times.log_times[times.log_times > START + 10**10] += 2 * 10**9
    assert clock_verdict(cameras).faults == ()


HEALTHY: dict[str, list[CameraTimes]] = {
    "usual": [camera(k) for k in range(3)],
    "random delays": [camera(k, delay=wifi) for k in range(3)],
    "bursts": [camera(k, delay=bursts) for k in range(2)] + [camera(9)],
    "slow and fast cameras": [camera(1, rate=5), camera(2, rate=60), camera(3)],
    "joins late": [camera(1), camera(2, begin=12), camera(3)],
    "stamps are log times": [camera(k, delay=lambda rng, t: np.zeros_like(t)) for k in range(3)],
    "replayed later": [
        camera(k, delay=lambda rng, t: usual(rng, t) + 7200) for k in range(3)
    ],
    "one camera": [camera(1, delay=bursts)],
    "one message": [camera(1), camera(2, seconds=0.05), camera(3)],
}  # fmt: skip


@pytest.mark.parametrize("name", HEALTHY)
def test_healthy_clocks_are_left_alone(name):
    cameras = {f"camera {k}": times for k, times in enumerate(HEALTHY[name])}
    verdicts = clock_verdict(cameras)
    assert verdicts.faults == ()
    assert not any(verdicts.corrections[c].changes(cameras[c]) for c in cameras)


def test_a_camera_may_pause():
    cameras = three()
    kept = (cameras["b"].stamps < START + 5 * 10**9) | (cameras["b"].stamps > START + 9 * 10**9)
    cameras["b"] = CameraTimes(cameras["b"].stamps[kept], cameras["b"].log_times[kept])
    assert clock_verdict(cameras).faults == ()


def test_a_slow_delivery_that_ends_with_a_loss_is_no_step():
    times = camera(2)
    sent = (times.stamps - START) * 1e-9
    times.log_times[(sent > 8) & (sent < 10.7)] += 300_000_000
    kept = (sent < 10.7) | (sent > 11)
    cameras = {**three(), "b": CameraTimes(times.stamps[kept], times.log_times[kept])}
    assert clock_verdict(cameras).faults == ()


def test_nothing_is_known_of_nobody():
    assert clock_verdict({}).faults == ()
    assert longest_wait([]) == 0.0
    empty = CameraTimes(np.empty(0, np.int64), np.empty(0, np.int64))
    assert clock_verdict({"a": empty}).faults == ()


def test_what_the_user_gives_is_added_and_not_judged():
    cameras = three(clock=lambda t: np.full_like(t, 1.5))
    verdicts = clock_verdict(cameras, {"b": -1.5})
    assert verdicts.faults == ()
    assert worst(cameras, verdicts, camera(2)) < 1e-6


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([usual, wifi, bursts]), st.sampled_from([5, 15, 60]))
def test_no_delay_makes_a_clock_wrong(seed, delay, rate):
    cameras = {n: camera(seed + k, delay=delay, rate=rate) for k, n in enumerate("abc")}
    assert [fault for fault in clock_verdict(cameras).faults if fault.kind != LATE] == []


def test_a_fault_has_a_sign_and_a_unit():
    def size(kind, seconds):
        return ClockFault("a", kind, seconds, 0, corrected=True).size

    assert (size(STEP, 2.0), size(STEP, -0.105)) == ("+2.00 s", "-105 ms")
    assert (size(DRIFT, 0.0012), size(OFFSET, -7200)) == ("+1.2 ms per s", "-2.0 hours")


@pytest.mark.parametrize("seed", [2, 5, 7])
def test_the_stamps_of_a_regular_camera_tell_a_step_more_exactly_than_its_delays(seed):
    """Over a radio, which delays messages by up to 150 ms."""
    times = camera(seed, rate=5, seconds=60.0, delay=wifi, clock=lambda t: 0.5 * (t > 30.0))
    fault = only(clock_verdict({"a": camera(1, seconds=60.0), "b": times}))
    assert (fault.kind, fault.seconds) == (STEP, pytest.approx(0.5, abs=0.005))


@pytest.mark.parametrize("sent", [1, 2, 3, 5])
@pytest.mark.parametrize("seconds", [0.5, -0.5, 3.0])
def test_a_step_is_told_as_exactly_where_messages_are_lost_at_it(sent, seconds):
    usual = (0.2, 0.001, 0.02)  # period, its noise and the error of the lags, s
    assert _explained(sent * 0.2 + seconds, seconds + 0.02, usual) == pytest.approx(seconds)


@pytest.mark.parametrize("late", [0.63, 0.8, 2.0])
@pytest.mark.parametrize("n", [1, 2])
def test_a_late_message_with_a_right_stamp_is_not_called_wrong(late, n):
    """Where it is logged, the camera has lost another message: that gap is not its own."""
    times = camera(2)
    period = 1 / 30
    sent = (times.stamps - START) * 1e-9
    k = int(np.searchsorted(sent, 8.0))
    lost = (sent > sent[k] + late - 1.6 * period) & (sent < sent[k] + late + 1.6 * period)
    logged = times.log_times.copy()
    logged[k : k + n] += round(late * 1e9)
    kept = ~lost
    order = np.argsort(logged[kept], kind="stable")
    b = CameraTimes(times.stamps[kept][order], logged[kept][order])
    cameras = {"a": camera(1), "b": b, "c": camera(3)}
    verdict = clock_verdict(cameras)
    assert not [fault for fault in verdict.faults if fault.kind == WRONG]
    assert (verdict.corrections["b"].apply(b.stamps, b.log_times) == b.stamps).all()


def radio(seed, late=(), held=0.0):
    """A camera whose messages overtake each other; some are late, or all are held for a while."""
    rng = np.random.default_rng(seed)
    sent = np.arange(600)[rng.random(600) > 0.1] / 30.0
    logged = sent + 0.05 + rng.exponential(0.05, len(sent))
    logged[rng.choice(len(sent), len(late), replace=False)] += late
    logged += np.where((sent > 8) & (sent < 8 + held), 8 + held - sent, 0.0)
    times = np.round(1e9 * np.stack([sent, logged])[:, np.argsort(logged)]).astype(np.int64)
    return CameraTimes(*(START + times))


@pytest.mark.parametrize("late", [[0.63], [0.55, 0.8, 1.2, 2.0], [5.0] * 20])
def test_late_messages_keep_their_stamps_where_messages_overtake_each_other(late):
    for seed in range(20):
        cameras = {"a": camera(1), "b": radio(seed, late), "c": camera(3)}
        verdict = clock_verdict(cameras)
        assert not [fault for fault in verdict.faults if fault.kind != LATE]
        assert not verdict.corrections["b"].changes(cameras["b"])


def test_stamps_that_are_wrong_by_one_time_are_found_though_they_lie_in_each_others_gaps():
    rng, found = np.random.default_rng(4), 0
    for seed in range(10):
        times = camera(seed)
        times.stamps[rng.choice(np.arange(40, 560), 20, replace=False)] -= 10**9
        found += sum(f.messages for f in clock_verdict({"a": camera(1), "b": times}).faults)
    assert found > 195


def test_late_messages_at_the_end_of_a_log_are_no_step_back():
    """The first eight come when all others have come."""
    times = camera(2, seconds=5.0)
    logged = np.append(times.log_times[8:], times.log_times[:8] + 10**10)
    b = CameraTimes(np.roll(times.stamps, -8), logged)
    cameras = {"a": camera(1), "b": b, "c": camera(3)}
    assert not clock_verdict(cameras).corrections["b"].changes(b)


def test_a_camera_whose_messages_are_held_makes_no_steps_of_the_others():
    for seed in range(10):
        cameras = {name: radio(3 * seed + k) for k, name in enumerate("ac")}
        cameras["b"] = radio(3 * seed + 2, held=4.0)
        assert not [fault for fault in clock_verdict(cameras).faults if fault.camera != "b"]


@pytest.mark.parametrize("n", [1, 2, 3, 10, 11, 600, 601])
def test_the_middle_and_the_least_tenth_of_some_lags_are_those_of_numpy(n):
    for lags in (rng := np.random.default_rng(n)).normal(size=(20, n)):
        assert median(lags) == np.median(lags)
        assert _tenth(lags) == np.quantile(lags, 0.1)
    stamps = rng.integers(0, 10**18, n)
    assert median(stamps) == np.median(stamps)
