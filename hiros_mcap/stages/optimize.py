"""Skeleton optimizer: constant limb lengths, outliers out (Hi-ROS 2023, section 3.3).

Per person and frame, in the order of the paper: the limb lengths found by calibration, the markers
that contradict them, and the pose of least energy (eq. 14 to 19).

The markers are the only unknowns. E_o needs an orientation of a link, and a link's direction is
the part of it that markers determine: turning a bone about itself moves neither of its ends. So
phi is the angle between a link's direction before and after; on request (``turn_links``) the
link's quaternion is afterwards turned by the least rotation between the two.

**What the paper's weights do.** Its w_l grows with the length error and vanishes with it, so a
small error is only partly corrected. And E_o, in rad^2 beside m^2, holds directions, noise and
all, much harder than positions. ``lengths="exact"`` (the default) keeps the three terms and the
solver, and weighs them by what is known: lengths almost rigid, positions by their confidence,
directions next to nothing. Measured on simulated logs of two and four people, five cameras merged
by an oracle (mean joint error; coefficient of variation of the lengths; rms error of the limbs'
directions):

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
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from operator import attrgetter
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, frames_of, join
from hiros_mcap.kernels import optimizing as kernels
from hiros_mcap.skeletons import POSITION, Floats, Frame, Ints, People, SkeletonModel
from hiros_mcap.stages.elimination import outward, plan
from hiros_mcap.stages.limb_calibration import Calibration, CalibrationParams, calibrate

MAX_STEPS = 50

# lengths="exact": against 1 for a position of full confidence.
STIFFNESS = 1e3
DIRECTION = 1e-3


class OptimizeParams(CalibrationParams):
    """Parameters of calibration, outlier detection and optimization."""

    lengths: Literal["exact", "paper"] = Field(
        "exact",
        description="exact: lengths are rigid, markers move as little as possible. paper: the "
        "weights of eq. 18, which correct small errors partly. Exact has the smaller joint error "
        "and a coefficient of variation of the lengths below 0.001 instead of 0.035.",
    )
    max_length_error: float = Field(
        0.1,
        gt=0.0,
        description="m: a link whose length is off by more has an outlier at one of its ends; also "
        "the scale of eq. 18 (L, which the paper does not give). Six times the spread of a link "
        "between merged joints; on clean logs 0.1 to 0.3 do the same, of joints displaced by 15 "
        "or 30 cm 0.1 repairs most.",
    )
    outliers: Literal["restore", "remove"] = Field(
        "restore",
        description="What becomes of an outlier. restore: it is put where the other markers and "
        "the lengths want it and has no say in the solution, so skeletons stay complete; which end "
        "of a wrong link is the outlier, a robust fit tells. "
        "remove: a wrong link's distal marker and all links that touch it are left out (paper).",
    )
    turn_links: bool = Field(
        False,
        description="Turn link orientations along with the bones. Detectors measure orientations "
        "apart from positions and better than a short bone's ends tell them: on logs made from "
        "real motion, turning raises their mean error from 2.6 to 4.2 degrees.",
    )
    solver: Literal["lm", "ceres"] = Field(
        "lm",
        description="lm: compiled block Levenberg-Marquardt. ceres: the same energy by Ceres "
        "Solver (needs the extra hiros-mcap[ceres]); about 100 times slower, for comparison.",
    )
    tolerance: float = Field(
        1e-6, gt=0.0, description="m: the solver has converged when no coordinate moves further."
    )

    @classmethod
    def paper(cls) -> OptimizeParams:
        """Return the parameters of the paper as printed (its L, which it does not give, 0.1 m)."""
        return cls(
            lengths="paper",
            max_length_error=0.1,
            outliers="remove",
            turn_links=True,
            max_free=0.0,
            debias=False,
            refine=False,
        )


Solver = Callable[[Floats, Floats, Floats], tuple[Floats, int]]
"""(start (P, M, 3), nominal (P, L), weights (P, L, 4)) -> solution, how many did not converge."""


def optimize(
    frames: Iterable[Frame],
    model: SkeletonModel,
    params: OptimizeParams = OptimizeParams(),  # noqa: B008 - immutable
    events: Events | None = None,
    limbs: LimbTable | None = None,
) -> Iterator[Frame]:
    """Give everybody constant limb lengths; order and number of frames stay as they are.

    People without an id, and people whose limbs are not (yet) known, pass through unchanged.

    Parameters
    ----------
    frames : in time order, merged or tracked.
    limbs : lengths known from before. Filled with everybody calibrated on the way.

    Raises
    ------
    ConfigError
        If ``limbs`` names a link that the model lacks, or Ceres is asked for and not installed.
    """
    return frames_of(optimize_blocks(map(Block.of, frames), model, params, events, limbs))


def optimize_blocks(
    blocks: Iterable[Block],
    model: SkeletonModel,
    params: OptimizeParams = OptimizeParams(),  # noqa: B008 - immutable
    events: Events | None = None,
    limbs: LimbTable | None = None,
) -> Iterator[Block]:
    """Do what :func:`optimize` does, a block at a time."""
    events = events if events is not None else Events()
    limbs = limbs if limbs is not None else LimbTable()
    if params.calibration == "two-pass":
        if not limbs.people:
            blocks = list(blocks)
            limbs.people.update(calibrate(frames_of(blocks), model, params, events).people)
        params = params.model_copy(update={"calibration": "off"})
    calibration = Calibration(model, params, events, limbs)
    fit = _Fit(model, params, events)
    for ready in _held_back(blocks, calibration):
        for block, group in itertools.groupby(ready, key=attrgetter("block")):
            yield fit(block, list(group))


class _Ready(NamedTuple):
    """A frame whose people's lengths are settled."""

    block: Block
    place: int
    log_time: int
    nominal: Floats
    """(P, L) lengths, m."""


def _held_back(blocks: Iterable[Block], calibration: Calibration) -> Iterator[list[_Ready]]:
    """Delay frames, in order, until the calibration of everybody in them is settled.

    A delayed frame gets the log time of the frame that let it go. Yields what each block lets go.
    """
    held: deque[tuple[Block, int, list[int]]] = deque()
    now = 0

    def release() -> _Ready:
        block, place, people = held.popleft()
        return _Ready(block, place, now, calibration.nominal(people))

    for block in blocks:
        ready = []
        ids, measured = block.people.ids.tolist(), calibration.measure(block.people)
        times = zip(
            block.stamps.tolist(), block.log_times.tolist(), block.rows.tolist(), strict=True
        )
        for i, (stamp, log_time, (begin, end)) in enumerate(times):
            calibration.observe(stamp, ids, measured, begin, end)
            held.append((block, i, ids[begin:end]))
            now = max(now, log_time)
            while held and not calibration.waits_for(held[0][2]):
                ready.append(release())
        yield ready
    calibration.finish()
    yield [release() for _ in range(len(held))]


class _Fit:
    """Outlier detection and optimization of some frames (sections 3.3.2 and 3.3.3)."""

    def __init__(self, model: SkeletonModel, params: OptimizeParams, events: Events) -> None:
        self._names = model.marker_names
        self._params, self._events = params, events
        self._outward, self._topology = outward(model), _topology(model)
        self._links = self._topology.links
        self._degree = _degrees(self._links, model.n_markers)
        self._work = kernels.Work.of(model.n_markers, self._topology)
        self._directions = np.empty((2, 3))
        self._solve = _solver(model, params)

    def __call__(self, block: Block, ready: list[_Ready]) -> Block:
        """Return frames of a block with their calibrated people optimized."""
        places, log_times = [one.place for one in ready], [one.log_time for one in ready]
        nominal = np.concatenate([one.nominal for one in ready])
        known = ~np.isnan(nominal).all(axis=1)
        if not known.any():
            return block.select(places, log_times)
        out = join([(block, i) for i in places])
        if known.all():
            self._fit(out.people, nominal)
        else:
            part = out.people.at(known)
            self._fit(part, nominal[known])
            for name in ("markers", "marker_confidences", "links", "link_confidences"):
                getattr(out.people, name)[known] = getattr(part, name)
        return replace(out, log_times=np.array(log_times, np.int64))

    def _fit(self, people: People, nominal: Floats) -> None:
        """Optimize everybody, in place."""
        points = people.markers[:, :, POSITION].copy()
        outlier, weights = self._find_outliers(points, nominal, people.marker_confidences)
        if weights is None:
            stiffness = STIFFNESS if self._params.lengths == "exact" else 0.0
            weights = self._weigh(points, nominal, people.marker_confidences, outlier, stiffness)
        solved, failed = self._solve(points, nominal, weights)
        self._events.count("optimizer not converged", n=failed)
        kernels.apply(
            solved, people.markers, people.marker_confidences, people.links,
            people.link_confidences,
            self._links, weights, outlier, self._params.outliers == "remove",
            self._params.turn_links, self._directions,
        )  # fmt: skip

    def _find_outliers(
        self, points: Floats, nominal: Floats, confidences: Floats
    ) -> tuple[Ints, Floats | None]:
        """(P, M) 1 for outliers; ``points`` has them relocated or absent.

        Also the solver's weights, if the search had to find them and they still hold.
        """
        outlier = np.zeros(points.shape[:2], np.int32)
        limit = self._params.max_length_error
        if self._params.outliers == "remove":
            found = kernels.judge(points, nominal, self._links, self._outward, limit, outlier)
            trusted = None
        else:
            trusted = self._weigh(points, nominal, confidences, outlier, STIFFNESS)
            found = kernels.relocate(
                points, nominal, trusted, self._topology, limit, outlier, self._work
            )
        if found:
            self._count(outlier)
        return outlier, None if found or self._params.lengths != "exact" else trusted

    def _weigh(
        self, points: Floats, nominal: Floats, confidences: Floats, outlier: Ints, stiffness: float
    ) -> Floats:
        weights = np.empty((*nominal.shape, 4))
        kernels.weigh(
            points, nominal, confidences, self._links, self._degree, outlier,
            self._params.max_length_error, stiffness, DIRECTION, weights,
        )  # fmt: skip
        return weights

    def _count(self, outlier: Ints) -> None:
        for marker, n in enumerate(np.count_nonzero(outlier, axis=0)):
            self._events.count("optimizer outlier", self._names[marker], int(n))


def _degrees(links: Ints, n_markers: int) -> Ints:
    """(M,) number of links that end in each marker."""
    ends = links[(links >= 0).all(axis=1)].ravel()
    return np.bincount(ends, minlength=n_markers).astype(np.int32)


def _solver(model: SkeletonModel, params: OptimizeParams) -> Solver:
    if params.solver == "ceres":
        from hiros_mcap.stages.ceres import CeresSolver

        return CeresSolver(model, params.tolerance)
    return block_solver(model, params.tolerance)


def _topology(model: SkeletonModel) -> kernels.Topology:
    p = plan(model)
    links = np.ascontiguousarray(model.links)
    return kernels.Topology(links, p.order, p.first, p.row, p.first_pair, p.target, p.link_slot)


def block_solver(model: SkeletonModel, tolerance: float) -> Solver:
    """Return the compiled solver for the topology of ``model``."""
    topology = _topology(model)
    work = kernels.Work.of(model.n_markers, topology)

    def solve(start: Floats, nominal: Floats, weights: Floats) -> tuple[Floats, int]:
        solved = np.empty_like(start)
        failed = kernels.solve(
            start, nominal, weights, topology, tolerance, MAX_STEPS, work, solved
        )
        return solved, int(failed)

    return solve
