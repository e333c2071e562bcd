"""Rows of a recording's entities, and how they become columns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import rerun as rr

from hiros_mcap.io.export.markers import RGB
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
    width: float = 1.5  # points on the screen


def ended(times: Stamps, values: Floats, last: Stamps | None) -> tuple[Stamps, Floats]:
    """Return rows of curves, (T, 2) and (T, n), with NaN where a pause begins.

    ``last`` (2,) are the times of the row before them; None if there is none.
    """
    places, before = after_pauses(times, last)
    return np.insert(times, places, before + 1, axis=0), np.insert(
        values.reshape(len(times), -1), places, np.nan, axis=0
    )


TextRow = tuple[Stamps, str, str]
"""A line of a log, or a state: (2,) stamp and log time, ns; the text; its level."""


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
    """Return lines (N, 2, 3), m, or (N, 2, 2), px, as a batch; rerun would loop in Python."""
    import pyarrow as pa

    is_flat = ends.shape[-1] == 2
    batch = rr.components.LineStrip2DBatch if is_flat else rr.components.LineStrip3DBatch
    kind = batch([]).as_arrow_array().type
    points = pa.FixedSizeListArray.from_arrays(pa.array(ends.ravel()), type=kind.value_type)
    offsets = pa.array(np.arange(0, 2 * len(ends) + 1, 2, dtype=np.int32))
    lines = pa.ListArray.from_arrays(offsets, points, type=kind)
    return batch(lines)
