"""A camera's pose and clock, and whether they can be trusted, or why not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.wording import plain

Verdict = Literal["good", "improved", "usable", "doubtful", "impossible"]
GRADES: tuple[Verdict, ...] = get_args(Verdict)
"""The best first."""
CONFIRMED = ("good", "improved")
SURE = (*CONFIRMED, "usable")
"""Verdicts on what a run uses by itself."""

LEAST_SHARE = 0.85
"""Of the skeletons that two cameras share, so many fit if their poses are right."""
SHARE_VARIANCE, SHARE_ERRORS = LEAST_SHARE * (1.0 - LEAST_SHARE), 2.0
"""Of one skeleton's fitting, where so many do. A measured pose is wrong if a smaller share fits, by
so many standard errors: of the four skeletons that two cameras of a corridor share, one may not."""
WRONG_M = 0.12
"""Median distance of the same person in two cameras: 1 to 7 cm if poses are right, 14 to 21 cm if
they are not."""
HALVES_ERRORS, HALVES_DEG = 4.2, 0.3
"""The halves of a log may differ by so many standard errors and degrees."""
OTHER_LIMBS = 0.3
"""0.45 to 0.95 for the same person."""
REGULAR_M = 0.066
"""Motion that repeats itself so closely would let a stranger pass the test of the middles."""
OTHER_PATH = 0.15
"""Paths then may differ by so much of the distance at which the motion repeats itself."""
COMPANY = 1.5
"""A stranger for each of two people at the same lag would be a coincidence."""
LATE_S = 0.3
"""Strangers who walk alike are rarely in step; stamps that are right to this show that."""
MOVED = 2.0
"""A pose differs from the log's if it does so by this many standard errors."""
LEAST_S, MOST_S = 20.0, 60.0
"""So long a recording is asked for."""

NO_VIEW = "sees nobody"
UNLINKED = "shares no view of the same people with the other cameras"


class Limits(NamedTuple):
    """The limits of a grade: a pose of that grade keeps to all of them."""

    error_deg: float
    error_m: float  # largest standard errors
    seconds: float  # shortest common view
    size: float  # by how much people may differ in size
    wander: float  # largest distance of the bodies' middles, m
    spread: float  # least standard deviation of the places where people are, m


GOOD = Limits(error_deg=0.7, error_m=0.1, seconds=8.0, size=0.01, wander=0.033, spread=0.25)
"""In seven of eight real logs, too, the same person is of the same size to a hundredth. The middle
of a body averages over the joints' errors: 1 cm simulated, 1 to 3 cm in reality."""
USABLE = Limits(error_deg=2.0, error_m=0.1, seconds=5.0, size=0.03, wander=0.045, spread=0.25)
"""Real detectors differ by more, above all seen from the side. People who pass each other may be
2 to 7 % apart in size. Whoever stays in place may be a stranger who does the same, or his own
mirror image: neither size nor posture tells."""

PROVEN = GOOD._replace(seconds=USABLE.seconds)
"""For a pose that fits better than the given one on what it was not estimated on."""

TIMED = USABLE._replace(seconds=2.0)
"""For a clock alone, where poses are known: somebody who walks for a moment shows it to 2 ms."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """The evidence for the pose of one camera."""

    share: float  # share of the skeletons in common with other cameras that fit
    residual: float  # median distance, m, of a person in this camera and in others
    seconds: float  # common view with other cameras, s
    spread: float  # how far the people spread in it: the square root of their variance, m
    share_error: float = 0.0
    """Standard error of the share, if the pose was measured; otherwise nothing excuses it."""
    size: float = 1.0  # size of the people in this camera against the others
    wander: float = 0.0  # distance of the bodies' middles in this camera and in the others, m
    limbs: float = 1.0
    """Correlation of the limbs' motion with that in the other cameras; 1 if nobody moves."""
    path: float = 0.0
    """Distance of the people's paths from those in the others, beyond the joints' errors, m."""
    repetition: float = float("inf")
    """How closely the people's motion fits itself at another time, m."""
    people: float = 1.0  # how many people it shares with other cameras at a time
    late: float = 0.0  # how much its clock differs from the other cameras', s
    rival: bool = False  # whether a quite different pose explains the data nearly as well
    error_deg: float = 0.0  # standard error of the orientation, degrees
    error_m: float = 0.0  # standard error of the position
    halves_deg: float = 0.0  # difference of the orientations found in each half of the log, degrees
    partner: str = ""  # the camera with which it has most in common


def verdict_of(evidence: Evidence, *, moved: bool) -> tuple[Verdict, str]:
    """Return the verdict on a camera, and what is wrong.

    Parameters
    ----------
    moved : whether the log has a pose for it from which the one found differs significantly.
    """
    weakness = weakness_of(evidence, USABLE)
    if weakness:
        return ("impossible" if evidence.residual > WRONG_M else "doubtful"), weakness
    flaw = weakness_of(evidence, GOOD)
    if flaw:
        return "usable", flaw
    return ("improved" if moved else "good"), ""


def misfit(e: Evidence) -> str:
    """Return why a camera does not see the people where the others see them; "" if it does."""
    if e.share + SHARE_ERRORS * e.share_error < LEAST_SHARE:
        return f"only {e.share:.0%} of what it shares with other cameras fits"
    if e.residual > WRONG_M:
        return f"its people are {100 * e.residual:.0f} cm from the other cameras' people"
    return ""


def fault(e: Evidence) -> str:
    """Return what speaks against a pose, "" if nothing does."""
    if misfit(e):
        return misfit(e)
    if e.rival:
        return "a quite different pose fits nearly as well"
    if _uncertain(e, USABLE):
        return _uncertain(e, USABLE)
    if e.halves_deg > HALVES_ERRORS * e.error_deg + HALVES_DEG:
        return f"the halves of the log differ by {e.halves_deg:.1f} degrees"
    return ""


def _uncertain(e: Evidence, limits: Limits) -> str:
    if not math.isfinite(e.error_deg + e.error_m):
        return "the standard error is unknown: a moment or a joint tells all of the pose"
    if e.error_deg > limits.error_deg or e.error_m > limits.error_m:
        return f"the standard error is {e.error_deg:.1f} degrees and {100 * e.error_m:.0f} cm"
    return ""


def weakness_of(e: Evidence, limits: Limits) -> str:
    """Return why a pose may be wrong, "" if it keeps to the limits."""
    if fault(e):
        return fault(e)
    if e.seconds < limits.seconds:
        return f"only {e.seconds:.0f} s of common view"
    if abs(e.size - 1.0) > limits.size:
        return f"its people are {abs(e.size - 1.0):.1%} of another size than in other cameras"
    if e.wander > limits.wander:
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
    if e.spread < limits.spread:
        return f"people spread by {100 * e.spread:.0f} cm only"
    return _uncertain(e, limits)


def remedy(
    camera: str, partner: str = "", seconds: float = 0.0, error_deg: float = math.nan
) -> str:
    """Return what to record; standard errors fall with the square root of the time.

    Parameters
    ----------
    partner : the camera that sees most of the same people; "" = none does.
    seconds, error_deg : common view so far, and the standard error of the orientation from it.
    """
    needed = seconds * (error_deg / GOOD.error_deg) ** 2
    length = 10.0 * math.ceil(min(max(needed, LEAST_S), MOST_S) / 10.0) if needed > 0 else LEAST_S
    return (
        f"record {length:.0f} s of one or two people who walk about over 2 m or more where "
        f"{camera} and {partner or 'another camera'} see them at the same time"
    )


@dataclass(frozen=True, slots=True)
class CameraResult:
    """One camera: its pose, how sure it is, and why it may be wrong."""

    name: str
    frame: str  # coordinate frame of its detections or images
    verdict: Verdict = "good"
    reason: str = ""  # why it is doubtful or impossible, "" otherwise
    pose: Rigid | None = None  # in the fixed frame
    clock_s: float = math.nan
    """s to add to its stamps; NaN if that is not known: keep the log's stamps."""
    error_deg: float = math.nan
    """Standard error of the orientation, degrees; NaN where nothing tells it."""
    error_mm: float = math.nan  # the same of the position
    residual_mm: float = math.nan  # how far what it sees is from what the others see

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
class TargetCamera(CameraResult):
    """The pose of one camera by a ball or a board. The clock is not measured.

    Errors by a ball are those against the first camera, whose own are not known. The residual is
    the root mean square distance of the centres that fit, or of the markers.
    """

    seen: int = 0  # frames with the target
    against: str = ""
    """The camera that it was registered with by a ball; "" for the first one, or with a board."""
    common: int = 0  # centres of the ball at common times with that camera
    used: int = 0  # those that fit


@dataclass(frozen=True, slots=True)
class TargetCalibration:
    """Poses of a log's cameras by a ball or a board."""

    fixed_frame: str
    cameras: tuple[TargetCamera, ...]
    gauge: str
    """Origin of the fixed frame: transforms, or the first camera; of a board, what joined the
    cameras: transforms, or the board that each one sees."""
    skipped: Mapping[str, Mapping[str, int]]
    """Depth images without a result, by camera and reason."""
    verdict: Verdict
    reason: str  # doubts about the poses, and a better recording
    radius: float = math.nan  # of the ball, m: the median of what was measured; NaN without images

    @classmethod
    def of(
        cls,
        fixed_frame: str,
        cameras: Sequence[TargetCamera],
        gauge: str,
        skipped: Mapping[str, Mapping[str, int]],
        radius: float = math.nan,
    ) -> TargetCalibration:
        """Return what cameras with their verdicts are together."""
        reason = "; ".join(f"{camera.name}: {camera.reason}" for camera in cameras if camera.reason)
        verdict: Verdict = "doubtful" if reason else "good"
        return cls(fixed_frame, tuple(cameras), gauge, skipped, verdict, reason, radius)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about the poses."""
        return (f"the poses are doubtful: {self.reason}",) if self.reason else ()

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; numbers that are not known are None."""
        cameras = [camera.to_dict(self.fixed_frame) for camera in self.cameras]
        return {**plain(replace(self, cameras=())), "cameras": cameras}


@dataclass(frozen=True, slots=True)
class CalibratedCamera(CameraResult):
    """The pose and clock of one camera by the people whom it sees.

    Where they tell no pose, or no better one, it is the log's, if it has one. The clock is NaN if
    no motion tells it. Errors are those against the first camera, its own the largest of the
    others. The residual is the median distance of its joints to the mean of the other cameras'.
    """

    verdict: Verdict = "impossible"
    error_ms: float = math.nan  # standard error of the clock
    seconds: float = 0.0  # s in which another camera sees the same people
    moved_deg: float = math.nan
    """Difference from the log's pose; NaN if that stays, or there is none."""
    moved_mm: float = math.nan
    partner: str = ""  # the camera with which it has most in common
    evidence: Evidence | None = None  # the evidence of the verdict

    @property
    def fits(self) -> bool:
        """False if its people are not where the other cameras see them, whatever pose it gets."""
        return self.verdict != "impossible" or self.reason in (NO_VIEW, UNLINKED)

    @property
    def agrees(self) -> bool:
        """Whether nothing speaks against its pose, but that people walk as strangers might, too."""
        if self.evidence is None:
            return False
        return not weakness_of(replace(self.evidence, repetition=math.inf), USABLE)

    @property
    def uncertainty(self) -> float:
        """Standard error of the orientation, degrees; 0 where nothing tells it."""
        return 0.0 if math.isnan(self.error_deg) else self.error_deg

    @property
    def remedy(self) -> str:
        """A recording that would give a better pose."""
        return remedy(self.name, self.partner, self.seconds, self.error_deg)
