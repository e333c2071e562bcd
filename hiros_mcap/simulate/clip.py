"""Recorded motion: joints over time, and what the readers of motion files share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.skeletons import Floats

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

MAX_BYTES = 1 << 28
Y_UP_TO_Z_UP: Floats = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Motion files have y up."""


@dataclass(frozen=True, slots=True)
class Clip:
    """Joints over time."""

    joints: Mapping[str, Floats]
    """Name -> (F, 3), z up, any unit."""
    rate: float
    """Frames per second."""

    @property
    def frames(self) -> int:
        """F."""
        return len(next(iter(self.joints.values())))


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the stripped lines of a text file with their numbers.

    Raises ConfigError if the file is too large or no text.
    """
    if path.stat().st_size > MAX_BYTES:
        raise ConfigError(f"{path}: larger than {MAX_BYTES} bytes")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        text = path.read_text(encoding="latin-1")
    if "\0" in text:
        raise ConfigError(f"{path}: not a text file")
    for number, line in enumerate(text.splitlines(), start=1):
        yield number, line.strip()


def euler(angles: Floats, axes: str) -> Rotation:
    """Product of rotations about ``axes``, the first letter leftmost; angles (n, k), rad."""
    from scipy.spatial.transform import Rotation

    result = Rotation.identity(len(angles))
    for k, axis in enumerate(axes):  # one by one: a file may name any number of axes, any twice
        result = result * Rotation.from_euler(axis, angles[:, k : k + 1])
    return result
