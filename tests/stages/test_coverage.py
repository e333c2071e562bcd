"""The view of a camera, learned from the places where it has reported people."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_mcap.stages.track.coverage import Coverage
from hiros_mcap.stages.track.tracking import LAST, NEVER

CAMERA = {"a": np.array([0.0, 0.0, 1.0])}


def place(x, y):
    return np.array([x, y, 1.0])


def taught(n=6):
    """Camera "a" has reported people 3 to 4 m in front of it, up to 0.5 m to either side."""
    coverage = Coverage(CAMERA)
    spots = [(3, -0.5), (3, 0.5), (4, -0.5), (4, 0.5), (3.5, 0.0), (3.2, 0.1)]
    for k, (x, y) in enumerate(spots[:n]):
        coverage.learn("a", [place(x, y)], k)
    return coverage


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        (3.5, 0.2, True),
        (4.2, 0.0, True),  # a little beyond the farthest person
        (2.8, 0.0, True),  # a little before the nearest
        (5.0, 0.0, False),
        (1.0, 0.0, False),
        (3.5, 1.5, False),
        (-3.5, 0.0, False),
    ],
)
def test_a_camera_covers_the_cone_of_those_it_reported(x, y, expected):
    assert taught().sees("a", place(x, y), []) is expected


@pytest.mark.parametrize(
    ("x", "y", "hidden"), [(2.0, 0.0, True), (2.0, 0.8, False), (3.7, 0.0, False), (-1, 0, False)]
)
def test_somebody_in_between_hides_a_place(x, y, hidden):
    assert taught().sees("a", place(3.5, 0.0), [place(x, y)]) is not hidden


def test_the_silence_of_a_camera_that_knows_little_says_nothing():
    assert not taught(4).sees("a", place(3.0, 0.0), [])
    assert taught(5).sees("a", place(3.0, 0.0), [])


def test_a_camera_nobody_knows_covers_nothing():
    coverage = taught()
    assert not coverage.sees("b", place(3.5, 0.0), [])
    assert coverage.due("b") == LAST


@pytest.mark.parametrize(("lessons", "pause"), [(1, 200_000_000), (5, 500_000_000)])
def test_lessons_are_closer_together_at_first(lessons, pause):
    coverage = taught(lessons)
    assert coverage.due("a") == lessons - 1 + pause


def test_a_camera_that_has_reported_nobody_is_due():
    assert Coverage(CAMERA).due("a") == NEVER


def test_the_cone_grows_with_the_people():
    coverage = taught()
    assert not coverage.sees("a", place(3.0, 2.0), [])
    coverage.learn("a", [place(3.0, 2.2)], 100)
    assert coverage.sees("a", place(3.0, 2.0), [])


def test_a_person_at_the_camera_itself_teaches_nothing():
    coverage = taught()
    coverage.learn("a", [CAMERA["a"].copy()], 100)
    assert not coverage.sees("a", place(0.5, 0.0), [])
