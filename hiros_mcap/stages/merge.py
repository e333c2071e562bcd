"""Skeleton merger: one skeleton per person and instant (Hi-ROS 2023, section 3.2).

A buffer collects one message per camera; when it is full, its views of a person are carried to
the mean time, turned-round views and outliers are voted out, and the rest is averaged (eq 12).
Beyond the paper: views are carried by their velocities, since cameras are not synchronised; the
previous merged pose has a vote; a view with its sides swapped is swapped back instead of being
thrown away; what is left is averaged robustly; a person between two sightings is bridged.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from pydantic import Field

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, Part, frames_of, join, most_often
from hiros_mcap.kernels import merging as kernels
from hiros_mcap.params import Params
from hiros_mcap.skeletons import (
    POSITION,
    UNTRACKED,
    VELOCITY,
    Floats,
    Frame,
    People,
    SkeletonModel,
    Stamps,
)
from hiros_mcap.stages.bank import ArrayBank
from hiros_mcap.stages.instants import Instant, Instants, Views


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
    ties: Literal["nearest", "drop"] = Field(
        "nearest",
        description="Where two groups of views are equally large: nearest = the one nearest to the "
        "past wins, then the more confident one; drop = what they do not agree on is left out: a "
        "marker, a link, or of views that face opposite ways the whole person (published code).",
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


class _Bank(ArrayBank):
    """Where each person was last merged, and the cameras' offsets."""

    ARRAYS = (
        "seen", "facing_seen", "facing_since", "positions", "velocities", "turns", "bias",
    )  # fmt: skip

    def __init__(self, model: SkeletonModel) -> None:
        super().__init__()
        self.rows: dict[int, int] = {}
        self.cameras: dict[str, int] = {}
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
            row = self.rows[person] = self.take()
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

    def forget(self, person: int) -> None:
        """Free the row of a person, if there is one."""
        if person in self.rows:
            self.give_back(self.rows.pop(person))


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
    return frames_of(merge_blocks(map(Block.of, frames), model, params, events, fixed_frame))


def merge_blocks(
    blocks: Iterable[Block],
    model: SkeletonModel,
    params: MergeParams | None = None,
    events: Events | None = None,
    fixed_frame: str = "",
) -> Iterator[Block]:
    """Do what :func:`merge` does, a block at a time."""
    params = params or MergeParams()
    events = events or Events()
    merger = _Merger(model, params, events, fixed_frame)
    gathered: Instants[Part] = Instants(params.cameras, params.max_delta_time, events)
    for block in blocks:
        ready: list[Instant[Part]] = []
        for message in block.messages():
            ready += gathered.add(*message)
        yield from merger.fuse(ready)
    yield from merger.fuse(gathered.rest())


@dataclass(slots=True)
class _Last:
    """Where a person was last merged from views."""

    stamp: int
    row: int
    people: People = field(init=False)
    """Of which it is a row."""


class _Plan:
    """What is to be merged, and into which rows of the output."""

    def __init__(self) -> None:
        self.instants: list[Instant[Part]] = []
        self.blocks: list[tuple[Block, int]] = []
        """Where the messages are, and the first instant whose they are."""
        self.parts: list[tuple[int, int, int, int]] = []
        """Of each message: first row of its people, the one after the last, time, camera."""
        self.ends: list[tuple[int, int]] = [(0, 0)]
        """Output row and message before which each instant ends, and the next begins."""
        self.people: list[int] = []
        self.bank_rows: list[int] = []
        """Of each output row: the person, and the person's row in the bank."""
        self.made: list[_Last] = []
        self.carried: list[tuple[int, int, _Last]] = []
        """(output row, time, last sighting) of people whom no message shows."""
        self.views = self.members = 0
        """Most views of an instant, and of a person in an instant."""

    def begin(self, block: Block, instant: int) -> None:
        """Go on with the messages of another block."""
        self.blocks.append((block, instant))
        self.ids, self.rows = block.people.ids.tolist(), block.rows.tolist()
        self.times = block.stamps.tolist()


class _Merger:
    """Merges some instants at a time; remembers each person's last merged pose."""

    _HORIZON = 0.2  # s for which a past pose is carried on and may vote
    _FORGET = 10_000_000_000  # ns after which a person who is not merged any more is forgotten
    # ns of instants that are merged at once. Whoever is forgotten meanwhile is seen in none of
    # them, so that the row can be another's at once: the kernel only touches who is seen.
    _SPAN = 5_000_000_000

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
        self.slots = model.n_markers, model.n_links
        self.work = kernels.Work.of(0, 0, *self.slots)
        self.last: dict[int, _Last] = {}
        pelvis = -1 if params.facing == "sides" else _pelvis_link(model, params.pelvis_link)
        self.numbers = np.array([
            self._HORIZON, params.max_position_delta, params.max_orientation_delta,
            params.max_facing_delta, params.confidence_power, params.robust_scale, pelvis,
            params.facing != "pelvis", params.past_votes,
            params.flips == "relabel" and self.symmetry.known, params.flip_patience,
            params.compensate_motion, params.bias_time, params.ties == "drop",
        ], np.float64)  # fmt: skip

    def fuse(self, instants: Iterable[Instant[Part]]) -> Iterator[Block]:
        """Merge the messages of each instant into one frame at its time."""
        plan = _Plan()
        for instant in instants:
            if plan.instants and instant.stamp - plan.instants[0].stamp > self._SPAN:
                yield self._carry_out(plan)
                plan = _Plan()
            self._plan(plan, instant)
        if plan.instants:
            yield self._carry_out(plan)

    def _plan(self, plan: _Plan, instant: Instant[Part]) -> None:
        """Add an instant."""
        bank = self.bank
        block, places = instant.messages[0][0], [i for _, i in instant.messages]
        if any(other is not block for other, _ in instant.messages):
            block, places = join(instant.messages), list(range(len(places)))
        if not plan.blocks or block is not plan.blocks[-1][0]:
            plan.begin(block, len(plan.instants))
        seen: set[int] = set()
        views = members = 0
        for i in places:
            begin, end = plan.rows[i]
            people = plan.ids[begin:end]
            seen.update(people)
            views += end - begin
            members += most_often([person for person in people if person != UNTRACKED])
            plan.parts.append((begin, end, plan.times[i], bank.camera(block.sources[i])))
        seen.discard(UNTRACKED)
        plan.views, plan.members = max(plan.views, views), max(plan.members, members)
        for person in sorted(seen | self._bridged(seen, instant.stamp)):
            row = len(plan.people)
            plan.people.append(person)
            plan.bank_rows.append(bank.row(person))
            if person in seen:
                self.last[person] = _Last(instant.stamp, row)
                plan.made.append(self.last[person])
            else:
                plan.carried.append((row, instant.stamp, self.last[person]))
        plan.instants.append(instant)
        plan.ends.append((len(plan.people), len(plan.parts)))

    def _bridged(self, seen: set[int], stamp: int) -> set[int]:
        """People whom no message of the buffer shows but one of the last few did."""
        for person in [p for p, last in self.last.items() if stamp - last.stamp > self._FORGET]:
            del self.last[person]
            self.bank.forget(person)
        limit = self.params.bridge * 1e9
        last = self.last.items()
        return {p for p, was in last if p not in seen and 0 <= stamp - was.stamp <= limit}

    def _carry_out(self, plan: _Plan) -> Block:
        """Merge as planned."""
        bank = self.bank
        stamps = np.array([instant.stamp for instant in plan.instants], np.int64)
        log_times = np.array([instant.log_time for instant in plan.instants], np.int64)
        ends, parts = np.array(plan.ends, np.int64), np.array(plan.parts, np.int64)
        rows = np.stack([ends[:-1, 0], ends[1:, 0]], axis=1)
        bank_rows, room = np.array(plan.bank_rows, np.int64), self.views.room(plan.views)
        work = self._work(plan)
        out = People.allocate(len(plan.people), self.model.n_markers, self.model.n_links)
        out.ids[:] = plan.people
        out.confidences.fill(np.nan)
        out.boxes.fill(np.nan)
        out.stamps[:] = np.repeat(stamps, rows[:, 1] - rows[:, 0])
        counts = np.zeros((2, bank.bias.shape[1]), np.int64)
        starts = [start for _, start in plan.blocks]
        for (block, a), b in zip(plan.blocks, [*starts[1:], len(stamps)], strict=True):
            people = block.people
            kernels.fuse(
                stamps[a:b], ends[a : b + 1], parts, people.ids, people.confidences,
                people.markers, people.marker_confidences, people.links, people.link_confidences,
                *room, bank_rows, bank.seen, bank.facing_seen, bank.facing_since, bank.positions,
                bank.velocities, bank.turns, bank.bias, self.symmetry.mirror,
                self.symmetry.lateral, self.numbers, out.ids, out.stamps, out.confidences,
                out.markers, out.marker_confidences, out.links, out.link_confidences, counts, work,
            )  # fmt: skip
        for last in plan.made:
            last.people = out
        for row, stamp, last in plan.carried:
            self._carry(out, row, stamp, last)
        for kind, numbers in zip(("outlier", "flip"), counts.tolist(), strict=True):
            for source, n in zip(bank.cameras, numbers, strict=False):
                self.events.count(kind, source, n)
        firsts = [instant.messages[0] for instant in plan.instants]
        names = [self.fixed_frame or block.frame_ids[i] for block, i in firsts]
        merged = Block(stamps, log_times, names, names, rows, out)
        return _without_nobody(merged) if self.params.ties == "drop" else merged

    def _work(self, plan: _Plan) -> kernels.Work:
        """Room for what is between input and output, of this plan and of larger ones."""
        views, members = len(self.work.verdicts), len(self.work.members)
        if views < plan.views or members < plan.members:
            needed = max(views, 2 * plan.views), max(members, 2 * plan.members)
            self.work = kernels.Work.of(*needed, *self.slots)
        return self.work

    def _carry(self, out: People, row: int, stamp: int, last: _Last) -> None:
        """Write a person who was seen a moment ago, carried on at constant velocity."""
        dt = min((stamp - last.stamp) * 1e-9, self._HORIZON)
        for name in ("confidences", "markers", "marker_confidences", "links", "link_confidences"):
            getattr(out, name)[row] = getattr(last.people, name)[last.row]
        velocities = last.people.markers[last.row, :, VELOCITY]
        out.markers[row, :, POSITION] += dt * np.nan_to_num(velocities)
        self.events.count("bridged")


def _without_nobody(block: Block) -> Block:
    """Leave out people of whom nothing is left."""
    there = ~np.isnan(block.people.markers[:, :, 0]).all(axis=1)
    places = np.concatenate([[0], np.cumsum(there)])
    return replace(block, rows=places[block.rows], people=block.people.at(there))


def _pelvis_link(model: SkeletonModel, name: str) -> int:
    """Slot of the link that orients the pelvis, -1 if there is none."""
    if name:
        return model.link_names.index(name) if name in model.link_names else -1
    children = set(model.link_children)
    for link, parent in enumerate(model.link_parents):
        if parent >= 0 and parent not in children:
            return link
    return -1
