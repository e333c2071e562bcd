"""Stamps of a live system: each message is corrected by those before it."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_mcap.frames import Block
from hiros_mcap.io.camera_clock import DRIFT
from hiros_mcap.running.clock_follower import ClockFollower
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.summary import ClockFault

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
    found = [int(b.stamps[0]) for b in ClockFollower({}, faults, 0.3).correct(blocks)]
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
