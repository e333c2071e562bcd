"""Faults of the cameras' clocks, found from the times of their messages alone.

A message has two times: the camera stamps it, and the recorder logs it on its own, one clock. The
lag is the difference, log time minus stamp: the delay of the delivery minus the error of the
camera's clock.

- **Step.** The clock was set: the lag changes for good, and one interval between stamps is odd
  while log times go on regularly.
- **Late delivery.** The lag grows for a while, and stamps go on regularly. The clock is right.
- **Drift.** The lag grows or shrinks steadily. Delays vary to one side only, so the least lag of
  each second counts.
- **Wrong time.** The stamp of a single message contradicts those around it: without the message
  there is a gap at its log time, and its stamp lies elsewhere. A message that was delivered late
  leaves its gap at its stamp.
- **Offset.** The lag differs from that of the other cameras from the first message on. Times alone
  cannot tell a wrong clock from a slow delivery; the people can, with the cameras' poses. Only a
  difference that no delivery explains is taken as one of the clocks.

A fault that all cameras share is the recorder's: it may stall, or its clock may be set.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hiros_mcap.skeletons import Flags, Floats, Stamps
from hiros_mcap.wording import duration, quantity

STEP, DRIFT, OFFSET = "clock step", "clock drift", "clock offset"
LATE, WRONG = "late delivery", "wrong time"

_LEAST = 10  # messages of a camera that say anything
_STEP_SIDE = 30  # messages on each side of a step that give its size
_LEAST_AFTER = 5  # messages that confirm a step
_LASTING = 10.0  # s: a lag that has not lasted so long may be a late delivery
_IRREGULAR = 0.025  # s: an interval between stamps that differs so much from the usual one is odd
_LEAST_STEP = 0.03  # s
_MOMENT = 20_000_000  # ns: within it, the recorder is late by the same time
_PARTED = 0.3  # share of a step by which all lags next to it lie on their side
_SURE = 6.0  # standard errors: lags may be mixed next to a step that is so much longer
_PAUSE = 1.0  # s: whoever pauses longer may do so for any time
_LATENESS = 0.5  # s
_REMARKABLE = 0.05  # s
LONGEST_WAIT = 60.0
"""s: so much of a log is held in memory at most until late messages have come."""
_FUTURE = 0.5  # s: no delivery is so much faster than the fastest
LONGEST_DELAY = 10.0  # s: no delivery takes so much longer than another camera's
_LEAST_DRIFT = 0.7e-3  # s/s: cheap crystals are off by a tenth of that
_LEAST_DRIFTED = 0.01  # s
_LEAST_SECONDS = 15  # fewer least lags fit a line by chance, where messages are late
_LARGEST_DRIFT = 0.01  # s/s: what changes less over a pause is no step
_WIDE = 1.5  # usual intervals: a longer one lacks a message
_BY_CHANCE = 1e-6  # probability of so many gaps where late messages were logged


@dataclass(frozen=True, slots=True)
class ClockFault:
    """Something wrong with the times of a camera's messages."""

    camera: str
    kind: str  # "clock step", "clock drift", "clock offset", "late delivery" or "wrong time"
    seconds: float
    """By how much the clock went or is ahead, s (a drift: s per s; a late delivery: the delay)."""
    at_ns: int  # corrected stamp of the first message that it concerns, ns since the epoch
    corrected: bool  # whether the results are free of it
    messages: int = 0  # messages that were late
    reason: str = ""  # why the stamps stay, if they do

    @property
    def size(self) -> str:
        """How large it is, with sign and unit: +2.00 s, -105 ms, +1.2 ms per s."""
        if self.kind == "clock drift":
            return f"{1000 * self.seconds:+.1f} ms per s"
        if abs(self.seconds) < 0.9995:
            return f"{1000 * self.seconds:+.0f} ms"
        sign = "-" if self.seconds < 0 else "+"
        long = abs(self.seconds) >= 3600
        return f"{sign}{duration(abs(self.seconds))}" if long else f"{self.seconds:+.2f} s"


@dataclass(frozen=True, slots=True)
class CameraTimes:
    """When a camera's N messages were stamped and logged, in the order of the log."""

    stamps: Stamps  # (N,) ns, camera's clock
    log_times: Stamps  # (N,) ns, recorder's clock

    @property
    def lags(self) -> Floats:
        """(N,) log time - stamp, s."""
        return np.asarray((self.log_times - self.stamps) * 1e-9, np.float64)

    def corrected(self, correction: ClockCorrection | None) -> CameraTimes:
        """Return the same with corrected stamps."""
        if correction is None:
            return self
        return replace(self, stamps=correction.apply(self.stamps, self.log_times))

    def followed(self, correction: ClockCorrection) -> CameraTimes:
        """Return the same without the steps and the drift of the clock."""
        return replace(self, stamps=correction.follow(self.stamps, self.log_times))

    def moved(self, seconds: float) -> CameraTimes:
        """Return the same with later stamps."""
        return replace(self, stamps=self.stamps + round(seconds * 1e9))


@dataclass(frozen=True, slots=True)
class ClockCorrection:
    """Correction of a camera's stamps: steps, and a drift on top of them."""

    begins: tuple[int, ...] = (-(2**63),)  # log times, ns, from which each of ``offsets`` holds
    offsets: tuple[int, ...] = (0,)  # ns
    drift: float = 0.0  # added per unit of the camera's time since ``origin``
    origin: int = 0  # ns, of the camera's clock after the steps
    floor: int | None = None
    """Least lag of corrected messages, ns. One that does not fit it at all gets it."""
    longest: float = LONGEST_WAIT  # longest lag beyond ``floor``, s, of a message with a right time

    def apply(self, stamps: Stamps, log_times: Stamps) -> Stamps:
        """Return the corrected stamps of messages, (N,) ns."""
        right = self.follow(stamps, log_times)
        if self.floor is not None:
            wrong = self.wrong(right, log_times)
            right = np.where(wrong, log_times - self.floor, right)
        return right

    def follow(self, stamps: Stamps, log_times: Stamps) -> Stamps:
        """Return the stamps without the clock's steps and drift, (N,) ns."""
        place = np.searchsorted(np.array(self.begins), log_times, "right") - 1
        right: Stamps = stamps + np.array(self.offsets)[place]
        if self.drift:
            right = right + np.round((right - self.origin) * self.drift).astype(np.int64)
        return right

    def wrong(self, stamps: Stamps, log_times: Stamps) -> Flags:
        """(N,) whether a message cannot have been sent at a corrected stamp."""
        beyond = (log_times - stamps - (self.floor or 0)) * 1e-9
        wrong: Flags = (beyond < -_FUTURE) | (beyond > self.longest)
        return wrong

    def changes(self, times: CameraTimes) -> bool:
        """Whether the correction does anything to a camera's messages."""
        return bool((times.corrected(self).stamps != times.stamps).any())

    def plus(self, seconds: float) -> ClockCorrection:
        """Return the correction with a constant more."""
        shift = round(seconds * 1e9)
        offsets = tuple(offset + shift for offset in self.offsets)
        floor = None if self.floor is None else self.floor - shift
        return replace(self, offsets=offsets, floor=floor)


class ClockVerdict(NamedTuple):
    """Corrections and faults of all clocks of a log."""

    corrections: dict[str, ClockCorrection]  # by camera
    faults: tuple[ClockFault, ...]  # in the order of their times


def clock_verdict(
    cameras: Mapping[str, CameraTimes], given: Mapping[str, float] | None = None
) -> ClockVerdict:
    """Return what is known of the clocks of a log from the times of all its messages.

    ``given`` are seconds that the user adds to the stamps of some cameras. Their offsets are taken
    as right, their steps and drifts are looked for all the same.
    """
    given = given or {}
    clocks = {
        name: times.moved(given.get(name, 0.0))
        for name, times in sorted(cameras.items())
        if len(times.stamps)
    }
    fixed, faults = corrections_of(clocks, set(given))
    fixed = {name: _with_limits(fixed[name], times) for name, times in clocks.items()}
    right = {name: times.corrected(fixed[name]) for name, times in clocks.items()}
    faults += _late(right)
    faults += _wrong(clocks, fixed)
    for name, seconds in given.items():
        if name in fixed:
            fixed[name] = replace(fixed[name].plus(seconds), floor=fixed[name].floor)
    faults.sort(key=lambda fault: (fault.at_ns, fault.camera))
    return ClockVerdict(fixed, tuple(faults))


def corrections_of(
    clocks: Mapping[str, CameraTimes], given: Set[str] = frozenset()
) -> tuple[dict[str, ClockCorrection], list[ClockFault]]:
    """Return the corrections of clocks over a window, and the faults that they remove.

    A window is a whole log, or the last seconds of a live one. A camera's part that is most like
    the others keeps its stamps. Offsets of ``given`` cameras are right.
    """
    steps = _find_steps(clocks)
    levels = {name: _usual(times.lags, steps[name]) for name, times in clocks.items()}
    faults: list[ClockFault] = []
    fixed: dict[str, ClockCorrection] = {}
    for name, times in clocks.items():
        beside = [levels[camera][0] for camera in clocks if camera != name]
        fixed[name], named = _stepped(name, times, steps[name], levels[name], beside)
        faults += named
    fixed = _level(clocks, fixed, faults, given)
    return _without_drift(clocks, fixed, faults), faults


def _wrong(
    cameras: Mapping[str, CameraTimes], fixed: Mapping[str, ClockCorrection]
) -> Iterator[ClockFault]:
    """Yield which cameras have single messages with times that make no sense."""
    for name, times in cameras.items():
        stamps = times.followed(fixed[name]).stamps
        wrong = np.flatnonzero(fixed[name].wrong(stamps, times.log_times))
        if len(wrong):
            right = times.corrected(fixed[name]).stamps[wrong]
            errors = (stamps[wrong] - right) * 1e-9
            worst = float(errors[np.argmax(np.abs(errors))])
            yield ClockFault(name, WRONG, worst, int(right[0]), corrected=True, messages=len(wrong))


def _with_limits(correction: ClockCorrection, times: CameraTimes) -> ClockCorrection:
    """Add the least lag of a camera, and the longest one if longer ones are wrong times."""
    followed = times.followed(correction)
    lags, (right, wrong) = times.log_times - followed.stamps, _judged(followed)
    floor = int(np.quantile(lags[~wrong], 0.05, method="lower"))
    early = (lags[wrong] - floor) * 1e-9
    early, late = early[early > _FUTURE], float((lags[right] - floor).max() * 1e-9)
    if not early.size or early.min() < late:
        return replace(correction, floor=floor)
    return replace(correction, floor=floor, longest=(float(early.min()) + late) / 2)


def _judged(times: CameraTimes) -> tuple[Flags, Flags]:
    """(N,) which messages have a right time, and which have one that the others contradict.

    The others leave a gap where such a message was logged, and none at its stamp. The stamp of a
    message that was delivered late lies in a gap of its own; where it was logged, others may be
    lost by chance. A message with an odd lag at the begin or end of the log has no others around
    it, and is neither.
    """
    stamps, lags = times.stamps, times.lags
    right, wrong = np.ones(len(stamps), np.bool_), np.zeros(len(stamps), np.bool_)
    is_odd = np.abs(lags - median(lags)) > _FUTURE
    usual, odd = np.flatnonzero(~is_odd), np.flatnonzero(is_odd)
    if len(usual) < _LEAST:
        return right, wrong
    right[: usual[0]] = right[usual[-1] + 1 :] = False
    odd = odd[(odd > usual[0]) & (odd < usual[-1])]
    lacking = _lacking(stamps, usual)
    suspects = odd[lacking[odd] > 0]
    places, chance = len(np.unique(lacking[suspects])), float(np.mean(lacking[usual] > 0))
    # Wrong stamps at a regular distance lie in each other's gaps.
    if _happens(places, len(odd), chance):
        seconds = np.asarray((stamps - stamps[usual[0]]) * 1e-9, np.float64)
        suspects = suspects[~_fits_a_gap(np.sort(seconds[usual]), seconds[suspects])]
    wrong[suspects] = True
    return right & ~wrong, wrong


def _happens(hits: int, trials: int, chance: float) -> bool:
    """Whether so many hits are likely enough: at most (trials over hits) chance^hits."""
    if chance == 0:
        return hits == 0
    # By logarithms: the numbers of a long log are no floats.
    ways = math.lgamma(trials + 1) - math.lgamma(hits + 1) - math.lgamma(trials - hits + 1)
    return ways + hits * math.log(chance) > math.log(_BY_CHANCE)


def _is_wide(around: Stamps | Floats) -> Flags:
    """(N,) which of increasing times come late after the one before: a message lacks."""
    intervals = np.diff(around, prepend=around[0])
    return np.asarray(intervals > _WIDE * median(intervals))


def _lacking(stamps: Stamps, usual: Stamps) -> Stamps:
    """(N,) the number of the gap that the others leave where a message was logged, 0 if none.

    Messages may overtake each other. So the gap is looked for between the first of those that were
    logged later and the last of those before. One in which the message's own stamp lies is none.

    Parameters
    ----------
    stamps : (N,) ns, in the order of the log. usual : the messages with a usual lag.
    """
    around, order = np.sort(stamps[usual]), np.searchsorted(usual, np.arange(len(stamps)))
    latest = np.maximum.accumulate(stamps[usual])
    earliest = np.minimum.accumulate(stamps[usual][::-1])[::-1]
    before = np.searchsorted(around, latest[np.maximum(order - 1, 0)])
    after = np.searchsorted(around, earliest[np.minimum(order, len(usual) - 1)])
    overtaken = after <= before
    first = np.maximum(np.where(overtaken, after - 1, before), 0)
    last = np.minimum(np.where(overtaken, before + 1, after), len(usual) - 1)
    is_wide = _is_wide(around)
    gaps, own = np.cumsum(is_wide), np.minimum(np.searchsorted(around, stamps), len(usual) - 1)
    is_own = is_wide[own] & (first < own) & (own <= last) & (around[own] != stamps)
    return np.where(gaps[last] - gaps[first] > is_own, gaps[last], 0)


def _fits_a_gap(around: Floats, stamps: Floats) -> Flags:
    """(K,) whether the others, with increasing stamps, leave a gap at some stamps, s.

    A message at a regular time is never nearer to others than half of the usual interval. One at an
    irregular time comes as near to them as they come to each other.
    """
    intervals = np.diff(around)
    own = np.minimum(intervals[1:], intervals[:-1])
    least = min(median(intervals) / 2, float(np.quantile(own, 0.05)))
    place = np.clip(np.searchsorted(around, stamps), 1, len(around) - 1)
    nearest = np.minimum(np.abs(stamps - around[place - 1]), np.abs(around[place] - stamps))
    inside = (stamps > around[0]) & (stamps < around[-1])
    return np.asarray((nearest > least) & (inside | (nearest < _PAUSE)))


# Steps


Step = tuple[int, float]
"""The message before which a clock was set, and how far it went ahead, s."""


def _find_steps(cameras: Mapping[str, CameraTimes]) -> dict[str, list[Step]]:
    """Find the steps of each camera's clock."""
    late = _recorder(cameras)
    return {name: _steps(times, late[name]) for name, times in cameras.items()}


def _steps(times: CameraTimes, late: Floats) -> list[Step]:
    """Find the steps of a clock, the largest first, each on what the former ones leave.

    ``late`` is by how much the recorder is late at each message, s.
    """
    if len(times.stamps) < _LEAST:
        return []
    start = int(times.log_times[0])
    stamps = np.asarray((times.stamps - start) * 1e-9, np.float64)
    logged = np.asarray((times.log_times - start) * 1e-9 - late, np.float64)
    steps: list[Step] = []
    for _ in range(100):  # no camera has more steps
        largest = _largest_step(stamps, logged)
        if largest is None:
            break
        steps.append(largest)
        place, seconds = largest
        stamps[place:] -= seconds
    return sorted(steps)


def _recorder(cameras: Mapping[str, CameraTimes]) -> dict[str, Floats]:
    """Camera -> (N,) by how much the recorder is late at its messages, s: as the others' lags tell.

    It is smooth, without the delays of single messages, and known every 20 ms.
    """
    late = {name: np.zeros(len(times.stamps)) for name, times in cameras.items()}
    known = {name: times for name, times in cameras.items() if len(times.stamps) >= _LEAST}
    if len(known) < 2:
        return late
    logged = np.concatenate([times.log_times for times in known.values()])
    moments = np.unique(logged // _MOMENT) * _MOMENT
    rows = np.array([
        np.interp(moments, times.log_times, _smooth(_lateness(times)))
        for times in known.values()
    ])  # fmt: skip
    middle = len(rows) // 2 - 1  # of the others; one of two that is late is not
    low, high = np.partition(rows, (middle, middle + 1), axis=0)[middle : middle + 2]
    for (name, times), own in zip(known.items(), rows, strict=True):
        lags = np.where(own <= low, high, low)
        late[name] = np.interp(times.log_times, moments, lags)
    return late


def _lateness(times: CameraTimes) -> Floats:
    """(N,) by how much a camera's messages are late, s."""
    lags = times.lags
    return np.asarray(lags - _tenth(lags))


def _smooth(values: Floats) -> Floats:
    """(N,) median of each value and its neighbours."""
    before, after = np.append(values[:1], values[:-1]), np.append(values[1:], values[-1:])
    low, high = np.minimum(before, after), np.maximum(before, after)
    return np.asarray(np.maximum(low, np.minimum(high, values)))


def _largest_step(stamps: Floats, logged: Floats) -> Step | None:
    """Return the largest step of a clock, None if there is none."""
    period = _period(stamps)
    intervals, lags = np.diff(stamps), logged - stamps
    odd = np.flatnonzero(np.abs(intervals - period) > _IRREGULAR) + 1
    odd = odd[(odd >= _LEAST_AFTER) & (odd <= len(lags) - _LEAST_AFTER)]
    least = _LEAST_STEP + _LARGEST_DRIFT * np.maximum(intervals[odd - 1], 0.0)
    near = lags[odd[:, None] + np.arange(-_LEAST_AFTER, _LEAST_AFTER)]
    before, after = np.split(near, 2, axis=1)
    # Most that is odd are lost messages, beside which the lags are alike.
    parts = np.abs(before.mean(axis=1) - after.mean(axis=1)) > _PARTED * least
    if not parts.any():
        return None
    odd, least, before, after = odd[parts], least[parts], before[parts], after[parts]
    noise = 1.48 * median(np.abs(intervals - period))
    jumps = -np.diff(lags)
    jitter = 1.48 * median(np.abs(jumps))
    around = np.pad(lags, _STEP_SIDE, constant_values=np.nan)
    sides = np.lib.stride_tricks.sliding_window_view(around, _STEP_SIDE)
    (level, sd), (level_after, sd_after) = _medians(sides[odd]), _medians(sides[odd + _STEP_SIDE])
    shifts, errors = level - level_after, np.hypot(sd, sd_after)
    size = np.abs(shifts)
    falls, rises = before.min(axis=1) - after.max(axis=1), after.min(axis=1) - before.max(axis=1)
    at_once = np.abs(jumps[odd - 1] - shifts) <= np.maximum(0.3 * size, max(4 * jitter, 0.02))
    is_apart = np.where(shifts > 0, falls, rises) > _PARTED * size
    is_whole = (odd >= _STEP_SIDE) & (odd <= len(lags) - _STEP_SIDE)
    is_likely = (size >= least) & at_once & (is_apart | (is_whole & (size > _SURE * errors)))
    steps: list[tuple[float, Step]] = []
    for i in np.flatnonzero(is_likely).tolist():
        k, usual = int(odd[i]), (period, noise, float(errors[i]))
        seconds = _explained(float(intervals[k - 1]), float(shifts[i]), usual)
        if seconds:
            steps.append((abs(seconds), (k, seconds)))
    for _, step in sorted(steps, key=lambda pair: -pair[0]):
        if _lasts(step, stamps, logged) and not _closes_gaps(stamps[: step[0]], stamps[step[0] :]):
            return step
    return None


def _medians(rows: Floats) -> tuple[Floats, Floats]:
    """Return (K,) medians of rows of numbers, some NaN, and their SDs by the median deviation."""
    counts = np.count_nonzero(~np.isnan(rows), axis=1)
    middle = _middle(rows, counts)
    return middle, 1.86 * _middle(np.abs(rows - middle[:, None]), counts) / np.sqrt(counts)


def _middle(rows: Floats, counts: Stamps) -> Floats:
    """(K,) median of so many numbers of each row; the rest of a row is NaN."""
    ordered, k = np.sort(rows, axis=1), np.arange(len(rows))
    return np.asarray((ordered[k, (counts - 1) // 2] + ordered[k, counts // 2]) / 2)


def _period(stamps: Floats) -> float:
    """Return the usual interval between stamps, s."""
    intervals = np.diff(stamps)
    usual = intervals[(intervals > 0) & (intervals < _PAUSE)]
    return median(usual) if usual.size else _PAUSE


def _explained(interval: float, shift: float, usual: tuple[float, float, float]) -> float:
    """Return the step that explains an odd interval better than lost messages do, 0 if none does.

    ``usual`` are the period, its SD, and the SD of ``shift``, by which the lag falls; all in s.
    """
    period, noise, error = usual
    if abs(shift) < 4 * error:
        return 0.0
    spread = max(0.004, noise)
    left = _oddity(interval - shift, period, float(np.hypot(spread, error)))
    if _oddity(interval, period, spread) - left < 1.5:
        return 0.0
    n = max(1, round((interval - shift) / period))
    near = n < 10 and abs(interval - shift - n * period) < period / 3 and error < period / 8
    # The stamps of a regular camera tell the step more exactly than the delays do.
    return interval - n * period if near and noise < 0.004 else shift


def _oddity(interval: float, period: float, spread: float) -> float:
    """Return how odd an interval between stamps is: lost messages and the rest, in SDs."""
    if interval < 0.3 * period:
        return 20.0
    if interval > _PAUSE:
        return 10.0
    n = max(1, round(interval / period))
    return min(n - 1, 5) + min(abs(interval - n * period) / spread, 6.0)


def _lasts(step: Step, stamps: Floats, logged: Floats) -> bool:
    """Whether the least lag changes, too: a late delivery ends where it began."""
    lags, (k, seconds) = logged - stamps, step
    before = lags[:k][logged[:k] > logged[k] - _LASTING]
    after = lags[k:][logged[k:] < logged[k] + _LASTING]
    if min(before.size, after.size) < _LEAST_AFTER:
        return False
    change = _tenth(before) - _tenth(after)
    return change / seconds > 0.5


def _closes_gaps(before: Floats, behind: Floats) -> bool:
    """Whether stamps that go back lie in gaps of those before, or are the first: they come late."""
    around, again = np.sort(before), behind[behind < before.max()]
    is_wide = _is_wide(around)
    is_wide[0] = True
    closed = is_wide[np.searchsorted(around, again)] & _fits_a_gap(around, again)
    return bool(len(again)) and bool(closed.mean() > 0.5)


def _usual(lags: Floats, steps: list[Step]) -> list[float]:
    """Return the usual lag between steps, s."""
    places = [0, *(place for place, _ in steps), len(lags)]
    return [median(lags[a:b]) for a, b in pairwise(places)]


def _stepped(
    name: str, times: CameraTimes, steps: list[Step], levels: list[float], others: list[float]
) -> tuple[ClockCorrection, list[ClockFault]]:
    """Return the correction of steps, and what to say of them.

    The part of the log whose lag is most like the other cameras' keeps its stamps; the first one
    if they are alike.
    """
    ahead = np.cumsum([0.0, *(seconds for _, seconds in steps)])
    usual = median(np.array(others)) if others else levels[0]
    strange = [abs(level - usual) for level in levels]
    right = 0 if strange[0] <= min(strange) + _LEAST_STEP else int(np.argmin(strange))
    offsets = np.round((ahead[right] - ahead) * 1e9).astype(np.int64)
    begins = [int(times.log_times[place]) for place, _ in steps]
    correction = ClockCorrection((-(2**63), *begins), tuple(offsets.tolist()))
    stamps = times.followed(correction).stamps
    return correction, [
        ClockFault(name, STEP, seconds, int(stamps[place]), corrected=True)
        for place, seconds in steps
    ]


# Offsets that no delivery explains


def _level(
    cameras: Mapping[str, CameraTimes],
    fixed: dict[str, ClockCorrection],
    faults: list[ClockFault],
    given: Set[str],
) -> dict[str, ClockCorrection]:
    """Align clocks that differ by more than any delivery takes, and name them."""
    lags = {name: median(times.followed(fixed[name]).lags) for name, times in cameras.items()}
    if not lags:
        return fixed
    usual = middle_of(lags)
    result = dict(fixed)
    for name, lag in lags.items():
        if abs(lag - usual) > LONGEST_DELAY and name not in given:
            result[name] = fixed[name].plus(lag - usual)
            first = int(cameras[name].log_times[0] - round(usual * 1e9))
            faults.append(ClockFault(name, OFFSET, usual - lag, first, corrected=True))
    return result


def middle_of(values: Mapping[str, float]) -> float:
    """Return the median; of two values the one nearer to 0, as a right clock's lag is."""
    ordered = sorted(values.values())
    if len(ordered) == 2:
        return min(ordered, key=abs)
    return ordered[(len(ordered) - 1) // 2]


def median(values: Floats | Stamps) -> float:
    """Return the median of some numbers, none of them NaN: NumPy's takes several times as long.

    A live run asks for dozens of each camera in every second.
    """
    half, is_odd = divmod(len(values), 2)
    ordered = np.partition(values, half)
    return float(ordered[half] if is_odd else (ordered[:half].max() + ordered[half]) / 2)


def _tenth(values: Floats) -> float:
    """Return what a tenth of some numbers lie below, between two of them as np.quantile does."""
    place = 0.1 * (len(values) - 1)
    k, share = int(place), place % 1.0
    ordered = np.sort(values)
    low, high = float(ordered[k]), float(ordered[min(k + 1, len(ordered) - 1)])
    step = high - low
    return high - step * (1 - share) if share >= 0.5 else low + step * share


# Drifts


def _without_drift(
    cameras: Mapping[str, CameraTimes],
    fixed: dict[str, ClockCorrection],
    faults: list[ClockFault],
) -> dict[str, ClockCorrection]:
    """Correct and name clocks that run faster or slower than the others."""
    followed = {name: times.followed(fixed[name]) for name, times in cameras.items()}
    result = dict(fixed)
    for name, slope in find_drifts(followed).items():
        first = int(followed[name].stamps[0])
        # The log's time is taken as right: a clock ahead by more and more has shrinking lags.
        result[name] = replace(fixed[name], drift=slope / (1 - slope), origin=first)
        faults.append(ClockFault(name, DRIFT, -slope, first, corrected=True))
    return result


def find_drifts(cameras: Mapping[str, CameraTimes]) -> dict[str, float]:
    """Camera -> by how much its lag grows, s per s, more than that of the others; if it does."""
    if len(cameras) < 2:
        return {}
    seconds, table = _least_lags(list(cameras.values()))
    slopes = [_slope(seconds, row) for row in table - _common(seconds, table)]
    return {name: slope for name, slope in zip(cameras, slopes, strict=True) if slope}


def _least_lags(cameras: Sequence[CameraTimes]) -> tuple[Stamps, Floats]:
    """Return (n,) seconds of the log that have messages, and (C, n) least lags in them, s.

    A lag is NaN where a camera has no message. One message may be logged decades from the others:
    the empty seconds between take no memory.
    """
    start = min(int(times.log_times[0]) for times in cameras)
    logged = [(times.log_times - start) // 1_000_000_000 for times in cameras]
    seconds = np.unique(np.concatenate(logged))
    table = np.full((len(cameras), len(seconds)), np.inf)
    for row, logs, times in zip(table, logged, cameras, strict=True):
        np.minimum.at(row, np.searchsorted(seconds, logs), times.lags)
    table[np.isinf(table)] = np.nan
    return seconds, table


def _common(seconds: Stamps, table: Floats) -> Floats:
    """(n,) How the lags of most of (C, n) cameras change; the recorder does that.

    Of two cameras, it is the one whose lags change less.
    """
    present = ~np.isnan(table)
    lags = table - _middle(table, present.sum(axis=1))[:, None]
    if len(table) == 2:
        steady = int(np.argmin([abs(_line(seconds, row)[0]) for row in lags]))
        return np.asarray(lags[steady])
    counts = present.sum(axis=0)
    return np.where(counts > 1, _middle(lags.T, counts), np.nan)


def _slope(seconds: Stamps, lags: Floats) -> float:
    """Return a drift of (n,) lags at some seconds, 0 if they do not follow a line throughout."""
    present = np.flatnonzero(~np.isnan(lags))
    if len(present) < _LEAST_SECONDS:
        return 0.0
    slope, error = _line(seconds, lags)
    span = float(seconds[present[-1]] - seconds[present[0]])
    if abs(slope) < max(_LEAST_DRIFT, 6 * error) or abs(slope) * span < _LEAST_DRIFTED:
        return 0.0
    middle = present[len(present) // 2]
    halves = [_line(seconds[part], lags[part]) for part in (slice(middle), slice(middle, None))]
    worst = max(abs(half - slope) - 2 * sd for half, sd in halves)
    return slope if worst < 0.3 * abs(slope) else 0.0


def _line(seconds: Stamps, values: Floats) -> tuple[float, float]:
    """Return the slope of values at some seconds, some NaN, by Theil and Sen, and its SD."""
    present = np.flatnonzero(~np.isnan(values))
    present = present[:: max(1, len(present) // 300)]
    if len(present) < 3:
        return 0.0, np.inf
    at, values = seconds[present], values[present]
    first, second = np.triu_indices(len(at), 1)
    slope = median((values[second] - values[first]) / (at[second] - at[first]))
    rest = values - slope * at
    spread = max(0.0005, 1.48 * median(np.abs(rest - median(rest))))
    return slope, 1.25 * spread / (float(np.std(at)) * np.sqrt(len(at)))


# Late deliveries, wrong times


def _late(cameras: Mapping[str, CameraTimes]) -> Iterator[ClockFault]:
    """Yield the deliveries of a camera that were late while those of the others were not."""
    late = {name: _lateness(times) for name, times in cameras.items()}
    recorder = _recorder(cameras) if any(s.max() > _LATENESS for s in late.values()) else late
    for name, times in cameras.items():
        alone = late[name] - recorder[name]
        places = np.flatnonzero((late[name] > _LATENESS) & (alone > _LATENESS))
        places = places[np.argsort(times.stamps[places], kind="stable")]
        for group in np.split(places, np.flatnonzero(np.diff(times.stamps[places]) > 2e9) + 1):
            if len(group) >= _LEAST_AFTER:
                worst = float(alone[group].max())
                first = int(times.stamps[group].min())
                yield ClockFault(name, LATE, worst, first, corrected=True, messages=len(group))


def longest_wait(cameras: Iterable[CameraTimes]) -> float:
    """Return the longest time, s, by which a message is older than one that came before it."""
    camera_times = list(cameras)
    if not camera_times:
        return 0.0
    stamps = np.concatenate([times.stamps for times in camera_times])
    order = np.argsort(np.concatenate([times.log_times for times in camera_times]), kind="stable")
    ordered = stamps[order]
    late = (np.maximum.accumulate(ordered) - ordered) * 1e-9
    return float(late[late < LONGEST_WAIT].max())


# Words


_LONGEST_LOG_S = 1e7


def described(fault: ClockFault, start: int) -> str:
    """Return a fault in words; ``start``, ns, is when the log starts."""
    seconds = max(0.0, (fault.at_ns - start) * 1e-9)
    # A log time of 0 and a stamp of today are no times of one log.
    is_known = seconds < _LONGEST_LOG_S
    at = f", {seconds:.1f} s after the start of the log" if is_known else ""
    size, way = fault.size.lstrip("+-"), "ahead" if fault.seconds > 0 else "back"
    if fault.kind == STEP:
        return f"the clock of {fault.camera} was set {way} by {size}{at}"
    if fault.kind == DRIFT:
        pace = "fast" if fault.seconds > 0 else "slow"
        return f"the clock of {fault.camera} runs {pace}: {fault.size}"
    if fault.kind == OFFSET:
        way = "ahead of" if fault.seconds > 0 else "behind"
        return f"the clock of {fault.camera} is {size} {way} the other cameras"
    if fault.kind == LATE:
        messages = quantity(fault.messages, "message")
        since = at.replace(", ", ", from ") + " on" if at else ""
        return f"{fault.camera}: {messages} arrived up to {size} late{since}"
    messages = quantity(fault.messages, "message")
    return f"{fault.camera}: {messages} with a wrong time (by up to {size}){at}"


def clocks_in_words(cameras: Mapping[str, CameraTimes], start: int) -> tuple[str, ...]:
    """Return everything that times alone say about the clocks of a log, in words."""
    corrections, faults = clock_verdict(cameras)
    texts = [described(fault, start) for fault in faults]
    lags = {name: median(cameras[name].corrected(c).lags) for name, c in corrections.items()}
    for name, lag in lags.items() if len(lags) > 1 else ():
        ahead = middle_of(lags) - lag
        if abs(ahead) > _REMARKABLE:
            size = ClockFault(name, OFFSET, ahead, start, corrected=False).size.lstrip("+-")
            which = "ahead, or its delivery is faster" if ahead > 0 else "behind, or it is slower"
            texts.append(
                f"{name}: messages come {size} {'sooner' if ahead > 0 else 'later'} after their "
                f"stamps than those of the other cameras; its clock is {which}"
            )
    return tuple(texts)
