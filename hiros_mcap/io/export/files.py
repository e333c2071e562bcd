"""A result as a file of another program: tables, biomechanics and animation."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.defaults import LEAST_CONFIDENCE
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.export import animation, biomechanics, opensim_model, tables
from hiros_mcap.io.export.choices import Choices, warn_in_python
from hiros_mcap.io.result import safe_name
from hiros_mcap.outputs import replacing

if TYPE_CHECKING:
    from hiros_mcap.io.result import Result

WHAT = ("joints", "angles", "both")


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """A kind of file."""

    text: str
    """What it is, for a list."""
    write: Callable[[Result, Path, Choices], None]
    """Writes the parts "joints" and "angles" of a result."""
    parts: tuple[str, ...] = ("joints", "angles")
    """What it can hold; the first is the default."""
    one_person: bool = False
    """Whether it holds one person only."""
    steady: bool = False
    """Whether its instants must have a fixed rate."""


_for_one = partial(ExportFormat, parts=("joints",), one_person=True)

FORMATS: dict[str, ExportFormat] = {
    ".csv": ExportFormat("table, a row per person and time", tables.write_csv),
    ".parquet": ExportFormat(
        "the same table for pandas, polars, R and DuckDB",
        tables.write_parquet,
    ),
    ".jsonl": ExportFormat("one JSON object per person and time", tables.write_jsonl),
    ".npz": ExportFormat("numpy arrays", tables.write_npz),
    ".trc": _for_one("markers for OpenSim (mm, y up)", biomechanics.write_trc, steady=True),
    ".mot": _for_one(
        "coordinates of OpenSim's Rajagopal model (degrees, m)",
        biomechanics.write_mot,
        parts=("angles",),
        steady=True,
    ),
    ".osim": _for_one(
        "the person as a model of OpenSim, without muscles", opensim_model.write_osim
    ),
    ".xml": _for_one(
        "setup of OpenSim's inverse kinematics on the .osim and .trc of the same name",
        opensim_model.write_ik_setup,
        steady=True,
    ),
    ".c3d": ExportFormat(
        "markers and angles for motion capture programs (mm, z up)",
        biomechanics.write_c3d,
        steady=True,
    ),
    ".bvh": _for_one(
        "a moving skeleton for Blender and games (cm, y up)", animation.write_bvh, steady=True
    ),
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
    keep_gaps: bool = False,
    mass: float | None = None,
    model: str | os.PathLike[str] | None = None,
    warn: Callable[[str], object] = warn_in_python,
) -> list[Path]:
    """Write a result in the format of the target's suffix.

    A format for one person gets a file per person, ``NAME.0.trc``, unless there is just one.
    Formats with a fixed rate get the result's own median rate, unless it was resampled before.

    Parameters
    ----------
    result : what to write. target : the file. what : "joints", "angles" or "both"; "" is
        whatever the format holds. least_confidence : markers below it are gaps; 0 writes them all.
    keep_gaps : leave out the rows of a MOT file that have gaps, instead of bridging them.
    mass : of the person, kg, for the bodies of a .osim file; without it they have none.
    model : .osim file to scale to the person, instead of writing a model of our own.
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
    target = Path(target)
    kind = format_of(target)
    if what not in ("", *WHAT):
        raise ConfigError(f"{what!r} is none of {', '.join(WHAT)}")
    parts = {"": kind.parts, "both": ("joints", "angles")}.get(what, (what,))
    lacking = [part for part in parts if part not in kind.parts]
    if lacking:
        raise ConfigError(f"{target}: {target.suffix} holds no {lacking[0]}")
    if not result.motions:
        raise ConfigError(f"{result.path}: {result.channel} holds no people")
    if (mass, model) != (None, None) and target.suffix.lower() != ".osim":
        raise ConfigError(f"{target}: mass and model are for .osim files")
    if mass is not None and not 1 <= mass <= 1000:
        raise ConfigError(f"{target}: mass: should be 1 to 1000 kg, is {mass:g}")
    result = _prepared(result, least_confidence)
    if kind.steady:
        result = steady(result)
    choices = Choices(parts, keep_gaps, mass, None if model is None else Path(model), warn)
    targets = files_of(target, result.people)
    each = [result] if len(targets) == 1 else [result.select(p) for p in result.people]
    with ExitStack() as together:  # the files get their names when all are written
        for one, path in zip(each, targets, strict=True):
            named = replace(one, path=path)  # a header names the file itself
            kind.write(named, together.enter_context(replacing(path)), choices)
    return targets


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
