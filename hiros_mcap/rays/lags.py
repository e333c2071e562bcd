"""By how much the clocks of RGB cameras differ, from the people whom they film.

Two cameras and a joint span a plane. About the line between the cameras, it has one angle, which
both cameras see: a signature of the person's motion. It hardly depends on errors of the poses,
since a mean is taken off. The people of two cameras are correlated at all lags, and the lags that
all pairs of cameras like best are the coarse ones. The bundle adjustment refines them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from hiros_mcap.kernels.correlation import STEP_S, Signature, alikeness
from hiros_mcap.kernels.local_line import Tracklet
from hiros_mcap.kernels.ray_equations import RayCameras
from hiros_mcap.rays.bundle import centres_of
from hiros_mcap.rays.image_tracks import ImageView, lines_at
from hiros_mcap.skeletons import Floats, Stamps

LONGEST_LAG_S = 3.0
LAGS: Stamps = np.arange(-round(LONGEST_LAG_S / STEP_S), round(LONGEST_LAG_S / STEP_S) + 1)
"""Lags that are tried, in steps of 50 ms."""
APART_S = 0.3
"""Lags that differ by less are the same peak of a correlation."""
RIVAL = 0.75
"""Share of the votes for a lag from which on another one is a rival."""
_ALONG = 0.15
"""Sine of the angle between a ray and the line of two cameras, below which it tells no plane."""


def coarse_lags(views: Sequence[ImageView], cameras: RayCameras) -> tuple[list[Floats], float]:
    """Return lags of the cameras' clocks, (C,) s, to a step: the likeliest, and its rivals.

    People who move regularly fit at other lags nearly as well: at another one of a camera, or with
    all clocks right. What speaks for the best rival of a camera's lag is returned, too, as a share
    of what speaks for the lag, 0 if it is small. The lag of the first camera is 0, and that of
    cameras before whom nobody moves.

    Parameters
    ----------
    cameras : about right.
    """
    votes = lag_votes(views, cameras)
    n = len(views)
    steps, placed = np.zeros(n, np.int64), {0}
    while len(placed) < n:
        totals = {c: _total(votes, steps, placed, c) for c in range(n) if c not in placed}
        c = max(totals, key=lambda c: float(totals[c].max()))
        if not totals[c].any():
            break
        steps[c] = LAGS[totals[c].argmax()]
        placed.add(c)
    rival, share = steps, RIVAL
    for c in sorted(placed - {0}):  # who came early was placed by few
        total = _total(votes, steps, placed - {c}, c)
        steps[c] = LAGS[total.argmax()]
        others = np.where(np.abs(LAGS - steps[c]) > APART_S / STEP_S, total, 0.0)
        if others.max() > share * total.max():
            share, other = float(others.max() / total.max()), LAGS[others.argmax()]
            rival = np.where(np.arange(n) == c, other, steps)
    likely = [steps] if rival is steps else [steps, rival]
    at_zero, at_steps = (
        sum(
            pair[LAGS[-1] + min(max(lags[b] - lags[a], LAGS[0]), LAGS[-1])]
            for (a, b), pair in votes.items()
        )
        for lags in (np.zeros_like(steps), steps)
    )
    if at_zero > RIVAL * at_steps and steps.any():
        likely.append(np.zeros_like(steps))
    return [np.asarray(STEP_S * lags) for lags in likely], share if rival is not steps else 0.0


def _total(votes: dict[tuple[int, int], Floats], steps: Stamps, others: set[int], c: int) -> Floats:
    """(L,) votes of some cameras for the lag of one more."""
    total = np.zeros(len(LAGS))
    for other in sorted(others):
        pair = votes[min(c, other), max(c, other)]
        at = LAGS - steps[other] if other < c else steps[other] - LAGS  # later camera less earlier
        inside = np.abs(at) <= LAGS[-1]
        total[inside] += pair[at[inside] + LAGS[-1]]
    return total


def lag_votes(views: Sequence[ImageView], cameras: RayCameras) -> dict[tuple[int, int], Floats]:
    """Return how much speaks for each lag (L,) of the second of two cameras, by pair."""
    centres = centres_of(cameras)
    tracks = [[sampled(track, view.half_width) for track in view.tracks] for view in views]
    room = [
        [(first, rays @ cameras.rotations[c]) for first, rays in every]
        for c, every in enumerate(tracks)
    ]
    votes = {}
    for a, b in combinations(range(len(views)), 2):
        axes = _axes(centres[b] - centres[a], [rays for _, rays in room[a] + room[b]])
        ones, others = ([_signature(*each, axes) for each in room[c]] for c in (a, b))
        total = np.zeros(len(LAGS))
        for one in ones:
            for other in others:
                total += alikeness(one, other, LAGS)
        votes[a, b] = np.convolve(total, [0.5, 1.0, 0.5], "same")
    return votes


def sampled(track: Tracklet, half_width: float) -> tuple[int, Floats]:
    """Return the first step of a tracklet, and its rays (T, J, 3) at every step."""
    first = int(np.ceil(track.seconds[0] / STEP_S))
    steps = np.arange(first, int(np.floor(track.seconds[-1] / STEP_S)) + 1, dtype=np.float64)
    times: Floats = STEP_S * steps
    lines = lines_at(track, times, half_width)
    return first, np.where(lines.weights[..., None] > 0.0, lines.positions, np.nan)


def _axes(line: Floats, rays: Sequence[Floats]) -> Floats:
    """(2, 3) orthonormal rows across a line; the first one points to where the people are."""
    along = line / max(float(np.linalg.norm(line)), 1e-9)
    usual = sum((np.nansum(each, axis=(0, 1)) for each in rays), start=np.full(3, 1e-9))
    first = usual - (usual @ along) * along
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(along, first)])


def _signature(first: int, rays: Floats, axes: Floats) -> Signature:
    """Return the angle of each joint's plane about the line of two cameras, (J, T) rad."""
    x, y = np.moveaxis(rays @ axes.T, -1, 0)
    with np.errstate(invalid="ignore"):
        plain = np.hypot(x, y) > _ALONG * np.linalg.norm(rays, axis=-1)
    return first, np.ascontiguousarray(np.where(plain, np.arctan2(y, x), np.nan).T)
