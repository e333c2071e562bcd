"""Corrects the stamps of cameras whose clocks are wrong, before the stages see them.

A run of a file learns steps, drifts and late deliveries from the times of all messages
(:mod:`hiros_mcap.io.camera_clock`). Offsets come from the people, together with the cameras' poses
(:mod:`hiros_mcap.running.pose_alignment`): each that is significant is corrected, or a fault says
why it is not. A causal run corrects each message by those before it
(:mod:`hiros_mcap.running.clock_follower`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hiros_mcap.calibrate.verdict import NO_VIEW, UNLINKED
from hiros_mcap.config import Config
from hiros_mcap.errors import ConfigError
from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.io.camera_clock import (
    DRIFT,
    LATE,
    LONGEST_WAIT,
    OFFSET,
    CameraTimes,
    ClockCorrection,
    ClockFault,
    clock_verdict,
    described,
    longest_wait,
    middle_of,
)
from hiros_mcap.io.log import Log
from hiros_mcap.running.clock_follower import ClockFollower
from hiros_mcap.running.summary import PoseSummary
from hiros_mcap.skeletons import Stamps

_WORTH_A_WARNING = 0.05  # s
_LIKELY_NO_DELAY = 0.2  # s: deliveries of cameras usually differ by less
_LEAST_CLOCK_MS = 5.0  # smaller offsets stay: a person who walks is then off by 5 mm
_SURE_CLOCK = 3.0  # standard errors that an offset has to be long
STILL = "nobody moves enough to tell"
"""Why an offset that the lags suggest is not measured."""


@dataclass(slots=True)
class ClockAlignment:
    """The clocks of a run's cameras."""

    corrections: dict[str, ClockCorrection] = field(default_factory=dict)  # by camera
    faults: list[ClockFault] = field(default_factory=list)
    given: Mapping[str, float] = field(default_factory=dict)  # camera -> seconds that the user adds
    reorder: float = 0.0  # longest time, s, by which the stages take messages that are late
    times: Mapping[str, CameraTimes] = field(default_factory=dict)
    """Camera -> the times of its messages, as logged; empty unless clocks are to be found."""
    causal: bool = False  # whether each message is corrected by those before it
    offsets: list[tuple[int, str, float]] = field(default_factory=list)
    """From which stamp on, ns, which camera's clock is ahead by how many s, as far as found and
    corrected; 0 ns if before the run."""
    needed: Mapping[str, float] = field(default_factory=dict)
    """Camera -> wait, s, that its messages need, where that is over the longest one."""

    def corrected(self, blocks: Iterable[Block]) -> Iterable[Block]:
        """Return messages at right stamps."""
        if not self.corrections:
            return blocks
        return (_corrected(block, self.corrections) for block in blocks)

    @property
    def wait(self) -> float:
        """Longest time, s, that messages of a file wait for older ones of other cameras."""
        if not self.times:
            return self.reorder
        late = longest_wait(map(self.corrected_times, self.times))
        return min(late + 0.1, LONGEST_WAIT)

    def follower(self) -> ClockFollower:
        """Return what corrects each message by those before it; it notes here what it finds."""
        self.faults.clear()
        self.offsets.clear()
        return ClockFollower(self.given, self.faults, self.reorder, self.offsets)

    @property
    def lags(self) -> dict[str, float]:
        """Usual time, s, from each camera's corrected stamps to the log times."""
        return {name: float(np.median(self.corrected_times(name).lags)) for name in self.times}

    def corrected_times(self, camera: str) -> CameraTimes:
        """Return the times of a camera's messages with corrected stamps."""
        return self.times[camera].corrected(self.corrections.get(camera))

    def take_offsets(self, cameras: Sequence[PoseSummary]) -> list[PoseSummary]:
        """Correct the offsets that the people prove; note which others stay, and why.

        Return the cameras with ``clock_ms`` counted from the right clock, as the notes count it.
        """
        lags = self.lags
        # Of a camera that was moved, the surer clock comes last.
        surest = {c.name: c for c in sorted(cameras, key=lambda c: -c.error_ms) if c.name in lags}
        measured = {name: c for name, c in surest.items() if not math.isnan(c.clock_ms)}
        offsets = significant_offsets(measured.values(), lags, self.given)
        for name, seconds in offsets.items():
            if not measured[name].tells_the_clock:
                self._note(name, seconds, measured[name].reason)
        for name, lag in lags.items():
            ahead = middle_of(lags) - lag
            if name not in measured and name not in self.given and abs(ahead) > _WORTH_A_WARNING:
                pose = surest.get(name)
                is_alone = pose is not None and pose.verdict == "impossible"
                self._note(name, ahead, pose.reason if pose and is_alone else STILL)
        self._add({name: s for name, s in offsets.items() if measured[name].tells_the_clock})
        right = right_clock(measured.values(), lags, self.given)
        return [replace(camera, clock_ms=camera.clock_ms - right) for camera in cameras]

    def _note(self, camera: str, seconds: float, reason: str) -> None:
        """Note an offset that is not corrected."""
        reason = f"it {reason}" if reason in (NO_VIEW, UNLINKED) else reason
        at = int(self.corrected_times(camera).stamps[0])
        fault = ClockFault(camera, OFFSET, seconds, at, corrected=False, reason=reason)
        self.faults.append(fault)

    def _add(self, offsets: Mapping[str, float]) -> None:
        """Correct clocks that are ahead by so many seconds, by camera."""
        for name, seconds in offsets.items():
            before = self.corrections.get(name, ClockCorrection())
            self.corrections[name] = before.plus(-seconds)
            superseded = [f for f in self.faults if (f.camera, f.kind) == (name, OFFSET)]
            self.faults = [fault for fault in self.faults if fault not in superseded]
            total = seconds + sum(fault.seconds for fault in superseded)
            self.offsets.append((0, name, total))
            at = int(self.corrected_times(name).stamps[0])
            self.faults.append(ClockFault(name, OFFSET, total, at, corrected=True))

    def note_events(self, events: Events) -> None:
        """Note the faults."""
        for fault in self.faults:
            detail = fault.size
            events.note(fault.at_ns, fault.kind, source=fault.camera, detail=detail)


def significant_offsets(
    cameras: Iterable[PoseSummary], lags: Mapping[str, float], given: Mapping[str, float]
) -> dict[str, float]:
    """Camera -> seconds that its clock is ahead, where the people show that clearly.

    Ahead of :func:`right_clock`. This adds no error: the cameras' standard errors are those of
    differences between clocks.

    Parameters
    ----------
    cameras : what the people say; a verdict may be no reason to believe it.
    lags : usual time, s, from each camera's stamps to the log times. given : as of the user.
    """
    measured = [camera for camera in cameras if not math.isnan(camera.clock_ms)]
    right = right_clock(measured, lags, given)
    return {
        camera.name: (right - camera.clock_ms) / 1000.0
        for camera in measured
        if camera.name not in given
        and abs(right - camera.clock_ms) > max(_LEAST_CLOCK_MS, _SURE_CLOCK * camera.error_ms)
    }


def right_clock(
    cameras: Iterable[PoseSummary], lags: Mapping[str, float], given: Mapping[str, float]
) -> float:
    """Return what the right clock has in ``clock_ms``; parameters as :func:`significant_offsets`.

    Clocks that the user has set are right. Without any, the median clock is; of two, it is that of
    the camera whose messages are logged nearer to their stamps.
    """
    sure = {camera.name: camera.clock_ms for camera in cameras if camera.tells_the_clock}
    sure = {name: ms for name, ms in sure.items() if not math.isnan(ms)}
    if set_right := [ms for name, ms in sure.items() if name in given]:
        return float(np.median(set_right))
    if len(sure) == 2:
        return sure[min(sorted(sure), key=lambda name: abs(lags[name]))]
    return float(np.median([*sure.values()] or [0.0]))


def align_clocks(
    log: Log, config: Config, reorder: float, times: Mapping[str, CameraTimes] | None = None
) -> ClockAlignment:
    """Find what the times of the messages show of the clocks of a log.

    Parameters
    ----------
    reorder : the longest time, s, by which the stages take messages that are late.
    times : of all messages, by camera; None = each message is corrected by those before it.

    Raises ConfigError if the configuration corrects a camera that the log does not have.
    """
    given = given_corrections(log, config)
    if config.input.clocks == "off":
        plain = {name: ClockCorrection().plus(s) for name, s in given.items()}
        return ClockAlignment(plain, given=given, reorder=reorder)
    if times is None or config.input.clocks == "causal":
        return ClockAlignment(given=given, reorder=reorder, causal=True)
    verdict = clock_verdict(times, given)
    corrections = {
        name: correction
        for name, correction in verdict.corrections.items()
        if correction.changes(times[name])
    }
    used = {name: camera_times for name, camera_times in times.items() if len(camera_times.stamps)}
    return ClockAlignment(corrections, list(verdict.faults), given, reorder, used)


def given_corrections(log: Log, config: Config) -> dict[str, float]:
    """Camera -> seconds that the user adds to its stamps.

    The names of cameras without a message are unknown, so that any name may be one of theirs.

    Raises ConfigError for a name that is neither a camera nor a topic of one.
    """
    names = [name for camera in log.cameras for name in camera.sources.values()]
    topics = {camera.channel.topic: tuple(camera.sources.values()) for camera in log.cameras}
    complete = all(camera.channel.count for camera in log.cameras)
    given: dict[str, float] = {}
    for name, seconds in config.clock.seconds.items():
        sources = (name,) if name in names else topics.get(name, ())
        if not sources and complete:
            raise ConfigError(
                f"clock: {log.path} has no camera {name!r} (there are: {', '.join(names)})"
            )
        given.update(dict.fromkeys(sources, seconds))
    return given


def clock_warnings(faults: Iterable[ClockFault], start: int) -> Iterator[str]:
    """Yield what is doubtful because of the clocks, and the remedy."""
    for fault in faults:
        if _is_grave(fault):
            yield f"{described(fault, start)}; {_remedy(fault)}"


def clock_notes(faults: Iterable[ClockFault], start: int) -> Iterator[str]:
    """Yield what was found in the clocks and matters less."""
    for fault in faults:
        if not _is_grave(fault):
            done = "hiros allowed for it" if fault.corrected else "hiros kept its stamps"
            yield f"{described(fault, start)}; {done}"


def _is_grave(fault: ClockFault) -> bool:
    if fault.kind == LATE:
        return False
    is_delay = not fault.corrected and fault.reason == STILL
    least = _LIKELY_NO_DELAY if is_delay else _WORTH_A_WARNING
    return fault.kind == DRIFT or abs(fault.seconds) >= least


def _remedy(fault: ClockFault) -> str:
    option = f"--clock {fault.camera}={-fault.seconds:.3f}"
    if not fault.corrected:
        return (
            f"hiros kept its stamps because {fault.reason}; if the clock is wrong, process again "
            f"with {option}"
        )
    if fault.kind == OFFSET:
        return f"hiros corrected its stamps, as {option} does; synchronize the clocks"
    return "hiros corrected its stamps; synchronize the clocks (NTP or PTP)"


def _corrected(block: Block, corrections: Mapping[str, ClockCorrection]) -> Block:
    """Return a block with right stamps, of frames and of people."""
    stamps: Stamps = block.stamps.copy()
    for code in np.unique(block.sources).tolist():
        name = block.names[code]
        if name not in corrections:
            continue
        frames = np.flatnonzero(block.sources == code)
        stamps[frames] = corrections[name].apply(block.stamps[frames], block.log_times[frames])
    return block.restamped(stamps)
