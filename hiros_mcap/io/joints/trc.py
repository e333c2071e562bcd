"""TRC files (OpenSim, Cortex): the markers of one person, a line per instant."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.outside import read_text
from hiros_mcap.skeletons import Floats

_MOST_BYTES = 1 << 30
METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0}


class Markers(NamedTuple):
    """What a file of motion capture holds."""

    names: list[str]
    times: Floats
    """(T,) s."""
    positions: Floats
    """(T, N, M, 3) m, in the file's axes; NaN where a marker was not seen."""
    people: tuple[str, ...] = ("0",)
    """Name of each of the N people."""
    unnamed: int = 0
    """Trajectories that are left out because they are of no marker."""


def read_trc(path: Path) -> Markers:
    """Read a TRC file; its ``Units`` scale to metres. Raises ConfigError if it is none."""
    lines = lines_of(path)
    if len(lines) < 6 or not lines[0].startswith("PathFileType"):
        raise ConfigError(f"{path}: not a TRC file: the first line is not PathFileType")
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    unit = header.get("Units", "").strip()
    if unit not in METRES:
        raise ConfigError(f"{path}: line 3: unit {unit!r} is none of {', '.join(METRES)}")
    names = [cell.strip() for cell in lines[3].split("\t")[2:] if cell.strip()]
    if not names:
        raise ConfigError(f"{path}: line 4: names no marker")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ConfigError(f"{path}: line 4: names the marker {twice} twice")
    count = header.get("NumMarkers", "").strip()
    if count and count != str(len(names)):
        raise ConfigError(f"{path}: line 4 names {len(names)} markers, but line 3 says {count}")
    times, rows = [], []
    columns = 1 + 3 * len(names)
    for number, line in enumerate(lines[5:], start=6):
        cells = line.split("\t")
        if not line.strip():
            continue
        if any(cell.strip() for cell in cells[1 + columns :]):
            raise ConfigError(
                f"{path}: line {number}: has more numbers than the {len(names)} markers of line 4"
            )
        values = [number_of(cell, f"{path}: line {number}") for cell in cells[1 : 1 + columns]]
        if len(values) % 3 != 1:
            raise ConfigError(f"{path}: line {number}: is cut off")
        values += [math.nan] * (columns - len(values))
        if math.isnan(values[0]):
            raise ConfigError(f"{path}: line {number}: has no time")
        times.append(values[0])
        rows.append(values[1:])
    expected = header.get("NumFrames", "").strip()
    if expected.isdecimal() and int(expected[:18]) > len(rows):
        raise ConfigError(
            f"{path}: is cut off: it has {len(rows)} of the {expected} frames of its line 3"
        )
    positions = METRES[unit] * np.array(rows, float).reshape(-1, 1, len(names), 3)
    return Markers(names, np.array(times), positions)


def text_of(path: Path) -> str:
    """Text of a file of joints; raises ConfigError if it cannot be read or is not UTF-8."""
    return read_text(path, _MOST_BYTES)


def lines_of(path: Path) -> list[str]:
    """Lines of a file of joints; raises ConfigError as :func:`text_of` does."""
    return text_of(path).splitlines()


def number_of(text: str | None, where: str) -> float:
    """Return a finite number, NaN for an empty cell; raises ConfigError for anything else."""
    text = (text or "").strip()
    try:
        number = float(text) if text else math.nan
    except ValueError:
        number = math.inf
    if math.isinf(number) or "_" in text:  # Python reads 1_0 as 10
        raise ConfigError(f"{where}: {text!r} is not a number")
    return number
