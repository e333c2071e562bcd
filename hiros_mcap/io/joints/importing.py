"""Files of joints as a log: skeletons as SkeletonGroups, keypoints of images as DetectionArrays."""

from __future__ import annotations

import heapq
import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.body_size import LARGEST, SMALLEST, body_size
from hiros_mcap.body.units import METRES
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.detectors.body_models import linked
from hiros_mcap.io.detectors.detector_reader import add_links
from hiros_mcap.io.joints.image_series import (
    ImageSeries,
    RgbSetup,
    add_images,
    check_named,
    of_camera,
)
from hiros_mcap.io.joints.joint_files import (
    IN_IMAGE,
    IN_ROOM,
    PersonInFile,
    Warn,
    read_sightings,
    unit_set,
)
from hiros_mcap.io.joints.mapping import FileMapping, TimeMapping, names_by_count, read_mapping
from hiros_mcap.io.joints.marker_files import has_markers, read_markers
from hiros_mcap.io.log_accounts import zeros_in_words
from hiros_mcap.progress import Bar, Progress
from hiros_mcap.skeletons import POSITION, Flags, Floats, Frame, SkeletonModel


class Series(NamedTuple):
    """The detections of one camera."""

    camera: str
    model: SkeletonModel
    frames: list[Frame]
    """In the order of time."""

    @property
    def topic(self) -> str:
        """Of its channel."""
        return f"/{self.camera}/skeletons"


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
    setup: RgbSetup = RgbSetup(),  # noqa: B008 - frozen
    progress: Progress = Bar(),  # noqa: B008 - frozen
) -> dict[str, int]:
    """Write files of joints, in a room or in images, as a log; return its messages by topic.

    Parameters
    ----------
    sources : CSV, TRC, C3D, JSON or numpy files, or folders of JSON files, one for each camera.
    target : MCAP log to write.
    mapping : TOML file that says what the files mean, or a detector; see :mod:`.mapping`.
    warn : is called with what makes the log doubtful. note : with what was taken as meant.
    setup : of RGB cameras. progress : follows the files of a folder.

    Raises
    ------
    ConfigError
        a file is not as the mapping says, or its people are too large or too small; keypoints have
        no lens.
    LogError
        ``target`` cannot be written.
    """
    paths = [Path(source) for source in sources]
    meanings = read_mapping(None if mapping is None else Path(mapping), paths)
    read: list[Series | ImageSeries] = []
    for path, meaning in zip(paths, meanings, strict=True):
        read += _series(path, _set_up(path, meaning, setup), setup, (warn, note), progress)
    names = [series.camera for series in read]
    _check_names(names, paths)
    check_named(setup, names)
    for path in filter(_may_be_cut, paths):
        warn(f"{path}: its last line has no end; if a number in it is cut off, it is wrong")
    with McapWriter(target) as writer:
        timed = [_skeleton_messages(writer, s) for s in read if isinstance(s, Series)]
        images = [s for s in read if isinstance(s, ImageSeries)]
        timed += add_images(writer, images, setup, warn, note)
        for log_time, channel, data in heapq.merge(*timed, key=lambda item: item[:2]):
            writer.write(channel, log_time, data)
        writer.commit()
        return {writer.channels[ident].topic: n for ident, n in sorted(writer.counts.items())}


def _set_up(path: Path, mapping: FileMapping, setup: RgbSetup) -> FileMapping:
    """Return a mapping with the rate and the joints that options name."""
    rate = of_camera(setup.rates, mapping.camera or path.stem)
    if rate is not None:
        time = mapping.time.model_copy(update={"rate": rate})
        mapping = mapping.model_copy(update={"time": time})
    if not setup.joints:
        return mapping
    try:
        return mapping.model_copy(update={"names": names_by_count(setup.joints)})
    except ValueError as error:
        raise ConfigError(f"--joints: {error}") from None


def _skeleton_messages(writer: McapWriter, series: Series) -> Iterator[tuple[int, int, bytes]]:
    """Declare the channel of a camera; return log time, channel and bytes of its messages."""
    encoder, channel = Encoder(series.model), add_skeleton_channel(writer, series.topic)
    return ((frame.log_time, channel, encoder.encode(frame)) for frame in series.frames)


def _may_be_cut(path: Path) -> bool:
    """Whether a table does not end with the end of a line. What else is cut off is an error."""
    is_table = path.is_file() and path.suffix.lower() in (".csv", ".tsv", ".trc")
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


class _Gathered(NamedTuple):
    """The sightings of a camera by time and person."""

    instants: dict[float, dict[str, Floats]]
    """(J, K) numbers of joints; NaN where a person has none of that name."""
    joints: list[str]
    ids: dict[str, int]
    """Number of each person."""


def _gathered(path: Path, sightings: Sequence[PersonInFile], width: int) -> _Gathered:
    """Gather the joints with so many numbers; raises ConfigError if one occurs twice."""
    wanted = [seen for seen in sightings if seen.joints and seen.width == width]
    layouts = dict.fromkeys(seen.joints for seen in wanted)
    joints = [*dict.fromkeys(joint for layout in layouts for joint in layout)]
    slots = {joint: slot for slot, joint in enumerate(joints)}
    places = {layout: [slots[joint] for joint in layout] for layout in layouts}
    instants: dict[float, dict[str, Floats]] = {seen.time: {} for seen in sightings}
    known: dict[tuple[float, str], Flags] = {}
    for time, person, layout, numbers, _ in wanted:
        rows, empty = places[layout], np.full((len(joints), width), np.nan)
        instants[time].setdefault(person, empty)[rows] = numbers
        taken = known.setdefault((time, person), np.zeros(len(joints), bool))
        if taken[rows].any():
            raise ConfigError(
                f"{path}: the joint {layout[int(taken[rows].argmax())]} of person {person} occurs "
                f"twice at {time:g} s; if a column tells cameras or people apart, name it under "
                "[columns] of a mapping file (--mapping): camera = ... or person = ..."
            )
        taken[rows] = True
    ids = {person: k for k, person in enumerate(dict.fromkeys(seen.person for seen in wanted))}
    return _Gathered(instants, joints, ids)


def _series(
    path: Path, mapping: FileMapping, setup: RgbSetup, say: tuple[Warn, Warn], progress: Progress
) -> Iterator[Series | ImageSeries]:
    """Yield what each camera of a file saw."""
    warn, note = say
    cameras: dict[str, list[PersonInFile]] = {}
    for sighting in read_sightings(path, mapping, warn, progress):
        cameras.setdefault(sighting.camera, []).append(sighting)
    if not cameras:
        raise ConfigError(f"{path}: holds no joint")
    for name, sightings in cameras.items():
        camera = name or mapping.camera or path.stem
        widths = {sighting.width for sighting in sightings}
        width = IN_ROOM if IN_ROOM in widths else IN_IMAGE if IN_IMAGE in widths else 0
        # A camera that saw nobody has the joints of its program.
        if not width and (any(s.person for s in sightings) or not mapping.names):
            raise ConfigError(f"{path}: holds no joint")
        gathered = _gathered(path, sightings, width)
        start = _start(path, min(gathered.instants), max(gathered.instants), mapping.time)
        start += of_camera(setup.starts, camera) or 0.0
        if width == IN_IMAGE:
            yield _images(path, camera, gathered, mapping, start)
        else:
            yield _skeletons(path, camera, gathered, mapping, start, note)


def _images(
    path: Path, camera: str, gathered: _Gathered, mapping: FileMapping, start: float
) -> ImageSeries:
    """Return the keypoints of a camera."""
    joints = tuple(_names(path, gathered.joints, mapping.joints))
    stamps, images = [], []
    for time, people in sorted(gathered.instants.items()):
        stamps.append(round((start + time) * 1e9))
        images.append(np.array([*people.values()]).reshape(-1, len(joints), IN_IMAGE))
    return ImageSeries(path, camera, joints, np.array(stamps), images, not mapping.names)


def _skeletons(
    path: Path, camera: str, gathered: _Gathered, mapping: FileMapping, start: float, note: Warn
) -> Series:
    """Return the skeletons that a camera saw.

    A joint at exactly 0 0 0 was not seen; ``note`` is called with how often that was.
    """
    joints = gathered.joints or mapping.names[min(mapping.names)]
    model = linked(_names(path, joints, mapping.joints))
    frame_id = mapping.frame.replace("{camera}", camera)
    frames = []
    zeros: Counter[str] = Counter()
    for time, seen in sorted(gathered.instants.items()):
        people = {}
        for person, numbers in seen.items():
            there = np.asarray(numbers[:, POSITION].any(axis=1))
            if not np.isnan(numbers[there, POSITION]).any(axis=1).all():
                people[person] = np.where(there[:, None], numbers, np.nan)
                zeros.update(joints[slot] for slot in np.flatnonzero(~there))
        stamp = round((start + time) * 1e9)
        frame = Frame.empty(len(people), model, stamp=stamp, source=camera, frame_id=frame_id)
        frame.ids[:] = [gathered.ids[person] for person in people]
        for k, numbers in enumerate(people.values()):
            frame.positions[k] = numbers[:, POSITION]
            frame.marker_confidences[k] = numbers[:, -1]
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
    if has_markers(path) and not unit_set(mapping):
        unit, said = read_markers(path).unit, ", as the file says"
    in_file = size / METRES[unit]
    units = [name for name, metres in METRES.items() if _USUAL[0] <= in_file * metres <= _USUAL[1]]
    remedy = f'write unit = "{units[0]}"' if units else "correct the unit"
    raise ConfigError(
        f"{path}: people are {size:.3g} m large if its unit is {unit}{said}; {remedy} in the "
        "mapping file (--mapping)"
    )
