"""Constant limb lengths from the root to the leaves (Malaguti 2019, III-E)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

import numpy as np

from hiros_mcap.body.limb_table import Limb, LimbTable, link_keys
from hiros_mcap.body.segments import HEAD
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.events import Events
from hiros_mcap.kernels.array_types import settings_of
from hiros_mcap.skeletons import POSITION, UNTRACKED, Frame, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.malaguti import limb_lengths as kernels
from hiros_mcap.stages.malaguti.malaguti_params import StraightenParams


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


class _LimbConsistency:
    """The limb lengths of everybody who was seen lately."""

    def __init__(self, model: SkeletonModel, params: StraightenParams, limbs: LimbTable) -> None:
        self._limbs, self._keys = limbs, link_keys(model)
        self._given = {person: limbs.lengths(person, model) for person in limbs.people}
        self._settings = settings_of(kernels.LimbSettings, params)
        head = [k for k, name in enumerate(model.marker_names) if split_side(name)[0] in HEAD]
        order = link_order(model, () if params.head else head)
        self._tree = kernels.LinkTree(np.ascontiguousarray(model.links), order)
        nobody, none = np.zeros(0, np.int64), np.zeros((0, model.n_links))
        self._bank = Bank(kernels.LimbLengths(none, none, nobody, nobody > 0))
        self._calibrated: set[int] = set()

    def apply(self, out: Frame) -> list[int]:
        """Move the joints of ``out`` in place; return who is calibrated from now on."""
        former_rows = self._bank.rows.copy()
        for person in self._bank.expire(out.stamp):
            self._save(person, former_rows[person])
            self._calibrated.discard(person)
        rows = [
            -1 if person == UNTRACKED else self._row(person, out.stamp)
            for person in out.ids.tolist()
        ]
        past = self._bank.past
        kernels.straighten(out.markers, np.array(rows, np.int64), past, self._tree, self._settings)
        if len(self._calibrated) == len(self._bank.rows):
            return []
        enough = self._settings.frames
        ready = {person for person, row in self._bank.rows.items() if past.frames[row] >= enough}
        new = ready - self._calibrated
        self._calibrated = ready
        return sorted(new)

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
            past, n = self._bank.past, self._settings.frames
            deviations = np.sqrt(past.squares[row] / n).tolist()
            columns = zip(self._keys, past.lengths[row].tolist(), deviations, strict=True)
            limbs = {key: Limb(length, sd, n) for key, length, sd in columns if length > 0}
            self._limbs.people[person] = limbs


def link_order(model: SkeletonModel, without: Collection[int] = ()) -> Stamps:
    """Order the links, a parent's before its children's; loops and loose ends are left out.

    A root is a marker that is no link's child. Links of the markers ``without`` are left out, too.
    """
    ends = {
        k: (p, c)
        for k, (p, c) in enumerate(model.links.tolist())
        if p not in without and c not in without
    }
    children = {c for _, c in ends.values()}
    placed = {p for p, _ in ends.values() if p >= 0 and p not in children}
    order: list[int] = []
    waiting = [k for k, (p, c) in ends.items() if p >= 0 and c >= 0]
    while True:
        ready = [k for k in waiting if ends[k][0] in placed and ends[k][1] not in placed]
        if not ready:
            return np.array(order, np.int64)
        for k in ready:
            if ends[k][1] not in placed:
                order.append(k)
                placed.add(ends[k][1])
        waiting = [k for k in waiting if k not in order]


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
