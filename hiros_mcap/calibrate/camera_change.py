"""When a camera was moved in the middle of a log.

The first and the last third of the log each give a pose of the camera in another one. If both fit,
and differ, each instant tells by which of them its people are nearer. The change is where the sum
of the distances, before it by the first pose and after it by the last one, is least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hiros_mcap.calibrate.camera_graph import ambiguous, usable
from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.coarse_clock import Landmarks, lag_candidates, signatures_of
from hiros_mcap.calibrate.pair_pose import FIT_M, PairFit, register_pair
from hiros_mcap.calibrate.sampling import Rig, group, instants_of, placed, sample
from hiros_mcap.kernels.local_line import Tracklet
from hiros_mcap.skeletons import Floats, Ints

PAIR_INSTANTS = 100
CHANGE_INSTANTS = 400
LEAST_PART_S = 5.0
"""A shorter part does not tell a pose."""
LEAST_DEG, LEAST_M = 0.7, 0.03
"""Poses of the thirds that are nearer to each other than both are the same."""
BETTER = 0.85
"""With the change, the sum of distances is at most this share of that without."""


def find_change(pair: Sequence[CameraView], landmarks: Landmarks, mirror: Ints) -> float | None:
    """Return when the second of two cameras was moved against the first, s of its own time.

    None if it was not, or if the log does not tell. Seconds count from the middle of the log.

    Parameters
    ----------
    landmarks : of the skeleton; see :func:`landmarks_of`. mirror : (M,).
    """
    one, other = pair
    if not (one.tracks and other.tracks):
        return None
    begin, end = (float(f([t.seconds[k] for t in other.tracks])) for f, k in ((min, 0), (max, -1)))
    third = (end - begin) / 3.0
    early = _pose(one, part_of(other, begin, begin + third), landmarks, mirror)
    late = _pose(one, part_of(other, end - third, end), landmarks, mirror)
    if early is None or late is None or _same(early.rig, late.rig):
        return None
    instants = instants_of([one], CHANGE_INSTANTS)
    before, after = (_distances(pair, fit.rig, instants, mirror) for fit in (early, late))
    known = ~np.isnan(before + after)
    instants, before, after = instants[known], before[known], after[known]
    if not len(instants):
        return None
    sums = np.concatenate([[0.0], np.cumsum(before)]) + np.concatenate(
        [np.cumsum(after[::-1])[::-1], [0.0]]
    )
    k = int(sums.argmin())
    if sums[k] > BETTER * min(before.sum(), after.sum()):
        return None
    at = float(np.mean(instants[max(k - 1, 0) : k + 1])) - float(late.rig.clocks[1])
    return at if begin + LEAST_PART_S < at < end - LEAST_PART_S else None


def part_of(view: CameraView, begin: float, end: float) -> CameraView:
    """Return what a camera sees from ``begin`` to ``end``, s of its own time."""
    tracks = []
    for track in view.tracks:
        kept = (track.seconds >= begin) & (track.seconds < end)
        if np.count_nonzero(kept) > 1:
            tracks.append(Tracklet(*(np.ascontiguousarray(array[kept]) for array in track)))
    return replace(view, tracks=tracks)


def _pose(one: CameraView, other: CameraView, landmarks: Landmarks, mirror: Ints) -> PairFit | None:
    """Return the pose of a camera in another one, None unless it is the only one that fits."""
    if not other.tracks:
        return None
    candidates = lag_candidates(signatures_of(one, landmarks), signatures_of(other, landmarks))
    instants = instants_of([other], PAIR_INSTANTS)
    fits = register_pair([one, other], candidates, instants, mirror)
    return fits[0] if usable(fits) and not ambiguous(fits) else None


def _same(one: Rig, other: Rig) -> bool:
    turn = one.rotations[1] @ other.rotations[1].T
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)))
    return bool(angle < LEAST_DEG and np.linalg.norm(one.shifts[1] - other.shifts[1]) < LEAST_M)


def _distances(pair: Sequence[CameraView], rig: Rig, instants: Floats, mirror: Ints) -> Floats:
    """(K,) mean distance of the people of two cameras, m; NaN unless both see somebody.

    Somebody who fits nobody counts with the distance at which people do not fit any more.
    """
    samples = sample(pair, instants, rig)
    distances = group(samples, placed(samples, rig), mirror, FIT_M).distances
    found = np.full(len(instants), np.nan)
    counts = [
        np.bincount(samples.instants[samples.cameras == c], minlength=len(instants)) for c in (0, 1)
    ]
    common = np.minimum(*counts)
    fitting = np.isfinite(distances)
    sums = np.bincount(samples.instants[fitting], distances[fitting], minlength=len(instants))
    matched = np.bincount(samples.instants[fitting], minlength=len(instants))
    both = common > 0
    found[both] = (sums + FIT_M * np.maximum(common - matched, 0))[both] / common[both]
    return found
