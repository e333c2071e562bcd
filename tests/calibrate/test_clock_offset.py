"""Offsets between clocks from people who move: walkers on ellipses, seen by cameras with noise."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_mcap.calibrate.clock_offset import PairOffset, Tracks, _by_camera, pair_offset
from hiros_mcap.skeletons import Floats


def seen(seed: int, *, ahead: float | Floats = 0.0, speed: float = 1.0, people: int = 1) -> Tracks:
    """A camera, displaced by 5 cm, whose clock is ahead by so many s; 24 s at 30 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 24, 1 / 30) + rng.random() / 30
    tracks = []
    for k in range(people):
        angle = speed * t + 2 * k
        path = np.stack([np.cos(angle), 0.7 * np.sin(1.3 * angle), np.full_like(t, 1.0 + k)], 1)
        tracks.append((t + ahead, path + rng.normal(0, 0.015, path.shape) + 0.05 * seed))
    return tracks


@pytest.mark.parametrize("ahead", [-1.5, -0.2, 0.03, 0.5])
def test_the_offset_of_people_who_walk_is_found(ahead: float) -> None:
    found = pair_offset(seen(0), seen(1, ahead=ahead, people=2), hint=ahead + 0.02)
    assert found is not None
    assert found.seconds == pytest.approx(ahead, abs=0.003)
    assert found.error < 0.003
    assert found.is_proven


def test_an_offset_that_the_lags_do_not_show_is_searched_for() -> None:
    found = pair_offset(seen(0), seen(1, ahead=1.2), hint=0.0)
    assert found is not None
    assert found.seconds == pytest.approx(1.2, abs=0.003)


def test_clocks_that_agree_have_no_proven_offset() -> None:
    found = pair_offset(seen(0), seen(1), hint=0.1)
    assert found is not None
    assert abs(found.seconds) < 0.003
    assert not found.is_proven


def test_people_who_stand_still_prove_nothing() -> None:
    assert pair_offset(seen(0, speed=0.0), seen(1, speed=0.0), hint=0.1) is None


def test_halves_that_disagree_prove_nothing() -> None:
    ahead = np.linspace(0.0, 0.3, len(seen(1)[0][0]))
    assert pair_offset(seen(0), seen(1, ahead=ahead), hint=0.1) is None


def test_people_whom_nobody_else_sees_prove_nothing() -> None:
    alone = [(at, places + np.array([0.0, 0.0, 5.0])) for at, places in seen(1)]
    assert pair_offset(seen(0), alone, hint=0.1) is None


def test_most_of_the_cameras_are_right() -> None:
    pairs = {("a", "b"): (0.0, 0.1), ("a", "c"): (0.0, 0.0), ("b", "c"): (0.1, 0.0)}
    found = _by_camera({k: PairOffset(b - a, 0.001, 0.5) for k, (a, b) in pairs.items()}, {})
    assert {k: round(v.seconds, 6) for k, v in found.items()} == {"a": 0.0, "b": 0.1, "c": 0.0}


def test_of_two_cameras_the_one_logged_nearer_to_its_stamps_is_right() -> None:
    found = _by_camera({("a", "b"): PairOffset(0.1, 0.001, 0.5)}, {"a": -0.07, "b": 0.03})
    assert {k: round(v.seconds, 6) for k, v in found.items()} == {"a": -0.1, "b": 0.0}
    assert _by_camera({}, {}) == {}


@pytest.mark.parametrize(
    ("seconds", "error", "gain", "proven"),
    [(0.1, 0.005, 0.2, True), (0.015, 0.001, 0.2, False), (0.05, 0.02, 0.2, False),
     (0.1, 0.005, 0.01, False)],
)  # fmt: skip
def test_a_proof_needs_size_certainty_and_gain(
    seconds: float, error: float, gain: float, proven: bool
) -> None:
    assert PairOffset(-seconds, error, gain).is_proven is proven
