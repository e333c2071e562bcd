"""How long messages of a live system wait for others."""

from __future__ import annotations

import pytest

from hiros_mcap.stages.time_order import Lateness

SECOND = 1_000_000_000


def waits(late, seconds=5, limit=0.25, start=0):
    """Return the wait, s, after messages of two cameras at 30 Hz; the second one is ``late`` s."""
    lateness = Lateness(limit)
    for k in range(30 * seconds):
        now = start + k * SECOND // 30
        lateness.take(now, "a", now)
        lateness.take(now - round(late(k) * SECOND), "b", now)
    return lateness


def test_messages_wait_for_the_slowest_camera():
    assert waits(lambda k: 0.1).wait == pytest.approx(0.1 * SECOND)


def test_cameras_that_are_in_time_make_nobody_wait():
    assert waits(lambda k: 0.03).wait == 0


def test_messages_wait_as_long_as_they_may_until_it_is_known_how_late_they_are():
    assert waits(lambda k: 0.0, seconds=0).wait == 0.25 * SECOND
    assert waits(lambda k: 0.0, seconds=1).wait == 0


def test_nobody_waits_for_a_single_message_that_hangs():
    assert waits(lambda k: 0.2 if k % 50 == 0 else 0.06).wait == pytest.approx(0.06 * SECOND)


def test_a_camera_that_is_later_than_the_limit_is_named_with_what_it_needs():
    lateness = waits(lambda k: 0.4)
    assert lateness.wait == 0.25 * SECOND
    assert lateness.needed == {"b": pytest.approx(0.4)}


def test_lateness_of_long_ago_is_forgotten():
    assert waits(lambda k: 0.2 if k < 30 else 0.06, 15).wait == pytest.approx(0.06 * SECOND)
