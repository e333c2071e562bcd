"""The plan of a room: its cameras, what error is expected where, and what one more would give.

Where to put cameras: places along the walls, chosen one by one, exchanged, then shifted.

1. Candidates stand along the walls and in the corners and look inwards in three directions.
2. Greedy: the candidate that lowers the mean error most is added, until there are enough cameras.
3. Exchange: each camera in turn goes to the candidate that is best beside the others.
4. Descent: each camera in turn is shifted, rotated and tilted by a little, while that helps.

Nothing is random, so that the same room gives the same plan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid, from_matrix, to_matrix
from hiros_mcap.evaluate.statistics import parts_of
from hiros_mcap.plan.expected_error import ErrorModel, View
from hiros_mcap.plan.scenes import FloorGrid, make_scenes
from hiros_mcap.simulate.body_model import MARKERS, MODEL, SLOT
from hiros_mcap.simulate.cameras import aimed
from hiros_mcap.simulate.settings import Area, SimulateParams
from hiros_mcap.skeletons import Flags, Floats, Stamps
from hiros_mcap.wording import plain_value

_CELLS, _FACINGS = 320, 8  # of the result
UNSEEN_M = 0.5
"""Error, m, that stands for a joint that no camera sees."""
_TRIED_CELLS, _TRIED_FACINGS = 48, 4  # while places are searched
_JOINTS = [
    *("PELVIS", "NECK", "HEAD", "ELBOW_LEFT", "ELBOW_RIGHT", "WRIST_LEFT", "WRIST_RIGHT"),
    *("KNEE_LEFT", "KNEE_RIGHT", "ANKLE_LEFT", "ANKLE_RIGHT"),
]
_DIRECTIONS = np.radians([0.0, -25.0, 25.0])  # beside the direction of the room's middle
_AIM_HEIGHT, _AIM_FAR = 1.0, 3.5  # m; the axis meets the middle of a body, at most so far away
_STEPS = ((0.25, 12.0, 6.0), (0.12, 6.0, 3.0))  # m along the walls, degrees aside and up
_APART = 0.5  # m, of two cameras
_ENOUGH = 1e-4  # gain, relative to the error, for which a camera is moved


@dataclass(frozen=True, slots=True)
class Outlook:
    """Expected error and coverage of a rig, over people who stand anywhere and face any way."""

    error_mm: float
    """Mean error of the joints of those whom a camera sees; NaN if none sees anybody."""
    one: float  # share, 0 to 1, of these people whom at least one camera detects
    two: float  # the same of two cameras
    three: float


@dataclass(frozen=True, slots=True)
class PlannedCamera:
    """A camera of a plan, in the room's coordinates, z up from the floor."""

    name: str
    x: float
    y: float
    height: float
    bearing_deg: float  # direction of its axis over the floor, from x to y
    tilt_deg: float  # of its axis below the horizon
    then: Outlook
    """Outlook of the rig without this camera; for a further camera, of the rig with it."""


@dataclass(frozen=True, slots=True)
class RoomPlan:
    """Cameras in a room and what is expected of them."""

    params: SimulateParams  # the room, with its cameras' poses
    expected: Outlook
    parts_mm: Mapping[str, float]  # part of the body -> expected error
    joints_mm: Mapping[str, float]
    cameras: Sequence[PlannedCamera]
    further: PlannedCamera  # where one more camera helps most
    floor: FloorGrid
    errors_mm: Floats
    """(rows, columns) of each cell of the floor: mean over people who face all ways; NaN where no
    camera sees anybody."""
    two: Floats  # (rows, columns) share in which at least two cameras detect the person

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON, without the picture's numbers."""
        rig, apart = self.params.rig, ("expected", "parts_mm", "joints_mm", "cameras", "further")
        room = {"area": self.params.area, "fov": rig.fov, "range": rig.range}
        rest = {name: plain_value(getattr(self, name)) for name in apart}
        return {"room": room, "people": self.params.people, **rest}


def make_plan(
    params: SimulateParams, height: float, poses: Mapping[str, Rigid] | None = None
) -> RoomPlan:
    """Return where to put cameras, or what is expected of those that stand at ``poses``.

    Parameters
    ----------
    params : the room (``area``), the people, and what cameras and detectors are like.
    height : of cameras that are placed, m.
    poses : name -> pose in the room, z up from the floor.
    """
    placing = Placing(params, height)
    if poses is None:
        poses = {f"camera_{k}": pose for k, pose in enumerate(placing.place(params.cameras))}
    floor = FloorGrid.of(params.area, _CELLS)
    (markers, cells), model = make_scenes(params, floor, _FACINGS), ErrorModel(params)
    views = [model.view(markers, pose) for pose in poses.values()]
    rig = reduce(View.plus, views)
    errors = 1000 * model.errors(rig)

    def outlook(view: View) -> Outlook:
        shares = [float((view.cameras >= count).mean()) for count in (1, 2, 3)]
        return Outlook(_mean(1000 * model.errors(view)), *shares)

    cameras = [
        _camera(name, pose, outlook(rig.plus(view, -1)))
        for (name, pose), view in zip(poses.items(), views, strict=True)
    ]
    pose = placing.further(list(poses.values()))
    further = _camera("one more", pose, outlook(rig.plus(model.view(markers, pose))))
    of_joint = dict(zip(MARKERS, np.moveaxis(errors, -1, 0), strict=True))
    rows = tuple((*p.translation.tolist(), *p.xyzw.tolist()) for p in poses.values())
    placed = params.rig.model_copy(update={"poses": rows})
    return RoomPlan(
        params.model_copy(update={"rig": placed, "cameras": len(rows)}),
        outlook(rig),
        {name: _mean(errors[..., rows]) for name, rows in parts_of(MODEL).items()},
        {name: _mean(errors) for name, errors in of_joint.items()},
        cameras,
        further,
        floor,
        *_maps(floor, cells, errors, rig),
    )


def _mean(errors: Floats) -> float:
    finite = errors[np.isfinite(errors)]
    return float(finite.mean()) if len(finite) else float("nan")


def _camera(name: str, pose: Rigid, then: Outlook) -> PlannedCamera:
    x, y, z = pose.translation.tolist()
    east, north, up = to_matrix(pose.xyzw)[:, 2].tolist()
    angles = np.arctan2([north, -up], [east, np.hypot(east, north)])
    bearing, tilt = np.degrees(angles).tolist()
    return PlannedCamera(name, x, y, z, bearing, tilt, then)


def _maps(floor: FloorGrid, cells: Stamps, errors: Floats, view: View) -> tuple[Floats, Floats]:
    """Average in each cell the errors, and how often two cameras detect the person."""
    shape = len(floor.y), len(floor.x)
    is_seen = np.isfinite(errors[..., 0])

    def mean(values: Floats, of: Flags) -> Floats:
        sums, counts = (
            np.bincount(cells[of], weights, minlength=shape[0] * shape[1])
            for weights in (values[of], None)
        )
        return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan).reshape(shape)

    twice = (view.cameras >= 2).astype(float)
    return mean(errors.mean(axis=-1), is_seen), mean(twice, np.ones_like(is_seen))


class Placed(NamedTuple):
    """A camera and what it contributes; on a wall, where that is."""

    pose: Rigid
    view: View
    along: float = np.nan  # m along the walls, anticlockwise from the corner of least x and y
    bearing: float = np.nan  # direction of its axis over the floor, rad from x to y
    tilt: float = np.nan  # rad below the horizon

    @property
    def stand(self) -> tuple[float, float, float]:
        """Where it stands on the wall, and looks."""
        return self.along, self.bearing, self.tilt


class Placing:
    """The search for the places of cameras in one room."""

    def __init__(self, params: SimulateParams, height: float) -> None:
        """Take the room and the cameras' settings; ``height``, m, is that of all cameras."""
        self._area, self._height = params.area, height
        floor = FloorGrid.of(params.area, _TRIED_CELLS)
        self._markers, _ = make_scenes(params, floor, _TRIED_FACINGS)
        self._model = ErrorModel(params, [SLOT[name] for name in _JOINTS])
        self._candidates = [self._placed(*stand) for stand in self._stands()]

    def place(self, count: int) -> list[Rigid]:
        """Return the poses of ``count`` cameras, in the order of their places along the walls."""
        chosen: list[Placed] = []
        for _ in range(count):
            chosen.append(self._best(chosen, self._candidates))
        for _ in range(3):
            before = [camera.stand for camera in chosen]
            for k in range(count):
                chosen[k] = self._best(_without(chosen, k), [chosen[k], *self._candidates])
            if [camera.stand for camera in chosen] == before:
                break
        for steps in _STEPS:
            for k in range(count):
                chosen[k] = self._descend(_without(chosen, k), chosen[k], steps)
        return [camera.pose for camera in sorted(chosen, key=lambda camera: camera.stand)]

    def further(self, poses: Sequence[Rigid]) -> Rigid:
        """Return where one more camera beside those at ``poses`` helps most."""
        rest = [Placed(pose, self._model.view(self._markers, pose)) for pose in poses]
        best = self._best(rest, self._candidates)
        for steps in _STEPS:
            best = self._descend(rest, best, steps)
        return best.pose

    def _placed(self, along: float, bearing: float, tilt: float) -> Placed:
        """Return a camera on a wall."""
        x, y = _on_wall(self._area, along)
        level = np.cos(tilt)
        forward = [level * np.cos(bearing), level * np.sin(bearing), -np.sin(tilt)]
        matrix = aimed(np.array(forward))
        pose = Rigid(from_matrix(matrix), np.array([x, y, self._height]))
        return Placed(pose, self._model.view(self._markers, pose), along, bearing, tilt)

    def _stands(self) -> Iterator[tuple[float, float, float]]:
        """Yield the :attr:`~Placed.stand` of each candidate."""
        x0, y0, x1, y1 = self._area
        sides = np.array([x1 - x0, y1 - y0, x1 - x0, y1 - y0])
        start = 0.0
        for side in sides:
            n = max(2, round(28 * side / sides.sum()))  # of 28 places
            for along in start + np.arange(n) * side / n:
                to_middle = (np.array([x0 + x1, y0 + y1]) / 2) - _on_wall(self._area, along)
                far = min(float(np.hypot(*to_middle)), _AIM_FAR)
                tilt = float(np.arctan2(self._height - _AIM_HEIGHT, far))
                for aside in _DIRECTIONS:
                    bearing = float(np.arctan2(to_middle[1], to_middle[0]) + aside)
                    yield float(along), bearing, tilt
            start += side

    def _best(self, rest: list[Placed], candidates: list[Placed]) -> Placed:
        """Return the best candidate beside others."""
        return min(candidates, key=self._cost_beside(rest))

    def _descend(
        self, rest: list[Placed], best: Placed, steps: tuple[float, float, float]
    ) -> Placed:
        """Shift, rotate and tilt a camera."""
        cost_of = self._cost_beside(rest)
        cost = cost_of(best)
        for axis, step in enumerate((steps[0], *np.radians(steps[1:]))):
            for change in (step, -step):
                moved = list(best.stand)
                moved[axis] += change
                tried = self._placed(*moved)
                if (new := cost_of(tried)) < cost * (1 - _ENOUGH):
                    best, cost = tried, new
                    break
        return best

    def _cost_beside(self, rest: list[Placed]) -> Callable[[Placed], float]:
        """Return the mean error over people and joints, m, of a camera and others."""
        base = [reduce(View.plus, [camera.view for camera in rest])] if rest else []
        taken = np.array([camera.pose.translation for camera in rest]).reshape(-1, 3)

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
