"""Rows of a recording's entities, and how they become columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import rerun as rr

from hiros_mcap.io.export.colours import RGB
from hiros_mcap.skeletons import Floats, Stamps

TIMELINE = "seconds from start"
"""Of the log, as on the command line."""
STAMP = "stamp"
"""The same instants as dates."""
LOGGED = "log time"
"""When a live system could have known it."""
GONE_NS = 250_000_000
"""Somebody or something that was not seen for this long is hidden."""
PAUSE_NS = 2 * GONE_NS
"""Nothing is drawn across a longer time without rows."""


def after_pauses(times: Stamps, last: Stamps | None) -> tuple[Stamps, Stamps]:
    """Find the rows that follow a pause.

    Parameters
    ----------
    times : (N, 2) stamps and log times, ns, in the order of stamps.
    last : (2,) of the row before them; None if there is none.

    Returns
    -------
    (K,) numbers of these rows, and (K, 2) times of the rows before the pauses.
    """
    before = np.concatenate([times[:1] if last is None else last[None], times[:-1]])
    places = np.flatnonzero(times[:, 0] - before[:, 0] > PAUSE_NS)
    return places, before[places]


class Line(NamedTuple):
    """How a curve looks."""

    name: str
    colour: RGB
    width: float = 1.5
    """Points on the screen."""


@dataclass(slots=True)
class CurveRows:
    """CurveRows of one entity over time."""

    lines: Sequence[Line]
    _last: Stamps | None = None
    """(2,) times of the newest row."""

    def ended(self, times: Stamps, values: Floats) -> tuple[Stamps, Floats]:
        """Return rows (T, 2) and (T, len(lines)) with NaN where a pause begins.

        They follow the rows of the call before.
        """
        places, before = after_pauses(times, self._last)
        self._last = times[-1]
        return np.insert(times, places, before + 1, axis=0), np.insert(
            values.reshape(len(times), len(self.lines)), places, np.nan, axis=0
        )


@dataclass(slots=True)
class TextRows:
    """Lines of a log, or states, that are still to be sent."""

    times: list[Stamps] = field(default_factory=list)
    """(2,) stamp and log time of each, ns."""
    texts: list[str] = field(default_factory=list)
    levels: list[str] = field(default_factory=list)

    def add(self, time: Stamps, text: str, level: str = "INFO") -> None:
        """Append a row."""
        self.times.append(time)
        self.texts.append(text)
        self.levels.append(level)

    def sent(self) -> None:
        """Forget the rows."""
        self.times, self.texts, self.levels = [], [], []


def time_columns(times: Stamps, start: int) -> list[Any]:
    """Return the columns of the rows' times (N, 2); seconds count from ``start``, ns."""
    stamps, logged = np.ascontiguousarray(times.T)
    return [
        rr.TimeColumn(TIMELINE, duration=(stamps - start).view("timedelta64[ns]")),
        rr.TimeColumn(STAMP, timestamp=stamps.view("datetime64[ns]")),
        rr.TimeColumn(LOGGED, timestamp=logged.view("datetime64[ns]")),
    ]


def columns(batches: Mapping[Any, Any], counts: npt.NDArray[np.integer[Any]]) -> list[Any]:
    """Return columns of components (descriptor -> batch), each row of so many instances."""
    offsets = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=offsets[1:])
    return [rr.ComponentColumn(kind, batch, offsets=offsets) for kind, batch in batches.items()]


def strips(ends: npt.NDArray[np.float32]) -> Any:
    """Return lines (N, 2, 3), m, as a batch; rerun itself would loop over them in Python."""
    import pyarrow as pa

    kind = rr.components.LineStrip3DBatch([]).as_arrow_array().type
    points = pa.FixedSizeListArray.from_arrays(pa.array(ends.ravel()), type=kind.value_type)
    offsets = pa.array(np.arange(0, 2 * len(ends) + 1, 2, dtype=np.int32))
    lines = pa.ListArray.from_arrays(offsets, points, type=kind)
    return rr.components.LineStrip3DBatch(lines)
