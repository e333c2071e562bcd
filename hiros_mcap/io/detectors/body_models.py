"""The skeletons of the detectors in one table: names in the order of the SDK, and who joins whom.

``*`` stands for both sides. A tree is written as chains of markers from the root to the tips. Every
detector spells joints in its own way: ``left shoulder``, ``LeftShoulder``, ``SHOULDER_LEFT``,
``l_shoulder`` and ``LShoulder`` are one (:func:`joints_of`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import pairwise

from hiros_mcap.body.symmetry import split_side
from hiros_mcap.skeletons import SkeletonModel

_ZED_TRUNK = """
    PELVIS SPINE_1 SPINE_2 SPINE_3 NECK NOSE LEFT_EYE RIGHT_EYE LEFT_EAR RIGHT_EAR
    LEFT_CLAVICLE RIGHT_CLAVICLE LEFT_SHOULDER RIGHT_SHOULDER LEFT_ELBOW RIGHT_ELBOW
    LEFT_WRIST RIGHT_WRIST LEFT_HIP RIGHT_HIP LEFT_KNEE RIGHT_KNEE LEFT_ANKLE RIGHT_ANKLE
    LEFT_BIG_TOE RIGHT_BIG_TOE LEFT_SMALL_TOE RIGHT_SMALL_TOE LEFT_HEEL RIGHT_HEEL"""
_ZED_TRUNK_TREE = """
    PELVIS-SPINE_1-SPINE_2-SPINE_3-NECK-NOSE-*_EYE-*_EAR
    SPINE_3-*_CLAVICLE-*_SHOULDER-*_ELBOW-*_WRIST
    PELVIS-*_HIP-*_KNEE-*_ANKLE-*_BIG_TOE  *_ANKLE-*_SMALL_TOE  *_ANKLE-*_HEEL"""
_COCO = """
    nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder
    left_elbow right_elbow left_wrist right_wrist left_hip right_hip
    left_knee right_knee left_ankle right_ankle"""
_COCO_TREE = """
    nose-*_eye-*_ear  left_hip-right_hip  *_hip-*_shoulder-*_elbow-*_wrist
    *_hip-*_knee-*_ankle"""
_FINGERS = ("THUMB", "INDEX", "MIDDLE", "RING", "PINKY")
_ZED_70 = _ZED_TRUNK + "".join(
    f" {side}_HAND_{finger}_{i}"
    for side in ("LEFT", "RIGHT")
    for finger in _FINGERS
    for i in range(1, 5)
)
_ZED_70_TREE = _ZED_TRUNK_TREE + "".join(
    " *_WRIST" + "".join(f"-*_HAND_{finger}_{i}" for i in range(1, 5)) for finger in _FINGERS
)

_TABLE: Mapping[str, tuple[str, str, str]] = {
    "azure-kinect": (
        "Azure Kinect Body Tracking SDK 1.1",
        """
        PELVIS SPINE_NAVAL SPINE_CHEST NECK
        CLAVICLE_LEFT SHOULDER_LEFT ELBOW_LEFT WRIST_LEFT HAND_LEFT HANDTIP_LEFT THUMB_LEFT
        CLAVICLE_RIGHT SHOULDER_RIGHT ELBOW_RIGHT WRIST_RIGHT HAND_RIGHT HANDTIP_RIGHT THUMB_RIGHT
        HIP_LEFT KNEE_LEFT ANKLE_LEFT FOOT_LEFT HIP_RIGHT KNEE_RIGHT ANKLE_RIGHT FOOT_RIGHT
        HEAD NOSE EYE_LEFT EAR_LEFT EYE_RIGHT EAR_RIGHT""",
        """
        PELVIS-SPINE_NAVAL-SPINE_CHEST-NECK-HEAD-NOSE  HEAD-EYE_*  HEAD-EAR_*
        SPINE_CHEST-CLAVICLE_*-SHOULDER_*-ELBOW_*-WRIST_*-HAND_*-HANDTIP_*  WRIST_*-THUMB_*
        PELVIS-HIP_*-KNEE_*-ANKLE_*-FOOT_*""",
    ),
    "kinect-v2": (
        "Kinect for Windows SDK 2.0, JointType",
        """
        SpineBase SpineMid Neck Head ShoulderLeft ElbowLeft WristLeft HandLeft
        ShoulderRight ElbowRight WristRight HandRight HipLeft KneeLeft AnkleLeft FootLeft
        HipRight KneeRight AnkleRight FootRight SpineShoulder HandTipLeft ThumbLeft
        HandTipRight ThumbRight""",
        """
        SpineBase-SpineMid-SpineShoulder-Neck-Head
        SpineShoulder-Shoulder*-Elbow*-Wrist*-Hand*-HandTip*  Wrist*-Thumb*
        SpineBase-Hip*-Knee*-Ankle*-Foot*""",
    ),
    "zed-18": (
        "ZED SDK 4, BODY_18_PARTS",
        """
        NOSE NECK RIGHT_SHOULDER RIGHT_ELBOW RIGHT_WRIST LEFT_SHOULDER LEFT_ELBOW LEFT_WRIST
        RIGHT_HIP RIGHT_KNEE RIGHT_ANKLE LEFT_HIP LEFT_KNEE LEFT_ANKLE
        RIGHT_EYE LEFT_EYE RIGHT_EAR LEFT_EAR""",
        """
        NECK-NOSE-*_EYE-*_EAR  NECK-*_SHOULDER-*_ELBOW-*_WRIST  NECK-*_HIP-*_KNEE-*_ANKLE""",
    ),
    "hri-18": (
        "ROS4HRI, hri_msgs/Skeleton2D",
        """
        nose neck right_shoulder right_elbow right_wrist left_shoulder left_elbow left_wrist
        right_hip right_knee right_ankle left_hip left_knee left_ankle
        left_eye right_eye left_ear right_ear""",
        """
        neck-nose-*_eye-*_ear  neck-*_shoulder-*_elbow-*_wrist  neck-*_hip-*_knee-*_ankle""",
    ),
    "zed-34": (
        "ZED SDK 4, BODY_34_PARTS",
        """
        PELVIS NAVAL_SPINE CHEST_SPINE NECK
        LEFT_CLAVICLE LEFT_SHOULDER LEFT_ELBOW LEFT_WRIST LEFT_HAND LEFT_HANDTIP LEFT_THUMB
        RIGHT_CLAVICLE RIGHT_SHOULDER RIGHT_ELBOW RIGHT_WRIST RIGHT_HAND RIGHT_HANDTIP RIGHT_THUMB
        LEFT_HIP LEFT_KNEE LEFT_ANKLE LEFT_FOOT RIGHT_HIP RIGHT_KNEE RIGHT_ANKLE RIGHT_FOOT
        HEAD NOSE LEFT_EYE LEFT_EAR RIGHT_EYE RIGHT_EAR LEFT_HEEL RIGHT_HEEL""",
        """
        PELVIS-NAVAL_SPINE-CHEST_SPINE-NECK-HEAD-NOSE-*_EYE-*_EAR
        CHEST_SPINE-*_CLAVICLE-*_SHOULDER-*_ELBOW-*_WRIST-*_HAND-*_HANDTIP  *_HAND-*_THUMB
        PELVIS-*_HIP-*_KNEE-*_ANKLE-*_FOOT  *_ANKLE-*_HEEL""",
    ),
    "zed-38": (
        "ZED SDK 4, BODY_38_PARTS",
        f"""{_ZED_TRUNK}
        LEFT_HAND_THUMB_4 RIGHT_HAND_THUMB_4 LEFT_HAND_INDEX_1 RIGHT_HAND_INDEX_1
        LEFT_HAND_MIDDLE_4 RIGHT_HAND_MIDDLE_4 LEFT_HAND_PINKY_1 RIGHT_HAND_PINKY_1""",
        f"""{_ZED_TRUNK_TREE}
        *_WRIST-*_HAND_THUMB_4  *_WRIST-*_HAND_INDEX_1  *_WRIST-*_HAND_MIDDLE_4
        *_WRIST-*_HAND_PINKY_1""",
    ),
    "zed-70": ("ZED SDK 4, BODY_70_PARTS", _ZED_70, _ZED_70_TREE),
    "ros4hri": (
        "ROS REP 155, links of the package human_description",
        """
        body torso head l_shoulder l_elbow l_wrist r_shoulder r_elbow r_wrist
        l_hip l_knee l_ankle r_hip r_knee r_ankle""",
        "body-torso-head  torso-*_shoulder-*_elbow-*_wrist  body-*_hip-*_knee-*_ankle",
    ),
    "openpose-25": (
        "OpenPose 1.7, BODY_25",
        """
        Nose Neck RShoulder RElbow RWrist LShoulder LElbow LWrist MidHip RHip RKnee RAnkle
        LHip LKnee LAnkle REye LEye REar LEar LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel""",
        """
        MidHip-Neck-Nose-*Eye-*Ear  Neck-*Shoulder-*Elbow-*Wrist
        MidHip-*Hip-*Knee-*Ankle-*BigToe  *Ankle-*SmallToe  *Ankle-*Heel""",
    ),
    "openpose-25b": (
        "OpenPose 1.7, BODY_25B: the neck is its upper end, the head its top",
        """
        Nose LEye REye LEar REar LShoulder RShoulder LElbow RElbow LWrist RWrist
        LHip RHip LKnee RKnee LAnkle RAnkle Neck Head
        LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel""",
        """
        Neck-Nose-*Eye-*Ear  Neck-Head  Neck-*Shoulder-*Elbow-*Wrist
        Neck-*Hip-*Knee-*Ankle-*BigToe  *Ankle-*SmallToe  *Ankle-*Heel""",
    ),
    "openpose-18": (
        "OpenPose 1.7, COCO",
        """
        Nose Neck RShoulder RElbow RWrist LShoulder LElbow LWrist RHip RKnee RAnkle
        LHip LKnee LAnkle REye LEye REar LEar""",
        "Neck-Nose-*Eye-*Ear  Neck-*Shoulder-*Elbow-*Wrist  Neck-*Hip-*Knee-*Ankle",
    ),
    "coco-23": (
        "COCO-WholeBody, without its 68 points of the face and 21 of each hand",
        f"""{_COCO}
        left_big_toe left_small_toe left_heel right_big_toe right_small_toe right_heel""",
        f"{_COCO_TREE}-*_big_toe  *_ankle-*_small_toe  *_ankle-*_heel",
    ),
    "coco-17": (
        "COCO keypoints, as YOLO, RTMPose and ViTPose order them",
        _COCO,
        _COCO_TREE,
    ),
    "halpe-26": (
        "Halpe, body and feet",
        """
        Nose LEye REye LEar REar LShoulder RShoulder LElbow RElbow LWrist RWrist
        LHip RHip LKnee RKnee LAnkle RAnkle Head Neck MidHip
        LBigToe RBigToe LSmallToe RSmallToe LHeel RHeel""",
        """
        MidHip-Neck-Nose-*Eye-*Ear  Neck-Head  Neck-*Shoulder-*Elbow-*Wrist
        MidHip-*Hip-*Knee-*Ankle-*BigToe  *Ankle-*SmallToe  *Ankle-*Heel""",
    ),
    "mediapipe-33": (
        "MediaPipe 0.10, PoseLandmark",
        """
        nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer
        left_ear right_ear mouth_left mouth_right left_shoulder right_shoulder
        left_elbow right_elbow left_wrist right_wrist
        left_pinky right_pinky left_index right_index left_thumb right_thumb
        left_hip right_hip left_knee right_knee left_ankle right_ankle
        left_heel right_heel left_foot_index right_foot_index""",
        """
        nose-*_eye_inner-*_eye-*_eye_outer-*_ear  nose-mouth_*
        left_hip-right_hip  *_hip-*_shoulder-*_elbow-*_wrist-*_index
        *_wrist-*_pinky  *_wrist-*_thumb
        *_hip-*_knee-*_ankle-*_foot_index  *_ankle-*_heel""",
    ),
}
"""Name -> where the names of the joints are from, the joints, and the tree."""
BODY_MODELS = tuple(_TABLE)
"""Names of the models."""
KEYPOINT_MODELS: Mapping[int, tuple[str, ...]] = {
    17: ("coco-17",),
    18: ("openpose-18",),
    23: ("coco-23",),
    25: ("openpose-25", "openpose-25b"),
    26: ("halpe-26",),
    33: ("mediapipe-33",),
    **dict.fromkeys((75, 543, 553), ("mediapipe-33",)),  # hands and face follow
    133: ("coco-23",),
    135: ("openpose-25b",),
    136: ("halpe-26",),
}
"""Number of joints that a detector finds -> the models that these may be, or begin with."""


@cache
def body_model(name: str) -> SkeletonModel:
    """Return a model of the table, whose links are called by their child.

    Raises KeyError for another name.
    """
    _, joints, tree = _TABLE[name]
    markers = joints.split()
    slots = {marker: slot for slot, marker in enumerate(markers)}
    parents = {slots[child]: slots[parent] for parent, child in _edges(tree, slots)}
    links = [(markers[child], parents[child], child) for child in sorted(parents)]
    return SkeletonModel.of(markers, links)


def name_of(model: SkeletonModel) -> str:
    """Return the name of the smallest model of the table that has all markers; "" if none has.

    Markers that were never seen are missing in the model of a log, but not most of them.
    """
    names = set(model.marker_names)
    sizes = {n: body_model(n).n_markers for n in BODY_MODELS}
    whole = [n for n, size in sizes.items() if names <= set(body_model(n).marker_names)]
    return min(whole, key=lambda n: sizes[n]) if names and whole else ""


def _edges(tree: str, names: Mapping[str, int]) -> Iterator[tuple[str, str]]:
    """Yield parent and child of every link."""
    for chain in tree.split():
        steps = chain.split("-")
        for parent, child in pairwise(steps):
            sides = ("Left", "Right", "LEFT", "RIGHT", "left", "right", "l", "r", "L", "R")
            pairs = [(parent.replace("*", s), child.replace("*", s)) for s in sides]
            yield from (pair for pair in dict.fromkeys(pairs) if names.keys() >= {*pair})


def linked(names: Sequence[str]) -> SkeletonModel:
    """Return a model of any markers, linked as the table links joints of these names.

    A joint is linked to the nearest one above it that is there. The skeleton that has most of the
    names comes first.
    """
    joints = joints_of(names)
    slots = {joint: slot for slot, joint in reversed([*enumerate(joints)])}
    above: dict[Joint, Joint] = {}
    models = [body_model(name) for name in BODY_MODELS]
    for model in sorted(models, key=lambda candidate: -len({*names} & {*candidate.marker_names})):
        indices = joints_of(model.marker_names)
        for parent, child in model.links.tolist():
            above.setdefault(indices[child], indices[parent])
    links = []
    for joint, slot in slots.items():
        parent, passed = above.get(joint), {joint}
        while parent is not None and parent not in slots and parent not in passed:
            passed.add(parent)
            parent = above.get(parent)
        if parent in slots and parent is not None and parent != joint:
            links.append((names[slot], slots[parent], slot))
    return SkeletonModel.of(names, links)


# What a joint is called here <- what others call it, without case, side and punctuation.
_SYNONYMS = {
    "pelvis": "hips spinebase basespine midhip hipcenter centerhip root body hipsmid",
    "spinenaval": "spinenavel navalspine navelspine spinemid midspine naval navel",
    "spinechest": "chestspine chest",
    "spineshoulder": "torso shouldercenter centershoulder midshoulder",
    "neck": "neckbase baseneck",
    "head": "headcenter headcentre",
    "nose": "nosetip",
    "clavicle": "collar collarbone",
    "shoulder": "upperarm shoulderjoint sho",
    "elbow": "forearm lowerarm elb",
    "wrist": "wri",
    "hand": "palm",
    "handtip": "handmiddle4 middletip handend",
    "thumb": "handthumb4 thumbtip",
    "hip": "upleg upperleg thigh hipjoint",
    "knee": "leg lowerleg shin shank kne",
    "ankle": "ank",
    "foot": "footindex toebase",
    "bigtoe": "toe toetip",
    "smalltoe": "littletoe",
}
_CANONICAL = {
    spelling: name
    for name, spellings in _SYNONYMS.items()
    for spelling in (name, *spellings.split())
}
_PREFIX = re.compile(r"^(k4abt[ _]?)?joint[ _]+|^mixamorig[:_]?", re.IGNORECASE)

Joint = tuple[str, str]
"""Name without its side, and "left", "right" or ""."""


def joints_of(names: Sequence[str]) -> list[Joint]:
    """Say which joint each name of a skeleton means; a name that nobody knows means itself.

    An initial counts as a side only if the other side exists, too: "Lumbar" is no left joint.

    >>> joints_of(["LeftShoulder", "r_shoulder", "Lumbar"])
    [('shoulder', 'left'), ('shoulder', 'right'), ('lumbar', '')]
    """
    split = [split_side(_PREFIX.sub("", name)) for name in names]
    pairs = {(_plain(part), side) for part, side in split}
    joints = []
    for name, (part, side) in zip(names, split, strict=True):
        opposite = {"left": "right", "right": "left"}.get(side, "")
        part = _plain(part)
        if side and side not in name.lower() and (part, opposite) not in pairs:
            part, side = _plain(name), ""
        joints.append((_CANONICAL.get(part, part), side))
    return joints


def _plain(text: str) -> str:
    return "".join(c for c in text.lower() if c.isalnum())
