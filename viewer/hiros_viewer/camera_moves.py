"""``hiros view --calibration``: where cameras were by the log, and where they are by a file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import CameraEntry, read_camera_entries
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.log import Log, open_log

_HEADER = ("camera", "moved", "turned", "verdict", "standard error", "residual")


@dataclass(frozen=True, slots=True)
class CameraMove:
    """A camera's pose before and after a calibration, or before and after somebody moved it."""

    name: str
    before: Rigid | None  # by the log's transforms; None if it has none
    after: Rigid  # by the file
    entry: CameraEntry  # the file's entry of the pose ``after``
    since_s: float = 0.0
    """Seconds from the log's start at which the camera was moved there; 0 = at once."""

    def row(self) -> tuple[str, ...]:
        """Return name, how far it moved and turned, and what the file says, as text."""
        name = f"{self.name}, from {self.since_s:.1f} s on" if self.since_s else self.name
        return name, *self._difference(), *_columns_of(self.entry)

    def _difference(self) -> tuple[str, str]:
        if self.before is None:
            return "-", "-"
        moved = 1000 * float(np.linalg.norm(self.after.translation - self.before.translation))
        cosine = min(1.0, abs(float(self.after.xyzw @ self.before.xyzw)))
        return f"{moved:.0f} mm", f"{np.degrees(2 * np.arccos(cosine)):.2f}°"


def _columns_of(entry: CameraEntry) -> tuple[str, str, str]:
    """Return verdict, standard errors and residual; "-" where the file has none."""
    verdict = f"{entry.verdict} ({entry.reason})" if entry.reason else entry.verdict
    degrees, error, residual = entry.errors
    errors = "-" if not math.isfinite(degrees + error) else f"{degrees:.2f}°, {error:.0f} mm"
    return verdict or "-", errors, "-" if math.isnan(residual) else f"{residual:.0f} mm"


def camera_moves(
    path: Path, file: Path, after: Mapping[str, Rigid], renamed: Mapping[str, str]
) -> list[CameraMove]:
    """Compare the poses of a log's cameras with those of a file, ``after`` by frame.

    ``renamed`` are the frames of the log that the file calls otherwise, by their names in the file.

    A camera that was moved in the middle of the log has a second row, with the file's first pose
    as the one before.

    Raises LogError if the log cannot be read, ConfigError if the file cannot.
    """
    with open_log(path, topics=["*"], output_prefix="/none") as log:
        before = {frame: pose for frame in after if (pose := _pose(log, frame)) is not None}
        start = log.span[0]
    moves: list[CameraMove] = []
    first: dict[str, Rigid] = {}
    for entry in read_camera_entries(file):
        name = entry.frame.lstrip("/")
        name = renamed.get(name, name)
        if name not in after:
            continue
        if entry.since:
            seconds, origin = (entry.since - start) / 1e9, first.get(name)
            moves.append(CameraMove(name, origin, entry.pose, entry, seconds))
        else:
            first[name] = entry.pose
            moves.append(CameraMove(name, before.get(name), after[name], entry))
    return moves


def _pose(log: Log, frame: str) -> Rigid | None:
    """Return where a camera is by the log's own transforms, None if they do not tell."""
    try:
        return log.transforms.at_rest(frame, log.fixed_frame)
    except (LogError, ConfigError):
        return None


def move_table(moves: Sequence[CameraMove]) -> str:
    """Return the poses before and after as Markdown."""
    table = markdown(_HEADER, [move.row() for move in moves])
    return f"{table}\n\nGrey cameras: where the log has them. Coloured: where the file has them."


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
