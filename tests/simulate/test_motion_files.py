"""Motion files: two bones worked out by hand, faults, and bodies that keep their limbs."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hiros_cli.app import run
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.truth_files import load_truth
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.simulate.body_model import MODEL, SLOT
from hiros_mcap.simulate.motion_files import euler, read_amc, read_asf, read_bvh
from hiros_mcap.simulate.performer import load_clip

ASF = """# two bones
:version 1.10
:units
  angle deg
:root
   order TX TY TZ RX RY RZ
   axis XYZ
:bonedata
  begin
     name upper
     direction 0 -1 0
     length 2
     axis 0 0 90 XYZ
     dof rx
  end
  begin
     name lower
     direction 0 -1 0
     length 1
     axis 0 0 0 XYZ
     dof rz
  end
:hierarchy
  begin
    root upper
    upper lower
  end
"""
AMC = """:FULLY-SPECIFIED
:DEGREES
1
root 1 2 3 0 0 0
upper 0
lower 0
2
root 0 0 0 0 0 90
upper 90
lower 90
"""


def bvh(frames=40):
    """A small person, y up, in centimetres, whose left arm swings and who walks along z."""
    joints = ["HIERARCHY", "ROOT Hips", "{", "OFFSET 0 0 0",
              "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"]  # fmt: skip

    def chain(names, offsets, end):
        for name, offset in zip(names, offsets, strict=True):
            joints.extend([f"JOINT {name}", "{", f"OFFSET {offset}",
                           "CHANNELS 3 Zrotation Xrotation Yrotation"])  # fmt: skip
        joints.extend(["End Site", "{", f"OFFSET {end}", "}"])
        joints.extend(["}"] * len(names))

    for side, x in (("Left", 10), ("Right", -10)):
        chain(
            [f"{side}UpLeg", f"{side}Leg", f"{side}Foot", f"{side}ToeBase"],
            [f"{x} 0 0", "0 -42 0", "0 -41 0", "0 -5 14"],
            "0 0 3",
        )
    chain(["Spine", "Neck", "Head"], ["0 15 0", "0 38 0", "0 10 0"], "0 10 0")
    for side, x in (("Left", 1), ("Right", -1)):
        chain(
            [f"{side}Arm", f"{side}ForeArm", f"{side}Hand"],
            [f"{18 * x} 48 0", "0 -28 0", "0 -25 0"],
            "0 -8 0",
        )
    joints.append("}")
    channels = 6 + 3 * 17
    rows = []
    for k in range(frames):
        row = [0.0] * channels
        row[1], row[2] = 95.0, 2.0 * k
        row[6 + 3 * 11 + 1] = -60 * np.sin(k / 6)  # LeftArm about x
        rows.append(" ".join(f"{v:.4f}" for v in row))
    return "\n".join([*joints, "MOTION", f"Frames: {frames}", "Frame Time: 0.0333333", *rows])


def write(folder, name, text):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_rotations_are_multiplied_in_the_order_of_the_letters():
    quarter = np.array([[np.pi / 2, np.pi / 2]])
    assert euler(quarter, "ZX").apply([0, 1, 0])[0] == pytest.approx([0, 0, 1])  # x first: y to z
    assert euler(quarter, "XZ").apply([0, 1, 0])[0] == pytest.approx([-1, 0, 0])  # z first: y to -x


def test_two_bones_of_an_asf_file_by_hand(tmp_path):
    """At rest both hang down; then the root turns by 90 degrees about z, and each bone bends.

    The upper bone's x axis is the global y (its axes are turned by 90 degrees about z), so it
    turns about itself, seen from the root; the lower one turns about its own z, which the
    upper's turn has laid along the room's axis. Files have y up, clips z.
    """
    skeleton = read_asf(write(tmp_path, "a.asf", ASF))
    clip = read_amc(write(tmp_path, "a.amc", AMC), skeleton)
    assert clip.frames == 2
    assert clip.joints["root"][0].tolist() == [1, -3, 2]
    assert clip.joints["upper"][0] == pytest.approx([1, -3, 0])
    assert clip.joints["lower"][0] == pytest.approx([1, -3, -1])
    turn = euler(np.array([[np.pi / 2]]), "Z").as_matrix()[0]
    about_y = euler(np.array([[np.pi / 2]]), "Y").as_matrix()[0]
    upper = turn @ about_y
    first = upper @ [0, -2, 0]
    second = first + upper @ turn @ [0, -1, 0]
    assert clip.joints["upper"][1] == pytest.approx([first[0], -first[2], first[1]])
    assert clip.joints["lower"][1] == pytest.approx([second[0], -second[2], second[1]])


def test_a_bvh_file_by_hand(tmp_path):
    clip = read_bvh(write(tmp_path, "a.bvh", bvh()))
    assert clip.rate == pytest.approx(30, abs=0.01)
    assert clip.joints["Hips"][3] == pytest.approx([0, -6, 95])
    assert clip.joints["LeftLeg"][3] == pytest.approx([10, -6, 53])
    bend = np.radians(-60 * np.sin(9 / 6))
    elbow = [18, -18 - 28 * np.sin(-bend) * -1, 95 + 48 - 28 * np.cos(bend)]
    assert clip.joints["LeftForeArm"][9][[0, 2]] == pytest.approx([elbow[0], elbow[2]])
    arm = clip.joints["LeftForeArm"] - clip.joints["LeftArm"]
    assert np.linalg.norm(arm, axis=1) == pytest.approx(28)


def test_the_body_repeats_the_motion_with_its_own_constant_limbs(tmp_path):
    path = write(tmp_path, "a.bvh", bvh())
    params = SimulateParams(motion=(str(path),), seconds=4.0, seed=3)
    simulation = simulate(params)
    (person,) = simulation.people
    poses, rotations = person.pose(np.arange(0, 4, 0.05))
    lengths = np.linalg.norm(poses[:, MODEL.links[:, 0]] - poses[:, MODEL.links[:, 1]], axis=-1)
    assert np.ptp(lengths, axis=0).max() < 1e-12
    assert np.abs(np.linalg.det(rotations) - 1).max() < 1e-9
    feet = poses[:, [SLOT["FOOT_LEFT"], SLOT["FOOT_RIGHT"]], 2]
    assert 0 <= feet.min() < 0.1
    assert np.ptp(poses[:, SLOT["WRIST_LEFT"], 2]) > 0.1  # the arm that swings
    assert np.ptp(poses[:, SLOT["WRIST_RIGHT"], 2]) < 0.02
    heads = poses[:, SLOT["HEAD"], 2]
    assert 1.3 < heads.min() <= heads.max() < 2.0
    ahead = rotations[:, 0, :, 0]  # the pelvis' x is forward: the way that the person walks
    path_ = np.diff(poses[:20, 0], axis=0)
    assert (np.einsum("ij,ij->i", ahead[:19], path_) > 0).all()


@pytest.mark.parametrize("name", [r"\1\2", r"\1_\2", r"\2\1", r"\2.\1"])
@pytest.mark.parametrize("sides", [("Left", "Right"), ("l", "r")])
def test_the_side_may_stand_before_or_behind_a_joints_name(name, sides, tmp_path):
    text = re.sub(r"\b(Left|Right)(\w+)", name, bvh(3))
    for side, ours in zip(("Left", "Right"), sides, strict=True):
        text = text.replace(side, ours)
    files = [write(tmp_path, "a.bvh", bvh(3)), write(tmp_path, "b.bvh", text)]
    people = [simulate(SimulateParams(motion=(str(path),))).people[0] for path in files]
    np.testing.assert_array_equal(*(who.pose(np.arange(2) / 30)[0] for who in people))


def test_it_goes_forth_and_back_without_a_jump(tmp_path):
    path = write(tmp_path, "a.bvh", bvh(30))
    (person,) = simulate(SimulateParams(motion=(str(path),), seconds=5.0)).people
    poses, _ = person.pose(np.arange(0, 5, 0.01))
    assert np.linalg.norm(np.diff(poses, axis=0), axis=-1).max() < 0.06
    again, _ = person.pose(np.arange(0, 5, 0.01) + 2 * 29 / 30 * 1.0000001)
    assert np.abs(again[:100] - poses[:100]).max() < 0.01


def test_several_people_keep_apart_and_the_seed_decides(tmp_path):
    path = write(tmp_path, "a.bvh", bvh())
    params = SimulateParams(motion=(str(path),), people=4, seconds=4.0, seed=1)
    times = np.arange(0, 4, 0.1)
    paths = [person.pose(times)[0][:, 0, :2] for person in simulate(params).people]
    for i in range(4):
        for j in range(i):
            assert np.linalg.norm(paths[i] - paths[j], axis=1).min() > 0.5
    again = [person.pose(times)[0][:, 0, :2] for person in simulate(params).people]
    assert all((a == b).all() for a, b in zip(paths, again, strict=True))


def test_from_outside(tmp_path, capsys):
    path, out = write(tmp_path, "a.bvh", bvh()), tmp_path / "out.mcap"
    files = ["--motion", str(path), "--motion", str(path)]
    assert run(["simulate", str(out), *files, "--seconds", "2", "--cameras", "2"]) == 0
    assert load_truth(out).people == (0, 1)
    capsys.readouterr()
    assert run(["simulate", str(out), "--motion", str(tmp_path / "none.bvh")]) == 2
    assert "none.bvh" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("a.bvh", "hello", "no joints"),
        ("a.bvh", bvh().replace("0 -42 0", "0 deep 0"), r"line \d+: cannot be read"),
        ("a.bvh", bvh().replace("Frame Time: 0.0333333", "Frame Time: 0"), "no motion"),
        ("a.bvh", bvh().replace("Xposition", "Wposition", 1), r"line \d+: cannot be read"),
        ("a.bvh", bvh().rsplit(" ", 1)[0], "frame 40: 56 numbers instead of 57"),
        ("a.bvh", bvh().replace("LeftLeg", "LeftThing"), "has no left knee"),
        ("a.fbx", "x", "ends in .amc or .bvh"),
        ("a.amc", AMC, "needs its skeleton"),
    ],
)
def test_faulty_files(tmp_path, name, text, fault):
    path = write(tmp_path, name, text)
    with pytest.raises(ConfigError, match=fault) as caught:
        simulate(SimulateParams(motion=(str(path),))).people  # noqa: B018 - computed here
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("asf", "amc", "fault"),
    [
        (ASF.replace("length 2", "length long"), AMC, r"a\.asf: line 15"),
        (ASF.replace("TX", "TW"), AMC, r"a\.asf: line \d+"),
        (ASF.replace("root upper", "root other"), AMC, "unknown bone: other"),
        (ASF.replace("root upper", "lower upper"), AMC, "loop"),
        ("nothing", AMC, "no bones"),
        (ASF, AMC.replace("lower 90", "lowest 90"), r"a\.amc: line 10: the skeleton has no bone"),
        (ASF, AMC.replace("lower 90", "lower x"), r"a\.amc: line 10: not numbers"),
        (ASF, AMC.replace("lower 90\n", ""), "frame 2: lower needs 1 numbers"),
        (ASF, "1\nroot 0 0 0 0 0 0\n", "it has 1 frames"),
    ],
)
def test_faulty_acclaim_files(tmp_path, asf, amc, fault):
    skeleton, motion = write(tmp_path, "a.asf", asf), write(tmp_path, "a.amc", amc)
    with pytest.raises(ConfigError, match=fault):
        load_clip(motion, skeleton)


@settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(kind=st.sampled_from(["bvh", "asf", "amc"]), at=st.floats(0, 1), text=st.text(max_size=12))
def test_a_damaged_file_is_read_or_named(tmp_path, kind, at, text):
    """Whatever is written into the middle of a file: a clip, or an error that names the file."""
    texts = {"bvh": bvh(4), "asf": ASF, "amc": AMC}
    where = round(at * len(texts[kind]))
    texts[kind] = texts[kind][:where] + text + texts[kind][where + len(text) :]
    paths = {name: write(tmp_path, f"a.{name}", content) for name, content in texts.items()}
    motion = paths["bvh" if kind == "bvh" else "amc"]
    try:
        assert load_clip(motion, paths["asf"]).frames >= 2
    except ConfigError as error:
        assert str(tmp_path) in str(error)


@given(st.lists(st.floats(-9, 9), min_size=1, max_size=4), st.text("XYZ", min_size=4, max_size=4))
@settings(deadline=None)
def test_euler_angles_of_any_axes(angles, axes):
    axes = axes[: len(angles)]
    expected = np.eye(3)
    for angle, axis in zip(angles, axes, strict=True):
        expected = expected @ Rotation.from_rotvec(angle * np.eye(3)["XYZ".index(axis)]).as_matrix()
    assert euler(np.array([angles]), axes).as_matrix()[0] == pytest.approx(expected, abs=1e-9)
