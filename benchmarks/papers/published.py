"""Numbers of the three papers, to print beside our own.

They come from other data. Hi-ROS (Guidolin et al. 2023): real people, Azure Kinects, inertial suits
as reference. Malaguti et al. (2019): Kinects v2 and a marker-based system. Lee et al. (2022): Azure
Kinects, the camera in front as reference. Lee's Tables A1 to A6 are in ``lee_2022_appendix.csv``
(CC BY 4.0). What its text says by parts of the body are their means, with digits cut off.
"""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path

import numpy as np

Pair = tuple[float, float]
"""RMSE and SD of the eight flexion angles, degrees."""

SINGLE = (
    "bend",
    "cross_arms",
    "jog",
    "jump",
    "point",
    "sit",
    "squat",
    "throw",
    "walk",
    "wave",
)
"""Actions of one person (Table 5)."""
SEVERAL = ("circle", "cross", "free_dynamic", "free_static", "in_out")
"""Actions of 2 to 4 people; "eight" is of 4 only."""

ANGLES: dict[tuple[int, str], tuple[Pair, Pair, Pair]] = {
    (1, "bend"): ((17.98, 13.48), (14.39, 8.77), (14.36, 8.76)),
    (1, "cross_arms"): ((17.70, 13.53), (13.82, 8.44), (13.80, 8.46)),
    (1, "jog"): ((19.15, 17.45), (14.39, 12.20), (14.40, 12.19)),
    (1, "jump"): ((21.60, 18.76), (16.40, 13.00), (16.44, 13.05)),
    (1, "point"): ((24.39, 20.14), (21.13, 15.94), (21.21, 16.02)),
    (1, "sit"): ((16.52, 13.37), (12.40, 8.38), (12.40, 8.28)),
    (1, "squat"): ((17.31, 14.76), (14.42, 11.31), (14.28, 11.10)),
    (1, "throw"): ((19.58, 16.11), (14.25, 9.14), (14.26, 9.16)),
    (1, "walk"): ((16.15, 11.61), (12.98, 6.45), (12.98, 6.45)),
    (1, "wave"): ((17.36, 13.12), (12.70, 6.08), (12.75, 6.16)),
    (2, "circle"): ((16.88, 12.93), (14.00, 8.50), (14.10, 8.62)),
    (2, "cross"): ((17.00, 13.41), (13.90, 8.96), (13.99, 9.04)),
    (2, "free_dynamic"): ((16.66, 13.59), (13.05, 8.42), (13.07, 8.49)),
    (2, "free_static"): ((16.58, 13.91), (12.31, 8.05), (12.35, 8.10)),
    (2, "in_out"): ((16.56, 13.04), (14.32, 11.66), (14.39, 11.72)),
    (3, "circle"): ((16.81, 13.21), (14.22, 9.17), (14.28, 9.28)),
    (3, "cross"): ((17.67, 14.04), (15.68, 11.28), (15.82, 11.44)),
    (3, "free_dynamic"): ((18.31, 15.28), (13.79, 9.54), (13.85, 9.64)),
    (3, "free_static"): ((17.59, 13.21), (14.87, 8.99), (14.78, 8.94)),
    (3, "in_out"): ((16.59, 13.97), (14.71, 12.27), (14.81, 12.35)),
    (4, "circle"): ((18.48, 14.66), (16.51, 12.19), (16.69, 12.37)),
    (4, "cross"): ((17.91, 14.22), (15.76, 11.60), (15.84, 11.73)),
    (4, "eight"): ((16.49, 13.03), (14.82, 10.50), (14.95, 10.64)),
    (4, "free_dynamic"): ((18.96, 16.29), (15.41, 12.04), (15.44, 12.09)),
    (4, "free_static"): ((17.61, 14.30), (14.53, 10.43), (14.43, 10.35)),
    (4, "in_out"): ((17.35, 14.08), (15.57, 12.08), (15.55, 12.06)),
}
"""(people, action) -> T, TMF, TMOF (Tables 6 and 7)."""

TIMES: dict[int, tuple[Pair, Pair, Pair, Pair]] = {
    1: ((0.19, 0.05), (0.55, 0.08), (4.16, 0.95), (0.11, 0.03)),
    2: ((0.37, 0.14), (0.71, 0.28), (6.44, 2.13), (0.17, 0.06)),
    3: ((0.63, 0.26), (0.85, 0.43), (7.52, 3.10), (0.19, 0.08)),
    4: ((0.86, 0.39), (0.88, 0.55), (8.33, 3.76), (0.21, 0.10)),
}
"""People -> mean and SD of the time of tracker, merger, optimizer, filter, ms (Table 8)."""

MALAGUTI: dict[str, tuple[Pair, Pair, Pair, Pair]] = {
    "1": ((8.29, 7.39), (12.56, 7.17), (11.85, 6.4), (5.55, 2.68)),
    "2": ((9.47, 8.43), (17.16, 10.23), (14.84, 8.67), (7.41, 4.74)),
    "3": ((8.79, 7.42), (14.48, 7.35), (14.17, 6.2), (6.74, 3.76)),
    "4": ((11.33, 8.81), (20.68, 9.44), (18.56, 8.24), (9.53, 4.46)),
    "5a": ((8.81, 8.74), (14.98, 7.98), (13.17, 6.63), (6.45, 3.52)),
    "5b": ((9.01, 9.11), (20.73, 10.85), (17.31, 8.86), (7.43, 5.53)),
    "6a": ((9.94, 9.25), (20.93, 10.9), (17.62, 8.91), (8.55, 5.1)),
    "6b": ((9.74, 8.71), (19.75, 9.82), (16.11, 8.28), (8.05, 4.31)),
}
"""Sequence -> mean and SD, cm, of raw (OpenPose), maf, openptrack, malaguti (Table I)."""
MALAGUTI_COLUMNS = ("raw", "maf", "openptrack", "malaguti")
MALAGUTI_MS_PER_PERSON = 13.4
"""Time per message and person, ms: Table II is its multiples for 1 to 6 people."""

LEE: dict[str, tuple[Pair, Pair, Pair]] = {
    "lee-a1": ((41.1, 11.02), (90.9, 44.89), (45.2, 22.0)),
    "lee-a3": ((40.8, 13.1), (66.0, 40.1), (38.9, 17.8)),
    "lee-a4": ((41.1, 12.0), (60.2, 33.8), (38.9, 17.3)),
    "lee": ((39.9, 10.3), (55.9, 29.3), (36.2, 14.2)),
}
"""Variant -> mean error and SD, mm, of torso, upper limbs, lower limbs (section 3.1)."""
LEE_RADII: dict[float, tuple[Pair, Pair, Pair]] = {
    0.05: ((40.6, 13.5), (60.2, 36.2), (36.0, 14.4)),
    0.10: ((39.1, 9.6), (51.6, 26.7), (35.7, 13.8)),
    0.15: ((39.9, 9.0), (53.5, 26.6), (36.2, 14.0)),
    0.20: ((39.9, 9.0), (58.1, 27.8), (36.8, 14.4)),
}
"""Radius, m -> the same for A5 (section 3.2)."""
LEE_CAMERAS: dict[int, tuple[Pair, Pair, Pair]] = {
    1: ((63.3, 15.8), (125.6, 64.2), (60.2, 28.6)),
    2: ((50.9, 13.6), (103.5, 57.5), (46.8, 20.3)),
    3: ((43.4, 12.2), (66.3, 37.1), (38.3, 14.5)),
    4: ((39.6, 9.8), (51.8, 26.0), (35.8, 13.2)),
}
"""Number of cameras -> the same, mean over all subsets (section 3.3)."""

LEE_GESTURES = ("hands_up_down", "jump", "squat", "lunge", "walk_in_place", "free_static")
"""Actions of the simulator for gestures 1 to 6 (section 2.3)."""
LEE_COLUMNS = ("A1", *(f"A{k}_{cm}" for k in (3, 4, 5) for cm in (5, 10, 15, 20)))
"""Variants and search radii, cm, of Tables A1 to A4; in the paper, A3 does not depend on it."""


@cache
def lee_appendix() -> dict[tuple[str, str], dict[str, Pair]]:
    """(gesture, joint) -> column of Tables A1 to A6 -> mean error and SD, mm.

    Joints are named as markers; TNOS_1 to TNOS_4 are the columns of 1 to 4 cameras.
    """
    table: dict[tuple[str, str], dict[str, Pair]] = {}
    path = Path(__file__).with_name("lee_2022_appendix.csv")
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    for errors, deviations in zip(rows[::2], rows[1::2], strict=True):
        key = LEE_GESTURES[int(errors["gesture"]) - 1], _marker(errors["joint"])
        columns = [c for c in errors if c not in ("gesture", "joint", "measure")]
        table[key] = {c: (float(errors[c]), float(deviations[c])) for c in columns}
    return table


def _marker(joint: str) -> str:
    """Return the marker of a joint: SHOULDER_LEFT of "L Shoulder"."""
    sides = {"L": "_LEFT", "R": "_RIGHT"}
    side, _, name = joint.partition(" ")
    return name.upper() + sides[side] if side in sides else joint.upper().replace(" ", "_")


def lee_mean(column: str, joints: tuple[str, ...], gestures: tuple[str, ...] = ()) -> Pair:
    """Mean error and SD of some joints in a column of the appendix, mm; over all gestures."""
    chosen = [
        row[column]
        for (gesture, joint), row in lee_appendix().items()
        if joint in joints and gesture in (gestures or LEE_GESTURES)
    ]
    error, deviation = np.mean(chosen, axis=0).tolist()
    return error, deviation
