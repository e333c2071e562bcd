"""Signed joint angles as clinicians name them.

A joint's angles are those of its distal segment in its proximal one, by the sequence z (flexion),
x (abduction), y (axial rotation) of the ISB recommendations (Wu et al. 2002 and 2005).
:mod:`hiros_mcap.body.segments` makes the frames of the segments, and says which axes of a limb
markers cannot show. So:

- flexion and abduction of hip and shoulder need the long axis only, and are always known;
- axial rotations are NaN where neither a bent joint nor a link orientation shows them;
- abduction and rotation of a knee, and pronation, need link orientations;
- the plane in which an arm is lifted is NaN while it hangs, within :data:`HANGING_DEG`;
- knee and elbow are hinges: their flexion is the angle between the bones. A knee may be
  overextended by up to 10 degrees, an elbow not.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hiros_mcap.body.segments import (
    HINGE_DEG,
    SIDES,
    Finder,
    LinkAxes,
    Segments,
    between,
    finder,
    frame,
    link_axes,
    long_axis_of_head,
    segments_of,
    toes,
    zxy,
)
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel

HANGING_DEG = 10.0
LEAP_DEG = 90.0
"""No joint turns so far from one frame to the next."""

ANGLE_NAMES: tuple[str, ...] = (
    *("pelvis tilt", "pelvis obliquity", "pelvis rotation"),
    *("trunk flexion", "trunk side bend", "trunk rotation"),
    *("neck flexion", "neck side bend", "neck rotation"),
    *(
        f"{side} {angle}"
        for side in SIDES
        for angle in (
            *("hip flexion", "hip abduction", "hip rotation"),
            *("knee flexion", "knee abduction", "knee rotation"),
            *("ankle dorsiflexion", "ankle rotation"),
            *("shoulder flexion", "shoulder abduction", "shoulder rotation"),
            *("shoulder elevation", "shoulder plane"),
            *("elbow flexion", "elbow pronation"),
        )
    ),
)
"""Columns of :func:`anatomical_angles`."""
MOST_RAD = np.array([np.inf if name.startswith("pelvis") else 1.5 * np.pi for name in ANGLE_NAMES])
"""How large each of them can be: only a whole person turns round and round."""
MAIN_ANGLES: tuple[str, ...] = tuple(
    f"{side} {angle} flexion" for side in SIDES for angle in ("shoulder", "elbow", "hip", "knee")
)
"""Those that a picture shows which has no room for all."""

Columns = Mapping[str, Floats]


def anatomical_angles(
    model: SkeletonModel,
    positions: Floats,
    orientations: Floats | None = None,
    axes: LinkAxes | None = None,
    *,
    unwrapped: bool = True,
) -> Floats:
    """(T, A) angles over time, rad; the columns are :data:`ANGLE_NAMES`.

    Signs: flexion lifts the thigh or the arm forwards, and bends knee, elbow, trunk and neck
    forwards or shut; dorsiflexion lifts the toes; abduction leads away from the middle; rotation
    of hip, knee, ankle and shoulder, and pronation, are positive inwards; side bend and rotation
    of trunk, neck and pelvis are positive to the right and to the left; pelvis tilt is positive
    forwards, its obliquity where the right side is lower. Shoulder elevation is the angle between
    arm and trunk, and its plane is 0 where the arm is lifted sideways, 90 degrees forwards
    (Wu et al. 2005, 2.4.7). Flexion and abduction of a shoulder are ill-defined near 90 degrees
    of abduction; elevation and plane are not.

    Parameters
    ----------
    model : names the markers. positions : (T, M, 3) of one person, m; NaN where absent.
    orientations : (T, L, 4) x y z w of the links, of any convention; None uses markers alone.
    axes : what :func:`hiros_mcap.body.segments.link_axes` measured; None measures it here.
    unwrapped : continue angles over 180 degrees instead of jumping by 360.

    Returns
    -------
    NaN where a marker is missing, or where the angle cannot be known.
    """
    if axes is None and orientations is not None:
        axes = link_axes(model, positions, orientations)
    at, body = finder(model, positions), segments_of(model, positions, orientations, axes)
    columns = dict.fromkeys(ANGLE_NAMES, np.full(len(positions), np.nan))
    columns |= _pelvis_angles(body["pelvis"])
    columns |= _trunk_angles(body["pelvis"], body["thorax"])
    columns |= _neck_angles(at, body)
    for side in SIDES:
        columns |= _leg_angles(at, body, side)
        columns |= _arm_angles(body, side)
        # Markers show thigh and shank by the same hinge, between which nothing turns.
        if {f"{side} thigh", f"{side} shank"} <= (axes or {}).keys():
            _, adduction, rotation = zxy(body[f"{side} thigh"], body[f"{side} shank"])
            columns[f"{side} knee abduction"] = -_sign(side) * adduction
            columns[f"{side} knee rotation"] = _sign(side) * rotation
        if f"{side} forearm" in (axes or {}):
            rotation = zxy(body[f"{side} upper arm"], body[f"{side} forearm"])[2]
            columns[f"{side} elbow pronation"] = _sign(side) * rotation
    angles = np.stack([columns[name] for name in ANGLE_NAMES], axis=-1)
    return continued(angles, most=MOST_RAD) if unwrapped else angles


def continued(
    angles: Floats, before: Floats | None = None, most: Floats | float = np.inf
) -> Floats:
    """Continue each column of (T, A), rad, over jumps of 360 degrees; gaps stay.

    Where an angle turns by more than :data:`LEAP_DEG`, or beyond ``most``, the skeleton is
    distorted, and nobody knows how often it went round: the angle is left as it is there, and
    continued from there on.

    Parameters
    ----------
    before : (A,) the last angles before the first row; NaN where there are none.
    most : (A,) how large an angle can be, rad.
    """
    out = angles.copy()
    n = angles.shape[1]
    firsts = np.full(n, np.nan) if before is None else before
    limits = np.broadcast_to(most, n).tolist()
    for column, first, limit in zip(out.T, firsts, limits, strict=True):
        present: Flags = ~np.isnan(column)
        begin = np.full(int(not np.isnan(first)), first)
        column[present] = _continued(np.append(begin, column[present]), limit)[len(begin) :]
    return out


def _continued(angles: Floats, most: float) -> Floats:
    """Continue angles (T,), rad, none of which is absent.

    An angle is continued from row to row within a stretch; a leap begins another stretch.
    """
    circle = 2 * np.pi
    steps = np.diff(angles)
    # Whole turns, counted from the first row, that make every step the shortest.
    turns = np.append(0.0, np.cumsum(np.round(-steps / circle)))[: len(angles)]
    shortest = np.abs((steps + np.pi) % circle - np.pi)
    leaps = np.flatnonzero(shortest > np.radians(LEAP_DEG)) + 1
    # Row of the stretch's beginning, where the angle stays as it is.
    starts = np.append(0, leaps)[np.searchsorted(leaps, np.arange(len(angles)), side="right")]
    out = np.asarray(angles + circle * (turns - turns[starts]))
    # An impossible angle is taken back to less than half a turn, and all behind it by as much.
    while (beyond := np.abs(out) > most).any():
        first = int(beyond.argmax())
        out[first:] -= circle * np.round(out[first] / circle)
    return out


# -- joints ----------------------------------------------------------------------------------------


def _pelvis_angles(pelvis: Floats) -> Columns:
    """Tilt, obliquity, rotation against the fixed frame, whose z is up, by the sequence y x z."""
    forward, _, up = np.eye(3)
    world = np.stack([forward, up, np.cross(forward, up)], axis=-1)
    r = world.T @ pelvis
    return {
        "pelvis tilt": -np.arctan2(r[:, 1, 0], r[:, 1, 1]),
        "pelvis obliquity": np.arcsin(np.clip(-r[:, 1, 2], -1, 1)),
        "pelvis rotation": np.arctan2(r[:, 0, 2], r[:, 2, 2]),
    }


def _trunk_angles(pelvis: Floats, thorax: Floats) -> Columns:
    extension, bend, rotation = zxy(pelvis, thorax)
    return {"trunk flexion": -extension, "trunk side bend": bend, "trunk rotation": rotation}


def _neck_angles(at: Finder, body: Segments) -> Columns:
    """Direction of the head's long axis in the thorax, and its rotation by ears or eyes."""
    x, y, z = _inside(body["thorax"], long_axis_of_head(at))
    return {
        "neck flexion": np.arctan2(x, y),
        "neck side bend": np.arcsin(np.clip(z, -1, 1)),
        "neck rotation": zxy(body["thorax"], body["head"])[2],
    }


def _leg_angles(at: Finder, body: Segments, side: str) -> Columns:
    pelvis, thigh, shank = body["pelvis"], body[f"{side} thigh"], body[f"{side} shank"]
    sign = _sign(side)
    flexion, abduction = _swing(pelvis, thigh[:, :, 1], sign)
    foot = toes(at, side)
    # Ankle: toes against the shank in its own plane; 0 where they stand at right angles.
    x, _, z = _inside(shank, foot)
    return {
        f"{side} hip flexion": flexion,
        f"{side} hip abduction": abduction,
        f"{side} hip rotation": sign * zxy(pelvis, thigh)[2],
        f"{side} knee flexion": _knee_flexion(pelvis, thigh, shank),
        f"{side} ankle dorsiflexion": np.pi / 2 - between(foot, shank[:, :, 1]),
        f"{side} ankle rotation": np.arctan2(-sign * z, x),
    }


def _knee_flexion(pelvis: Floats, thigh: Floats, shank: Floats) -> Floats:
    """Angle between the bones, negative when overextended."""
    thigh_y, shank_y = thigh[:, :, 1], shank[:, :, 1]
    z = pelvis[:, :, 2]  # of a thigh that does not rotate about its long axis
    z = z - np.sum(z * thigh_y, axis=-1, keepdims=True) * thigh_y
    hinge = frame(y=thigh_y, z=z, keep="y")
    ahead, along, _ = _inside(hinge, shank_y)
    bend = between(thigh_y, shank_y)
    # A nearly straight knee shows no hinge: what bends sideways then is noise, not flexion.
    certain = np.clip(2.0 * bend / np.radians(HINGE_DEG) - 1.0, 0.0, 1.0)
    return np.asarray(certain * bend + (1.0 - certain) * np.arctan2(ahead, along))


def _arm_angles(body: Segments, side: str) -> Columns:
    thorax, upper, fore = body["thorax"], body[f"{side} upper arm"], body[f"{side} forearm"]
    sign = _sign(side)
    flexion, abduction = _swing(thorax, upper[:, :, 1], sign)
    x, y, z = _inside(thorax, -upper[:, :, 1])
    elevation = np.arccos(np.clip(-y, -1, 1))
    plane = np.where(elevation > np.radians(HANGING_DEG), np.arctan2(x, sign * z), np.nan)
    return {
        f"{side} shoulder flexion": flexion,
        f"{side} shoulder abduction": abduction,
        f"{side} shoulder rotation": sign * zxy(thorax, upper)[2],
        f"{side} shoulder elevation": elevation,
        f"{side} shoulder plane": plane,
        f"{side} elbow flexion": between(upper[:, :, 1], fore[:, :, 1]),
    }


def _sign(side: str) -> float:
    """Sign of abduction and inward rotation about the axes of a segment."""
    return 1.0 if side == "right" else -1.0


def _inside(segment: Floats, vectors: Floats) -> tuple[Floats, Floats, Floats]:
    """Components x, y, z of vectors (T, 3) in frames (T, 3, 3)."""
    x, y, z = np.moveaxis(np.einsum("tij,ti->tj", segment, vectors), -1, 0)
    return x, y, z


def _swing(proximal: Floats, axis: Floats, sign: float) -> tuple[Floats, Floats]:
    """Flexion and abduction of a limb whose long axis (T, 3) points up to its joint.

    The second column of Rz(a) Rx(b) Ry(c) is (-sin a cos b, cos a cos b, sin b): a is flexion, b
    adduction of the right side.
    """
    x, y, z = _inside(proximal, axis)
    return np.arctan2(-x, y), -sign * np.arcsin(np.clip(z, -1, 1))
