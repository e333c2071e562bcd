"""A result as a file of another program: tables, biomechanics and animation.

Its markers may have the names of a musculoskeletal model, so that its inverse kinematics finds
them. A marker set is a TOML file of our names and theirs::

    SHOULDER_LEFT = "LSJC"
    KNEE_LEFT = "LKJC"

Markers that it does not name are left out.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.body.symmetry import split_side
from hiros_mcap.defaults import LEAST_CONFIDENCE
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.export import biomechanics, tables
from hiros_mcap.io.export.tables import Parts, Warn
from hiros_mcap.io.result import safe_name
from hiros_mcap.outputs import replacing
from hiros_mcap.outside import read_toml
from hiros_mcap.skeletons import SkeletonModel

if TYPE_CHECKING:
    from hiros_mcap.io.result import Result

WHAT = ("joints", "angles", "both")


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """A kind of file."""

    write: Callable[[Result, Path, Parts, Warn], None]
    """Writes the parts "joints" and "angles" of a result."""
    parts: Parts = ("joints", "angles")
    """Parts that it can hold; the first is the default."""
    one_person: bool = False  # whether it holds one person only
    steady: bool = False  # whether its instants must have a fixed rate


FORMATS = {
    ".csv": ExportFormat(tables.write_csv),
    ".parquet": ExportFormat(tables.write_parquet),
    ".jsonl": ExportFormat(tables.write_jsonl),
    ".trc": ExportFormat(biomechanics.write_trc, ("joints",), one_person=True, steady=True),
    ".mot": ExportFormat(biomechanics.write_mot, ("angles",), one_person=True, steady=True),
    ".c3d": ExportFormat(biomechanics.write_c3d, steady=True),
    ".bvh": ExportFormat(biomechanics.write_bvh, ("joints",), one_person=True, steady=True),
}
"""Suffix -> kind of file."""


def format_of(target: Path) -> ExportFormat:
    """Return the kind of file that a name asks for.

    Raises ConfigError if there is none with this suffix.
    """
    chosen = FORMATS.get(target.suffix.lower())
    if chosen is None:
        raise ConfigError(f"{target}: ends in none of {', '.join(FORMATS)}")
    return chosen


def export(
    result: Result,
    target: str | os.PathLike[str],
    what: str = "",
    least_confidence: float = LEAST_CONFIDENCE,
    *,
    warn: Warn = warnings.warn,
) -> list[Path]:
    """Write a result in the format of the target's suffix.

    A format for one person gets a file per person, ``NAME.0.trc``, unless there is just one.
    Formats with a fixed rate get the result's own median rate, unless it was resampled before.

    Parameters
    ----------
    result : what to write. target : the file.
    what : "joints", "angles" or "both"; "" is whatever the format holds.
    least_confidence : markers below it are gaps; 0 writes them all.
    warn : is called with what a file lacks or bridges; by default Python's own warning.

    Returns
    -------
    The files, in the order of the ids.

    Raises
    ------
    ConfigError
        The format does not exist or cannot hold this, or nobody is in the result.
    LogError
        A file cannot be written.
    """
    if not result.motions:
        raise ConfigError(f"{result.path}: {result.channel} holds no people")
    path = Path(target)
    kind, parts = format_of(path), _parts_of(path, what)
    result = _prepared(result, least_confidence)
    result = steady(result) if kind.steady else result
    files = files_of(path, result.people)
    each = [result] if len(files) == 1 else [result.select(p) for p in result.people]
    with ExitStack() as together:  # the files get their names when all are written
        for one, file in zip(each, files, strict=True):
            named = replace(one, path=file)  # a header names the file itself
            kind.write(named, together.enter_context(replacing(file)), parts, warn)
    return files


def _parts_of(target: Path, what: str) -> Parts:
    """Return the parts of a result that a file gets; raises ConfigError if it cannot hold one."""
    kind = format_of(target)
    if what not in ("", *WHAT):
        raise ConfigError(f"{what!r} is none of {', '.join(WHAT)}")
    parts = {"": kind.parts, "both": ("joints", "angles")}.get(what, (what,))
    lacking = [part for part in parts if part not in kind.parts]
    if lacking:
        raise ConfigError(f"{target}: {target.suffix} holds no {lacking[0]}")
    return parts


def _prepared(result: Result, least_confidence: float) -> Result:
    """Return a result with gaps where it is uncertain, and marker names that fit into a cell."""
    names = tuple(map(safe_name, result.model.marker_names))
    model = replace(result.model, marker_names=names)
    return replace(result.trusted(least_confidence), model=model)


def files_of(target: Path, people: tuple[int, ...]) -> list[Path]:
    """Return the names of the files that a target stands for, one per person if needed."""
    if not format_of(target).one_person or len(people) == 1:
        return [target]
    return [target.with_suffix(f".{person}{target.suffix}") for person in people]


def steady(result: Result) -> Result:
    """Return a result at a fixed rate: its own, rounded to whole Hz, if it is not fixed yet."""
    steps = np.concatenate([np.diff(m.times) for m in result.motions.values()])
    if not len(steps):
        raise ConfigError(f"{result.path}: a single frame has no rate; choose another format")
    step = float(np.median(steps))
    if np.ptp(steps) < 1e-6 and step > 0:
        return result
    return result.select(rate=max(1.0, float(np.round(1.0 / max(step, 1e-3)))))


RAJAGOPAL = {
    (part, side): f"{side[0]}{part[0]}JC".upper()
    for part in ("shoulder", "elbow", "hip", "knee", "ankle")
    for side in ("left", "right")
}
"""The joint centres among the markers of OpenSim's model of Rajagopal et al. (IEEE TBME 63, 2016).

The model has no marker at the centre of a wrist, and its others lie on the skin, where no detector
of skeletons looks.
"""
BUILT_IN = "rajagopal"

SUFFIXES = (".trc", ".c3d")
"""Formats whose markers can have other names."""


def load_marker_set(name: str, model: SkeletonModel) -> dict[str, str]:
    """Return our name -> theirs, of the built-in set or of a TOML file.

    Raises
    ------
    ConfigError
        There is no such file, it is no marker set, or it names a marker that the log lacks.
    """
    if name == BUILT_IN:
        ours = {split_side(marker): marker for marker in model.marker_names}
        names = {ours[key]: theirs for key, theirs in RAJAGOPAL.items() if key in ours}
        if not names:
            raise ConfigError("the marker names reveal no joint of the marker set rajagopal")
        return names
    path = Path(name)
    try:
        path.stat()
    except FileNotFoundError:
        raise ConfigError(f"{name!r} is neither a file nor the marker set {BUILT_IN}") from None
    return _checked(path, read_toml(path), model)


def _checked(path: Path, table: Mapping[str, object], model: SkeletonModel) -> dict[str, str]:
    names = {ours: theirs for ours, theirs in table.items() if isinstance(theirs, str) and theirs}
    for ours in table:
        if ours not in names:
            raise ConfigError(f'{path}: {ours} has no name of the form {ours} = "NAME"')
        if ours not in model.marker_names:
            listed = ", ".join(model.marker_names)
            raise ConfigError(f"{path}: the log has no marker {ours} (there are: {listed})")
    if not names:
        raise ConfigError(f"{path}: names no marker")
    if len(set(names.values())) < len(names):
        raise ConfigError(f"{path}: gives two markers the same name")
    return names


def renamed(result: Result, names: Mapping[str, str]) -> Result:
    """Return the named markers alone, under their other names; without links."""
    slots = [result.model.marker_names.index(ours) for ours in names]
    motions = {
        person: replace(
            motion,
            positions=motion.positions[:, slots],
            confidences=motion.confidences[:, slots],
            deviations=None if motion.deviations is None else motion.deviations[:, slots],
            orientations=None,
            axes={},
        )
        for person, motion in result.motions.items()
    }
    return replace(result, model=SkeletonModel.of(names.values(), ()), motions=motions)
