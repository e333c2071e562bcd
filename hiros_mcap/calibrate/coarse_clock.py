"""Who is who in two cameras, and the lag of their clocks, without the cameras' poses.

A signature holds distances within a body: between left and right, and from the middle of both to
the pelvis. It depends neither on the frame nor on confused sides. The same person has the same
signature in both cameras, at the lag of their clocks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.body.segments import PELVIS
from hiros_mcap.body.symmetry import split_side, symmetry_of
from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.kernels.correlation import STEP_S, Signature, alikeness
from hiros_mcap.rays.lags import APART_S, sampled
from hiros_mcap.skeletons import Floats, SkeletonModel, Stamps

LONGEST_LAG_S = 5.0
LAGS = 10
"""The right lag of somebody who walks is one of many: every step looks like the last one."""


class Landmarks(NamedTuple):
    """The joints that a signature needs."""

    left: Stamps  # (F,) slots
    right: Stamps  # (F,) slots
    pelvis: Stamps
    """Slots whose mean is the pelvis: one, both hips, or all joints of an unknown skeleton."""


LagCandidate = tuple[float, list[tuple[int, int]]]
"""Time on the second camera's clock less that on the first one's, s, and the tracklets of both
that speak for it, the most similar first."""


def landmarks_of(model: SkeletonModel) -> Landmarks:
    """Find the paired joints and the pelvis by their names; without names, all joints."""
    symmetry = symmetry_of(model)
    slots = np.arange(model.n_markers)
    names = [split_side(name) for name in model.marker_names]
    paired = [m for m in slots if symmetry.mirror[m] != m]
    left = np.array([m for m in paired if names[m][1] == "left"], np.int64)
    pelvis = [m for m in slots if names[m][0] in PELVIS]
    hips = [m for m in paired if names[m][0] == "hip"]
    if not len(left):
        return Landmarks(slots, slots, slots)
    return Landmarks(
        left, symmetry.mirror[left].astype(np.int64), np.array(pelvis or hips or slots)
    )


def signatures_of(view: CameraView, landmarks: Landmarks) -> list[Signature]:
    """Return the signature of each tracklet of a camera, at 20 Hz."""
    return [_signature(*sampled(track, view.half_width), landmarks) for track in view.tracks]


def _signature(first: int, positions: Floats, landmarks: Landmarks) -> Signature:
    """Return the signature of positions (T, M, 3), NaN = absent, from step ``first`` on."""
    left, right = positions[:, landmarks.left], positions[:, landmarks.right]
    pelvis = positions[:, landmarks.pelvis].mean(axis=1)[:, None]
    across = np.linalg.norm(left - right, axis=2)
    along = np.linalg.norm((left + right) / 2.0 - pelvis, axis=2)
    return first, np.ascontiguousarray(np.concatenate([across, along], axis=1).T)


def lag_candidates(ones: list[Signature], others: list[Signature]) -> list[LagCandidate]:
    """Return the lags of two cameras at which their people move alike, the likeliest first.

    All pairs of tracklets vote for lags; people who stand still cannot, and there may be none.
    """
    lags = np.arange(-round(LONGEST_LAG_S / STEP_S), round(LONGEST_LAG_S / STEP_S) + 1)
    table = {
        (i, j): scores
        for i, one in enumerate(ones)
        for j, other in enumerate(others)
        if (scores := alikeness(one, other, lags)).any()
    }
    if not table:
        return []
    votes = np.sum(list(table.values()), axis=0)
    votes = np.convolve(votes, [0.5, 1.0, 0.5], "same")
    candidates: list[LagCandidate] = []
    while len(candidates) < LAGS and votes.max() > 0.0:
        k = int(votes.argmax())
        near = slice(max(0, k - 2), k + 3)
        ranked = sorted(table, key=lambda pair: -float(table[pair][near].max()))
        pairs = [pair for pair in ranked[:3] if table[pair][near].any()]
        candidates.append((STEP_S * float(lags[k]), pairs))
        votes[np.abs(lags - lags[k]) < APART_S / STEP_S] = 0.0
    return candidates
