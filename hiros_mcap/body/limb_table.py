"""Limb lengths per person: the calibration finds them, a session saves and the next one loads them.

The file is TOML that people can read and edit::

    [person.0.THIGH_LEFT]
    length = 0.4213      # m
    deviation = 0.0112   # m, of one measurement
    frames = 300
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass as pydantic_dataclass

from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.outputs import LIMBS_MARK, write_text
from hiros_mcap.outside import parse, read_text
from hiros_mcap.params import Params, explain
from hiros_mcap.skeletons import Floats, SkeletonModel


@pydantic_dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class Limb:
    """Length of one link of one person (Hi-ROS 2023, eq 13)."""

    length: Annotated[float, Field(gt=0.0, allow_inf_nan=False, strict=True)]  # nominal length, m
    deviation: Annotated[float, Field(ge=0.0, allow_inf_nan=False, strict=True)] = 0.0
    """Standard deviation of one measurement of it, m."""
    frames: Annotated[int, Field(ge=0, strict=True)] = 0  # number of measurements


class _LimbFile(Params):
    person: dict[Annotated[int, Field(ge=0)], dict[str, Limb]]


@dataclass(slots=True)
class LimbTable:
    """The calibrated people of a session: link names to limbs, per person id."""

    people: dict[int, dict[str, Limb]] = field(default_factory=dict)
    origin: str = "limbs"  # the file's name once loaded, for error messages

    def lengths(self, person: int, model: SkeletonModel) -> Floats:
        """(L,) nominal lengths of a person, m, NaN where a link has none.

        Raises ConfigError if a limb's name is no link of ``model``.
        """
        limbs = self.people.get(person, {})
        keys = link_keys(model)
        unknown = sorted(limbs.keys() - set(keys))
        if unknown:
            raise ConfigError(
                f"{self.origin}: person {person}: this log has no link {unknown[0]!r}"
                f" (its links: {', '.join(keys[:3])}{', ...' * (len(keys) > 3)})"
            )
        return np.array([limbs[key].length if key in limbs else math.nan for key in keys])

    def to_toml(self) -> str:
        """Text of the file, people by id, limbs in the order of the model."""
        import tomli_w

        people = {
            str(person): {name: asdict(limb) for name, limb in limbs.items()}
            for person, limbs in sorted(self.people.items())
        }
        return tomli_w.dumps({"person": people})

    def save(self, path: str | Path) -> None:
        """Write the file, or nothing at all; raises ConfigError if it cannot be written."""
        try:
            write_text(Path(path), LIMBS_MARK + self.to_toml())
        except LogError as error:
            raise ConfigError(str(error)) from error

    @classmethod
    def load(cls, path: str | Path) -> LimbTable:
        """Read a file that :meth:`save` or a person wrote.

        Raises ConfigError that names the file, and the person and link if one is at fault.
        """
        return cls.from_toml(read_text(path), str(path))

    @classmethod
    def from_toml(cls, text: str, origin: str) -> LimbTable:
        """Read what :meth:`to_toml` returns; ``origin`` names it in errors."""
        try:
            people = _LimbFile.model_validate(parse(text, "TOML", origin)).person
        except ValidationError as error:
            where, what = explain(error)
            names = [name for name in where if name != "[key]"]
            raise ConfigError(f"{origin}: {'.'.join(names)}: {what}") from error
        return cls(people, origin)


def link_keys(model: SkeletonModel) -> tuple[str, ...]:
    """Return the names that limbs go by: the link's, or "link ID" if it has none of its own."""
    count = Counter(model.link_names)
    return tuple(
        name if name and count[name] == 1 else f"link {link_id}"
        for name, link_id in zip(model.link_names, model.link_ids, strict=True)
    )
