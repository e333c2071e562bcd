"""What a viewer draws of people, in its precision: joints, bones and places of labels."""

from __future__ import annotations

from math import isnan
from typing import Any

import numpy as np
import numpy.typing as npt

from hiros_mcap.kernels.compile import kernel
from hiros_mcap.skeletons import Floats, Ints, Stamps

Singles = npt.NDArray[np.float32]


@kernel
def _size(largest: float, confidence: float) -> Any:
    """Return a joint's size: half at confidence 0, full at 1 or if it is unknown."""
    certainty = 1.0 if isnan(confidence) else min(max(confidence, 0.0), 1.0)
    return np.float32(largest * (0.5 + 0.5 * certainty))


@kernel("void(float64[:,:,::1], float64[:,::1], int64[::1], float64[:,:,::1], float64[:,::1])")
def pick(
    markers: Floats, confidences: Floats, rows: Stamps, positions: Floats, sure: Floats
) -> None:
    """Copy positions (P, M, 3), m, and confidences (P, M) of some rows of markers (N, M, 19)."""
    for p in range(rows.shape[0]):
        n = rows[p]
        for m in range(markers.shape[1]):
            for k in range(3):
                positions[p, m, k] = markers[n, m, k]
            sure[p, m] = confidences[n, m]


@kernel(
    "void(float64[:,:,::1], float64[:,::1], int64[::1], float64, float32[:,:,::1], float32[:,::1])"
)
def draw_joints(
    poses: Floats,
    confidences: Floats,
    rows: Stamps,
    largest: float,
    joints: Singles,
    radii: Singles,
) -> None:
    """Write the joints (R, M, 3) and their radii (R, M), m, of some poses (N, M, 3)."""
    for r in range(rows.shape[0]):
        n = rows[r]
        for m in range(poses.shape[1]):
            for k in range(3):
                joints[r, m, k] = poses[n, m, k]
            radii[r, m] = _size(largest, confidences[n, m])


@kernel("int64(float32[:,:,::1], int32[:,::1], float32[:,:,::1], int32[::1])")
def draw_bones(joints: Singles, ends: Ints, bones: Singles, counts: Ints) -> int:
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


@kernel("void(float64[:,:,::1], int64[::1], float64[:,::1])")
def tops(poses: Floats, rows: Stamps, out: Floats) -> None:
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
