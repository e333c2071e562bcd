"""Skeleton optimizer: constant limb lengths, outliers out (Hi-ROS 2023, section 3.3).

Per person, in the order of the paper: the limb lengths are calibrated (3.3.1), markers that
contradict them are outliers (3.3.2), and the pose of least energy is found (3.3.3).

The markers are the only unknowns. E_o needs the orientation of a link, and markers determine only
its direction. So phi is the angle between a link's direction before and after. Orientations stay as
they were measured: detectors see them better than the ends of a short link show them. Links that
were turned with their directions had 4.2 degrees of error instead of 2.6.

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

from collections import deque
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.skeletons import POSITION, Floats, Ints, People, SkeletonModel
from hiros_mcap.stages.look_ahead import LookAhead
from hiros_mcap.stages.optimize import optimizing as kernels
from hiros_mcap.stages.optimize.energy import (
    Energy,
    SolverScratch,
    exact_weights,
    minimize,
    paper_weights,
)
from hiros_mcap.stages.optimize.limb_calibration import Calibration
from hiros_mcap.stages.optimize.normal_equations import topology_of
from hiros_mcap.stages.optimize.optimize_params import OptimizeParams


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
    limbs : lengths known from before, for two passes by
        :func:`~hiros_mcap.stages.optimize.limb_calibration.calibrate_limbs`. With ``auto``,
        everybody who is calibrated on the way is added.

    Raises
    ------
    ConfigError
        If ``limbs`` names a link that the model lacks.
    """
    events = events if events is not None else Events()
    limbs = limbs if limbs is not None else LimbTable()
    calibration = Calibration(model, params, events, limbs)
    optimizer = _Optimizer(model, params, events)
    for block, nominal in _await_calibration(blocks, calibration):  # section 3.3.1
        optimizer.optimize(block.people, nominal)
        yield block


def _await_calibration(
    blocks: Iterable[Block], calibration: Calibration
) -> Iterator[tuple[Block, Floats]]:
    """Hold frames, in order, until the calibration of everybody in them is settled.

    Yields copies of the frames that each block releases, logged when they were, and the calibrated
    lengths (P, L) of their people, m, NaN where there are none.
    """
    ahead, waiting = LookAhead(), deque[list[int]]()
    now = 0
    for block in blocks:
        ahead.add(block)
        nominal, log_times = list[Floats](), list[int]()
        ids, (lengths, weights) = block.people.ids.tolist(), calibration.measure(block.people)
        times = zip(
            block.stamps.tolist(), block.log_times.tolist(), block.rows.tolist(), strict=True
        )
        for stamp, log_time, (begin, end) in times:
            waiting.append(ids[begin:end])
            calibration.observe(stamp, waiting[-1], lengths[begin:end], weights[begin:end])
            now = max(now, log_time)
            while waiting and calibration.is_ready(waiting[0]):
                nominal.append(calibration.nominal(waiting.popleft()))
                log_times.append(now)
        if nominal:
            yield ahead.release(len(nominal)).logged_at(log_times), np.concatenate(nominal)
        del block  # else it lies in memory until the next one is made
    calibration.finish()
    if waiting:
        nominal = [calibration.nominal(people) for people in waiting]
        yield ahead.release(len(nominal)).logged_at([now] * len(nominal)), np.concatenate(nominal)


class _Optimizer:
    """Outlier detection and optimization of some frames (sections 3.3.2 and 3.3.3)."""

    def __init__(self, model: SkeletonModel, params: OptimizeParams, events: Events) -> None:
        self._names, self._params, self._events = model.marker_names, params, events
        self._topology = topology_of(model)
        self._scratch = SolverScratch.of(self._topology)
        self._minimize: Callable[[Energy], tuple[Floats, int]] = self._minimize_by_blocks
        if params.solver == "ceres":
            from hiros_mcap.stages.optimize.ceres import CeresSolver

            self._minimize = CeresSolver(model, params.tolerance)

    def optimize(self, people: People, nominal: Floats) -> None:
        """Optimize those people whose limb lengths (P, L), m, are known, in place."""
        rows = ~np.isnan(nominal).all(axis=1)
        if rows.all():
            self._optimize(people, nominal)
        elif rows.any():
            calibrated = people.at(rows)
            self._optimize(calibrated, nominal[rows])
            for name in ("markers", "marker_confidences", "links", "link_confidences"):
                getattr(people, name)[rows] = getattr(calibrated, name)

    def _optimize(self, people: People, nominal: Floats) -> None:
        """Optimize people whose limb lengths are all known, in place."""
        points = people.markers[:, :, POSITION].copy()
        energy = Energy(points, nominal, np.empty((*nominal.shape, 4)))
        outlier = self._find_outliers(energy, people.marker_confidences)  # section 3.3.2
        self._write_weights(energy, outlier, people.marker_confidences)  # eq 18
        solved, failed = self._minimize(energy)  # eq 14 to 17, 19
        self._events.count("optimizer not converged", n=failed)
        remove = self._params.outliers == "remove"
        kernels.write_poses(people, energy, solved, outlier, self._topology.links, remove)

    def _minimize_by_blocks(self, energy: Energy) -> tuple[Floats, int]:
        """(P, M, 3) Poses of least energy, and how many people did not converge."""
        solved = np.empty_like(energy.start)
        tolerance = self._params.tolerance
        return solved, int(minimize(energy, self._topology, tolerance, self._scratch, solved))

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
