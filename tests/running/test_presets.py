"""The presets of the paper on a log where their optimizer acts.

With the paper's quality gate (section 3.3.1), one link whose length varies by more than a fifth
rejects the person: on the sample logs a hand does. Here the cameras are better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from odd_logs import changed

from hiros_mcap.config import load_config
from hiros_mcap.evaluate.logs import evaluate_log, find_truth, read_channel
from hiros_mcap.evaluate.smoothness import lengths_of
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.skeletons import Floats, SkeletonModel

ARM = ("WRIST_LEFT", "HAND_LEFT", "HANDTIP_LEFT", "THUMB_LEFT")
LONG = range(180, 188)
"""Messages of each camera in which the left forearm is twice as long, from second 6 on."""
CALIBRATED_NS = 4_500_000_000
"""After so long, 100 frames of the person have been measured."""


@dataclass(frozen=True)
class Chain:
    """One person after the merger and after the optimizer."""

    model: SkeletonModel
    stamps: Floats
    """(T,) s from the start."""
    merged: Floats
    optimized: Floats
    """(T, M, 3) m."""
    errors: tuple[float, float]
    """Mean joint error of both, mm."""

    def variations(self, poses):
        """Mean coefficient of variation of the lengths once they are calibrated."""
        known = (self.stamps > CALIBRATED_NS / 1e9) & ((self.stamps < 5.7) | (self.stamps > 6.6))
        lengths = lengths_of(poses[known], self.model)
        return float(np.nanmean(np.nanstd(lengths, axis=0) / np.nanmean(lengths, axis=0)))


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """One person, three good cameras, 8 s; for a quarter of a second a long forearm."""
    folder = tmp_path_factory.mktemp("presets")
    faultless = {"occlusion": 0.0, "flips": 0.0, "phantoms": 0.0, "dropouts": 0.0}
    params = {"people": 1, "cameras": 3, "seconds": 8.0, "seed": 1, "noise": 0.4}
    good = SimulateParams(**params, **faultless, calibration_error=0.0)
    write_log(folder / "good.mcap", good)
    _, model, _ = read_channel(folder / "good.mcap", "/truth/skeletons")
    elbow, wrist = (model.marker_names.index(name) for name in ("ELBOW_LEFT", "WRIST_LEFT"))
    arm = [model.marker_names.index(name) for name in ARM]

    def long_forearm(frame, sent):
        if sent not in LONG:
            return frame
        markers = frame.markers.copy()
        forearm = frame.positions[:, wrist] - frame.positions[:, elbow]
        markers[:, arm, :3] += forearm[:, None]
        return frame.replace(markers=markers)

    return changed(folder / "good.mcap", folder / "log.mcap", long_forearm)


@pytest.fixture(scope="module", params=["paper", "upstream"])
def chain(request, log, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / f"{request.param}.mcap"
    process(
        log,
        out,
        config=load_config(preset=request.param, system="hiros"),
        options=ProcessOptions("hiros", keep=()),
    )
    truth, channels = find_truth(log), ("/hiros/merged", "/hiros/optimized")
    assert truth is not None
    (merged, model, _), (optimized, _, _) = (read_channel(out, channel) for channel in channels)
    scores = evaluate_log(out, truth, channels)
    return Chain(
        model,
        np.array([(frame.stamp - merged[0].stamp) / 1e9 for frame in merged]),
        *(np.stack([frame.positions[0] for frame in each]) for each in (merged, optimized)),
        tuple(scores[channel].scores.mean for channel in channels),  # type: ignore[arg-type]
    )


def test_nothing_changes_before_the_calibration(chain):
    early = chain.stamps < 3.0
    assert np.array_equal(chain.merged[early], chain.optimized[early], equal_nan=True)


def test_eq_18_lets_lengths_vary_by_a_third_of_what_they_did(chain):
    before, after = chain.variations(chain.merged), chain.variations(chain.optimized)
    assert before == pytest.approx(0.052, abs=0.004)
    assert 0.25 < after / before < 0.35


def test_the_joint_error_falls_by_some_percent(chain):
    before, after = chain.errors
    assert 0.90 < after / before < 0.97


def test_a_forearm_of_twice_its_length_loses_its_distal_marker_alone(chain):
    absent = np.isnan(chain.optimized[..., 0]) & ~np.isnan(chain.merged[..., 0])
    names = {chain.model.marker_names[m] for m in np.nonzero(absent.any(axis=0))[0]}
    assert names == {"WRIST_LEFT"}
    times = chain.stamps[absent.any(axis=1)]
    assert len(LONG) - 2 <= len(times) <= len(LONG) + 2
    assert 5.9 < times.min() < times.max() < 6.4
