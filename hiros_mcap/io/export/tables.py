"""Results as a table: CSV, Parquet and JSON lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.events import hidden_times
from hiros_mcap.outputs import EXPORT_MARK
from hiros_mcap.skeletons import Floats, Stamps

if TYPE_CHECKING:
    import pandas as pd

    from hiros_mcap.io.result import Result


Parts = tuple[str, ...]
"""Of a result: "joints", "angles"."""
Warn = Callable[[str], object]
"""Is called with what a file lacks."""


def table(result: Result, parts: Parts) -> pd.DataFrame:
    """Return joints and angles side by side, with flat column names that carry their units.

    Behind the joints follow their confidences, 0 to 1, and if the result states them, their
    standard deviations along an axis. The last column is :func:`hidden_from`.
    """
    import pandas as pd

    columns = []
    if "joints" in parts:
        names = result.model.marker_names
        joints = result.joints(0)
        index = joints.index
        joints.columns = pd.Index([f"{name} {axis} (m)" for name in names for axis in "xyz"])
        columns.append(joints)
        for values, text in _certainties(result):
            columns.append(pd.DataFrame(values, index, [f"{name} {text}" for name in names]))
    if "angles" in parts:
        angles = result.angles(0)
        columns.append(angles.rename(columns=lambda name: f"{name} (deg)"))
    hidden = np.concatenate([hidden_from(result, person) for person in result.motions])
    columns.append(pd.DataFrame({"hidden from (cameras)": hidden}, columns[0].index))
    return pd.concat(columns, axis=1).rename_axis(index=["person", "time (s)"])


def _certainties(result: Result) -> list[tuple[Floats, str]]:
    """(T, M) of everybody, and what it is."""
    motions = result.motions.values()
    certainties = [(np.concatenate([m.confidences for m in motions]), "confidence")]
    if any(m.deviations is not None for m in motions):
        stated = [
            np.full_like(m.confidences, np.nan) if m.deviations is None else m.deviations
            for m in motions
        ]
        certainties.append((np.concatenate(stated), "SD (m)"))
    return certainties


def hidden_from(result: Result, person: int) -> Stamps:
    """(T,) Number of cameras from which somebody else hides a person: its joints are guesses."""
    times = result.motions[person].times
    count = np.zeros(len(times), np.int64)
    for begin, end, *_ in hidden_times(result.happened, person, result.start):
        count += (times >= begin) & (times <= end)
    return count


def write_csv(result: Result, target: Path, parts: Parts, warn: Warn) -> None:
    """Write a table with a header line; an empty cell is a gap."""
    table(result, parts).round(6).to_csv(target, lineterminator="\n")


def write_parquet(result: Result, target: Path, parts: Parts, warn: Warn) -> None:
    """Write the table of :func:`write_csv` at full precision."""
    rows = table(result, parts).reset_index()
    rows.attrs["hiros"] = EXPORT_MARK  # pandas stores them as metadata of the file
    rows.to_parquet(target, index=False)


def write_jsonl(result: Result, target: Path, parts: Parts, warn: Warn) -> None:
    """Write the rows of :func:`write_csv` as objects, a line each; null is a gap."""
    rows = table(result, parts).round(6).reset_index()
    rows.to_json(target, orient="records", lines=True)


def write_lines(target: Path, lines: Sequence[str]) -> None:
    """Write lines of text."""
    target.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
