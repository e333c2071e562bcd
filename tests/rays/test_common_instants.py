"""Laws of the instants that several cameras share: when they come, and which images make them."""

import numpy as np
import pytest

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.rays.common_instants import CommonInstants

PERIOD = 1_000_000_000 // 30
POSE = Rigid.identity()


def point(stamp):
    """Where somebody of two joints is in the image of every camera: moves evenly."""
    return np.array([[[0.0, 0.0], [0.0, 1.0]]]) + stamp / PERIOD * 0.02


def instants(images, silent=()):
    """(instant, people by camera, stamp of the image with which it came) of (camera, stamp)."""
    common = CommonInstants()
    for name in (*dict.fromkeys(name for name, _ in images), *silent):
        common.add_camera(name)
    out = [
        (instant, people, stamp)
        for name, stamp in images
        for instant, people in common.add(name, stamp, POSE, point(stamp), np.ones((1, 2)))
    ]
    return common, out + [(instant, people, -1) for instant, people in common.rest()]


def sent(phases, n=30, shake=None):
    """Images of cameras with these phases, in periods, in the order of time."""
    shakes = np.zeros(n) if shake is None else shake
    every = [
        (round((30 + k + phase + shakes[k]) * PERIOD), name)
        for name, phase in phases.items()
        for k in range(n)
    ]
    return [(name, stamp) for stamp, name in sorted(every)]


def test_cameras_in_step_make_each_instant_at_once_though_their_times_tremble():
    shake = 0.015 * np.resize([1, -1, 0, 1, 1, -1, -1], 30)
    images = sent({"a": 0.0, "b": 0.0, "c": 0.0}, shake=shake)
    _, out = instants(images)
    assert [instant for instant, _, _ in out] == sorted({stamp for _, stamp in images})
    assert all(instant == came for instant, _, came in out)
    assert all(people.keys() == {*"abc"} for _, people, _ in out)


@pytest.mark.parametrize("phase", [0.2, 0.5, 0.8])
def test_cameras_out_of_step_share_one_instant_a_period(phase):
    _, out = instants(sent({"a": 0.0, "b": phase, "c": 0.1}))
    stamps = np.array([instant for instant, _, _ in out])
    assert np.diff(stamps) / PERIOD == pytest.approx(np.ones(len(stamps) - 1), abs=0.26)
    for instant, people, came in out[2:-2]:
        assert people.keys() == {*"abc"}
        assert 0 <= came - instant <= PERIOD  # the next image of each camera is enough
        for sight in people.values():
            assert sight.points == pytest.approx(point(instant), abs=1e-6)
            assert sight.tracks.tolist() == [0]


def test_an_image_that_is_early_waits_for_one_that_is_nearer():
    stamps = [("a", 30.0), ("b", 30.0), ("a", 31.0), ("b", 31.0), ("b", 31.8), ("a", 32.0),
              ("b", 33.0), ("a", 33.0)]  # fmt: skip
    _, out = instants([(name, round(k * PERIOD)) for name, k in stamps])
    assert [instant / PERIOD for instant, _, _ in out] == pytest.approx([30, 31, 32, 33], abs=1e-6)


def test_an_early_image_counts_once_none_can_be_nearer():
    stamps = [round(k * PERIOD) for k in (*range(20, 32), 31.8, 32.9, 33.9, 34.9)]
    _, out = instants([("a", stamp) for stamp in stamps])
    assert [instant for instant, _, _ in out] == stamps
    assert [came / PERIOD for _, _, came in out[11:14]] == pytest.approx([31.0, 32.9, 32.9])


def test_neither_the_origin_of_time_nor_the_names_of_cameras_matter():
    images = sent({"a": 0.0, "b": 0.4})
    plain = [(instant, came) for instant, _, came in instants(images)[1]]
    later = instants([(name, stamp + 10**18) for name, stamp in images])[1]
    assert [(i - 10**18, c - 10**18 if c > 0 else c) for i, _, c in later] == plain
    other = instants([({"a": "b", "b": "a"}[name], stamp) for name, stamp in images])[1]
    assert [(instant, came) for instant, _, came in other] == plain


def test_a_camera_that_sends_nothing_is_waited_for_in_the_first_second_only():
    images = sent({"a": 0.0, "b": 0.4}, n=60)
    came = [(i, stamp - i) for i, _, stamp in instants(images, ["silent"])[1] if stamp > 0]
    first, second = images[0][1], 1_000_000_000
    early = [wait for instant, wait in came if instant < first + 0.8 * second]
    assert len(early) > 20
    assert all(0.15 * second <= wait < 0.15 * second + PERIOD for wait in early)
    assert all(wait <= PERIOD for instant, wait in came if instant > first + second)


@pytest.mark.parametrize("early", [0, 1])
def test_who_falls_silent_is_waited_for_a_period_longer_than_who_is_late(early):
    """At that very time all instants come that only waited for this camera."""
    both = sent({"a": 0.0, "b": 0.0}, n=10)
    last = both[-1][1]
    limit = last + CommonInstants().wait + PERIOD
    alone = [("a", stamp) for stamp in range(last + PERIOD, limit - PERIOD // 2, PERIOD)]
    _, out = instants([*both, *alone, ("a", limit - early)])
    came = {came for instant, _, came in out if last + PERIOD < instant < limit - PERIOD}
    assert came == {-1 if early else limit}


def test_an_image_that_comes_when_its_time_is_over_is_counted_and_left_out():
    images = sent({"a": 0.0, "b": 0.0})
    late = [("a", images[40][1]), ("b", images[20][1])]
    common, out = instants([*images[:50], *late, *images[50:]])
    assert common.late == {"a": 1, "b": 1}
    assert [i for i, _, _ in out] == [i for i, _, _ in instants(images)[1]]
