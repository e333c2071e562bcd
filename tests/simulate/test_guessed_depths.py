"""The detector of the benchmarks that guesses depths errs as MediaPipe does on film.

The bounds enclose what ``benchmarks/depth_errors.py`` measures on film; the other simulated
detectors lie outside of them.
"""

from __future__ import annotations

from functools import cache

import depth_errors
import numpy as np
import pytest
from scenes import guessing, published

pytestmark = pytest.mark.filterwarnings("ignore:Mean of empty slice")  # nobody in a view


@cache
def measured():
    depth_errors.SEEDS = range(7310, 7311)
    return dict(depth_errors.rows(depth_errors.simulated("kinect", guesses=True)))


def test_it_errs_along_its_rays_as_far_as_on_film_and_not_across():
    scene = published(7311, people=2, cameras=2, seconds=2.0)
    for after in guessing(scene, 7311).frames:
        (before,) = (f for f in scene.frames if (f.source, f.stamp) == (after.source, after.stamp))
        beside = np.cross(before.positions, after.positions)
        assert np.nanmax(np.abs(beside), initial=0.0) < 1e-9
    along, across = map(int, measured()["all joints: along, across"].split(", "))
    assert 130 < along < 230  # mm; on film 178
    assert 3 < along / across < 6  # on film 3.6


def test_it_puts_bodies_and_whole_limbs_too_near_or_too_far():
    assert 90 < int(measured()["along, whole body"]) < 190  # mm; on film 144
    assert 75 < int(measured()["along, beside the body"]) < 150  # on film 105
    for one, other, least in (("knee", "ankle", 0.4), ("elbow", "wrist", 0.5)):
        r = float(measured()[f"correlation of {one} and {other}, beside the body"])
        assert least < r < 0.9  # on film .57 and .72


def test_it_keeps_to_a_guess_for_about_a_second():
    after = {lag: float(measured()[f"correlation after {lag:g} s"]) for lag in (0.1, 0.5, 2.0)}
    assert after[0.1] > 0.75  # on film .85
    assert 0.35 < after[0.5] < 0.75  # .55
    assert after[2.0] < 0.35
