"""Results as tables: CSV, Parquet, JSON lines and numpy arrays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

    from hiros_mcap.io.result import Result


def table(result: Result, parts: tuple[str, ...]) -> pd.DataFrame:
    """Return joints and angles side by side, with flat column names that carry their units."""
    import pandas as pd

    found = []
    if "joints" in parts:
        joints = result.joints()
        names = result.model.marker_names
        joints.columns = pd.Index([f"{name} {axis} (m)" for name in names for axis in "xyz"])
        found.append(joints)
    if "angles" in parts:
        angles = result.angles()
        found.append(angles.rename(columns=lambda name: f"{name} (deg)"))
    return pd.concat(found, axis=1).rename_axis(index=["person", "time (s)"])


def write_csv(result: Result, target: Path, parts: tuple[str, ...]) -> None:
    """Write a table with a header line; an empty cell is a gap."""
    table(result, parts).round(6).to_csv(target)


def write_parquet(result: Result, target: Path, parts: tuple[str, ...]) -> None:
    """Write the table of :func:`write_csv` at full precision."""
    table(result, parts).reset_index().to_parquet(target, index=False)


def write_jsonl(result: Result, target: Path, parts: tuple[str, ...]) -> None:
    """Write one object per person and time; null is a gap."""
    joints, angles = result.joints(), result.angles()
    with target.open("w", encoding="utf-8") as file:
        for k, (person, time) in enumerate(joints.index):
            row: dict[str, Any] = {"person": int(person), "time": round(float(time), 6)}
            if "joints" in parts:
                points = joints.to_numpy()[k].reshape(-1, 3)
                names = result.model.marker_names
                row["joints"] = {n: _numbers(p) for n, p in zip(names, points, strict=True)}
            if "angles" in parts:
                degrees = _numbers(angles.to_numpy()[k])
                row["angles"] = dict(zip(angles.columns, degrees, strict=True))
            file.write(json.dumps(row) + "\n")


def write_npz(result: Result, target: Path, parts: tuple[str, ...]) -> None:
    """Write ``person_<id>_times``, ``..._positions`` and ``..._angles`` with the names of both."""
    arrays: dict[str, Any] = {"markers": np.array(result.model.marker_names)}
    angles = result.angles() if "angles" in parts else None
    if angles is not None:
        arrays["angles"] = np.array(angles.columns, dtype=str)
    for person, motion in result.motions.items():
        arrays[f"person_{person}_times"] = motion.times
        if "joints" in parts:
            arrays[f"person_{person}_positions"] = motion.positions
        if angles is not None:
            arrays[f"person_{person}_angles"] = angles.loc[person].to_numpy()
    with target.open("wb") as file:  # a name would get the suffix .npz once more
        np.savez_compressed(file, **arrays)


def _numbers(values: Any) -> list[float | None]:
    return [None if np.isnan(v) else round(float(v), 6) for v in values]
