"""Files of joints as they are: who is where at which instant, in a room or in an image."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.body.units import METRES
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.detectors.body_models import KEYPOINT_MODELS, body_model
from hiros_mcap.io.joints.mapping import ColumnMapping, FileMapping, of_columns
from hiros_mcap.io.joints.marker_files import MARKER_FILES, has_markers, read_markers
from hiros_mcap.io.joints.text_tables import (
    SECONDS,
    Table,
    lacks_zone,
    number_of,
    read_table,
    seconds_of,
    text_of,
)
from hiros_mcap.outside import parse
from hiros_mcap.progress import Progress
from hiros_mcap.skeletons import Floats
from hiros_mcap.wording import quantity

IN_ROOM, IN_IMAGE = 4, 3
"""Numbers of a joint: x, y, z, confidence; or u, v, score."""
_NO_JOINTS = np.empty((0, 0))
_IMAGE_KEYS = "pose_keypoints_2d", "keypoints"
"""Where OpenPose and AlphaPose have the keypoints of a person: u0, v0, score0, u1, ..."""


class PersonInFile(NamedTuple):
    """A person at an instant, or some of his joints."""

    time: float
    """s, as the file has it."""
    person: str
    """"" if nobody is there."""
    joints: tuple[str, ...]
    """None if the person has none."""
    numbers: Floats
    """(J, 4) x, y, z in the file's own axes, m, and confidence; (J, 3) u, v, px, and score.
    Confidences are 0 to 1, NaN = not given."""
    camera: str = ""
    """"" if all of the file are of one."""

    @property
    def width(self) -> int:
        """Numbers of a joint; 0 if there is none."""
        return int(self.numbers.shape[1])


Warn = Callable[[str], object]


def read_sightings(
    path: Path, mapping: FileMapping, warn: Warn, progress: Progress
) -> Iterator[PersonInFile]:
    """Yield what a CSV, TRC, C3D, JSON or numpy file holds, or a folder of a JSON file per instant.

    ``warn`` is called with what is guessed, or makes the numbers doubtful.

    Raises ConfigError naming the file and the line, for a file that is not as the mapping says.
    """
    readers: dict[str, Callable[[Path, FileMapping, Warn], Iterator[PersonInFile]]] = {
        ".csv": _csv,
        ".tsv": _csv,
        ".json": _json,
        ".npy": _numpy,
    }
    if path.is_dir():
        yield from _folder(path, mapping, warn, progress)
        return
    reader = _markers if has_markers(path) else readers.get(path.suffix.lower())
    if reader is None:
        kinds = ", ".join([*readers, *MARKER_FILES])
        raise ConfigError(f"{path}: is none of {kinds}, which hiros imports; export one of them")
    yield from reader(path, mapping, warn)


def unit_set(mapping: FileMapping) -> str:
    """Return the unit that a mapping file sets; "" if it does not."""
    return mapping.unit if "unit" in mapping.model_fields_set else ""


def _markers(path: Path, mapping: FileMapping, warn: Warn) -> Iterator[PersonInFile]:
    if mapping.time.rate:
        raise ConfigError(f"{path}: time.rate is for files without times; this one has times")
    markers = read_markers(path, unit_set(mapping))
    if markers.doubt:
        warn(f"{path}: {markers.doubt}")
    names = tuple(markers.names)
    numbers = np.insert(markers.positions, 3, np.nan, axis=-1)
    for time, people in zip(markers.times.tolist(), numbers, strict=True):
        for person, joints in zip(markers.people, people, strict=True):
            yield PersonInFile(time, person, names, joints)


_CAMERA = re.compile(
    r"(cam|camera|device|sensor|kinect)([ _-]?(id|name|no|nr|number|serial))?", re.I
)
"""Columns that probably name the camera of a row."""


def _csv(path: Path, mapping: FileMapping, warn: Warn) -> Iterator[PersonInFile]:
    table = read_table(path)
    columns = table.columns
    mapping = of_columns(mapping, columns)
    c = mapping.columns
    names = c.names_in(columns)
    _check_columns(path, table, names, mapping)
    mapping = _with_units(mapping, table, names)
    counts = mapping.time.frame in columns
    if mapping.time.rate and not counts and (not names or c.person in columns or c.camera):
        row_of = "camera" if c.camera else "person" if names else "joint"
        raise ConfigError(
            f"{path}: time.rate is for files of one row per instant; this one has a row for each "
            f"{row_of}, so it needs a column with times"
        )
    cells = [c.numbers_of(name) for name in names] or [c.numbers]
    if any(lacks_zone(row.get(mapping.time.column)) for _, row in table.rows[:1]):
        warn(f"{path}: its dates name no zone, so that of UTC is taken")
    wide = tuple(names)
    for number, (where, row) in enumerate(table.rows):
        if any(not fnmatchcase(row[name], pattern) for name, pattern in mapping.rows.items()):
            continue
        place = number_of(row[mapping.time.frame], where) if counts else number
        time = _time(row.get(mapping.time.column), place, mapping, where)
        camera = row[c.camera] if c.camera else ""
        if c.camera and not camera:
            raise ConfigError(f"{where}: the column {c.camera} names no camera")
        numbers = [[number_of(row.get(column), where) for column in joint] for joint in cells]
        joints = wide or (row[c.joint],)
        person = row.get(c.person) or "0"
        yield PersonInFile(time, person, joints, _scaled(np.array(numbers), mapping), camera)


def _check_columns(path: Path, table: Table, names: Sequence[str], mapping: FileMapping) -> None:
    """Raise ConfigError if a column is missing, or one of several cameras is not named."""
    c, columns = mapping.columns, set(table.columns)
    needed = [*mapping.rows, *([] if mapping.time.rate else [mapping.time.column])]
    needed += [column for n in names for column in c.numbers_of(n)[:-1]]
    needed += [] if names else [c.joint, *c.numbers[:-1]]
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
    places = [n for name in names for n in c.numbers_of(name)[:-1]] or c.numbers[:-1]
    length, time = table.unit(places, METRES), table.unit([mapping.time.column], SECONDS)
    if time and "unit" not in mapping.time.model_fields_set:
        times = mapping.time.model_copy(update={"unit": time})
        mapping = mapping.model_copy(update={"time": times})
    if length and not unit_set(mapping):
        mapping = mapping.model_copy(update={"unit": length})
    return mapping


def _scaled(numbers: Floats, mapping: FileMapping) -> Floats:
    """Return the numbers of joints in m, with confidences up to 1."""
    if numbers.shape[1] == IN_ROOM:
        numbers[:, :-1] *= METRES[mapping.unit]
    numbers[:, -1] /= mapping.certain
    return numbers


def _folder(
    path: Path, mapping: FileMapping, warn: Warn, progress: Progress
) -> Iterator[PersonInFile]:
    """Yield the instants of a folder, one per file; files that cannot be read are counted.

    Raises ConfigError if most cannot.
    """
    files = _numbered(path, is_time=mapping.time.rate is not None)
    bad: list[ConfigError] = []
    for done, (number, file) in enumerate(files):
        progress.update(done, len(files))
        try:
            content = parse(text_of(file), "JSON", file)
            yield from list(_instant(content, str(file), number, mapping))
        except ConfigError as error:
            bad.append(error)
            if 2 * len(bad) > len(files):
                raise bad[0] from None
    if bad:
        warn(
            f"{path}: {quantity(len(bad), 'file')} of {len(files)} left out; the first one: "
            f"{bad[0]}"
        )


def _json(path: Path, mapping: FileMapping, warn: Warn) -> Iterator[PersonInFile]:
    content = parse(text_of(path), "JSON", path)
    key = mapping.columns.frames
    frames = content
    if isinstance(content, dict):
        frames = content.get(key) if key else list(content.values())
    frames = _list(frames, key, path, content)
    if frames and isinstance(frames[0], dict) and {"image_id", "keypoints"} <= frames[0].keys():
        frames = _by_image(frames, path)
    for number, frame in enumerate(frames):
        number, frame = frame if isinstance(frame, tuple) else (number, frame)
        yield from _instant(frame, f"{path}: frame {number}", number, mapping)


def _by_image(people: Sequence[Any], path: Path) -> list[tuple[int, Any]]:
    """Return number and people of each image of AlphaPose's results, which list people."""
    images: dict[int, list[Any]] = {}
    for person in people:
        name = str(_object(person, str(path)).get("image_id", ""))
        digits = re.findall(r"\d+", name.rpartition(".")[0] or name)
        if not digits:
            raise ConfigError(f"{path}: the image_id {name!r} has no number of the frame")
        images.setdefault(int(digits[-1]), []).append(person)
    return [(number, {"people": images[number]}) for number in sorted(images)]


def _instant(frame: Any, where: str, number: int, mapping: FileMapping) -> Iterator[PersonInFile]:
    """Yield the people of an instant of a JSON file."""
    c = mapping.columns
    if isinstance(frame, list):  # of people, without anything about the instant
        frame = {c.people: frame}
    stamp = _object(frame, where).get(mapping.time.column)
    time = _time(None if stamp is None else str(stamp), number, mapping, where)
    is_null = c.people in frame and frame[c.people] is None  # nobody, as MediaPipe says it
    people = [] if is_null else _list(frame.get(c.people), c.people, where, frame)
    if people and isinstance(people[0], dict) and c.x in people[0]:
        people = [people]  # the joints of the only person
    camera = _camera(frame, c.camera, where)
    if not people:
        yield PersonInFile(time, "", (), _NO_JOINTS, camera)
    for index, person in enumerate(people):
        joints = _object({c.joints: person} if isinstance(person, list) else person, where)
        name = str(joints.get(c.person, joints.get("id", index)))
        yield PersonInFile(time, name, *_joints_of(joints, mapping, where), camera)


def _camera(instant: dict[str, Any], key: str, where: str) -> str:
    """Return which camera an instant is of; "" if no key tells. Raises ConfigError if it lacks."""
    if not key:
        return ""
    if not isinstance(name := instant.get(key), str | int) or name == "":
        raise ConfigError(f"{where}: the key {key} names no camera")
    return str(name)


def _numbered(folder: Path, *, is_time: bool) -> list[tuple[int, Path]]:
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


def _list(value: Any, name: str, where: object, table: Any = None) -> list[Any]:
    """Return a list; raises ConfigError if it is none, with the keys of the ``table`` it is of."""
    if not isinstance(value, list):
        keys = ", ".join([*table][:12]) if isinstance(table, dict) else "none"
        raise ConfigError(
            f"{where}: has no list {name!r} (there are: {keys}); --mapping names the program, or a "
            "file that says how it is called"
        )
    return value


def _joints_of(
    person: dict[str, Any], mapping: FileMapping, where: str
) -> tuple[tuple[str, ...], Floats]:
    """Return names and numbers of the joints of a person."""
    c = mapping.columns
    values = person.get(c.joints)
    width = IN_ROOM if c.z else IN_IMAGE
    if not values:  # none in 3D
        key = next((key for key in _IMAGE_KEYS if person.get(key)), "")
        values, width = (person[key], IN_IMAGE) if key else (values, width)
    names: Sequence[str] = ()
    if isinstance(values, dict):
        names, values = tuple(map(str, values)), [*values.values()]
    values = _list(values, c.joints, where)
    if not values:
        return (), _NO_JOINTS
    if all(isinstance(value, int | float) for value in values):  # x0, y0, z0, c0, x1, ...
        count = max(min(mapping.names, default=1), 1)
        size = IN_IMAGE if width == IN_IMAGE else max(len(values) // count, 1)
        values = [values[k : k + size] for k in range(0, len(values), size)]
    names = tuple(names) or _names_of(len(values), mapping, where, width)
    try:
        numbers = np.array(values, np.float64)
    except (TypeError, ValueError):  # a joint is null, or has other numbers than the others
        numbers = np.empty(0)
    if numbers.ndim != 2 or numbers.shape[1] != width or np.isinf(numbers).any():
        numbers = np.array([_numbers_of(joint, c, where, width) for joint in values])
    sure = person.get(c.confidence)  # of the person's joints, beside them
    if isinstance(sure, list) and isinstance(values[0], list) and len(values[0]) == width:
        raise ConfigError(
            f"{where}: joints have {width} numbers and a confidence beside them; if they are those "
            "of a 3D model of MMPose, import those of its 2D model"
        )
    for k, value in enumerate(sure[: len(numbers)] if isinstance(sure, list) else ()):
        numbers[k, -1] = number_of("" if value is None else str(value), where)
    return names, _scaled(numbers[: len(names)], mapping)


def _names_of(
    count: int, mapping: FileMapping, where: object, width: int = IN_ROOM
) -> tuple[str, ...]:
    """Return the names of so many joints, or of the first ones, where a face and hands follow.

    Raises ConfigError if neither the mapping nor, of an image, a detector has so many.
    """
    known = [body_model(name).marker_names for name in KEYPOINT_MODELS.get(count, ())]
    for size in (count, *map(len, known)):
        if size in mapping.names:
            return tuple(mapping.names[size])
    if width == IN_ROOM:
        raise ConfigError(
            f"{where}: has {count} joints without names, and names in the mapping file are "
            f"{' or '.join(map(str, mapping.names)) or 0}"
        )
    if not known:
        raise ConfigError(
            f"{where}: has {count} keypoints, and hiros knows detectors of "
            f"{', '.join(map(str, KEYPOINT_MODELS))}; give their names in a mapping file: "
            "names = [...]"
        )
    return known[0]


def _numpy(path: Path, mapping: FileMapping, warn: Warn) -> Iterator[PersonInFile]:
    """Yield the joints of an array of one person, as FreeMoCap writes them.

    It is (T, J, 3) in a room; (T, J, 2), or (cameras, T, J, 2 or 3), in images. Its arrays of body,
    hands and face begin with the body's joints.
    """
    try:
        points = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ConfigError(f"{path}: not an array of numpy: {error}") from None
    shape: Any = getattr(points, "shape", "of several arrays")
    if not isinstance(points, np.ndarray) or points.ndim not in (3, 4) or shape[-1] not in (2, 3):
        raise ConfigError(f"{path}: should have the shape (instants, joints, 3), is {shape}")
    if mapping.time.rate is None:
        raise ConfigError(f"{path}: has no times; write their rate under [time]")
    width = IN_ROOM if points.ndim == 3 and shape[-1] == 3 else IN_IMAGE
    names = _names_of(shape[-2], mapping, path, width)
    cameras = points if points.ndim == 4 else points[None]
    for k, images in enumerate(cameras):
        camera = f"cam{k + 1}" if points.ndim == 4 else ""
        for number, joints in enumerate(images[:, : len(names)]):
            numbers = np.full((len(names), width), np.nan)
            numbers[:, : width - 1] = joints[:, : width - 1]
            time = number / mapping.time.rate
            yield PersonInFile(time, "0", names, _scaled(numbers, mapping), camera)


def _numbers_of(values: Any, columns: ColumnMapping, where: str, width: int) -> list[float]:
    """Return the numbers of a joint; NaN for null and for a confidence that is not there."""
    keys = columns.numbers
    if isinstance(values, dict) and {*keys[:-1]} <= values.keys():
        values = [values.get(key) for key in keys]
    numbers = values if isinstance(values, list) else [None] * 3 if values is None else []
    if len(numbers) not in (width - 1, width):
        axes = "x, y, z" if width == IN_ROOM else "u, v"
        raise ConfigError(f"{where}: a joint is no list of {axes} and perhaps a confidence")
    joint = [number_of("" if v is None else str(v), where) for v in numbers]
    return [*joint, math.nan][:width]


def _time(text: str | None, number: float, mapping: FileMapping, where: str) -> float:
    if mapping.time.rate is not None and not math.isnan(number):
        return number / mapping.time.rate
    time = seconds_of(text, where, mapping.time.unit)
    if math.isnan(time):
        raise ConfigError(f"{where}: has no time; the rate under [time] tells it, too")
    return time
