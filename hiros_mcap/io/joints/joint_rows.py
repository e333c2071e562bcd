"""Files of joint positions as rows: who had which joint where, and when."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hiros_mcap.errors import ConfigError
from hiros_mcap.io.joints.mapping import SECONDS, ColumnMapping, FileMapping, of_export
from hiros_mcap.io.joints.trc import METRES, lines_of, number_of, read_markers, text_of
from hiros_mcap.outside import parse


class JointRow(NamedTuple):
    """One joint of one person at one instant, in the file's own axes."""

    time: float
    """s, as the file has it."""
    person: str
    joint: str
    position: tuple[float, float, float]
    """m."""
    confidence: float
    """0 to 1, NaN = not given."""


def read_rows(path: Path, mapping: FileMapping) -> Iterator[JointRow]:
    """Yield what a CSV, TRC or JSON file holds, or a folder of JSON files, one per instant.

    Raises ConfigError naming the file and the line, for a file that is not as the mapping says.
    """
    readers: dict[str, Callable[[Path, FileMapping], Iterator[JointRow]]] = {
        ".csv": _csv_rows,
        ".trc": _trc_rows,
        ".json": _json_rows,
    }
    reader = readers.get(".json" if path.is_dir() else path.suffix.lower())
    if reader is None:
        raise ConfigError(f"{path}: is none of {', '.join(readers)}, which hiros imports")
    yield from reader(path, mapping)


def _trc_rows(path: Path, mapping: FileMapping) -> Iterator[JointRow]:
    if mapping.time.rate:
        raise ConfigError(f"{path}: time.rate is for files without times; a TRC file has times")
    names, times, positions = read_markers(path)
    for time, points in zip(times.tolist(), positions.tolist(), strict=True):
        for name, point in zip(names, points, strict=True):
            yield JointRow(time, "0", name, tuple(point), math.nan)


def _csv_rows(path: Path, mapping: FileMapping) -> Iterator[JointRow]:
    try:
        reader = csv.DictReader(lines_of(path))
        columns, rows = list(reader.fieldnames or ()), list(reader)
    except csv.Error as error:
        raise ConfigError(f"{path}: not CSV: {error}") from error
    mapping = of_export(mapping, columns)
    c = mapping.columns
    names = _wide_names(columns, c)
    needed = [] if mapping.time.rate else [mapping.time.column]
    needed += [column for n in names for column in c.numbers_of(n)[:3]] or [c.joint, c.x, c.y, c.z]
    if "person" in c.model_fields_set:
        needed.append(c.person)
    if missing := [name for name in needed if name not in columns]:
        raise ConfigError(
            f"{path}: line 1: no column {', '.join(missing)}; the mapping file says how the "
            f"columns are called (there are: {', '.join(columns[:12])})"
        )
    if mapping.time.rate and (not names or c.person in columns):
        raise ConfigError(
            f"{path}: time.rate is for files of one row per instant; this one has a row for each "
            f"{'person' if names else 'joint'}, so it needs a column with times"
        )
    for number, row in enumerate(rows):
        where = f"{path}: line {number + 2}"
        if None in row or None in row.values():
            raise ConfigError(f"{where}: has not as many cells as the first line; is it cut off?")
        time = _time(row.get(mapping.time.column), number, mapping, where)
        yield from (
            _wide(row, names, time, mapping, where) if names else _tall(row, time, mapping, where)
        )


def _wide_names(columns: Sequence[str], mapping: ColumnMapping) -> list[str]:
    """Joints that have a column for x, in the order of the file; none if rows name the joint."""
    pattern = mapping.position or ("" if mapping.joint in columns else "{joint}_{axis}")
    before, joint, after = pattern.format(joint="\0", axis=mapping.x).partition("\0")
    if not joint:
        return []
    return [
        column[len(before) : len(column) - len(after)]
        for column in columns
        if column and column.startswith(before) and column.endswith(after)
    ]


def _wide(
    row: dict[str, str], names: Sequence[str], time: float, mapping: FileMapping, where: str
) -> Iterator[JointRow]:
    c = mapping.columns
    for name in names:
        x, y, z, sure = (number_of(row.get(column), where) for column in c.numbers_of(name))
        yield _row(time, row.get(c.person) or "0", name, (x, y, z), sure, mapping)


def _tall(row: dict[str, str], time: float, mapping: FileMapping, where: str) -> Iterator[JointRow]:
    c = mapping.columns
    x, y, z, sure = (number_of(row.get(name), where) for name in c.numbers)
    yield _row(time, row.get(c.person) or "0", row[c.joint] or "", (x, y, z), sure, mapping)


def _json_rows(path: Path, mapping: FileMapping) -> Iterator[JointRow]:
    c = mapping.columns
    for number, (where, frame) in enumerate(_instants(path, c)):
        given = _object(frame, where).get(mapping.time.column)
        time = _time(None if given is None else str(given), number, mapping, where)
        people = _list(frame.get(c.people), c.people, where)
        if people and isinstance(people[0], dict) and c.x in people[0]:
            people = [people]  # the joints of the only person
        for index, person in enumerate(people):
            joints = _object({c.joints: person} if isinstance(person, list) else person, where)
            who = str(joints.get(c.person, joints.get("id", index)))
            for name, values in _named(joints.get(c.joints), mapping, where):
                x, y, z, sure = _four(values, c, where)
                yield _row(time, who, name, (x, y, z), sure, mapping)


def _instants(path: Path, columns: ColumnMapping) -> Iterator[tuple[str, Any]]:
    """Yield the name and the content of each instant: a file of a folder, or a part of a file."""
    if path.is_dir():
        files = path.glob("*.json")
        for file in sorted(files, key=lambda one: re.sub(r"\d+", _padded, one.name)):
            yield str(file), parse(text_of(file), "JSON", file)
        return
    content = parse(text_of(path), "JSON", path)
    frames = content.get(columns.frames) if isinstance(content, dict) else content
    for number, frame in enumerate(_list(frames, columns.frames, path)):
        yield f"{path}: frame {number}", frame


def _padded(digits: re.Match[str]) -> str:
    return digits[0].zfill(20)


def _object(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{where}: an instant or a person is no JSON object")
    return value


def _list(value: Any, name: str, where: object) -> list[Any]:
    if not isinstance(value, list):
        raise ConfigError(f"{where}: has no list {name!r}; the mapping file says how it is called")
    return value


def _named(joints: Any, mapping: FileMapping, where: str) -> Iterator[tuple[str, Any]]:
    """Yield name and numbers of each joint of a person."""
    if isinstance(joints, dict):
        yield from joints.items()
        return
    values = _list(joints, mapping.columns.joints, where)
    if not values:
        return  # the detector has none in 3D
    if all(isinstance(value, int | float) for value in values):  # x0, y0, z0, c0, x1, ...
        size = max(len(values) // max(len(mapping.names), 1), 1)
        values = [values[k : k + size] for k in range(0, len(values), size)]
    if len(values) != len(mapping.names):
        raise ConfigError(
            f"{where}: has {len(values)} joints without names, and names in the mapping file are "
            f"{len(mapping.names)}"
        )
    yield from zip(mapping.names, values, strict=True)


def _four(values: Any, columns: ColumnMapping, where: str) -> list[float]:
    """Return x, y, z and confidence; NaN for null and for a confidence that is not there."""
    if isinstance(values, dict) and {columns.x, columns.y, columns.z} <= values.keys():
        values = [values.get(key) for key in columns.numbers]
    numbers = values if isinstance(values, list) else [None] * 3 if values is None else []
    if len(numbers) not in (3, 4):
        raise ConfigError(f"{where}: a joint is no list of x, y, z and perhaps a confidence")
    quaternion = [number_of("" if v is None else str(v), where) for v in numbers]
    return [*quaternion, math.nan][:4]


def _time(text: str | None, number: int, mapping: FileMapping, where: str) -> float:
    if mapping.time.rate is not None:
        return number / mapping.time.rate
    time = number_of(text, where)
    if math.isnan(time):
        raise ConfigError(f"{where}: has no time")
    return time * SECONDS[mapping.time.unit]


def _row(
    time: float,
    person: str,
    joint: str,
    position: tuple[float, float, float],
    confidence: float,
    mapping: FileMapping,
) -> JointRow:
    if confidence == 0 and not any(position):  # OpenPose: this joint was not triangulated
        position = math.nan, math.nan, math.nan
    factor = METRES[mapping.unit]
    x, y, z = position
    return JointRow(time, person, joint, (factor * x, factor * y, factor * z), confidence)
