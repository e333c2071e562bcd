"""Poses, clocks and size of RGB cameras from keypoints alone."""

import itertools
import tomllib

import numpy as np
import pytest

from hiros_cli.app import run
from hiros_mcap.calibrate.filmed_people import ADULT_M, calibrate_filmed
from hiros_mcap.io.channels import channels_of
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_reader
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import Simulation, write_log

SCENE = SimulateParams.model_validate(
    {
        "people": 2,
        "cameras": 3,
        "seconds": 10.0,
        "seed": 3,
        "heights": (1.8, 1.8),
        "rig": {"kinds": ("rgb",), "clock_offset": 0.4},
    }
)


@pytest.fixture(scope="module")
def placed(tmp_path_factory):
    path = tmp_path_factory.mktemp("film") / "placed.mcap"
    write_log(path, SCENE)
    return path


@pytest.fixture(scope="module")
def log(placed):
    """The same without transforms."""
    path = placed.with_name("log.mcap")
    with open_reader(placed) as reader, McapWriter(path) as writer:
        kept = [info.id for info in channels_of(reader) if info.topic != "/tf_static"]
        writer.copy_definitions(reader, kept)
        for message in reader.messages(kept):
            writer.write(message.channel_id, message.log_time, message.data)
        writer.commit()
    return path


@pytest.fixture(scope="module")
def found(log):
    with open_reader(log) as reader:
        return calibrate_filmed(reader)


def spans(poses):
    """Distances between cameras, m."""
    pairs = itertools.combinations([pose.translation for pose in poses], 2)
    return np.array([np.linalg.norm(a - b) for a, b in pairs])


def true_poses():
    return [camera.pose for camera in Simulation(SCENE).cameras]


def test_people_alone_tell_poses_and_clocks(found):
    ratios = spans([camera.pose for camera in found.cameras]) / spans(true_poses())
    assert ratios == pytest.approx(ratios.mean(), rel=0.01)
    late = [(c.stamped - c.captured)[0] / 1e9 for c in Simulation(SCENE).cameras]
    clocks = np.array([camera.clock_s for camera in found.cameras])
    assert np.ptp(clocks + late) < 0.012
    assert np.ptp(late) > 0.2
    assert {camera.verdict for camera in found.cameras} == {"good"}


def test_the_floor_is_level_and_below_the_cameras(found):
    assert found.gauge == "floor"
    heights = [camera.pose.translation[2] for camera in found.cameras]
    true = [pose.translation[2] for pose in true_poses()]
    assert np.array(heights) / true == pytest.approx(1.0, abs=0.12)


def test_limbs_of_adults_give_a_size_that_is_doubted(found):
    assert found.verdict == "usable"
    assert "from the limbs of adults, so it may be wrong by 6" in found.reason


def test_a_stature_gives_the_size(found, log):
    with open_reader(log) as reader:
        told = calibrate_filmed(reader, height=1.8)
    poses, usual = ([c.pose for c in each.cameras] for each in (told, found))
    assert spans(poses) / spans(usual) == pytest.approx(1.8 / ADULT_M)
    assert spans(poses) / spans(true_poses()) == pytest.approx(1.0, abs=0.05)


def test_transforms_place_and_size_the_rig(placed):
    with open_reader(placed) as reader:
        found = calibrate_filmed(reader)
    assert (found.gauge, found.verdict) == ("transforms", "good")
    apart = [c.pose.apart(p) for c, p in zip(found.cameras, true_poses(), strict=True)]
    assert max(degrees for _, degrees in apart) < 1.0
    assert max(metres for metres, _ in apart) < 0.05


def test_a_run_takes_the_file(log, tmp_path):
    cameras, out = tmp_path / "cameras.toml", tmp_path / "out.mcap"
    assert run(["calibrate", "people", str(log), "-o", str(cameras)]) == 0
    table = tomllib.loads(cameras.read_text())
    assert [camera["frame"] for camera in table["camera"]] == ["camera_0", "camera_1", "camera_2"]
    assert run(["process", str(log), "--extrinsics", str(cameras), "-o", str(out), "-q"]) == 0


def test_a_height_is_refused_of_depth_cameras(tmp_path, capsys):
    depth = tmp_path / "depth.mcap"
    write_log(depth, SimulateParams.model_validate({"cameras": 2, "seconds": 1.0}))
    assert run(["calibrate", "people", str(depth), "--height", "1.8"]) == 2
    assert "--height is for RGB cameras alone" in capsys.readouterr().err


def test_people_whom_no_two_cameras_see_tell_nothing(tmp_path, capsys):
    path = tmp_path / "short.mcap"
    short = {"cameras": 2, "people": 1, "seconds": 0.2, "rig": {"kinds": ("rgb",)}}
    write_log(path, SimulateParams.model_validate(short))
    assert run(["calibrate", "people", str(path)]) == 2
    assert "no two RGB cameras see the same person" in capsys.readouterr().err
