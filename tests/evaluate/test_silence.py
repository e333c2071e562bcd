"""A result that is silent misses everybody; a result of another rate than the truth is not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stick_figures import MODEL, SECOND, START, person, seen

from hiros_mcap.evaluate import Truth, evaluate
from hiros_mcap.evaluate.match import silent_instants

STEP = SECOND // 100


def walking(k):
    """Two people at 100 Hz; frame ``k``."""
    return seen([person(0.3 * math.sin(0.05 * k)), person(3)], START + k * STEP, ids=[0, 1])


FRAMES = [walking(k) for k in range(601)]
TRUTH = Truth.of(FRAMES)


def result(rate, start=0.0, end=6.0):
    """Everybody at a rate, Hz, as exactly as they can be seen."""
    times = np.arange(start, end + 1e-9, 1 / rate)
    stamps = [START + round(t * SECOND) for t in times]
    return [
        seen(list(TRUTH.at(stamp)[0]), stamp, ids=[5, 7]) for stamp in stamps if TRUTH.covers(stamp)
    ]


def scores(frames):
    return evaluate(frames, TRUTH, MODEL)


@pytest.mark.parametrize("rate", [5, 10, 15, 29.97, 30, 100])
def test_another_rate_is_no_silence(rate):
    found = scores(result(rate))
    assert (found.silent, found.missing, found.tracking.mota) == (0, 0, 1)


def test_a_result_that_ends_at_half_time_misses_half():
    found = scores(result(30, end=3.0))
    assert found.silent == pytest.approx(90, abs=1)
    assert found.missing == 2 * found.silent
    assert found.tracking.mota == pytest.approx(0.5, abs=0.01)
    assert found.tracking.idf1 == pytest.approx(2 / 3, abs=0.01)  # precision 1, recall 1/2
    assert found.tracking.hota == pytest.approx(0.5, abs=0.01)  # sqrt(DetA AssA), both 1/2
    assert found.pck_at(100) == pytest.approx(0.5, abs=0.01)
    assert found.mean == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("frames", "seconds"),
    [
        (result(30, start=2.0), 2.0),
        (result(30, end=1.0) + result(30, start=4.0), 3.0),
        (result(30, start=0.5, end=1.5) + result(30, start=2.5, end=4), 0.5 + 1 + 2),
        (result(100, end=3.0), 3.0),
        (result(5, end=3.0), 3.0),
    ],
    ids=["late start", "gap", "start, gap and end", "100 Hz", "5 Hz"],
)
def test_silence_lasts_as_long_as_it_lasts(frames, seconds):
    found = scores(frames)
    share = found.missing / (found.missing + 2 * found.frames)
    assert share == pytest.approx(seconds / 6.0, abs=0.02)
    assert found.tracking.mota == pytest.approx(1 - share)


def test_one_lost_frame_of_thirty_a_second_counts():
    frames = result(30)
    del frames[60]
    assert (scores(frames).silent, scores(frames).missing) == (1, 2)


def test_a_result_without_any_frame_misses_everything():
    found = scores([])
    assert (found.frames, found.silent, found.missing) == (0, 601, 1202)
    assert (found.tracking.mota, found.tracking.hota, found.pck_at(200)) == (0, 0, 0)
    assert math.isnan(found.mean)


def test_frames_without_people_miss_them_too():
    empty = [f.select([]) if k >= 90 else f for k, f in enumerate(result(30))]
    assert scores(empty).missing == scores(result(30, end=2.99)).missing
    assert scores(empty).silent == 0


def test_where_the_truth_pauses_nothing_counts():
    """Motion capture that stops for 2 s: the result in between is neither false nor asked for."""
    truth = Truth.of([f for k, f in enumerate(FRAMES) if not 200 < k < 400])
    found = evaluate(result(30), truth, MODEL)
    assert (found.missing, found.false) == (0, 0)
    assert found.frames == pytest.approx(120, abs=2)
    assert evaluate(result(30, end=2.0), truth, MODEL).silent == pytest.approx(60, abs=2)


def test_a_truth_of_a_part_of_the_time_asks_for_this_part_only():
    truth = Truth.of(FRAMES[200:300])
    assert evaluate(result(30), truth, MODEL).missing == 0
    assert evaluate(result(30, end=2.5), truth, MODEL).silent == pytest.approx(14, abs=1)


def test_nobody_there_is_nobody_missed():
    truth = Truth.of([f.select([]) if k >= 300 else f for k, f in enumerate(FRAMES)])
    found = evaluate(result(30, end=3.0), truth, MODEL)
    assert (found.silent, found.missing) == (0, 0)


@settings(deadline=None, max_examples=60)
@given(
    cameras=st.integers(1, 6),
    phases=st.lists(st.floats(0, 1), min_size=6, max_size=6),
    rate=st.sampled_from([15.0, 30.0, 60.0]),
)
def test_cameras_that_take_turns_are_not_silent(cameras, phases, rate):
    """One frame per camera and period, at any phase, even all at once."""
    times = np.sort([(k + phases[c]) / rate for k in range(60) for c in range(cameras)])
    stamps = START + np.rint(times * SECOND).astype(np.int64)
    assert silent_instants(stamps, TRUTH.moved()).size == pytest.approx(
        _ends(stamps), rel=0.1, abs=3
    )


def _ends(stamps):
    """Instants before the first and after the last frame, at the mean rhythm."""
    stamps = np.unique(stamps)
    step = float(np.diff(stamps).mean())
    ends = stamps[0] - START, START + 6 * SECOND - stamps[-1]
    return sum(max(0, end) / step for end in ends if end > SECOND / 10)
