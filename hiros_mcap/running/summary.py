"""Summary of a run: every message accounted for, every person, every rejection, every second.

:func:`hiros_mcap.running.pipeline.process` fills it, ``hiros process`` shows it, ``--json`` prints
:meth:`Summary.to_dict`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hiros_mcap.calibrate.verdict import SURE
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.camera_clock import ClockFault
from hiros_mcap.io.result import Result, open_result
from hiros_mcap.wording import plain, plain_value, quantity


@dataclass(frozen=True, slots=True)
class PoseSummary:
    """Verdict of the people in the log on the pose of one camera."""

    name: str
    verdict: str
    """good: they confirm it. improved: they know a better one. doubtful: they do not know enough.
    impossible: they tell nothing, or contradict it."""
    reason: str = ""  # why it is doubtful or impossible, "" otherwise
    used: bool = False  # whether the run used their pose in place of the log's
    moved_mm: float = math.nan
    """How far the pose that was used is from the log's; NaN if it is the log's, or the log has
    none."""
    moved_deg: float = math.nan
    clock_ms: float = math.nan
    """Offset to add to its stamps by the people's motion, besides that by the times of its
    messages; NaN if no motion tells. Significant offsets are corrected: see
    :attr:`CameraSummary.clock`."""
    error_mm: float = math.nan  # standard error of the people's pose against the other cameras
    error_deg: float = math.nan
    error_ms: float = math.nan
    since_s: float = math.nan
    """When the camera was moved to this pose, s from the log's start; NaN if it stood there from
    the start. A camera that was moved is listed twice."""
    until_s: float = math.nan  # when it was moved away from this pose; NaN if it stayed

    @property
    def tells_the_clock(self) -> bool:
        """Whether its clock can be believed: that goes with the pose, where the run uses this."""
        return self.used or self.verdict in SURE


@dataclass(frozen=True, slots=True)
class PlacementSummary:
    """How uncertain it is where the rig as a whole stands: the people in a log cannot show it."""

    error_mm: float  # standard deviation of the cameras' middle along an axis
    error_deg: float  # standard deviation of the orientation about an axis


@dataclass(frozen=True, slots=True)
class DelaySummary:
    """How long after their time the results of a causal run were known, by the log's clock.

    It holds how late the messages came and how long the stages waited. Of live input, it also holds
    how long messages lay here while the run was busy, and what was computed.
    """

    median_s: float
    most_s: float  # 95 % of the results were known sooner


@dataclass(frozen=True, slots=True)
class CameraSummary:
    """Counts of the messages of one camera's channel: ``messages`` = used + skipped."""

    name: str
    topic: str
    rate_hz: float
    """Messages per second of the camera's own time, gaps left out; NaN below two messages."""
    messages: int  # messages read from the channel
    used: int  # messages that contributed to results
    skipped: Mapping[str, int] = field(default_factory=dict)
    """Messages that were left out, by reason: not read, or read and not merged."""
    flips: int = 0  # detections left out because left and right were swapped
    outliers: int = 0  # markers and links left out because the other cameras disagreed
    clock: tuple[ClockFault, ...] = ()  # faults of the times of its messages


@dataclass(frozen=True, slots=True)
class ScatterSummary:
    """How far the detections of one camera are from the result, against what its noise says."""

    name: str
    ratio: float
    """How many times as far as expected they are; 1 = as the model says. NaN if seen too little."""
    worst_joint: str  # the joint with the largest ratio, "" if none was seen often enough
    worst_ratio: float
    common: float
    """Median share, 0..1, of a person's squared residuals that is the same for all joints: near 1,
    the pose or the clock of the camera is wrong; near 0, its joints scatter one by one."""


@dataclass(frozen=True, slots=True)
class LimbSummary:
    """The calibration of one person's limb lengths."""

    frames: int  # frames that the lengths were measured in
    median_cv: float
    """Median over the links of the coefficient of variation of the measured length; NaN if not
    measured."""
    worst_cv: float
    """Largest coefficient of variation (standard deviation / mean) of a link's length."""
    worst_link: str  # the link that varied most, "" if none was measured
    accepted: bool  # False: the person passed through the optimizer unchanged
    reason: str = ""  # why the calibration was not accepted, "" if it was


@dataclass(frozen=True, slots=True)
class PersonSummary:
    """One person from the first to the last frame in which a camera saw them."""

    id: int
    first_ns: int  # stamp of the first frame, ns since the epoch
    last_ns: int  # stamp of the last frame, ns since the epoch
    frames: int  # frames of the last stage that contain the person
    cameras: tuple[str, ...]  # names of the cameras that saw the person
    predicted: int = 0
    """Frames with a confidence below 0.1: nobody saw the person, who was predicted."""
    limbs: LimbSummary | None = None
    """None when the chain has no optimizer or the person was never calibrated."""

    @property
    def seconds(self) -> float:
        """Time between the first and the last frame, s."""
        return (self.last_ns - self.first_ns) / 1e9


@dataclass(frozen=True, slots=True)
class StageTime:
    """CPU time of one step. Some steps run at the same time."""

    name: str
    cpu_s: float  # CPU time, s


@dataclass(frozen=True, slots=True)
class Summary:
    """The whole run."""

    source: str
    """The log that was read."""
    target: str | None
    """The log that was written, None when nothing was."""
    log_s: float
    """Time from the first to the last message of the cameras, s."""
    wall_s: float
    """Time that the run took, s."""
    waited_s: float = 0.0
    """Part of it in which live input was waited for, s."""
    system: str = ""
    """Name of the system that was run."""
    settings: str = ""
    """File that the parameters came from, "" if none did."""
    delay: DelaySummary | None = None
    """None if the run looked ahead, or there are no results."""
    cameras: tuple[CameraSummary, ...] = ()
    poses: tuple[PoseSummary, ...] = ()
    """Empty if the run did not compare the cameras' poses with the people."""
    placement: PlacementSummary | None = None
    """Of the whole rig; None if the run did not compare the poses, or the log has none."""
    scatter: float = math.nan
    """How many times as far as expected the detections are from the result. The uncertainty of the
    result allows for what lasts of it. NaN if the system states none."""
    scatters: tuple[ScatterSummary, ...] = ()
    """The same by camera."""
    people: tuple[PersonSummary, ...] = ()
    stages: tuple[StageTime, ...] = ()
    written: Mapping[str, int] = field(default_factory=dict)
    """Messages written, by output channel."""
    warnings: tuple[str, ...] = ()
    """Reasons to doubt the result, or losses, with their remedies, one line each."""
    losses: str = ""
    """Losses of a damaged log, one line; "" if everything was read."""
    notes: tuple[str, ...] = ()
    """Further notes for the user, one line each."""

    def __repr__(self) -> str:
        source, target = Path(self.source).name, ""
        if self.target:
            target = f" -> {Path(self.target).name}"
        people = "1 person" if len(self.people) == 1 else f"{len(self.people)} people"
        return (
            f"<Summary {source}{target}: {people}, {self.log_s:.1f} s of log in "
            f"{self.wall_s:.1f} s, {quantity(len(self.warnings), 'warning')}>"
        )

    def result(self, channel: str = "") -> Result:
        """Open what was written, see :func:`hiros_mcap.open_result`.

        Raises ConfigError if the run wrote nothing.
        """
        if self.target is None:
            raise ConfigError("the run wrote no log to open; give it a target")
        return open_result(self.target, channel)

    @property
    def times_real_time(self) -> float:
        """Seconds of log per second of work; NaN when no time was measured."""
        work = self.wall_s - self.waited_s
        return self.log_s / work if work > 0 else math.nan

    @property
    def skipped(self) -> int:
        """Messages of all cameras that were left out."""
        return sum(sum(camera.skipped.values()) for camera in self.cameras)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; derived numbers included, numbers that are not finite are None."""
        people = [{**plain(person), "seconds": person.seconds} for person in self.people]
        return {
            **plain(self),
            "people": people,
            "times_real_time": plain_value(self.times_real_time),
        }

    def reproducible(self) -> dict[str, Any]:
        """Return :meth:`to_dict` without what differs from run to run: times taken and paths.

        This is what an output file may hold: the same input gives the same bytes.
        """
        varying = {
            "source",
            "target",
            "settings",
            "wall_s",
            "waited_s",
            "times_real_time",
            "stages",
        }
        return {key: value for key, value in self.to_dict().items() if key not in varying}
