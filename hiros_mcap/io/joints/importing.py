"""Files of joint positions as rows, and as a log: one channel of SkeletonGroups per file."""

from __future__ import annotations

import heapq
import math
import os
import re
from collections import Counter
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
from hiros_mcap.io.detectors.body_size import LARGEST, METRES, SMALLEST, body_size
from hiros_mcap.io.detectors.detector_reader import add_links
from hiros_mcap.io.joints.mapping import (
    ColumnMapping,
    FileMapping,
    TimeMapping,
    of_columns,
    read_mapping,
)
from hiros_mcap.io.joints.marker_files import MARKER_FILES
from hiros_mcap.io.joints.text_tables import (
    SECONDS,
    Table,
    lacks_zone,
    number_of,
    read_table,
    seconds_of,
    text_of,
)
from hiros_mcap.io.log_accounts import zeros_in_words
from hiros_mcap.outside import parse
from hiros_mcap.skeletons import POSITION, Frame, SkeletonModel

_BODY = 33
_NOWHERE = math.nan, math.nan, math.nan
_HOLISTIC = (75, 543, 553)
"""Joints of MediaPipe's holistic model: those of the body, then hands, then the face if any."""


class JointRow(NamedTuple):
    """One joint of one person at one instant, in the file's own axes."""

    time: float
    """s, as the file has it."""
    person: str
    joint: str
    """"" if the person has none in 3D, or if nobody is there; then the person is "", too."""
    position: tuple[float, float, float]
    """m."""
    confidence: float
    """0 to 1, NaN = not given."""
    camera: str = ""
    """"" if all rows of the file are of one."""


class Series(NamedTuple):
    """The detections of one camera."""

    camera: str
    model: SkeletonModel
    frames: list[Frame]
    """In the order of time."""


Warn = Callable[[str], object]


def read_rows(
    path: Path, mapping: FileMapping, warn: Warn = lambda text: None
) -> Iterator[JointRow]:
    """Yield what a CSV, TRC or JSON file holds, or a folder of JSON files, one per instant.

    ``warn`` is called with what is guessed, or makes the rows doubtful.

    Raises ConfigError naming the file and the line, for a file that is not as the mapping says.
    """
    readers: dict[str, Callable[[Path, FileMapping, Warn], Iterator[JointRow]]] = {
        ".csv": _csv_rows,
        ".json": _json_rows,
        ".npy": _npy_rows,
        **dict.fromkeys(MARKER_FILES, _marker_rows),
    }
    reader = readers.get(".json" if path.is_dir() else path.suffix.lower())
    if reader is None:
        raise ConfigError(f"{path}: is none of {', '.join(readers)}, which hiros imports")
    yield from reader(path, mapping, warn)


def _marker_rows(path: Path, mapping: FileMapping, warn: Warn) -> Iterator[JointRow]:
    if mapping.time.rate:
        raise ConfigError(f"{path}: time.rate is for files without times; this one has times")
    markers = MARKER_FILES[path.suffix.lower()](path, _unit_set(mapping))
    if markers.doubt:
        warn(f"{path}: {markers.doubt}")
    for time, skeletons in zip(markers.times.tolist(), markers.positions.tolist(), strict=True):
        for person, points in zip(markers.people, skeletons, strict=True):
            for name, point in zip(markers.names, points, strict=True):
                yield JointRow(time, person, name, tuple(point), math.nan)


def _unit_set(mapping: FileMapping) -> str:
    """Return the unit that a mapping file sets; "" if it does not."""
    return mapping.unit if "unit" in mapping.model_fields_set else ""


_CAMERA = re.compile(
    r"(cam|camera|device|sensor|kinect)([ _-]?(id|name|no|nr|number|serial))?", re.I
)
"""Columns that probably name the camera of a row."""


def _csv_rows(path: Path, mapping: FileMapping, warn: Warn) -> Iterator[JointRow]:
    table = read_table(path)
    columns = table.columns
    mapping = of_columns(mapping, columns)
    c = mapping.columns
    names = _wide_names(columns, c)
    _check_columns(path, table, names, mapping)
    mapping = _with_units(mapping, table, names)
    counts = mapping.time.frame in columns
    if mapping.time.rate and not counts and (not names or c.person in columns or c.camera):
        row_of = "camera" if c.camera else "person" if names else "joint"
        raise ConfigError(
            f"{path}: time.rate is for files of one row per instant; this one has a row for each "
            f"{row_of}, so it needs a column with times"
        )
    cells = {name: c.numbers_of(name) for name in names}
    if any(lacks_zone(row.get(mapping.time.column)) for _, row in table.rows[:1]):
        warn(f"{path}: its dates name no zone, so that of UTC is taken")
    for number, (where, row) in enumerate(table.rows):
        if any(not fnmatchcase(row[name], pattern) for name, pattern in mapping.rows.items()):
            continue
        place = number_of(row[mapping.time.frame], where) if counts else number
        time = _time(row.get(mapping.time.column), place, mapping, where)
        camera = row[c.camera] if c.camera else ""
        if c.camera and not camera:
            raise ConfigError(f"{where}: the column {c.camera} names no camera")
        for joint in (
            _wide(row, cells, time, mapping, where) if names else _tall(row, time, mapping, where)
        ):
            yield joint._replace(camera=camera) if camera else joint


def _check_columns(path: Path, table: Table, names: Sequence[str], mapping: FileMapping) -> None:
    """Raise ConfigError if a column is missing, or one of several cameras is not named."""
    c, columns = mapping.columns, set(table.columns)
    needed = [*mapping.rows, *([] if mapping.time.rate else [mapping.time.column])]
    needed += [column for n in names for column in c.numbers_of(n)[:3]] or [c.joint, c.x, c.y, c.z]
    needed += [c.person] if "person" in c.model_fields_set else []
    needed += [c.camera] if c.camera else []
    if missing := [name for name in needed if name not in columns]:
        raise ConfigError(
            f"{path}: line 1: no column {', '.join(missing[:12])}; the mapping file says how the "
            f"columns are called, or the rate of a file without times (there are: "
            f"{', '.join(table.columns[:12])})"
        )
    if "camera" in c.model_fields_set:
        return
    for column in filter(_CAMERA.fullmatch, dict.fromkeys(table.columns)):
        if len(values := dict.fromkeys(row[column] for _, row in table.rows)) > 1:
            raise ConfigError(
                f"{path}: line 1: the column {column} has {len(values)} values "
                f'({", ".join([*values][:4])}); if they are cameras, write camera = "{column}" '
                'under [columns] of a mapping file (--mapping), else camera = ""'
            )


def _with_units(mapping: FileMapping, table: Table, names: Sequence[str]) -> FileMapping:
    """Return a mapping with the units of the second line, where the mapping file sets none."""
    c = mapping.columns
    places = [n for name in names for n in c.numbers_of(name)[:3]] or [c.x, c.y, c.z]
    length, time = table.unit(places, METRES), table.unit([mapping.time.column], SECONDS)
    if time and "unit" not in mapping.time.model_fields_set:
        times = mapping.time.model_copy(update={"unit": time})
        mapping = mapping.model_copy(update={"time": times})
    if length and not _unit_set(mapping):
        mapping = mapping.model_copy(update={"unit": length})
    return mapping


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
    row: dict[str, str],
    cells: dict[str, tuple[str, ...]],
    time: float,
    mapping: FileMapping,
    where: str,
) -> Iterator[JointRow]:
    person = row.get(mapping.columns.person) or "0"
    for name, columns in cells.items():
        x, y, z, sure = (number_of(row.get(column), where) for column in columns)
        yield _row(time, person, name, (x, y, z), sure, mapping)


def _tall(row: dict[str, str], time: float, mapping: FileMapping, where: str) -> Iterator[JointRow]:
    c = mapping.columns
    x, y, z, sure = (number_of(row.get(name), where) for name in c.numbers)
    yield _row(time, row.get(c.person) or "0", row[c.joint], (x, y, z), sure, mapping)


def _json_rows(path: Path, mapping: FileMapping, warn: Warn) -> Iterator[JointRow]:
    c = mapping.columns
    for where, number, frame in _instants(path, mapping):
        stamp = _object(frame, where).get(mapping.time.column)
        time = _time(None if stamp is None else str(stamp), number, mapping, where)
        people = _list(frame.get(c.people), c.people, where)
        if people and isinstance(people[0], dict) and c.x in people[0]:
            people = [people]  # the joints of the only person
        camera = _camera(frame, c.camera, where)
        if not people:
            yield JointRow(time, "", "", _NOWHERE, math.nan, camera)
        for index, person in enumerate(people):
            joints = _object({c.joints: person} if isinstance(person, list) else person, where)
            person = str(joints.get(c.person, joints.get("id", index)))
            confidences = joints.get(c.confidence)  # of the person's joints, beside them
            named = [*_named(joints.get(c.joints), mapping, where)]
            if not named:
                yield JointRow(time, person, "", _NOWHERE, math.nan, camera)
            for k, (name, values) in enumerate(named):
                x, y, z, sure = _four(values, c, where)
                if isinstance(confidences, list) and k < len(confidences):
                    sure = number_of("" if confidences[k] is None else str(confidences[k]), where)
                yield _row(time, person, name, (x, y, z), sure, mapping)._replace(camera=camera)


def _camera(instant: dict[str, Any], key: str, where: str) -> str:
    """Return which camera an instant is of; "" if no key tells. Raises ConfigError if it lacks."""
    if not key:
        return ""
    if not isinstance(name := instant.get(key), str | int) or name == "":
        raise ConfigError(f"{where}: the key {key} names no camera")
    return str(name)


def _instants(path: Path, mapping: FileMapping) -> Iterator[tuple[str, int, Any]]:
    """Yield name, number and content of each instant: a file of a folder, or a part of a file."""
    if path.is_dir():
        for number, file in numbered_files(path, is_time=mapping.time.rate is not None):
            yield str(file), number, parse(text_of(file), "JSON", file)
        return
    content = parse(text_of(path), "JSON", path)
    key = mapping.columns.frames
    frames = content
    if isinstance(content, dict):
        frames = content.get(key) if key else list(content.values())
    for number, frame in enumerate(_list(frames, key, path)):
        yield f"{path}: frame {number}", number, frame


def numbered_files(folder: Path, *, is_time: bool) -> list[tuple[int, Path]]:
    """Return the JSON files of a folder in the order of the numbers in their names.

    The number that differs between them counts the frames. ``is_time`` says that it is the time.

    Raises ConfigError if the names differ in anything else: then they are of several series.
    """
    files = sorted(folder.glob("*.json"))
    names = [re.split(r"(\d+)", file.stem) for file in files]  # text, digits, text, ...
    first = next(iter(names), [])
    differ = [k for k in range(len(first)) if any(name[k : k + 1] != [first[k]] for name in names)]
    stray = next((k for k, name in enumerate(names) if name[::2] != first[::2]), None)
    if stray is None and len(differ) > 1 and is_time:
        stray = next(k for k, name in enumerate(names) if name[differ[0]] != first[differ[0]])
    if stray is not None:
        raise ConfigError(
            f"{folder}: holds several series, as {files[0].name} and {files[stray].name} show; "
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


def _npy_rows(path: Path, mapping: FileMapping, warn: Warn) -> Iterator[JointRow]:
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
    time = seconds_of(text, where, mapping.time.unit)
    if math.isnan(time):
        raise ConfigError(f"{where}: has no time; the rate under [time] tells it, too")
    return time


def _row(
    time: float,
    person: str,
    joint: str,
    position: tuple[float, float, float],
    confidence: float,
    mapping: FileMapping,
) -> JointRow:
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
    warn: Warn = lambda text: None,
    note: Warn = lambda text: None,
) -> dict[str, int]:
    """Write files of joint positions as a log; return its messages by topic.

    Parameters
    ----------
    sources : CSV, TRC, C3D, JSON or numpy files, or folders of JSON files, one for each camera.
    target : MCAP log to write.
    mapping : TOML file that says what the files mean, or a detector; see :mod:`.mapping`.
    warn : is called with what makes the log doubtful. note : with what was taken as meant.

    Raises
    ------
    ConfigError
        a file is not as the mapping says, or its people are too large or too small.
    LogError
        ``target`` cannot be written.
    """
    paths = [Path(source) for source in sources]
    meanings = read_mapping(None if mapping is None else Path(mapping), paths)
    pairs = zip(paths, meanings, strict=True)
    read = [s for path, meaning in pairs for s in _series(path, meaning, warn, note)]
    _check_names([series.camera for series in read], paths)
    for path in filter(_may_be_cut, paths):
        warn(f"{path}: its last line has no end; if a number in it is cut off, it is wrong")
    with McapWriter(target) as writer:
        encoders = [Encoder(series.model) for series in read]
        channels = [add_skeleton_channel(writer, f"/{s.camera}/skeletons") for s in read]
        timed = ([(f.log_time, i, f) for f in series.frames] for i, series in enumerate(read))
        for log_time, i, frame in heapq.merge(*timed, key=lambda item: item[:2]):
            writer.write(channels[i], log_time, encoders[i].encode(frame))
        writer.commit()
        return {writer.channels[ident].topic: n for ident, n in sorted(writer.counts.items())}


def _may_be_cut(path: Path) -> bool:
    """Whether a table does not end with the end of a line. What else is cut off is an error."""
    is_table = path.is_file() and path.suffix.lower() in (".csv", ".trc")
    return is_table and not path.read_bytes().endswith((b"\n", b"\r", b"\n\0"))


def _check_names(names: Sequence[str], paths: Sequence[Path]) -> None:
    """Raise ConfigError if a camera's name is none, or is another one's, too."""
    for name in names:
        if not name.isprintable():
            raise ConfigError(
                f"{paths[0]}: name the camera in the mapping file; {name!r} is no name"
            )
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(
            f"several files are of the camera {', '.join(twice)}; name it in the mapping file, "
            f'under [files."{paths[-1].name}"]'
        )


def _series(path: Path, mapping: FileMapping, warn: Warn, note: Warn) -> Iterator[Series]:
    """Yield what each camera of a file saw."""
    cameras: dict[str, list[JointRow]] = {}
    for row in read_rows(path, mapping, warn):
        cameras.setdefault(row.camera, []).append(row)
    if not cameras:
        raise ConfigError(f"{path}: holds no joint in 3D; joints of images need --calibration FILE")
    for name, rows in cameras.items():
        yield _seen(path, name or mapping.camera or path.stem, rows, mapping, note)


def _seen(
    path: Path, camera: str, rows: Iterable[JointRow], mapping: FileMapping, note: Warn
) -> Series:
    """Return what a camera saw, by its rows.

    A joint at exactly 0 0 0 was not seen; ``note`` is called with how often that was.
    """
    instants: dict[float, dict[str, dict[str, JointRow]]] = {}
    slots: dict[str, int] = {}
    ids: dict[str, int] = {}
    is_flat = False
    for row in rows:
        people = instants.setdefault(row.time, {})
        if not row.joint:
            is_flat = is_flat or bool(row.person)
            continue
        joints = people.setdefault(row.person, {})
        if row.joint in joints:
            raise ConfigError(
                f"{path}: the joint {row.joint} of person {row.person} occurs twice at "
                f"{row.time:g} s; if a column tells cameras or people apart, name it under "
                "[columns] of a mapping file (--mapping): camera = ... or person = ..."
            )
        joints[row.joint] = row
        slots.setdefault(row.joint, len(slots))
        ids.setdefault(row.person, len(ids))
    if not slots and (is_flat or not mapping.names):
        raise ConfigError(f"{path}: holds no joint in 3D; joints of images need --calibration FILE")
    # A camera that saw nobody has the joints of its program.
    slots = slots or {name: k for k, name in enumerate(mapping.names[min(mapping.names)])}
    model = linked(_names(path, slots, mapping.joints))
    start = _start(path, min(instants), max(instants), mapping.time)
    frame_id = mapping.frame.replace("{camera}", camera)
    frames = []
    zeros: Counter[str] = Counter()
    for time in sorted(instants):
        people = {}
        for person, joints in instants[time].items():
            placed = {joint: row for joint, row in joints.items() if any(row.position)}
            if not all(any(map(math.isnan, row.position)) for row in placed.values()):
                people[person] = placed
                zeros.update(joint for joint in joints if joint not in placed)
        stamp = round((start + time) * 1e9)
        frame = Frame.empty(len(people), model, stamp=stamp, source=camera, frame_id=frame_id)
        frame.ids[:] = [ids[person] for person in people]
        for k, joints in enumerate(people.values()):
            for name, row in joints.items():
                frame.markers[k, slots[name], POSITION] = row.position
                frame.marker_confidences[k, slots[name]] = row.confidence
        frame.positions[:] = mapping.rotated(frame.positions)
        add_links(frame, model)
        frames.append(frame)
    _check_size(path, frames, mapping)
    if text := zeros_in_words(zeros, sum(frame.n_people for frame in frames)):
        note(f"{path}: {text}")
    return Series(camera, model, frames)


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
    begin = mapping.start
    start = begin.timestamp() if isinstance(begin, datetime) else float(begin)
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
    unit, said = str(mapping.unit), ""
    if path.suffix.lower() in MARKER_FILES and not _unit_set(mapping):
        unit, said = MARKER_FILES[path.suffix.lower()](path).unit, ", as the file says"
    in_file = size / METRES[unit]
    units = [name for name, metres in METRES.items() if _USUAL[0] <= in_file * metres <= _USUAL[1]]
    remedy = f'write unit = "{units[0]}"' if units else "correct the unit"
    raise ConfigError(
        f"{path}: people are {size:.3g} m large if its unit is {unit}{said}; {remedy} in the "
        "mapping file (--mapping)"
    )
