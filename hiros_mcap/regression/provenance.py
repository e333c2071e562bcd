"""How a result came about: version, system, input and parameters; and what of it changed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hiros_mcap.config import without_constants
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.channels import PROVENANCE
from hiros_mcap.io.log import open_reader
from hiros_mcap.io.result import stored_parameters
from hiros_mcap.regression.differences import Difference

_RUN = {
    "system": "system",
    "stages": "stages",
    "fixed_frame": "fixed frame",
    "topics": "topics",
    "extrinsics_sha256": "extrinsics file, SHA-256",
    "limbs_sha256": "limb lengths file, SHA-256",
    "version": "hiros version",
    "input_sha256": "input, SHA-256",
}
"""Key of the metadata -> what reports call it, in their order."""
_NONE = "none"


@dataclass(frozen=True, slots=True)
class Provenance:
    """What a result was made from, and how."""

    run: Mapping[str, str] = field(default_factory=dict)
    """Version, system, stages, hash of the input, ..., as the metadata have them."""
    parameters: Mapping[str, str] = field(default_factory=dict)
    """``stage.param`` -> its value as text; what is not set is left out."""

    def __bool__(self) -> bool:
        """Whether anything is known; golden files of former versions tell nothing."""
        return bool(self.run or self.parameters)

    @classmethod
    def of_log(cls, path: str | os.PathLike[str]) -> Provenance:
        """Read what a log that hiros wrote says; raises LogError if it is damaged."""
        with open_reader(path) as reader:
            run = dict(reader.contents.metadata).get(PROVENANCE, {})
            parameters = stored_parameters(reader)
        return cls({name: value for name, value in run.items() if name in _RUN}, parameters)

    @classmethod
    def from_json(cls, data: object, path: Path) -> Provenance:
        """Read what :meth:`to_json` gives; None is nothing.

        Raises ConfigError if it is something else.
        """
        tables = data if isinstance(data, dict) else {} if data is None else {"": None}
        if not set(tables) <= {"run", "parameters"} or not all(
            isinstance(table, dict) and all(isinstance(text, str) for text in table.values())
            for table in tables.values()
        ):
            raise ConfigError(f"{path}: provenance: is not what hiros check writes")
        return cls(**tables)

    def to_json(self) -> dict[str, Any]:
        """Plain data, a line for each parameter."""
        return asdict(self)


def changes(now: Provenance, was: Provenance) -> list[Difference]:
    """Return what changed, parameters first; nothing if the golden file does not tell."""
    if not was:
        return []
    if not now:
        return [Difference("run", "version and configuration", "known", _NONE)]
    former, new = map(without_constants, (was.parameters, now.parameters))
    rows = [("configuration", k, former.get(k), new.get(k)) for k in dict.fromkeys([*former, *new])]
    rows += [("run", name, was.run.get(key), now.run.get(key)) for key, name in _RUN.items()]
    return [
        Difference(
            where, what, _NONE if before is None else before, _NONE if after is None else after
        )
        for where, what, before, after in rows
        if before != after
    ]
