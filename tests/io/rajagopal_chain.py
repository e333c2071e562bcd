"""OpenSim's model of Rajagopal et al. (2016), posed by the coordinates of a MOT file.

Written from the joints of Rajagopal2016.osim alone, with the splines of its knee, so that it shares
nothing with the exporter. test_opensim.py compares it with OpenSim itself where that is installed.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
Place = tuple[Rotation, Floats]
"""Orientation of a body in the ground, and (3,) its origin, m."""

KNEE_FRAME = (-1.64157, 1.44618, 1.5708)
KNEE_STEPS = np.arange(13) * np.radians(10)
KNEE_TILT = (
    *(0, 0.0126809, 0.0226969, 0.0296054, 0.0332049, 0.0335354, 0.0308779, 0.0257548),
    *(0.0189295, 0.011407, 0.00443314, -0.00050475, -0.0016782),
)
KNEE_TWIST = (
    *(0, 0.059461, 0.109399, 0.150618, 0.18392, 0.210107, 0.229983, 0.24435),
    *(0.254012, 0.25977, 0.262428, 0.262788, 0.261654),
)
KNEE_UP = (
    *(0, 0.000479, 0.000835, 0.001086, 0.001251, 0.001346, 0.001391, 0.001403),
    *(0.0014, 0.0014, 0.001421, 0.001481, 0.001599),
)
KNEE_SIDE = (
    *(0, 0.000988, 0.001899, 0.002734, 0.003492, 0.004173, 0.004777, 0.005305),
    *(0.005756, 0.00613, 0.006427, 0.006648, 0.006792),
)
ELBOW_FRAME = (-0.0228627, 0.228018, 0.0051689)
ANKLE_FRAME = (0.175895, -0.105208, 0.0186622)


def read_mot(path):
    """Angles in degrees, places in m, by the time in s."""
    return pd.read_csv(path, sep="\t", skiprows=7, index_col="time")


def joints(table):
    """(T, 3) where the model's joints are, m, in the ground, y up."""
    q = {name: column if name[:-1] == "pelvis_t" else np.radians(column)
         for name, column in zip(table, table.to_numpy().T, strict=True)}  # fmt: skip
    pelvis = (
        zxy(q, "pelvis_tilt", "pelvis_list", "pelvis_rotation"),
        np.stack([q["pelvis_tx"], q["pelvis_ty"], q["pelvis_tz"]], axis=-1),
    )
    back = zxy(q, "lumbar_extension", "lumbar_bending", "lumbar_rotation")
    torso = below(pelvis, [-0.1007, 0.0815, 0], back)
    found = {}
    for side, sign in (("r", 1.0), ("l", -1.0)):
        found |= leg(q, pelvis, side, sign) | arm(q, torso, side, sign)
    return found


def leg(q, pelvis, side, sign):
    names = (f"hip_flexion_{side}", f"hip_adduction_{side}", f"hip_rotation_{side}")
    femur = below(pelvis, [-0.056276, -0.07849, 0.07726 * sign], zxy(q, *names, sign=sign))
    k = q[f"knee_angle_{side}"]
    tilt, twist, up, aside = (
        CubicSpline(KNEE_STEPS, values)(np.clip(k, 0, KNEE_STEPS[-1]))
        for values in (KNEE_TILT, KNEE_TWIST, KNEE_UP, KNEE_SIDE)
    )
    frame = Rotation.from_euler("XYZ", KNEE_FRAME)
    bend = Rotation.from_euler("XZY", np.stack([k, tilt, twist], axis=-1))
    # Its own frame in the femur, the motion there, and the frame in the tibia undone.
    moved = mirrored(frame * bend * frame.inv(), sign)
    slide = flipped(frame.apply(np.stack([0 * up, up, aside], axis=-1)), sign)
    centre = np.array([-0.00809, -0.40796, -0.00275 * sign]) + slide
    tibia_orientation = femur[0] * moved
    knee = femur[1] + femur[0].apply(centre)
    from_knee = np.array([-0.00808954, -0.0035348, -0.00148474 * sign])
    tibia = (tibia_orientation, knee - tibia_orientation.apply(from_knee))
    ankle_frame = Rotation.from_euler("XYZ", ANKLE_FRAME)
    ankle_bend = ankle_frame * about_z(q.get(f"ankle_angle_{side}", 0 * k))
    talus = below(tibia, [-0.01, -0.4, 0], mirrored(ankle_bend * ankle_frame.inv(), sign))
    toes = [0.1788 - 0.04877, -0.002 - 0.04195, (0.00108 + 0.00792) * sign]
    return {
        f"hip_{side}": femur[1],
        f"knee_{side}": femur[1] + femur[0].apply([-0.00809, -0.40796, -0.00275 * sign]),
        f"ankle_{side}": talus[1],
        f"toes_{side}": talus[1] + talus[0].apply(toes),
    }


def arm(q, torso, side, sign):
    names = (f"arm_flex_{side}", f"arm_add_{side}", f"arm_rot_{side}")
    humerus = below(torso, [0.003155, 0.3715, 0.17 * sign], zxy(q, *names, sign=sign))
    frame = Rotation.from_euler("XYZ", ELBOW_FRAME)
    bend = frame * about_z(q[f"elbow_flex_{side}"]) * frame.inv()
    ulna = below(humerus, [0.013144, -0.286273, -0.009595 * sign], mirrored(bend, sign))
    wrist = [-0.006727 - 0.008797, -0.013007 - 0.235841, (0.026083 + 0.01361) * sign]
    return {
        f"shoulder_{side}": humerus[1],
        f"elbow_{side}": ulna[1],
        f"wrist_{side}": ulna[1] + ulna[0].apply(wrist),
    }


def below(parent, offset, turn):
    """A body whose origin lies at ``offset`` in its parent."""
    return parent[0] * turn, parent[1] + parent[0].apply(np.asarray(offset, float))


def zxy(q, *names, sign=1.0):
    """Three coordinates in turn about z, x and y; the left side's x and y point the other way."""
    angles = np.stack([q[name] for name in names], axis=-1)
    return Rotation.from_euler("ZXY", angles * [1, sign, sign])


def about_z(angles):
    return Rotation.from_euler("Z", angles[:, None])


def mirrored(rotation, sign):
    """The same rotation of the other side: what lies in the plane x y stays."""
    flip = np.diag([1.0, 1.0, sign])
    return Rotation.from_matrix(flip @ rotation.as_matrix() @ flip)


def flipped(vector, sign):
    return vector * np.array([1.0, 1.0, sign])
