"""Files of joint positions as a log, one channel of SkeletonGroups per file."""

from __future__ import annotations

import heapq
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from hiros_mcap.errors import ConfigError
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.detectors.body_models import linked
from hiros_mcap.io.detectors.body_size import LARGEST, SMALLEST, body_size
from hiros_mcap.io.detectors.detector_reader import add_links
from hiros_mcap.io.joints.joint_rows import JointRow, read_rows
from hiros_mcap.io.joints.mapping import FileMapping, TimeMapping, read_mapping
from hiros_mcap.io.joints.marker_files import MARKER_FILES, METRES
from hiros_mcap.skeletons import POSITION, Frame, SkeletonModel

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
    meaning = read_mapping(None if mapping is None else Path(mapping))
    paths = [Path(source) for source in sources]
    if others := sorted(meaning.files.keys() - {path.name for path in paths}):
        raise ConfigError(f"{mapping}: [files] names {', '.join(others)}, not among those imported")
    names = [meaning.of(path).camera or path.stem for path in paths]
    for path, name in zip(paths, names, strict=True):
        if not name.isprintable():
            raise ConfigError(f"{path}: name the camera in the mapping file; {name!r} is no name")
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(
            f"several files are of the camera {', '.join(twice)}; name it in the mapping file, "
            f'under [files."{paths[-1].name}"]'
        )
    read = [_frames(path, name, meaning.of(path)) for path, name in zip(paths, names, strict=True)]
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
            if any(map(_seen, rows.values()))
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


def _seen(row: JointRow) -> bool:
    return not any(map(math.isnan, row.position))


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
