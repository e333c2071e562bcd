"""Joint angles: equation 21 and the ISB sequence, on rotations that are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hiros_mcap.body.angles import ANGLES, joint_links, link_angles, wrapped
from hiros_mcap.body.rotations import to_matrix
from hiros_mcap.body.segments import zxy
from hiros_mcap.simulate.body_model import MODEL
from hiros_mcap.skeletons import SkeletonModel


def test_known_rotations_are_recovered():
    rng = np.random.default_rng(0)
    angles = rng.uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (1000, 3))
    xyzw = Rotation.from_euler("ZXY", angles).as_quat()
    for same in (xyzw, -xyzw):
        found = np.stack(zxy(np.eye(3), to_matrix(same)), axis=-1)
        assert np.abs(found - angles).max() < 1e-9


def test_angles_wrap_at_half_a_turn():
    assert np.degrees(wrapped(np.radians([179.0 - -179.0, -358.0, 10.0, 180.0]))) == pytest.approx(
        [-2, 2, 10, -180]
    )


def test_exactly_eight_angles():
    joints = ("shoulder", "elbow", "hip", "knee")
    assert tuple(f"{side} {joint}" for side in ("left", "right") for joint in joints) == ANGLES


def test_the_links_of_the_joints():
    """Upper arm seen from the upper trunk, thigh from the pelvis, and so on."""
    markers = MODEL.marker_names
    ends = [
        (markers[MODEL.link_parents[k]], markers[MODEL.link_children[k]])
        for pair in joint_links(MODEL)
        for k in pair
    ]
    assert len(joint_links(MODEL)) == 8
    arm, forearm = ("SHOULDER_LEFT", "ELBOW_LEFT"), ("ELBOW_LEFT", "WRIST_LEFT")
    thigh, shin = ("HIP_LEFT", "KNEE_LEFT"), ("KNEE_LEFT", "ANKLE_LEFT")
    assert ends[1:4] == [arm, arm, forearm]
    assert ends[5:8] == [thigh, thigh, shin]
    assert ends[0] == ("SPINE_CHEST", "NECK")
    assert ends[4] == ("PELVIS", "SPINE_NAVAL")


def test_eq21_is_the_z_angle_of_the_distal_link_in_the_proximal_one():
    model = SkeletonModel.of(
        ["RShoulder", "RElbow", "RWrist"], [("upper arm", 0, 1), ("forearm", 1, 2)]
    )
    upper = Rotation.from_euler("xyz", [0.3, -1.0, 2.0])
    bend = Rotation.from_euler("ZXY", [1.2, 0.2, -0.4])
    turns = np.stack([upper.as_quat(), (upper * bend).as_quat()])
    angles = link_angles(model, turns)[:, 0]
    assert angles[ANGLES.index("right elbow")] == pytest.approx(1.2)
    assert np.isnan(np.delete(angles, ANGLES.index("right elbow"))).all()
