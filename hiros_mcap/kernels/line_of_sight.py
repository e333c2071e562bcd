"""What stands in a camera's line of sight: bodies are capsules along their links.

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
from hiros_mcap.kernels.distance import mean_position
from hiros_mcap.kernels.points import norm3
from hiros_mcap.skeletons import Floats

_BLUR = 0.05
"""m; how far beside a limb joints are still uncertain: edges of depth images are blurred by a few
pixels (1 cm at 3 m, fov 70 degrees, 512 pixels), and the limb's own joints are 3 to 5 cm off."""
_NEARER = 0.15
"""m; a limb in front is this much nearer than the joint: half the depth of a trunk."""


class Capsules(NamedTuple):
    """Links with two ends, and their radii."""

    ends: J2  # (K, 2) marker slots
    radii: F2  # (K, 2) m, at each end


@inlined
def enclose(body: Floats, sphere: Floats) -> None:
    """Write the centre (3) of a body (M, >= 3) and the radius around it, m; NaN if it is absent."""
    sphere[0], sphere[1], sphere[2] = mean_position(body)
    sphere[3] = np.nan if math.isnan(sphere[0]) else 0.0
    for m in range(len(body)):
        away = norm3(body[m, 0] - sphere[0], body[m, 1] - sphere[1], body[m, 2] - sphere[2])
        if away > sphere[3]:
            sphere[3] = away


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
    place: Floats, camera: Floats, body: Floats, sphere: Floats, capsules: Capsules
) -> float:
    """Return h of a place (>= 3,) behind a body (M, >= 3) that ``sphere`` encloses."""
    ux, uy, uz = place[0] - camera[0], place[1] - camera[1], place[2] - camera[2]
    away = norm3(ux, uy, uz)
    if not away > _NEARER:
        return 0.0
    ray = ux / away, uy / away, uz / away
    wx, wy, wz = sphere[0] - camera[0], sphere[1] - camera[1], sphere[2] - camera[2]
    along = wx * ray[0] + wy * ray[1] + wz * ray[2]
    aside = math.sqrt(max(wx * wx + wy * wy + wz * wz - along * along, 0.0))
    # No limb is wider than 0.2 m, and 4 BLUR beside it h is below 0.001.
    if not aside < sphere[3] + 0.2 + 4.0 * _BLUR or along - sphere[3] > away:
        return 0.0
    least = np.inf
    for k in range(len(capsules.ends)):
        least = min(least, _gap(k, body, camera, ray, away - _NEARER, capsules))
        if least <= 0.0:
            return 1.0
    return math.exp(-0.5 * (least / _BLUR) ** 2)
