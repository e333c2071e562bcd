"""Joints, bones and places of labels that a viewer draws, in single precision."""

from __future__ import annotations

from math import isnan

import numpy as np
import numpy.typing as npt

from hiros_mcap.kernels.array_types import F2, F3, I1, J1, J2, S2, S3
from hiros_mcap.kernels.compile import entry

Singles = npt.NDArray[np.float32]


@entry
def pick(markers: F3, confidences: F2, rows: I1, positions: F3, sure: F2) -> None:
    """Copy positions (P, M, 3), m, and confidences (P, M) of some rows of markers (N, M, 19)."""
    for p in range(rows.shape[0]):
        n = rows[p]
        for m in range(markers.shape[1]):
            for k in range(3):
                positions[p, m, k] = markers[n, m, k]
            sure[p, m] = confidences[n, m]


@entry
def draw_joints(
    poses: F3, confidences: F2, rows: I1, largest: float, joints: S3, radii: S2
) -> None:
    """Write the joints (R, M, 3) and their radii (R, M), m, of some poses (N, M, 3)."""
    for r in range(rows.shape[0]):
        n = rows[r]
        for m in range(poses.shape[1]):
            for k in range(3):
                joints[r, m, k] = poses[n, m, k]
            given = confidences[n, m]  # full size at 1 or if it is unknown, half at 0
            sure = 1.0 if isnan(given) else min(max(given, 0.0), 1.0)
            radii[r, m] = np.float32(largest * (0.5 + 0.5 * sure))


@entry
def draw_bones(joints: S3, ends: J2, bones: S3, counts: J1) -> int:
    """Write the bones that have both ends, and how many each pose has; return how many in all.

    ``joints`` (R, M, 3), ``ends`` (B, 2) slots, ``bones`` (at least R B, 2, 3), ``counts`` (R,).
    """
    total = 0
    for r in range(joints.shape[0]):
        before = total
        for b in range(ends.shape[0]):
            parent, child = ends[b, 0], ends[b, 1]
            if isnan(joints[r, parent, 0]) or isnan(joints[r, child, 0]):
                continue
            for k in range(3):
                bones[total, 0, k] = joints[r, parent, k]
                bones[total, 1, k] = joints[r, child, k]
            total += 1
        counts[r] = total - before
    return total


@entry
def tops(poses: F3, rows: I1, out: F2) -> None:
    """Write the mean x and y and the largest z of each pose (R, 3), m; NaN if it has no joint."""
    for r in range(rows.shape[0]):
        n, count = rows[r], 0
        x, y, z = 0.0, 0.0, -np.inf
        for m in range(poses.shape[1]):
            if not isnan(poses[n, m, 0]):
                x += poses[n, m, 0]
                y += poses[n, m, 1]
                z = max(z, poses[n, m, 2])
                count += 1
        out[r, 0] = x / count if count else np.nan
        out[r, 1] = y / count if count else np.nan
        out[r, 2] = z if count else np.nan
