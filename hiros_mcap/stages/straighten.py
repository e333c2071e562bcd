"""Constant limb lengths from the root to the leaves (Malaguti 2019, III-E)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from pydantic import Field

from hiros_mcap.body.limb_table import Limb, LimbTable, link_keys
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.events import Events
from hiros_mcap.params import Params
from hiros_mcap.skeletons import POSITION, UNTRACKED, Floats, Frame, SkeletonModel, Stamps


class StraightenParams(Params):
    """Parameters of the limb lengths."""

    frames: int = Field(
        30,
        ge=1,
        description='Frames with the whole skeleton that lengths start from ("the first few").',
    )
    rate: float = Field(
        0.002,
        ge=0,
        le=1,
        description="Share of a new measurement in a length. The paper updates with the optimized "
        "joints, whose links have just that length: here with the filter's.",
    )
    chest_midpoint: bool = Field(
        False, description="Put the chest in the middle of shoulders and hips (III-E)."
    )


def straighten(
    frames: Iterable[Frame],
    model: SkeletonModel,
    params: StraightenParams | None = None,
    events: Events | None = None,
    limbs: LimbTable | None = None,
) -> Iterator[Frame]:
    """Give everybody's links their lengths: the closed minimum of eq 12.

    Parameters
    ----------
    frames : merged frames; people pass unchanged until their lengths are known.
    model : its links are walked from the root outwards; those that close a loop are left alone.
    params, events : parameters; where calibrations are noted.
    limbs : lengths known from before; filled on the way.
    """
    from hiros_mcap.kernels.joint_filter import straighten as kernel

    params, limbs = params or StraightenParams(), limbs or LimbTable()
    events = Events() if events is None else events
    order, links = link_order(model), np.ascontiguousarray(model.links)
    chest = _chest(model) if params.chest_midpoint else None
    rows: dict[int, int] = {}
    lengths, learned = np.zeros((8, model.n_links)), np.zeros(8, np.int64)
    for frame in frames:
        ids = frame.ids.tolist()
        for person in ids:
            if person != UNTRACKED:
                rows.setdefault(person, len(rows))
        if len(rows) > len(lengths):
            lengths = np.concatenate([lengths, np.zeros((len(rows), model.n_links))])
            learned = np.concatenate([learned, np.zeros(len(rows), np.int64)])
        out = frame.replace(markers=frame.markers.copy())
        own = np.array([rows.get(person, -1) for person in ids], np.int64)
        before = learned[own]
        kernel(out.markers, own, lengths, learned, links, order, params.frames, params.rate)
        for k in np.nonzero((before < params.frames) & (learned[own] >= params.frames))[0]:
            events.note(frame.stamp, "limbs calibrated", person=ids[k])
        if chest is not None:
            slot, corners = chest
            out.markers[:, slot, POSITION] = out.markers[:, corners, POSITION].mean(axis=1)
        yield out
    for person, row in rows.items():
        if learned[row] >= params.frames:
            limbs.people[person] = _as_limbs(lengths[row], model, params)


def _as_limbs(lengths: Floats, model: SkeletonModel, params: StraightenParams) -> dict[str, Limb]:
    rows = zip(link_keys(model), lengths.tolist(), strict=True)
    return {key: Limb(length, 0.0, params.frames) for key, length in rows if length > 0}


def link_order(model: SkeletonModel) -> Stamps:
    """Link slots so that a link's parent is placed before it; loops and loose ends left out.

    A root is a marker that is no link's child.
    """
    ends = [(int(p), int(c)) for p, c in model.links]
    children = {c for _, c in ends}
    placed = {p for p, _ in ends if p >= 0 and p not in children}
    order: list[int] = []
    waiting = [k for k, (p, c) in enumerate(ends) if p >= 0 and c >= 0]
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
    """Slot of the chest, and those of shoulders and hips; None if the names do not tell."""
    slots = {split_side(name): slot for slot, name in enumerate(model.marker_names)}
    chest = next((slots[(n, "")] for n in ("chest", "spine_chest") if (n, "") in slots), None)
    corners = [
        slots.get((part, side)) for part in ("shoulder", "hip") for side in ("left", "right")
    ]
    if chest is None or None in corners:
        return None
    return chest, [slot for slot in corners if slot is not None]
