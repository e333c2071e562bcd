"""Files of motion capture: TRC (OpenSim, Cortex) of one person, C3D (Vicon, Qualisys, OptiTrack).

https://www.c3d.org describes C3D. These parameters count: POINT:LABELS (and LABELS2 and so on, of
more than 255 points), POINT:UNITS, POINT:RATE, and the lists of points that are no markers, as the
manual of Vicon's Plug-in Gait has them: ANGLES, FORCES, MOMENTS, POWERS and SCALARS. Nexus writes a
subject before the marker, ``Anna:LASI``, and ``*12`` for a trajectory without a name. A marker that
was not seen has a negative residual.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

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


_BIG_ENDIAN = bytes([86])
"""Processor type of SGI's, in the fourth byte of the parameters."""
_NO_MARKERS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")


def read_c3d(path: Path) -> Markers:
    """Read a C3D file; its POINT:UNITS, mm if there are none, scale to metres.

    Times count from the first frame of the file. ``Anna:LASI`` is the marker LASI of Anna.

    Raises ConfigError if it is none, or has no markers.
    """
    file = open_c3d(path)
    point, points = file["parameters"]["POINT"], file["data"]["points"]
    labels = [label.strip() for label in _listed(point, "LABELS")]
    others = {label.strip() for name in _NO_MARKERS for label in _listed(point, name)}
    unit = (point.get("UNITS", {}).get("value") or ["mm"])[0].strip() or "mm"
    rate = float((point.get("RATE", {}).get("value") or [0.0])[0])
    if unit not in METRES:
        raise ConfigError(f"{path}: POINT:UNITS: unit {unit!r} is none of {', '.join(METRES)}")
    if not rate > 0:
        raise ConfigError(f"{path}: POINT:RATE is {rate:g}, so its frames have no times")
    columns: dict[tuple[str, str], int] = {}
    for k, label in enumerate(labels):
        if not label or label in others or label.startswith("*"):
            continue
        person, _, name = label.rpartition(":")
        if (person, name) in columns:
            raise ConfigError(f"{path}: POINT:LABELS names the marker {label} twice")
        columns[person, name] = k
    if not columns or not points.shape[-1]:
        raise ConfigError(f"{path}: holds no marker")
    people = tuple(dict.fromkeys(person for person, _ in columns))
    names = list(dict.fromkeys(name for _, name in columns))
    metres = METRES[unit] * points[:3]  # NaN where the residual is negative
    positions = np.full((points.shape[-1], len(people), len(names), 3), np.nan)
    for (person, name), k in columns.items():
        positions[:, people.index(person), names.index(name)] = metres[:, k].T
    times = np.arange(points.shape[-1]) / rate
    whose = tuple(person or "0" for person in people)
    return Markers(names, times, positions, whose)


def open_c3d(path: Path) -> Any:
    """Return a C3D file as ezc3d reads it; raises ConfigError if it is none, or is cut off."""
    import ezc3d

    with path.open("rb") as start:
        header = start.read(512)
        start.seek(512 * (header[0] - 1) + 3 if header[:1] > b"\0" else 0)
        order: Literal["big", "little"] = "big" if start.read(1) == _BIG_ENDIAN else "little"
    if header[1:2] != b"P":  # the second byte of every C3D file
        raise ConfigError(f"{path}: not a C3D file")
    if int.from_bytes(header[16:18], order) < 2:  # the first block is the header; ezc3d would crash
        raise ConfigError(f"{path}: is cut off: its header names no block where the data begin")
    try:
        file = ezc3d.c3d(str(path))
    except Exception as error:  # noqa: BLE001 - a reader of another project, on a faulty file
        raise ConfigError(f"{path}: not a C3D file: {error}") from None
    # ezc3d leaves out what is cut off. Beyond 65535 frames, the header holds less than there are.
    first, last = (int.from_bytes(header[k : k + 2], order) for k in (6, 8))
    found = file["data"]["points"].shape[-1]
    if found < last - first + 1:
        raise ConfigError(f"{path}: is cut off: it has {found} of {last - first + 1} frames")
    return file


def _listed(point: Any, name: str) -> list[str]:
    """Return the texts of a parameter of points and of those that continue it."""
    texts = list(point.get(name, {}).get("value") or [])
    number = 2
    while more := point.get(f"{name}{number}", {}).get("value"):
        texts += more
        number += 1
    return texts


MARKER_FILES = {".trc": read_trc, ".c3d": read_c3d}
"""Readers of motion capture by suffix."""
