"""Which joint a name means: every detector spells them in its own way.

``left shoulder``, ``LeftShoulder``, ``SHOULDER_LEFT``, ``l_shoulder`` and ``LShoulder`` are one.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from hiros_mcap.body.symmetry import split_side

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
    other: name for name, others in _SYNONYMS.items() for other in (name, *others.split())
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
        other = {"left": "right", "right": "left"}.get(side, "")
        part = _plain(part)
        if side and side not in name.lower() and (part, other) not in pairs:
            part, side = _plain(name), ""
        joints.append((_CANONICAL.get(part, part), side))
    return joints


def _plain(text: str) -> str:
    return "".join(c for c in text.lower() if c.isalnum())
