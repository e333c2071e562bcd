"""The plan of a room: its cameras, what error is expected where, and what one more would give."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from hiros_mcap.body.rotations import Rigid, to_matrix
from hiros_mcap.evaluate.statistics import parts_of
from hiros_mcap.plan.expected_error import ErrorModel, View
from hiros_mcap.plan.placing import Placing
from hiros_mcap.plan.scenes import FloorGrid, make_scenes
from hiros_mcap.simulate.body_model import MARKERS, MODEL
from hiros_mcap.simulate.settings import SimulateParams
from hiros_mcap.skeletons import Flags, Floats, Stamps
from hiros_mcap.summary import plain_value

_CELLS, _FACINGS = 320, 8


@dataclass(frozen=True, slots=True)
class Outlook:
    """What is expected of a rig, over people who stand anywhere and face any way."""

    error_mm: float
    """Mean error of the joints of those whom a camera sees; NaN if none sees anybody."""
    one: float
    """Share, 0 to 1, of these people whom at least one camera detects."""
    two: float
    """The same of two cameras."""
    three: float


@dataclass(frozen=True, slots=True)
class PlannedCamera:
    """A camera of a plan, in the room's coordinates, z up from the floor."""

    name: str
    x: float
    y: float
    height: float
    bearing_deg: float
    """Direction of its axis over the floor, from x to y."""
    tilt_deg: float
    """Of its axis below the horizon."""
    then: Outlook
    """What the others give without this camera; of a further camera, what they give with it."""


@dataclass(frozen=True, slots=True)
class ErrorMap:
    """The floor in cells: means over people who face all ways, (rows, columns) each."""

    floor: FloorGrid
    errors_mm: Floats
    """NaN where no camera sees anybody."""
    two: Floats
    """Share in which at least two cameras detect the person."""


@dataclass(frozen=True, slots=True)
class RoomPlan:
    """Cameras in a room and what is expected of them."""

    params: SimulateParams
    """The room, with its cameras' poses."""
    expected: Outlook
    parts_mm: Mapping[str, float]
    """Part of the body -> expected error."""
    joints_mm: Mapping[str, float]
    cameras: Sequence[PlannedCamera]
    further: PlannedCamera
    """Where one more camera helps most."""
    map: ErrorMap

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON, without the picture's numbers."""
        rig, shown = self.params.rig, ("expected", "parts_mm", "joints_mm", "cameras", "further")
        room = {"area": self.params.area, "fov": rig.fov, "range": rig.range}
        rest = {name: plain_value(getattr(self, name)) for name in shown}
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
    scenes, model = make_scenes(params, floor, _FACINGS), ErrorModel(params)
    views = [model.view(scenes, pose) for pose in poses.values()]
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
    further = _camera("one more", pose, outlook(rig.plus(model.view(scenes, pose))))
    of_joint = dict(zip(MARKERS, np.moveaxis(errors, -1, 0), strict=True))
    rows = tuple((*p.translation.tolist(), *p.xyzw.tolist()) for p in poses.values())
    placed = params.rig.model_copy(update={"poses": rows})
    return RoomPlan(
        params.model_copy(update={"rig": placed, "cameras": len(rows)}),
        outlook(rig),
        {name: _mean(errors[..., rows]) for name, rows in parts_of(MODEL).items()},
        {name: _mean(each) for name, each in of_joint.items()},
        cameras,
        further,
        _map(floor, scenes.cells, errors, rig),
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


def _map(floor: FloorGrid, cells: Stamps, errors: Floats, view: View) -> ErrorMap:
    """Average what happens in each cell."""
    shape = len(floor.y), len(floor.x)
    seen = np.isfinite(errors[..., 0])

    def mean(values: Floats, of: Flags) -> Floats:
        sums, counts = (
            np.bincount(cells[of], weights, minlength=shape[0] * shape[1])
            for weights in (values[of], None)
        )
        return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan).reshape(shape)

    return ErrorMap(
        floor,
        mean(errors.mean(axis=-1), seen),
        mean((view.cameras >= 2).astype(float), np.ones_like(seen)),
    )
