"""When a camera was moved in the middle of a log.

Each stretch of some seconds gives a pose of the camera in another camera's frame. By each of these
poses, people are some distance apart at each instant. Of all pairs of poses, and all times at which
the second could have replaced the first, the best has the least sum of distances. It counts if this
is less than the sum of any single pose, by what a few seconds make.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.joint_refinement import Points
from hiros_mcap.calibrate.pair_pose import (
    FIT_M,
    PAIR_INSTANTS,
    alike,
    ambiguous,
    register_pair,
    usable,
)
from hiros_mcap.calibrate.sampling import CELL_S, Rig, group, instants_of, placed, sample
from hiros_mcap.kernels.array_types import chosen
from hiros_mcap.kernels.rig_equations import RigResiduals
from hiros_mcap.rays.image_tracks import Samples
from hiros_mcap.skeletons import Floats, Ints

CHANGE_INSTANTS = 400
LEAST_PART_S = 3.0
"""A shorter part does not tell a pose."""
STRETCHES = 6
"""A log is looked at in so many stretches of equal length, and in those between them."""
LEAST_DEG, LEAST_M = 0.7, 0.03
"""Poses that are nearer to each other than both are the same."""
BIN_S, LEAST_BINS = 1.0, 2
"""Between two times of a change that are compared by :func:`second_poses`, and from the ends."""


class CameraChange(NamedTuple):
    """When the second of two cameras was moved, and where it stood in the first one."""

    begin: float  # until then it stood at the first pose, s of the first camera's time
    end: float  # from then on it stood at the second one; nobody was seen in between
    early: Rig
    late: Rig
    metres: float = 0.0
    """How much nearer people are by the right one of both poses, in the part that gains less."""

    @property
    def seconds(self) -> float:
        """When it was moved, s of its own time."""
        return (self.begin + self.end) / 2.0 - float(self.late.clocks[1])


def partner_of(views: Sequence[CameraView], c: int, cameras: Sequence[int]) -> int | None:
    """Return which of the other ``cameras`` sees somebody most often together with camera ``c``."""
    cells = {k: _cells(views[k]) for k in {c, *cameras}}
    candidates = [k for k in cameras if k != c]
    return max(candidates, key=lambda k: len(cells[k] & cells[c]), default=None)


def _cells(view: CameraView) -> set[int]:
    """Return the numbers of the tenths of a second in which a camera sees somebody."""
    seconds = [track.seconds for track in view.tracks]
    return {int(s // CELL_S) for times in seconds for s in times.tolist()}


def find_change(pair: Sequence[CameraView], mirror: Ints) -> CameraChange | None:
    """Find out whether the second of two cameras was moved against the first, and when.

    None if it was not, or if the log does not tell. The clocks are about right.
    """
    first, second = pair
    if not (first.tracks and second.tracks):
        return None
    rigs = _stretch_poses(first, second, mirror)
    instants = instants_of(pair[:1], CHANGE_INSTANTS)
    if len(rigs) < 2 or len(instants) < 2:
        return None
    distances = np.stack([_distances(pair, rig, instants, mirror) for rig in rigs], axis=1)
    complete = ~np.isnan(distances).any(axis=1)
    instants, distances = instants[complete], distances[complete]
    step = float(np.median(np.diff(instants))) if len(instants) > 1 else np.inf
    least = int(LEAST_PART_S / step)
    if not 0 < least < len(distances) - least:
        return None
    early = np.cumsum(distances, axis=0)
    late = early[-1] - early
    # By the last instant of the first pose, the first pose and the second one.
    sums = (early[:, :, None] + late[:, None])[least - 1 : -least]
    k, before, after = (int(n) for n in np.unravel_index(sums.argmin(), sums.shape))
    if before == after or sums.min() + LEAST_M * least > early[-1].min():
        return None
    k += least  # now the first instant of the second pose
    gains = distances[:, after] - distances[:, before]
    metres = min(float(gains[:k].mean()), float(-gains[k:].mean()))
    ends = float(instants[k - 1]), float(instants[k])
    return CameraChange(*ends, rigs[before], rigs[after], metres)


def _stretch_poses(first: CameraView, second: CameraView, mirror: Ints) -> list[Rig]:
    """Return the different poses of the second camera in the first that stretches of a log give."""
    begin = min(float(track.seconds[0]) for track in second.tracks)
    end = max(float(track.seconds[-1]) for track in second.tracks)
    length = max((end - begin) / STRETCHES, LEAST_PART_S)
    rigs: list[Rig] = []
    for at in np.arange(begin, end - 0.75 * length, length / 2.0):
        rig = _pose(first, part_of(second, at, at + length), mirror)
        if rig is not None and not any(alike(rig, other, LEAST_DEG, LEAST_M) for other in rigs):
            rigs.append(rig)
    return rigs


def located(pair: Sequence[CameraView], early: Rig, late: Rig, mirror: Ints) -> CameraChange:
    """Find the time at which one pose of the second camera replaces another one.

    It begins at -inf, or ends at inf, if one of the poses fits throughout.
    """
    instants = instants_of(pair[:1], CHANGE_INSTANTS)
    before, after = (_distances(pair, rig, instants, mirror) for rig in (early, late))
    present = ~np.isnan(before + after)
    edges = np.concatenate([[-np.inf], instants[present], [np.inf]])
    gains = np.concatenate([[0.0], np.cumsum((before - after)[present])])
    k = int(gains.argmin())
    return CameraChange(float(edges[k]), float(edges[k + 1]), early, late)


class SecondPose(NamedTuple):
    """The gain if a camera had another pose from some time on."""

    share: float = 0.0  # of the misfit that is gone then
    metres: float = 0.0
    """How far one pose for all puts people off in the part that is seen less, root mean square."""
    seconds: float = 0.0  # from when on, common time


def second_poses(residuals: RigResiduals, points: Points) -> list[SecondPose]:
    """Return what each of C cameras would gain by a second pose.

    The misfit is the sum of squares about the best rigid fit to the other cameras (Kabsch 1976),
    whose moments add up over time. Each part has :data:`LEAST_BINS` seconds with people.
    """
    start = points.seconds.min(initial=np.inf)
    bins = np.floor((points.seconds - start) / BIN_S)
    cameras = []
    for c, (is_seen, apart, weights) in enumerate(residuals.against_others()):
        positions = (residuals.means + residuals.offsets[c])[is_seen]
        moments = _moments(positions, positions - apart, weights)
        filled, rows = np.unique(bins[is_seen], return_inverse=True)
        sums = np.zeros((len(filled), moments.shape[1]))
        np.add.at(sums, rows, moments)
        total, early = sums.sum(axis=0), np.cumsum(sums, axis=0)[LEAST_BINS - 1 : -LEAST_BINS]
        misfits = _misfits(early) + _misfits(total - early)
        whole = float(_misfits(total[None])[0])
        if not len(misfits) or whole <= 0.0:
            cameras.append(SecondPose())
            continue
        k = int(misfits.argmin())
        better, mass = whole - float(misfits[k]), min(early[k, 0], total[0] - early[k, 0])
        at = float(start + BIN_S * filled[k + LEAST_BINS])
        cameras.append(SecondPose(better / whole, float(np.sqrt(max(better, 0.0) / mass)), at))
    return cameras


def steps_apart(views: Sequence[CameraView], rig: Rig, mirror: Ints) -> Floats:
    """(C, C) by how much more, m, people of two cameras are apart in one part of a log.

    The log is cut in two where the mean distances of both parts differ most significantly. Each
    part has :data:`LEAST_PART_S`. NaN where two cameras do not see people together for so long.
    """
    instants = instants_of(views, PAIR_INSTANTS, rig)
    samples = sample(views, instants, rig)
    places, n = placed(samples, rig), len(views)
    steps = np.full((n, n), np.nan)
    for a, b in combinations(range(n), 2):
        distances = _distances_of(samples, places, (a, b), len(instants), mirror)
        steps[a, b] = steps[b, a] = _step(distances, instants)
    return steps


def _step(distances: Floats, instants: Floats) -> float:
    """Return by how much the mean of (K,) distances, m, changes at one of the instants, s."""
    present = ~np.isnan(distances)
    distances, seconds = distances[present], instants[present]
    early = np.arange(1, len(seconds))
    late, sums = early[::-1], np.cumsum(distances)
    parts = seconds[:-1] - seconds[:1], seconds[-1:] - seconds[1:]
    long = (np.minimum(*parts) > LEAST_PART_S) if len(seconds) else np.zeros(0, np.bool_)
    if not long.any():
        return np.nan
    steps = np.abs(sums[:-1] / early - (sums[-1] - sums[:-1]) / late)
    return float(steps[np.where(long, steps**2 * early * late, -1.0).argmax()])


def _moments(points: Floats, targets: Floats, weights: Floats) -> Floats:
    """(P, 17) moments of P pairs of points: weighted 1, both points, their products and squares."""
    products = (points[:, :, None] * targets[:, None, :]).reshape(-1, 9)
    squares = np.sum(points**2 + targets**2, axis=1)[:, None]
    rows = np.concatenate([np.ones((len(points), 1)), points, targets, products, squares], axis=1)
    return np.asarray(rows * weights[:, None])


def _misfits(moments: Floats) -> Floats:
    """(K,) sum of squares about the best rigid fit of each of K sums of moments."""
    mass = np.maximum(moments[:, :1], 1e-12)
    points, targets = moments[:, 1:4], moments[:, 4:7]
    products = moments[:, 7:16].reshape(-1, 3, 3)
    products = products - points[:, :, None] * targets[:, None, :] / mass[:, :, None]
    spread = moments[:, 16] - np.sum(points**2 + targets**2, axis=1) / mass[:, 0]
    singular = np.linalg.svd(products, compute_uv=False)
    singular[:, 2] *= np.sign(np.linalg.det(products))
    return np.asarray(np.maximum(spread - 2.0 * singular.sum(axis=1), 0.0))


def part_of(view: CameraView, begin: float, end: float) -> CameraView:
    """Return what a camera sees from ``begin`` to before ``end``, s of its own time."""
    parts = [(t, (t.seconds >= begin) & (t.seconds < end)) for t in view.tracks]
    tracks = [chosen(track, kept) for track, kept in parts if np.count_nonzero(kept) > 1]
    return replace(view, tracks=tracks)


def _pose(first: CameraView, second: CameraView, mirror: Ints) -> Rig | None:
    """Return the pose of the second camera in the first; None if none fits, or several do."""
    if not second.tracks:
        return None
    instants = instants_of([second], PAIR_INSTANTS)
    fits = register_pair([first, second], [(0.0, [])], instants, mirror)
    return fits[0].rig if usable(fits) and not ambiguous(fits) else None


def _distances(pair: Sequence[CameraView], rig: Rig, instants: Floats, mirror: Ints) -> Floats:
    """(K,) distances of :func:`_distances_of` of two cameras, by a rig of theirs."""
    samples = sample(pair, instants, rig)
    return _distances_of(samples, placed(samples, rig), (0, 1), len(instants), mirror)


def _distances_of(
    samples: Samples, places: Floats, pair: tuple[int, int], n_instants: int, mirror: Ints
) -> Floats:
    """(K,) mean distance of the people of two cameras, m; NaN unless both see somebody.

    Who fits nobody counts with :data:`~hiros_mcap.calibrate.pair_pose.FIT_M`.

    Parameters
    ----------
    places : (N, M, 3) of all cameras' samples in the common frame, m.
    """
    rows = np.isin(samples.cameras, pair)
    of_pair = samples.part(rows)
    instants, cameras = of_pair.instants, of_pair.cameras
    counts = [np.bincount(instants[cameras == c], minlength=n_instants) for c in pair]
    common = np.minimum(*counts)
    distances = group(of_pair, places[rows], mirror, FIT_M).distances
    fitting = np.isfinite(distances)
    sums = np.bincount(instants[fitting], distances[fitting], minlength=n_instants)
    matched = np.bincount(instants[fitting], minlength=n_instants)
    totals = sums + FIT_M * np.maximum(common - matched, 0)
    means = np.full(n_instants, np.nan)
    return np.asarray(np.divide(totals, common, out=means, where=common > 0))
