"""Corrects the stamps of cameras whose clocks are wrong, before the stages see them.

A run of a file judges every clock first, by the times of all messages
(:mod:`hiros_mcap.io.camera_clock`) and by the people
(:mod:`hiros_mcap.calibrate.clock_offset`). Poses and clocks that are found together may show more
(:mod:`hiros_mcap.running.pose_alignment`). A causal run judges each message by those before it
(:mod:`hiros_mcap.running.clock_follower`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.calibrate.clock_offset import clock_offsets
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
    ClockJudgement,
    described,
    judge_clocks,
    longest_wait,
    middle_of,
)
from hiros_mcap.io.log import Log
from hiros_mcap.running.clock_follower import ClockFollower
from hiros_mcap.skeletons import Stamps
from hiros_mcap.stages.time_order import late_in_order
from hiros_mcap.summary import ClockFault

_WORTH_A_WARNING = 0.05  # s
_LIKELY_NO_DELAY = 0.2  # s: deliveries of cameras usually differ by less
_MARGIN = 0.1  # s
_ALIKE = 0.01  # s: cameras whose usual and least lags differ by less have the same clock


@dataclass(slots=True)
class ClockAlignment:
    """The clocks of a run's cameras."""

    corrections: dict[str, ClockCorrection] = field(default_factory=dict)
    """By camera."""
    faults: list[ClockFault] = field(default_factory=list)
    wait: float = 0.0
    """s: how late messages are; 0 if no later than the stages can take."""
    given: Mapping[str, float] | None = None
    """Camera -> seconds that the user adds, of a causal run; None if the whole log was judged."""
    reorder: float = 0.0
    """Longest time, s, by which the stages take messages that are late."""

    def correct(self, blocks: Iterable[Block]) -> Iterator[Block]:
        """Yield blocks with right stamps, in an order that the stages can take."""
        if self.given is not None:
            self.faults.clear()
            blocks = ClockFollower(self.given, self.faults, self.reorder).correct(blocks)
        if self.corrections:
            blocks = (_corrected(block, self.corrections) for block in blocks)
        yield from late_in_order(blocks, self.wait) if self.wait else blocks

    def add_offsets(self, offsets: Mapping[str, float], log: Log) -> None:
        """Correct clocks that are still ahead by so many seconds, by camera."""
        if not offsets:
            return
        times = log.times()
        for name, seconds in offsets.items():
            before = self.corrections.get(name, ClockCorrection())
            self.corrections[name] = before.plus(-seconds)
            self._note_offset(name, seconds, int(times[name].stamps[0] - round(seconds * 1e9)))
        corrected = (_corrected_times(times[name], self.corrections.get(name)) for name in times)
        self.wait = _wait_for(longest_wait(corrected), self.reorder)

    def _note_offset(self, camera: str, seconds: float, at_ns: int) -> None:
        """Add to the fault of a camera's offset, or begin one."""
        before = [f for f in self.faults if (f.camera, f.kind) == (camera, OFFSET)]
        self.faults = [fault for fault in self.faults if fault not in before]
        total = seconds + sum(fault.seconds for fault in before if fault.corrected)
        self.faults.append(ClockFault(camera, OFFSET, total, at_ns, corrected=True))

    def tell(self, events: Events) -> None:
        """Note the faults."""
        for fault in self.faults:
            detail = fault.size
            events.note(fault.at_ns, fault.kind, source=fault.camera, detail=detail)


def align_clocks(log: Log, config: Config, reorder: float) -> ClockAlignment:
    """Judge the clocks of a log.

    ``reorder`` is the longest time, s, by which the stages take messages that are late.

    Raises ConfigError if the configuration corrects a camera that the log does not have.
    """
    given = given_corrections(log, config)
    if config.input.clocks == "off":
        plain = {name: ClockCorrection().plus(s) for name, s in given.items()}
        return ClockAlignment(plain, reorder=reorder)
    if config.input.clocks == "causal":
        return ClockAlignment(given=given, reorder=reorder)
    times = log.times()
    judged = judge_clocks(times, given)
    alignment = ClockAlignment(dict(judged.corrections), list(judged.faults), reorder=reorder)
    late = judged.wait
    if len(judged.lags) > 1:
        late = _align_by_people(log, alignment, judged, set(given)) or judged.wait
    alignment.corrections = {
        name: one
        for name, one in alignment.corrections.items()
        if name in times and one.changes(times[name])
    }
    alignment.wait = _wait_for(late, reorder)
    return alignment


def _wait_for(late: float, reorder: float) -> float:
    """Return how long, s, messages wait if they are late by so much; 0 if the stages take them."""
    return min(late + _MARGIN, LONGEST_WAIT) if late > reorder else 0.0


def _corrected_times(times: CameraTimes, correction: ClockCorrection | None) -> CameraTimes:
    if correction is None:
        return times
    return CameraTimes(correction.apply(times.stamps, times.log_times), times.log_times)


def _align_by_people(
    log: Log, alignment: ClockAlignment, judged: ClockJudgement, given: set[str]
) -> float:
    """Correct constant offsets that the people prove, where the lags of cameras differ.

    Return by how much messages are late then, s; 0 if nothing changed.
    """
    usual = middle_of(judged.lags)
    least = {name: float(np.quantile(t.lags, 0.05)) for name, t in judged.times.items()}
    if max(map(_spread, (judged.lags, least))) < _ALIKE:
        return 0.0
    offsets = clock_offsets(alignment.correct(log.blocks()), judged.lags)
    start = min(times.stamps[0] for times in judged.times.values())
    times = dict(judged.times)
    for name, lag in judged.lags.items():
        found = offsets.get(name)
        if name in given:
            continue
        if found is not None and found.is_proven:
            alignment.corrections[name] = judged.corrections[name].plus(-found.seconds)
            times[name] = times[name].moved(-found.seconds)
            fault = ClockFault(name, OFFSET, found.seconds, int(start), corrected=True)
            alignment.faults.append(fault)
        elif found is None and abs(usual - lag) > _WORTH_A_WARNING:
            fault = ClockFault(name, OFFSET, usual - lag, int(start), corrected=False)
            alignment.faults.append(fault)
    return longest_wait(times.values())


def _spread(values: Mapping[str, float]) -> float:
    return max(values.values()) - min(values.values())


def given_corrections(log: Log, config: Config) -> dict[str, float]:
    """Camera -> seconds that the user adds to its stamps.

    The names of cameras without a message are unknown, so that any name may be one of theirs.

    Raises ConfigError for a name that is neither a camera nor a topic of one.
    """
    names = [name for camera in log.cameras for name in camera.sources.values()]
    topics = {camera.channel.topic: tuple(camera.sources.values()) for camera in log.cameras}
    all_known = all(camera.channel.count for camera in log.cameras)
    given: dict[str, float] = {}
    for name, seconds in config.clock.seconds.items():
        found = (name,) if name in names else topics.get(name, ())
        if not found and all_known:
            raise ConfigError(
                f"clock: {log.path} has no camera {name!r} (there are: {', '.join(names)})"
            )
        given.update(dict.fromkeys(found, seconds))
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
    least = _WORTH_A_WARNING if fault.corrected else _LIKELY_NO_DELAY
    return fault.kind == DRIFT or abs(fault.seconds) >= least


def _remedy(fault: ClockFault) -> str:
    option = f"--clock {fault.camera}={-fault.seconds:.3f}"
    if not fault.corrected:
        return (
            "hiros kept its stamps because nobody moves enough to tell; if the clock is wrong, "
            f"process again with {option}"
        )
    if fault.kind == OFFSET:
        return f"hiros corrected its stamps, as {option} does; synchronize the clocks"
    return "hiros corrected its stamps; synchronize the clocks (NTP or PTP)"


def _corrected(block: Block, corrections: Mapping[str, ClockCorrection]) -> Block:
    """Return a block with right stamps, of frames and of people."""
    concerned = corrections.keys() & set(block.sources)
    if not concerned:
        return block
    sources = np.array(block.sources)
    stamps: Stamps = block.stamps.copy()
    for name in concerned:
        own = np.flatnonzero(sources == name)
        stamps[own] = corrections[name].apply(block.stamps[own], block.log_times[own])
    return block.restamped(stamps)
