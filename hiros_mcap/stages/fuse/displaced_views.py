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
of the offset to the variance of all views of the camera, after a batch of instants in which most
of them were displaced: poses that are mended on the way come late.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hiros_mcap.events import Events, camera_displaced
from hiros_mcap.kernels.array_types import chosen, joined
from hiros_mcap.skeletons import SECOND, Flags, Floats, Stamps
from hiros_mcap.stages.fuse.fusing import Sightings
from hiros_mcap.stages.known_cameras import KnownCameras

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
_WORTH_S, _WORTH_M = 1.5, 0.06
"""For a warning, people must be off for so long and by so much, without a pause. Parts of a second
occur with healthy cameras, too: while somebody lies, crouches, or is half hidden."""
_OF_ALL = 0.4
"""Share of the views in a part of a second: a camera that was moved shows everybody elsewhere, but
of two who touch one may be seen wrong."""
_PART, _PAUSE = 250_000_000, 4  # ns, and so many of it in which people are in place end one


class DisplacedViews:
    """Finds the cameras that show people elsewhere than the others, and warns of them.

    Parameters
    ----------
    known : has the errors of poses that the people gave.
    is_filter : whether views lose their weight by what those of the last batch have shown.
    """

    def __init__(self, known: KnownCameras, *, is_filter: bool) -> None:
        self._known, self._is_filter = known, is_filter
        self._names: tuple[str, ...] = ()
        self._spans: dict[int, _Span] = {}
        self._batch: list[tuple[Sightings, Floats]] = []
        """Views that a filter has not learned from, and their offsets, m."""
        self._learned = np.zeros(0)
        """(C,) excess, m2, of the next views of each camera; 0 if there is none."""

    def name(self, names: tuple[str, ...]) -> None:
        """Take the names of the cameras, by index."""
        self._names = names
        self._learned = np.pad(self._learned, (0, len(names) - len(self._learned)))

    def expected(self, views: Sightings) -> Floats:
        """(N,) Variance, m2, to be added to views by what a filter has learned so far."""
        return np.asarray(self._learned[views.cameras])

    def take(self, views: Sightings, offsets: Floats, done: Flags) -> Floats:
        """(N,) Excess, m2, of views that are ``offsets`` (N, 3), m, from the results.

        Those whose results are ``done`` are counted.
        """
        if self._is_filter:
            self._batch.append((chosen(views, done), offsets[done]))
            return self.expected(views)
        excess = excess_of(views, offsets, self._limits())
        self.count(views, excess, done)
        return excess

    def learn(self) -> None:
        """Let the next views of a filter have the weight that the batch before shows."""
        if not self._batch:
            return
        batch, offsets = zip(*self._batch, strict=True)
        self._batch, views = [], joined(batch)
        excess = excess_of(views, np.concatenate(offsets), self._limits())
        self.count(views, excess, np.ones(len(excess), np.bool_))
        cameras = np.unique(views.cameras).tolist()
        for camera in cameras if len(cameras) >= MAJORITY else ():
            # Errors of a moment, or of one person among several, are those of a detector.
            own = excess[views.cameras == camera]
            self._learned[camera] = np.quantile(own, 0.5, method="lower")

    def count(self, views: Sightings, excess: Floats, done: Flags) -> None:
        """Note which of the views whose results are ``done`` have lost their weight."""
        for camera in np.unique(views.cameras[done]).tolist():
            own = done & (views.cameras == camera)
            self._spans.setdefault(camera, _Span()).add(views.stamps[own], excess[own])

    def _limits(self) -> Floats:
        least = LIMIT_AHEAD if self._is_filter else LIMIT
        return limits_of(self._names, self._known.errors, least)

    def warn(self, events: Events) -> None:
        """Note the cameras that were displaced for long enough, and those that still are.

        If most are, none is: then the people's views differ, not the cameras.
        """
        self.learn()
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
    seen = counts > 0
    squares = (sums**2).sum(axis=2) / np.maximum(counts, 1.0) ** 2
    ordered, votes = np.sort(np.where(seen, squares, np.inf), axis=1), seen.sum(axis=1)
    middle = ordered[np.arange(n), np.maximum(votes - 1, 0) // 2]
    healthy = np.maximum(limits**2, CLEARLY**2 * middle[:, None])
    excess = np.where(seen & (squares > healthy), SHARE * squares, 0.0)
    for g in np.flatnonzero(votes < MAJORITY).tolist():
        excess[g] = excess[g - 1] if g and people[g] == people[g - 1] else 0.0
    return np.asarray(excess[groups, views.cameras])
