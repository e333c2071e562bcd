"""Residuals against the model: simulated cameras as the fuser assumes them, and worse ones."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from builders import at_once, same

from hiros_mcap.config import load_config
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, by_frame, frames_of, join
from hiros_mcap.rays.keypoints import TRIANGULATED, confidence_of
from hiros_mcap.running.pipeline import process
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.running.report import scatter_by_camera, scatter_notes, scatter_of
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import Simulation, write_log
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.stages.fuse.fuse import FuseParams, fuse_blocks
from hiros_mcap.stages.fuse.residuals import histograms, medians

fuse = at_once(fuse_blocks)

BODY = SkeletonModel.of([f"m{k}" for k in range(8)], [])
CAMERAS = "abc"
REALTIME = {"lookahead": 0.02, "window": 0.0}


def wander(rng, steps, shape):
    """Gauss-Markov offsets of 1 cm with a time constant of 1.7 s at 30 Hz."""
    keep = np.exp(-1 / 30 / 1.7)
    b = [rng.normal(0, 0.01, shape)]
    for _ in range(steps - 1):
        b.append(keep * b[-1] + rng.normal(0, 0.01 * np.sqrt(1 - keep**2), shape))
    return np.stack(b)


TIMES = np.arange(600) / 30


@cache
def scattered():
    """(600, 3, 8, 3) positions by each camera, with its offset; their white noise of 1 sigma."""
    rng = np.random.default_rng(5)
    place = 0.4 * np.sin(TIMES[:, None, None] + np.arange(24.0).reshape(8, 3))
    offsets = wander(rng, len(TIMES), (3, 8, 3))
    return place[:, None] + offsets, rng.normal(0, 0.007, offsets.shape)


def detections(noise, shift=None):
    """20 s of one who moves; noise of each camera in units of the model's, a shift of camera c."""
    places, white = scattered()
    frames = []
    for k, t in enumerate(TIMES):
        for c, name in enumerate(CAMERAS):
            stamp = round((t + 0.005 * c) * 1e9) + 10**9
            frame = Frame.empty(1, BODY, stamp=stamp, source=name)
            frame.ids[:] = 0
            frame.markers[0, :, :3] = places[k, c] + noise.get(name, 1.0) * white[k, c]
            if name == "c" and shift is not None:
                frame.markers[0, :, :3] += shift
            frame.marker_confidences[:] = frame.confidences[:] = 0.9
            frames.append(frame)
    return frames


def found(frames, **params):
    events = Events()
    for _ in fuse(frames, BODY, FuseParams(**params), events):
        pass
    return scatter_of(events), list(scatter_by_camera(events, BODY))


@pytest.mark.parametrize("params", [{}, REALTIME])
def test_cameras_as_the_model_has_them_scatter_as_expected(params):
    ratio, cameras = found(detections({}), **params)
    assert ratio == pytest.approx(1.0, abs=0.1)
    assert [c.name for c in cameras] == ["a", "b", "c"]
    assert [c.ratio for c in cameras] == pytest.approx([1, 1, 1], abs=0.15)
    assert not list(scatter_notes(cameras))


@pytest.mark.parametrize("params", [{}, REALTIME])
def test_a_camera_that_is_noisier_is_named(params):
    _, cameras = found(detections({"b": 2.5}), **params)
    (note,) = scatter_notes(cameras)
    assert "detections of b scatter" in note
    assert "noisier than assumed" in note


def test_a_camera_that_stands_elsewhere_is_told_from_a_noisy_one():
    _, cameras = found(detections({}, np.array([0.0, 0.15, 0.0])))
    assert max(cameras, key=lambda c: c.ratio).name == "c"
    assert any("hiros calibrate people" in note for note in scatter_notes(cameras))
    assert cameras[2].common > 0.6


def test_the_worst_joint_is_named():
    frames = detections({"b": 3.0})
    rng = np.random.default_rng(6)
    for frame in frames[1::3]:
        frame.markers[0, 5, :3] += rng.normal(0, 0.06, 3)
    _, cameras = found(frames)
    assert cameras[1].worst_joint == "m5"
    assert "(m5 " in next(iter(scatter_notes(cameras)))


@pytest.mark.parametrize("params", [{"window": 1.0}, REALTIME])
def test_blocks_change_no_histogram_and_no_result(params):
    frames, settings = detections({"b": 2.5})[:600], FuseParams(**params)
    one, other = Events(), Events()
    results = list(by_frame(fuse_blocks)(frames, BODY, settings, one))
    whole = join([Block.of(frame) for frame in frames])
    again = list(frames_of(fuse_blocks([whole], BODY, settings, other)))
    assert all(map(same, results, again))
    assert one.histograms.keys() == other.histograms.keys()
    for key, counts in one.histograms.items():
        np.testing.assert_array_equal(counts, other.histograms[key])


def deviations(frames, **params):
    """The mean deviation, m, from 5 s on, without that of the poses."""
    params = {"pose_angle": 0.0, "pose_shift": 0.0, **params}
    later = [f for f in fuse(frames, BODY, FuseParams(**params)) if f.stamp > 6e9]
    return float(np.mean([f.uncertainty.deviations for f in later]))


@cache
def usual_deviations(causal):
    return deviations(detections({}), **(REALTIME if causal else {}))


@pytest.mark.parametrize("cameras", ["abc", "ab"])
@pytest.mark.parametrize(("params", "off"), [({}, 0.12), (REALTIME, 0.14)])
def test_ellipsoids_hold_their_share_of_cameras_as_the_model_has_them(cameras, params, off):
    frames = [frame for frame in detections({}) if frame.source in cameras]
    params = FuseParams(pose_angle=0.0, pose_shift=0.0, **params)
    squares = []
    for frame in fuse(frames, BODY, params):
        t = frame.stamp * 1e-9 - 1.0
        away = frame.positions[0] - 0.4 * np.sin(t + np.arange(24.0).reshape(8, 3))
        squares.append((away**2).sum(axis=1) / frame.uncertainty.deviations[0] ** 2)
    assert np.mean(np.array(squares) < 3.506) == pytest.approx(0.68, abs=off)


@pytest.mark.parametrize("params", [{}, REALTIME])
def test_what_lasts_and_is_larger_makes_deviations_larger(params):
    rng, frames = np.random.default_rng(9), detections({})
    usual, offsets = usual_deviations(bool(params)), rng.normal(0, 0.02, (3, 8, 3))
    for k, frame in enumerate(frames):
        frame.markers[0, :, :3] += offsets[k % 3]
    assert 1.4 * usual < deviations(frames, **params) < 2.6 * usual


@pytest.mark.parametrize("params", [{}, REALTIME])
def test_guesses_change_no_deviation_of_what_others_see(params):
    """A detector that guesses a joint errs by much, but the result hardly follows it."""
    rng, frames = np.random.default_rng(9), detections({})
    for frame in frames[2::3]:  # camera c guesses the joints of one half
        frame.marker_confidences[0, 4:] = 0.3
    usual, errors = deviations(frames, **params), rng.normal(0, 0.08, (50, 4, 3))
    for k, frame in enumerate(frames[2::3]):  # others each 0.4 s
        frame.markers[0, 4:, :3] += errors[k // 12]
    assert deviations(frames, **params) < 1.25 * usual


@pytest.mark.parametrize("params", [{}, REALTIME])
def test_joints_that_are_seen_at_times_scatter_as_others_do(params):
    rng, frames = np.random.default_rng(9), detections({})
    offsets = rng.normal(0, 0.02, (3, 8, 3))
    for k, frame in enumerate(frames):
        frame.markers[0, :, :3] += offsets[k % 3]
        frame.markers[0, 4 * (k // 3 % 2) :][:4] = np.nan
    assert 1.4 * usual_deviations(bool(params)) < deviations(frames, **params)


@pytest.mark.parametrize("params", [{}, REALTIME])
def test_the_error_of_a_pose_is_no_scatter(params):
    """The common error of all joints of a view is in the shared part, and counts once."""
    usual = usual_deviations(bool(params))
    shifted = detections({}, np.array([0.0, 0.05, 0.0]))
    assert deviations(shifted, **params) == pytest.approx(usual, rel=0.1)


@pytest.mark.parametrize("params", [{}, REALTIME])
@pytest.mark.parametrize(("lasts", "scatters"), [(0.03, 0.003), (0.02, 0.02), (0.04, 0.02)])
def test_joints_from_rays_err_by_what_they_state_and_do_not_scatter(params, lasts, scatters):
    rng, frames = np.random.default_rng(9), []
    offsets = rng.normal(0, lasts, (8, 3))
    for t in TIMES:
        stamp = round(t * 1e9) + 10**9
        frames.append(frame := Frame.empty(1, BODY, stamp=stamp, source=TRIANGULATED))
        frame.ids[:], frame.confidences[:] = 0, 0.9
        place = 0.4 * np.sin(t + np.arange(24.0).reshape(8, 3))
        frame.markers[0, :, :3] = place + offsets + rng.normal(0, scatters, (8, 3))
        frame.marker_confidences[:] = confidence_of(np.hypot(lasts, scatters))
    assert deviations(frames, **params) == pytest.approx(lasts, rel=0.25)


def test_medians_of_histograms_are_those_of_the_values():
    values = np.random.default_rng(7).lognormal(0, 2, (3, 4001))
    values[1, 100:] = np.nan
    found = medians(histograms(values), 50)
    np.testing.assert_allclose(found, np.nanmedian(values, axis=1), rtol=0.02)
    assert np.isnan(medians(histograms(values[:, :40]), 50)).all()


def summary_of(folder, system):
    log = folder / "log.mcap"
    write_log(log, SimulateParams(cameras=4, seconds=4, seed=4, flips=0, occlusion=0))
    config = load_config(system=system)
    return process(log, None, config=config, options=ProcessOptions(system=system))


def test_a_run_on_a_log_as_expected_says_nothing(tmp_path):
    summary = summary_of(tmp_path, "fuse")
    assert 0.5 < summary.scatter < 1.3
    assert len(summary.to_dict()["scatters"]) == 4
    assert not any("scatter" in note for note in summary.notes)


def test_a_run_says_which_camera_contradicts_the_model(tmp_path, monkeypatch):
    rng = np.random.default_rng(8)
    usual = Simulation.detections.fget

    def noisier(simulation):
        for frame in usual(simulation):
            if frame.source == "camera_1":
                frame.positions[:] += rng.normal(0, 0.03, frame.positions.shape)
            yield frame

    monkeypatch.setattr(Simulation, "detections", property(noisier))
    notes = [n for n in summary_of(tmp_path, "fuse").notes if "scatter" in n]
    assert len(notes) == 1
    assert notes[0].startswith("the detections of camera_1 scatter")
