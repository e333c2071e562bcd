"""Occlusion in a camera's line of sight: bodies are capsules along their links.

The line from the camera to a place passes the axis of a link that is nearer to the camera at a
distance d. With the radius r of the limb there, the place is hidden by

    h = 1 for d < r,   h = exp(-((d - r) / BLUR)^2 / 2) beyond.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F2, J2
from hiros_mcap.kernels.compile import inlined, kernel
from hiros_mcap.kernels.points import mean_position, norm3
from hiros_mcap.skeletons import Floats

_BLUR = 0.05
"""m; how far beside a limb joints are still uncertain: edges of depth images are blurred by a few
pixels (1 cm at 3 m, fov 70 degrees, 512 pixels), and the limb's own joints are 3 to 5 cm off."""
_NEARER = 0.15
"""m; a limb in front is this much nearer than the joint: half the depth of a trunk."""
_REACH = 0.4
"""m; farther beside the axis of a limb nothing is hidden: no limb is wider than 0.2 m, and h is
below 0.001 at 4 BLUR beside it."""


class Capsules(NamedTuple):
    """Links with two ends, and their radii."""

    ends: J2  # (K, 2) marker slots
    radii: F2  # (K, 2) m, at each end


OUTLINE = 14
"""Numbers of an outline: three unit vectors (depth, across, up), a box of tangents, least depth."""


@inlined
def outline(body: Floats, camera: Floats, out: Floats) -> None:
    """Write the box (OUTLINE,) in which a camera sees a body (M, >= 3); NaN if it is absent.

    No place outside the box is hidden. A body around the camera has a box without bounds.
    """
    x, y, z = mean_position(body)
    x, y, z = x - camera[0], y - camera[1], z - camera[2]
    away = norm3(x, y, z)
    out[0], out[1], out[2] = x / away, y / away, z / away
    # Across is at a right angle to depth and to the axis that is farthest from depth.
    if abs(out[2]) < 0.7:
        out[3], out[4], out[5] = -out[1], out[0], 0.0
    else:
        out[3], out[4], out[5] = 0.0, -out[2], out[1]
    length = norm3(out[3], out[4], out[5])
    out[3], out[4], out[5] = out[3] / length, out[4] / length, out[5] / length
    out[6] = out[1] * out[5] - out[2] * out[4]
    out[7] = out[2] * out[3] - out[0] * out[5]
    out[8] = out[0] * out[4] - out[1] * out[3]
    out[9] = out[11] = out[13] = np.inf
    out[10] = out[12] = -np.inf
    for m in range(len(body)):
        x, y, z = body[m, 0] - camera[0], body[m, 1] - camera[1], body[m, 2] - camera[2]
        depth, across, up = _seen_from(x, y, z, out)
        if math.isnan(depth):
            continue
        out[13] = min(out[13], norm3(x, y, z) - _REACH)
        # A line of sight that is far from the axis misses by less than its tangents differ.
        beside = 1.5 * _REACH / depth if depth > _REACH else np.inf
        out[9], out[10] = (
            min(out[9], across / depth - beside),
            max(out[10], across / depth + beside),
        )
        out[11], out[12] = min(out[11], up / depth - beside), max(out[12], up / depth + beside)


@inlined
def _seen_from(x: float, y: float, z: float, frame: Floats) -> tuple[float, float, float]:
    """Where a place lies in an outline's axes, m."""
    depth = x * frame[0] + y * frame[1] + z * frame[2]
    across = x * frame[3] + y * frame[4] + z * frame[5]
    return depth, across, x * frame[6] + y * frame[7] + z * frame[8]


@inlined
def _is_outside(x: float, y: float, z: float, box: Floats) -> bool:
    """Whether the line of sight to a place (x, y, z), seen from the camera, misses an outline."""
    depth, across, up = _seen_from(x, y, z, box)
    if box[9] == -np.inf:
        return False
    inside = box[9] * depth < across < box[10] * depth and box[11] * depth < up < box[12] * depth
    return not (depth > 0.0 and inside)


@inlined
def _gap(
    k: int, body: Floats, camera: Floats, ray: tuple[float, float, float], reach: float,
    capsules: Capsules,
) -> float:  # fmt: skip
    """By how much, m, a line of sight of length ``reach`` misses a link; inf if it ends before."""
    a, b = capsules.ends[k, 0], capsules.ends[k, 1]
    (ux, uy, uz), x, y, z = ray, body[a, 0], body[a, 1], body[a, 2]
    px, py, pz = x - camera[0], y - camera[1], z - camera[2]
    ex, ey, ez = body[b, 0] - x, body[b, 1] - y, body[b, 2] - z
    depth, slope = px * ux + py * uy + pz * uz, ex * ux + ey * uy + ez * uz
    across = ex * ex + ey * ey + ez * ez - slope * slope
    if math.isnan(across) or math.isnan(depth):
        return np.inf
    # The nearest point of the link to the line lies at the share s of it.
    s = (depth * slope - (px * ex + py * ey + pz * ez)) / max(across, 1e-9)
    s = min(max(s, 0.0), 1.0)
    depth += s * slope
    if not 0.0 < depth < reach:
        return np.inf
    qx, qy, qz = px + s * ex - depth * ux, py + s * ey - depth * uy, pz + s * ez - depth * uz
    return norm3(qx, qy, qz) - (1.0 - s) * capsules.radii[k, 0] - s * capsules.radii[k, 1]


@kernel
def hidden_by(
    place: Floats, camera: Floats, body: Floats, box: Floats, capsules: Capsules
) -> float:
    """Return h of a place (>= 3,) behind a body (M, >= 3); ``box`` is the body's outline."""
    ux, uy, uz = place[0] - camera[0], place[1] - camera[1], place[2] - camera[2]
    if _is_outside(ux, uy, uz, box):
        return 0.0
    away = norm3(ux, uy, uz)
    if not away > max(_NEARER, box[13]):
        return 0.0
    ray = ux / away, uy / away, uz / away
    least = np.inf
    for k in range(len(capsules.ends)):
        least = min(least, _gap(k, body, camera, ray, away - _NEARER, capsules))
        if least <= 0.0:
            return 1.0
    return math.exp(-0.5 * (least / _BLUR) ** 2)
