"""Joints that bend as no body does, by hand: somebody who faces along x."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stick_figures import at

from hiros_mcap.events import Events
from hiros_mcap.frames import Block, join
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.stages.detections.hidden import POSTURE, mend_hidden_blocks

PLACES = {
    "SpineBase": (0.0, 0.0, 1.0), "SpineMid": (0.0, 0.0, 1.3), "Neck": (0.0, 0.0, 1.5),
    "Head": (0.0, 0.0, 1.7),
    "ShoulderLeft": (0.0, 0.2, 1.45), "ElbowLeft": (0.0, 0.2, 1.15), "WristLeft": (0.0, 0.2, 0.9),
    "ShoulderRight": (0.0, -0.2, 1.45), "ElbowRight": (0.0, -0.2, 1.15),
    "WristRight": (0.0, -0.2, 0.9),
    "HipLeft": (0.0, 0.1, 0.95), "KneeLeft": (0.0, 0.1, 0.5), "AnkleLeft": (0.0, 0.1, 0.1),
    "HipRight": (0.0, -0.1, 0.95), "KneeRight": (0.0, -0.1, 0.5), "AnkleRight": (0.0, -0.1, 0.1),
}  # fmt: skip
NAMES = list(PLACES)
CHAINS = (
    ("SpineBase", "SpineMid", "Neck", "Head"),
    *(
        (trunk, *(f"{name}{side}" for name in limb))
        for side in ("Left", "Right")
        for trunk, limb in (
            ("Neck", ("Shoulder", "Elbow", "Wrist")),
            ("SpineBase", ("Hip", "Knee", "Ankle")),
        )
    ),
)
MODEL = SkeletonModel.of(
    NAMES,
    [(b, NAMES.index(a), NAMES.index(b)) for chain in CHAINS for a, b in itertools.pairwise(chain)],
)


def bent(joint, degrees, *limb, axis="y"):
    """Markers of somebody whose limb, which begins at a joint, swings forwards and up."""
    pose = np.array(list(PLACES.values()))
    centre, rows = PLACES[joint], [NAMES.index(name) for name in limb]
    turn = Rotation.from_euler(axis, -degrees, degrees=True)
    pose[rows] = turn.apply(pose[rows] - centre) + centre
    return pose


LEG, ARM = ("KneeLeft", "AnkleLeft"), ("ElbowLeft", "WristLeft")
STANDS = bent("Neck", 0.0, "Head")
IMPOSSIBLE = {
    "head": bent("Neck", 130.0, "Head"),
    "head, back": bent("Neck", -110.0, "Head"),
    "hip": bent("HipLeft", -80.0, *LEG),
    "shoulder": bent("ShoulderLeft", -110.0, *ARM),
    "hip, inwards": bent("HipLeft", 75.0, *LEG, axis="x"),
    "knee": bent("KneeLeft", -178.0, "AnkleLeft"),
    "elbow": bent("ElbowLeft", 175.0, "WristLeft"),
}
POSSIBLE = {
    "head": bent("Neck", 70.0, "Head"),
    "hip": bent("HipLeft", 120.0, *LEG),
    "hip, back": bent("HipLeft", -25.0, *LEG),
    "hip, outwards": bent("HipLeft", -75.0, *LEG, axis="x"),
    "shoulder": bent("ShoulderLeft", 175.0, *ARM),
    "knee": bent("KneeLeft", -140.0, "AnkleLeft"),
    "elbow": bent("ElbowLeft", 140.0, "WristLeft"),
}


def run(poses, events=None):
    """Mend views of two cameras, whose places nobody knows: b sees the person stand."""
    frames = []
    for k, pose in enumerate([STANDS] * 60 + poses):
        for camera, (source, markers) in enumerate((("b", STANDS), ("a", pose))):
            frame = Frame.empty(1, MODEL, stamp=at(k, camera), source=source, frame_id="world")
            frame.markers[0, :, :3], frame.marker_confidences[:], frame.ids[:] = markers, 1.0, 7
            frames.append(frame)
    whole = join([Block.of(frame) for frame in frames])
    return join(list(mend_hidden_blocks([whole], MODEL, None, events)))


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_what_no_body_can_do_counts_little(what):
    events, pose = Events(), IMPOSSIBLE[what]
    out = run([pose] * 15, events)
    moved = np.linalg.norm(pose - STANDS, axis=1)
    farthest = moved.argmax()
    assert out.doubts.variances[-1, farthest] > (0.3 * moved[farthest]) ** 2
    assert not out.doubts.variances[-2].any()  # what camera b shows counts as before
    assert events.counts[POSTURE, "a"] >= 15


@pytest.mark.parametrize("what", POSSIBLE)
def test_what_a_body_can_do_is_believed(what):
    out = run([POSSIBLE[what]] * 15)
    assert not out.doubts.variances.any()
    np.testing.assert_array_equal(out.frame(-1).positions[0], POSSIBLE[what])


@pytest.mark.parametrize("name", NAMES)
def test_an_absent_marker_makes_nothing_impossible(name):
    pose = STANDS.copy()
    pose[NAMES.index(name)] = np.nan
    assert not run([pose] * 15).doubts.variances.any()


def test_an_impossible_head_goes_back_to_where_it_was_seen_when_nobody_else_sees_it():
    frames = [STANDS] * 60 + [IMPOSSIBLE["head"]] * 15
    blocks = []
    for k, pose in enumerate(frames):
        frame = Frame.empty(1, MODEL, stamp=at(k), source="a", frame_id="world")
        frame.markers[0, :, :3], frame.marker_confidences[:], frame.ids[:] = pose, 1.0, 7
        blocks.append(Block.of(frame))
    head = join(list(mend_hidden_blocks(blocks, MODEL))).frame(-1).positions[0, NAMES.index("Head")]
    np.testing.assert_allclose(head, PLACES["Head"], atol=0.1)
