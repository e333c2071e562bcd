"""The table of systems. What every system keeps is in test_laws.py."""

from __future__ import annotations

import numpy as np
import pytest
from builders import at_once, room

from hiros_mcap.config import load_config
from hiros_mcap.errors import ConfigError
from hiros_mcap.skeletons import SkeletonModel
from hiros_mcap.stages.known_cameras import KnownCameras
from hiros_mcap.stages.merge.merge import MergeParams
from hiros_mcap.systems import LETTERS, SYSTEMS, Run, chain_of, merging_order, system

MODEL = SkeletonModel.of(["A", "B"], [("AB", 0, 1)])


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_chains_are_the_table(name):
    table = list(system(name).stages(Run(MODEL, load_config(system=name), system=name)))
    assert list(chain_of(name)) == [LETTERS[letter] for letter in SYSTEMS[name].chains[-1]]
    assert [stage for stage in table if stage in chain_of(name)] == list(chain_of(name))
    assert all(chain.startswith("T") for chain in SYSTEMS[name].chains)


def test_some_of_the_stages_can_be_chosen():
    assert chain_of("hiros", "tmf") == ("tracked", "merged", "filtered")
    with pytest.raises(ConfigError, match="system raw cannot run the stages 'TM'"):
        chain_of("raw", "TM")


def test_an_unknown_system_is_named_with_those_that_exist():
    with pytest.raises(
        ConfigError,
        match=r"no system 'hirso'; did you mean hiros\? \(there are: fuse, ",
    ):
        system("hirso")


def test_a_stage_gets_what_the_run_has():
    run = Run(MODEL, known=KnownCameras({"a": np.zeros(3)}), fixed_frame="world")
    for name in SYSTEMS:
        for stage in system(name).stages(run).values():
            assert callable(stage)
    bound = run.stage(print, run.config.kalman, cameras=run.cameras).keywords
    expected = {"model": MODEL, "params": run.config.kalman, "events": run.events}
    assert bound == {**expected, "cameras": run.cameras}


@pytest.mark.parametrize("preset", ["paper", "upstream"])
def test_the_optimizer_of_the_published_presets_acts(preset):
    """Good detections pass the paper's quality gate; then the lengths vary three times less."""
    scene = room(people=1, cameras=4, seconds=8, noise=0.3, flips=0.0, phantoms=0.0, seed=3)
    run = Run(
        scene.model,
        load_config(preset=preset, system="hiros"),
        known=KnownCameras(scene.cameras),
        fixed_frame="world",
    )
    stages, spread = system("hiros").stages(run), {}
    frames = scene.frames
    for channel in ("tracked", "merged", "optimized"):
        frames = list(at_once(stages[channel])(frames))
        poses = np.stack([frame.positions[0] for frame in frames if frame.n_people][-60:])
        lengths = np.linalg.norm(np.diff(poses[:, scene.model.links], axis=2)[:, :, 0], axis=-1)
        spread[channel] = np.mean(lengths.std(axis=0) / lengths.mean(axis=0))
    assert [e.kind for e in run.events.log] == ["track born", "limbs calibrated"]
    assert spread["optimized"] < spread["merged"] / 3


def test_the_order_of_merging_names_the_steps_that_are_on():
    assert merging_order(MergeParams()) == ("flips", "outliers", "mean")
    off = MergeParams(max_facing_delta=0.0, max_position_delta=0.0, max_orientation_delta=0.0)
    assert merging_order(off) == ("mean",)
