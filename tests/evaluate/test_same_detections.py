"""Systems are scored on the same detections, and a difference is stated with its interval."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.comparison import MeanDifference, Outcome, on_same_detections
from hiros_mcap.evaluate.leave_one_out import Distances
from hiros_mcap.evaluate.statistics import block_interval

SECOND = 1_000_000_000


def camera(joints, rate=10):
    """Detections at ``rate`` Hz."""
    stamps = np.arange(len(joints), dtype=np.int64) * (SECOND // rate)
    values = joints.astype(np.float32)
    return Distances(stamps, values, values / 2)


def scored(*systems):
    """Score systems on the same detections, each given by its cameras."""
    outcome = Outcome("log", "a", ("camera",), 1.0)
    return on_same_detections([(outcome, list(cameras)) for cameras in systems])


def random(mean, seed, seconds=20, joints=3):
    return mean + np.random.default_rng(seed).normal(0, 3, (10 * seconds, joints))


def test_who_has_nobody_where_it_is_hard_gains_nothing():
    """The second system is 10 mm worse where both have somebody, and silent in the hard part."""
    good = np.full((100, 4), 20.0)
    good[50:] = 300.0
    worse = good + 10
    worse[50:] = np.nan
    first, second = scored([camera(good)], [camera(worse)])
    assert (first.distance.mean, second.distance.mean) == pytest.approx((20, 30))
    assert (first.distance.median, second.distance.median) == pytest.approx((20, 30))
    assert (first.misses, second.misses) == (0, 50)
    assert first.detections == second.detections == 100
    assert second.difference is not None
    assert str(second.difference).startswith("worse by 10.0")
    assert second.difference.seconds == 5


def test_a_joint_that_one_lacks_counts_for_nobody():
    one, other = random(20, 1), random(20, 2)
    other[:, 0] = np.nan
    one[:, 0] = 900.0
    first, second = scored([camera(one)], [camera(other)])
    assert first.distance.mean == pytest.approx(20, abs=1)
    assert first.distance.count == second.distance.count == 400
    assert second.misses == 0
    assert first.spread == pytest.approx(first.distance.mean / 2, rel=1e-5)


def test_a_system_without_a_result_does_not_empty_the_table():
    nothing = np.full((200, 3), np.nan)
    first, second = scored([camera(random(20, 1))], [camera(nothing)])
    assert first.distance.mean == pytest.approx(20, abs=1)
    assert second.misses == 200
    assert np.isnan(second.distance.mean)
    assert second.difference is not None
    assert second.difference.seconds == 0
    assert not second.difference.is_sure


def test_all_cameras_count_together():
    near, far = camera(np.full((100, 2), 10.0)), camera(np.full((300, 2), 50.0))
    (only,) = scored([near, far])
    assert only.distance.mean == pytest.approx(40)
    assert only.difference is None


def test_the_interval_is_of_seconds_not_of_frames():
    """Errors that last a second: 95 % of the intervals hold the true difference, which is 0."""
    held, wide = 0, []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        lasting = rng.normal(0, 5, (20, 1)).repeat(10, axis=0)
        systems = [camera(np.full((200, 1), 30.0))], [camera(30 + lasting)]
        found = scored(*systems)[1].difference
        assert found is not None
        held += found.low <= 0 <= found.high
        wide.append(found.high - found.low)
    assert 0.91 < held / 300 < 0.985
    assert np.mean(wide) == pytest.approx(2 * 2.09 * 5 / 20**0.5, rel=0.05)


@pytest.mark.parametrize(("blocks", "quantile"), [(2, 12.706), (3, 4.303), (10, 2.262)])
def test_few_seconds_have_the_interval_of_student(blocks, quantile):
    """Quantiles of tables of the t distribution, of one degree of freedom less."""
    values = np.arange(blocks, dtype=float)
    mean, low, high, n = block_interval(values, np.arange(blocks))
    half = quantile * values.std(ddof=1) / blocks**0.5
    assert (mean, low, high) == pytest.approx(
        (values.mean(), values.mean() - half, values.mean() + half), rel=1e-3
    )
    assert n == blocks


@pytest.mark.parametrize(
    ("ends", "text"),
    [
        ((-2.6, -3.3, -1.9), "better by 2.6 (95 % 1.9 to 3.3)"),
        ((2.0, 1.0, 3.0), "worse by 2.0 (95 % 1.0 to 3.0)"),
        ((0.1, -0.2, 0.4), "no difference (-0.2 to +0.4)"),
    ],
)
def test_a_difference_in_words(ends, text):
    assert str(MeanDifference("hiros", *ends, seconds=9)) == text


def test_other_detections_cannot_be_compared():
    with pytest.raises(ConfigError, match="different detections"):
        scored([camera(random(1, 1))], [camera(random(1, 1, seconds=3))])
