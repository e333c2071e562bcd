"""Rows of a recording's entities, collected and sent as columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hiros_mcap.io.export.colours import RGB
from hiros_mcap.skeletons import Floats, Frame, Ints, Stamps

TIMELINE = "seconds from start"
"""Of the log, as on the command line."""
STAMP = "stamp"
"""The same instants as dates."""
HIDDEN = -1
PAUSE_NS = 500_000_000
"""A curve is not drawn across a longer time without values."""


@dataclass(frozen=True, slots=True)
class Poses:
    """What is drawn of a Frame: a tenth of it, where thousands have to wait."""

    stamp: int
    source: str
    ids: Ints
    """(P,)"""
    positions: Floats
    """(P, M, 3) m"""
    marker_confidences: Floats
    """(P, M)"""

    @classmethod
    def of(cls, frame: Frame) -> Poses:
        """Copy what is drawn."""
        positions = frame.positions.copy()
        return cls(frame.stamp, frame.source, frame.ids, positions, frame.marker_confidences)


class PoseBatch:
    """Poses of several frames in one array, which is used again for the next ones."""

    def __init__(self, n_markers: int) -> None:
        self.size = 0
        """Poses in it, N."""
        self._positions = np.empty((64, n_markers, 3))
        self._confidences = np.empty((64, n_markers))

    @property
    def positions(self) -> Floats:
        """(N, M, 3), m."""
        return self._positions[: self.size]

    @property
    def confidences(self) -> Floats:
        """(N, M)."""
        return self._confidences[: self.size]

    def add(self, frame: Frame | Poses) -> None:
        """Append a frame's poses."""
        start, self.size = self.size, self.size + len(frame.ids)
        if missing := max(0, self.size - len(self._positions)):
            more = ((0, missing + self.size), (0, 0))
            self._positions = np.pad(self._positions, (*more, (0, 0)))
            self._confidences = np.pad(self._confidences, more)
        self._positions[start : self.size] = frame.positions
        self._confidences[start : self.size] = frame.marker_confidences

    def clear(self) -> None:
        """Forget the poses."""
        self.size = 0


@dataclass(slots=True, kw_only=True)
class Rows:
    """What all rows have."""

    stamps: list[int] = field(default_factory=list)
    started: bool = False
    """Whether it was said how the entity looks."""


@dataclass(slots=True)
class DetectionRows(Rows):
    """A camera's detections over time; a row of nobody hides them."""

    poses: PoseBatch
    counts: list[int] = field(default_factory=list)
    """People in each row."""
    shown: bool = False
    last: int = 0

    def add(self, frame: Frame | Poses) -> None:
        """Append a row."""
        self.poses.add(frame)
        self.stamps.append(frame.stamp)
        self.counts.append(len(frame.ids))
        self.shown, self.last = len(frame.ids) > 0, frame.stamp

    def hide(self, stamp: int) -> None:
        """Append a row of nobody, unless nobody is shown."""
        if self.shown:
            self.stamps.append(stamp)
            self.counts.append(0)
            self.shown = False

    def sent(self) -> None:
        """Forget the rows."""
        self.stamps, self.counts = [], []
        self.poses.clear()


@dataclass(slots=True)
class PersonRows(Rows):
    """One person over time; all that is drawn of it is derived from its joints when it is sent."""

    places: list[int] = field(default_factory=list)
    """Which of its stage's collected poses each row is, or HIDDEN."""
    shown: bool = False
    last: int = 0
    last_root: tuple[int, Floats] | None = None
    """Stamp and place of the root in the last row that was sent."""
    last_angles: Floats | None = None
    """Joint angles, rad, in that row."""

    def add(self, stamp: int, place: int) -> None:
        """Append a row."""
        self.stamps.append(stamp)
        self.places.append(place)
        self.shown, self.last = True, stamp

    def hide(self, stamp: int) -> None:
        """Append an empty row, unless nothing is shown."""
        if self.shown:
            self.stamps.append(stamp)
            self.places.append(HIDDEN)
            self.shown = False

    def sent(self) -> None:
        """Forget the rows."""
        self.stamps, self.places = [], []


@dataclass(slots=True)
class StageRows:
    """Everybody of one stage over time."""

    poses: PoseBatch
    people: dict[int, PersonRows] = field(default_factory=dict)
    """By the person's id."""
    shown: dict[int, PersonRows] = field(default_factory=dict)
    """Those of them that are not hidden."""
    last: int = 0
    """Stamp of the newest frame; 0 before there is one."""

    def hide_all(self, stamp: int) -> None:
        """Hide everybody."""
        for person_rows in self.shown.values():
            person_rows.hide(stamp)
        self.shown.clear()


class Line(NamedTuple):
    """How a curve looks."""

    name: str
    colour: RGB
    width: float = 1.5
    """Points on the screen."""


@dataclass(slots=True)
class ScalarRows(Rows):
    """Curves of one entity over time."""

    lines: Sequence[Line]
    values: list[float] = field(default_factory=list)
    """len(lines) of each row, row by row; NaN ends a curve before a pause."""
    last: int | None = None
    """Stamp of the newest row."""

    def add(self, stamp: int, value: float) -> None:
        """Append a row of the only curve."""
        if self.last is not None and stamp - self.last > PAUSE_NS:
            self._append(self.last + 1, [float("nan")])
        self._append(stamp, [value])

    def extend(self, stamps: Stamps, values: Floats) -> None:
        """Append rows (T, len(lines))."""
        if not len(stamps):
            return
        rows = values.reshape(len(stamps), len(self.lines))
        before = np.concatenate([[stamps[0] if self.last is None else self.last], stamps[:-1]])
        pauses = np.flatnonzero(stamps - before > PAUSE_NS)
        self.last = int(stamps[-1])
        self.stamps += np.insert(stamps, pauses, before[pauses] + 1).tolist()
        self.values += np.insert(rows, pauses, np.nan, axis=0).ravel().tolist()

    def _append(self, stamp: int, values: Sequence[float]) -> None:
        self.last = stamp
        self.stamps.append(stamp)
        self.values += values

    def sent(self) -> None:
        """Forget the rows."""
        self.stamps, self.values = [], []


@dataclass(slots=True)
class TextRows(Rows):
    """Lines of a log, or states, over time."""

    texts: list[str] = field(default_factory=list)
    levels: list[str] = field(default_factory=list)

    def add(self, stamp: int, text: str, level: str = "INFO") -> None:
        """Append a row."""
        self.stamps.append(stamp)
        self.texts.append(text)
        self.levels.append(level)

    def sent(self) -> None:
        """Forget the rows."""
        self.stamps, self.texts, self.levels = [], [], []


def times(stamps: list[int], start: int) -> list[Any]:
    """Return the columns of the rows' times; seconds count from ``start``, ns."""
    import rerun as rr

    table = np.array(stamps, np.int64)
    return [
        rr.TimeColumn(TIMELINE, duration=(table - start).view("timedelta64[ns]")),
        rr.TimeColumn(STAMP, timestamp=table.view("datetime64[ns]")),
    ]


def columns(batches: Mapping[Any, Any], counts: npt.NDArray[np.integer[Any]]) -> list[Any]:
    """Return columns of components (descriptor -> batch), each row of so many instances."""
    import rerun as rr

    offsets = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=offsets[1:])
    return [rr.ComponentColumn(kind, batch, offsets=offsets) for kind, batch in batches.items()]


def strips(ends: npt.NDArray[np.float32]) -> Any:
    """Return lines (N, 2, 3), m, as a batch; rerun itself would loop over them in Python."""
    import pyarrow as pa
    import rerun as rr

    kind = rr.components.LineStrip3DBatch([]).as_arrow_array().type
    points = pa.FixedSizeListArray.from_arrays(pa.array(ends.ravel()), type=kind.value_type)
    offsets = pa.array(np.arange(0, 2 * len(ends) + 1, 2, dtype=np.int32))
    lines = pa.ListArray.from_arrays(offsets, points, type=kind)
    return rr.components.LineStrip3DBatch(lines)
