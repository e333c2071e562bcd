"""Views of cameras that are wrong as a whole lose their weight: moved, of a bad pose or clock.

The noise of a detector moves each joint on its own. A camera that stands elsewhere than its pose
says moves all joints of a person together. So the offset of a view is the mean of its joints'
residuals against the fused pose, and the offset of a camera is the mean of its views of a person
over a second: faster changes are those of people. A camera is displaced for that second if its
offset is over LIMIT, and clearly over the median of all cameras that see the person: where all are
off alike, nobody knows which one is wrong. The variance of its views grows by SHARE times the
square of the offset.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.skeletons import Flags, Floats, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.fuse.fusing import FusedPoses, Sightings
from hiros_mcap.stages.track.displaced import CAMERA_DISPLACED

LIMIT, LIMIT_AHEAD = 0.035, 0.06
"""m; of a smoother, and of a filter, whose poses and means are less sure. Healthy cameras of
simulated rigs with three cameras or more mostly stay below."""
CLEARLY = 1.9
"""Offset over the median of the cameras. One of three that is off by d moves the mean by d / 3, so
it has twice the offset of the others; with more cameras the ratio is larger."""
SHARE = 100.0
"""The offset lasts, and noise averages out: the variance of a view must be far over its square."""
MAJORITY = 3  # fewer cameras do not tell which one of them is wrong
SECOND = 1_000_000_000  # ns
_MEMORY = 0.5  # s; time constant of the mean without future views
_WORTH_S, _WORTH_M = 1.5, 0.06
"""For a warning, people must be off for so long and by so much. Parts of a second that are off by
less occur with healthy cameras, too: while somebody lies or crouches."""
_OF_ALL = 0.4
"""Share of the views in a part of a second: a camera that was moved shows everybody elsewhere, but
of two who touch one may be seen wrong."""
_PART, _PAUSE = 250_000_000, 4  # ns, and so many of it without such views end a displacement


def view_offsets(
    views: Sightings, variances: Floats, poses: FusedPoses, stamps: Stamps, rows: Stamps
) -> Floats:
    """(N, 3) Mean residual of the joints of each view, m; NaN = nothing to compare.

    Parameters
    ----------
    variances : (N, M) of the measurements, m2. poses, stamps : (K, M) results and (K,) times, ns.
    rows : (N,) the result of each view; -1 = none.
    """
    offsets = np.full((len(rows), 3), np.nan)
    fused = np.flatnonzero(rows >= 0)
    these = rows[fused]
    later = (views.stamps[fused] - stamps[these])[:, None, None] * 1e-9
    residuals = views.positions[fused]  # in place: these arrays are large
    residuals -= poses.positions[these]
    residuals -= later * poses.velocities[these]
    there = ~np.isnan(residuals[:, :, 0])
    weights = np.where(there, 1.0 / variances[fused], 0.0)
    total = weights.sum(axis=1)
    residuals[~there] = 0.0
    sums = np.einsum("nm,nmi->ni", weights, residuals)
    with np.errstate(invalid="ignore"):
        offsets[fused] = sums / total[:, None]
    return offsets


class _Offsets(NamedTuple):
    """Sums over the recent views of R people by C cameras."""

    sums: Floats  # (R, C, 3) of the offsets, m
    weights: Floats  # (R, C) of the views


class DisplacedViews:
    """Which cameras show people elsewhere than the others, person by person.

    A smoother asks for the excess (:func:`excess_of`) of views whose offsets it has measured, and
    smooths again. A filter asks for the excess that is ``expected`` by the views before.
    """

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._bank = Bank(_Offsets(np.zeros((0, 0, 3)), np.zeros((0, 0))))
        self._stamp = 0
        self._spans: dict[int, _Span] = {}

    def name(self, names: tuple[str, ...]) -> None:
        """Take the names of the cameras, by index."""
        new = len(names) - len(self._names)
        self._names = names
        self._bank.past = _Offsets(
            np.pad(self._bank.past.sums, ((0, 0), (0, new), (0, 0))),
            np.pad(self._bank.past.weights, ((0, 0), (0, new))),
        )

    def expected(self, views: Sightings) -> Floats:
        """(N,) Variance, m2, to be added to new views, by the offsets of the views before them."""
        rows = np.array([self._bank.rows.get(p, -1) for p in views.people.tolist()], np.int64)
        variances = displaced(*self._bank.past, LIMIT_AHEAD)
        if not len(variances):
            return np.zeros(len(rows))
        return np.where(rows >= 0, variances[rows, views.cameras], 0.0)

    def remember(self, views: Sightings, offsets: Floats) -> None:
        """Take the offsets of views, m; NaN = none. Each view comes once with an offset."""
        these = np.flatnonzero(~np.isnan(offsets[:, 0]))
        if not len(these):
            return
        stamp = int(views.stamps[these].max())
        rows = np.array([self._bank.row(p, stamp) for p in views.people[these].tolist()], np.int64)
        keep = np.exp(-max(stamp - self._stamp, 0) * 1e-9 / _MEMORY)
        self._stamp = max(stamp, self._stamp)
        for array in self._bank.past:
            array *= keep
        np.add.at(self._bank.past.sums, (rows, views.cameras[these]), offsets[these])
        np.add.at(self._bank.past.weights, (rows, views.cameras[these]), 1.0)
        self._bank.expire(stamp)

    def count(self, views: Sightings, excess: Floats, done: Flags) -> None:
        """Note which of the views whose results are ``done`` have lost their weight."""
        for camera in np.unique(views.cameras[done & (excess > 0)]).tolist():
            these = done & (views.cameras == camera)
            self._spans.setdefault(camera, _Span()).add(views.stamps[these], excess[these])

    def warn(self, events: Events) -> None:
        """Note the cameras that were displaced for long enough to be worth a warning."""
        for camera, span in self._spans.items():
            if span.seconds >= _WORTH_S and span.metres >= _WORTH_M:
                detail = f"shows people {span.metres:.2f} m from where other cameras see them"
                events.note(span.first, CAMERA_DISPLACED, source=self._names[camera], detail=detail)


class _Span:
    """For how long and how far a camera was displaced."""

    def __init__(self) -> None:
        self._parts: set[int] = set()
        self._squares, self._views = 0.0, 0

    def add(self, stamps: Stamps, excess: Floats) -> None:
        """Take the times, ns, and the excess, m2, of views."""
        lost = excess > 0
        parts, index = np.unique(stamps // _PART, return_inverse=True)
        shares = np.bincount(index, lost) / np.maximum(np.bincount(index), 1)
        self._parts.update(parts[shares >= _OF_ALL].tolist())
        self._squares += float(excess[lost].sum()) / SHARE
        self._views += int(lost.sum())

    @property
    def seconds(self) -> float:
        return len(self._parts) * _PART / SECOND

    @property
    def first(self) -> int:
        """When the longest displacement began, ns."""
        parts = np.array(sorted(self._parts))
        spans = np.split(parts, np.flatnonzero(np.diff(parts) > _PAUSE) + 1)
        return int(max(spans, key=len)[0]) * _PART

    @property
    def metres(self) -> float:
        return float(np.sqrt(self._squares / max(self._views, 1)))


def excess_of(views: Sightings, offsets: Floats, n_cameras: int) -> Floats:
    """(N,) Variance, m2, to be added to views with ``offsets`` (N, 3), m, second by second.

    A second without a majority, as in the look-ahead, where offsets are NaN, is like the one
    before.
    """
    keys = np.stack([views.people, views.stamps // SECOND])
    keys, groups = np.unique(keys, axis=1, return_inverse=True)
    groups, n = groups.ravel(), int(groups.max(initial=-1)) + 1
    there = ~np.isnan(offsets[:, 0])
    sums, counts = np.zeros((n, n_cameras, 3)), np.zeros((n, n_cameras))
    np.add.at(sums, (groups[there], views.cameras[there]), offsets[there])
    np.add.at(counts, (groups[there], views.cameras[there]), 1.0)
    excess = displaced(sums, counts)
    for g in range(1, n):
        if keys[0, g] == keys[0, g - 1] and (counts[g] > 0).sum() < MAJORITY:
            excess[g] = excess[g - 1]
    return np.asarray(excess[groups, views.cameras])


def displaced(sums: Floats, weights: Floats, limit: float = LIMIT) -> Floats:
    """(G, C) Variance, m2, to be added to the views of each camera in each group; mostly 0.

    ``sums`` (G, C, 3) of offsets, m, ``weights`` (G, C) of views, 0 = none, ``limit`` in m.
    """
    seen = weights > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = ((sums / weights[:, :, None]) ** 2).sum(axis=2)
    order = np.sort(np.where(seen, squares, np.inf), axis=1)
    count = seen.sum(axis=1)
    if not order.size:
        return np.zeros(weights.shape)
    middle = np.take_along_axis(order, np.maximum(count - 1, 0)[:, None] // 2, axis=1)
    clearly = squares > np.maximum(limit**2, CLEARLY**2 * middle)
    lost = seen & clearly & (count >= MAJORITY)[:, None]
    return np.where(lost, SHARE * squares, 0.0)
