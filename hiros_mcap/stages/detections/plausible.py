"""Detections that contradict a person's own body count less, before they are merged or fused.

A detector that sees a part of somebody guesses the rest: limbs get longer or shorter, feet float,
the pelvis jumps. Every person's limb lengths, and how much they usually vary, are learned on the
way (:mod:`hiros_mcap.stages.detections.limb_deviations`). Then

1. a view whose limbs contradict them while somebody else stands in front of the person is left
   out, if no other camera shows the person, and the detector is sure of every joint: it has no
   marker from here on, and the person is carried on (merge.carry).
2. a marker whose limbs contradict them loses confidence. The merger gives it less weight, and the
   fuser a larger variance.

Lengths do not depend on how fast somebody moves, nor on sides that a detector has exchanged.
Nothing is changed while too little is known of a person.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, CameraNumbers, places_of
from hiros_mcap.kernels.array_types import settings_of
from hiros_mcap.skeletons import Floats, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.detections import limb_deviations as kernels
from hiros_mcap.stages.detections.detection_params import PlausibleParams

DISTORTED, CONTRADICTORY = "distorted", "implausible marker"
"""Kinds of events: views that are left out, and markers that count less."""
_FORGET = 30.0  # s; longest absence after which somebody gets the old id back (track.reidentify)


def drop_implausible_blocks(
    blocks: Iterable[Block], model: SkeletonModel, params: PlausibleParams | None = None,
    events: Events | None = None, cameras: Mapping[str, Floats] | None = None,
) -> Iterator[Block]:  # fmt: skip
    """Lower the weight of detections that contradict the limb lengths of their person.

    Parameters
    ----------
    blocks : tracked frames in the fixed frame, in the order of time.
    model, params : the skeleton; see :class:`PlausibleParams`.
    events : counts "distorted" (views without markers from here on) and "implausible marker"
        (markers with less confidence), by camera.
    cameras : source -> (3,) position in the fixed frame, m. Without it no view is left out.

    Yields
    ------
    The same frames at once.
    """
    params = params or PlausibleParams()
    if not params.limbs:
        yield from blocks
        return
    bodies = _LimbHistories(model, params, Events() if events is None else events, cameras or {})
    yield from map(bodies.compare, blocks)


class _LimbHistories:
    """What is known of everybody's limbs."""

    def __init__(
        self, model: SkeletonModel, params: PlausibleParams, events: Events,
        places: Mapping[str, Floats],
    ) -> None:  # fmt: skip
        self._links = links_of(model)
        self._settings = settings_of(kernels.PlausibleSettings, params)
        self._events, self._places = events, places
        self._bank = Bank(kernels.LimbPast.empty(len(self._links.ends)), _FORGET)
        self._cameras = CameraNumbers()

    def compare(self, block: Block) -> Block:
        """Return a block with less confident markers, and without those of distorted views."""
        people, (rows, owners) = block.people, block.everybody()
        past_rows = np.full(len(people.ids), -1, np.int64)
        past_rows[rows] = self._bank.rows_of(people.ids[rows], block.stamps[owners])
        messages = kernels.ComparedMessages(
            block.stamps, self._cameras.of(block), block.rows, past_rows
        )
        work = kernels.PlausibleWork.of(*people.markers.shape[:2])
        places = places_of(self._cameras, self._places)
        seen = self._bank.past.seen
        if len(places) > seen.shape[1]:
            seen = np.pad(seen, ((0, 0), (0, len(places))))
            self._bank.past = self._bank.past._replace(seen=seen)
        counts = np.zeros((2, len(places)), np.int64)
        # What is not written is shared: the tracker may still write into others of the arrays.
        people = people._replace(marker_confidences=people.marker_confidences.copy())
        kernels.find_implausible(
            messages, people, places, self._links, self._bank.past, self._settings, counts, work
        )
        if not counts.any():
            return block
        for kind, by_camera in zip((DISTORTED, CONTRADICTORY), counts.tolist(), strict=True):
            for source, n in zip(self._cameras, by_camera, strict=True):
                self._events.count(kind, source, n)
        if work.left_out.any():
            people = people.copy()
            for array in people.markers, people.marker_confidences, people.links:
                array[work.left_out] = np.nan
            people.link_confidences[work.left_out] = np.nan
        return replace(block, people=people)


def links_of(model: SkeletonModel) -> kernels.LimbLinks:
    """Return the links of a skeleton that have two ends, and where their lengths are kept."""
    ends = model.links[(model.links >= 0).all(axis=1)]
    mirror = symmetry_of(model).mirror
    places = {tuple(pair): k for k, pair in enumerate(ends.tolist())}
    others = [places.get(tuple(pair), k) for k, pair in enumerate(mirror[ends].tolist())]
    slots: Stamps = np.minimum(np.arange(len(ends)), others).astype(np.int64)
    return kernels.LimbLinks(np.ascontiguousarray(ends), slots)
