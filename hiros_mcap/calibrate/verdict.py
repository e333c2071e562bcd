"""Whether a pose that was found can be trusted, and why not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["good", "improved", "doubtful", "impossible"]

LEAST_SHARE = 0.85
"""Of the skeletons that two cameras share, so many fit if their poses are right."""
WRONG_M = 0.12
"""Median distance of the same person in two cameras: 1 to 7 cm if poses are right, 14 to 21 cm if
they are not."""
UNCERTAIN_DEG = 0.7
"""Largest standard error of a pose that is believed."""
HALVES_ERRORS, HALVES_DEG = 4.2, 0.3
"""The halves of a log may differ by so many standard errors and degrees."""
SHORT_S = 8.0
NARROW_M = 0.25
MOVED = 2.0
"""A pose differs from the log's if it does so by this many standard errors."""

NO_VIEW = "sees nobody"
UNLINKED = "shares no view of the same people with the other cameras"


@dataclass(frozen=True, slots=True)
class Evidence:
    """What speaks for the pose of one camera."""

    share: float
    """Share of the skeletons in common with other cameras that fit."""
    residual: float
    """Median distance, m, of a person in this camera and in others."""
    rival: bool
    """Whether a quite different pose explains the data nearly as well."""
    error_deg: float
    """Standard error of the orientation, degrees."""
    halves_deg: float
    """Difference of the orientations found in each half of the log, degrees; NaN if not known."""
    seconds: float
    """Common view with other cameras, s."""
    spread: float
    """How far the people move about in it: the square root of their variance, m."""


def judge(evidence: Evidence, *, moved: bool) -> tuple[Verdict, str]:
    """Return the verdict on a camera, and what is wrong.

    Parameters
    ----------
    moved : whether the log has a pose for it from which the one found differs significantly.
    """
    fault = _fault(evidence)
    if fault:
        return "impossible", fault
    doubt = _doubt(evidence)
    if doubt:
        return "doubtful", doubt
    return ("improved" if moved else "good"), ""


def _fault(e: Evidence) -> str:
    """Why there is no pose."""
    if e.share < LEAST_SHARE:
        return f"only {e.share:.0%} of what it shares with other cameras fits"
    if e.residual > WRONG_M:
        return f"its people are {100 * e.residual:.0f} cm from the other cameras' people"
    if e.rival:
        return "a quite different pose fits nearly as well"
    if e.error_deg > UNCERTAIN_DEG:
        return f"the standard error is {e.error_deg:.1f} degrees"
    if e.halves_deg > HALVES_ERRORS * e.error_deg + HALVES_DEG:
        return f"the halves of the log differ by {e.halves_deg:.1f} degrees"
    return ""


def _doubt(e: Evidence) -> str:
    """Why a pose may be wrong although nothing speaks against it."""
    if e.seconds < SHORT_S:
        return f"only {e.seconds:.0f} s of common view"
    if e.spread < NARROW_M:
        return f"people moved about by {e.spread:.1f} m only"
    return ""


def remedy(camera: str, n_cameras: int) -> str:
    """Return what to record."""
    other = "the other camera" if n_cameras == 2 else "another camera"
    return f"record 20 s of somebody walking about in view of {camera} and {other}"
