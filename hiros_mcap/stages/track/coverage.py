"""Each camera's field of view, learned from the people it has reported."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.skeletons import Floats
from hiros_mcap.stages.track.tracking import LAST, NEVER

_PERSON_RADIUS = 0.35  # m: a person this near to a line of sight blocks it
_MARGIN = 0.3  # m: how far a place may lie beyond the farthest person reported
PICTURE = math.cos(math.radians(20.0))  # of any camera: people are in the middle on average
_ENOUGH = 5  # people that a camera must have reported before its silence says anything
_INTERVAL = 500_000_000  # ns between two messages of a camera that are learned from
_FIRST_INTERVAL = 200_000_000  # ns until it has reported enough


@dataclass(slots=True)
class _FieldOfView:
    """Directions and distances at which a camera has reported people: a cone and two spheres."""

    directions: list[Floats] = field(default_factory=list)
    axis: Floats = field(default_factory=lambda: np.zeros(3))
    nearest: float = np.inf
    farthest: float = 0.0
    least_cosine: float = 1.0  # of the angles between the axis and the people reported
    stamp: int = 0
    people: int = 0

    def contains(self, ray: Floats, margin: float = 0.0, widest: float = 1.0) -> bool:
        """Whether a place is in the cone and, give or take ``margin``, between the spheres.

        ``ray`` : (3,) to the place, m. ``widest`` : cosine of an angle that the cone has at least.
        """
        distance = math.hypot(*ray.tolist())
        near = self.nearest - margin <= distance <= self.farthest + margin
        return near and float(ray @ self.axis) >= distance * min(self.least_cosine, widest)

    def widen(self, ray: Floats) -> None:
        """Hold the place at a ray (3,), m, too."""
        distance = math.hypot(*ray.tolist())
        if distance == 0.0 or self.contains(ray):
            return
        self.directions.append(ray / distance)
        mean = np.mean(self.directions, axis=0)
        self.axis = mean / max(float(np.linalg.norm(mean)), 1e-9)
        self.least_cosine = float(np.min(np.array(self.directions) @ self.axis))
        self.nearest = min(self.nearest, distance)
        self.farthest = max(self.farthest, distance)


class Coverage:
    """Says whether a camera ought to see a place.

    A camera covers the cone around its mean line of sight that holds everybody it has reported,
    between the nearest and the farthest of them. Without the camera's position it covers nothing.

    Parameters
    ----------
    cameras : source -> (3,) position in the fixed frame, m.
    """

    def __init__(self, cameras: Mapping[str, Floats]) -> None:
        self._origins = cameras
        self._views: dict[str, _FieldOfView] = {}

    def due(self, source: str) -> int:
        """Time, ns, from which on a camera's message is learned from: sooner ones say little."""
        if source not in self._origins:
            return LAST
        if source not in self._views:
            return NEVER
        view = self._views[source]
        return view.stamp + (_INTERVAL if view.people >= _ENOUGH else _FIRST_INTERVAL)

    def learn(self, source: str, places: Floats | Sequence[Floats], stamp: int) -> None:
        """Note that ``source`` reported people at ``places`` (N, 3), m, in the fixed frame."""
        if not len(places):
            return
        view = self._views.setdefault(source, _FieldOfView())
        view.stamp = stamp
        view.people += len(places)
        for place in places:
            view.widen(place - self._origins[source])

    def covers(self, source: str, place: Floats, widest: float = 1.0) -> bool:
        """Whether ``source`` looks at ``place`` (3,), m, whoever stands in between.

        ``widest`` : cosine; nearer to the middle of its people, it looks wherever they were.
        """
        view = self._views.get(source)
        if view is None or view.people < _ENOUGH:
            return False
        return view.contains(place - self._origins[source], _MARGIN, widest)

    def sees(
        self, source: str, place: Floats, others: Floats | Sequence[Floats], widest: float = 1.0
    ) -> bool:
        """Whether ``source`` covers ``place`` and none of ``others`` (N, 3) stands in between.

        Whoever is at the place himself may be among them.
        """
        if not self.covers(source, place, widest):
            return False
        origin = self._origins[source]
        ray = place - origin
        distance = float(np.linalg.norm(ray))
        direction = ray / max(distance, 1e-9)
        people = np.reshape(others, (-1, 3)) - origin
        along = people @ direction
        in_front = (along > 0.0) & (along < distance - _PERSON_RADIUS)
        people = people[in_front] - along[in_front, None] * direction
        return not bool((np.linalg.norm(people, axis=1) < _PERSON_RADIUS).any())
