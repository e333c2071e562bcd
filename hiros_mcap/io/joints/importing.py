"""Files of joint positions as rows, and as a log: one channel of SkeletonGroups per file."""

from __future__ import annotations

import csv
import heapq
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.detectors.body_models import linked
from hiros_mcap.io.detectors.body_size import LARGEST, SMALLEST, body_size
from hiros_mcap.io.detectors.detector_reader import add_links
from hiros_mcap.io.joints.mapping import (
    SECONDS,
    ColumnMapping,
    FileMapping,
    TimeMapping,
    of_columns,
    read_mapping,
)
from hiros_mcap.io.joints.marker_files import MARKER_FILES, METRES, lines_of, number_of, text_of
from hiros_mcap.outside import parse
from hiros_mcap.skeletons import POSITION, Frame, SkeletonModel

_BODY = 33
_HOLISTIC = (75, 543, 553)
"""Joints of MediaPipe's holistic model: those of the body, then hands, then the face if any."""


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
        ".json": _json_rows,
        ".npy": _npy_rows,
        **dict.fromkeys(MARKER_FILES, _marker_rows),
    }
    reader = readers.get(".json" if path.is_dir() else path.suffix.lower())
    if reader is None:
        raise ConfigError(f"{path}: is none of {', '.join(readers)}, which hiros imports")
    yield from reader(path, mapping)


def _marker_rows(path: Path, mapping: FileMapping) -> Iterator[JointRow]:
    if mapping.time.rate:
        raise ConfigError(f"{path}: time.rate is for files without times; this one has times")
    markers = MARKER_FILES[path.suffix.lower()](path)
    for time, skeletons in zip(markers.times.tolist(), markers.positions.tolist(), strict=True):
        for person, points in zip(markers.people, skeletons, strict=True):
            for name, point in zip(markers.names, points, strict=True):
                yield JointRow(time, person, name, tuple(point), math.nan)


def _csv_rows(path: Path, mapping: FileMapping) -> Iterator[JointRow]:
    try:
        reader = csv.DictReader(lines_of(path))
        columns, rows = list(reader.fieldnames or ()), list(reader)
    except csv.Error as error:
        raise ConfigError(f"{path}: not CSV: {error}") from error
    if twice := sorted({name for name in columns if name and columns.count(name) > 1}):
        raise ConfigError(f"{path}: line 1: names the column {twice[0]} twice")
    mapping = of_columns(mapping, columns)
    c = mapping.columns
    names = _wide_names(columns, c)
    needed = [*mapping.rows, *([] if mapping.time.rate else [mapping.time.column])]
    needed += [column for n in names for column in c.numbers_of(n)[:3]] or [c.joint, c.x, c.y, c.z]
    if "person" in c.model_fields_set:
        needed.append(c.person)
    if missing := [name for name in needed if name not in columns]:
        raise ConfigError(
            f"{path}: line 1: no column {', '.join(missing)}; the mapping file says how the "
            f"columns are called, or the rate of a file without times (there are: "
            f"{', '.join(columns[:12])})"
        )
    counts = mapping.time.frame in columns
    if mapping.time.rate and not counts and (not names or c.person in columns):
        raise ConfigError(
            f"{path}: time.rate is for files of one row per instant; this one has a row for each "
            f"{'person' if names else 'joint'}, so it needs a column with times"
        )
    for number, row in enumerate(rows):
        where = f"{path}: line {number + 2}"
        if None in row or None in row.values():
            raise ConfigError(f"{where}: has not as many cells as the first line; is it cut off?")
        if any(not fnmatchcase(row[name], pattern) for name, pattern in mapping.rows.items()):
            continue
        place = number_of(row[mapping.time.frame], where) if counts else number
        time = _time(row.get(mapping.time.column), place, mapping, where)
        yield from (
            _wide(row, names, time, mapping, where) if names else _tall(row, time, mapping, where)
        )


def _wide_names(columns: Sequence[str], mapping: ColumnMapping) -> list[str]:
    """Joints that have a column of x, y or z, in their order; none if rows name the joint."""
    pattern = mapping.position or ("" if mapping.joint in columns else "{joint}_{axis}")
    if not pattern:
        return []
    names = []
    for axis in (mapping.x, mapping.y, mapping.z):
        before, _, after = pattern.format(joint="\0", axis=axis).partition("\0")
        names += [
            column[len(before) : len(column) - len(after)]
            for column in columns
            if column.startswith(before) and column.endswith(after)
        ]
    return list(dict.fromkeys(name for name in names if name))


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
    for where, number, frame in _instants(path, mapping):
        given = _object(frame, where).get(mapping.time.column)
        time = _time(None if given is None else str(given), number, mapping, where)
        people = _list(frame.get(c.people), c.people, where)
        if people and isinstance(people[0], dict) and c.x in people[0]:
            people = [people]  # the joints of the only person
        for index, person in enumerate(people):
            joints = _object({c.joints: person} if isinstance(person, list) else person, where)
            who = str(joints.get(c.person, joints.get("id", index)))
            each = joints.get(c.confidence)  # of the person's joints, beside them
            for k, (name, values) in enumerate(_named(joints.get(c.joints), mapping, where)):
                x, y, z, sure = _four(values, c, where)
                if isinstance(each, list) and k < len(each):
                    sure = number_of("" if each[k] is None else str(each[k]), where)
                yield _row(time, who, name, (x, y, z), sure, mapping)


def _instants(path: Path, mapping: FileMapping) -> Iterator[tuple[str, int, Any]]:
    """Yield name, number and content of each instant: a file of a folder, or a part of a file."""
    if path.is_dir():
        for number, file in _numbered(path, is_time=mapping.time.rate is not None):
            yield str(file), number, parse(text_of(file), "JSON", file)
        return
    content = parse(text_of(path), "JSON", path)
    key = mapping.columns.frames
    frames = content
    if isinstance(content, dict):
        frames = content.get(key) if key else list(content.values())
    for number, frame in enumerate(_list(frames, key, path)):
        yield f"{path}: frame {number}", number, frame


def _numbered(folder: Path, *, is_time: bool) -> list[tuple[int, Path]]:
    """Return the JSON files of a folder in the order of the numbers in their names.

    The number that differs between them counts the frames. ``is_time`` says that it is the time.

    Raises ConfigError if the names differ in anything else: then they are of several series.
    """
    files = sorted(folder.glob("*.json"))
    names = [re.split(r"(\d+)", file.stem) for file in files]  # text, digits, text, ...
    first = next(iter(names), [])
    differ = [k for k in range(len(first)) if any(name[k : k + 1] != [first[k]] for name in names)]
    other = next((k for k, name in enumerate(names) if name[::2] != first[::2]), None)
    if other is None and len(differ) > 1 and is_time:
        other = next(k for k, name in enumerate(names) if name[differ[0]] != first[differ[0]])
    if other is not None:
        raise ConfigError(
            f"{folder}: holds several series, as {files[0].name} and {files[other].name} show; "
            "import a folder for each camera"
        )
    numbers = [[int(digits) for digits in name[1::2]] for name in names]
    place = differ[0] // 2 if differ else -1
    return sorted((n[place] if n else 0, f) for n, f in zip(numbers, files, strict=True))


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
        size = max(len(values) // max(min(mapping.names, default=1), 1), 1)
        values = [values[k : k + size] for k in range(0, len(values), size)]
    yield from zip(_names_of(len(values), mapping, where), values, strict=True)


def _names_of(count: int, mapping: FileMapping, where: object) -> list[str]:
    """Return the names of so many joints; raises ConfigError if the mapping has not so many."""
    if count not in mapping.names:
        raise ConfigError(
            f"{where}: has {count} joints without names, and names in the mapping file are "
            f"{' or '.join(map(str, mapping.names)) or 0}"
        )
    return mapping.names[count]


def _npy_rows(path: Path, mapping: FileMapping) -> Iterator[JointRow]:
    """Yield the joints of an array (T, M, 3) of one person, as FreeMoCap writes them.

    Its arrays of body, hands and face begin with the body's joints.
    """
    try:
        points = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ConfigError(f"{path}: not an array of numpy: {error}") from None
    if not isinstance(points, np.ndarray) or points.ndim != 3 or points.shape[2] != 3:
        shape = getattr(points, "shape", "of several arrays")
        raise ConfigError(f"{path}: should have the shape (instants, joints, 3), is {shape}")
    if mapping.time.rate is None:
        raise ConfigError(f"{path}: has no times; write their rate under [time]")
    count = points.shape[1]
    body = min(mapping.names, default=0)
    names = _names_of(body if count in _HOLISTIC and body == _BODY else count, mapping, path)
    for number, skeleton in enumerate(points[:, : len(names)].astype(np.float64).tolist()):
        for name, (x, y, z) in zip(names, skeleton, strict=True):
            yield _row(number / mapping.time.rate, "0", name, (x, y, z), math.nan, mapping)


def _four(values: Any, columns: ColumnMapping, where: str) -> list[float]:
    """Return x, y, z and confidence; NaN for null and for a confidence that is not there."""
    if isinstance(values, dict) and {columns.x, columns.y, columns.z} <= values.keys():
        values = [values.get(key) for key in columns.numbers]
    numbers = values if isinstance(values, list) else [None] * 3 if values is None else []
    if len(numbers) not in (3, 4):
        raise ConfigError(f"{where}: a joint is no list of x, y, z and perhaps a confidence")
    quaternion = [number_of("" if v is None else str(v), where) for v in numbers]
    return [*quaternion, math.nan][:4]


def _time(text: str | None, number: float, mapping: FileMapping, where: str) -> float:
    if mapping.time.rate is not None and not math.isnan(number):
        return number / mapping.time.rate
    time = number_of(text, where)
    if math.isnan(time):
        raise ConfigError(f"{where}: has no time; the rate under [time] tells it, too")
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
    sure = confidence / mapping.certain
    return JointRow(time, person, joint, (factor * x, factor * y, factor * z), sure)


RELATIVE_START = datetime(2020, 1, 1, tzinfo=UTC).timestamp()
"""s since 1970, at which time 0 lies of a file whose times count from its own start."""
_RELATIVE = 1e8
"""s; earlier times, of before 1973, count from the start of the file."""
_LATEST = 4e9
_USUAL = (0.3, 3.0)  # m, between which a body that is seen for the most part is


def import_joints(
    sources: Sequence[str | os.PathLike[str]],
    target: str | os.PathLike[str],
    mapping: str | os.PathLike[str] | None = None,
    warn: Callable[[str], object] = lambda text: None,
) -> dict[str, int]:
    """Write files of joint positions as a log; return its messages by topic.

    Parameters
    ----------
    sources : CSV, TRC, C3D, JSON or numpy files, or folders of JSON files, one for each camera.
    target : MCAP log to write.
    mapping : TOML file that says what the files mean, or a detector; see :mod:`.mapping`.
    warn : is called with what makes the log doubtful.

    Raises
    ------
    ConfigError
        a file is not as the mapping says, or its people are too large or too small.
    LogError
        ``target`` cannot be written.
    """
    paths = [Path(source) for source in sources]
    meanings = read_mapping(None if mapping is None else Path(mapping), paths)
    names = [one.camera or path.stem for one, path in zip(meanings, paths, strict=True)]
    for path, name in zip(paths, names, strict=True):
        if not name.isprintable():
            raise ConfigError(f"{path}: name the camera in the mapping file; {name!r} is no name")
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(
            f"several files are of the camera {', '.join(twice)}; name it in the mapping file, "
            f'under [files."{paths[-1].name}"]'
        )
    read = [_frames(*each) for each in zip(paths, names, meanings, strict=True)]
    for path in filter(_may_be_cut, paths):
        warn(f"{path}: its last line has no end; if a number in it is cut off, it is wrong")
    with McapWriter(target) as writer:
        encoders = [Encoder(model) for model, _ in read]
        channels = [add_skeleton_channel(writer, f"/{name}/skeletons") for name in names]
        each = ([(f.log_time, i, f) for f in frames] for i, (_, frames) in enumerate(read))
        for log_time, i, frame in heapq.merge(*each, key=lambda item: item[:2]):
            writer.write(channels[i], log_time, encoders[i].encode(frame))
        writer.commit()
        return {writer.channels[ident].topic: n for ident, n in sorted(writer.counts.items())}


def _may_be_cut(path: Path) -> bool:
    """Whether a table does not end with the end of a line. What else is cut off is an error."""
    is_table = path.is_file() and path.suffix.lower() in (".csv", ".trc")
    return is_table and not path.read_bytes().endswith((b"\n", b"\r"))


def _frames(path: Path, camera: str, mapping: FileMapping) -> tuple[SkeletonModel, list[Frame]]:
    """Return the skeleton model of a file, and its frames in the order of time."""
    instants: dict[float, dict[str, dict[str, JointRow]]] = {}
    slots: dict[str, int] = {}
    ids: dict[str, int] = {}
    for row in read_rows(path, mapping):
        joints = instants.setdefault(row.time, {}).setdefault(row.person, {})
        if row.joint in joints:
            raise ConfigError(
                f"{path}: the joint {row.joint} of person {row.person} occurs twice at "
                f"{row.time:g} s"
            )
        joints[row.joint] = row
        slots.setdefault(row.joint, len(slots))
        ids.setdefault(row.person, len(ids))
    if not instants:
        raise ConfigError(f"{path}: holds no joint in 3D")
    model = linked(_names(path, slots, mapping.joints))
    start = _start(path, min(instants), max(instants), mapping.time)
    frame_id = mapping.frame.replace("{camera}", camera)
    frames = []
    for time in sorted(instants):
        people = {
            ids[who]: rows.values()
            for who, rows in instants[time].items()
            if not all(any(map(math.isnan, row.position)) for row in rows.values())
        }
        stamp = round((start + time) * 1e9)
        frame = Frame.empty(len(people), model, stamp=stamp, source=camera, frame_id=frame_id)
        frame.ids[:] = list(people)
        for k, rows in enumerate(people.values()):
            for row in rows:
                frame.markers[k, slots[row.joint], POSITION] = row.position
                frame.marker_confidences[k, slots[row.joint]] = row.confidence
        frame.positions[:] = mapping.rotated(frame.positions)
        add_links(frame, model)
        frames.append(frame)
    _check_size(path, frames, mapping)
    return model, frames


def _names(path: Path, joints: Iterable[str], renamed: Mapping[str, str]) -> list[str]:
    """Return the names of the joints in the log; raises ConfigError if two have the same."""
    names = [renamed.get(joint, joint) for joint in joints]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ConfigError(
            f"{path}: [joints] gives the name {twice} to a joint, but another one has it"
        )
    return names


def _start(path: Path, first: float, last: float, mapping: TimeMapping) -> float:
    """Return what is added to the times of a file, s."""
    given = mapping.start
    start = given.timestamp() if isinstance(given, datetime) else float(given)
    if start == 0.0 and abs(first) < _RELATIVE:
        start = RELATIVE_START
    start += mapping.offset
    if not 0 < start + first <= start + last < _LATEST:
        raise ConfigError(
            f"{path}: its times reach to {start + last:.4g} s after 1970; is the unit of the time "
            f"in the mapping file, {mapping.unit}, right?"
        )
    return start


def _check_size(path: Path, frames: Iterable[Frame], mapping: FileMapping) -> None:
    """Raise ConfigError if people have a size that nobody has."""
    size = body_size(person for frame in frames for person in frame.positions)
    if math.isnan(size) or SMALLEST <= size <= LARGEST:
        return
    if path.suffix.lower() in MARKER_FILES:
        raise ConfigError(f"{path}: people are {size:.3g} m large by the unit in the file")
    given = size / METRES[mapping.unit]
    units = [unit for unit, metres in METRES.items() if _USUAL[0] <= given * metres <= _USUAL[1]]
    remedy = f'write unit = "{units[0]}"' if units else "correct the unit"
    raise ConfigError(
        f"{path}: people are {size:.3g} m large if its unit is {mapping.unit}; {remedy} in the "
        "mapping file"
    )
