"""What is known of a camera: its pose and clock, how sure they are, and why they may be wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.calibrate.verdict import (
    ACCEPTABLE,
    NO_VIEW,
    SURE,
    UNLINKED,
    USABLE,
    Evidence,
    Verdict,
    remedy,
    weakness_of,
)
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
        for name in ("pose", "evidence"):
            data.pop(name, None)
        if self.pose is not None:
            data |= {
                "translation": self.pose.translation.tolist(),
                "quaternion_xyzw": self.pose.xyzw.tolist(),
            }
        return data | {"parent": parent}


@dataclass(frozen=True, slots=True)
class CalibratedCamera(CameraResult):
    """What the people tell about one camera.

    Where they tell no pose, or no better one, it is the log's, if it has one. The clock is NaN if
    no motion tells it. Errors are those against the first camera, its own the largest of the
    others. The residual is the median distance of its joints to the mean of the other cameras'.
    """

    verdict: Verdict = "impossible"
    drift_ppm: float = 0.0
    """How fast the clock's offset grows, from the middle of the log; 0 in logs of less than two
    minutes."""
    error_ms: float = NAN
    """Standard error of the clock."""
    seconds: float = 0.0
    """s in which another camera sees the same people."""
    moved_deg: float = NAN
    """Difference from the log's pose; NaN if that stays, or there is none."""
    moved_mm: float = NAN
    since_s: float = NAN
    """When it was moved to this pose, s from the log's start; NaN if it always stood there."""
    until_s: float = NAN
    """When it was moved away from this pose; such a camera is listed twice."""
    since: int = 0
    """The first of both as a log time, ns; 0 if it always stood there."""
    partner: str = ""
    """The camera with which it has most in common."""
    evidence: Evidence | None = None
    """What the verdict is from."""

    @property
    def acceptable(self) -> bool:
        """Whether a user may accept the pose: it is sure, or doubtful but consistent."""
        if self.verdict in SURE:
            return True
        found = self.evidence
        if self.pose is None or found is None or self.reason != weakness_of(found, USABLE):
            return False
        return not weakness_of(found, ACCEPTABLE)

    @property
    def fits(self) -> bool:
        """False if its people are not where the other cameras see them, whatever pose it gets."""
        return self.verdict != "impossible" or self.reason in (NO_VIEW, UNLINKED)

    @property
    def uncertainty(self) -> float:
        """Standard error of the orientation, degrees; 0 where nothing tells it."""
        return 0.0 if math.isnan(self.error_deg) else self.error_deg

    @property
    def remedy(self) -> str:
        """What to record for a better pose."""
        return remedy(self.name, self.partner, self.seconds, self.error_deg)
