"""Files for OpenSim: the model stands as the person did, and files with gaps load."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rajagopal_chain import joints, read_mot
from scipy.spatial.transform import Rotation

from hiros_mcap.body.rotations import Y_UP
from hiros_mcap.body.segments import finder
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.export.files import export
from hiros_mcap.io.result import Motion, open_result
from hiros_mcap.running.pipeline import process
from hiros_mcap.skeletons import SkeletonModel

LIMBS = (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
STRAIGHTEST_DEG = 13
"""The model's arm has a carrying angle: its upper arm and forearm are never in line."""


@pytest.fixture(scope="module")
def result(crossing, tmp_path_factory):
    out = tmp_path_factory.mktemp("opensim") / "crossing.hiros.mcap"
    process(crossing, out)
    return open_result(out).select(person=0, rate=30.0)


def turned(result, degrees, about="z"):
    """The same person, who walks another way or lies."""
    rotation = Rotation.from_euler(about, degrees, degrees=True).as_matrix()
    motions = {
        person: replace(motion, positions=motion.positions @ rotation.T, orientations=None)
        for person, motion in result.motions.items()
    }
    return replace(result, motions=motions)


def errors(result, folder):
    """(T,) degrees between each bone of the posed model and of the person; "hips" in mm."""
    (path,) = export(result, folder / "pose.mot", warn=lambda text: None)
    model = joints(read_mot(path))
    (motion,) = result.motions.values()
    at = finder(result.model, motion.positions @ Y_UP.T)

    def middle(part):
        ours = at(part, side="left") + at(part, side="right")
        return (model[f"{part}_l"] + model[f"{part}_r"]) / 2, ours / 2

    (model_hips, hips), (model_shoulders, shoulders) = middle("hip"), middle("shoulder")
    found = {
        "hips": 1000 * np.linalg.norm(model_hips - hips, axis=-1),
        "trunk": degrees_between(model_shoulders - model_hips, shoulders - hips),
    }
    for side in ("left", "right"):
        across = at("hip", side=side) - hips
        found[f"{side} pelvis"] = degrees_between(model[f"hip_{side[0]}"] - model_hips, across)
        for limb in LIMBS:
            own = [at(part, side=side) for part in limb]
            theirs = [model[f"{part}_{side[0]}"] for part in limb]
            for k in range(2):
                deviation = degrees_between(theirs[k + 1] - theirs[k], own[k + 1] - own[k])
                found[f"{side} {limb[k]}"] = deviation
            bend = degrees_between(own[1] - own[0], own[2] - own[1])
            if limb[1] == "elbow":
                found[f"{side} elbow"][bend < STRAIGHTEST_DEG] = 0
    return found


def degrees_between(u, v):
    cross = np.linalg.norm(np.cross(u, v), axis=-1)
    return np.degrees(np.arctan2(cross, np.sum(u * v, axis=-1)))


@pytest.mark.parametrize("degrees", [0, 50, 90, 135, 180, 250, 310])
def test_the_model_stands_as_the_person_whatever_way_they_face(degrees, result, tmp_path):
    found = errors(turned(result, degrees), tmp_path)
    assert max(values.max() for values in found.values()) < 3
    assert found["hips"].max() < 0.01
    assert max(found[f"{side} hip"].max() for side in ("left", "right")) < 0.1


@pytest.mark.parametrize(("degrees", "about"), [(85, "y"), (-80, "y"), (80, "x"), (30, "x")])
def test_the_model_lies_as_the_person(degrees, about, result, tmp_path):
    found = errors(turned(result, degrees, about), tmp_path)
    assert max(values.max() for values in found.values()) < 3


def stick(result, **joints):
    """A person who holds still: x forwards, y to the left, z up, m."""
    model = SkeletonModel.of(joints, ())
    positions = np.repeat(np.array([[*joints.values()]]), 30, axis=0)
    motion = Motion(0, np.arange(30) / 30, positions, np.ones(positions.shape[:2]))
    return replace(result, model=model, motions={0: motion})


STANDING = {
    "pelvis": (0.0, 0.0, 1.0), "neck": (0.0, 0.0, 1.5),
    "shoulder_left": (0.0, 0.18, 1.45), "shoulder_right": (0.0, -0.18, 1.45),
    "elbow_left": (0.0, 0.2, 1.15), "elbow_right": (0.0, -0.2, 1.15),
    "wrist_left": (0.12, 0.2, 0.92), "wrist_right": (0.12, -0.2, 0.92),
    "hip_left": (0.0, 0.09, 0.92), "hip_right": (0.0, -0.09, 0.92),
    "knee_left": (0.03, 0.09, 0.5), "knee_right": (0.03, -0.09, 0.5),
    "ankle_left": (-0.02, 0.09, 0.1), "ankle_right": (-0.02, -0.09, 0.1),
}  # fmt: skip


def test_raised_bent_and_crossed_limbs(result, tmp_path):
    poses = {
        "arm up sideways": {"elbow_left": (0, 0.3, 1.72), "wrist_left": (0.05, 0.2, 1.95)},
        "arm up forwards": {"elbow_left": (0.1, 0.2, 1.73), "wrist_left": (0.2, 0.2, 1.95)},
        "hand behind the back": {"elbow_left": (-0.1, 0.2, 1.17), "wrist_left": (-0.2, 0, 1.1)},
        "sitting": {"knee_left": (0.42, 0.12, 0.92), "ankle_left": (0.45, 0.12, 0.5)},
        "leg crossed": {"knee_left": (0.4, 0.0, 0.95), "ankle_left": (0.5, -0.2, 0.6)},
    }
    for name, joints_ in poses.items():
        found = errors(stick(result, **(STANDING | joints_)), tmp_path)
        worst = {bone: values.max() for bone, values in found.items() if values.max() >= 3}
        assert not worst, name


def test_a_person_who_stands_straight_has_the_angles_of_standing(result, tmp_path):
    """A detector that bends a knee backwards a little does not turn the leg round."""
    backwards = {"ankle_left": (0.08, 0.09, 0.1), "ankle_right": (0.08, -0.09, 0.1)}
    (path,) = export(stick(result, **(STANDING | backwards)), tmp_path / "out.mot", warn=len)
    pose = read_mot(path).iloc[0]
    for coordinate in ("pelvis_list", "pelvis_rotation", "hip_rotation_l", "hip_rotation_r"):
        assert abs(pose[coordinate]) < 5
    assert pose["knee_angle_l"] == pytest.approx(0, abs=1)
    assert "ankle_angle_l" not in pose  # there are no toes


def test_a_knee_that_bends_backwards_is_counted_and_measured(result, tmp_path):
    """The right knee does so in 9 frames by 40 degrees, the left one in one frame of hundred."""
    bent = {"knee_right": (-0.2, -0.09, 0.5), "ankle_right": (0.2, -0.09, 0.1)}
    good, bad = stick(result, **STANDING), stick(result, **(STANDING | bent))
    (motion,), (wrong,) = good.motions.values(), bad.motions.values()
    positions = np.repeat(motion.positions[:1], 100, axis=0)
    positions[20:29] = wrong.positions[0]
    times, confidences = np.arange(100) / 30, np.ones(positions.shape[:2])
    moving = replace(motion, times=times, positions=positions, confidences=confidences)
    texts: list[str] = []
    both = replace(good, motions={motion.person: moving})
    (path,) = export(both, tmp_path / "out.mot", warn=texts.append)
    (text,) = [text for text in texts if "bend as the model's cannot" in text]
    model, at = joints(read_mot(path)), finder(good.model, positions @ Y_UP.T)
    shank = at("ankle", side="right") - at("knee", side="right")
    apart = degrees_between(model["ankle_r"] - model["knee_r"], shank)
    median, most = np.median(apart[20:29]), apart.max()
    assert median > 30
    bone = f"the right shank in 9 of 100 frames, by {median:.0f} degrees in the median and at most "
    assert f"{bone}{most:.0f}" in text
    assert "left shank" not in text


def test_coordinates_that_nothing_shows_are_left_out_and_named(result, tmp_path):
    armless = {name: at for name, at in STANDING.items() if "wrist" not in name}
    with pytest.warns(match="need shoulder, elbow and wrist"):
        (path,) = export(stick(result, **armless), tmp_path / "out.mot")
    table = read_mot(path)
    assert not {"arm_flex_l", "elbow_flex_r", "ankle_angle_l"} & {*table}
    assert {"hip_flexion_l", "lumbar_bending"} <= {*table}


def test_no_pelvis_no_motion(result, tmp_path):
    hipless = {name: at for name, at in STANDING.items() if "hip" not in name}
    with pytest.raises(ConfigError, match=r"pelvis_tilt.*need both hips"):
        export(stick(result, **hipless), tmp_path / "out.mot")
    assert not (tmp_path / "out.mot").exists()


def with_gap(result):
    """Nobody sees the person from .7 to 1.3 s."""
    (motion,) = result.motions.values()
    positions = motion.positions.copy()
    positions[20:40] = np.nan
    return replace(result, motions={0: replace(motion, positions=positions)})


def test_rows_without_a_pelvis_are_left_out_and_limbs_are_bridged(result, tmp_path):
    person = with_gap(result)
    (motion,) = person.motions.values()
    motion.positions[45:50, person.model.marker_names.index("ELBOW_LEFT")] = np.nan
    told = []
    (path,) = export(person, tmp_path / "out.mot", warn=told.append)
    table = read_mot(path)
    assert len(table) == len(motion.times) - 20
    assert not table.isna().any().any()
    np.testing.assert_allclose(np.diff(table["elbow_flex_l"][24:31], n=2), 0, atol=1e-5)
    spans = [f"{motion.times[a]:.1f} to {motion.times[b]:.1f} s" for a, b in ((19, 40), (44, 50))]
    limb = "arm_flex_l, arm_add_l, arm_rot_l, elbow_flex_l"
    assert [text for text in told if "bend" not in text] == [
        f"{path}: left out the rows without a pelvis: {spans[0]}",
        f"{path}: bridged {limb}: {spans[1]}",
    ]


def test_every_row_of_a_trc_file_has_all_its_cells(result, tmp_path):
    """OpenSim counts tabs: a row whose last marker is missing must not end before it.

    Its inverse kinematics stops at a row without markers, so there is none.
    """
    (motion,) = result.motions.values()
    positions = motion.positions.copy()
    positions[5, -1] = positions[6, 3] = positions[7] = np.nan
    told = []
    gaps = replace(result, motions={0: replace(motion, positions=positions)})
    (path,) = export(gaps, tmp_path / "with gaps.trc", warn=told.append)
    lines = path.read_text().splitlines()
    assert lines[0].split("\t")[3:] == ["with gaps.trc", "written by hiros"]
    assert lines[2].split("\t")[2] == str(len(positions) - 1)
    rows = [line.split("\t") for line in lines[6:]]
    assert {len(row) for row in rows} == {2 + 3 * result.model.n_markers + 1}
    assert rows[5][-4:] == [""] * 4
    assert "" not in rows[4][:-1]
    times = [float(row[1]) for row in rows]
    np.testing.assert_allclose(times, np.delete(motion.times, 7), atol=1e-6)
    assert [row[0] for row in rows[5:9]] == ["6", "7", "9", "10"]
    assert "no joint of OpenSim's model is seen: " in told[0]
