"""Where to put cameras: places along the walls, chosen one by one, exchanged, then shifted.

1. Candidates stand along the walls and in the corners and look inwards in three directions.
2. Greedy: the candidate that lowers the mean error most is added, until there are enough cameras.
3. Exchange: each camera in turn goes to the candidate that is best beside the others.
4. Descent: each camera in turn is shifted, rotated and tilted by a little, while that helps.

Nothing is random, so that the same room gives the same plan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid, from_matrix
from hiros_mcap.plan.expected_error import ErrorModel, View
from hiros_mcap.plan.scenes import FloorGrid, Scenes, make_scenes
from hiros_mcap.simulate.body_model import SLOT
from hiros_mcap.simulate.cameras import aimed
from hiros_mcap.simulate.settings import Area, SimulateParams
from hiros_mcap.skeletons import Floats

UNSEEN_M = 0.5
"""What a joint that no camera sees counts as."""
_CELLS, _FACINGS = 48, 4
_JOINTS = [
    *("PELVIS", "NECK", "HEAD", "ELBOW_LEFT", "ELBOW_RIGHT", "WRIST_LEFT", "WRIST_RIGHT"),
    *("KNEE_LEFT", "KNEE_RIGHT", "ANKLE_LEFT", "ANKLE_RIGHT"),
]
_PLACES = 28
_DIRECTIONS = np.radians([0.0, -25.0, 25.0])  # beside the direction of the room's middle
_AIM_HEIGHT, _AIM_FAR = 1.0, 3.5  # m; the axis meets the middle of a body, at most so far away
_STEPS = ((0.25, 12.0, 6.0), (0.12, 6.0, 3.0))  # m along the walls, degrees aside and up
_EXCHANGES = 3
_APART = 0.5  # m, of two cameras
_ENOUGH = 1e-4
"""Gain, relative to the error, for which a camera is moved."""


class Stand(NamedTuple):
    """A camera on a wall."""

    along: float
    """m along the walls, anticlockwise from the corner of least x and y."""
    bearing: float
    """Direction of its axis over the floor, rad from x to y."""
    tilt: float
    """rad below the horizon."""


class Placed(NamedTuple):
    """A camera and what it contributes."""

    stand: Stand | None
    """None where nobody asks to move it."""
    pose: Rigid
    view: View


class Placing:
    """The search for the places of cameras in one room."""

    def __init__(self, params: SimulateParams, height: float) -> None:
        """Take the room and the cameras' settings; ``height``, m, is that of all cameras."""
        self._area, self._height = params.area, height
        self._scenes: Scenes = make_scenes(params, FloorGrid.of(params.area, _CELLS), _FACINGS)
        self._model = ErrorModel(params, [SLOT[name] for name in _JOINTS])
        self._candidates = [self._placed(stand) for stand in self._stands()]

    def place(self, count: int) -> list[Rigid]:
        """Return the poses of ``count`` cameras, in the order of their places along the walls."""
        chosen: list[Placed] = []
        for _ in range(count):
            chosen.append(self._best(chosen, self._candidates))
        for _ in range(_EXCHANGES):
            before = [each.stand for each in chosen]
            for k in range(count):
                chosen[k] = self._best(_without(chosen, k), [chosen[k], *self._candidates])
            if [each.stand for each in chosen] == before:
                break
        for steps in _STEPS:
            for k in range(count):
                chosen[k] = self._descend(_without(chosen, k), chosen[k], steps)
        return [each.pose for each in sorted(chosen, key=lambda each: each[0] or ())]

    def further(self, poses: Sequence[Rigid]) -> Rigid:
        """Return where one more camera beside those at ``poses`` helps most."""
        others = [Placed(None, pose, self._model.view(self._scenes, pose)) for pose in poses]
        best = self._best(others, self._candidates)
        for steps in _STEPS:
            best = self._descend(others, best, steps)
        return best.pose

    def _placed(self, stand: Stand) -> Placed:
        pose = self.pose(stand)
        return Placed(stand, pose, self._model.view(self._scenes, pose))

    def pose(self, stand: Stand) -> Rigid:
        """Return the pose of a camera in the world."""
        x, y = _on_wall(self._area, stand.along)
        level = np.cos(stand.tilt)
        forward = [level * np.cos(stand.bearing), level * np.sin(stand.bearing)]
        matrix = aimed(np.array([*forward, -np.sin(stand.tilt)]))
        return Rigid(from_matrix(matrix), np.array([x, y, self._height]))

    def _stands(self) -> Iterator[Stand]:
        """Yield the candidates."""
        x0, y0, x1, y1 = self._area
        sides = np.array([x1 - x0, y1 - y0, x1 - x0, y1 - y0])
        start = 0.0
        for side in sides:
            n = max(2, round(_PLACES * side / sides.sum()))
            for along in start + np.arange(n) * side / n:
                to_middle = (np.array([x0 + x1, y0 + y1]) / 2) - _on_wall(self._area, along)
                far = min(float(np.hypot(*to_middle)), _AIM_FAR)
                tilt = float(np.arctan2(self._height - _AIM_HEIGHT, far))
                for aside in _DIRECTIONS:
                    bearing = float(np.arctan2(to_middle[1], to_middle[0]) + aside)
                    yield Stand(float(along), bearing, tilt)
            start += side

    def _best(self, others: list[Placed], candidates: list[Placed]) -> Placed:
        """Return the best candidate beside others."""
        return min(candidates, key=self._cost_beside(others))

    def _descend(
        self, others: list[Placed], best: Placed, steps: tuple[float, float, float]
    ) -> Placed:
        """Shift, rotate and tilt a camera."""
        cost_of = self._cost_beside(others)
        cost = cost_of(best)
        for axis, step in enumerate((steps[0], *np.radians(steps[1:]))):
            for change in (step, -step):
                moved = list(best.stand or ())
                moved[axis] += change
                tried = self._placed(Stand(*moved))
                if (new := cost_of(tried)) < cost * (1 - _ENOUGH):
                    best, cost = tried, new
                    break
        return best

    def _cost_beside(self, others: list[Placed]) -> Callable[[Placed], float]:
        """Return the mean error over people and joints, m, of a camera and others."""
        base = [reduce(View.plus, [other.view for other in others])] if others else []
        taken = np.array([other.pose.translation for other in others]).reshape(-1, 3)

        def cost(camera: Placed) -> float:
            gaps = np.linalg.norm(taken - camera.pose.translation, axis=1)
            if gaps.size and gaps.min() < _APART:
                return np.inf
            errors = self._model.errors(reduce(View.plus, [*base, camera.view]))
            return float(np.nan_to_num(errors, nan=UNSEEN_M).mean())

        return cost


def _without(chosen: list[Placed], k: int) -> list[Placed]:
    return chosen[:k] + chosen[k + 1 :]


def _on_wall(area: Area, along: float) -> Floats:
    """(2,) the point at a distance along the walls, m."""
    x0, y0, x1, y1 = area
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
    ends = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(corners, axis=0)).sum(axis=1))])
    at = along % ends[-1]
    return np.array([np.interp(at, ends, corners[:, axis]) for axis in range(2)])
