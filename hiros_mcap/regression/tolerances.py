"""How far two results may differ before a check fails."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field, NonNegativeFloat, ValidationError

from hiros_mcap.errors import ConfigError
from hiros_mcap.outside import read_toml
from hiros_mcap.params import Params, explain

SUFFIX = ".tolerances.toml"


class Tolerances(Params):
    """Differences that do not count. The defaults forgive another machine, not another algorithm.

    If a change is meant to alter the numbers, compare metrics instead: give the suite a golden file
    of metrics (``.json``) or thresholds.
    """

    positions: NonNegativeFloat = Field(
        1e-6, description="m, of every joint in every frame (rounding differs between machines)."
    )
    orientations: NonNegativeFloat = Field(
        1e-4,
        description="deg, of every link in every frame (1e-6 m at the end of a limb of 0.5 m).",
    )
    velocities: NonNegativeFloat = Field(1e-4, description="m/s, of every joint.")
    angular_velocities: NonNegativeFloat = Field(1e-2, description="deg/s, of every link.")
    accelerations: NonNegativeFloat = Field(1e-2, description="m/s2, of every joint.")
    angular_accelerations: NonNegativeFloat = Field(1.0, description="deg/s2, of every link.")
    confidences: NonNegativeFloat = Field(
        1e-6, description="Of every skeleton, joint and link; 0 to 1."
    )
    times: NonNegativeFloat = Field(
        1e-6, allow_inf_nan=False, description="s, of a frame, and of its source and log time."
    )
    lengths: NonNegativeFloat = Field(1e-6, description="m, of a calibrated limb.")
    frames: NonNegativeFloat = Field(0.0, le=1, description="Share of frames that may be missing.")
    people: NonNegativeFloat = Field(
        0.0, le=1, description="Share of a channel's skeletons that may be missing, new or renamed."
    )
    metrics: NonNegativeFloat = Field(
        0.05, description="Share by which a metric may get worse; counts may not at all."
    )


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
        raise ConfigError(f"{origin}: {'.'.join(where)}: {message}") from None


def beside(golden: Path) -> Tolerances:
    """Tolerances from ``GOLDEN.tolerances.toml`` (its suffix replaced), else the defaults."""
    path = golden.with_suffix(SUFFIX)
    return load_tolerances(path) if path.is_file() else Tolerances()
