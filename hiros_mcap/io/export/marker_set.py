"""Markers under the names of a musculoskeletal model, so that its inverse kinematics finds them.

A marker set is a TOML file of our names and theirs::

    SHOULDER_LEFT = "LSJC"
    KNEE_LEFT = "LKJC"

Markers that it does not name are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hiros_mcap.body.symmetry import split_side
from hiros_mcap.errors import ConfigError
from hiros_mcap.outside import read_toml
from hiros_mcap.skeletons import SkeletonModel

if TYPE_CHECKING:
    from hiros_mcap.io.result import Result

RAJAGOPAL = {
    (part, side): f"{side[0].upper()}{letter}JC"
    for part, letter in (
        ("shoulder", "S"),
        ("elbow", "E"),
        ("hip", "H"),
        ("knee", "K"),
        ("ankle", "A"),
    )
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
