"""Whether a pose that was found can be trusted, and why not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["good", "improved", "doubtful", "impossible"]
SURE = ("good", "improved")
"""Verdicts on what can be used."""

LEAST_SHARE = 0.85
"""Of the skeletons that two cameras share, so many fit if their poses are right."""
WRONG_M = 0.12
"""Median distance of the same person in two cameras: 1 to 7 cm if poses are right, 14 to 21 cm if
they are not."""
UNCERTAIN_DEG = 0.7
"""Largest standard error of a pose that is believed."""
HALVES_ERRORS, HALVES_DEG = 4.2, 0.3
"""The halves of a log may differ by so many standard errors and degrees."""
OTHER_SIZE = 0.01
"""The same person is of the same size to a hundredth, in seven of eight real logs, too."""
WANDER_M = 0.033
"""The middle of a body averages over the joints' errors: 1 cm simulated, 1 to 3 cm in reality."""
OTHER_LIMBS = 0.3
"""0.45 to 0.95 for the same person."""
REGULAR_M = 2.0 * WANDER_M
"""Motion that repeats itself so closely would let a stranger pass the test of the middles."""
OTHER_PATH = 0.15
"""Paths then may differ by so much of the distance at which the motion repeats itself."""
COMPANY = 1.5
"""A stranger for each of two people at the same lag would be a coincidence."""
LATE_S = 0.3
"""Strangers who walk alike are rarely in step; stamps that are right to this show that."""
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
    seconds: float
    """Common view with other cameras, s."""
    spread: float
    """How far the people spread in it: the square root of their variance, m."""
    size: float = 1.0
    """Size of the people in this camera against the others."""
    wander: float = 0.0
    """Distance of the bodies' middles in this camera and in the others, m."""
    limbs: float = 1.0
    """Correlation of the limbs' motion with that in the other cameras; 1 if nobody moves."""
    path: float = 0.0
    """Distance of the people's paths from those in the others, beyond the joints' errors, m."""
    repetition: float = float("inf")
    """How closely the people's motion fits itself at another time, m."""
    people: float = 1.0
    """How many people it shares with other cameras at a time."""
    late: float = 0.0
    """How much its clock differs from the other cameras', s."""
    rival: bool = False
    """Whether a quite different pose explains the data nearly as well."""
    error_deg: float = 0.0
    """Standard error of the orientation, degrees."""
    halves_deg: float = 0.0
    """Difference of the orientations found in each half of the log, degrees."""


def judge(evidence: Evidence, *, moved: bool) -> tuple[Verdict, str]:
    """Return the verdict on a camera, and what is wrong.

    Parameters
    ----------
    moved : whether the log has a pose for it from which the one found differs significantly.
    """
    reason = fault(evidence)
    if reason:
        return "impossible", reason
    doubt = _doubt(evidence)
    if doubt:
        return "doubtful", doubt
    return ("improved" if moved else "good"), ""


def misfit(e: Evidence) -> str:
    """Return why a camera does not see the people where the others see them; "" if it does."""
    if e.share < LEAST_SHARE:
        return f"only {e.share:.0%} of what it shares with other cameras fits"
    if e.residual > WRONG_M:
        return f"its people are {100 * e.residual:.0f} cm from the other cameras' people"
    return ""


def fault(e: Evidence) -> str:
    """Return why there is no pose; "" if there is one."""
    if misfit(e):
        return misfit(e)
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
    if abs(e.size - 1.0) > OTHER_SIZE:
        return f"its people are {abs(e.size - 1.0):.1%} of another size than in other cameras"
    if e.wander > WANDER_M:
        return f"its people's bodies are {100 * e.wander:.0f} cm from those in other cameras"
    if e.repetition < REGULAR_M and e.path > OTHER_PATH * e.repetition:
        return "its people walk as regularly as strangers might, and not quite as in other cameras"
    if e.repetition < REGULAR_M and e.people < COMPANY and e.late > LATE_S:
        return (
            f"its clock would be off by {e.late:.1f} s, and its people walk so regularly that "
            "strangers might fit; let them change pace and direction"
        )
    if e.limbs < OTHER_LIMBS:
        return "its people's limbs move differently than in other cameras"
    if e.spread < NARROW_M:
        return f"people spread by {e.spread:.1f} m only"
    return ""


def remedy(camera: str, n_cameras: int) -> str:
    """Return what to record."""
    other = "the other camera" if n_cameras == 2 else "another camera"
    return f"record 20 s of somebody walking about in view of {camera} and {other}"
