"""How far two results may differ before a check fails."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Self

from pydantic import ConfigDict, Field, NonNegativeFloat, ValidationError, model_validator

from hiros_mcap.errors import ConfigError
from hiros_mcap.outside import read_toml
from hiros_mcap.params import Params, explain
from hiros_mcap.regression.quantities import QUANTITIES, Quantity

SUFFIX = ".tolerances.toml"


LIMITS = {quantity.limit: quantity.tolerance for quantity in QUANTITIES}


class Tolerances(Params):
    """Differences that do not count: of :data:`QUANTITIES` by the names of their limits, and these.

    If a change is meant to alter the numbers, compare metrics instead: give the suite a golden file
    of metrics (``.json``) or thresholds.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, NonNegativeFloat]

    lengths: NonNegativeFloat = Field(1e-6, description="m, of a calibrated limb.")
    frames: NonNegativeFloat = Field(0.0, le=1, description="Share of frames that may be missing.")
    people: NonNegativeFloat = Field(
        0.0, le=1, description="Share of a channel's skeletons that may be missing, new or renamed."
    )
    metrics: NonNegativeFloat = Field(
        0.05, description="Share by which a metric may get worse; counts may not at all."
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in self.__pydantic_extra__.keys() - LIMITS:
            raise ValueError(f"{name}: there is no such key")
        if not math.isfinite(self.limit("times")):
            raise ValueError("times: should be a finite number")
        return self

    def limit(self, name: str) -> float:
        """Return a limit of :data:`LIMITS`."""
        return self.__pydantic_extra__.get(name, LIMITS[name])

    def of(self, quantity: Quantity) -> float:
        """Return the largest distance that does not count."""
        return self.limit(quantity.limit)


def load_tolerances(path: Path) -> Tolerances:
    """Read tolerances from a TOML file.

    Raises ConfigError if the file cannot be read, or holds something else.
    """
    return validated(read_toml(path), str(path))


def validated(table: dict[str, Any], origin: str) -> Tolerances:
    """Return the tolerances of a table; ``origin`` names it in errors."""
    try:
        return Tolerances.model_validate(table)
    except ValidationError as error:
        where, message = explain(error)
        raise ConfigError(": ".join([origin, *filter(None, [".".join(where)]), message])) from None


def beside(golden: Path) -> Tolerances:
    """Tolerances from ``GOLDEN.tolerances.toml`` (its suffix replaced), else the defaults."""
    path = golden.with_suffix(SUFFIX)
    return load_tolerances(path) if path.is_file() else Tolerances()
