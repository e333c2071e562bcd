"""What every calibration tells about a camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.calibrate.verdict import Verdict
from hiros_mcap.summary import plain

NAN = float("nan")


@dataclass(frozen=True, slots=True)
class CameraResult:
    """One camera: its pose, how sure it is, and why it may be wrong."""

    name: str
    frame: str
    """Coordinate frame of its detections or images."""
    verdict: Verdict = "good"
    reason: str = ""
    """Why it is doubtful or impossible, "" otherwise."""
    pose: Rigid | None = None
    """In the fixed frame."""
    clock_s: float = NAN
    """s to add to its stamps; NaN if that is not known: keep the log's stamps."""
    error_deg: float = NAN
    """Standard error of the orientation, degrees; NaN where nothing tells it."""
    error_mm: float = NAN
    """The same of the position."""
    residual_mm: float = NAN
    """How far what it sees is from what the others see."""

    def to_dict(self, parent: str) -> dict[str, Any]:
        """Plain data for JSON; numbers that are not known are None. ``parent`` has the pose."""
        data: dict[str, Any] = plain(replace(self, pose=None))
        del data["pose"]
        if self.pose is not None:
            data |= {
                "translation": self.pose.translation.tolist(),
                "quaternion_xyzw": self.pose.xyzw.tolist(),
            }
        return data | {"parent": parent}
