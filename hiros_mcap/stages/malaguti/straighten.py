"""Constant limb lengths from the root to the leaves (Malaguti 2019, III-E)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.limb_table import Limb, LimbTable, link_keys
from hiros_mcap.body.link_levels import link_levels
from hiros_mcap.body.segments import HEAD
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.events import Events
from hiros_mcap.skeletons import (
    POSITION,
    UNTRACKED,
    Flags,
    Floats,
    Frame,
    Ints,
    SkeletonModel,
    Stamps,
)
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.malaguti.malaguti_params import StraightenParams

_SHORTEST = 1e-6  # m; a shorter link has no direction


def straighten(
    frames: Iterable[Frame], model: SkeletonModel, params: StraightenParams | None = None,
    events: Events | None = None, limbs: LimbTable | None = None,
) -> Iterator[Frame]:  # fmt: skip
    """Give everybody's links their lengths (Malaguti 2019, III-E).

    Parameters
    ----------
    frames : merged frames; people pass unchanged until their lengths are known.
    model : its links are walked from the root outwards; those that close a loop are left alone.
    params, events : parameters; where calibrations are noted.
    limbs : lengths known from before. These people keep them exactly, from their first frame on.
        Filled with the lengths of everybody else, when they leave and at the end.

    Raises
    ------
    ConfigError
        If ``limbs`` names a link that the model lacks.
    """
    params = params or StraightenParams()
    consistency = _LimbConsistency(model, params, LimbTable() if limbs is None else limbs)
    events = Events() if events is None else events
    chest = _chest(model) if params.chest_midpoint else None
    for frame in frames:
        out = frame.replace(markers=frame.markers.copy())
        for person in consistency.apply(out):  # eq 11 to 13
            events.note(frame.stamp, "limbs calibrated", person=person)
        if chest is not None:
            slot, corners = chest
            out.markers[:, slot, POSITION] = out.markers[:, corners, POSITION].mean(axis=1)
        yield out
    consistency.save_all()


class LimbLengths(NamedTuple):
    """The learned limbs of people: R rows, L links."""

    lengths: Floats  # (R, L) m
    squares: Floats  # (R, L) sum of the squared deviations of the first lengths, m2
    frames: Stamps  # (R,) frames with the whole skeleton that were measured
    given: Flags  # (R,) whether the lengths are known from before; NaN = a link has none


class _LimbConsistency:
    """The limb lengths of everybody who was seen lately."""

    def __init__(self, model: SkeletonModel, params: StraightenParams, limbs: LimbTable) -> None:
        self._limbs, self._keys = limbs, link_keys(model)
        self._given = {person: limbs.lengths(person, model) for person in limbs.people}
        self._params, self._links = params, model.links
        head = [k for k, name in enumerate(model.marker_names) if split_side(name)[0] in HEAD]
        self._levels = link_levels(model, () if params.head else head)
        nobody, none = np.zeros(0, np.int64), np.zeros((0, model.n_links))
        self._bank = Bank(LimbLengths(none, none, nobody, nobody > 0))
        self._calibrated: set[int] = set()

    def apply(self, out: Frame) -> list[int]:
        """Move the joints of ``out`` in place; return who is calibrated from now on."""
        former_rows = self._bank.rows.copy()
        for person in self._bank.expire(out.stamp):
            self._save(person, former_rows[person])
            self._calibrated.discard(person)
        tracked = np.flatnonzero(out.ids != UNTRACKED)
        rows = np.array([self._row(p, out.stamp) for p in out.ids[tracked].tolist()], np.int64)
        past, poses, enough = self._bank.past, out.positions[tracked], self._params.frames
        new = ~past.given[rows]
        learn_lengths(poses[new], rows[new], past, self._levels, self._links, self._params)
        known = past.given[rows] | (past.frames[rows] >= enough)
        straight = straightened(poses[known], past.lengths[rows[known]], self._links, self._levels)
        out.markers[tracked[known], :, POSITION] = straight
        if len(self._calibrated) == len(self._bank.rows):
            return []
        ready = {person for person, row in self._bank.rows.items() if past.frames[row] >= enough}
        now_ready, self._calibrated = ready - self._calibrated, ready
        return sorted(now_ready)

    def _row(self, person: int, stamp: int) -> int:
        is_new = person not in self._bank.rows
        row = self._bank.row(person, stamp)
        if is_new and person in self._given:
            self._bank.past.lengths[row] = self._given[person]
            self._bank.past.given[row] = True
        return row

    def save_all(self) -> None:
        """Put the lengths of everybody who is left into the table."""
        for person, row in self._bank.rows.items():
            self._save(person, row)

    def _save(self, person: int, row: int) -> None:
        if person in self._calibrated:
            past, n = self._bank.past, self._params.frames
            deviations = np.sqrt(past.squares[row] / n).tolist()
            columns = zip(self._keys, past.lengths[row].tolist(), deviations, strict=True)
            limbs = {key: Limb(length, sd, n) for key, length, sd in columns if length > 0}
            self._limbs.people[person] = limbs


def learn_lengths(
    poses: Floats, rows: Stamps, past: LimbLengths, levels: Sequence[Stamps], links: Ints,
    params: StraightenParams,
) -> None:  # fmt: skip
    """Average the first whole skeletons (P, M, 3); adapt the lengths slowly afterwards.

    ``rows`` (P,) are those of the people in ``past``.
    """
    order = np.concatenate([*levels, np.zeros(0, np.int64)])
    _, lengths = _steps(poses, links[order])
    is_whole: Flags = np.asarray(~np.isnan(lengths).any(axis=1))
    error = lengths - past.lengths[rows[:, None], order]
    n = past.frames[rows][:, None]
    is_first = n < params.frames
    averaged = is_first & is_whole[:, None]
    adapted = ~is_first & ~np.isnan(error)
    change = np.where(averaged, error / (n + 1), params.rate * error)
    past.lengths[rows[:, None], order] += np.where(averaged | adapted, change, 0.0)
    past.squares[rows[:, None], order] += np.where(averaged, error * error * n / (n + 1), 0.0)
    past.frames[rows] += is_first[:, 0] & is_whole


def straightened(poses: Floats, lengths: Floats, links: Ints, levels: Sequence[Stamps]) -> Floats:
    """(P, M, 3) Poses whose links have their lengths (P, L), m: children are moved, roots first.

    The minimum of eq 12 has a closed form. Theta_kf points from the moved parent to the filter's
    child (eq 13), so the point at the link's length in this direction makes both terms 0. A link
    without a length is left alone.
    """
    out = poses.copy()
    for level in levels:
        parents, children = links[level].T
        steps, measured = _steps(out, links[level])
        known = ~np.isnan(measured + lengths[:, level]) & (measured >= _SHORTEST)
        scale = np.divide(lengths[:, level], measured, out=np.ones_like(measured), where=known)
        moved = out[:, parents] + scale[..., None] * steps  # eq 12
        out[:, children] = np.where(known[..., None], moved, out[:, children])
    return out


def _steps(poses: Floats, links: Ints) -> tuple[Floats, Floats]:
    """(P, K, 3) and (P, K) Vectors from parent to child of ``links`` (K, 2), and lengths, m."""
    steps = poses[:, links[:, 1]] - poses[:, links[:, 0]]
    return steps, np.sqrt((steps**2).sum(axis=-1))


def _chest(model: SkeletonModel) -> tuple[int, list[int]] | None:
    """Slot of the chest, and those of shoulders and hips; None if a name is missing."""
    slots = {split_side(name): slot for slot, name in enumerate(model.marker_names)}
    chest = next((slots[(n, "")] for n in ("chest", "spine_chest") if (n, "") in slots), None)
    corners = [
        slots.get((part, side)) for part in ("shoulder", "hip") for side in ("left", "right")
    ]
    if chest is None or None in corners:
        return None
    return chest, [slot for slot in corners if slot is not None]
