"""A person as a model of OpenSim: MOT and TRC fit it, and OpenSim agrees where it is installed."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from test_opensim import STANDING, stick

from hiros_mcap.body.rotations import Y_UP
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.export.files import export, renamed
from hiros_mcap.io.result import open_result
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log

MASS = 64.0


@pytest.fixture(scope="module")
def result(crossing, tmp_path_factory):
    out = tmp_path_factory.mktemp("model") / "crossing.hiros.mcap"
    process(crossing, out)
    return open_result(out).select(person=0, rate=30.0)


def model_of(path):
    return ET.parse(path).getroot().find("Model")


def place(model, joint):
    """(3,) of a joint in the body that carries it."""
    frame = model.find(f".//CustomJoint[@name='{joint}']/frames/PhysicalOffsetFrame/translation")
    return np.array([float(number) for number in frame.text.split()])


def test_the_model_has_the_lengths_of_the_person(result, tmp_path):
    told = []
    person = stick(result, **STANDING)
    (path,) = export(person, tmp_path / "out.osim", warn=told.append)
    model = model_of(path)
    for child, parent, upper, lower in (
        ("tibia_l", "femur_l", "hip_left", "knee_left"),
        ("talus_r", "tibia_r", "knee_right", "ankle_right"),
        ("ulna_r", "humerus_r", "shoulder_right", "elbow_right"),
    ):
        length = np.linalg.norm(np.subtract(STANDING[upper], STANDING[lower]))
        assert np.linalg.norm(place(model, f"{parent}_{child}")) == pytest.approx(length, abs=1e-6)
    hips = [place(model, f"pelvis_femur_{side}") for side in "lr"]
    assert np.linalg.norm(hips[0] - hips[1]) == pytest.approx(0.18)
    assert len(told) == 1  # no toes, so the feet have the usual length
    assert told[0].endswith("since nobody saw them: left foot, right foot")


def test_shoulders_are_as_far_apart_as_usual_if_one_of_them_was_never_seen(result, tmp_path):
    seen = {name: at for name, at in STANDING.items() if name != "shoulder_left"}
    (path,) = export(stick(result, **seen), tmp_path / "out.osim", warn=len)
    left, right = (place(model_of(path), f"torso_humerus_{side}") for side in "lr")
    assert left == pytest.approx(right * [1, 1, -1])
    assert 0.25 < right[2] - left[2] < 0.45


def test_the_soles_are_on_the_floor_while_the_person_stands(result, tmp_path):
    (path,) = export(stick(result, **STANDING), tmp_path / "out.osim", warn=len)
    model = model_of(path)
    foot = model.find(".//Body[@name='talus_r']")
    height = [foot.find(f".//{name}").text.split()[1] for name in ("translation", "radii")]
    assert float(height[0]) - float(height[1]) == pytest.approx(
        -STANDING["ankle_left"][2], abs=0.02
    )
    pelvis = model.find(".//Coordinate[@name='pelvis_ty']/default_value")
    assert 0.9 < float(pelvis.text) < 1.1


def test_the_torso_alone_carries_the_head(result, tmp_path):
    (path,) = export(stick(result, **STANDING), tmp_path / "out.osim", warn=len)
    shapes = {
        body.get("name"): [frame.get("name") for frame in body.iter("PhysicalOffsetFrame")]
        for body in model_of(path).iter("Body")
    }
    assert shapes.pop("torso") == ["torso_shape", "head_shape"]
    assert all(names == [f"{name}_shape"] for name, names in shapes.items())


def test_the_mass_is_shared(result, tmp_path):
    for mass, total in ((MASS, MASS), (None, 0.0)):
        (path,) = export(result, tmp_path / "out.osim", mass=mass, warn=len)
        masses = [float(body.find("mass").text) for body in model_of(path).iter("Body")]
        assert sum(masses) == pytest.approx(total, rel=1e-3)
    export(result, tmp_path / "out.mot", mass=MASS, warn=len)  # it has no use, and does no harm
    with pytest.raises(ConfigError, match="mass: should be 1 to 1000 kg, is 0"):
        export(result, tmp_path / "out.trc", mass=0)


def test_all_files_of_a_person_are_written_at_once_or_none(result, tmp_path):
    names = [tmp_path / f"walk{suffix}" for suffix in (".trc", ".osim", ".xml")]
    hipless = stick(result, **{name: at for name, at in STANDING.items() if "hip" not in name})
    with pytest.raises(ConfigError, match="the model needs both hips"):
        export(hipless, names)
    assert not [*tmp_path.iterdir()]
    assert export(result, names, warn=len) == names
    assert {*tmp_path.iterdir()} == {*names}


def test_the_setup_names_the_files_of_its_own_name(result, tmp_path):
    (path,) = export(result, tmp_path / "walk.xml")
    tool = ET.parse(path).getroot().find("InverseKinematicsTool")
    assert tool.find("model_file").text == "walk.osim"
    assert tool.find("marker_file").text == "walk.trc"
    assert {task.get("name") for task in tool.iter("IKMarkerTask")} < {*result.model.marker_names}
    (motion,) = result.motions.values()
    times = [float(number) for number in tool.find("time_range").text.split()]
    assert times == pytest.approx([motion.times[0], motion.times[-1]], abs=1e-6)


# -- with OpenSim itself ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def opensim(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("log"))  # OpenSim writes a log where it starts
        module = pytest.importorskip("opensim", reason="needs OpenSim: pip install opensim")
        module.Logger.setLevelString("Off")
        yield module


def posed(opensim, model, motion):
    """Marker name -> (T, 3) m, of a model posed by a MOT file."""
    state, table = model.initSystem(), opensim.TimeSeriesTable(str(motion))
    matrix, names = table.getMatrix().to_numpy(), list(table.getColumnLabels())
    coordinates = [model.getCoordinateSet().get(name) for name in names]
    markers = [model.getMarkerSet().get(k) for k in range(model.getMarkerSet().getSize())]
    places = {marker.getName(): [] for marker in markers}
    for row in matrix:
        for coordinate, value in zip(coordinates, row, strict=True):
            moves = coordinate.getName() in ("pelvis_tx", "pelvis_ty", "pelvis_tz")
            coordinate.setValue(state, value if moves else np.radians(value), False)
        model.realizePosition(state)
        for marker in markers:
            places[marker.getName()].append(marker.getLocationInGround(state).to_numpy())
    return {name: np.array(values) for name, values in places.items()}


def distances(opensim, result, folder):
    """Marker name -> median distance, mm, of the posed model from the person."""
    (motion,) = export(result.select(start=1.0, end=2.0), folder / "pose.mot", warn=len)
    (person,) = result.select(start=1.0, end=2.0).motions.values()
    (path,) = export(result, folder / "lab.osim", mass=MASS, warn=len)
    places = posed(opensim, opensim.Model(str(path)), motion)
    y_up = person.positions @ Y_UP.T
    slots = {name: k for k, name in enumerate(result.model.marker_names)}
    return {
        name: 1000 * np.median(np.linalg.norm(at - y_up[:, slots[name]], axis=-1))
        for name, at in places.items()
        if name in slots
    }


def test_opensim_puts_the_joints_where_the_person_has_them(opensim, result, tmp_path):
    far = distances(opensim, result, tmp_path)
    for joint, most in (("ANKLE", 25), ("KNEE", 20), ("WRIST", 25)):
        assert max(value for name, value in far.items() if joint in name) < most


@pytest.fixture(scope="module")
def bending(tmp_path_factory):
    """4 s, longer than OpenSim's own default range, of somebody who bends and straightens."""
    folder = tmp_path_factory.mktemp("bending")
    write_log(folder / "log.mcap", SimulateParams(action="bend", seconds=4, seed=5))
    process(folder / "log.mcap", folder / "log.hiros.mcap")
    return open_result(folder / "log.hiros.mcap").select(person=0, rate=30.0)


def columns(opensim, path):
    """(T,) s, and name -> (T,) of a MOT file."""
    table = opensim.TimeSeriesTable(str(path))
    names, values = table.getColumnLabels(), table.getMatrix().to_numpy().T
    return np.array(table.getIndependentColumn()), dict(zip(names, values, strict=True))


def without(result, part):
    """The same person without the markers whose names hold ``part``."""
    return renamed(result, {name: name for name in result.model.marker_names if part not in name})


@pytest.mark.parametrize("lacking", ["nothing", "SPINE"])
def test_inverse_kinematics_agrees_with_the_motion(
    opensim, bending, lacking, tmp_path, monkeypatch
):
    """Nobody sees the person for .7 s, and then the head alone."""
    monkeypatch.chdir(tmp_path)
    person = without(bending, lacking)
    (motion,) = person.motions.values()
    positions = motion.positions.copy()
    positions[40:60] = np.nan
    positions[60:66, [name != "HEAD" for name in person.model.marker_names]] = np.nan
    told = []
    paused = replace(person, motions={0: replace(motion, positions=positions)})
    for suffix in (".osim", ".trc", ".mot", ".xml"):
        export(paused, f"lab{suffix}", warn=told.append)
    assert sum("left out the rows in which no joint" in text for text in told) == 1
    assert opensim.InverseKinematicsTool("lab.xml").run()
    (times, solved), (all_times, moved) = (
        columns(opensim, "lab_ik.mot"),
        columns(opensim, "lab.mot"),
    )
    seen = np.delete(np.arange(len(positions)), np.s_[40:66])
    np.testing.assert_allclose(times, all_times[seen], atol=1e-5)
    for name in ("pelvis_tilt", "hip_flexion_l", "hip_flexion_r"):
        apart = np.abs(solved[name] - moved[name][seen])
        assert np.median(apart) < 3, name
        assert np.percentile(apart, 95) < 8, name
    places = posed(opensim, opensim.Model("lab.osim"), "lab_ik.mot")
    for name in ("HIP_LEFT", "KNEE_RIGHT", "SHOULDER_LEFT", "WRIST_RIGHT"):
        at = positions[seen, person.model.marker_names.index(name)] @ Y_UP.T
        assert 1000 * np.median(np.linalg.norm(places[name] - at, axis=-1)) < 15, name
