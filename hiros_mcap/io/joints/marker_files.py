"""Files of motion capture: TRC (OpenSim, Cortex), C3D, tables of Nexus, Motive and Qualisys.

https://www.c3d.org describes C3D. These parameters count: POINT:LABELS (and LABELS2 and so on, of
more than 255 points), POINT:UNITS, POINT:RATE, and the lists of points that are no markers, as the
manual of Vicon's Plug-in Gait has them: ANGLES, FORCES, MOMENTS, POWERS and SCALARS. Nexus writes a
subject before the marker, ``Anna:LASI``, and ``*12`` for a trajectory without a name. A marker that
was not seen has a negative residual. USED counts the points; labels beyond it name nothing.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.units import METRES
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.joints.c3d_file import C3dFile, open_c3d
from hiros_mcap.io.joints.text_tables import number_of, text_of, unit_of, with_points
from hiros_mcap.skeletons import Floats


class Markers(NamedTuple):
    """The trajectories in a file of motion capture."""

    names: list[str]
    times: Floats
    """(T,) s."""
    positions: Floats
    """(T, N, M, 3) m, in the file's axes; NaN where a marker was not seen."""
    people: tuple[str, ...] = ("0",)
    """Name of each of the N people."""
    unit: str = "m"
    """Of the file."""
    doubt: str = ""
    """Reason to doubt the file; "" if there is none."""


def read_trc(path: Path, unit: str = "") -> Markers:
    """Read a TRC file; ``unit``, or else its ``Units``, scales to metres.

    Cells are apart by tabs, semicolons, commas or blanks. The header may have empty cells, and
    lines of axes and without text may be missing. Trajectories without a name are left out.

    Raises ConfigError if it is none, or is cut off.
    """
    text = text_of(path)
    lines = text.splitlines()
    if len(lines) < 5 or not lines[0].lstrip(' "').startswith("PathFileType"):
        raise ConfigError(f"{path}: not a TRC file: the first line is not PathFileType")
    header, unit_name = _trc_header(*lines[1:3])
    unit = unit or _length(unit_name, f"{path}: line 3")
    delimiter = next((d for d in "\t;," if d in lines[3]), None)
    names = [name for name in _stripped(lines[3].split(delimiter))[2:] if name]
    if not names:
        raise ConfigError(f"{path}: line 4: names no marker")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ConfigError(f"{path}: line 4: names the marker {twice} twice")
    rows = list(_trc_rows(path, lines, delimiter, 2 + 3 * len(names)))
    count = _trc_count(path, header, "NumMarkers")
    if count not in (None, len(names)):
        raise ConfigError(
            f"{path}: line 4 names {len(names)} markers, but line 3 says {count}; correct it"
        )
    # A last line without an end may be cut off.
    allowed = int(text.endswith("\n"))
    doubt = _check_frames(path, _trc_count(path, header, "NumFrames") or 0, rows, allowed)
    with_points(rows)
    numbers = np.full((len(rows), 1 + 3 * len(names)), np.nan)
    for k, (where, cells) in enumerate(rows):
        values = [number_of(cell, where) for cell in cells[1:]]
        if math.isnan(values[0]):
            raise ConfigError(f"{where}: has no time")
        numbers[k, : len(values)] = values
    positions = METRES[unit] * numbers[:, 1:].reshape(-1, 1, len(names), 3)
    named = [k for k, name in enumerate(names) if not name.startswith("*")]
    names, positions = [names[k] for k in named], positions[:, :, named]
    return Markers(names, numbers[:, 0], positions, unit=unit, doubt=doubt)


def _trc_header(keys: str, values: str) -> tuple[dict[str, str], str]:
    """Return the values of the header that are known by name, and its unit."""
    by = [r"[\t; ]+" if re.search(r"[\t;]", line) else r"[, ]+" for line in (keys, values)]
    names, cells = (
        re.split(pattern, line.replace('"', "").strip(" \t;,"))
        for pattern, line in zip(by, (keys, values), strict=True)
    )
    header = dict(zip(names, cells, strict=True)) if len(names) == len(cells) else {}
    # The unit is the only word among numbers.
    word = next((cell for cell in cells if cell[:1].isalpha() and not _is_number(cell)), "")
    return header, word or header.get("Units", "")


def _trc_count(path: Path, header: dict[str, str], key: str) -> int | None:
    """Return a number of the header; None without one. Raises ConfigError if it counts nothing."""
    if not (text := header.get(key, "")):
        return None
    if not _is_number(text) or float(text) < 0 or not float(text).is_integer():
        raise ConfigError(f"{path}: line 3: {key} is {text}, which counts nothing; correct it")
    return int(float(text))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _trc_rows(
    path: Path, lines: list[str], delimiter: str | None, columns: int
) -> Iterator[tuple[str, list[str]]]:
    """Yield place and cells of each row, which begins with the number of the frame and the time."""
    begun = False
    for number, line in enumerate(lines[4:], start=5):
        where = f"{path}: line {number}"
        by = delimiter if delimiter and delimiter in line else None
        cells = _stripped(line.split(by))
        first = next(filter(None, cells), "")
        if not first or (not begun and first[0] in "XYZxyz"):
            continue
        begun = True
        if any(cells[columns:]):
            raise ConfigError(
                f"{where}: has more numbers than the {columns // 3} markers of line 4"
                + ("; if its commas are decimal ones, separate the cells by tabs" * (by == ","))
            )
        cells = cells[:columns]
        # Without a delimiter, nobody knows which cell is missing.
        if len(cells) % 3 != 2 or (by is None and len(cells) < columns):
            raise ConfigError(f"{where}: is cut off")
        yield where, cells


def _check_frames(path: Path, count: int, rows: list[tuple[str, list[str]]], allowed: int) -> str:
    """Return what is doubtful about the number of rows, of which a program may count one too many.

    Rows that are missing in the middle are a pause. Raises ConfigError if more than ``allowed``
    are missing at the end.
    """
    ends = [rows[k][1][0] for k in (0, -1)] if rows else []
    if len(ends) == 2 and all(number.isdecimal() for number in ends):
        found = max(int(ends[1][:18]) - int(ends[0][:18]) + 1, len(rows))
    else:
        found = len(rows)
    if count <= found:
        return ""
    text = f"it has {len(rows)} of the {count} frames of its line 3"
    if rows and count <= found + allowed:
        return f"{text}; unless NumFrames is wrong, it was cut off"
    raise ConfigError(f"{path}: is cut off: {text}; export it again, or correct NumFrames")


def _stripped(cells: list[str]) -> list[str]:
    return [cell.strip(' "') for cell in cells]


def _length(text: str, where: str) -> str:
    """Return the unit of METRES that a file names. Raises ConfigError for others."""
    if (unit := unit_of(text)) in METRES:
        return unit
    raise ConfigError(
        f"{where}: unit {text!r} is none of {', '.join(METRES)}; correct it, or import the file "
        'with unit = "mm", or which it is, in a mapping file (--mapping)'
    )


_NUMBERED = re.compile(r"marker[ _]?\d+", re.I)
_EDGES = '",;\t '
_NO_MARKERS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")


def read_c3d(path: Path, unit: str = "") -> Markers:
    """Read a C3D file; ``unit``, or else its POINT:UNITS, or else mm, scales to metres.

    Times count from the first frame of the file. ``Anna:LASI`` is the marker LASI of Anna.

    Raises ConfigError if it is none, or has no markers.
    """
    file = open_c3d(path)
    points = file.points
    labels = file.texts("POINT", "LABELS")[: points.shape[1]]
    no_markers = {label for name in _NO_MARKERS for label in file.texts("POINT", name)}
    unit_name = next(iter(file.texts("POINT", "UNITS")), "") or "mm"
    unit = unit or _length(unit_name, f"{path}: POINT:UNITS")
    rate = sum(file.numbers("POINT", "RATE")[:1])
    kept = {
        k: label
        for k, label in enumerate(labels)
        if label and label not in no_markers and not label.startswith("*")
    }
    if not kept or not len(points):
        raise ConfigError(f"{path}: has no markers{_instead(file)}")
    if not rate > 0:
        raise ConfigError(f"{path}: POINT:RATE is {rate:g}, so its frames have no times")
    times, metres = np.arange(len(points)) / rate, METRES[unit] * points[:, [*kept]]
    return _by_person(f"{path}: POINT:LABELS", [*kept.values()], times, metres, unit, file.doubt)


def _by_person(
    where: str, labels: list[str], times: Floats, points: Floats, unit: str, doubt: str = ""
) -> Markers:
    """Return (T, K, 3) points, m, as the markers of the people before the colons of their labels.

    Raises ConfigError if two have the same label.
    """
    parts = [label.rpartition(":")[::2] for label in labels]
    owners = [*dict.fromkeys(owner for owner, _ in parts)]
    bodies = _rigid_bodies(parts)
    people = [owner for owner in owners if owner not in bodies] or [""]
    doubts = [doubt] if doubt else []
    if bodies:
        fate = "left out" if len(people) > 1 else "taken as parts of one person"
        doubts.append(f"the rigid bodies {', '.join(bodies)} are {fate}")
    columns: dict[tuple[str, str], int] = {}
    for k, (owner, name) in enumerate(parts):
        key = (owner, name) if owner not in bodies else (people[0], f"{owner}_{name}")
        if key in columns:
            raise ConfigError(f"{where} names the marker {labels[k]} twice")
        if len(people) == 1 or owner not in bodies:
            columns[key] = k
    names = list(dict.fromkeys(name for _, name in columns))
    positions = np.full((len(points), len(people), len(names), 3), np.nan)
    for (person, name), k in columns.items():
        positions[:, people.index(person), names.index(name)] = points[:, k]
    whose = tuple(person or "0" for person in people)
    return Markers(names, times, positions, whose, unit, "; ".join(doubts))


def _rigid_bodies(parts: Sequence[tuple[str, str]]) -> list[str]:
    """Return who of several owners of markers are no people, but rigid bodies.

    OptiTrack's Motive numbers the markers of a rigid body: ``ArmL:Marker1``. Beside others who have
    more, nobody has one marker only.
    """
    markers: dict[str, list[str]] = {}
    for owner, name in parts:
        markers.setdefault(owner, []).append(name)
    if len(markers) < 2:
        return []
    most = max(map(len, markers.values()))
    return [
        owner
        for owner, names in markers.items()
        if owner and (len(names) == 1 < most or all(map(_NUMBERED.fullmatch, names)))
    ]


def _instead(file: C3dFile) -> str:
    """Say what a file without markers holds; "" if nothing that is known."""
    kinds = {"ROTATION": "rotations", "ANALOG": "analog data"}
    held = [word for group, word in kinds.items() if any(file.numbers(group, "USED")[:1])]
    return f", only {' and '.join(held)}" if held else ""


_SECTIONS = ("Trajectories", "Model Outputs", "Devices", "Joints", "Segments")


def _reader_of_table(path: Path) -> Reader | None:
    """Return the reader of a table of motion capture by its first lines; None for other tables.

    Vicon Nexus begins with a section's name and its rate, Motive with the version of its format,
    Qualisys with the number of frames.
    """
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            lines = [line.strip(_EDGES) for line in file.read(4096).splitlines()]
    except OSError:
        return None
    first, second = ([line for line in lines if line] + ["", ""])[:2]
    if first.startswith("Format Version,"):
        return read_motive
    if first.startswith("NO_OF_FRAMES"):
        return read_qualisys
    return read_nexus if first in _SECTIONS and _is_number(second) else None


def read_nexus(path: Path, unit: str = "") -> Markers:
    """Read the trajectories of a table of Vicon Nexus; ``unit``, or else its own, scales to metres.

    The section has a line each of its name, rate, labels (``Anna:LASI``), columns (Frame, Sub
    Frame, X, Y, Z, ...) and units, and ends with an empty line. Times count from the first frame.

    Raises ConfigError if it has no such section, or one of its lines is faulty.
    """
    (at, rates), (where, labels), (_, columns), (there, units), *rows = _trajectories(path)
    rate = number_of(rates[0], at)
    kept = {k: labels[k] for k in _triples(columns, labels) if "*" not in labels[k]}
    if not kept or not rate > 0:
        raise ConfigError(f"{where}: names no marker, or the line before no rate")
    said = dict.fromkeys(cell for k in kept for cell in units[k : k + 3])
    unit = unit or _length(", ".join(said), there)
    counted, points = _frames(rows, 0, [*kept])
    times = (counted - counted[0]) / rate
    return _by_person(where, [*kept.values()], times, METRES[unit] * points, unit)


def _trajectories(path: Path) -> list[tuple[str, list[str]]]:
    """Return place and cells of each line of this section of Nexus, behind its name."""
    lines = text_of(path).splitlines()
    names = [line.strip(_EDGES) for line in lines]
    if "Trajectories" not in names:
        found = ", ".join(name for name in _SECTIONS if name in names)
        raise ConfigError(f"{path}: has no Trajectories, only {found}; export them, too")
    begin = names.index("Trajectories") + 1
    end = next((k for k in range(begin, len(names)) if not names[k]), len(names))
    if end - begin < 5:
        raise ConfigError(f"{path}: line {begin}: has no trajectories")
    delimiter = max("\t;,", key=lines[begin + 2].count)
    cells = [_stripped(line.split(delimiter)) for line in lines[begin:end]]
    return [(f"{path}: line {k}", row) for k, row in enumerate(cells, start=begin + 1)]


def _triples(columns: Sequence[str], labels: Sequence[str]) -> list[int]:
    """Return where three columns X, Y, Z begin that have a label."""
    axes = [cell.upper() for cell in columns]
    return [k for k, label in enumerate(labels) if label and axes[k : k + 3] == ["X", "Y", "Z"]]


def _frames(
    rows: list[tuple[str, list[str]]], first: int, kept: Sequence[int]
) -> tuple[Floats, Floats]:
    """(T,) numbers of the column ``first`` and (T, K, 3) of those from ``kept`` on.

    NaN for an empty cell. Raises ConfigError for a row that ends within a point, or has no time.
    """
    with_points(rows)
    wanted = [first, *(k + axis for k in kept for axis in range(3))]
    numbers = np.full((len(rows), len(wanted)), np.nan)
    for row, (where, cells) in zip(numbers, rows, strict=True):
        if any(k < len(cells) < k + 3 for k in kept):
            raise ConfigError(f"{where}: is cut off")
        row[:] = [number_of(cells[k] if k < len(cells) else "", where) for k in wanted]
        if math.isnan(row[0]):
            raise ConfigError(f"{where}: has no time")
    return numbers[:, 0], numbers[:, 1:].reshape(len(rows), -1, 3)


_KINDS = ("Bone", "Marker", "Bone Marker")
"""What Motive exports, and from what a table is read: the first of these that it has."""
_MIDDLE = {"Hip": "PELVIS", "Ab": "SPINE_NAVAL", "Chest": "SPINE_CHEST"}
_SIDED = {
    **{"Shoulder": "CLAVICLE", "UArm": "SHOULDER", "FArm": "ELBOW", "Hand": "WRIST"},
    **{"Thigh": "HIP", "Shin": "KNEE", "Foot": "ANKLE", "Toe": "FOOT"},
}
_BONES = _MIDDLE | {
    f"{side[0]}{bone}": f"{joint}_{side}"
    for bone, joint in _SIDED.items()
    for side in ("LEFT", "RIGHT")
}
"""Motive places a bone where it begins; its LShoulder is the collarbone, its LUArm the shoulder."""


def read_motive(path: Path, unit: str = "") -> Markers:
    """Read a table of OptiTrack's Motive; ``unit``, or else its Length Units, scales to metres.

    https://docs.optitrack.com describes it: a line of keys and values; lines of types, names
    (``Anna:LUArm``), IDs and, since 1.25, parents; Rotation or Position; Frame, Time, X, Y, Z.
    Bones are named after the joint where they begin.

    Raises ConfigError if it has neither bones nor markers, or one of its lines is faulty.
    """
    rows = [
        (f"{path}: line {number}", _stripped(cells))
        for number, cells in enumerate(csv.reader(text_of(path).splitlines()), start=1)
        if any(cells)
    ]
    header = rows[0][1]
    said = dict(zip(header[::2], header[1::2], strict=False))
    begin = next((k for k, (_, cells) in enumerate(rows) if cells[0] == "Frame"), 0)
    if begin < 4:
        raise ConfigError(f"{path}: has no line that begins with Frame, Time; export it again")
    (_, types), (where, labels) = rows[1:3]
    (_, parts), (_, columns) = rows[begin - 1 : begin + 1]
    named = [k for k in _triples(columns, labels) if not labels[k].startswith("Unlabeled")]
    found = [k for k in named if parts[k] == "Position"]
    kind = next((kind for kind in _KINDS if kind in {types[k] for k in found}), "")
    kept = [k for k in found if types[k] == kind]
    if not kept:
        others = ", ".join(dict.fromkeys(filter(None, types[1:]))) or "nothing"
        raise ConfigError(f"{where}: names no bone and no marker, only {others}; export them, too")
    if said.get("Coordinate Space", "Global") != "Global":
        raise ConfigError(f"{path}: line 1: positions count from others; export Global ones")
    unit = unit or _length(said.get("Length Units", "Meters"), f"{path}: line 1")
    times, points = _frames(rows[begin + 1 :], 1, kept)
    names = [_joint_of(labels[k]) if kind == "Bone" else labels[k] for k in kept]
    return _by_person(where, names, times, METRES[unit] * points, unit)


def _joint_of(label: str) -> str:
    """Return the label of the joint where a bone begins; the hip may have the person's name."""
    person, colon, bone = label.rpartition(":")
    bone = "Hip" if bone == person else bone
    return f"{person}{colon}{_BONES.get(bone, bone)}"


def read_qualisys(path: Path, unit: str = "") -> Markers:
    """Read a TSV file of Qualisys Track Manager; ``unit``, or else mm, scales to metres.

    Lines of a key and its values come first, then perhaps one of column names. Rows may begin with
    frame and time; ``FREQUENCY`` tells the times. A marker that was not seen is empty, or at 0 0 0.

    Raises ConfigError if it has no markers, or one of its lines is faulty.
    """
    lines = [
        (f"{path}: line {number}", _stripped(line.split("\t")))
        for number, line in enumerate(text_of(path).splitlines(), start=1)
    ]
    header = {cells[0]: cells[1:] for _, cells in lines}
    labels = [name for name in header.get("MARKER_NAMES", []) if name]
    rate = number_of(header.get("FREQUENCY", [""])[0], f"{path}: FREQUENCY")
    if not labels or not rate > 0 or "3D" not in header.get("DATA_INCLUDED", ["3D"]):
        raise ConfigError(f"{path}: has no MARKER_NAMES or no FREQUENCY, or no 3D data")
    keys = [k for k, (_, cells) in enumerate(lines) if cells[0][:1].isalpha()]
    begin = 1 + max(k for k in keys if lines[k][1][0] not in ("NaN", "NULL"))
    rows = [row for row in lines[begin:] if any(row[1])]
    lead = 2 * (max((len(cells) for _, cells in rows), default=0) >= 2 + 3 * len(labels))
    rows = [(where, [str(k), *cells[lead:]]) for k, (where, cells) in enumerate(rows)]
    counted, points = _frames(rows, 0, range(1, 1 + 3 * len(labels), 3))
    unit = unit or "mm"
    return _by_person(f"{path}: MARKER_NAMES", labels, counted / rate, METRES[unit] * points, unit)


Reader = Callable[[Path, str], Markers]
MARKER_FILES: dict[str, Reader] = {".trc": read_trc, ".c3d": read_c3d}
"""Readers of motion capture by suffix; a table may be of Nexus, Motive or Qualisys, too."""


def has_markers(path: Path) -> bool:
    """Whether a file is one of motion capture, by its suffix and, of a table, its first lines."""
    return _reader_of(path) is not None


def _reader_of(path: Path) -> Reader | None:
    suffix = path.suffix.lower()
    if suffix in (".csv", ".tsv") and path.is_file():
        return _reader_of_table(path)
    return MARKER_FILES.get(suffix)


def read_markers(path: Path, unit: str = "") -> Markers:
    """Read a file that :func:`has_markers`; ``unit``, or else its own, scales to metres.

    Raises ConfigError if it is faulty.
    """
    reader = _reader_of(path)
    assert reader is not None  # noqa: S101 - has_markers
    return reader(path, unit)
