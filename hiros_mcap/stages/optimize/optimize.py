"""Skeleton optimizer: constant limb lengths, outliers out (Hi-ROS 2023, section 3.3).

Per person, in the order of the paper: the limb lengths are calibrated (3.3.1), markers that
contradict them are outliers (3.3.2), and the pose of least energy is found (3.3.3).

The markers are the only unknowns. E_o needs the orientation of a link, and markers determine only
its direction. So phi is the angle between a link's direction before and after. On request
(``align_links``) the link's quaternion turns with its direction afterwards.

**What the paper's weights do.** Its w_l grows with the length error and vanishes with it, so a
small error is only partly corrected. And E_o, in rad^2 beside m^2, holds directions, noise and
all, much harder than positions. ``lengths="exact"`` (the default) keeps the three terms and the
solver, and weights them by what is known: lengths are almost rigid, positions count by their
confidence, directions next to nothing. Measured on simulated logs of two and four people, five
cameras merged by an oracle (mean joint error; coefficient of variation of the lengths; rms error
of the limbs' directions):

======  ==========  ==============  ==================
        error, mm   CV of lengths   direction, degrees
======  ==========  ==============  ==================
input   22.4, 23.5  0.143, 0.160    7.1, 8.1
paper   20.7, 21.6  0.033, 0.037    6.9, 7.9
exact   19.3, 20.0  0.0005, 0.0005  6.2, 7.0
======  ==========  ==============  ==================
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, frames_of, join
from hiros_mcap.skeletons import POSITION, Floats, Ints, People, SkeletonModel
from hiros_mcap.stages.delay import Delay
from hiros_mcap.stages.optimize import optimizing as kernels
from hiros_mcap.stages.optimize.energy import (
    Energy,
    SolverScratch,
    exact_weights,
    minimize,
    paper_weights,
)
from hiros_mcap.stages.optimize.limb_calibration import Calibration, calibrate_limbs
from hiros_mcap.stages.optimize.normal_equations import topology_of
from hiros_mcap.stages.optimize.optimize_params import OptimizeParams

_UNLIMITED = 1e9  # s; the calibration decides how long frames are held


def optimize_blocks(
    blocks: Iterable[Block],
    model: SkeletonModel,
    params: OptimizeParams = OptimizeParams(),  # noqa: B008 - immutable
    events: Events | None = None,
    limbs: LimbTable | None = None,
) -> Iterator[Block]:
    """Give everybody constant limb lengths; order and number of frames stay as they are.

    People without an id, and people whose limbs are not (yet) known, pass through unchanged.

    Parameters
    ----------
    blocks : in time order, merged or tracked.
    limbs : lengths known from before. Everybody who is calibrated on the way is added.

    Raises
    ------
    ConfigError
        If ``limbs`` names a link that the model lacks.
    """
    events = events if events is not None else Events()
    limbs = limbs if limbs is not None else LimbTable()
    if params.calibration == "two-pass":
        if not limbs.people:
            blocks = list(blocks)
            limbs.people.update(calibrate_limbs(frames_of(blocks), model, params, events).people)
        params = params.model_copy(update={"calibration": "off"})
    calibration = Calibration(model, params, events, limbs)
    optimizer = _Optimizer(model, params, events)
    for calibrated in _await_calibration(blocks, calibration):  # section 3.3.1
        for block, frames in itertools.groupby(calibrated, key=attrgetter("block")):
            yield optimizer(block, list(frames))


class _Calibrated(NamedTuple):
    """A frame whose people's calibration is settled."""

    block: Block
    place: int
    log_time: int
    nominal: Floats  # (P, L) calibrated lengths, m, NaN where there are none


def _await_calibration(
    blocks: Iterable[Block], calibration: Calibration
) -> Iterator[list[_Calibrated]]:
    """Hold frames, in order, until the calibration of everybody in them is settled.

    A held frame gets the log time of the frame that releases it. Yields the frames that each block
    releases.
    """
    delay = Delay[tuple[Block, int, list[int]]](_UNLIMITED)
    now = 0

    def is_ready(held: tuple[Block, int, list[int]]) -> bool:
        return calibration.is_ready(held[2])

    for block in blocks:
        calibrated = []
        ids, (lengths, weights) = block.people.ids.tolist(), calibration.measure(block.people)
        times = zip(
            block.stamps.tolist(), block.log_times.tolist(), block.rows.tolist(), strict=True
        )
        for i, (stamp, log_time, (begin, end)) in enumerate(times):
            people = ids[begin:end]
            calibration.observe(stamp, people, lengths[begin:end], weights[begin:end])
            delay.push(stamp, (block, i, people))
            now = max(now, log_time)
            for held, place, who in delay.release(stamp, is_ready):
                calibrated.append(_Calibrated(held, place, now, calibration.nominal(who)))
        yield calibrated
    calibration.finish()
    yield [_Calibrated(b, place, now, calibration.nominal(who)) for b, place, who in delay.rest()]


Solver = Callable[[Energy], tuple[Floats, int]]
"""Energy of P skeletons -> poses of least energy (P, M, 3), how many did not converge."""


class _Optimizer:
    """Outlier detection and optimization of some frames (sections 3.3.2 and 3.3.3)."""

    def __init__(self, model: SkeletonModel, params: OptimizeParams, events: Events) -> None:
        self._names, self._params, self._events = model.marker_names, params, events
        self._topology = topology_of(model)
        self._scratch = SolverScratch.of(self._topology)
        self._minimize = block_solver(model, params.tolerance)
        if params.solver == "ceres":
            from hiros_mcap.stages.optimize.ceres import CeresSolver

            self._minimize = CeresSolver(model, params.tolerance)

    def __call__(self, block: Block, frames: list[_Calibrated]) -> Block:
        """Return frames of a block with their calibrated people optimized."""
        places, log_times = [each.place for each in frames], [each.log_time for each in frames]
        nominal = np.concatenate([each.nominal for each in frames])
        rows = ~np.isnan(nominal).all(axis=1)
        if not rows.any():
            return block.select(places).logged_at(log_times)
        out = join([block.select(places)]).logged_at(log_times)
        if rows.all():
            self._optimize(out.people, nominal)
        else:
            some = out.people.at(rows)
            self._optimize(some, nominal[rows])
            for name in ("markers", "marker_confidences", "links", "link_confidences"):
                getattr(out.people, name)[rows] = getattr(some, name)
        return out

    def _optimize(self, people: People, nominal: Floats) -> None:
        """Optimize people whose limb lengths are known, in place."""
        points = people.markers[:, :, POSITION].copy()
        energy = Energy(points, nominal, np.empty((*nominal.shape, 4)))
        outlier = self._find_outliers(energy, people.marker_confidences)  # section 3.3.2
        self._write_weights(energy, outlier, people.marker_confidences)  # eq 18
        solved, failed = self._minimize(energy)  # eq 14 to 17, 19
        self._events.count("optimizer not converged", n=failed)
        remove, align = self._params.outliers == "remove", self._params.align_links
        kernels.write_poses(people, energy, solved, outlier, self._topology.links, remove, align)

    def _find_outliers(self, energy: Energy, confidences: Floats) -> Ints:
        """(P, M) 1 for outliers, which move or become NaN in ``energy.start``."""
        outlier = np.zeros(confidences.shape, np.int32)
        limit = self._params.max_length_error
        if self._params.outliers == "remove":
            count = kernels.remove_outliers(*energy[:2], self._topology, limit, outlier)
        else:
            exact_weights(energy, self._topology, outlier, confidences)
            count = kernels.restore_outliers(energy, self._topology, limit, outlier, self._scratch)
        if count:
            for name, n in zip(self._names, outlier.sum(axis=0), strict=True):
                self._events.count("optimizer outlier", name, int(n))
        return outlier

    def _write_weights(self, energy: Energy, outlier: Ints, confidences: Floats) -> None:
        if self._params.lengths == "paper":
            paper_weights(energy, self._topology, outlier, self._params.max_length_error)
        elif self._params.outliers == "remove" or outlier.any():  # else the search has written them
            exact_weights(energy, self._topology, outlier, confidences)


def block_solver(model: SkeletonModel, tolerance: float) -> Solver:
    """Return the compiled solver for the links of ``model``; ``tolerance`` in m."""
    topology = topology_of(model)
    scratch = SolverScratch.of(topology)

    def solve(energy: Energy) -> tuple[Floats, int]:
        solved = np.empty_like(energy.start)
        return solved, int(minimize(energy, topology, tolerance, scratch, solved))

    return solve
