"""Stamps of a live system: each message is corrected by those before it."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_mcap.frames import Block
from hiros_mcap.io.camera_clock import DRIFT, OFFSET, STEP, ClockFault
from hiros_mcap.running.clock_follower import ClockFollower
from hiros_mcap.skeletons import Frame, SkeletonModel

MODEL = SkeletonModel.of(["HIP"], [])
START = 1_700_000_000 * 10**9


def errors(clock, seconds):
    """True times, s, and errors of the corrected stamps, s, of one of three cameras at 30 Hz.

    ``clock`` is the error of its clock at a true time; messages take 20 to 30 ms.
    """
    rng = np.random.default_rng(3)
    sent = np.arange(90 * seconds) / 90
    cameras = ["a", "b", "c"] * (30 * seconds)
    blocks = []
    delays = rng.uniform(0.02, 0.03, len(sent)).tolist()
    for at, name, delay in zip(sent.tolist(), cameras, delays, strict=True):
        stamp = START + round(1e9 * (at + (clock(at) if name == "b" else 0.0)))
        frame = Frame.empty(1, MODEL, stamp=stamp, source=name)
        blocks.append(Block.of(frame.replace(log_time=START + round(1e9 * (at + delay)))))
    faults: list[ClockFault] = []
    clocks = ClockFollower({}, faults, 0.3)
    found = [int(clocks.correct(block).stamps[0]) for block in clocks.compared(blocks)]
    mine = np.array(cameras) == "b"
    return sent[mine], (np.array(found)[mine] - START) * 1e-9 - sent[mine], faults


@pytest.mark.parametrize("rate", [-4e-3, 4e-3])
def test_a_drift_that_grows_is_followed_without_a_jump(rate):
    times, wrong, faults = errors(lambda t: rate * (t + max(0.0, t - 30.0)), 80)
    assert [fault.kind for fault in faults] == [DRIFT]
    # What the clock gained before the change was known may stay, as an offset that is constant.
    assert np.ptp(wrong[times > 65.0]) < 0.005
    assert np.abs(wrong).max() < 0.15


def test_what_a_clock_did_long_ago_is_forgotten():
    times, wrong, faults = errors(lambda t: 4e-3 * max(0.0, t - 60.0), 100)
    assert [fault.kind for fault in faults] == [DRIFT]
    assert np.abs(wrong[times > 85.0]).max() < 0.01


@pytest.mark.parametrize("seconds", [-0.3, -0.04, 0.04, 30.0])
def test_a_step_is_corrected_within_two_seconds(seconds):
    times, wrong, faults = errors(lambda t: seconds if t > 10.0 else 0.0, 16)
    assert [fault.kind for fault in faults] == [STEP]
    assert faults[0].seconds == pytest.approx(seconds, abs=0.004)
    assert np.abs(wrong[times > 12.0]).max() < 0.004
    assert np.abs(wrong).max() < 0.31, "nobody is taken into the future"


def test_a_step_towards_the_other_clocks_is_no_jump_of_the_results():
    """The people prove an offset, slowly; until then stamps go on as they were."""
    times, wrong, faults = errors(lambda t: 0.0 if t > 10.0 else -0.06, 16)
    assert [fault.kind for fault in faults] == [STEP]
    assert wrong[times > 12.0] == pytest.approx(-0.06, abs=0.004)


def test_what_the_people_prove_comes_in_without_a_jump():
    """A tenth of a second in a second of the log, and no further."""
    clocks = ClockFollower({}, [], 0.3)
    blocks = [message(START + k * 33_000_000) for k in range(90)]
    moved = []
    for k, block in enumerate(clocks.compared(blocks)):
        if k == 30:
            clocks.prove("a", 0.05)
        moved.append(int(clocks.correct(block).stamps[0] - block.stamps[0]) * 1e-9)
    assert moved[:30] == [0.0] * 30
    assert np.diff(moved).max() < 0.0034
    assert moved[-1] == pytest.approx(0.05)
    assert clocks.added("a") == clocks.proved("a") == pytest.approx(0.05)


@pytest.mark.parametrize("delay", [0.0, 0.02])
def test_a_clock_whose_messages_are_logged_before_their_time_is_ahead(delay):
    faults: list[ClockFault] = []
    clocks = ClockFollower({}, faults, 0.3)
    blocks = []
    for k in range(300):
        at = START + k * 33_000_000
        blocks += [message(at, "a", delay), message(at + 60_000_000, "b", delay - 0.06)]
    stamps = [clocks.correct(block).stamps[0] for block in clocks.compared(blocks)]
    assert np.abs(np.subtract(stamps[1::2], stamps[::2])).max() < 1e6
    assert [(fault.camera, fault.kind) for fault in faults] == [("b", OFFSET)]
    assert faults[0].seconds == pytest.approx(0.06)


def test_what_is_found_of_clocks_is_noted_from_when_it_is_known():
    found: list[tuple[int, str, float]] = []
    clocks = ClockFollower({}, [], 0.3, found)
    lags = {"a": -0.04, "b": -0.01, "c": 0.06, "d": 0.11}
    blocks = []
    for k in range(100):
        at = START + k * 33_000_000
        blocks += [message(at - round(1e9 * lag), name, lag) for name, lag in lags.items()]
    for block in clocks.compared(blocks):
        clocks.correct(block)
    assert clocks.lags == pytest.approx({"a": 0.06, "b": 0.06, "c": 0.06, "d": 0.11}, abs=1e-3)
    ahead = {name: seconds for _, name, seconds in found}
    assert ahead == pytest.approx({"a": 0.10, "b": 0.07}, abs=1e-3)
    clocks.prove("d", 0.05)
    since, *proved = found[-1]
    assert proved == ["d", pytest.approx(-0.05)]
    assert since >= blocks[-1].stamps[0], "what is proved now changes nothing before"


def message(stamp, source="a", delay=0.02):
    """One message with one person."""
    frame = Frame.empty(1, MODEL, stamp=stamp, source=source)
    return Block.of(frame.replace(log_time=stamp + round(delay * 1e9)))
