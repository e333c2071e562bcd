"""People everywhere on a floor, facing every way: what a rig is tried on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hiros_mcap.simulate.body_model import BodyModel
from hiros_mcap.simulate.motion import WALK, Person, Walker
from hiros_mcap.simulate.paths import TURN, Spot
from hiros_mcap.simulate.settings import WALL, Area, SimulateParams
from hiros_mcap.skeletons import Floats, Stamps

_NEAR = 0.6  # m; people keep this distance
_PHASES = 8  # of a stride


@dataclass(frozen=True, slots=True)
class FloorGrid:
    """The part of a room that people use, in cells."""

    x: Floats  # (columns,) middles of the cells, m
    y: Floats  # (rows,) m

    @classmethod
    def of(cls, area: Area, cells: int) -> FloorGrid:
        """Divide a room, without the strip along its walls, into about ``cells`` square cells."""
        low, high = np.array(area[:2]) + WALL, np.array(area[2:]) - WALL
        size = np.maximum(high - low, 0.1)
        step = np.sqrt(size.prod() / cells)
        counts = np.maximum(1, np.round(size / step)).astype(int)
        x, y = (a + (np.arange(n) + 0.5) * s / n for a, n, s in zip(low, counts, size, strict=True))
        return cls(x, y)

    @property
    def centres(self) -> Floats:
        """(cells, 2) m, row by row."""
        return np.stack(np.meshgrid(self.x, self.y), axis=-1).reshape(-1, 2)


def make_scenes(params: SimulateParams, floor: FloorGrid, facings: int) -> tuple[Floats, Stamps]:
    """Put somebody into each cell, once for each of several facings, with others at random.

    They walk; their strides differ. The same room gives the same scenes.

    Returns the markers (n, P, M, 3) of the people in each of n moments, in the world, m; and (n, P)
    the cell of the floor that each stands in.
    """
    centres, people = floor.centres, max(1, params.people)
    cells = np.repeat(np.arange(len(centres)), facings)
    cells = np.resize(cells, -(-len(cells) // people) * people)
    order = np.arange(len(cells))
    bearing = TURN * (order % facings) / facings
    mixed = _mixed(centres[cells], people)
    bodies = _strides(float(np.mean(params.heights)))[order % _PHASES]
    c, s = np.cos(bearing)[:, None], np.sin(bearing)[:, None]
    x, y = bodies[..., 0], bodies[..., 1]
    markers = np.stack([c * x - s * y, s * x + c * y, bodies[..., 2]], axis=-1)
    markers[..., :2] += centres[cells][:, None]
    return markers[mixed], cells[mixed]


def _mixed(places: Floats, people: int) -> Stamps:
    """(n, P) whom each scene has, so that people are at a distance where there is room for it."""
    if people == 1:
        return np.arange(len(places))[:, None]
    rng = np.random.default_rng(0)
    rows = rng.permutation(len(places)).reshape(-1, people)
    for _ in range(50):
        here = places[rows]
        gaps = np.linalg.norm(here[:, :, None] - here[:, None], axis=-1)
        gaps[:, np.arange(people), np.arange(people)] = np.inf
        crowded = gaps.min(axis=(1, 2)) < _NEAR
        if not crowded.any():
            break
        crowded |= rng.random(len(rows)) < 0.1  # others to exchange with
        rows[crowded] = rng.permutation(rows[crowded].ravel()).reshape(-1, people)
    return rows


def _strides(height: float) -> Floats:
    """(_PHASES, M, 3) somebody who walks at the origin towards +x, over one stride, m."""
    body = BodyModel.of(height)
    walker = Walker(body, Spot(0.0, 0.0, 0.0), WALK, 0.0)
    return Person(body, walker.posture).pose(np.arange(_PHASES) / _PHASES / WALK.cadence)[0]
