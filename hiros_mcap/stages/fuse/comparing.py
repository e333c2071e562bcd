"""Views against the fused poses: how far they are off, and which cameras saw what; the results."""

from __future__ import annotations

import math

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2, F3, I1, I2
from hiros_mcap.kernels.averaging import POSITION, VELOCITY
from hiros_mcap.kernels.compile import entry
from hiros_mcap.skeletons import People
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


@entry
def write_fused(
    poses: FusedPoses, shared: F2, most: float, half: float, people: People, deviations: F2
) -> None:
    """Write positions, velocities, and confidences 1 / (1 + variance / half^2) of people.

    Parameters
    ----------
    shared : (K, M) variance that is added, m2. deviations : (K, M) get the square root of the sum.
    most : deviation, m, beyond which a marker is unknown. half : that of the confidence 0.5, m.
    """
    for k in range(len(shared)):
        count, total = 0, 0.0
        for m in range(shared.shape[1]):
            variance = poses.variances[k, m] + shared[k, m]
            known = variance <= most * most
            for c in range(3):
                place, speed = poses.positions[k, m, c], poses.velocities[k, m, c]
                people.markers[k, m, POSITION + c] = place if known else np.nan
                people.markers[k, m, VELOCITY + c] = speed if known else np.nan
            confidence = 1.0 / (1.0 + variance / (half * half)) if known else np.nan
            people.marker_confidences[k, m] = confidence
            deviations[k, m] = math.sqrt(variance) if known else np.nan
            if known:
                count += 1
                total += confidence
        people.confidences[k] = total / count


@entry
def find_displaced(
    sums: F3, weights: F2, limits: F1, clearly: float, majority: int, squares: F1, out: F2
) -> None:
    """Write the squared offset of the displaced cameras of each group, m2; 0 for the others.

    Parameters
    ----------
    sums : (G, C, 3) of offsets, m. weights : (G, C) of views, 0 = none. limits : (C,) m.
    clearly, majority : offset over the median of the cameras; how many cameras there must be.
    squares : (C,) scratch.
    """
    for g in range(len(weights)):
        count = 0
        for c in range(len(limits)):
            out[g, c] = 0.0
            if weights[g, c] > 0.0:
                for i in range(3):
                    out[g, c] += (sums[g, c, i] / weights[g, c]) ** 2
                k = count
                while k > 0 and squares[k - 1] > out[g, c]:
                    squares[k] = squares[k - 1]
                    k -= 1
                squares[k] = out[g, c]
                count += 1
        middle = clearly * clearly * squares[(count - 1) // 2] if count >= majority else np.inf
        for c in range(len(limits)):
            if not out[g, c] > max(limits[c] * limits[c], middle):
                out[g, c] = 0.0


@entry
def add_offsets(offsets: F2, rows: I1, cameras: I1, keep: float, sums: F3, weights: F2) -> None:
    """Add offsets (N, 3), m, to the sums (R, C, 3) of people and cameras, of which ``keep`` stays.

    ``rows`` (N,) are those of the people; -1 = nothing to add.
    """
    for r in range(len(weights)):
        for c in range(weights.shape[1]):
            weights[r, c] *= keep
            for i in range(3):
                sums[r, c, i] *= keep
    for n in range(len(rows)):
        if rows[n] >= 0:
            weights[rows[n], cameras[n]] += 1.0
            for i in range(3):
                sums[rows[n], cameras[n], i] += offsets[n, i]
