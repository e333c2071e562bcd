"""The truth: people's real motion as arrays over time, on the markers of a result."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid, multiply, to_vector
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.errors import ConfigError
from hiros_mcap.skeletons import SECOND, Flags, Floats, Frame, SkeletonModel, Stamps

MAX_GAP_NS = 500_000_000
"""The truth is not interpolated over a longer pause."""
EPOCH_2001 = SECOND * SECOND  # ns; earlier times are no dates
_Y_TO_Z = np.array([0.5**0.5, 0.0, 0.0, 0.5**0.5])


class Alignment(NamedTuple):
    """Pose and shift that :func:`hiros_mcap.evaluate.alignment.align` gives a truth."""

    pose: Rigid  # of the truth's frame in that of the result
    seconds: float = 0.0  # added to the times of the truth

    @property
    def degrees(self) -> float:
        """Angle of the rotation."""
        return float(np.degrees(np.linalg.norm(to_vector(self.pose.xyzw))))

    @property
    def text(self) -> str:
        """Describe the alignment in words."""
        quaternion = ", ".join(f"{x:.4f}" for x in self.pose.xyzw)
        moved = ", ".join(f"{x:.3f}" for x in self.pose.translation)
        parts = [
            f"turned by {self.degrees:.1f} degrees (xyzw {quaternion})",
            f"moved by ({moved}) m",
        ]
        if self.seconds:
            parts.append(f"shifted by {self.seconds:.3f} s")
        return (
            f"the truth was {', '.join(parts)}, so that it fits the result best: what is constant "
            "in the error does not show"
        )


@dataclass(slots=True)
class Truth:
    """True skeletons as arrays over time: T instants, N people."""

    stamps: Stamps  # (T,) ns, increasing
    positions: Floats  # (T, N, M, 3) m, NaN where a person or a marker is absent
    orientations: Floats  # (T, N, L, 4) orientations of the links, x y z w
    people: tuple[int, ...] = ()  # id of each of the N people
    model: SkeletonModel | None = None  # of the true skeletons; None = that of the result
    partial: bool = False
    """Whether there were people besides these, of whom the truth knows nothing."""
    alignment: Alignment | None = None
    """How it was aligned with the result; None if it is as in the file."""
    from_begin: bool = False
    """Whether its times may count from the log's start, as those of motion capture files do."""
    notes: tuple[str, ...] = ()  # guesses that were made while it was read

    @classmethod
    def of(cls, frames: Iterable[Frame], model: SkeletonModel | None = None) -> Truth:
        """Collect frames whose ids are the true people; sorted by time.

        Raises ValueError if there are no frames.
        """
        ordered = sorted(frames, key=lambda frame: frame.stamp)
        if not ordered:
            raise ValueError("no true skeletons")
        people = tuple(sorted({int(i) for frame in ordered for i in frame.ids}))
        row = {person: n for n, person in enumerate(people)}
        shape = (len(ordered), len(people))
        positions = np.full((*shape, *ordered[0].markers.shape[1:2], 3), np.nan)
        orientations = np.full((*shape, *ordered[0].links.shape[1:2], 4), np.nan)
        for t, frame in enumerate(ordered):
            for p, person in enumerate(frame.ids):
                positions[t, row[int(person)]] = frame.positions[p]
                orientations[t, row[int(person)]] = frame.orientations[p]
        stamps = np.array([frame.stamp for frame in ordered], np.int64)
        return cls(stamps, positions, orientations, people, model)

    def covers(self, stamps: Stamps | int) -> Flags:
        """(...) Whether the truth knows who was there: at an instant, or within no pause."""
        _, _, _, is_instant, is_between = self._neighbours(stamps, 0)
        return np.asarray(is_instant | is_between)

    def at(self, stamps: Stamps | int) -> tuple[Floats, Floats]:
        """(..., N, M, 3) positions and (..., N, L, 4) orientations at stamps (...).

        Linear between the neighbours. NaN beyond the first and the last instant, and within a pause
        of more than half a second.
        """
        early, late, *place = self._neighbours(stamps, 3)
        positions = _mixed(self.positions[early], self.positions[late], *place)
        first, second = self.orientations[early], self.orientations[late]
        sign = np.where(np.sum(first * second, axis=-1, keepdims=True) < 0, -1.0, 1.0)
        orientations = _mixed(first, sign * second, *place)
        norm = np.linalg.norm(orientations, axis=-1, keepdims=True)
        orientations /= np.where(norm > 0, norm, np.nan)
        return positions, np.where(place[1], second, orientations)

    def positions_of(self, rows: Stamps, stamps: Stamps) -> Floats:
        """(R, M, 3) positions of one person each, by rows and stamps (R,), as :meth:`at`."""
        early, late, *place = self._neighbours(stamps, 2)
        return _mixed(self.positions[early, rows], self.positions[late, rows], *place)

    def _neighbours(self, stamps: Stamps | int, axes: int) -> tuple[Any, ...]:
        """Rows before and after stamps; which part of the way, if at one, if between both.

        The last three have so many axes more.
        """
        after = np.searchsorted(self.stamps, stamps)
        late = np.minimum(after, len(self.stamps) - 1)
        early = np.maximum(late - 1, 0)
        gap = self.stamps[late] - self.stamps[early]
        place = (
            (stamps - self.stamps[early]) / np.maximum(gap, 1),
            self.stamps[late] == stamps,
            (after > 0) & (after == late) & (gap <= MAX_GAP_NS),
        )
        index = (..., *[None] * axes)
        part, is_instant, is_between = (np.asarray(values)[index] for values in place)
        return early, late, part, is_instant, is_between

    def moved(self, seconds: float = 0.0, *, start: int | None = None, up: str = "z") -> Truth:
        """Return the truth with other times or axes.

        Parameters
        ----------
        seconds : added to all times.
        start : ns; where the log starts. Times of a truth that may count ``from_begin`` do so if
            they lie before the year 2001. Others stay: simulated time begins at 0, too.
        up : the vertical axis of the truth, "z" or "y" (OpenSim); y becomes z.
        """
        stamps = self.stamps + round(seconds * 1e9)
        if start is not None and self.from_begin and self.stamps[-1] < EPOCH_2001:
            stamps = stamps + start
        positions, orientations = self.positions, self.orientations
        if up == "y":
            positions = np.stack(
                [positions[..., 0], -positions[..., 2], positions[..., 1]], axis=-1
            )
            orientations = multiply(_Y_TO_Z, orientations)
        return replace(self, stamps=stamps, positions=positions, orientations=orientations)

    def aligned(self, alignment: Alignment) -> Truth:
        """Return the truth turned and moved, and at other times."""
        pose, seconds = alignment
        return replace(
            self,
            stamps=self.stamps + round(seconds * 1e9),
            positions=pose.moved(self.positions),
            orientations=multiply(pose.xyzw, self.orientations),
            alignment=alignment,
        )

    def seen_by(self, model: SkeletonModel) -> Truth:
        """Return the truth on the markers and links of another model; NaN where it has none.

        A model without markers is that of a room where nobody was seen: it changes nothing.

        Raises ConfigError if no marker has the same name in both.
        """
        if self.model is None or self.model == model or not model.n_markers:
            return self
        slots = shared_markers(self.model, model)
        if not slots:
            raise ConfigError(
                "the truth and the result share no marker: "
                f"{_list(self.model.marker_names)} against {_list(model.marker_names)}"
            )
        links = shared_links(self.model, model, slots)
        positions = np.full((*self.positions.shape[:2], model.n_markers, 3), np.nan)
        orientations = np.full((*self.orientations.shape[:2], model.n_links, 4), np.nan)
        positions[:, :, list(slots.values())] = self.positions[:, :, list(slots)]
        orientations[:, :, list(links.values())] = self.orientations[:, :, list(links)]
        return replace(self, positions=positions, orientations=orientations, model=model)


def _mixed(
    early: Floats, late: Floats, part: Floats, is_instant: Flags, is_between: Flags
) -> Floats:
    """Values on the way between two instants, or at the later one; NaN elsewhere."""
    between = np.where(is_between, (1 - part) * early + part * late, np.nan)
    return np.where(is_instant, late, between)


def shared_markers(a: SkeletonModel, b: SkeletonModel) -> dict[int, int]:
    """Slot in ``a`` -> slot in ``b`` of markers that mean the same, as LShoulder, shoulder_left."""
    theirs = {_name(name): slot for slot, name in enumerate(b.marker_names)}
    pairs = {slot: theirs.get(_name(name)) for slot, name in enumerate(a.marker_names)}
    return {slot: link for slot, link in pairs.items() if link is not None}


def _name(name: str) -> tuple[str, str]:
    part, side = split_side(name)
    return "".join(c for c in part if c.isalnum()), side


def shared_links(a: SkeletonModel, b: SkeletonModel, slots: dict[int, int]) -> dict[int, int]:
    """Slot in ``a`` -> slot in ``b`` of links that join the same markers."""
    ends = {pair: k for k, pair in enumerate(zip(b.link_parents, b.link_children, strict=True))}
    pairs = zip(a.link_parents, a.link_children, strict=True)
    links = [ends.get((slots.get(parent, -2), slots.get(child, -2))) for parent, child in pairs]
    return {slot: link for slot, link in enumerate(links) if link is not None}


def _list(names: tuple[str, ...], most: int = 40) -> str:
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")
