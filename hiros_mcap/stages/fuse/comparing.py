"""Views against the fused poses: how far they are off, and which cameras saw what."""

from __future__ import annotations

import math

from hiros_mcap.kernels.array_types import F2, I1, I2
from hiros_mcap.kernels.compile import entry
from hiros_mcap.stages.fuse.fusing import FusedPoses, Sightings


@entry
def compare_views(
    views: Sightings, variances: F2, poses: FusedPoses, stamps: I1, rows: I1, offsets: F2
) -> None:
    """Write the mean residual of the joints of each view, weighted by 1 / variance.

    Parameters
    ----------
    variances : (N, M) of the measurements, m2. poses, stamps : (K, M) results and (K,) times, ns.
    rows : (N,) the result of each view; -1 = none.
    offsets : (N, 3) m; NaN = nothing to compare.
    """
    for n in range(len(rows)):
        k, total, x, y, z = rows[n], 0.0, 0.0, 0.0, 0.0
        later = (views.stamps[n] - stamps[k]) * 1e-9 if k >= 0 else 0.0
        for m in range(variances.shape[1] if k >= 0 else 0):
            measured, pose = views.positions[n, m], poses.positions[k, m]
            speed = poses.velocities[k, m]
            if math.isnan(measured[0]) or math.isnan(pose[0]):
                continue
            weight = 1.0 / variances[n, m]
            total += weight
            x += weight * (measured[0] - pose[0] - later * speed[0])
            y += weight * (measured[1] - pose[1] - later * speed[1])
            z += weight * (measured[2] - pose[2] - later * speed[2])
        offsets[n, 0], offsets[n, 1], offsets[n, 2] = x / total, y / total, z / total


@entry
def find_cameras(views: Sightings, rows: I1, hidden: float, seen: I2) -> None:
    """Write which cameras saw each marker of a person at an instant, a bit each: (K, M).

    ``rows`` (N,) is as in :func:`compare_views`. A camera does not see a marker from the variance
    ``hidden`` on, m2, that was added since somebody stands in front.
    """
    for n in range(len(rows)):
        if rows[n] < 0:
            continue
        for m in range(seen.shape[1]):
            if not math.isnan(views.positions[n, m, 0]) and views.hidden[n, m] < hidden:
                seen[rows[n], m] |= 1 << views.cameras[n]
