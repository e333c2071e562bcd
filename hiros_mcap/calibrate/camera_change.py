"""When a camera was moved in the middle of a log.

The first and the last third of the log each give a pose of the camera in another one. If both fit,
and differ, each instant tells by which of them its people are nearer. The change is where the sum
of the distances, before it by the first pose and after it by the last one, is least.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hiros_mcap.calibrate.camera_graph import ambiguous, usable
from hiros_mcap.calibrate.camera_result import CalibratedCamera
from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.coarse_clock import (
    LagCandidate,
    Landmarks,
    lag_candidates,
    signatures_of,
)
from hiros_mcap.calibrate.joint_refinement import Points, RigResiduals
from hiros_mcap.calibrate.pair_pose import FIT_M, PairFit, register_pair
from hiros_mcap.calibrate.sampling import CELL_S, Rig, group, instants_of, placed, sample
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
BIN_S = 1.0
"""Between two times of a change that are compared by :func:`two_pose_gains`."""


class CameraChange(NamedTuple):
    """When the second of two cameras was moved, and where it stood in the first one."""

    begin: float
    """Until then it stood at the first pose, s of the first camera's time."""
    end: float
    """From then on it stood at the second one; nobody was seen in between."""
    early: Rig
    late: Rig
    metres: float = 0.0
    """How much nearer people are by the right one of both poses, in the part that gains less."""

    @property
    def seconds(self) -> float:
        """When it was moved, s of its own time."""
        return (self.begin + self.end) / 2.0 - float(self.late.clocks[1])


def find_moves(
    views: Sequence[CameraView], misfits: Sequence[int], landmarks: Landmarks | None, mirror: Ints
) -> dict[str, CameraChange]:
    """Return how and when cameras that do not fit the others were moved, by name.

    Two cameras show that one of them was moved, but not which: it is then the second.
    """
    moves = {}
    for c in misfits:
        partner = partner_of(views, c, [k for k in range(len(views)) if k not in misfits] or [0])
        if partner is not None:
            change = find_change([views[partner], views[c]], landmarks, mirror)
            if change is not None:
                moves[views[c].name] = change
    return moves


def partner_of(views: Sequence[CameraView], c: int, others: Sequence[int]) -> int | None:
    """Return that one of some other cameras which sees most at the same time as camera ``c``."""
    cells = {k: _cells(views[k]) for k in {c, *others}}
    rest = [k for k in others if k != c]
    return max(rest, key=lambda k: len(cells[k] & cells[c]), default=None)


def _cells(view: CameraView) -> set[int]:
    """Return in which tenths of a second a camera sees somebody."""
    seconds = [track.seconds for track in view.tracks]
    return {int(s // CELL_S) for some in seconds for s in some.tolist()}


def split_views(views: Sequence[CameraView], moves: Mapping[str, CameraChange]) -> list[CameraView]:
    """Return the views, those of cameras that were moved as two."""
    parts = []
    for view in views:
        at = moves[view.name].seconds if view.name in moves else None
        spans = [(-np.inf, np.inf)] if at is None else [(-np.inf, at), (at, np.inf)]
        parts += [part_of(view, *span) for span in spans]
    return parts


def with_times(
    cameras: Sequence[CalibratedCamera],
    moves: Mapping[str, CameraChange],
    span: tuple[int, int],
) -> list[CalibratedCamera]:
    """Return the cameras with the times at which they were moved.

    Parameters
    ----------
    cameras : those that were moved twice, one behind the other.
    span : of the log, ns.
    """
    timed = list(cameras)
    for c, (one, other) in enumerate(pairwise(cameras)):
        if one.name == other.name:
            at = sum(span) // 2 + round(1e9 * moves[one.name].seconds)
            seconds = (at - span[0]) / 1e9
            timed[c] = replace(one, until_s=seconds)
            timed[c + 1] = replace(other, since_s=seconds, since=at)
    return timed


def find_change(
    pair: Sequence[CameraView], landmarks: Landmarks | None, mirror: Ints
) -> CameraChange | None:
    """Find out whether the second of two cameras was moved against the first, and when.

    None if it was not, or if the log does not tell.

    Parameters
    ----------
    landmarks : of the skeleton, to find the clocks; see :func:`landmarks_of`. None = the clocks
        are about right. mirror : (M,).
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
    change = located(pair, early.rig, late.rig, mirror)
    if change is None or not begin + LEAST_PART_S < change.seconds < end - LEAST_PART_S:
        return None
    return change


def located(
    pair: Sequence[CameraView], early: Rig, late: Rig, mirror: Ints, better: float = BETTER
) -> CameraChange | None:
    """Find the time at which one pose of the second camera replaces another one.

    None if the distances with the change are more than the share ``better`` of those without.
    """
    instants = instants_of(pair[:1], CHANGE_INSTANTS)
    before, after = (_distances(pair, rig, instants, mirror) for rig in (early, late))
    known = ~np.isnan(before + after)
    instants, before, after = instants[known], before[known], after[known]
    if not len(instants):
        return None
    sums = np.concatenate([[0.0], np.cumsum(before)]) + np.concatenate(
        [np.cumsum(after[::-1])[::-1], [0.0]]
    )
    k = int(sums.argmin())
    if sums[k] > better * min(before.sum(), after.sum()):
        return None
    gains = (after - before)[:k], (before - after)[k:]
    return CameraChange(
        float(instants[k - 1]) if k else -np.inf,
        float(instants[k]) if k < len(instants) else np.inf,
        early,
        late,
        min((float(gain.mean()) for gain in gains if len(gain)), default=0.0),
    )


def two_pose_gains(residuals: RigResiduals, points: Points) -> Floats:
    """(C,) by which share the misfit of each camera falls if it may change its pose once.

    The misfit is the sum of squares about the best rigid fit to the other cameras (Kabsch 1976),
    whose moments add up over time. The change may be anywhere :data:`LEAST_PART_S` from the ends.
    """
    total = residuals.weights.sum(axis=0)
    bins = np.floor((points.seconds - points.seconds.min(initial=np.inf)) / BIN_S).astype(np.int64)
    first, last = int(LEAST_PART_S / BIN_S), int(bins.max(initial=0) + 1 - LEAST_PART_S / BIN_S)
    gains = np.zeros(len(residuals.weights))
    if first > last:
        return gains
    for c, weights in enumerate(residuals.weights):
        rest = total - weights
        seen = np.flatnonzero((weights > 0.0) & (rest > 1e-12))
        own = (residuals.means + residuals.offsets[c])[seen]
        apart = residuals.offsets[c, seen] * (total[seen] / rest[seen])[:, None]
        moments = _moments(own, own - apart, np.minimum(weights, rest)[seen])
        sums = np.zeros((int(bins.max()) + 1, moments.shape[1]))
        np.add.at(sums, bins[seen], moments)
        early = np.cumsum(sums, axis=0)[first - 1 : last]
        both = _misfits(early) + _misfits(sums.sum(axis=0) - early)
        whole = float(_misfits(sums.sum(axis=0)[None])[0])
        gains[c] = 1.0 - float(both.min()) / whole if whole > 0.0 else 0.0
    return gains


def _moments(ones: Floats, others: Floats, weights: Floats) -> Floats:
    """(P, 17) what the misfit of two sets of (P, 3) points is made of, for each pair."""
    products = (ones[:, :, None] * others[:, None, :]).reshape(-1, 9)
    squares = np.sum(ones**2 + others**2, axis=1)[:, None]
    rows = np.concatenate([np.ones((len(ones), 1)), ones, others, products, squares], axis=1)
    return np.asarray(rows * weights[:, None])


def _misfits(moments: Floats) -> Floats:
    """(K,) sum of squares about the best rigid fit of each of K sums of moments."""
    mass = np.maximum(moments[:, :1], 1e-12)
    ones, others = moments[:, 1:4], moments[:, 4:7]
    products = moments[:, 7:16].reshape(-1, 3, 3)
    products = products - ones[:, :, None] * others[:, None, :] / mass[:, :, None]
    spread = moments[:, 16] - np.sum(ones**2 + others**2, axis=1) / mass[:, 0]
    singular = np.linalg.svd(products, compute_uv=False)
    singular[:, 2] *= np.sign(np.linalg.det(products))
    return np.asarray(np.maximum(spread - 2.0 * singular.sum(axis=1), 0.0))


def part_of(view: CameraView, begin: float, end: float) -> CameraView:
    """Return what a camera sees from ``begin`` to ``end``, s of its own time."""
    tracks = []
    for track in view.tracks:
        kept = (track.seconds >= begin) & (track.seconds < end)
        if np.count_nonzero(kept) > 1:
            tracks.append(Tracklet(*(np.ascontiguousarray(array[kept]) for array in track)))
    return replace(view, tracks=tracks)


def _pose(
    one: CameraView, other: CameraView, landmarks: Landmarks | None, mirror: Ints
) -> PairFit | None:
    """Return the pose of a camera in another one, None unless it is the only one that fits."""
    if not other.tracks:
        return None
    if landmarks is None:
        candidates = [LagCandidate(0.0, [])]
    else:
        candidates = lag_candidates(signatures_of(one, landmarks), signatures_of(other, landmarks))
    instants = instants_of([other], PAIR_INSTANTS)
    fits = register_pair([one, other], candidates, instants, mirror)
    return fits[0] if usable(fits) and not ambiguous(fits) else None


def _same(one: Rig, other: Rig) -> bool:
    metres, degrees = one.pose(1).apart(other.pose(1))
    return degrees < LEAST_DEG and metres < LEAST_M


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
