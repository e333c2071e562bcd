"""What a run has to say of its own accord, in words for somebody who has not read the code."""

from __future__ import annotations

from collections.abc import Mapping

COUNTED: Mapping[str, str] = {
    "bridged": "people carried on over moments in which no camera showed them",
    "calibration rejected": "people whose limb lengths varied too much or were seen too briefly; "
    "their lengths stay as measured",
    "filter: cut-off lowered": "the rate is too low for filter.cutoff",
    "filter: time not increasing": "skeletons not later than that person's last; not filtered",
    "limbs left free": "links whose measured length varied too much; they stay as measured",
    "low confidence": "detections below track.min_skeleton_confidence",
    "no markers": "detections without any marker, or with none confident enough",
    "not confirmed": "detections of bodies that too few messages or cameras bore out to be people",
    "optimizer not converged": "skeletons for which the solver stopped early",
    "predict: time not increasing": "skeletons not later than that person's last; not filtered",
    "duplicate": "detections on somebody whom the same camera had reported already; left out",
    "too few markers": "detections with fewer markers than track.min_markers; they start nobody",
}
"""Kind of an event -> what its number counts."""

CLEANED: Mapping[str, str] = {
    "absurd number": "infinite or beyond 10000; left out with the rest of its vector",
    "incomplete vector": "some of its numbers are missing; left out",
    "quaternion of length 0": "no rotation; left out",
    "quaternion normalised": "its length was not 1",
    "confidence above 1": "taken as 1",
    "negative confidence": "taken as not given",
}
"""Kind of a number that cannot be true (see codec.clean) -> what was done about it."""


def counted(kind: str, n: int) -> str:
    """Say what was counted."""
    return f"{kind}: {n}" + (f" ({COUNTED[kind]})" if kind in COUNTED else "")


def cleaned(kind: str, n: int) -> str:
    """Say which numbers could not be true, and what became of them."""
    return f"{n} x {kind} ({CLEANED[kind]})"


def duration(seconds: float) -> str:
    """Return a time as people say it: 3.2 s, 100 s, 1.0 hours, 3.2 years."""
    for unit, length in (("years", 31_557_600.0), ("days", 86_400.0), ("hours", 3_600.0)):
        if seconds >= length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.1f} s"
