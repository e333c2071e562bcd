"""Cameras that are wrong as a whole: moved, of a bad pose or clock.

The noise of a detector moves each joint on its own. A camera that stands elsewhere than its pose
says moves all joints of a person together. So the offset of a view is the mean of its joints'
residuals against the fused pose, and the offset of a camera is the mean of its views of a person
over a second: faster changes are those of people. A camera is displaced for that second if its
offset is over LIMIT, and clearly over the median of all cameras that see the person: where all are
off alike, nobody knows which one is wrong. A pose that the people gave may be off by three of its
standard errors.

A smoother names these cameras: the vote on joints (:mod:`.majority`) has taken their weight, and
taking more made logs of moved cameras worse, by up to .3 mm. A filter adds SHARE times the square
of the offset to the variance of their next views, until they agree: poses that are mended on the
way come late.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hiros_mcap.events import Events, camera_displaced
from hiros_mcap.kernels.array_types import F1, F2, F3, arrays
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import SECOND, Flags, Floats, Stamps
from hiros_mcap.stages.fuse.fusing import Sightings

LIMIT, LIMIT_AHEAD = 0.035, 0.06
"""m; of a smoother, and of a filter, whose poses and means are less sure. Healthy cameras of
simulated rigs with three cameras or more mostly stay below."""
_ERRORS = 3.0  # standard errors of a pose that explain an offset
CLEARLY = 1.9
"""Offset over the median of the cameras. One of three that is off by d moves the mean by d / 3, so
it has twice the offset of the others; with more cameras the ratio is larger."""
SHARE = 100.0
"""The offset lasts, and noise averages out: the variance of a view must be far over its square."""
MAJORITY = 3  # fewer cameras do not tell which one of them is wrong
_MEMORY = 0.5  # s; time constant of the mean without future views
_WORTH_S, _WORTH_M = 1.5, 0.06
"""For a warning, people must be off for so long and by so much, without a pause. Parts of a second
occur with healthy cameras, too: while somebody lies, crouches, or is half hidden."""
_OF_ALL = 0.4
"""Share of the views in a part of a second: a camera that was moved shows everybody elsewhere, but
of two who touch one may be seen wrong."""
_PART, _PAUSE = 250_000_000, 4  # ns, and so many of it in which people are in place end one


class ViewOffsets(NamedTuple):
    """How far the recent views of R people by C cameras were from the results of a filter."""

    sums: F3  # (R, C, 3) m; old views count less
    counts: F2  # (R, C) how many views; 0 = none
    times: F1  # (R,) of the latest, s

    @classmethod
    def none(cls, people: int, cameras: int) -> ViewOffsets:
        """Return what is known before anybody is seen."""
        return arrays(cls, (people, cameras, 3), (people, cameras), people)


class DisplacedViews:
    """Counts which cameras show people elsewhere than the others, and warns of them."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._spans: dict[int, _Span] = {}
        self._uncounted: list[tuple[Stamps, Stamps, Floats]] = []
        """Cameras, times, ns, and excess, m2, of views of the latest part of a second."""

    def name(self, names: tuple[str, ...]) -> None:
        """Take the names of the cameras, by index."""
        self._names = names

    def count(self, views: Sightings, excess: Floats, done: Flags) -> None:
        """Note which of the views whose results are ``done`` have lost their weight."""
        if not done.any():
            return
        self._uncounted.append((views.cameras[done], views.stamps[done], excess[done]))
        if self._uncounted[0][1][0] // _PART != views.stamps[done][-1] // _PART:
            self._count_all()

    def _count_all(self) -> None:
        """Count, part of a second by part, the views that were noted."""
        if not self._uncounted:
            return
        cameras, stamps, excess = map(np.concatenate, zip(*self._uncounted, strict=True))
        self._uncounted = []
        for camera in np.unique(cameras).tolist():
            these = cameras == camera
            self._spans.setdefault(camera, _Span()).add(stamps[these], excess[these])

    def warn(self, events: Events) -> None:
        """Note the cameras that were displaced for long enough, and those that still are.

        If most are, none is: then the people's views differ, not the cameras.
        """
        self._count_all()
        still = []
        for camera, span in self._spans.items():
            span.close()
            for first, last, metres in span.over:
                name, seconds = self._names[camera], (last - first) / SECOND
                events.log.append(camera_displaced(first, name, metres, seconds=seconds))
            if span.is_worth:
                still.append(camera)
        for camera in still if 2 * len(still) <= len(self._spans) else ():
            span = self._spans[camera]
            events.log.append(camera_displaced(span.first, self._names[camera], span.metres))


class _Span:
    """Since when and how far a camera is displaced, and the times before when it was."""

    def __init__(self) -> None:
        self.first = self._last = 0
        """Begin and end of the displacement, ns."""
        self.over: list[tuple[int, int, float]] = []
        """Begin and end, ns, and distance, m, of those that are over and worth telling."""
        self._parts = self._in_place = 0
        """Parts in which people were displaced, and those since then in which they were not."""
        self._part = self._lost = self._seen = 0
        """The latest part, and how many views lost their weight in it, of how many."""
        self._squares, self._views = 0.0, 0

    def add(self, stamps: Stamps, excess: Floats) -> None:
        """Take the times, ns, and the excess, m2, of views."""
        parts, index = np.unique(stamps // _PART, return_inverse=True)
        lost = np.bincount(index, excess > 0)
        squares = np.bincount(index, excess) / SHARE
        seen = np.bincount(index)
        for part, *of_part in zip(*(a.tolist() for a in (parts, lost, seen, squares)), strict=True):
            self._add(part, *of_part)

    def _add(self, part: int, lost: float, seen: int, squares: float) -> None:
        if part > self._part:
            self.close()
            self._part = part
        self._lost += int(lost)
        self._seen += seen
        self._squares += squares
        self._views += int(lost)

    def close(self) -> None:
        """Count the latest part."""
        if self._lost > 0 and self._lost >= _OF_ALL * self._seen:
            self.first = self.first or self._part * _PART
            self._last = (self._part + 1) * _PART
            self._parts, self._in_place = self._parts + 1, 0
        elif self._seen:
            self._in_place += 1
        self._lost = self._seen = 0
        if self._in_place > _PAUSE:
            if self.is_worth:
                self.over.append((self.first, self._last, self.metres))
            self.first = self._parts = self._views = 0
            self._squares = 0.0

    @property
    def is_worth(self) -> bool:
        """Whether the displacement is long and large enough to be told."""
        return self._parts * _PART >= _WORTH_S * SECOND and self.metres >= _WORTH_M

    @property
    def metres(self) -> float:
        return float(np.sqrt(self._squares / max(self._views, 1)))


def limits_of(
    names: Sequence[str], pose_errors: Mapping[str, float], least: float = LIMIT
) -> Floats:
    """(C,) Offset of each camera, m, up to which it may be healthy.

    ``pose_errors`` has the standard errors, m, of poses that the people gave.
    """
    return np.array([max(least, _ERRORS * pose_errors.get(name, 0.0)) for name in names])


def excess_of(views: Sightings, offsets: Floats, limits: Floats) -> Floats:
    """(N,) Variance, m2, to be added to views with ``offsets`` (N, 3), m, second by second.

    A second without a majority, as in the look-ahead, where offsets are NaN, is like the one
    before. ``limits`` (C,) are those of the cameras, m.
    """
    if not len(views.stamps):
        return np.zeros(0)
    seconds = views.stamps // SECOND - views.stamps.min() // SECOND
    n_seconds = int(seconds.max()) + 1
    # One number per person and second: sorting pairs takes longer than all that follows.
    keys, groups = np.unique(views.people * n_seconds + seconds, return_inverse=True)
    people, n = keys // n_seconds, len(keys)
    there = ~np.isnan(offsets[:, 0])
    sums, counts = np.zeros((n, len(limits), 3)), np.zeros((n, len(limits)))
    np.add.at(sums, (groups[there], views.cameras[there]), offsets[there])
    np.add.at(counts, (groups[there], views.cameras[there]), 1.0)
    excess = np.empty_like(counts)
    find_displaced(sums, counts, limits, excess)
    for g in range(1, n):
        if people[g] == people[g - 1] and (counts[g] > 0).sum() < MAJORITY:
            excess[g] = excess[g - 1]
    return np.asarray(excess[groups, views.cameras])


# The verdict on the cameras that see a person, compiled.


@kernel
def displaced_cameras(sums: Floats, counts: Floats, limits: Floats, excess: Floats) -> None:
    """Write the variance, m2, to be added to the views of each camera of a person; mostly 0.

    Parameters
    ----------
    sums : (C, 3) of offsets, m. counts : (C,) of views, 0 = none. limits : (C,) m.
    """
    n = 0
    for c in range(len(counts)):
        is_seen = counts[c] > 0.0
        excess[c] = _mean_square(sums[c], counts[c]) if is_seen else 0.0
        n += int(is_seen)
    if n < MAJORITY:
        excess[:] = 0.0
        return
    middle = _ranked(counts, excess, (n - 1) // 2)
    for c in range(len(counts)):
        if excess[c] > max(limits[c] * limits[c], CLEARLY * CLEARLY * middle):
            excess[c] *= SHARE
        else:
            excess[c] = 0.0


@kernel
def _mean_square(total: Floats, count: float) -> float:
    """Square of a mean, from the sum (3,) and the number."""
    x, y, z = total[0] / count, total[1] / count, total[2] / count
    square: float = x * x + y * y + z * z
    return square


@kernel
def _ranked(counts: Floats, squares: Floats, rank: int) -> float:
    """Return the square that as many as ``rank`` of the others precede, of cameras with views."""
    for c in range(len(counts)):
        before = 0
        for k in range(len(counts)):
            is_less = squares[k] < squares[c] or (squares[k] == squares[c] and k < c)
            before += int(counts[k] > 0.0 and is_less)
        if counts[c] > 0.0 and before == rank:
            return float(squares[c])
    return np.inf


@entry
def find_displaced(sums: F3, counts: F2, limits: F1, excess: F2) -> None:
    """Write the excess (G, C) of G groups of views; see :func:`displaced_cameras`."""
    for g in range(len(counts)):
        displaced_cameras(sums[g], counts[g], limits, excess[g])


@kernel
def remember_offset(
    row: int, camera: int, time: float, offset: Floats, recent: ViewOffsets
) -> None:
    """Take the offset (3,), m, of a view of a person at a time, s."""
    passed = time - recent.times[row]
    if passed > 0.0:
        keep = math.exp(-passed / _MEMORY)
        for c in range(recent.counts.shape[1]):
            recent.counts[row, c] *= keep
            for axis in range(3):
                recent.sums[row, c, axis] *= keep
        recent.times[row] = time
    recent.counts[row, camera] += 1.0
    for axis in range(3):
        recent.sums[row, camera, axis] += offset[axis]
