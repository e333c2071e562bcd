"""Views of cameras that are wrong as a whole lose their weight: moved, of a bad pose or clock.

The noise of a detector moves each joint on its own. A camera that stands elsewhere than its pose
says moves all joints of a person together. So the offset of a view is the mean of its joints'
residuals against the fused pose, and the offset of a camera is the mean of its views of a person
over a second: faster changes are those of people. A camera is displaced for that second if its
offset is over LIMIT, and clearly over the median of all cameras that see the person: where all are
off alike, nobody knows which one is wrong. A pose that the people gave may be off by three of its
standard errors. The variance of the views of a displaced camera grows by SHARE times the square of
the offset; they count again from the second on in which they agree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hiros_mcap.events import Events, camera_displaced
from hiros_mcap.kernels.array_types import F1, F2, F3, I1, arrays
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.skeletons import Flags, Floats, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.fuse.fusing import PEOPLE, FusionWindows, Sightings

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
SECOND = 1_000_000_000  # ns
EXACT: Mapping[str, float] = {}  # errors of poses that nobody knows
_MEMORY = 0.5  # s; time constant of the mean without future views
_WORTH_S, _WORTH_M = 1.5, 0.06
"""For a warning, people must be off for so long and by so much, without a pause. Parts of a second
occur with healthy cameras, too: while somebody lies, crouches, or is half hidden."""
_OF_ALL = 0.4
"""Share of the views in a part of a second: a camera that was moved shows everybody elsewhere, but
of two who touch one may be seen wrong."""
_PART, _PAUSE = 250_000_000, 4  # ns, and so many of it in which people are in place end one


class RecentOffsets(NamedTuple):
    """Offsets of the recent views of R people, of which the old ones count less."""

    sums: F3  # (R, C, 3) by cameras, m
    weights: F2  # (R, C) of how many views
    stamps: I1  # (R,) time of the latest, ns


class OffsetsBefore(NamedTuple):
    """By what a filter expects offsets of N views."""

    recent: RecentOffsets
    rows: I1  # (N,) of the person; -1 = nothing is known
    limits: F1  # (C,) offset of each camera, m, up to which it may be healthy; none = a smoother's


class DisplacedViews:
    """Which cameras show people elsewhere than the others, person by person.

    A smoother asks for the excess (:func:`excess_of`) of views whose offsets it has measured, and
    smooths again. A filter expects (:func:`expect`) the excess that the views ``before`` had.
    ``pose_errors`` are those of :func:`limits_of`.
    """

    def __init__(self, pose_errors: Mapping[str, float] = EXACT) -> None:
        self._pose_errors = pose_errors
        self._names: tuple[str, ...] = ()
        self._bank = Bank(arrays(RecentOffsets, (0, 0, 3), (0, 0), 0))
        self._spans: dict[int, _Span] = {}
        self._uncounted: list[tuple[Stamps, Stamps, Floats]] = []
        """Cameras, times, ns, and excess, m2, of views of the latest part of a second."""

    def name(self, names: tuple[str, ...]) -> None:
        """Take the names of the cameras, by index."""
        new = len(names) - len(self._names)
        self._names = names
        sums, weights, stamps = self._bank.past
        sums = np.pad(sums, ((0, 0), (0, new), (0, 0)))
        self._bank.past = RecentOffsets(sums, np.pad(weights, ((0, 0), (0, new))), stamps)

    @property
    def nothing(self) -> OffsetsBefore:
        """What a smoother takes, which compares views with its own results."""
        return OffsetsBefore(self._bank.past, np.empty(0, np.int64), np.empty(0))

    def before(self, windows: FusionWindows) -> OffsetsBefore:
        """Return what the views before tell; the people of ``windows`` are remembered."""
        begin = 0
        for end, boundary in zip(
            windows.ends[:, PEOPLE].tolist(), windows.boundaries.tolist(), strict=True
        ):
            self._bank.expire(boundary)
            for person in windows.everybody[begin:end].tolist():
                self._bank.row(person, boundary)
            begin = end
        people, places = np.unique(windows.views.people, return_inverse=True)
        rows = [self._bank.rows.get(person, -1) for person in people.tolist()]
        limits = limits_of(self._names, self._pose_errors, LIMIT_AHEAD)
        return OffsetsBefore(self._bank.past, np.array(rows, np.int64)[places], limits)

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
    excess = np.zeros(counts.shape)
    displace_all(sums, counts, limits, excess)
    for g in range(1, n):
        if people[g] == people[g - 1] and (counts[g] > 0).sum() < MAJORITY:
            excess[g] = excess[g - 1]
    return np.asarray(excess[groups, views.cameras])


# Offsets of cameras, compiled.


@inlined
def _square(sums: Floats, weights: Floats, camera: int) -> float:
    """Return the square of the offset of a camera, m2."""
    x, y, z = sums[camera, 0], sums[camera, 1], sums[camera, 2]
    return (x * x + y * y + z * z) / (weights[camera] * weights[camera])


@kernel
def displaced(sums: Floats, weights: Floats, limits: Floats, camera: int) -> float:
    """Variance, m2, to be added to the views of a camera; mostly 0.

    ``sums`` (C, 3) of offsets, m, ``weights`` (C,) of views, 0 = none, ``limits`` (C,), m.
    """
    square = _square(sums, weights, camera)
    if weights[camera] == 0.0 or square <= limits[camera] * limits[camera]:
        return 0.0
    count = 0
    for k in range(len(weights)):
        count += int(weights[k] > 0.0)
    if count < MAJORITY:
        return 0.0
    for k in range(len(weights)):
        middle, nearer = _square(sums, weights, k), 0
        for j in range(len(weights)):
            other = _square(sums, weights, j)
            nearer += int(weights[j] > 0.0 and (other < middle or (other == middle and j < k)))
        if weights[k] > 0.0 and nearer == (count - 1) // 2:  # the median
            return SHARE * square if square > CLEARLY * CLEARLY * middle else 0.0
    return 0.0


@kernel
def expect(before: OffsetsBefore, cameras: Stamps, begin: int, end: int, excess: Floats) -> None:
    """Write the variance, m2, to be added to views, by the offsets of the views before them."""
    for n in range(begin, end):
        row, excess[n] = before.rows[n], 0.0
        if row >= 0:
            sums, weights = before.recent.sums[row], before.recent.weights[row]
            excess[n] = displaced(sums, weights, before.limits, cameras[n])


@kernel
def remember(
    before: OffsetsBefore, cameras: Stamps, stamps: Stamps, offsets: Floats, begin: int, end: int
) -> None:
    """Take the offsets (N, 3) of views, m; NaN = none. Each view comes once with an offset."""
    recent, now = before.recent, 0
    for n in range(begin, end):
        now = now if math.isnan(offsets[n, 0]) else max(now, stamps[n])
    for n in range(begin, end):
        row, k = before.rows[n], cameras[n]
        if math.isnan(offsets[n, 0]):
            continue
        if now > recent.stamps[row]:
            keep = math.exp(-(now - recent.stamps[row]) * 1e-9 / _MEMORY)
            for j in range(len(before.limits)):
                recent.weights[row, j] *= keep
                for c in range(3):
                    recent.sums[row, j, c] *= keep
            recent.stamps[row] = now
        recent.weights[row, k] += 1.0
        for c in range(3):
            recent.sums[row, k, c] += offsets[n, c]


@entry
def displace_all(sums: F3, weights: F2, limits: F1, excess: F2) -> None:
    """Write what :func:`displaced` says of the cameras of G groups of views, (G, C) m2."""
    for g in range(len(weights)):
        for k in range(len(limits)):
            excess[g, k] = displaced(sums[g], weights[g], limits, k)
