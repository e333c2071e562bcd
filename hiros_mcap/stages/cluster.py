"""Lee's merger: one skeleton per person and instant (Lee et al. 2022, section 2.2).

Cameras that take a joint's left for its right are re-arranged; then each joint's candidates are
clustered by density together with two helpers, the mean of the trusted candidates and the previous
position, and the largest cluster is averaged. The paper follows a single person; here every person
of the tracker is merged so.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Literal

import numpy as np
from pydantic import Field

from hiros_mcap.body.symmetry import split_side, symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.params import Params
from hiros_mcap.skeletons import UNTRACKED, Flags, Floats, Frame, Ints, SkeletonModel, Stamps
from hiros_mcap.stages.bank import ArrayBank
from hiros_mcap.stages.instants import Instant, Views, instants

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

_SWAPS = {"off": 0.0, "right": 1.0, "both": 2.0}


class ClusterParams(Params):
    """Parameters of Lee's merger."""

    joints: Literal["all", "lee16"] = Field(
        "all", description="All joints of the log, or the 16 that the paper merges (2.2.1)."
    )
    rearrange: Literal["off", "right", "both"] = Field(
        "right",
        description="Swap a camera's left and right joints back if its right one is farther from "
        "the right reference position than its left one (2.2.1), or if the distances of both sides "
        "together say so, which is slightly safer (benchmarks/papers/lee_2022.py).",
    )
    medium_confidence: float = Field(
        0.5,
        description="Least confidence of level medium. Detectors of four levels (Azure Kinect) "
        "give 0, 0.33, 0.66 and 1; a confidence that is not given is medium.",
    )
    low_confidence: float = Field(
        0.17,
        description="Least confidence of level low; below is level none, which never makes a "
        "reference position.",
    )
    method: Literal["dbscan", "average"] = Field(
        "dbscan", description="Average the largest cluster, or all candidates (A1, A2)."
    )
    radius: float = Field(
        0.1, gt=0, description="m: searching area of DBSCAN. The paper's best of 5, 10, 15, 20 cm."
    )
    min_neighbours: int = Field(
        1,
        ge=1,
        description="N_c of algorithm 1, a point itself counted. With 1 (paper) nothing is noise.",
    )
    reference_helps: bool = Field(
        True, description="The reference position joins the candidates (2.2.2)."
    )
    previous_helps: bool = Field(
        True, description="The previous position joins the candidates: 1-frame smoothing (2.2.2)."
    )
    memory: float = Field(
        0.1,
        gt=0,
        description="s after which a position is no longer the previous one; three frames at 30 "
        "Hz. A joint has moved farther than the radius by then.",
    )
    compensate_motion: bool = Field(
        True,
        description="Carry views to the merged time by their velocities. The paper's cameras are "
        "synchronised by wire; a log's seldom are.",
    )
    cameras: int = Field(
        0, ge=0, description="Messages that make an instant; 0 = as many as cameras are known."
    )
    max_delta_time: float = Field(
        0.07, gt=0, description="s between the oldest and the newest message of an instant."
    )


def cluster(
    frames: Iterable[Frame],
    model: SkeletonModel,
    params: ClusterParams = ClusterParams(),  # noqa: B008 - immutable
    events: Events | None = None,
    fixed_frame: str = "",
) -> Iterator[Frame]:
    """Fuse the tracked skeletons of all cameras (Lee, 2.2.1 and 2.2.2).

    Parameters
    ----------
    frames : tracked frames in the fixed frame, roughly in time order. Untracked people are left
        out.
    model : the skeleton; the names of its markers tell left from right.
    params : see :class:`ClusterParams`.
    events : counts "outlier" (candidates outside of the largest cluster) and "swap" (pairs
        re-arranged), by camera.
    fixed_frame : name written as the source of merged skeletons; empty = that of the frames.

    Yields
    ------
    One frame per instant, at the mean time of its messages, people sorted by id.
    """
    events = Events() if events is None else events
    merger = _Clusterer(model, params, events, fixed_frame)
    for instant in instants(frames, params.cameras, params.max_delta_time, events):
        yield merger.fuse(instant)


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


class _Past(ArrayBank):
    """Where each person was last."""

    ARRAYS = ("seen", "positions")

    def __init__(self, n_markers: int, memory: float) -> None:
        super().__init__()
        self.memory = memory * 1e9
        self.row_of: dict[int, int] = {}
        self.seen: Stamps = np.zeros(0, np.int64)
        self.positions: Floats = np.zeros((0, n_markers, 3))

    def rows(self, people: list[int], stamp: int) -> Stamps:
        """Rows of some people; those of new ones hold no position."""
        if not self.row_of.keys() >= set(people):
            self._forget(stamp)
            for person in people:
                if person not in self.row_of:
                    row = self.row_of[person] = self.take()
                    self.seen[row], self.positions[row] = stamp, np.nan
        return np.array([self.row_of[person] for person in people], np.int64)

    def _forget(self, stamp: int) -> None:
        """Free the rows of people whose position is too old to be the previous one."""
        for person in [p for p, row in self.row_of.items() if stamp - self.seen[row] > self.memory]:
            self.give_back(self.row_of.pop(person))


class _Clusterer:
    """Merges one instant at a time; remembers each person's last merged pose."""

    def __init__(
        self, model: SkeletonModel, params: ClusterParams, events: Events, fixed_frame: str
    ) -> None:
        from hiros_mcap.kernels import clustering  # compiled only where it is used

        self.kernels = clustering
        self.model = model
        self.params = params
        self.events = events
        self.fixed_frame = fixed_frame
        self.pairs = pairs_of(model)
        self.ends = np.ascontiguousarray(model.links)
        every = np.ones(model.n_markers, np.bool_)
        self.used = lee_joints(model) if params.joints == "lee16" else every
        self.past = _Past(model.n_markers, params.memory)
        self.views = Views(model)
        self.numbers = np.array([
            params.medium_confidence, params.low_confidence, _SWAPS[params.rearrange],
            params.radius if params.method == "dbscan" else 0.0, params.min_neighbours,
            params.reference_helps, params.compensate_motion,
            params.memory * 1e9 if params.previous_helps else -1.0,
        ], np.float64)  # fmt: skip

    def fuse(self, instant: Instant[Frame]) -> Frame:
        """Merge the views of an instant into one frame at its time."""
        frames = instant.messages
        people = sorted({i for frame in frames for i in frame.ids.tolist()} - {UNTRACKED})
        fixed = self.fixed_frame or frames[0].frame_id
        out = Frame.empty(
            len(people), self.model, stamp=instant.stamp, log_time=instant.log_time, source=fixed,
            frame_id=fixed,
        )  # fmt: skip
        if people:
            out.ids[:] = people
            self._merge(out, self.past.rows(people, out.stamp), frames)
        return out

    def _merge(self, out: Frame, rows: Stamps, frames: Sequence[Frame]) -> None:
        """Fill in ``out``; ``rows`` (P,) are the rows of its people in the past."""
        past = self.past
        views = self.views.load(
            out, frames, range(len(frames)), carry=self.params.compensate_motion
        )
        counts = np.zeros((2, len(frames)), np.int64)
        self.kernels.merge_views(
            out.stamp, *views, rows, past.seen, past.positions, self.pairs, self.ends, self.used,
            self.numbers, out.stamps, out.confidences, out.markers, out.marker_confidences,
            out.links, out.link_confidences, counts,
        )  # fmt: skip
        for kind, numbers in zip(("outlier", "swap"), counts.tolist(), strict=True):
            for frame, number in zip(frames, numbers, strict=True):
                self.events.count(kind, frame.source, number)
