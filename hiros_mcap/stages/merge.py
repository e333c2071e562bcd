"""Skeleton merger: one skeleton per person and instant (Hi-ROS 2023, section 3.2).

A buffer collects one message per camera; when it is full, its views of a person are carried to
the mean time, turned-round views and outliers are voted out, and the rest is averaged (eq 12).
Beyond the paper: views are carried by their velocities, since cameras are not synchronised; the
previous merged pose has a vote; a view with its sides swapped is swapped back instead of being
thrown away; what is left is averaged robustly; a person between two sightings is bridged.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Literal

import numpy as np
from pydantic import Field

from hiros_mcap.events import Events
from hiros_mcap.kernels import merging as kernels
from hiros_mcap.params import Params
from hiros_mcap.skeletons import (
    POSITION,
    UNTRACKED,
    VELOCITY,
    Floats,
    Frame,
    SkeletonModel,
    Stamps,
)
from hiros_mcap.stages.instants import Instant, Views, instants
from hiros_mcap.symmetry import symmetry_of


class MergeParams(Params):
    """Parameters of the merger."""

    cameras: int = Field(
        0, ge=0, description="Messages that fill the buffer (third trigger); 0 = as many as known."
    )
    max_delta_time: float = Field(
        0.07,
        gt=0,
        description="s between the oldest and the newest message of a buffer (second trigger, "
        "section 3.2). Two periods of a 30 Hz camera.",
    )
    max_position_delta: float = Field(
        0.2,
        description="m: views of a marker that differ by less agree (0.2: workable launch value "
        "of the published code); <= 0 turns the vote off.",
    )
    max_orientation_delta: float = Field(
        np.pi / 4, description="rad: the same for links; <= 0 turns the vote off."
    )
    max_facing_delta: float = Field(
        np.pi / 2,
        description="rad: views that face within this of each other agree (section 3.2); <= 0 "
        "turns the search for flips off.",
    )
    facing: Literal["auto", "pelvis", "sides"] = Field(
        "auto",
        description="Where the facing direction comes from: the pelvis orientation (paper), the "
        "line from left to right shoulders and hips, or whichever of both differs more.",
    )
    pelvis_link: str = Field(
        "", description="Link that orients the pelvis; empty = the first link of the root marker."
    )
    flips: Literal["relabel", "drop"] = Field(
        "relabel",
        description="A turned-round view is dropped (paper), or its left and right are swapped "
        "back if that brings it near the others.",
    )
    flip_patience: float = Field(
        4.0,
        ge=0,
        description="s after which the past no longer outvotes views that all face the other way; "
        "detectors' flips last up to 3 s. Sooner, after three times as long as the past was seen.",
    )
    past_votes: bool = Field(
        True,
        description="The previous merged pose votes like a camera and settles ties (published "
        "code; not in the paper).",
    )
    compensate_motion: bool = Field(
        True, description="Carry views to the merged time by their velocities."
    )
    confidence_power: float = Field(
        2.0,
        ge=0,
        description="Exponent of the confidences in eq 12 (paper: 1). A marker that the detector "
        "guesses (confidence halved) is about five times less accurate, so 1 is too polite.",
    )
    robust_scale: float = Field(
        0.05,
        description="m: views this far from the mean count half, farther ones less (Cauchy "
        "weights on top of eq 12); <= 0 = plain eq 12.",
    )
    bias_time: float = Field(
        5.0,
        ge=0,
        description="s: time constant of each camera's slow offset from the others per marker, "
        "which is taken off its views so that the mean does not jump when a camera drops out; 3 to "
        "30 s take 1 to 3 % off the error after the filter. 0 = off (paper).",
    )
    bridge: float = Field(
        0.12,
        ge=0,
        description="s for which a person that no message of the buffer shows is carried on at "
        "constant velocity: cameras that see only one person each would let the others flicker.",
    )


class _Bank:
    """What is remembered of each person, as arrays that the kernel takes; rows are reused."""

    _FORGET = 10_000_000_000  # ns after which a person who is not merged any more is forgotten

    def __init__(self, model: SkeletonModel) -> None:
        self.rows: dict[int, int] = {}
        self.cameras: dict[str, int] = {}
        self.free: list[int] = []
        m, n = model.n_markers, model.n_links
        self.seen: Stamps = np.zeros(0, np.int64)
        self.facing_seen: Stamps = np.zeros(0, np.int64)
        self.facing_since: Stamps = np.zeros(0, np.int64)
        self.positions: Floats = np.zeros((0, m, 3))
        self.velocities: Floats = np.zeros((0, m, 3))
        self.turns: Floats = np.zeros((0, n, 4))
        self.bias: Floats = np.zeros((0, 4, m, 3))

    def row(self, person: int) -> int:
        """Row of a person; a new one is empty."""
        if person not in self.rows:
            if not self.free:
                self._grow(max(8, 2 * len(self.seen)))
            row = self.rows[person] = self.free.pop()
            self.seen[row] = self.facing_seen[row] = self.facing_since[row] = 0
            self.bias[row] = 0.0
        return self.rows[person]

    def camera(self, source: str) -> int:
        """Index of a camera in ``bias``."""
        if source not in self.cameras:
            self.cameras[source] = len(self.cameras)
            if len(self.cameras) > self.bias.shape[1]:
                self.bias = np.concatenate([self.bias, np.zeros_like(self.bias)], axis=1)
        return self.cameras[source]

    def forget(self, stamp: int) -> None:
        """Free the rows of people who were last merged long before ``stamp``."""
        gone = [p for p, row in self.rows.items() if stamp - self.seen[row] > self._FORGET]
        self.free += [self.rows.pop(person) for person in gone]

    def _grow(self, size: int) -> None:
        old = len(self.seen)
        for name in (
            "seen", "facing_seen", "facing_since", "positions", "velocities", "turns", "bias",
        ):  # fmt: skip
            array = getattr(self, name)
            bigger = np.zeros((size, *array.shape[1:]), array.dtype)
            bigger[:old] = array
            setattr(self, name, bigger)
        self.free += range(size - 1, old - 1, -1)


def merge(
    frames: Iterable[Frame],
    model: SkeletonModel,
    params: MergeParams | None = None,
    events: Events | None = None,
    fixed_frame: str = "",
) -> Iterator[Frame]:
    """Fuse the tracked skeletons of all cameras (section 3.2).

    Parameters
    ----------
    frames : tracked frames in the fixed frame, roughly in time order. Untracked people are left
        out.
    model : names and hierarchy of the skeleton.
    params, events : parameters; where counts and events go.
    fixed_frame : name written as the source of merged skeletons; empty = that of the frames.

    Yields
    ------
    One frame per buffer, at the mean time of its messages, people sorted by id. Times never
    decrease: a frame that is older than what was merged before is counted and left out.
    """
    params = params or MergeParams()
    events = events or Events()
    merger = _Merger(model, params, events, fixed_frame)
    for instant in instants(frames, params.cameras, params.max_delta_time, events):
        yield merger.fuse(instant)


class _Merger:
    """Merges one buffer at a time; remembers each person's last merged pose."""

    _HORIZON = 0.2  # s for which a past pose is carried on and may vote

    def __init__(
        self, model: SkeletonModel, params: MergeParams, events: Events, fixed_frame: str
    ) -> None:
        self.model = model
        self.params = params
        self.events = events
        self.fixed_frame = fixed_frame
        self.symmetry = symmetry_of(model)
        self.bank = _Bank(model)
        self.views = Views(model)
        self.last: dict[int, tuple[Frame, int]] = {}
        pelvis = -1 if params.facing == "sides" else _pelvis_link(model, params.pelvis_link)
        self.numbers = np.array([
            self._HORIZON, params.max_position_delta, params.max_orientation_delta,
            params.max_facing_delta, params.confidence_power, params.robust_scale, pelvis,
            params.facing != "pelvis", params.past_votes,
            params.flips == "relabel" and self.symmetry.known, params.flip_patience,
            params.compensate_motion, params.bias_time,
        ], np.float64)  # fmt: skip

    def fuse(self, instant: Instant) -> Frame:
        """Merge the messages of an instant into one frame at its time."""
        frames, stamp, log_time = instant.frames, instant.stamp, instant.log_time
        seen = {i for frame in frames for i in frame.ids.tolist()} - {UNTRACKED}
        people = sorted(seen | self._bridged(seen, stamp))
        fixed = self.fixed_frame or frames[0].frame_id
        out = Frame.empty(
            len(people), self.model, stamp=stamp, log_time=log_time, source=fixed, frame_id=fixed
        )
        out.ids[:] = people
        if seen:
            self._merge(out, people, frames)
        for row, person in enumerate(people):
            if person in seen:
                self.last[person] = (out, row)
            else:
                self._carry(out, row, *self.last[person])
        return out

    def _bridged(self, seen: set[int], stamp: int) -> set[int]:
        """People whom no message of the buffer shows but one of the last few did."""
        self.bank.forget(stamp)
        limit = self.params.bridge * 1e9
        kept = {p: last for p, last in self.last.items() if p in self.bank.rows}
        self.last = kept
        return {p for p, (f, _) in kept.items() if p not in seen and 0 <= stamp - f.stamp <= limit}

    def _merge(self, out: Frame, people: list[int], frames: Sequence[Frame]) -> None:
        """Fill the rows of the people whom the buffer shows."""
        bank = self.bank
        rows = np.array([bank.row(person) for person in people], np.int64)
        cameras = [bank.camera(frame.source) for frame in frames]
        views = self.views.load(out, frames, cameras, carry=self.params.compensate_motion)
        counts = np.zeros((2, bank.bias.shape[1]), np.int64)
        kernels.fuse(
            out.stamp, *views, rows, bank.seen, bank.facing_seen, bank.facing_since,
            bank.positions, bank.velocities, bank.turns, bank.bias, self.symmetry.mirror,
            self.symmetry.lateral, self.numbers, out.stamps, out.confidences, out.markers,
            out.marker_confidences, out.links, out.link_confidences, counts,
        )  # fmt: skip
        for kind, numbers in zip(("outlier", "flip"), counts.tolist(), strict=True):
            for frame, camera in zip(frames, cameras, strict=True):
                if numbers[camera]:
                    self.events.count(kind, frame.source, numbers[camera])

    def _carry(self, out: Frame, row: int, last: Frame, last_row: int) -> None:
        """Write a person who was seen a moment ago, carried on at constant velocity."""
        dt = min((out.stamp - last.stamp) * 1e-9, self._HORIZON)
        for name in ("markers", "marker_confidences", "links", "link_confidences"):
            getattr(out, name)[row] = getattr(last, name)[last_row]
        out.markers[row, :, POSITION] += dt * np.nan_to_num(last.markers[last_row, :, VELOCITY])
        out.confidences[row] = last.confidences[last_row]
        self.events.count("bridged")


def _pelvis_link(model: SkeletonModel, name: str) -> int:
    """Slot of the link that orients the pelvis, -1 if there is none."""
    if name:
        return model.link_names.index(name) if name in model.link_names else -1
    children = set(model.link_children)
    for link, parent in enumerate(model.link_parents):
        if parent >= 0 and parent not in children:
            return link
    return -1
