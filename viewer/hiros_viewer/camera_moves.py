"""``hiros view --calibration``: where cameras were by the log, and where they are by a file."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.log import Log, open_log

# What `hiros calibrate` writes: the verdict and the standard errors of a camera are a comment.
_REMARK = re.compile(r"^\[\[camera\]\][ \t]*#[ \t]*(.+)\r?\nframe = (\".*\")", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class CameraMove:
    """One camera's poses in the fixed frame."""

    name: str
    before: Rigid | None
    """By the log's transforms; None if it has none."""
    after: Rigid
    """By the file."""
    remark: str
    """What the file says about it: verdict, standard errors; "" if it says nothing."""

    def row(self) -> tuple[str, ...]:
        """Return name, how far it moved and turned, and the remark, as text."""
        if self.before is None:
            return self.name, "-", "-", self.remark
        moved = 1000 * float(np.linalg.norm(self.after.translation - self.before.translation))
        cosine = min(1.0, abs(float(self.after.xyzw @ self.before.xyzw)))
        return (
            self.name,
            f"{moved:.0f} mm",
            f"{np.degrees(2 * np.arccos(cosine)):.2f}°",
            self.remark,
        )


def camera_moves(path: Path, file: Path, after: Mapping[str, Rigid]) -> list[CameraMove]:
    """Compare the poses of a log's cameras with those of a file, ``after`` by frame.

    Raises LogError if the log cannot be read.
    """
    with open_log(path, topics=["*"], output_prefix="/none") as log:
        before = {frame: pose for frame in after if (pose := _pose(log, frame)) is not None}
    remarks = {
        json.loads(frame): remark for remark, frame in _REMARK.findall(file.read_text("utf-8"))
    }
    return [
        CameraMove(frame, before.get(frame), pose, remarks.get(frame, ""))
        for frame, pose in after.items()
    ]


def _pose(log: Log, frame: str) -> Rigid | None:
    """Return where a camera is by the log's own transforms, None if they do not tell."""
    try:
        return log.transforms.at_rest(frame, log.fixed_frame)
    except (LogError, ConfigError):
        return None


def move_table(moves: Sequence[CameraMove]) -> str:
    """Return the poses before and after as Markdown."""
    header = ["camera", "moved", "turned", "the file says"]
    lines = [header, ["---"] * len(header), *(move.row() for move in moves)]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{table}\n\nGrey cameras: where the log has them. Coloured: where the file has them."
