"""How well markers are known: written, read back, and compared with a truth."""

from __future__ import annotations

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from hiros_mcap.config import load_config
from hiros_mcap.evaluate.logs import evaluate_log, find_truth
from hiros_mcap.evaluate.match import Matches
from hiros_mcap.evaluate.scores import coverage_of
from hiros_mcap.io.marker_uncertainty import UNCERTAINTY_TOPIC, read_uncertainty
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.skeletons import SkeletonModel

MODEL = SkeletonModel.of(["A", "B"], [])


def matches(error, n=4000):
    poses = np.random.default_rng(0).normal(0, error, (n, 2, 3))
    stamps, turns = np.arange(n), np.zeros((n, 0, 4))
    true_poses = np.zeros_like(poses)
    return Matches(stamps, stamps * 0, np.full(n, 7), poses, true_poses, turns, turns)


@pytest.mark.parametrize(("error", "within"), [(0.01, 0.68), (0.02, 0.17), (0.005, 0.997)])
def test_coverage_of_normal_errors(error, within):
    told = {(stamp, 7): {0: 0.01, 1: 0.01} for stamp in range(4000)}
    found = coverage_of(matches(error), told, MODEL)
    assert found is not None
    assert found.within_68 == pytest.approx(within, abs=0.03)


def test_joints_without_a_deviation_do_not_count():
    told = {(stamp, 7): {0: 0.01, 1: np.nan} for stamp in range(10)}
    found = coverage_of(matches(0.01, 20), told, MODEL)
    assert found is not None
    assert coverage_of(matches(0.01, 20), {}, MODEL) is None


def test_a_result_of_fuse_says_how_well_it_is_known(tmp_path):
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    write_log(log, SimulateParams(people=1, cameras=3, seconds=4, seed=5))
    config = load_config(system="fuse")
    process(log, out, config=config, options=ProcessOptions(system="fuse"))
    told = read_uncertainty(out)
    with out.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        groups = [m[3] for m in reader.iter_decoded_messages([UNCERTAINTY_TOPIC])]
    assert len(told) == sum(len(group.skeletons) for group in groups) > 90
    assert len(groups[0].cameras) == 3
    assert all(0 < d < 0.3 for d in groups[-20].skeletons[0].deviations)
    truth = find_truth(out)
    assert truth is not None
    result = evaluate_log(out, truth)["/hiros/filtered"]
    assert result.coverage is not None
    assert 0.5 < result.coverage.within_68 < 1


def test_a_result_of_hiros_says_nothing(tmp_path):
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    write_log(log, SimulateParams(people=1, cameras=2, seconds=1, seed=5))
    process(log, out, options=ProcessOptions(system="hiros"))
    assert read_uncertainty(out) == {}
