"""The truth from a log, or from files of motion capture: TRC (OpenSim, Cortex), C3D and CSV.

docs/evaluating.md describes the CSV layout, joints and link orientations, for inertial suits, too.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hiros_mcap.body.units import METRES
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.evaluate.truth import MAX_GAP_NS, Truth
from hiros_mcap.io.channels import TRUTH_PREFIX
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.detectors.body_models import joints_of
from hiros_mcap.io.joints.marker_files import has_markers, read_markers
from hiros_mcap.io.joints.text_tables import SECONDS, number_of, read_table, seconds_of
from hiros_mcap.io.log import Source, open_log
from hiros_mcap.io.log_accounts import zeros_in_words
from hiros_mcap.skeletons import Floats, SkeletonModel

_LAST_TIME = 9e9  # s; later times do not fit into 64 bits of nanoseconds
_LARGEST_M, _SMALLEST_M = 10.0, 0.02
"""Nobody is as large or as small as this, between any two of his markers along an axis."""
_ENOUGH_MARKERS = 2
_UNIT_LENGTH = 0.02  # by which the length of a quaternion may differ from 1: files round
_ROOT = "pelvis", ""  # the joint from which positions count in a file that is relative to a person
_LINK = ("parent", "child")
_QUATERNION = ("qx", "qy", "qz", "qw")


def load_truth(path: Source, topic: str = f"{TRUTH_PREFIX}/*") -> Truth:
    """Read the truth from a log's SkeletonGroup channel, or from a TRC, C3D or CSV file.

    Parameters
    ----------
    path : an MCAP log, ``.trc``, ``.c3d`` or ``.csv``.
    topic : glob of the channel in a log; the ids of its skeletons are the true people.

    Raises LogError or ConfigError if the file cannot be read, or holds no truth.
    """
    name = Path(path.path if isinstance(path, McapReader) else path)
    if has_markers(name):
        return read_mocap(name)
    if name.suffix.lower() == ".csv":
        return read_csv(name)
    with open_log(path, topics=[topic], output_prefix="/none") as log:
        check_only(name, topic, [camera.channel.topic for camera in log.cameras])
        reading = log.read()
        frames = list(reading.frames())
        if not frames:
            raise LogError("holds no true skeletons", path=name, topic=topic)
        accounts = reading.accounts.values()
        notes = [text for one in accounts for text in one.notes(log.model.marker_names)]
        return replace(Truth.of(frames, log.model), notes=tuple(notes))


def check_only(path: Path | str, topic: str, matching: Sequence[str]) -> None:
    """Raise ConfigError if several channels of a log match the glob of the truth."""
    if len(matching) > 1:
        topics = ", ".join(matching)
        raise ConfigError(f"{path}: several channels match {topic}: {topics}; name one")


def read_mocap(path: Path) -> Truth:
    """Read markers from a file of motion capture; times are seconds from the log's start.

    The file's unit scales to metres. Coordinates are taken as they are: the file's axes must be
    those of the log's fixed frame. People are numbered in the order of the file.

    Raises ConfigError if the file is faulty.
    """
    markers = read_markers(path)
    orientations = np.full((*markers.positions.shape[:2], 0, 4), np.nan)
    model = SkeletonModel.of(markers.names, [])
    people = tuple(range(len(markers.people)))
    truth = _truth(path, markers.times, markers.positions, orientations, model, people)
    return replace(truth, notes=(*truth.notes, *filter(None, [markers.doubt])))


def read_csv(path: Path) -> Truth:
    """Read people's joints and link orientations from a CSV file.

    The columns time, person, marker, x, y, z give one joint a row: seconds (from the log's start,
    or since the epoch) and metres in the fixed frame. ``person`` is a whole number and may be left
    out when there is one person. A row with parent and child, the two markers that a link joins,
    gives the link's orientation instead: qx, qy, qz, qw in the fixed frame.

    Raises ConfigError if a column is missing, a cell is not a number, a quaternion is none, or a
    link ends at a marker without positions.
    """
    joints, turns = _read_tables(path)
    times = sorted({time for time, _, _ in (*joints, *turns)})
    people = sorted({person for _, person, _ in joints})
    names = list(dict.fromkeys(name for _, _, name in joints))
    links = list(dict.fromkeys(ends for _, _, ends in turns))
    if unknown := sorted({end for ends in links for end in ends} - set(names)):
        raise ConfigError(f"{path}: links end at joints without positions: {', '.join(unknown)}")
    if unknown_people := sorted({p for _, p, _ in turns} - set(people)):
        raise ConfigError(f"{path}: links of people without joints: {unknown_people}")
    shape = (len(times), len(people))
    positions = np.full((*shape, len(names), 3), np.nan)
    orientations = np.full((*shape, len(links), 4), np.nan)
    row_of = {time: k for k, time in enumerate(times)}
    for (time, person, name), xyz in joints.items():
        positions[row_of[time], people.index(person), names.index(name)] = xyz
    for (time, person, ends), xyzw in turns.items():
        orientations[row_of[time], people.index(person), links.index(ends)] = xyzw
    slots = [(child, names.index(parent), names.index(child)) for parent, child in links]
    model = SkeletonModel.of(names, slots)
    return _truth(path, np.array(times), positions, orientations, model, tuple(people))


_Table = dict[tuple[float, int, Any], list[float]]
"""Numbers by time, person, and marker or ends of the link."""


def _read_tables(path: Path) -> tuple[_Table, _Table]:
    """Return the positions of markers and the orientations of links in a CSV file."""
    table = read_table(path, may_be_short=True)
    columns = set(table.columns)
    needed = {"time", "marker", "x", "y", "z"}
    if columns & {*_LINK, *_QUATERNION}:
        needed |= {*_LINK, *_QUATERNION}
    if missing := needed - columns:
        raise ConfigError(
            f"{path}: line 1: no column {', '.join(sorted(missing))} "
            f"(there are: {', '.join(table.columns)})"
        )
    seconds = table.unit(["time"], SECONDS) or "s"
    metres = METRES[table.unit("xyz", METRES) or "m"]
    joints: _Table = {}
    links: _Table = {}
    for where, row in table.rows:
        stamp = seconds_of(row["time"], where, seconds)
        person = number_of(row.get("person") or "0", where)
        if math.isnan(stamp) or not person.is_integer():
            raise ConfigError(f"{where}: time and person must be numbers")
        marker, parent, child = (row.get(c) or "" for c in ("marker", *_LINK))
        if bool(marker) == bool(parent or child) or bool(parent) != bool(child):
            raise ConfigError(f"{where}: needs either a marker, or the parent and child of a link")
        name = marker or f"link {parent} to {child}"
        found, numbers = (joints, "xyz") if marker else (links, _QUATERNION)
        key = stamp, int(person), marker or (parent, child)
        if key in found:
            raise ConfigError(f"{where}: {name} twice at {stamp} s")
        values = [number_of(row[column], where) for column in numbers]
        found[key] = [metres * v for v in values] if marker else _unit_quaternion(values, where)
    return joints, links


def _unit_quaternion(xyzw: list[float], where: str) -> list[float]:
    length = math.hypot(*xyzw)
    if not abs(length - 1.0) <= _UNIT_LENGTH:  # nan, too
        raise ConfigError(f"{where}: the quaternion has the length {length:.3g}, not 1")
    return [q / length for q in xyzw]


def _truth(
    path: Path,
    times: Floats,
    positions: Floats,
    orientations: Floats,
    model: SkeletonModel,
    people: tuple[int, ...],
) -> Truth:
    if len(set(model.marker_names)) < model.n_markers:
        raise ConfigError(f"{path}: a marker is named twice")
    if len(times) < 2 or not (np.diff(times) > 0).all():
        raise ConfigError(f"{path}: needs at least two increasing times")
    if np.abs(times).max() > _LAST_TIME:
        raise ConfigError(f"{path}: a time is beyond {_LAST_TIME:g} s; times are seconds")
    if (step := float(np.median(np.diff(times)))) > MAX_GAP_NS / 1e9:
        raise ConfigError(
            f"{path}: the instants are {step:g} s apart, more than {MAX_GAP_NS / 1e9:g} s; times "
            "are seconds, neither milliseconds nor numbers of frames"
        )
    positions, notes = _without_zeros(path, positions, model.marker_names)
    _check_unit(path, positions)
    stamps = np.rint(times * 1e9).astype(np.int64)
    return Truth(stamps, positions, orientations, people, model, from_begin=True, notes=notes)


def _without_zeros(
    path: Path, positions: Floats, names: Sequence[str]
) -> tuple[Floats, tuple[str, ...]]:
    """Return positions (T, N, M, 3) with NaN in place of 0 0 0, and a note of how often that was.

    Programs write 0 0 0 for a joint that they do not know. A pelvis that is there whenever its
    person is, is meant: the positions count from it.
    """
    zeros = (positions == 0.0).all(axis=-1)
    is_there = (~zeros & ~np.isnan(positions).any(axis=-1)).any(axis=-1)
    roots = [m for m, joint in enumerate(joints_of(names)) if joint == _ROOT]
    relative = [m for m in roots if is_there.any() and zeros[is_there][:, m].all()]
    zeros[:, :, relative] = False
    counts = zeros[is_there].sum(axis=0)
    text = zeros_in_words(Counter(dict(zip(names, counts.tolist(), strict=True))), is_there.sum())
    notes = (f"{path}: {text}",) if text else ()
    return np.where(zeros[..., None], np.nan, positions), notes


def _check_unit(path: Path, positions: Floats) -> None:
    """Refuse people (T, N, M, 3) who are far too large or too small to be in metres."""
    unknown = np.isnan(positions).any(axis=-1, keepdims=True)
    enough = (~unknown).sum(axis=(-2, -1)) >= _ENOUGH_MARKERS
    people = np.where(unknown, np.nan, positions)[enough]
    if not len(people):
        return
    is_mocap = has_markers(path)
    size = float(np.median((np.nanmax(people, axis=1) - np.nanmin(people, axis=1)).max(axis=-1)))
    if size > _LARGEST_M:
        unit = "millimetres" if size > 30 * _LARGEST_M else "centimetres"
        raise ConfigError(
            f"{path}: its people measure {size:.4g} m; the coordinates look like {unit}. "
            f"{'Correct the unit in the file' if is_mocap else 'Convert them to metres'}"
        )
    if 0 < size < _SMALLEST_M and positions.shape[2] > _ENOUGH_MARKERS:
        raise ConfigError(f"{path}: its people measure {size:.2g} m; is the unit right?")
