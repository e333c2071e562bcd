"""How a result moves, and how late it is: limb lengths, jitter, lag."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from hiros_mcap.evaluate.match import Matches, Track
from hiros_mcap.evaluate.statistics import nan_mean
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.skeletons import Floats, SkeletonModel

MOST_MS = 180
"""Longest delay that is tried: filters of this field lag by up to 150 ms, clocks err either way."""
_COARSE_MS, _FINE_MS = 30, 5
_SAMPLES = 400  # the lag is measured on about this many matches; more do not change it
_STANDS_STILL = 4e-6  # m2: somebody who moves less than 2 mm in 60 ms shows no lag
_PAUSE = 2.5  # usual steps: a longer one interrupts a track


def lengths_of(poses: Floats, model: SkeletonModel) -> Floats:
    """(..., L) Length of every link of ``poses`` (..., M, 3), m; NaN if it lacks a marker."""
    parents, children = np.array(model.link_parents), np.array(model.link_children)
    if not len(parents):
        return np.zeros((*poses.shape[:-2], 0))
    lengths = np.linalg.norm(poses[..., parents, :] - poses[..., children, :], axis=-1)
    return np.where((parents < 0) | (children < 0), np.nan, lengths)


def limb_variations(tracks: Iterable[Track], model: SkeletonModel) -> Floats:
    """(L,) Coefficient of variation of each link's length, mean over the people; NaN if unseen."""
    rows = [np.full(model.n_links, np.nan)]
    for track in tracks:
        lengths = lengths_of(track.poses, model)
        seen = (~np.isnan(lengths)).sum(axis=0) > 1
        row = np.full(model.n_links, np.nan)
        mean = np.nanmean(lengths[:, seen], axis=0)
        row[seen] = np.nanstd(lengths[:, seen], axis=0) / np.where(mean > 0, mean, np.nan)
        rows.append(row)
    return nan_mean(np.stack(rows), 0)


def jitter(tracks: Iterable[Track]) -> Floats:
    """(M,) Mean norm of the second difference between frames of each joint, mm.

    Differences over a pause of the track (2.5 times its usual step) do not count.
    """
    parts: list[Floats] = []
    for track in tracks:
        if len(track.stamps) < 3:
            continue
        steps = np.diff(track.stamps)
        even = np.maximum(steps[1:], steps[:-1]) <= _PAUSE * np.median(steps)
        second = np.linalg.norm(np.diff(track.poses, 2, axis=0), axis=-1)
        parts.append(1000 * second[even])
    return nan_mean(np.concatenate(parts), 0) if parts else np.array([np.nan])


def lag(matches: Matches, truth: Truth) -> float:
    """By how many ms the result is late: the shift of the truth with the least squared error.

    A parabola through the best three shifts gives the fraction; NaN when nobody moves or the log is
    too short.
    """
    some, most = slice(None, None, max(1, len(matches.stamps) // _SAMPLES)), MOST_MS * 1_000_000
    stamps, rows, poses = matches.stamps[some], matches.people[some], matches.poses[some]
    chosen = truth.covers(stamps - most) & truth.covers(stamps + most)
    if not chosen.any():
        return np.nan
    stamps, rows, poses = stamps[chosen], rows[chosen], poses[chosen]

    def cost(shift: int) -> float:
        """Mean squared distance to the truth ``shift`` ms earlier, m2."""
        squares = (truth.positions_of(rows, stamps - shift * 1_000_000) - poses) ** 2
        present = ~np.isnan(squares)
        return float(squares[present].mean()) if present.any() else np.nan

    coarse = list(range(-MOST_MS, MOST_MS + 1, _COARSE_MS))
    costs = np.array(list(map(cost, coarse)))
    if np.isnan(costs).any() or costs.max() - costs.min() < _STANDS_STILL:
        return np.nan
    about = coarse[int(np.clip(np.argmin(costs), 1, len(costs) - 2))]
    shifts = range(about - _COARSE_MS, about + _COARSE_MS + 1, _FINE_MS)
    costs = np.array(list(map(cost, shifts)))
    best = int(np.clip(np.argmin(costs), 1, len(costs) - 2))
    left, middle, right = costs[best - 1 : best + 2]
    curvature = left - 2 * middle + right
    if curvature <= 0:
        return np.nan
    return float(shifts[best] + 0.5 * _FINE_MS * (left - right) / curvature)


def distances_at(matches: Matches, truth: Truth, late_ms: float) -> Floats:
    """(R, M) Distances, m, from the truth at stamps moved by ``late_ms``; NaN if that is NaN."""
    if np.isnan(late_ms):
        return np.zeros((0, 0))
    then = truth.positions_of(matches.people, matches.stamps - round(late_ms * 1e6))
    return np.asarray(np.linalg.norm(matches.poses - then, axis=-1))
