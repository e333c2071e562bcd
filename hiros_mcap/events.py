"""Events of the stages: they note here what they drop, correct or find."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated

from pydantic import Field, TypeAdapter

from hiros_mcap.skeletons import Stamps
from hiros_mcap.wording import quantity

TOO_LATE = "too late to be merged"
"""Counts messages, by source, that came after their time had been merged."""
SAME_TIME = "stamped as those merged before"
"""Counts messages, by source, of a time that has been merged: nobody is shown twice at one time."""

RESIDUAL, COMMON = "residual", "common residual"
"""Histograms by camera: (M, B) of each marker's squared residual over its expected variance; (1, B)
of the share of a person's squared residuals that all markers have in common."""

COUNTED: Mapping[str, tuple[str, str]] = {
    "bridged": ("skeleton", "predicted while no camera saw the person"),
    "carried": ("skeleton", "predicted while others hid the person from every camera"),
    "calibration rejected": ("calibration", "rejected: limb lengths stay as measured"),
    "displaced": ("detection", "ignored: a camera shows a person elsewhere than the others do"),
    "filter: cut-off lowered": ("filter", "with a lower cut-off: the frame rate is too low"),
    "filter: time not increasing": ("skeleton", "not filtered: its time did not increase"),
    "leap": (
        "detection",
        "ignored: farther from where the person was than anybody moves in that time",
    ),
    "limbs left free": ("limb", "not made constant: the measured length varied too much"),
    "low confidence": ("detection", "ignored: confidence below track.min_skeleton_confidence"),
    "no markers": ("detection", "ignored: no marker that is confident enough"),
    "not confirmed": ("detection", "ignored: seen too briefly or by too few cameras"),
    "optimizer outlier": ("marker", "replaced by the optimizer: a limb had a wrong length"),
    "optimizer not converged": ("skeleton", "not fully optimized: the solver did not converge"),
    "predict: time not increasing": ("skeleton", "not filtered: its time did not increase"),
    "distorted": ("detection", "ignored: limbs of a wrong length, and somebody else in front"),
    "implausible marker": ("marker", "trusted less: the person's limbs have another length"),
    "hidden": ("marker", "trusted less: behind somebody else"),
    "impossible posture": ("marker", "trusted less: in a posture that no body takes"),
    "duplicate": ("detection", "ignored: the same camera had already reported the person"),
    "too few markers": ("detection", "started no track: fewer markers than track.min_markers"),
    "swap": ("pair", "of joints re-arranged: left and right were swapped"),
    # Numbers that cannot be true (codec.clean), and what was done about them.
    "absurd number": ("vector", "ignored: infinite, or a number beyond 10000"),
    "incomplete vector": ("vector", "ignored: some of its numbers are missing"),
    "quaternion of length 0": ("orientation", "ignored: a quaternion of length 0"),
    "quaternion normalised": ("quaternion", "normalized"),
    "confidence above 1": ("confidence", "above 1 taken as 1"),
    "negative confidence": ("negative confidence", "taken as missing"),
    "nobody": ("skeleton", "left out: no joint in them, or all at exactly 0 0 0"),
    "copy": ("skeleton", "left out: another one in the same message has the same joints"),
}
"""Kind of an event that is counted -> noun, what happened to it."""


def counted(kind: str, n: int) -> str:
    """Return in words what was counted."""
    if kind not in COUNTED:
        return f"{kind}: {n}"
    noun, what = COUNTED[kind]
    return f"{quantity(n, noun)} {what}"


CAMERA_DISPLACED, CAMERA_BACK = "camera displaced", "camera back"
"""A camera shows people elsewhere than the others do; it did, and shows them in place again."""
MIRROR_SEEN, CAMERA_MOVED = "mirror seen", "camera moved"

_WARNING_WORDS = "lost", "withdrawn", "rejected", "clock", "moved", "displaced", "mirror"


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened at an instant and that a user may want to see."""

    stamp: Annotated[int, Field(ge=0, lt=1 << 63)]  # ns since the epoch
    kind: str  # "track born", "track lost", "flip", "limbs calibrated", ...
    person: int  # id of the person, -1 if of nobody
    source: str  # the camera, "" if of none
    detail: str

    @property
    def text(self) -> str:
        """Kind, person, camera and detail, in one line."""
        who = f" person {self.person}" if self.person >= 0 else ""
        where = f" {self.source}" if self.source else ""
        return f"{self.kind}{who}{where}{f': {self.detail}' if self.detail else ''}"

    @property
    def is_warning(self) -> bool:
        """Whether something was lost, refused or wrong."""
        return any(word in self.kind for word in _WARNING_WORDS)


_BEHIND = re.compile(r"(behind.*) for ([\d.]+)")


def hidden_times(
    events: Iterable[Event], person: int, start: int
) -> Iterator[tuple[float, float, str, str]]:
    """Yield when somebody stood in front of a person, seen from one camera.

    Begin and end in s from ``start``, ns; "behind person 1"; the camera.
    """
    for event in events:
        found = _BEHIND.search(event.detail)
        if event.kind == "hidden" and event.person == person and found is not None:
            begin = (event.stamp - start) * 1e-9
            yield begin, begin + float(found[2]), found[1], event.source


def camera_displaced(
    stamp: int, camera: str, metres: float, others: Sequence[str] = (), seconds: float | None = None
) -> Event:
    """Return that a camera shows people elsewhere than the others do.

    Parameters
    ----------
    stamp : since when, ns. metres : how far from where they are.
    others : the cameras that see them there, if nobody can know which of them is wrong.
    seconds : for how long; None = it still does.
    """
    who = f"{' or '.join(others)} sees them; which of them is wrong cannot be known"
    where = f"people {metres:.2f} m from where {who if others else 'other cameras see them'}"
    if seconds is None:
        return Event(stamp, CAMERA_DISPLACED, -1, camera, f"shows {where}")
    return Event(stamp, CAMERA_BACK, -1, camera, f"showed {where} for {seconds:.1f} s")


@dataclass(slots=True)
class Events:
    """Counters by (kind, source) and a list of notable instants, shared by the stages of a run."""

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    log: list[Event] = field(default_factory=list)
    histograms: dict[tuple[str, str], Stamps] = field(default_factory=dict)
    """By (kind, source): how often a quantity had a size, (K, B) for B sizes."""

    def count(self, kind: str, source: str = "", n: int = 1) -> None:
        """Add ``n`` to a counter."""
        if n:
            self.counts[kind, source] += n

    def tally(self, kind: str, source: str, counts: Stamps) -> None:
        """Add to a histogram."""
        before = self.histograms.get((kind, source))
        self.histograms[kind, source] = counts if before is None else before + counts

    def note(
        self, stamp: int, kind: str, *, person: int = -1, source: str = "", detail: str = ""
    ) -> None:
        """Append an event to the log."""
        self.log.append(Event(stamp, kind, person, source, detail))

    def total(self, kind: str) -> int:
        """Sum of a counter over all sources."""
        return sum(n for (k, _), n in self.counts.items() if k == kind)

    def to_json(self) -> str:
        """Events by time, as the attachment of an output holds them."""
        events = sorted(self.log, key=lambda event: event.stamp)
        return json.dumps([asdict(event) for event in events], indent=0)


def events_from_json(text: str) -> list[Event]:
    """Read what :meth:`Events.to_json` returns; ValueError if it is something else."""
    return TypeAdapter(list[Event]).validate_json(text)
