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
from hiros_mcap.calibrate.sampling import lines_of
from hiros_mcap.kernels.array_types import F1, F2
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import Floats, SkeletonModel, Stamps

STEP_S = 0.05
LONGEST_LAG_S = 5.0
LEAST_OVERLAP_S = 2.0
ENOUGH_OVERLAP_S = 10.0
LEAST_CORRELATION = 0.4
DIFFERENCE_M = 0.1
"""Signatures of the same person differ by less."""
LAGS = 10
"""The right lag of somebody who walks is one of many: every step looks like the last one."""
APART_S = 0.3


class Landmarks(NamedTuple):
    """The joints that a signature needs."""

    left: Stamps
    """(F,) slots."""
    right: Stamps
    """(F,) slots."""
    pelvis: Stamps
    """Slots whose mean is the pelvis: one, both hips, or all joints of an unknown skeleton."""


Signature = tuple[int, Floats]
"""A tracklet as numbers that every camera agrees on: the time of its first sample, in steps of
50 ms, and features (F, T), m; NaN = unknown."""
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
    return [_signature(view, k, landmarks) for k in range(len(view.tracks))]


def _signature(view: CameraView, k: int, landmarks: Landmarks) -> Signature:
    seconds = view.tracks[k].seconds
    first, last = int(np.ceil(seconds[0] / STEP_S)), int(np.floor(seconds[-1] / STEP_S))
    times: Floats = STEP_S * np.arange(first, last + 1, dtype=np.float64)
    lines = lines_of(view, k, times)
    positions = np.where(lines.weights[:, :, None] > 0.0, lines.positions, np.nan)
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
        if (scores := _scores(one, other, lags)).any()
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


@kernel
def _add_feature(a: Floats, b: Floats, f: int, lag: int, sums: Floats) -> None:
    """Add the moments of one feature at one lag: n, variances, covariance, squared difference."""
    n = sa = sb = saa = sbb = sab = 0.0
    for i in range(max(0, -lag), min(a.shape[1], b.shape[1] - lag)):
        x, y = a[f, i], b[f, i + lag]
        if np.isnan(x) or np.isnan(y):
            continue
        n += 1.0
        sa, sb = sa + x, sb + y
        saa, sbb, sab = saa + x * x, sbb + y * y, sab + x * y
    if n > 0.0:
        sums[0] += n
        sums[1] += saa - sa * sa / n
        sums[2] += sbb - sb * sb / n
        sums[3] += sab - sa * sb / n
        sums[4] += saa + sbb - 2.0 * sab


@entry
def correlate(
    a: F2, b: F2, first: int, correlations: F1, differences: F1, overlaps: F1, sums: F1
) -> None:
    """Correlate signatures (F, T) and (F, U), NaN = absent, at the lags first, first + 1, ...

    At a lag, sample ``i`` of ``a`` belongs to sample ``i + lag`` of ``b``.

    Parameters
    ----------
    correlations : (L,) of each lag, over all features, each less its mean; NaN without an overlap.
    differences : (L,) root mean square difference, m. overlaps : (L,) samples that both have.
    sums : (5,) scratch.
    """
    for k in range(len(overlaps)):
        sums[:] = 0.0
        for f in range(len(a)):
            _add_feature(a, b, f, first + k, sums)
        overlaps[k] = sums[0] / len(a)
        correlations[k] = np.nan
        differences[k] = np.nan
        if sums[0] > 0.0:
            differences[k] = np.sqrt(max(0.0, sums[4]) / sums[0])
            if sums[1] > 0.0 and sums[2] > 0.0:
                correlations[k] = sums[3] / np.sqrt(sums[1] * sums[2])


def _scores(one: Signature, other: Signature, lags: Stamps) -> Floats:
    """(L,) how alike two tracklets are at each lag; 0 where they are not, or hardly overlap."""
    (first, features), (other_first, other_features) = one, other
    longest = STEP_S * min(features.shape[1], other_features.shape[1])
    if longest < LEAST_OVERLAP_S:
        return np.zeros(len(lags))
    offset = int(lags[0]) + first - other_first
    correlations, differences, samples = np.zeros((3, len(lags)))
    correlate(features, other_features, offset, correlations, differences, samples, np.zeros(5))
    overlaps = STEP_S * samples
    alike = (overlaps >= LEAST_OVERLAP_S) & (correlations > LEAST_CORRELATION)
    similar = np.exp(-((differences / DIFFERENCE_M) ** 2))
    scores = correlations * np.minimum(overlaps, ENOUGH_OVERLAP_S) * similar
    return np.where(alike, scores, 0.0)
