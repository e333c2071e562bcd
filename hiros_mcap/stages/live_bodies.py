"""Poses that a body can have, each by the poses before it.

What :mod:`hiros_mcap.stages.constrain` learns from a window, this learns on the way:

1. The means behind each length run on for some seconds; the first poses use what there is. Both
   sides of a body have the same lengths.
2. Every half second, the motion of the last seconds becomes the prior of the poses to come. A
   marker that moves as it never did before is believed: its step is limited.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.body.rigid_groups import constant_pairs
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, join
from hiros_mcap.kernels.link_lengths import project
from hiros_mcap.skeletons import POSITION, Flags, Floats, Ints, SkeletonModel
from hiros_mcap.stages.constrain import (
    FEWEST,
    OUTLIER,
    SURE,
    PairLimbs,
    own_variances,
    remembered,
    surer,
)
from hiros_mcap.stages.constrain_params import ConstrainParams
from hiros_mcap.stages.pose_prior import FEWEST as FEWEST_POSES
from hiros_mcap.stages.pose_prior import PoseSpace, estimated, local_frames, motion_of

_RATE = 15.0  # Hz; a prior needs no more poses
_FIRST, _RENEWED = 2.0, 0.5  # s of a person before the first prior, and between two
_LARGEST_STEP = 0.5  # by the prior, in standard deviations
_POSES = 45  # of 3 s
_LEFT = 1.0  # s unseen after which the motion is learned anew


def constrain_live(
    blocks: Iterable[Block],
    model: SkeletonModel,
    params: ConstrainParams | None = None,
    events: Events | None = None,
    limbs: LimbTable | None = None,
) -> Iterator[Block]:
    """Do what :func:`hiros_mcap.stages.constrain.constrain_blocks` does, without waiting."""
    events = Events() if events is None else events
    bodies = LiveBodies(model, params or ConstrainParams(), events, limbs)
    yield from map(bodies.constrain, blocks)
    bodies.keep_lengths()


class LiveBodies:
    """What is known of everybody's body so far."""

    def __init__(
        self,
        model: SkeletonModel,
        params: ConstrainParams,
        events: Events,
        limbs: LimbTable | None = None,
    ) -> None:
        self._params, self._events = params, events
        symmetry = symmetry_of(model)
        self._links, self._lateral, self._mirror = model.links, symmetry.lateral, symmetry.mirror
        self._pairs = constant_pairs(model, rigid=params.rigid)
        self._limbs = PairLimbs(model, self._pairs, LimbTable() if limbs is None else limbs)
        self._people: dict[int, _LiveBody] = {}

    def constrain(self, block: Block) -> Block:
        """Correct the poses of a block, one after the other; each is logged when it came."""
        if not len(block):
            return block
        out = join([(block, i) for i in range(len(block))])
        variances = own_variances(out)
        for stamp, (begin, end) in zip(out.stamps.tolist(), out.rows.tolist(), strict=True):
            bodies = [self._body(i, stamp) for i in out.people.ids[begin:end].tolist()]
            self._correct(bodies, out.people.markers[begin:end], variances[begin:end])
            self._people = remembered(self._people, stamp)
        return surer(out, variances, self._links)

    def _body(self, person: int, stamp: int) -> _LiveBody:
        """Return what is known of who is seen at ``stamp``, ns."""
        body = self._people.get(person)
        if body is None:
            lengths = RunningLengths(self._pairs, self._mirror)
            body = self._people[person] = _LiveBody(person, lengths, RecentMotion(), stamp, stamp)
        elif stamp - body.last > _LEFT * 1e9:
            body.recent = RecentMotion()
        before = (body.last - body.first) * 1e-9
        body.last = max(stamp, body.last)
        enough = self._params.enough
        if before < enough <= (body.last - body.first) * 1e-9:
            self._events.note(stamp, "limbs calibrated", person=person)
        return body

    def keep_lengths(self) -> None:
        """Put everybody's lengths into the run's table."""
        for person, body in self._people.items():
            measured = body.lengths
            self._limbs.keep(person, measured.lengths, measured.deviations, measured.counts)

    def _correct(self, bodies: Sequence[_LiveBody], markers: Floats, variances: Floats) -> None:
        """Project onto the lengths; move towards what the person does; project again."""
        for row, body in enumerate(bodies):
            if body.last - body.first <= self._params.enough * 1e9:
                body.lengths.update(markers[row, :, POSITION], variances[row])
        self._project(bodies, markers, variances)
        if self._params.prior and bodies:
            frames, origins = local_frames(markers[:, :, POSITION], self._lateral)
            poses = (markers[:, :, POSITION] - origins) @ frames
            for row, body in enumerate(bodies):
                poses[row] = body.recent.shrink(poses[row], variances[row], body.last)
            markers[:, :, POSITION] = poses @ np.swapaxes(frames, 1, 2) + origins
            self._project(bodies, markers, variances)

    def _project(self, bodies: Sequence[_LiveBody], markers: Floats, variances: Floats) -> None:
        """Give the links of each body (P, M, 19) its lengths."""
        for row, body in enumerate(bodies):
            constant = self._limbs.given_or(body.person, body.lengths.lengths)
            lengths = np.column_stack([constant, np.ones(len(self._pairs))])
            project(markers[row], self._pairs, lengths, variances[row], self._params.sweeps, 1e-3)


class RunningLengths:
    """Distances of markers without the part that noise adds, from running means.

    L^2 = mean |d|^2 - 3 v, as :func:`hiros_mcap.stages.constrain.measured_lengths` has it.

    Parameters
    ----------
    pairs : (K, 2) slots. mirror : (M,) slot of the same joint on the other side.
    """

    def __init__(self, pairs: Ints, mirror: Ints) -> None:
        self._a, self._b = pairs[:, 0], pairs[:, 1]
        places = {(a, b): k for k, (a, b) in enumerate(pairs.tolist())}
        others = np.sort(mirror[pairs], axis=1).tolist()
        self._other = np.array([places.get((a, b), k) for k, (a, b) in enumerate(others)], np.int64)
        """(K,) the same pair on the other side, which has the same length."""
        k = len(pairs)
        self.counts = np.zeros(k, np.int32)
        """(K,) poses with both ends."""
        self._weight = np.zeros(k)
        self._means = np.zeros((4, k))
        """Of the square of the distance, its square, the distance, and the noise."""
        self.lengths = np.zeros(k)
        """(K,) m; 0 = unknown."""

    def update(self, positions: Floats, variances: Floats) -> None:
        """Take a pose: (M, 3) m, (M,) m2 along each axis."""
        squares = ((positions[self._a] - positions[self._b]) ** 2).sum(axis=1)
        noise = variances[self._a] + variances[self._b]
        known = ~np.isnan(squares)
        squares = np.where(known, squares, 0.0)
        mean, mean_square = self._means[:2]
        spread = np.sqrt(np.maximum(mean_square - mean**2, 0.0))
        clipped = np.clip(squares, mean - OUTLIER * spread, mean + OUTLIER * spread)
        squares = np.where(self.counts >= FEWEST, clipped, squares)
        new = known / (noise + 2 * SURE**2)
        self._weight += new
        gain = new / np.maximum(self._weight, 1e-12)
        values = np.stack([squares, squares**2, np.sqrt(squares), noise])
        self._means += gain * (values - self._means)
        self.counts += known
        square, _, distance, stated = self._means
        added = 3 * np.minimum(stated, np.maximum(square - distance**2, 0.0))
        found, weight, other = np.maximum(square - added, 0.0), self._weight, self._other
        both = np.maximum(weight + weight[other], 1e-12)
        self.lengths = np.sqrt((weight * found + weight[other] * found[other]) / both)

    @property
    def deviations(self) -> Floats:
        """(K,) Standard deviations of the distances as they were seen, m."""
        square, _, distance, _ = self._means
        return np.sqrt(np.maximum(square - distance**2, 0.0))


class RecentMotion:
    """The last seconds of a person, and the prior that they give."""

    def __init__(self) -> None:
        self._poses: list[Floats] = []
        self._variances: list[Floats] = []
        self._next = self._pushed = 0
        """When the prior is due, and when the last pose was kept, ns."""
        self._motion: tuple[PoseSpace, Flags] | None = None
        """With the markers that any pose had."""

    def shrink(self, local: Floats, variances: Floats, stamp: int) -> Floats:
        """Return a pose (M, 3), m, moved towards what the person has done; then remember it.

        Poses are in the person's own frame (``pose_prior.local_frames``).
        """
        estimate = self._estimate(local, variances)
        # Not the pose as measured: from what has less noise, a better prior is learned.
        self._remember(estimate, variances, stamp)
        return estimate

    def _estimate(self, local: Floats, variances: Floats) -> Floats:
        if self._motion is None:
            return local
        motion, known = self._motion
        estimate = local.copy()
        estimate[known] = estimated(motion, local[None, known], variances[None, known])[0]
        steps = estimate - local
        sizes, most = np.linalg.norm(steps, axis=1), _LARGEST_STEP * np.sqrt(3 * variances)
        scale = most / np.maximum(sizes, np.maximum(most, 1e-9))
        return np.asarray(np.where(np.isnan(sizes), 1.0, scale)[:, None] * steps + local)

    def _remember(self, local: Floats, variances: Floats, stamp: int) -> None:
        """Keep a pose; renew the prior if it is due."""
        if not self._poses:
            self._next = stamp + round(_FIRST * 1e9)
        elif stamp - self._pushed < 0.9e9 / _RATE:
            return
        self._pushed = stamp
        self._poses = [*self._poses[1 - _POSES :], local]
        self._variances = [*self._variances[1 - _POSES :], variances]
        if stamp >= self._next and len(self._poses) >= FEWEST_POSES:
            self._next = stamp + round(_RENEWED * 1e9)
            poses = np.stack(self._poses)
            known: Flags = np.asarray(~np.isnan(poses).any(axis=2).all(axis=0))
            some, noise = poses[:, known], np.stack(self._variances)[:, known]
            self._motion = (motion_of(some, noise), known) if known.any() else None


@dataclass
class _LiveBody:
    """What is known of one person."""

    person: int
    lengths: RunningLengths
    recent: RecentMotion
    first: int
    """When the person was seen first, and last, ns."""
    last: int
