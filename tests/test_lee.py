"""Lee's system as a whole: its variants, the tracker's ids, the laws of the chain."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from builders import at_once, moved, room, same
from scipy.spatial.transform import Rotation

from hiros_mcap.config import load_config
from hiros_mcap.evaluate import evaluate
from hiros_mcap.evaluate.logs import read_channel
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.stages.known_cameras import KnownCameras
from hiros_mcap.systems import SYSTEMS, Run, chain_of

VARIANTS = ("lee-a1", "lee-a2", "lee-a3", "lee-a4", "lee")

TURN, SHIFT = Rotation.from_euler("xyz", [0.3, -0.5, 1.2]), np.array([3.0, -1.0, 0.5])


@cache
def pair():
    """Two people, four cameras with every fault of real ones."""
    return room(people=2, cameras=4, action="free_dynamic", seconds=3, seed=5)


@cache
def tracked():
    stages = SYSTEMS["lee"].stages(
        Run(pair().model, known=KnownCameras(pair().cameras), fixed_frame="world")
    )
    return list(at_once(stages["tracked"])(pair().frames))


def after_tracking(system, frames, *overrides):
    """Run what follows the tracker."""
    config = load_config(None, overrides, system=system)
    stages = SYSTEMS[system].stages(Run(pair().model, config, fixed_frame="world"))
    for name in chain_of(system)[1:]:
        frames = list(at_once(stages[name])(frames))
    return frames


@cache
def usual(system):
    return after_tracking(system, tracked())


def upper_limbs(system, *overrides):
    """Mean error, mm."""
    frames = after_tracking(system, tracked(), *overrides) if overrides else usual(system)
    return evaluate(frames, pair().truth, pair().model).parts["upper limbs"].mean


def test_each_variant_gives_something_else():
    results = {name: usual(name) for name in VARIANTS}
    for one, two in pairwise(VARIANTS):
        assert not all(map(same, results[one], results[two]))


def test_clustering_beats_averaging_on_the_upper_limbs():
    a1, a2, a3, a4 = (upper_limbs(name) for name in VARIANTS[:4])
    assert a3 < 0.9 * a2 < 0.9 * a1
    assert a4 == pytest.approx(a3, rel=0.03)


def test_ten_centimetres_is_the_best_of_the_radii():
    errors = {r: upper_limbs("lee-a4", f"cluster.radius={r}") for r in (0.05, 0.1, 0.15, 0.2)}
    assert min(errors, key=lambda r: errors[r]) in (0.1, 0.15)
    assert errors[0.2] > errors[0.1] < errors[0.05]


def test_one_person_is_merged_as_in_the_paper(walking, tmp_path):
    """With one person there is one id, and each instant is one merge of all cameras."""
    out = tmp_path / "out.mcap"
    process(walking, out, options=ProcessOptions(system="lee-a4"))
    merged = read_channel(out, "/hiros/merged")[0]
    assert {int(i) for frame in merged for i in frame.ids} == {0}
    assert len(merged) > 40
    assert len({frame.stamp for frame in merged}) == len(merged)


@pytest.mark.parametrize("system", VARIANTS)
def test_the_room_may_turn_and_shift(system):
    expected = moved(usual(system), TURN, SHIFT)
    result = after_tracking(system, moved(tracked(), TURN, SHIFT))
    for here, there in zip(expected, result, strict=True):
        assert np.allclose(here.positions, there.positions, atol=1e-6, equal_nan=True)
