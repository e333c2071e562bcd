"""How long messages of a live system wait for others."""

from __future__ import annotations

from dataclasses import replace

import pytest
from builders import at_once
from stick_figures import MODEL, SECOND, START, person, seen

from hiros_mcap.events import TOO_LATE, Events
from hiros_mcap.frames import by_frame
from hiros_mcap.stages.merge.merge import merge_blocks
from hiros_mcap.stages.time_order import Lateness, in_time_order

ordered, merge = by_frame(in_time_order), at_once(merge_blocks)


def waits(late, seconds=5, limit=0.25, rate=30, every=1):
    """Measure messages of two cameras; the second one is ``late`` s, and sends one of ``every``."""
    lateness = Lateness(limit)
    for k in range(rate * seconds):
        now = k * SECOND // rate
        lateness.take(now, "a", now)
        if k % every == 0:
            lateness.take(now - round(late(k) * SECOND), "b", now)
    return lateness


def test_messages_wait_for_the_slowest_camera():
    assert waits(lambda k: 0.1).wait == pytest.approx(0.1 * SECOND)


def test_cameras_that_are_in_time_make_nobody_wait():
    assert waits(lambda k: 0.03).wait == 0


@pytest.mark.parametrize("every", [1, 3])
def test_fast_cameras_wait_for_what_is_later_than_their_next_message(every):
    """So late a message is older than those that they have shown since."""
    assert waits(lambda k: 0.03, rate=90, every=every).wait == pytest.approx(0.03 * SECOND)
    assert waits(lambda k: 0.01, rate=90, every=every).wait == 0


@pytest.mark.parametrize("rate", [90, 120])
def test_a_fast_camera_whose_messages_come_frames_later_is_in_every_instant(rate):
    """Some are lost at first, while nobody knows how late they are."""
    late, events = round(0.025 * SECOND), Events()
    stamps = [START + k * SECOND // rate for k in range(2 * rate)]
    frames = [seen([person()], stamp, camera, ids=[0]) for stamp in stamps for camera in "abcd"]
    frames = [replace(f, log_time=f.stamp + late * (f.source == "d")) for f in frames]
    frames.sort(key=lambda frame: frame.log_time)
    instants = list(merge(list(ordered(frames, Lateness(0.25))), MODEL, events=events))
    assert events.total(TOO_LATE) <= 8
    assert len(instants) == pytest.approx(2 * rate, abs=2)


@pytest.mark.parametrize("rate", [8, 15, 30])
def test_nobody_tolerates_more_than_40_ms(rate):
    assert waits(lambda k: 0.039, rate=rate).wait == 0
    assert waits(lambda k: 0.041, rate=rate).wait == pytest.approx(0.041 * SECOND)


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
