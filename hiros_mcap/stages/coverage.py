"""What each camera looks at, learned from the people it has reported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.skeletons import Floats

_BODY_RADIUS = 0.35  # m: a person this near to a line of sight blocks it
_MARGIN = 0.3  # m: by how much a place may lie beyond the farthest person reported
_INTERVAL = 500_000_000  # ns between two lessons of a camera
_AT_FIRST = 200_000_000  # ns between them until it has learned enough, before bodies are confirmed
_ENOUGH = 5  # people to have learned before a camera's silence says anything


@dataclass(slots=True)
class _View:
    """Directions and distances at which a camera has reported people: a cone and two spheres."""

    directions: list[Floats] = field(default_factory=list)
    axis: Floats = field(default_factory=lambda: np.zeros(3))
    nearest: float = np.inf
    farthest: float = 0.0
    narrowest: float = 1.0  # least cosine between the axis and a reported person
    stamp: int = -_INTERVAL
    people: int = 0


class Coverage:
    """Answers whether a camera ought to see a place.

    A camera covers the cone around its mean line of sight that holds everybody it has reported,
    between the nearest and the farthest of them. That needs the camera's position; without it
    the answer is always no.
    """

    def __init__(self, cameras: Mapping[str, Floats]) -> None:
        self._origins = cameras
        self._views: dict[str, _View] = {}

    def is_due(self, source: str, stamp: int) -> bool:
        """Whether ``source`` is worth teaching again: neighbouring frames teach nothing new."""
        return self.lessons([source], [stamp], [0])[0]

    def lessons(
        self, sources: Sequence[str], stamps: Sequence[int], people: Sequence[int]
    ) -> list[bool]:
        """Which of these messages are due, if everybody in those before is learned."""
        due, taught = [], {source: self._taught(source) for source in self._origins}
        for source, stamp, n in zip(sources, stamps, people, strict=True):
            last = taught.get(source)
            due.append(last is not None and stamp - last[0] >= _interval(last[1]))
            if last is not None and due[-1] and n:
                taught[source] = stamp, last[1] + n
        return due

    def _taught(self, source: str) -> tuple[int, int]:
        """When a camera was taught last, and by how many people so far."""
        view = self._views.get(source)
        return (-_INTERVAL, 0) if view is None else (view.stamp, view.people)

    def learn(self, source: str, place: Floats, stamp: int) -> None:
        """Note that ``source`` reported a person at ``place`` (3,), m, in the fixed frame."""
        view = self._views.setdefault(source, _View())
        view.stamp = stamp
        ray = place - self._origins[source]
        distance = float(np.linalg.norm(ray))
        view.people += 1
        if distance <= 0.0 or self._inside(view, ray / distance, distance, 0.0):
            return
        view.directions.append(ray / distance)
        mean = np.mean(view.directions, axis=0)
        view.axis = mean / max(float(np.linalg.norm(mean)), 1e-9)
        view.narrowest = float(np.min(np.array(view.directions) @ view.axis))
        view.nearest = min(view.nearest, distance)
        view.farthest = max(view.farthest, distance)

    def sees(self, source: str, place: Floats, others: list[Floats]) -> bool:
        """Whether ``source`` covers ``place`` and none of ``others`` stands in between."""
        view = self._views.get(source)
        if view is None or view.people < _ENOUGH:
            return False
        origin = self._origins[source]
        ray = place - origin
        distance = float(np.linalg.norm(ray))
        direction = ray / max(distance, 1e-9)
        if not self._inside(view, direction, distance, _MARGIN):
            return False
        return not any(_blocks(other - origin, direction, distance) for other in others)

    @staticmethod
    def _inside(view: _View, direction: Floats, distance: float, margin: float) -> bool:
        near = view.nearest - margin <= distance <= view.farthest + margin
        return near and float(direction @ view.axis) >= view.narrowest


def _interval(people: int) -> int:
    """Ns between two lessons of a camera that so many people have taught."""
    return _INTERVAL if people >= _ENOUGH else _AT_FIRST


def _blocks(body: Floats, direction: Floats, distance: float) -> bool:
    """Whether a body at ``body`` (relative to the camera) hides what lies behind it."""
    along = float(body @ direction)
    beside = float(np.linalg.norm(body - along * direction))
    return 0.0 < along < distance - _BODY_RADIUS and beside < _BODY_RADIUS
