"""Simulated RGB cameras: true keypoints are projections, and every fault is what was asked for."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_cli.app import run
from hiros_mcap.io.detectors.body_models import body_model, joints_of
from hiros_mcap.io.log import open_reader
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.simulate.simulation import write_log

OFF = {
    "noise": 0.0, "occlusion": 0.0, "flips": 0.0, "dropouts": 0.0, "clock_jitter": 0.0,
    "calibration_error": 0.0, "phantoms": 0.0,
}  # fmt: skip


def images(kinds=("rgb",), rig=(), **changes):
    scene = {"seconds": 2.0, "cameras": 2, "rig": {"kinds": kinds, **dict(rig)}, **OFF, **changes}
    return simulate(SimulateParams.model_validate(scene))


def with_truth(simulation):
    """Each image, and (P, J, 3) where its joints really are in the camera's coordinates, m."""
    markers = joints_of(simulation.model.marker_names)
    joints = joints_of(body_model(simulation.params.image.joints).marker_names)
    rows = [markers.index(joint) for joint in joints]
    cameras = {camera.name: camera for camera in simulation.cameras}
    for frame in simulation.keypoints:
        camera = cameras[frame.camera]
        captured = camera.captured[camera.stamped == frame.stamp]
        yield frame, camera.points(simulation.truth_at(captured)[0].positions[:, rows])


def test_without_faults_keypoints_are_projections():
    simulation = images(action="free_static")
    for frame, points in with_truth(simulation):
        pixels = simulation.intrinsics[frame.camera].pixels(points)
        assert np.nanmax(np.abs(frame.pixels - pixels)) < 1e-9
        assert np.isfinite(frame.pixels).all()


def test_noise_is_as_wide_as_asked_for_and_shrinks_with_the_distance():
    only = {"quick": 0.0, "slow": 0.0, "pixel": 0.0, "outliers": 0.0, "exposure": 0.0}
    for radius in (4.0, 8.0):
        simulation = images(
            noise=1.0, image={**only, "white": 3.0}, action="free_static",
            rig={"radius": radius, "height": 1.0},
        )  # fmt: skip
        errors = [
            (frame.pixels - simulation.intrinsics[frame.camera].pixels(points)) * points[..., 2:]
            for frame, points in with_truth(simulation)
        ]
        assert np.nanstd(np.concatenate(errors)) == pytest.approx(3.0 * 4.0, rel=0.03)


def test_what_moves_fast_blurs_along_its_way():
    only = dict.fromkeys(("white", "quick", "slow", "pixel", "outliers"), 0.0)
    simulation = images(noise=1.0, image={**only, "exposure": 0.03}, rig={"synchronised": True})
    lens = simulation.intrinsics["camera_0"]
    pairs = [(f.pixels, lens.pixels(p)) for f, p in with_truth(simulation) if f.camera[-1] == "0"]
    seen, true = (np.stack(each)[1:, 0] for each in zip(*pairs, strict=True))
    way = np.diff(np.stack([pixels for _, pixels in pairs])[:, 0], axis=0)
    error = np.linalg.norm(seen - true, axis=-1)
    along = np.abs(((seen - true) * way).sum(axis=-1)) / np.linalg.norm(way, axis=-1)
    assert np.nanmax(np.abs(error - along)) < 1e-6
    assert np.nanmax(error / np.linalg.norm(way, axis=-1)) == pytest.approx(0.45, abs=0.02)


def test_hidden_joints_are_guessed_with_a_low_score_or_missing():
    simulation = images(people=2, action="cross", seconds=8.0, occlusion=1.0, cameras=1)
    lens, far, near, missing, count = simulation.intrinsics["camera_0"], [], [], 0, 0
    for frame, points in with_truth(simulation):
        if len(frame.pixels) != 2:
            continue
        pixels = lens.pixels(points)
        order = [0, 1] if _gap(frame.pixels, pixels) < _gap(frame.pixels[::-1], pixels) else [1, 0]
        error = np.linalg.norm(frame.pixels[order] - pixels, axis=-1)
        low = (frame.scores[order] < 0.62) & (frame.scores[order] > 0)
        far += error[low].tolist()
        near += error[frame.scores[order] >= 0.62].tolist()
        missing, count = missing + np.isnan(error).sum(), count + error.size
    assert np.median(far) > 10 > 1 > np.median(near)
    assert 0.02 < missing / count < 0.3


def _gap(seen, true):
    return np.nanmedian(np.linalg.norm(seen - true, axis=-1))


def test_who_is_partly_outside_of_the_image_keeps_the_joints_inside():
    simulation = images(image={"focal": 2800.0}, action="free_static")
    for frame in simulation.keypoints:
        inside = frame.pixels[np.isfinite(frame.pixels).all(axis=-1)]
        assert 0 < len(inside) < 17
        assert ((inside >= 0) & (inside < (1920, 1080))).all()
        assert (frame.scores[np.isnan(frame.pixels[..., 0])] == 0).all()


def test_a_stranger_in_the_background_is_seen_by_one_camera_only():
    simulation = images(cameras=3, phantoms=1.0, detector={"static_phantoms": 1})
    by_camera = {name: [] for name in simulation.intrinsics}
    for frame in simulation.keypoints:
        by_camera[frame.camera].append([np.ptp(p[:, 1]) for p in frame.pixels])
    assert max(map(len, by_camera["camera_0"])) == 2
    assert max(map(len, by_camera["camera_1"] + by_camera["camera_2"])) == 1
    small, large = np.median([sorted(p) for p in by_camera["camera_0"] if len(p) == 2], axis=0)
    assert small < 0.7 * large


def test_a_depth_camera_reports_the_same_beside_rgb_cameras():
    alone, mixed = (
        images(kinds, people=2, seed=3, noise=1.0, flips=1.0, occlusion=1.0, cameras=3)
        for kinds in (("depth",), ("depth", "rgb", "depth"))
    )
    expected = [f.markers.tobytes() for f in alone.detections if f.source != "camera_1"]
    assert [f.markers.tobytes() for f in mixed.detections] == expected
    assert {frame.camera for frame in mixed.keypoints} == set(mixed.intrinsics) == {"camera_1"}


def test_a_log_holds_keypoints_lenses_poses_and_truth(tmp_path):
    params = SimulateParams.model_validate(
        {"seconds": 1.0, "cameras": 2, "rig": {"kinds": ("depth", "rgb")}}
    )
    written = [write_log(tmp_path / name, params) for name in "ab"]
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert set(written[0]) == {
        *("/tf_static", "/truth/skeletons", "/camera_0/skeletons"),
        *("/camera_1/keypoints", "/camera_1/camera_info"),
    }
    assert written[0]["/camera_1/keypoints"] == len(list(simulate(params).keypoints))


def test_the_command_takes_a_kind_for_all_or_one_each(tmp_path):
    out = str(tmp_path / "log.mcap")
    assert run(["simulate", out, "--camera", "depth,rgb,rgb", "--seconds", "0.2"]) == 0
    with open_reader(out) as reader:
        topics = {channel.topic for channel in reader.channels.values()}
    assert {"/camera_0/skeletons", "/camera_1/keypoints", "/camera_2/keypoints"} <= topics
    assert run(["simulate", out, "-f", "--camera", "depth,rgb", "--cameras", "3"]) == 2
    assert run(["simulate", out, "-f", "--camera", "colour"]) == 2
