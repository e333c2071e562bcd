"""Images of unsynchronised cameras at common instants: keypoints between two images.

An instant is the time of an image: the one that is nearest to a period after the instant before,
whichever camera it is of. Keypoints of the other cameras are interpolated between
the image before and the one after, never across a gap. So cameras in step need no interpolation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.kernels.assignment import assign
from hiros_mcap.skeletons import SECOND, Floats, Stamps

_STEP = 0.75  # of the shortest period: from here on an image makes an instant
_GAP = 2.5  # periods of a camera, after which it has lost images
_USUAL = SECOND // 30  # ns; period before any is known
_PERIODS = 15  # that the median is of
_WAIT = 0.15  # s that others wait for a camera that is late
_START = SECOND  # ns; for which a camera that has sent nothing is waited for
_SAME = 0.05  # of a period: an image as near to the next instant makes it at once
_AT_ONCE = 500_000  # ns: an image as near is of the instant
_MOVED = 0.5  # of a person's size in the image: how far it may move from one image to the next


class ImagePeople(NamedTuple):
    """The people in one image, without distortion."""

    stamp: int
    """ns, in the time that the cameras share."""
    pose: Rigid
    """Of the camera in the fixed frame."""
    points: Floats
    """(P, J, 2) x / z and y / z; NaN = not found."""
    scores: Floats
    """(P, J)"""
    tracks: Stamps
    """(P,) number of each person within the images of this camera."""


@dataclass
class ImageStream:
    """The images of one camera, as they come; each person keeps its number from one to the next."""

    camera: str
    sights: list[ImagePeople] = field(default_factory=list)
    """The last ones."""
    count: int = 0
    """People so far."""
    steps: list[int] = field(default_factory=list)
    """ns between the last images."""
    period: int = _USUAL
    """Usual time between two images, ns."""

    @property
    def newest(self) -> int:
        """Stamp of the last image, ns; -1 before the first."""
        return self.sights[-1].stamp if self.sights else -1

    def add(self, stamp: int, pose: Rigid, points: Floats, scores: Floats) -> None:
        """Take an image that is later than those before."""
        tracks = np.full(len(points), -1)
        if self.sights:
            self.steps = [*self.steps[1 - _PERIODS :], stamp - self.newest]
            self.period = sorted(self.steps)[len(self.steps) // 2]
            if stamp - self.newest < _GAP * self.period:
                tracks = followed(self.sights[-1], points)
        new = np.flatnonzero(tracks < 0)
        tracks[new] = self.count + np.arange(len(new))
        self.count += len(new)
        self.sights.append(ImagePeople(stamp, pose, points, scores, tracks))

    def forget(self, instant: int) -> None:
        """Forget images that no instant after ``instant`` needs."""
        while len(self.sights) > 1 and self.sights[1].stamp <= instant:
            self.sights.pop(0)

    def at(self, instant: int) -> ImagePeople | None:
        """Return the people at an instant; None if the camera has no images about it."""
        for sight in self.sights:
            if abs(sight.stamp - instant) <= _AT_ONCE:
                return sight
        later = next((k for k, s in enumerate(self.sights) if s.stamp > instant), 0)
        if not later:
            return None
        before, after = self.sights[later - 1], self.sights[later]
        if after.stamp - before.stamp > _GAP * self.period:
            return None
        return between(before, after, instant)


def between(before: ImagePeople, after: ImagePeople, instant: int) -> ImagePeople:
    """Return the people of two images at a time between them, those that both show."""
    tracks, first, second = np.intersect1d(before.tracks, after.tracks, return_indices=True)
    share = (instant - before.stamp) / (after.stamp - before.stamp)
    points = (1 - share) * before.points[first] + share * after.points[second]
    scores = np.minimum(before.scores[first], after.scores[second])
    pose = before.pose if before.pose is after.pose else before.pose.towards(after.pose, share)
    return ImagePeople(instant, pose, points, scores, tracks)


def followed(before: ImagePeople, points: Floats) -> Stamps:
    """(P,) Number of each person, of those in the image before; -1 = new.

    As many pairs as possible, none of whom moved by half of its size, with the shortest ways.
    """
    if not len(before.points) or not len(points):
        return np.full(len(points), -1)
    ways = np.linalg.norm(before.points[:, None] - points[None], axis=-1)
    cost = mean_known(ways)
    size = np.maximum(sizes_of(before.points)[:, None], sizes_of(points)[None])
    cost[~(cost < _MOVED * size)] = np.inf  # also where no joint is in both
    rows = assign(np.ascontiguousarray(cost))
    return np.where(rows >= 0, before.tracks[rows], -1)


def sizes_of(points: Floats) -> Floats:
    """(P,) Half of the diagonal of the rectangle around each person's keypoints (P, J, 2)."""
    with np.errstate(invalid="ignore"):
        low = np.fmin.reduce(points, axis=1)
        high = np.fmax.reduce(points, axis=1)
    return np.asarray(np.linalg.norm(high - low, axis=-1) / 2)


def mean_known(values: Floats) -> Floats:
    """Mean along the last axis of what is known; NaN if nothing is."""
    known = np.isfinite(values)
    sums = np.where(known, values, 0.0).sum(axis=-1)
    with np.errstate(invalid="ignore"):
        return np.asarray(sums / known.sum(axis=-1))


class CommonInstants:
    """Brings the images of several cameras to common instants.

    Attributes
    ----------
    late : images that came out of order, or when their time was over, by camera.
    wait : ns that others wait for a camera that is late.
    """

    def __init__(self) -> None:
        self.streams: dict[str, ImageStream] = {}
        self.late: dict[str, int] = {}
        self.wait = int(_WAIT * SECOND)
        self._last, self._begin = -1, -1
        self._candidates: list[int] = []

    def add_camera(self, name: str, slack: float = 0.0) -> None:
        """Let a camera join; ``slack`` s is how much later than the usual images may come now."""
        self.streams[name], self.late[name] = ImageStream(name), 0
        self.wait = int((_WAIT + slack) * SECOND)

    def add(
        self, camera: str, stamp: int, pose: Rigid, points: Floats, scores: Floats
    ) -> Iterator[tuple[int, dict[str, ImagePeople]]]:
        """Take an image; yield the instants that are complete, each with what cameras saw."""
        stream = self.streams[camera]
        if stamp <= max(stream.newest, self._last - self.wait):
            self.late[camera] += 1
            return
        stream.add(stamp, pose, points, scores)
        self._begin = stamp if self._begin < 0 else self._begin
        self._candidates.append(stamp)
        yield from self._complete(at_end=False)

    def rest(self) -> Iterator[tuple[int, dict[str, ImagePeople]]]:
        """Yield the instants that wait for images which do not come any more."""
        yield from self._complete(at_end=True)

    def _complete(self, *, at_end: bool) -> Iterator[tuple[int, dict[str, ImagePeople]]]:
        """Yield instants until one has to wait."""
        while (instant := self._next(at_end=at_end)) is not None:
            if not at_end and self._waits(instant):
                return
            self._last = instant
            sights = {n: s.at(instant) for n, s in self.streams.items()}
            yield instant, {n: sight for n, sight in sights.items() if sight is not None}
            for stream in self.streams.values():
                stream.forget(instant)

    def _next(self, *, at_end: bool) -> int | None:
        """Return the next instant: a period after the last, as nearly as images allow."""
        period = min(s.period for s in self.streams.values())
        if self._last < 0:
            return min(self._candidates, default=None)
        first, ideal = self._last + int(_STEP * period), self._last + period
        self._candidates = [s for s in self._candidates if s >= first]
        nearest = min(self._candidates, key=lambda s: (abs(s - ideal), s), default=None)
        if nearest is None or nearest > ideal + period:
            return min(self._candidates, default=None)
        # One that is nearer still may come.
        comes = abs(nearest - ideal) > _SAME * period and self._now < 2 * ideal - nearest
        return None if comes and not at_end and nearest < ideal else nearest

    @property
    def _now(self) -> int:
        return max(stream.newest for stream in self.streams.values())

    def _waits(self, instant: int) -> bool:
        """Whether a camera may still send an image that an instant needs."""
        now = self._now
        if now - instant >= self.wait:
            return False
        return any(
            now - stream.newest < self.wait + stream.period
            if stream.sights
            else now - self._begin < _START
            for stream in self.streams.values()
            if stream.newest < instant
        )
