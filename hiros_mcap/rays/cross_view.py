"""Who is who among the people in several images of one instant.

People of the instant before are expected in each image, and take the detections nearest to where
they are expected, camera by camera (Chen et al., "Cross-View Tracking for Multi-Human 3D Pose
Estimation at over 100 FPS", CVPR 2020). What is left may be somebody new: who is seen by two
cameras at least, whose rays meet in a body.

Distances are between rays and joints, m, so that near and far people count alike.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import to_matrix
from hiros_mcap.kernels.assignment import assign
from hiros_mcap.rays.common_instants import ImagePeople
from hiros_mcap.rays.triangulation import Rays, Triangulated, triangulate
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel, Stamps

_CAP = 0.5  # m; beyond, a joint is an outlier, however far
_REACH, _SPEED = 0.25, 1.5  # m, m/s: mean distance from a detection that is still somebody
_SWAPPED = 0.5  # share of the distance that is left when left and right are exchanged
_FAMILIAR = 0.05  # m that the person whom a camera followed so far is ahead of others
_NEW = 0.08  # m; mean distance of the rays of somebody new
_JOINS = 0.2  # m; mean distance at which a further camera joins in
_LEAST_JOINTS, _LEAST_SHARE = 5, 0.5
"""Joints, and share of the common ones, that make somebody: rays of two people meet in a few."""
_LONGEST, _SHORT_LINKS = 0.75, 0.85  # m; a body has links as short, but for some outliers
_SMALLEST, _LARGEST = 0.25, 2.6  # m; extent of a body
_VAGUE = 0.08  # m; deviation of a body's joints, beyond which cameras do not tell its place
_FORGET = 0.5  # s without two cameras, after which somebody is gone
_PROOF = 0.25  # s that somebody whom two of several cameras see has to stay; three are proof
_QUICK_PROOF = 0.05  # s; where there are only two, and both do
_FOLLOWS = 0.4  # share of a new difference that the velocity takes
_WHITE = 0.02  # m; noise of a ray before any is known
_LEAST_NOISE, _MOST_NOISE = 0.004, 0.06  # m
_LEARNS, _LEARNS_EACH = 2.0, 0.1  # s: time constant; how often it is enough
_UNEQUAL = 2.0  # a camera that is believed more comes to look better: how much better, at most
_LEAST_FREEDOM = 0.2


class Detections(NamedTuple):
    """All N people in the images of an instant."""

    cameras: Stamps
    """(N,) number of the camera."""
    tracks: Stamps
    """(N,) number among the people of the camera."""
    points: Floats
    """(N, J, 2) x / z and y / z."""
    scores: Floats
    """(N, J)"""
    centres: Floats
    """(C, 3) of the cameras, m."""
    rotations: Floats
    """(C, 3, 3) from the fixed frame to the camera; NaN for a camera without an image."""

    @classmethod
    def of(cls, names: Sequence[str], sights: Mapping[str, ImagePeople], joints: int) -> Detections:
        """Collect what cameras saw, in the order of ``names``."""
        centres = np.full((len(names), 3), np.nan)
        rotations = np.full((len(names), 3, 3), np.nan)
        nobody, nowhere = np.empty(0, np.int64), np.empty((0, joints, 2))
        parts = [(nobody, nobody, nowhere, nowhere[..., 0])]
        for c, name in enumerate(names):
            if sight := sights.get(name):
                centres[c] = sight.pose.translation
                rotations[c] = to_matrix(sight.pose.xyzw).T
                cameras = np.full(len(sight.points), c)
                parts.append((cameras, sight.tracks, sight.points, sight.scores))
        numbers, tracks, points, scores = map(np.concatenate, zip(*parts, strict=True))
        return cls(numbers, tracks, points, scores, centres, rotations)

    def seen(self, camera: int, positions: Floats) -> tuple[Floats, Floats]:
        """Return where a camera sees (..., 3) points: (..., 2) x / z and y / z, and (...,) z, m."""
        local = (positions - self.centres[camera]) @ self.rotations[camera].T
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = np.where(local[..., 2] > 0.1, local[..., 2], np.nan)
            return local[..., :2] / depth[..., None], depth


@dataclass(eq=False)
class Somebody:
    """A person whom cameras follow together."""

    positions: Floats
    """(J, 3) of the last instant at which each joint was found, m."""
    stamp: int
    born: int
    velocities: Floats
    """(J, 3) m/s."""
    is_proven: bool = False
    tracks: dict[int, int] = field(default_factory=dict)
    """Camera -> number of the person among its people."""

    def expected(self, instant: int) -> Floats:
        """(J, 3) Positions at an instant: on with the velocity of the body, and of the joint."""
        seconds = min((instant - self.stamp) * 1e-9, 0.2)
        return self.positions + seconds * self.velocities


@dataclass(frozen=True, eq=False)
class Found:
    """A person at an instant."""

    person: Somebody
    points: Floats
    """(J, 3) m; NaN where cameras do not tell."""
    deviations: Floats
    """(J,) standard deviation along an axis, m."""
    scores: Floats
    """(J,) mean score of the images that agree."""
    views: list[int]
    """Rows of the detections."""
    missed: float
    """Mean distance at which the rays that agree pass the joints, m."""


class People3D:
    """Follows people through the images of several cameras.

    Parameters
    ----------
    model : of the joints. mirror : (J,) joint of the other side.

    Attributes
    ----------
    noises : (C,) standard deviation at which the rays of each camera pass a joint, m; learned.
    joined : (C,) detections of each camera that were somebody's whom another one sees.
    counts : "detections"; of these, "alone", whom no second camera sees, and "vague", whose place
        cameras tell badly; "keypoints"; of these, "outvoted", which other cameras contradict.
    """

    def __init__(self, model: SkeletonModel, mirror: Stamps) -> None:
        self.model, self.mirror = model, mirror
        self.people: list[Somebody] = []
        self.noises = np.zeros(0)
        self.joined = np.zeros(0, np.int64)
        self.counts = Counter[str]()
        self._last = 0
        self._works: dict[int, tuple[Rays, Triangulated]] = {}

    def add_camera(self) -> None:
        """Let a camera join."""
        self.noises = np.append(self.noises, _WHITE)
        self.joined = np.append(self.joined, 0)

    def update(self, instant: int, seen: Detections) -> list[Found]:
        """Return the people at an instant, ns, whom two cameras show at least."""
        points = self._assigned(instant, seen)
        found, free = [], np.ones(len(seen.cameras), np.bool_)
        for person, rows in points.items():
            one = self._located(seen, rows, person.expected(instant), person)
            if one is not None:
                found.append(one)
                free[one.views] = False
        self._take_in(instant, found)
        self.people = [p for p in self.people if (instant - p.stamp) * 1e-9 <= _FORGET]
        born = list(self._new(instant, seen, free))
        for one in born:
            free[one.views] = False
            self.people.append(one.person)
        self.counts["detections"] += len(free)
        self.counts["alone"] += int(free.sum())
        np.add.at(self.joined, seen.cameras[~free], 1)
        for one in (*found, *born):
            self._prove(instant, one, seen)
        self._learn(instant, seen, found)
        shown = [one for one in (*found, *born) if one.person.is_proven]
        vague = [one for one in shown if _misfit(one) > _VAGUE]
        self.counts["vague"] += sum(len(one.views) for one in vague)
        return [one for one in shown if one not in vague]

    # -- the people of before ---------------------------------------------------------------------

    def _assigned(self, instant: int, seen: Detections) -> dict[Somebody, list[int]]:
        """Give each person at most one detection of each camera; mend their sides."""
        rows: dict[Somebody, list[int]] = {person: [] for person in self.people}
        if not self.people:
            return rows
        expected = np.array([person.expected(instant) for person in self.people])
        reach = np.array([_REACH + _SPEED * (instant - p.stamp) * 1e-9 for p in self.people])
        for camera in np.unique(seen.cameras).tolist():
            mine = np.flatnonzero(seen.cameras == camera)
            places, depths = seen.seen(camera, expected)
            straight = _apart(places, depths, seen.points[mine])
            crossed = _apart(places, depths, seen.points[mine][:, self.mirror])
            is_crossed = crossed < _SWAPPED * straight
            cost = np.where(is_crossed, crossed, straight)
            known = np.array([p.tracks.get(camera, -1) for p in self.people])
            cost = cost + np.where(known[:, None] == seen.tracks[mine], 0.0, _FAMILIAR)
            cost[~(cost < reach[:, None])] = np.inf
            for column, row in enumerate(assign(np.ascontiguousarray(cost)).tolist()):
                if row < 0:
                    continue
                n = int(mine[column])
                rows[self.people[row]].append(n)
                if is_crossed[row, column]:
                    seen.points[n] = seen.points[n][self.mirror]
                    seen.scores[n] = seen.scores[n][self.mirror]
        return rows

    def _located(
        self, seen: Detections, rows: list[int], expected: Floats, person: Somebody
    ) -> Found | None:
        """Triangulate a person; a view most of whose joints others contradict is left out."""
        while len(rows) >= 2:
            out = self._triangulated(seen, rows, expected)
            there = np.isfinite(out.distances)
            wrong = (there & ~out.agrees).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
            wrong[there.sum(axis=1) == 0] = 0.0
            if wrong.max() > _LEAST_SHARE and len(rows) > 2:
                rows = [n for k, n in enumerate(rows) if k != int(wrong.argmax())]
                continue
            common = np.isfinite(seen.points[rows, :, 0]).sum(axis=0) >= 2
            n_found = int(np.isfinite(out.deviations).sum())
            if n_found < max(min(_LEAST_JOINTS, self.model.n_markers), _LEAST_SHARE * common.sum()):
                return None
            self.counts["keypoints"] += int(there.sum())
            self.counts["outvoted"] += int((there & ~out.agrees).sum())
            n = np.maximum(out.agrees.sum(axis=0), 1)
            scores = np.where(out.agrees, seen.scores[rows], 0.0).sum(axis=0) / n
            missed = float(out.distances[out.agrees].mean())
            points, deviations = out.points.copy(), out.deviations.copy()
            return Found(person, points, deviations, scores, list(rows), missed)
        return None

    def _triangulated(
        self, seen: Detections, rows: Sequence[int], expected: Floats
    ) -> Triangulated:
        """Triangulate the joints of some detections of a person; valid until the next call."""
        k, joints = len(rows), self.model.n_markers
        if k not in self._works:
            self._works[k] = Rays.allocate(k, joints), Triangulated.allocate(k, joints)
        rays, out = self._works[k]
        cameras = seen.cameras[list(rows)]
        rays.centres[:] = seen.centres[cameras]
        flat = np.concatenate([seen.points[list(rows)], np.ones((k, joints, 1))], axis=-1)
        turned = flat @ seen.rotations[cameras]  # the inverse of a rotation is its transpose
        rays.directions[:] = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        rays.noises[:] = self.noises[cameras][:, None] / np.clip(seen.scores[list(rows)], 0.1, 1.0)
        triangulate(rays, expected, out)
        return out

    def _take_in(self, instant: int, found: Sequence[Found]) -> None:
        """Let people be where they were found."""
        for one in found:
            person, points = one.person, one.points
            seconds = (instant - person.stamp) * 1e-9
            there = np.isfinite(points[:, 0])
            speeds = (points - person.positions) / seconds
            changed = person.velocities + _FOLLOWS * (speeds - person.velocities)
            person.velocities = np.where(np.isfinite(changed), changed, person.velocities)
            body = np.median(person.velocities, axis=0)
            moved = person.positions + seconds * body  # joints that nobody sees go with the body
            person.positions = np.where(there[:, None], points, moved)
            person.velocities[~there] = body
            person.stamp = instant

    # -- somebody new -----------------------------------------------------------------------------

    def _new(self, instant: int, seen: Detections, free: Flags) -> Iterator[Found]:
        """Yield people whom the detections that are left show, the best of them first."""
        free = free.copy()
        while True:
            rows = np.flatnonzero(free).tolist()
            pairs = [(a, b) for a, b in combinations(rows, 2) if seen.cameras[a] != seen.cameras[b]]
            groups = [group for pair in pairs if (group := self._group(instant, seen, pair, rows))]
            if not groups:
                return
            best = max(groups, key=lambda g: (len(g.views), -g.missed))
            best.person.tracks = {int(seen.cameras[n]): int(seen.tracks[n]) for n in best.views}
            free[best.views] = False
            yield best

    def _group(
        self, instant: int, seen: Detections, pair: tuple[int, int], rows: Sequence[int]
    ) -> Found | None:
        """Return the person whom two detections show, with those of others that fit."""
        joints = self.model.n_markers
        nowhere = np.full((joints, 3), np.nan)
        out = self._triangulated(seen, pair, nowhere)
        if not self._is_body(out, seen, pair):
            return None
        members, points = list(pair), out.points.copy()
        others = set(seen.cameras[list(rows)].tolist()) - set(seen.cameras[list(pair)].tolist())
        for camera in sorted(others):
            mine = [n for n in rows if seen.cameras[n] == camera]
            places, depths = seen.seen(camera, points[None])
            away = _apart(places, depths, seen.points[mine])[0]
            if np.isfinite(away).any() and np.nanmin(away) < _JOINS:
                members.append(mine[int(np.nanargmin(away))])
        person = Somebody(nowhere, instant, instant, np.zeros((joints, 3)))
        found = self._located(seen, members, points, person)
        if found is not None:
            person.positions = found.points.copy()
        return found

    def _is_body(self, out: Triangulated, seen: Detections, pair: Sequence[int]) -> bool:
        """Whether the rays of two detections meet in a body."""
        common = int(np.isfinite(seen.points[list(pair), :, 0]).all(axis=0).sum())
        there = np.isfinite(out.points[:, 0])
        if there.sum() < max(min(_LEAST_JOINTS, self.model.n_markers), _LEAST_SHARE * common):
            return False
        missed = np.minimum(np.nanmean(out.distances[:, there], axis=0), _CAP)
        extent = np.ptp(out.points[there], axis=0).max()
        ends = out.points[self.model.links]
        lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        lengths = lengths[np.isfinite(lengths)]
        short = np.mean(lengths < _LONGEST) if len(lengths) else 1.0
        return bool(
            missed.mean() < _NEW and _SMALLEST < extent < _LARGEST and short >= _SHORT_LINKS
        )

    def _prove(self, instant: int, found: Found, seen: Detections) -> None:
        """Note which detections are the person's, and whether it is there for long enough."""
        person = found.person
        person.tracks |= {int(seen.cameras[n]): int(seen.tracks[n]) for n in found.views}
        there = np.isfinite(seen.rotations[:, 0, 0]).sum()
        needed = _QUICK_PROOF if len(found.views) == there else _PROOF
        is_long = (instant - person.born) * 1e-9 >= needed
        person.is_proven |= is_long or len(found.views) > 2

    def _learn(self, instant: int, seen: Detections, found: Sequence[Found]) -> None:
        """Let the noise of each camera follow the distances of its rays from the joints."""
        seconds = (instant - self._last) * 1e-9
        if seconds < _LEARNS_EACH:
            return
        share = min(seconds / _LEARNS, 1.0) if self._last else 0.0
        self._last = instant
        squares: dict[int, list[float]] = {}
        for one in found:
            weights = self.noises[seen.cameras[one.views]] ** -2.0
            # The point takes three of the distances' 2 K degrees of freedom, by weight.
            freedoms = np.maximum(1 - 1.5 * weights / weights.sum(), _LEAST_FREEDOM)
            for n, freedom in zip(one.views, freedoms.tolist(), strict=True):
                camera = int(seen.cameras[n])
                places, depths = seen.seen(camera, one.points)
                away = np.linalg.norm(places - seen.points[n], axis=1) * depths
                away = away * np.clip(seen.scores[n], 0.1, 1.0)
                known = away[np.isfinite(away)]
                if len(known):
                    # Half of the square of a distance in a plane is that along one axis.
                    median = float(np.median(known**2)) / (2 * np.log(2) * freedom)
                    squares.setdefault(camera, []).append(median)
        for camera, values in squares.items():
            square = self.noises[camera] ** 2
            square += share * (float(np.mean(values)) - square)
            self.noises[camera] = np.clip(np.sqrt(square), _LEAST_NOISE, _MOST_NOISE)
        usual = np.median(self.noises)
        np.clip(self.noises, usual / _UNEQUAL, usual * _UNEQUAL, out=self.noises)


def _apart(places: Floats, depths: Floats, points: Floats) -> Floats:
    """(P, N) Mean distance, m, of P people at (P, J, 2) with z (P, J) from detections (N, J, 2).

    NaN where too few joints are in both.
    """
    away = np.linalg.norm(places[:, None] - points[None], axis=-1) * depths[:, None]
    known = np.isfinite(away)
    n = known.sum(axis=-1)
    total = np.where(known, np.minimum(away, _CAP), 0.0).sum(axis=-1)
    least = min(_LEAST_JOINTS, points.shape[1])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(n >= least, total / n, np.nan))


def _misfit(found: Found) -> float:
    """Return how badly known somebody's joints are, m."""
    return float(np.nanmedian(found.deviations))
