"""Lee's merger: one skeleton per person and instant (Lee et al. 2022, section 2.2).

1. A camera that takes a joint's left for its right is re-arranged by the reference positions, the
   means of the confident candidates (2.2.1).
2. The candidates of each joint, its reference and its previous position are clustered by DBSCAN
   (2.2.2, algorithms 1 and 2).
3. The candidates of the largest cluster are averaged.

The kernel ``_merge_person`` of clustering.py shows these steps. The paper follows
a single person; here the tracker's people are merged one by one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from hiros_mcap.body.symmetry import split_side, symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.kernels.array_types import settings_of
from hiros_mcap.kernels.averaging import Buffers, Views
from hiros_mcap.skeletons import Flags, Ints, People, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.lee import clustering
from hiros_mcap.stages.lee.lee_params import ClusterParams
from hiros_mcap.stages.merge.instants import InstantMerger

LEE_JOINTS = (
    "PELVIS", "SPINE_NAVEL", "NECK", "HEAD",
    "SHOULDER_LEFT", "ELBOW_LEFT", "WRIST_LEFT", "HIP_LEFT", "KNEE_LEFT", "ANKLE_LEFT",
    "SHOULDER_RIGHT", "ELBOW_RIGHT", "WRIST_RIGHT", "HIP_RIGHT", "KNEE_RIGHT", "ANKLE_RIGHT",
)  # fmt: skip
"""The 16 of the Azure Kinect's 32 joints that the paper merges (tables A1 to A6)."""

_ALIASES = {"spine_naval": "spine_navel", "spinebase": "pelvis", "spinemid": "spine_navel"}
"""Other names of these joints: the Azure Kinect's own spelling, the Kinect v2's."""
_TOO_NEAR = ("eye", "ear", "mouth", "clavicle", "collar")
"""Pairs so near to each other that a camera's error could pass for a swap."""

_MEDIUM, _LOW = 0.5, 0.17
"""Least confidences of these levels; below low, a joint never gives a reference position. Detectors
with four levels (Azure Kinect) give 0, 0.33, 0.66 and 1. A missing confidence is medium."""


def cluster_blocks(
    blocks: Iterable[Block], model: SkeletonModel, params: ClusterParams | None = None,
    events: Events | None = None, fixed_frame: str = "",
) -> Iterator[Block]:  # fmt: skip
    """Merge the tracked skeletons of all cameras (Lee, 2.2.1 and 2.2.2).

    Parameters
    ----------
    blocks : tracked frames in the fixed frame, roughly in time order. Untracked people are left
        out.
    model : the skeleton; the names of its markers tell left from right.
    params : see :class:`ClusterParams`.
    events : counts "outlier" (candidates outside the largest cluster) and "swap" (pairs
        re-arranged), by camera.
    fixed_frame : name written as the source of merged skeletons; empty = that of the frames.

    Yields
    ------
    One frame per instant, at the mean time of its messages, people sorted by id.
    """
    params = params or ClusterParams()
    kernel = _ClusterKernel(model, params)
    merger = InstantMerger(
        model, kernel, kernel.bank, events or Events(), fixed_frame, ("outlier", "swap")
    )
    return merger.run(blocks, params.cameras, params.max_delta_time)


def lee_joints(model: SkeletonModel) -> Flags:
    """(M,) which markers are among the paper's 16 joints."""
    wanted = {split_side(name) for name in LEE_JOINTS}
    names = [split_side(name) for name in model.marker_names]
    return np.array([(_ALIASES.get(bare, bare), side) in wanted for bare, side in names], np.bool_)


def pairs_of(model: SkeletonModel) -> Ints:
    """(K, 2) left and right slots of the joints that may be swapped."""
    mirror = symmetry_of(model).mirror
    rows = []
    for slot, name in enumerate(model.marker_names):
        bare, side = split_side(name)
        if side == "left" and mirror[slot] != slot and not bare.startswith(_TOO_NEAR):
            rows.append((slot, int(mirror[slot])))
    return np.array(rows, np.int32).reshape(-1, 2)


class _ClusterKernel:
    """The compiled merger, with its settings, scratch and what it remembers of people."""

    def __init__(self, model: SkeletonModel, params: ClusterParams) -> None:
        self._slots = model.n_markers, model.n_links
        every = np.ones(model.n_markers, np.bool_)
        used = lee_joints(model) if params.joints == "lee16" else every
        self._settings = settings_of(
            clustering.ClusterSettings, params, medium_confidence=_MEDIUM, low_confidence=_LOW,
            radius=params.radius if params.method == "dbscan" else 0.0,
            memory=round(params.memory * 1e9) if params.previous_helps else -1,
            rearrange=params.rearrange != "off", both_sides=params.rearrange == "both",
            pairs=pairs_of(model), links=np.ascontiguousarray(model.links), used=used,
        )  # fmt: skip
        nobody = clustering.ClusterPast(np.zeros(0, np.int64), np.zeros((0, model.n_markers, 3)))
        self.bank = Bank(nobody)
        self._make_room(0)

    def _make_room(self, views: int) -> None:
        self._views = Views.allocate(views, *self._slots)
        self._work = clustering.ClusterWork.of(views, self._slots[0])

    def __call__(
        self, buffers: Buffers, people: People, views: int, out: People, counts: Stamps
    ) -> None:
        """Merge; see :data:`hiros_mcap.stages.merge.instants.MergeKernel`."""
        if views > len(self._views.stamps):
            self._make_room(2 * views)
        clustering.cluster_buffers(
            buffers, people, self._views, self.bank.past, self._settings, out, counts, self._work,
        )  # fmt: skip
