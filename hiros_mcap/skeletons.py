"""The data that every stage takes and gives: one skeleton model per log, one Frame per message.

Numbers are kept as the messages define them: a marker and a link are each one KinematicState of
19 numbers. Whatever a detector fills in (a marker's orientation, a link's position) thereby goes
through the whole chain. NaN means absent, everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
Stamps = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

# Columns of a KinematicState: pose.position, pose.orientation (x y z w), velocity.linear,
# velocity.angular, acceleration.linear, acceleration.angular, in the order of the message.
POSITION = slice(0, 3)
ORIENTATION = slice(3, 7)
VELOCITY = slice(7, 10)
ANGULAR_VELOCITY = slice(10, 13)
ACCELERATION = slice(13, 16)
ANGULAR_ACCELERATION = slice(16, 19)
POSE = 7
"""Columns of position and orientation."""
STATE = 19
"""All columns."""
BOX = STATE + 3  # a Box is the KinematicState of its centre, then height, length, width

UNTRACKED = -1
SECOND = 1_000_000_000
"""ns."""


@dataclass(frozen=True, eq=True)
class SkeletonModel:
    """Names and hierarchy of the skeleton, constant over a log.

    Slot ``m`` of every marker array belongs to the marker whose id is ``marker_ids[m]``; slot
    ``l`` of every link array to ``link_ids[l]``. Ids are increasing. ``link_parents`` and
    ``link_children`` are *slots* of markers, -1 where the log names a marker that does not exist.
    ``max_markers`` and ``max_links`` are written back as the detectors gave them.
    """

    marker_ids: tuple[int, ...]
    marker_names: tuple[str, ...]
    link_ids: tuple[int, ...]
    link_names: tuple[str, ...]
    link_parents: tuple[int, ...]
    link_children: tuple[int, ...]
    max_markers: int
    max_links: int

    def __repr__(self) -> str:
        return f"<SkeletonModel {self.n_markers} markers, {self.n_links} links>"

    @property
    def n_markers(self) -> int:
        """Number of marker slots, M."""
        return len(self.marker_ids)

    @property
    def n_links(self) -> int:
        """Number of link slots, L."""
        return len(self.link_ids)

    @property
    def is_whole(self) -> bool:
        """Whether it has every marker and link that the detectors claim to know."""
        return 0 < self.max_markers <= self.n_markers and self.max_links <= self.n_links

    @cached_property
    def links(self) -> npt.NDArray[np.int32]:
        """(L, 2) parent and child marker slot of each link."""
        return np.array([self.link_parents, self.link_children], dtype=np.int32).T.reshape(-1, 2)

    @classmethod
    def of(
        cls,
        marker_names: Iterable[str],
        links: Iterable[tuple[str, int, int]],
    ) -> SkeletonModel:
        """Model with ids 0, 1, 2, ...; ``links`` are (name, parent slot, child slot)."""
        names = tuple(marker_names)
        rows = tuple(links)
        return cls(
            marker_ids=tuple(range(len(names))),
            marker_names=names,
            link_ids=tuple(range(len(rows))),
            link_names=tuple(name for name, _, _ in rows),
            link_parents=tuple(parent for _, parent, _ in rows),
            link_children=tuple(child for _, _, child in rows),
            max_markers=len(names),
            max_links=len(rows),
        )


class People(NamedTuple):
    """Arrays of P people, M markers, L links; C-contiguous. NaN means absent.

    Kernels take it as it is (``kernels.compile.PEOPLE``).
    """

    ids: Ints  # (P,) person, UNTRACKED (-1) where unknown
    stamps: Stamps  # (P,) source time per person, ns; 0 = not given
    confidences: Floats  # (P,) 0..1, NaN = not given
    markers: Floats
    """(P, M, W) KinematicState of each marker; m, m/s, rad/s, m/s2, rad/s2.

    W is 19, or less where no stage has filled in the rest: 7 in a log of poses, 10 with velocities.
    """
    marker_confidences: Floats  # (P, M) 0..1, NaN = not given
    links: Floats  # (P, L, W) KinematicState of each link; W as of the markers, or another
    link_confidences: Floats  # (P, L) 0..1, NaN = not given
    boxes: Floats  # (P, 22) bounding box: KinematicState of its centre, then height, length, width

    def __repr__(self) -> str:
        n, m, links = len(self.ids), self.markers.shape[1], self.links.shape[1]
        return f"<People {n} rows, {m} markers, {links} links>"

    @classmethod
    def allocate(
        cls, n_people: int, n_markers: int, n_links: int, width: int = STATE, of_links: int = 0
    ) -> People:
        """Return arrays whose numbers are still to be set.

        ``width`` and ``of_links`` are W of the markers and of the links; 0 = as of the markers.
        """
        p, m, n = n_people, n_markers, n_links
        shapes = (p,), (p, m, width), (p, m), (p, n, of_links or width), (p, n), (p, BOX)
        numbers = [np.empty(shape) for shape in shapes]
        return cls(np.empty(p, np.int32), np.empty(p, np.int64), *numbers)

    @classmethod
    def absent(cls, n_people: int, n_markers: int, n_links: int) -> People:
        """Return people of whom nothing is known, neither id nor time nor any number."""
        people = cls.allocate(n_people, n_markers, n_links)
        people.ids.fill(UNTRACKED)
        people.stamps.fill(0)
        for numbers in people[2:]:
            numbers.fill(np.nan)
        return people

    def at(self, rows: Any) -> People:
        """Return some people: views if ``rows`` is a slice, copies if it is a mask or indices."""
        return People(*[array[rows] for array in self])

    def copy(self) -> People:
        """Return copies of all arrays."""
        arrays: Iterable[Any] = self
        return People(*[array.copy() for array in arrays])

    def reorder(self, begin: int, order: Sequence[int]) -> None:
        """Put the people from row ``begin`` on in another order, in place."""
        for array in self:
            some = array[begin : begin + len(order)]
            some[:] = some[order]


class Uncertainty(NamedTuple):
    """How well the markers of P people are known, as far as a stage says it."""

    deviations: Floats
    """(P, M) standard deviation of the position along each axis, m; NaN = unknown."""
    cameras: Stamps  # (P, M) the cameras that contributed: bit k is that of ``names[k]``
    names: tuple[str, ...]  # sources of the cameras
    shared: Floats
    """(P, M) part of the deviations that neighbouring markers share: the cameras' poses, m."""

    def at(self, rows: Any) -> Uncertainty:
        """Return some people: views if ``rows`` is a slice, copies if it is a mask or indices."""
        return Uncertainty(self.deviations[rows], self.cameras[rows], self.names, self.shared[rows])


T = TypeVar("T")


def _of_people(name: str, kind: type[T]) -> T:
    """Make a property of a frame: a field of its people."""
    return cast(T, property(attrgetter(f"people.{name}")))


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A SkeletonGroup message: its times, its camera and its people.

    The fields of :class:`People` are also those of the frame: ``frame.markers`` is
    ``frame.people.markers``. A stage never writes into a frame that it was given.
    """

    stamp: int
    """Time of the data, ns since the epoch (header.stamp of what we write)."""
    log_time: int
    """Log time, ns, of the message that caused this frame; what an output has follows
    ``output.log_time``."""
    source: str
    """The camera: unique per camera within a log; the fixed frame once merged."""
    frame_id: str
    """The frame that the coordinates are expressed in."""
    people: People
    uncertainty: Uncertainty | None = None
    """Of the same people; None = no stage has said anything."""

    ids = _of_people("ids", Ints)
    stamps = _of_people("stamps", Stamps)
    confidences = _of_people("confidences", Floats)
    markers = _of_people("markers", Floats)
    marker_confidences = _of_people("marker_confidences", Floats)
    links = _of_people("links", Floats)
    link_confidences = _of_people("link_confidences", Floats)
    boxes = _of_people("boxes", Floats)

    def __repr__(self) -> str:
        ids = ", ".join(str(i) if i != UNTRACKED else "?" for i in self.ids.tolist())
        return (
            f"<Frame {self.source} in {self.frame_id} at {self.stamp / 1e9:.3f} s: "
            f"{self.n_people} people ({ids}), {self.markers.shape[1]} markers>"
        )

    @property
    def n_people(self) -> int:
        """P."""
        return len(self.people.ids)

    @property
    def positions(self) -> Floats:
        """(P, M, 3) view of the marker positions, m."""
        return self.markers[:, :, POSITION]

    @property
    def orientations(self) -> Floats:
        """(P, L, 4) view of the link orientations, unit quaternions x y z w."""
        return self.links[:, :, ORIENTATION]

    @property
    def velocities(self) -> Floats:
        """(P, M, 3) marker velocities, m/s; a view where there are any."""
        return widened(self.markers)[:, :, VELOCITY]

    @property
    def accelerations(self) -> Floats:
        """(P, M, 3) marker accelerations, m/s2; a view where there are any."""
        return widened(self.markers)[:, :, ACCELERATION]

    def tracked(self) -> Iterator[tuple[int, int]]:
        """Yield row and id of everybody who has an id."""
        return ((k, i) for k, i in enumerate(self.ids.tolist()) if i != UNTRACKED)

    def replace(self, **changes: Any) -> Frame:
        """Return a copy with other fields, also those of its people; the other arrays are shared.

        Raises :class:`TypeError` for a field that does not exist.
        """
        fields = {name: changes.pop(name) for name in _FIELDS if name in changes}
        people = fields.pop("people", self.people)
        if changes.keys() - set(People._fields):
            raise TypeError(f"a frame has no {', '.join(sorted(changes))}")
        values = {n: fields.get(n, getattr(self, n)) for n in _FIELDS if n != "people"}
        return Frame(**values, people=people._replace(**changes) if changes else people)

    def select(self, people: npt.NDArray[Any] | list[int]) -> Frame:
        """Return a frame with the given rows (indices or a mask), arrays copied."""
        index = np.asarray(people)
        if index.size == 0:
            index = index.astype(np.intp)
        uncertainty = self.uncertainty and self.uncertainty.at(index)
        return self.replace(people=self.people.at(index), uncertainty=uncertainty)

    @classmethod
    def empty(
        cls,
        n_people: int,
        model: SkeletonModel,
        *,
        stamp: int = 0,
        log_time: int | None = None,
        source: str = "",
        frame_id: str = "",
    ) -> Frame:
        """Frame with every number absent, ids UNTRACKED, per-person stamps equal to ``stamp``."""
        people = People.absent(n_people, model.n_markers, model.n_links)
        people.stamps.fill(stamp)
        return cls(stamp, stamp if log_time is None else log_time, source, frame_id, people)


_FIELDS = Frame.__slots__


def widened(states: Floats) -> Floats:
    """(..., 19) KinematicStates (..., W) with all columns; those that were left out are NaN."""
    if states.shape[-1] == STATE:
        return states
    whole = np.full((*states.shape[:-1], STATE), np.nan)
    whole[..., : states.shape[-1]] = states
    return whole


def nearest_stamps(stamps: Stamps, asked: Stamps) -> Stamps:
    """(...) Index of the nearest of ``stamps`` (N,) for each one asked; of two, the earlier.

    ``stamps`` are in order.
    """
    after = np.minimum(np.searchsorted(stamps, asked), len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(asked - stamps[before]) <= np.abs(stamps[after] - asked)
    return np.where(is_before, before, after)


Stage = Callable[[Iterable[Frame]], Iterator[Frame]]
"""A step of a system: a generator over frames. ``list(stage(frames))`` is its whole test."""
