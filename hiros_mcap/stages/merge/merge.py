"""Skeleton merger: one skeleton per person and instant (Hi-ROS 2023, section 3.2).

1. A buffer collects one message per camera; it is full when a camera comes again, when it spans
   too long a time, or when all cameras are there (:class:`.instants.Instants`).
2. The views of a person are carried to the mean time of the messages.
3. Views that face another way than the largest group are flipped (eq 10), and dropped, unless
   stages.sides has brought all to their right sides before.
4. Markers and links that are not in the largest group of views are outliers.
5. The rest is averaged, weighted by confidence (eq 12): the marker's or link's own, that of the
   skeleton where the detector gives no other, 1 where it gives none.

The kernel ``_merge_person`` of merging.py shows steps 3 to 5. Beyond the paper:
views are carried by their velocities, since cameras are not synchronised; the previous merged pose
votes; slow offsets of the cameras are taken off; the mean is robust; a person between two sightings
is bridged.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.kernels.array_types import settings_of
from hiros_mcap.kernels.averaging import Buffers, Views
from hiros_mcap.skeletons import Floats, People, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.detections.visibility import HONEST
from hiros_mcap.stages.merge import merging
from hiros_mcap.stages.merge.instants import InstantMerger
from hiros_mcap.stages.merge.merge_params import MergeParams
from hiros_mcap.stages.merge.unseen import Unseen


def merge_blocks(
    blocks: Iterable[Block], model: SkeletonModel, params: MergeParams | None = None,
    events: Events | None = None, fixed_frame: str = "",
    cameras: Mapping[str, Floats] | None = None,
) -> Iterator[Block]:  # fmt: skip
    """Merge the tracked skeletons of all cameras (section 3.2).

    Parameters
    ----------
    blocks : tracked frames in the fixed frame, roughly in time order. Untracked people are left
        out.
    model : names and hierarchy of the skeleton.
    params : see :class:`MergeParams`.
    events : counts "outlier" (markers and links that lost the vote) and "flip" (views), by camera,
        "bridged" and "carried" (people).
    fixed_frame : name written as the source of merged skeletons; empty = that of the frames.
    cameras : source -> (3,) position of the camera in the fixed frame, m. Without it nobody is
        carried beyond ``bridge``.

    Yields
    ------
    One frame per buffer, at the mean time of its messages, people sorted by id. Times never
    decrease: a frame older than the last merged one is counted and left out.
    """
    params = params or MergeParams()
    kernel = ViewMerger(model, params)
    merger = InstantMerger(
        model, kernel, kernel.bank, events or Events(), fixed_frame, ("outlier", "flip"),
        Unseen(params.bridge, params.carry, cameras or {}),
    )  # fmt: skip
    yield from merger.run(blocks, params.cameras, params.max_delta_time, in_step=params.in_step)


class ViewMerger:
    """The compiled merger, with its settings, scratch and what it remembers of people."""

    def __init__(self, model: SkeletonModel, params: MergeParams) -> None:
        self._slots = model.n_markers, model.n_links
        self._settings = settings_of(
            merging.MergerSettings, params, pelvis_link=_pelvis_link(model)
        )
        self.bank = Bank(merging.MergerPast.empty(*self._slots))
        self._make_room(0)

    def _make_room(self, views: int) -> None:
        self._views = Views.allocate(views, *self._slots)
        self._work = merging.MergerWork.of(views, *self._slots)

    def __call__(
        self, buffers: Buffers, people: People, views: int, out: People, counts: Stamps
    ) -> None:
        """Merge; see :data:`hiros_mcap.stages.merge.instants.MergeKernel`."""
        people = weighted_by_sight(people, buffers.doubts)
        if views > len(self._views.stamps):
            self._make_room(2 * views)
        offsets = self.bank.past.camera_offsets
        while counts.shape[1] > offsets.shape[1]:
            offsets = np.concatenate([offsets, np.zeros_like(offsets)], axis=1)
        self.bank.past = self.bank.past._replace(camera_offsets=offsets)
        merging.merge_buffers(
            buffers, people, self._views, self.bank.past, self._settings, out, counts, self._work
        )


def weighted_by_sight(people: People, hidden: Floats) -> People:
    """Lower the confidences of markers that their cameras cannot see, by variances (P, M), m2.

    A view counts by the inverse of its variance; eq 12 weighs by the confidence.
    """
    if not hidden.any():
        return people
    whole = np.where(np.isnan(people.confidences), 1.0, people.confidences)[:, None]
    confidences = people.marker_confidences
    weighted = np.where(np.isnan(confidences), whole, confidences) * (
        HONEST**2 / (HONEST**2 + hidden)
    )
    lowered: Floats = np.where(hidden > 0.0, weighted, confidences)
    return people._replace(marker_confidences=lowered)


def _pelvis_link(model: SkeletonModel) -> int:
    """Slot of the first link of the root, which orients the pelvis; -1 if there is none."""
    children = set(model.link_children)
    for link, parent in enumerate(model.link_parents):
        if parent >= 0 and parent not in children:
            return link
    return -1
