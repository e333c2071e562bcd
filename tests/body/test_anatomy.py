"""Signed joint angles: poses whose angles are known by construction."""

from __future__ import annotations

import numpy as np
import pytest
from poses import SIGN, links, posed
from scipy.signal import find_peaks
from scipy.spatial.transform import Rotation

from hiros_mcap.body.anatomy import ANGLE_NAMES, anatomical_angles, continued
from hiros_mcap.body.segments import link_axes
from hiros_mcap.simulate.body_model import MODEL

SEQUENCE = np.linspace(0.0, 340.0, 35)


def degrees(name, **joints):
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
def test_limbs(side, angle, segment, isb, expected):
    z, x, y = isb
    sign = SIGN[side]
    found = degrees(f"{side} {angle}", **{f"{segment}_{side}": (z, sign * x, sign * y)})
    # The body's neck lies behind its pelvis: its trunk leans, which a hanging arm shows, too.
    lean = degrees(f"{side} {angle}") if angle == "shoulder flexion" else 0.0
    assert abs(lean) < 1.5
    assert found - lean == pytest.approx(expected, abs=0.5)


@pytest.mark.parametrize("side", SIGN)
def test_the_plane_of_elevation_tells_forwards_from_sideways(side):
    plane, arm = f"{side} shoulder plane", f"upper_arm_{side}"
    assert degrees(plane, **{arm: (90, 0, 0)}) == pytest.approx(90, abs=1)
    assert degrees(plane, **{arm: (0, -90 * SIGN[side], 0)}) == pytest.approx(0, abs=1)
    assert np.isnan(degrees(plane))


@pytest.mark.parametrize("side", SIGN)
def test_axial_rotation_shows_in_the_bent_joint_only(side):
    sign = SIGN[side]
    thigh = {f"thigh_{side}": (20.0, -10 * sign, 25 * sign)}
    arm = {f"upper_arm_{side}": (20.0, -10 * sign, 30 * sign)}
    assert np.isnan(degrees(f"{side} hip rotation", **thigh))
    assert np.isnan(degrees(f"{side} shoulder rotation", **arm))
    bent = degrees(f"{side} hip rotation", **thigh, **{f"shank_{side}": (-60.0, 0, 0)})
    assert bent == pytest.approx(25, abs=0.5)
    bent = degrees(f"{side} shoulder rotation", **arm, **{f"forearm_{side}": (90.0, 0, 0)})
    assert bent == pytest.approx(30, abs=1)


@pytest.mark.parametrize(
    ("angle", "segment", "isb", "expected"),
    [
        ("pelvis tilt", "pelvis", (-20, 0, 0), 20),
        ("pelvis obliquity", "pelvis", (0, 10, 0), 10),
        ("pelvis rotation", "pelvis", (0, 0, 70), 70),
        ("trunk rotation", "abdomen", (0, 0, 20), 20),
    ],
)
def test_pelvis_and_trunk(angle, segment, isb, expected):
    assert degrees(angle, **{segment: isb}) == pytest.approx(expected, abs=0.5)


def test_bending_has_the_sign_of_its_side():
    assert degrees("trunk flexion", abdomen=(-30, 0, 0)) > degrees("trunk flexion") + 15
    assert degrees("trunk side bend", abdomen=(0, 20, 0)) > 10
    assert degrees("neck flexion", neck=(-20, 0, 0)) == pytest.approx(
        degrees("neck flexion") + 20, abs=0.5
    )
    assert degrees("neck side bend", neck=(0, 15, 0)) == pytest.approx(15, abs=0.5)


@pytest.mark.parametrize("side", SIGN)
def test_dorsiflexion_lifts_the_toes(side):
    neutral = degrees(f"{side} ankle dorsiflexion")
    lifted = degrees(f"{side} ankle dorsiflexion", **{f"foot_{side}": (20.0, 0, 0)})
    assert lifted - neutral == pytest.approx(20, abs=0.5)


def test_turning_on_the_spot_is_continued_over_180_degrees():
    poses = np.concatenate([posed(pelvis=(0, 0, y)) for y in SEQUENCE])
    column = ANGLE_NAMES.index("pelvis rotation")
    assert np.degrees(anatomical_angles(MODEL, poses))[:, column] == pytest.approx(SEQUENCE)
    jumping = np.degrees(anatomical_angles(MODEL, poses, unwrapped=False))[:, column]
    assert np.abs(np.diff(jumping)).max() > 300


def test_a_distorted_skeleton_leaves_no_turn_behind():
    """By the shortest way, 10 -> 150 -> -100 -> 10 would end at 370 degrees."""
    distorted = np.radians([[8.0], [10.0], [150.0], [-100.0], [10.0], [np.nan], [12.0]])
    assert np.degrees(continued(distorted)).ravel() == pytest.approx(
        [8, 10, 150, -100, 10, np.nan, 12], nan_ok=True
    )
    lifted = np.radians([[170.0], [-170.0], [np.nan], [-165.0], [175.0]])
    expected = [170, 190, np.nan, 195, 175]
    for cut in range(5):
        first = continued(lifted[:cut])
        before = first[~np.isnan(first)][-1:] if cut else None
        whole = np.concatenate([first, continued(lifted[cut:], before)])
        assert np.degrees(whole).ravel() == pytest.approx(expected, nan_ok=True)
    assert continued(np.full((3, 2), np.nan)).shape == (3, 2)


def test_a_limb_does_not_go_round():
    """It seems to, step by step, where a skeleton is distorted; a person may turn for real."""
    spinning = (np.radians(np.arange(0.0, 800.0, 40.0)) + np.pi) % (2 * np.pi) - np.pi
    both = np.degrees(continued(np.stack([spinning, spinning], 1), most=np.array([4.7, np.inf])))
    assert np.abs(both[:, 0]).max() < 270
    np.testing.assert_allclose(both[:, 1], np.arange(0.0, 800.0, 40.0))
    np.testing.assert_allclose(np.cos(np.radians(both[:, 0])), np.cos(spinning), atol=1e-9)


def test_other_angles_do_not_depend_on_where_a_person_stands_and_looks():
    here = posed(thigh_left=(30, 10, 0), upper_arm_right=(50, -20, 0), shank_left=(-40, 0, 0))
    there = here @ Rotation.from_euler("z", 100, degrees=True).as_matrix().T + [3.0, -2.0, 0.5]
    columns = [k for k, name in enumerate(ANGLE_NAMES) if not name.startswith("pelvis")]
    a, b = anatomical_angles(MODEL, here), anatomical_angles(MODEL, there)
    np.testing.assert_allclose(a[:, columns], b[:, columns], atol=1e-9)


def test_a_missing_marker_spoils_its_own_angles_only():
    poses = posed(shank_left=(-60, 0, 0))
    poses[:, MODEL.marker_names.index("ANKLE_LEFT")] = np.nan
    angles = dict(zip(ANGLE_NAMES, anatomical_angles(MODEL, poses)[0], strict=True))
    assert np.isnan(angles["left knee flexion"])
    assert np.isnan(angles["left hip rotation"])
    assert np.isfinite([angles["left hip flexion"], angles["right knee flexion"]]).all()


# -- link orientations -----------------------------------------------------------------------------

CONVENTION = (70.0, -20.0, 130.0)
"""Of a detector whose link axes nobody documented."""


def moving(*convention):
    """Somebody who bends elbow and knee, then keeps them straight while the limbs turn."""
    poses, turns = [], []
    for k in range(60):
        bend = max(0.0, 80.0 - 2.0 * k)
        joints = {
            "thigh_right": (20.0, -5.0, 25.0), "thigh_left": (20.0, 5.0, -25.0),
            "upper_arm_right": (30.0, -10.0, 0.5 * k), "upper_arm_left": (30.0, 10.0, -0.5 * k),
            "forearm_right": (bend, 0.0, 40.0), "forearm_left": (bend, 0.0, -40.0),
            "shank_right": (-bend, 0.0, 0.0), "shank_left": (-bend, 0.0, 0.0),
        }  # fmt: skip
        poses.append(posed(**joints))
        turns.append(links(*convention, **joints))
    return np.concatenate(poses), np.concatenate(turns)


@pytest.mark.parametrize("convention", [(0.0, 0.0, 0.0), CONVENTION])
@pytest.mark.parametrize("side", SIGN)
def test_links_show_the_rotation_of_straight_limbs(side, convention):
    poses, turns = moving(*convention)
    angles = dict(
        zip(ANGLE_NAMES, np.degrees(anatomical_angles(MODEL, poses, turns)).T, strict=True)
    )
    by_markers = np.degrees(anatomical_angles(MODEL, poses))
    straight = slice(40, 60)
    assert np.isnan(by_markers[straight, ANGLE_NAMES.index(f"{side} shoulder rotation")]).all()
    found = angles[f"{side} shoulder rotation"][straight]
    np.testing.assert_allclose(found, 0.5 * np.arange(40, 60), atol=1)
    np.testing.assert_allclose(angles[f"{side} hip rotation"][straight], 25, atol=0.5)
    np.testing.assert_allclose(angles[f"{side} elbow pronation"], 40, atol=1)
    np.testing.assert_allclose(
        angles[f"{side} elbow flexion"][:20], 80 - 2.0 * np.arange(20), atol=1
    )


def test_links_that_do_not_turn_with_their_segments_are_not_used():
    poses, _ = moving()
    turned = poses @ Rotation.from_euler("z", 90, degrees=True).as_matrix().T
    both = np.concatenate([poses, turned])
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(both), MODEL.n_links, 1))
    assert link_axes(MODEL, both, still) == {}
    with_links = anatomical_angles(MODEL, both, still)
    np.testing.assert_array_equal(with_links, anatomical_angles(MODEL, both))


def test_a_moment_does_not_tell_the_axes_of_links():
    poses, turns = moving()
    assert link_axes(MODEL, poses[:10], turns[:10]) == {}
    assert len(link_axes(MODEL, poses, turns)) == 11


# -- walking ---------------------------------------------------------------------------------------

STRIDE = np.arange(120) / 40.0
"""Three strides."""


def textbook(stride):
    """Flexion of hip and knee, degrees, over strides that begin with the heel's contact.

    Level walking as in Perry and Burnfield (2010), chapters 5 and 6: the hip goes from 25 to -15
    and back; the knee bends by 15 under load and by 60 in swing.
    """
    phase = 2 * np.pi * stride
    hip = 5 + 20 * np.cos(phase - 0.1)
    loaded, swung = (((stride % 1 - at) / width) ** 2 for at, width in ((0.14, 0.06), (0.72, 0.1)))
    knee = 2 + 13 * np.exp(-loaded) + 58 * np.exp(-swung)
    return hip, knee


@pytest.fixture(scope="module")
def gait():
    """Angles, degrees, of somebody who walks by the textbook, from markers alone."""
    flexed = {"right": textbook(STRIDE), "left": textbook(STRIDE + 0.5)}
    poses = []
    for k in range(len(STRIDE)):
        thighs = {f"thigh_{side}": (hip[k], 0.0, 0.0) for side, (hip, _) in flexed.items()}
        shanks = {f"shank_{side}": (-knee[k], 0.0, 0.0) for side, (_, knee) in flexed.items()}
        poses.append(posed(**thighs, **shanks))
    angles = np.degrees(anatomical_angles(MODEL, np.concatenate(poses)))
    return dict(zip(ANGLE_NAMES, angles.T, strict=True))


@pytest.mark.parametrize("side", SIGN)
def test_walking_has_the_textbook_shape(side, gait):
    hip, knee = textbook(STRIDE + 0.5 * (side == "left"))
    np.testing.assert_allclose(gait[f"{side} hip flexion"], hip, atol=0.5)
    np.testing.assert_allclose(gait[f"{side} knee flexion"], knee, atol=0.5)


@pytest.mark.parametrize("side", SIGN)
def test_a_hip_has_one_peak_a_stride_and_a_knee_two(side, gait):
    hip, knee = gait[f"{side} hip flexion"], gait[f"{side} knee flexion"]
    two = slice(8, 88)  # strides that begin and end between the hip's peaks
    assert len(find_peaks(hip[two], prominence=5)[0]) == 2
    assert len(find_peaks(-hip[two], prominence=5)[0]) == 2
    heights = knee[find_peaks(knee, prominence=5)[0]]
    assert sorted(heights) == pytest.approx([15] * 3 + [60] * 3, abs=1.5)
    assert hip.min() == pytest.approx(-15, abs=0.5)
