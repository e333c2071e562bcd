"""Poses that a body can have: constant lengths, rigid groups, and the person's own motion.

1. The lengths of limbs, and the distances within head, thorax and pelvis, are measured once per
   person: L^2 = mean |d|^2 - 3 v, since noise of variance v along each axis lengthens.
2. Each pose is projected onto them. Uncertain markers move most.
3. The person's poses of some seconds are the prior of each of them
   (:mod:`hiros_mcap.stages.pose_prior`); then lengths are restored.
4. Known lengths take a part of the variance of each marker.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np
from pydantic import Field

from hiros_mcap.body.limb_table import Limb, LimbTable, link_keys
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, Part, frames_of, join
from hiros_mcap.params import Params, Seconds, advanced
from hiros_mcap.skeletons import (
    POSITION,
    UNTRACKED,
    Floats,
    Frame,
    Ints,
    SkeletonModel,
    Stamps,
)
from hiros_mcap.stages.residuals import restated

UNKNOWN_DEVIATION = 0.01  # m; of markers whose uncertainty no stage has said
SURE = 0.005  # m; added to the deviations that weight a length
OUTLIER = 4.0  # robust standard deviations
FEWEST = 30  # poses that give a length
_FORGET = 600.0  # s; somebody who returns has the same body


class ConstrainParams(Params):
    """Parameters of the constraints."""

    window: Seconds = Field(
        10.0,
        ge=0,
        description="Seconds that are corrected at once. 0 = each pose by those before it, as in "
        "fuse-realtime.",
    )
    enough: Seconds = advanced(
        60.0,
        ge=0,
        description="Seconds after which the lengths of a person stay as they are. Detectors see "
        "other lengths in other poses, so a few seconds in one pose do not give them. Results wait "
        "for it. In fuse-realtime, which does not wait, 5.",
    )
    rigid: bool = advanced(
        True, description="Keep the distances within head, thorax and pelvis, too."
    )
    prior: bool = advanced(
        True, description="Use the motion of the person in the window as a prior of each pose."
    )
    sweeps: int = advanced(20, ge=1, description="Most sweeps of the projection onto the lengths.")


def constrain(
    frames: Iterable[Frame],
    model: SkeletonModel,
    params: ConstrainParams | None = None,
    events: Events | None = None,
    limbs: LimbTable | None = None,
) -> Iterator[Frame]:
    """Do what :func:`constrain_blocks` does, frame by frame."""
    return frames_of(constrain_blocks(map(Block.of, frames), model, params, events, limbs))


def constrain_blocks(
    blocks: Iterable[Block],
    model: SkeletonModel,
    params: ConstrainParams | None = None,
    events: Events | None = None,
    limbs: LimbTable | None = None,
) -> Iterator[Block]:
    """Give everybody constant lengths and less noise.

    Parameters
    ----------
    blocks : fused frames; the uncertainty of their markers is used if it is known.
    model, params : the skeleton; see :class:`ConstrainParams`.
    events : notes when somebody's limbs are measured.
    limbs : lengths known from before, which these people keep. Those of the others are filled in.

    Yields
    ------
    The same frames with other positions, m, and orientations, logged when the lengths of everybody
    in their window were known.

    Raises
    ------
    ConfigError
        If ``limbs`` names a link that the model lacks.
    """
    params = params or ConstrainParams()
    events = Events() if events is None else events
    bodies = _Bodies(model, params, events, LimbTable() if limbs is None else limbs)
    waiting: deque[Block] = deque()
    held: list[Part] = []
    for block in blocks:
        for i, stamp in enumerate(block.stamps.tolist()):
            held.append((block, i))
            first = held[0][0].stamps[held[0][1]]
            if stamp - first >= params.window * 1e9:
                waiting.append(bodies.measured(held))
                held = []
                while waiting and bodies.can_correct(waiting[0], stamp):
                    yield bodies.corrected(waiting.popleft(), block.log_times[i])
    if held:
        waiting.append(bodies.measured(held))
    bodies.end_of_log()
    for window in waiting:
        yield bodies.corrected(window, waiting[-1].log_times[-1])


@dataclass
class _Body:
    """The body of one person."""

    lengths: Floats
    """(K,) m; 0 = not measured."""
    first: int
    last: int = 0
    """When the person was first and last seen, ns."""
    poses: list[Floats] = field(default_factory=list)
    variances: list[Floats] = field(default_factory=list)
    """What the lengths are measured from, until they are known."""
    known: bool = False


class _Bodies:
    """What is known of everybody's body."""

    def __init__(
        self, model: SkeletonModel, params: ConstrainParams, events: Events, limbs: LimbTable
    ) -> None:
        from hiros_mcap.body.rigid_groups import constant_pairs
        from hiros_mcap.kernels import link_lengths

        self._params, self._events, self._kernels = params, events, link_lengths
        self._lateral = symmetry_of(model).lateral
        self._links = model.links
        self._pairs = constant_pairs(model, rigid=params.rigid)
        self._limbs = PairLimbs(model, self._pairs, limbs)
        self._people: dict[int, _Body] = {}

    def measured(self, held: list[Part]) -> Block:
        """Measure everybody in a window; return it."""
        out = join(held)
        variances = own_variances(out)
        stamps = np.repeat(out.stamps, np.diff(out.rows).ravel())
        for person, rows in _tracked(out):
            self._measure(person, out, rows, variances, stamps[rows])  # 1
        return out

    def can_correct(self, window: Block, now: int) -> bool:
        """Whether nothing more about the people of a window is worth waiting for at ``now``, ns."""
        patience = self._params.enough + self._params.window
        waited = now - int(window.stamps[0]) >= patience * 1e9
        return waited or all(self._people[person].known for person, _ in _tracked(window))

    def corrected(self, out: Block, log_time: int) -> Block:
        """Correct the poses of a window."""
        variances = own_variances(out)
        for person, rows in _tracked(out):
            self._correct(person, out, rows, variances)  # 2 and 3
        self._people = remembered(self._people, int(out.stamps[-1]))
        log_times = np.full(len(out), log_time)
        return replace(surer(out, variances, self._links), log_times=log_times)

    def _measure(
        self, person: int, out: Block, rows: Stamps, variances: Floats, stamps: Stamps
    ) -> None:
        """Measure the lengths of a person as long as they are not well known."""
        body = self._people.setdefault(person, _Body(np.zeros(len(self._pairs)), int(stamps[0])))
        body.last = int(stamps[-1])
        if body.known:
            return
        body.poses.append(out.people.markers[rows][:, :, POSITION])
        body.variances.append(variances[rows])
        body.known = body.last - body.first >= self._params.enough * 1e9
        poses, own = np.concatenate(body.poses), np.concatenate(body.variances)
        found = measured_lengths(poses, own, self._pairs)
        body.lengths = self._limbs.given_or(person, np.where(np.isnan(found), body.lengths, found))
        self._limbs.keep(person, body.lengths, *_deviations(poses, self._pairs))
        if body.known:
            self._note(person)
            body.poses, body.variances = [], []

    def end_of_log(self) -> None:
        """Note the lengths of those who were not seen for long enough."""
        for person in [p for p, body in self._people.items() if not body.known]:
            self._note(person)

    def _note(self, person: int) -> None:
        body = self._people[person]
        detail = f"{sum(map(len, body.poses))} frames"
        self._events.note(body.last, "limbs calibrated", person=person, detail=detail)

    def _correct(self, person: int, out: Block, rows: Stamps, variances: Floats) -> None:
        """Project onto the lengths; move towards what the person does; project again."""
        from hiros_mcap.stages.pose_prior import shrink_noise

        markers, sweeps = out.people.markers, self._params.sweeps
        lengths = np.column_stack([self._people[person].lengths, np.ones(len(self._pairs))])
        project = self._kernels.project_all
        project(markers, rows, variances, self._pairs, lengths, sweeps, 1e-3)
        if self._params.prior:
            own = markers[rows][:, :, POSITION]
            markers[rows, :, POSITION] = shrink_noise(own, variances[rows], self._lateral)
            project(markers, rows, variances, self._pairs, lengths, sweeps, 1e-3)


class PairLimbs:
    """The lengths of links in the limb table of a run, as distances of pairs of markers.

    Parameters
    ----------
    model : the skeleton. pairs : (K, 2) slots with a constant distance. limbs : known from before.
    """

    def __init__(self, model: SkeletonModel, pairs: Ints, limbs: LimbTable) -> None:
        self._limbs, self._keys = limbs, link_keys(model)
        places = {(a, b): k for k, (a, b) in enumerate(pairs.tolist())}
        ends = np.sort(model.links, axis=1).tolist()
        self._places = {
            key: places.get((a, b)) for key, (a, b) in zip(self._keys, ends, strict=True)
        }
        self._given = {person: limbs.lengths(person, model) for person in limbs.people}

    def given_or(self, person: int, lengths: Floats) -> Floats:
        """Return (K,) lengths, m, with those that the person had before."""
        if person not in self._given:
            return lengths
        out = lengths.copy()
        for key, length in zip(self._keys, self._given[person].tolist(), strict=True):
            place = self._places[key]
            if place is not None and not np.isnan(length):
                out[place] = length
        return out

    def keep(self, person: int, lengths: Floats, deviations: Floats, frames: Ints) -> None:
        """Put lengths, m, that were measured in ``frames`` poses each into the table, all (K,)."""
        if person in self._given:
            return
        self._limbs.people[person] = {
            key: Limb(float(lengths[k]), float(deviations[k]), int(frames[k]))
            for key, k in self._places.items()
            if k is not None and lengths[k] > 0
        }


def _deviations(poses: Floats, pairs: Ints) -> tuple[Floats, Ints]:
    """(K,) Standard deviations of the distances of pairs, m, and the number of poses with each."""
    distances = np.linalg.norm(poses[:, pairs[:, 0]] - poses[:, pairs[:, 1]], axis=2)
    known = ~np.isnan(distances)
    n = np.maximum(known.sum(axis=0), 1)
    means = np.where(known, distances, 0.0).sum(axis=0) / n
    squares = np.where(known, (distances - means) ** 2, 0.0).sum(axis=0) / n
    return np.sqrt(squares), known.sum(axis=0).astype(np.int32)


class _Remembered(Protocol):
    last: int
    """When a person was seen last, ns."""


S = TypeVar("S", bound=_Remembered)


def remembered(people: dict[int, S], now: int) -> dict[int, S]:
    """Return what is known of the people without those who are gone for long at ``now``, ns."""
    return {p: body for p, body in people.items() if now - body.last <= _FORGET * 1e9}


def _tracked(block: Block) -> Iterator[tuple[int, Stamps]]:
    """Yield everybody who has an id, with the person's rows."""
    for person in np.unique(block.people.ids).tolist():
        if person != UNTRACKED:
            yield person, np.flatnonzero(block.people.ids == person)


def own_variances(block: Block) -> Floats:
    """(P, M) Variance of each marker along each axis by itself, m2, without what all share."""
    known = block.uncertainty
    if known is None:
        return np.full(block.people.marker_confidences.shape, UNKNOWN_DEVIATION**2)
    variances = known.deviations**2 - known.shared**2
    return np.where(np.isnan(variances), UNKNOWN_DEVIATION**2, np.maximum(variances, 1e-8))


def surer(out: Block, variances: Floats, links: Ints) -> Block:
    """Return a block with the uncertainty after the projection onto ``links``."""
    if out.uncertainty is None:
        return out
    left = variances * left_by_lengths(variances, links)
    return restated(out, np.where(np.isnan(out.uncertainty.deviations), np.nan, left))


def left_by_lengths(variances: Floats, links: Ints) -> Floats:
    """(P, M) Share of the variance that known lengths of ``links`` (L, 2) leave.

    A length fixes one of three directions. It takes v_a / (v_a + v_b) of the variance of its end a
    along the link. To first order, the links of a marker add up.
    """
    a, b = links[(links >= 0).all(axis=1)].T
    share = variances[:, a] / (variances[:, a] + variances[:, b])
    parts = np.stack([share / 3, (1 - share) / 3], axis=2).reshape(len(variances), 2 * len(a))
    taken = np.zeros(variances.shape[::-1])
    np.add.at(taken, np.stack([a, b], axis=1).ravel(), parts.T)
    return np.asarray(1 - np.minimum(taken.T, 2 / 3))


def measured_lengths(positions: Floats, variances: Floats, pairs: Ints) -> Floats:
    """(K,) Distances of markers without the part that noise adds, m; NaN = unknown.

    The noise is at most what the distance itself varies by: an overstated one would shorten.

    Parameters
    ----------
    positions : (T, M, 3) m. variances : (T, M) m2 along each axis. pairs : (K, 2) slots.
    """
    a, b = pairs[:, 0], pairs[:, 1]
    squares = ((positions[:, a] - positions[:, b]) ** 2).sum(axis=2)
    noise = variances[:, a] + variances[:, b]
    known = ~np.isnan(squares)
    squares = np.where(known, squares, np.nan)
    enough = known.sum(axis=0) >= FEWEST
    lengths = np.full(len(pairs), np.nan)
    if not enough.any():
        return lengths
    squares, noise, known = squares[:, enough], noise[:, enough], known[:, enough]
    middle = np.nanmedian(squares, axis=0)
    spread = 1.4826 * np.nanmedian(np.abs(squares - middle), axis=0)
    clipped = np.clip(squares, middle - OUTLIER * spread, middle + OUTLIER * spread)
    weights = known / (noise + 2 * SURE**2)
    mean = np.nansum(weights * clipped, axis=0) / weights.sum(axis=0)
    stated = np.nansum(weights * noise, axis=0) / weights.sum(axis=0)
    lengths[enough] = np.sqrt(mean - 3 * np.minimum(stated, np.nanvar(np.sqrt(clipped), axis=0)))
    return lengths
