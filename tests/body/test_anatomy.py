"""Signed joint angles: poses whose angles are known by construction."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hiros_mcap.body.anatomy import ANGLE_NAMES, anatomical_angles
from hiros_mcap.simulate.body_model import MODEL, PARENT_SEGMENT, SEGMENTS, UPRIGHT, BodyModel
from hiros_mcap.skeletons import Floats

BODY = BodyModel.of(1.75)
SIGN = {"right": 1.0, "left": -1.0}
ARM_OFFSET = 1.2  # degrees by which the neck lies behind the pelvis, so that the trunk leans
SEQUENCE = np.linspace(0.0, 340.0, 35)


def posed(times: int = 1, **joints: tuple[float, float, float]) -> Floats:
    """(T, M, 3) a person with these ISB angles z x y, degrees, and all others 0."""
    rotations: dict[str, Floats] = {}
    for segment in SEGMENTS:
        part, _, side = segment.rpartition("_")
        if not part or side not in SIGN:
            part, side = segment, ""
        parent = PARENT_SEGMENT.get(part)
        base = UPRIGHT
        if parent is not None:
            base = rotations[parent if parent in rotations else f"{parent}_{side}"]
        turn = Rotation.from_euler("ZXY", joints.get(segment, (0, 0, 0)), degrees=True)
        rotations[segment] = base @ turn.as_matrix()
    stacked = np.stack([rotations[segment] for segment in SEGMENTS])[None]
    return np.repeat(BODY.markers(np.zeros((1, 3)), stacked), times, axis=0)


def degrees(name: str, **joints: tuple[float, float, float]) -> float:
    angles = np.degrees(anatomical_angles(MODEL, posed(**joints)))
    return float(angles[0, ANGLE_NAMES.index(name)])


@pytest.mark.parametrize("side", SIGN)
@pytest.mark.parametrize(
    ("angle", "segment", "isb", "expected"),
    [
        ("hip flexion", "thigh", (60, 0, 0), 60),
        ("hip flexion", "thigh", (-20, 0, 0), -20),
        ("hip abduction", "thigh", (0, -30, 0), 30),
        ("hip abduction", "thigh", (0, 15, 0), -15),
        ("knee flexion", "shank", (-120, 0, 0), 120),
        ("knee flexion", "shank", (8, 0, 0), -8),
        ("elbow flexion", "forearm", (90, 0, 0), 90),
        ("shoulder flexion", "upper_arm", (90, 0, 0), 90),
        ("shoulder flexion", "upper_arm", (-40, 0, 0), -40),
        ("shoulder abduction", "upper_arm", (0, -80, 0), 80),
        ("shoulder elevation", "upper_arm", (0, -80, 0), 80),
    ],
)
def test_limbs(
    side: str, angle: str, segment: str, isb: tuple[float, float, float], expected: float
) -> None:
    z, x, y = isb
    sign = SIGN[side]
    found = degrees(f"{side} {angle}", **{f"{segment}_{side}": (z, sign * x, sign * y)})
    assert found == pytest.approx(expected, abs=ARM_OFFSET if "shoulder" in angle else 0.5)


@pytest.mark.parametrize("side", SIGN)
def test_the_plane_of_elevation_tells_forwards_from_sideways(side: str) -> None:
    plane, arm = f"{side} shoulder plane", f"upper_arm_{side}"
    assert degrees(plane, **{arm: (90, 0, 0)}) == pytest.approx(90, abs=ARM_OFFSET)
    assert degrees(plane, **{arm: (0, -90 * SIGN[side], 0)}) == pytest.approx(0, abs=ARM_OFFSET)
    assert np.isnan(degrees(plane))


@pytest.mark.parametrize("side", SIGN)
def test_axial_rotation_shows_in_the_bent_joint_only(side: str) -> None:
    sign = SIGN[side]
    thigh = {f"thigh_{side}": (20.0, -10 * sign, 25 * sign)}
    arm = {f"upper_arm_{side}": (20.0, -10 * sign, 30 * sign)}
    assert np.isnan(degrees(f"{side} hip rotation", **thigh))
    assert np.isnan(degrees(f"{side} shoulder rotation", **arm))
    bent = degrees(f"{side} hip rotation", **thigh, **{f"shank_{side}": (-60.0, 0, 0)})
    assert bent == pytest.approx(25, abs=0.5)
    bent = degrees(f"{side} shoulder rotation", **arm, **{f"forearm_{side}": (90.0, 0, 0)})
    assert bent == pytest.approx(30, abs=ARM_OFFSET)


@pytest.mark.parametrize(
    ("angle", "segment", "isb", "expected"),
    [
        ("pelvis tilt", "pelvis", (-20, 0, 0), 20),
        ("pelvis obliquity", "pelvis", (0, 10, 0), 10),
        ("pelvis rotation", "pelvis", (0, 0, 70), 70),
        ("trunk rotation", "abdomen", (0, 0, 20), 20),
    ],
)
def test_pelvis_and_trunk(
    angle: str, segment: str, isb: tuple[float, float, float], expected: float
) -> None:
    assert degrees(angle, **{segment: isb}) == pytest.approx(expected, abs=0.5)


def test_bending_has_the_sign_of_its_side() -> None:
    assert degrees("trunk flexion", abdomen=(-30, 0, 0)) > degrees("trunk flexion") + 15
    assert degrees("trunk side bend", abdomen=(0, 20, 0)) > 10
    assert degrees("neck flexion", neck=(-20, 0, 0)) == pytest.approx(
        degrees("neck flexion") + 20, abs=0.5
    )
    assert degrees("neck side bend", neck=(0, 15, 0)) == pytest.approx(15, abs=0.5)


@pytest.mark.parametrize("side", SIGN)
def test_dorsiflexion_lifts_the_toes(side: str) -> None:
    neutral = degrees(f"{side} ankle dorsiflexion")
    lifted = degrees(f"{side} ankle dorsiflexion", **{f"foot_{side}": (20.0, 0, 0)})
    assert lifted - neutral == pytest.approx(20, abs=0.5)


def test_turning_on_the_spot_is_continued_over_180_degrees() -> None:
    poses = np.concatenate([posed(pelvis=(0, 0, y)) for y in SEQUENCE])
    column = ANGLE_NAMES.index("pelvis rotation")
    assert np.degrees(anatomical_angles(MODEL, poses))[:, column] == pytest.approx(SEQUENCE)
    jumping = np.degrees(anatomical_angles(MODEL, poses, unwrapped=False))[:, column]
    assert np.abs(np.diff(jumping)).max() > 300


def test_other_angles_do_not_depend_on_where_a_person_stands_and_looks() -> None:
    here = posed(thigh_left=(30, 10, 0), upper_arm_right=(50, -20, 0), shank_left=(-40, 0, 0))
    there = here @ Rotation.from_euler("z", 100, degrees=True).as_matrix().T + [3.0, -2.0, 0.5]
    columns = [k for k, name in enumerate(ANGLE_NAMES) if not name.startswith("pelvis")]
    a, b = anatomical_angles(MODEL, here), anatomical_angles(MODEL, there)
    np.testing.assert_allclose(a[:, columns], b[:, columns], atol=1e-9)


def test_a_missing_marker_spoils_its_own_angles_only() -> None:
    poses = posed(shank_left=(-60, 0, 0))
    poses[:, MODEL.marker_names.index("ANKLE_LEFT")] = np.nan
    angles = dict(zip(ANGLE_NAMES, anatomical_angles(MODEL, poses)[0], strict=True))
    assert np.isnan(angles["left knee flexion"])
    assert np.isnan(angles["left hip rotation"])
    assert np.isfinite([angles["left hip flexion"], angles["right knee flexion"]]).all()
