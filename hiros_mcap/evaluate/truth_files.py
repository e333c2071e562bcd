"""The truth from a log, or from files of motion capture: TRC (OpenSim, Cortex) and CSV."""

from __future__ import annotations

import csv
import math
import os
from pathlib import Path

import numpy as np

from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.io.channels import TRUTH_PREFIX
from hiros_mcap.io.log import open_log
from hiros_mcap.skeletons import Floats, SkeletonModel

_LAST_TIME = 9e9
"""s; later times do not fit into 64 bits of nanoseconds."""
_UNITS = {"mm": 0.001, "cm": 0.01, "m": 1.0}


def load_truth(path: str | os.PathLike[str], topic: str = f"{TRUTH_PREFIX}/*") -> Truth:
    """Read the truth from a log's SkeletonGroup channel, or from a TRC or CSV file.

    Parameters
    ----------
    path : an MCAP log, ``.trc`` or ``.csv``.
    topic : glob of the channel in a log; the ids of its skeletons are the true people.

    Raises
    ------
    LogError, ConfigError
        The file cannot be read, or holds no truth.
    """
    readers = {".trc": read_trc, ".csv": read_csv}
    if (read := readers.get(Path(path).suffix.lower())) is not None:
        return read(Path(path))
    with open_log(path, topics=[topic], output_prefix="/none") as log:
        if len(log.cameras) > 1:
            topics = ", ".join(camera.channel.topic for camera in log.cameras)
            raise ConfigError(f"{path}: several channels match {topic}: {topics}; name one")
        frames = list(log.detections())
        if not frames:
            raise LogError("holds no true skeletons", path=path, topic=topic)
        return Truth.of(frames, log.model)


def read_trc(path: Path) -> Truth:
    """Read one person's markers from a TRC file; times are seconds from the log's start.

    The file's ``Units`` scale to metres. Coordinates are taken as they are: the file's axes must
    be those of the log's fixed frame.

    Raises ConfigError if the file is not a TRC file.
    """
    lines = _lines(path)
    if len(lines) < 6 or not lines[0].startswith("PathFileType"):
        raise ConfigError(f"{path}: not a TRC file: the first line is not PathFileType")
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    unit = header.get("Units", "").strip()
    if unit not in _UNITS:
        raise ConfigError(f"{path}: line 3: unit {unit!r} is none of {', '.join(_UNITS)}")
    names = [cell.strip() for cell in lines[3].split("\t")[2:] if cell.strip()]
    if not names:
        raise ConfigError(f"{path}: line 4: names no marker")
    times, rows = [], []
    for number, line in enumerate(lines[5:], start=6):
        cells = line.split("\t")
        if not line.strip():
            continue
        columns = 1 + 3 * len(names)
        values = [_number(cell, path, number) for cell in cells[1 : 1 + columns]]
        values += [math.nan] * (columns - len(values))
        if math.isnan(values[0]):
            raise ConfigError(f"{path}: line {number}: has no time")
        times.append(values[0])
        rows.append(values[1:])
    positions = _UNITS[unit] * np.array(rows, float).reshape(-1, 1, len(names), 3)
    return _truth(path, np.array(times), positions, names, (0,))


def read_csv(path: Path) -> Truth:
    """Read people's markers from a CSV file with the columns time, person, marker, x, y, z.

    One row per marker; seconds (from the log's start, or since the epoch) and metres in the
    fixed frame. ``person`` is a whole number and may be left out when there is one person.

    Raises ConfigError if a column is missing or a cell is not a number.
    """
    try:
        rows = list(csv.DictReader(_lines(path)))
    except csv.Error as error:
        raise ConfigError(f"{path}: not CSV: {error}") from error
    columns = set(rows[0]) if rows else set()
    if missing := {"time", "marker", "x", "y", "z"} - columns:
        raise ConfigError(f"{path}: line 1: no column {', '.join(sorted(missing))}")
    cells: dict[tuple[float, int, str], list[float]] = {}
    for line, row in enumerate(rows, start=2):
        stamp = _number(row["time"], path, line)
        person = _number(row.get("person") or "0", path, line)
        if math.isnan(stamp) or not person.is_integer():
            raise ConfigError(f"{path}: line {line}: time and person must be numbers")
        key = (stamp, int(person), str(row["marker"]).strip())
        if key in cells:
            raise ConfigError(f"{path}: line {line}: {key[2]} twice at {stamp} s")
        cells[key] = [_number(row[axis], path, line) for axis in "xyz"]
    times = sorted({stamp for stamp, _, _ in cells})
    people = sorted({person for _, person, _ in cells})
    names = list(dict.fromkeys(name for _, _, name in cells))
    positions = np.full((len(times), len(people), len(names), 3), np.nan)
    where = {stamp: k for k, stamp in enumerate(times)}
    for (stamp, person, name), xyz in cells.items():
        positions[where[stamp], people.index(person), names.index(name)] = xyz
    return _truth(path, np.array(times), positions, names, tuple(people))


def _truth(
    path: Path, times: Floats, positions: Floats, names: list[str], people: tuple[int, ...]
) -> Truth:
    if len(set(names)) < len(names):
        raise ConfigError(f"{path}: a marker is named twice")
    if len(times) < 2 or not (np.diff(times) > 0).all():
        raise ConfigError(f"{path}: needs at least two increasing times")
    if np.abs(times).max() > _LAST_TIME:
        raise ConfigError(f"{path}: a time is beyond {_LAST_TIME:g} s; times are seconds")
    stamps = np.rint(times * 1e9).astype(np.int64)
    orientations = np.full((*positions.shape[:2], 0, 4), np.nan)
    return Truth(stamps, positions, orientations, people, SkeletonModel.of(names, []))


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not text: {error.reason}") from error


def _number(text: str | None, path: Path, line: int) -> float:
    text = (text or "").strip()
    try:
        number = float(text) if text else math.nan
    except ValueError:
        number = math.inf
    if math.isinf(number):
        raise ConfigError(f"{path}: line {line}: {text!r} is not a number")
    return number
