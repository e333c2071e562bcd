"""Limb calibration (Hi-ROS 2023, section 3.3.1, eq. 13), by itself and while the log runs.

People are measured as they come. After ``lookahead`` seconds (or as soon as they leave) their
limb lengths are settled, or rejected by the paper's quality gate and tried again with the next
frames. From then on every block of frames refines them a little.

Noise makes limbs longer: a joint error across the limb adds to its length, whatever its sign. For
noise of variance s2 per axis on d = a - b, isotropic, E|d|^2 = l^2 + 3 s2 and var |d|^2 =
4 l^2 s2 + 6 s2^2; solved for the length, l^4 = E(|d|^2)^2 - 1.5 var |d|^2. That needs no knowledge
of the noise. On simulated cameras it halves the error against the mean or the median (15 s of
two people, root mean square over all links: mean 5.9, median 5.4, this 3.0 mm).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from hiros_mcap.body.limb_table import Limb, LimbTable, link_keys
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.kernels import optimizing as kernels
from hiros_mcap.params import Params
from hiros_mcap.skeletons import Floats, Frame, People, SkeletonModel

_SECOND = 1_000_000_000
_GONE = _SECOND  # unseen for so long, a person has left and nothing is gained by waiting
_FORGET = 60 * _SECOND  # then the measurements of somebody never calibrated are dropped
_SPAN = 3 * _SECOND  # several cameras fill a block fast, but noise takes its time to average out
_CLIP = 3.0  # robust standard deviations


class CalibrationParams(Params):
    """How limb lengths are found."""

    calibration: Literal["auto", "two-pass", "off"] = Field(
        "auto",
        description="auto: from each person's own frames, while the log runs. two-pass: from the "
        "whole log, read once before (most accurate, lengths strictly constant). off: only limbs "
        "that were loaded.",
    )
    calibration_frames: int = Field(
        100,
        ge=2,
        description="Measurements of a person that one calibration takes (K in section 3.3.1; 100 "
        "in the published implementation).",
    )
    lookahead: float = Field(
        10.0,
        ge=0.0,
        description="Seconds that a person's first frames are held back, so that they too are "
        "optimized, with the lengths that they contribute to. 10 s rather than 100 frames takes "
        "a quarter off the error of the lengths; 0 for real time: frames pass unchanged until "
        "calibration_frames have been seen.",
    )
    calibration_windows: tuple[tuple[float, float], ...] = Field(
        (),
        description="Calibrate only from these windows, each (start, end) in seconds from the "
        "log's start: when the people stand still and well visible. Empty: everywhere.",
    )
    max_variation: float = Field(
        0.2,
        gt=0.0,
        description="Quality gate: a calibration is rejected when a link's length varies by more "
        "than this, relative (standard deviation / length; 0.2 in the published implementation).",
    )
    short_link: float = Field(
        0.15,
        ge=0.0,
        description="Links shorter than this, m, are judged by max_variation as if they were this "
        "long: the noise of a joint does not shrink with the bone, and a hand of 5 cm with 2 cm "
        "noise would reject everybody.",
    )
    max_free: float = Field(
        0.3,
        ge=0.0,
        le=1.0,
        description="Share of the links that may fail the gate: they keep the lengths that are "
        "measured, the others are made constant. With more, the person is not calibrated. 0 = one "
        "failing link is enough (the paper); but then one thumb that a single camera guesses "
        "leaves a whole body as it was.",
    )
    debias: bool = Field(
        True,
        description="Correct for the lengthening by noise. false: plain (robust) mean, as the "
        "paper has it.",
    )
    symmetric: bool = Field(
        False,
        description="Give links whose names differ by left and right their common mean. Off: it "
        "helps after a short calibration, but not everybody is symmetric.",
    )
    refine: bool = Field(
        True, description="Go on measuring after the calibration and adjust the lengths slowly."
    )
    max_refinement: float = Field(
        0.01,
        ge=0.0,
        le=0.5,
        description="Largest relative change by refinement: lengths are to stay constant within "
        "a person, so it moves little.",
    )

    @model_validator(mode="after")
    def _check_windows(self) -> CalibrationParams:
        for start, end in self.calibration_windows:
            if not 0.0 <= start < end:
                raise ValueError(f"calibration window ({start}, {end}): start must precede end")
        return self


@dataclass(slots=True)
class Moments:
    """Weighted sums of squared lengths, per link, that further measurements add to."""

    weight: Floats
    """(L,) sum of the weights."""
    first: Floats
    """(L,) weighted sum of |d|^2."""
    second: Floats
    """(L,) weighted sum of |d|^4."""
    count: npt.NDArray[np.int64]
    """(L,) number of measurements."""

    @classmethod
    def none(cls, n_links: int) -> Moments:
        """Nothing measured yet."""
        zeros = np.zeros((3, n_links))
        return cls(zeros[0], zeros[1], zeros[2], np.zeros(n_links, np.int64))

    @classmethod
    def of(cls, lengths: Floats, weights: Floats) -> Moments:
        """Add up (K, L) measurements, NaN = not seen, outliers pulled in to 3 robust SD."""
        seen = ~np.isnan(lengths) & (weights > 0.0)
        squares = np.where(seen, lengths, np.nan) ** 2
        centre = _median(squares)
        spread = _CLIP * 1.4826 * _median(np.abs(squares - centre))
        squares = np.clip(squares, centre - spread, centre + spread)
        w = np.where(seen, weights, 0.0)
        squares = np.where(seen, squares, 0.0)
        return cls(
            w.sum(axis=0), (w * squares).sum(axis=0), (w * squares**2).sum(axis=0), seen.sum(axis=0)
        )

    def add(self, other: Moments, links: npt.NDArray[np.bool_]) -> None:
        """Add measurements of some links."""
        self.weight += np.where(links, other.weight, 0.0)
        self.first += np.where(links, other.first, 0.0)
        self.second += np.where(links, other.second, 0.0)
        self.count += np.where(links, other.count, 0)

    def lengths(self, debias: bool) -> tuple[Floats, Floats]:
        """(L,) lengths and their standard deviations, m; NaN where nothing was measured."""
        weight = np.where(self.weight > 0.0, self.weight, np.nan)
        mean = self.first / weight
        variance = np.maximum(self.second / weight - mean**2, 0.0)
        length = np.sqrt(mean)
        deviation = np.sqrt(variance) / (2.0 * np.maximum(length, 1e-9))
        if debias:
            # Never below 7/10 of the mean: shorter than its own noise, a link's length is a guess.
            length = np.maximum(mean**2 - 1.5 * variance, (0.5 * mean) ** 2) ** 0.25
        else:
            length = np.sqrt(np.maximum(mean - deviation**2, 0.0))  # E|d|^2 - var|d| = (E|d|)^2
        return np.where(length > 1e-6, length, np.nan), deviation


def _median(values: Floats) -> Floats:
    """(L,) medians of the columns of (K, L) without NaN; NaN where there is nothing else."""
    ordered = np.sort(values, axis=0)  # NaN comes last
    count = np.count_nonzero(~np.isnan(values), axis=0)
    columns = np.arange(values.shape[1])
    lower, upper = (
        ordered[np.maximum(count - 1, 0) // 2, columns],
        ordered[count // 2 % len(values), columns],
    )
    return np.where(count > 0, 0.5 * (lower + upper), np.nan)


Mask = npt.NDArray[np.bool_]


@dataclass(slots=True)
class _Lengths:
    """Lengths of a calibrated person's links, (L,) each, m."""

    anchor: Floats
    """As calibrated."""
    target: Floats
    """As refined since."""
    current: Floats
    """In use: on the way from the anchor to the target."""


@dataclass(slots=True)
class _Person:
    """What is known about one person."""

    first: int
    last: int
    good: Moments
    tried: Mask
    waiting: bool
    rows: list[tuple[Floats, Floats]] = field(default_factory=list)
    block_start: int = 0
    known: _Lengths | None = None
    """None before the person is calibrated."""


class Calibration:
    """Measures people as they come and tells their lengths: the state of one run.

    ``limbs`` is filled as people are calibrated; people who are in it from the start keep exactly
    the lengths that are given there.
    """

    def __init__(
        self, model: SkeletonModel, params: CalibrationParams, events: Events, limbs: LimbTable
    ) -> None:
        self.limbs = limbs
        self._model, self._params, self._events = model, params, events
        self._links = np.ascontiguousarray(model.links)
        self._keys = link_keys(model)
        self._mirror = symmetry_of(model).link_mirror
        self._given = {person: limbs.lengths(person, model) for person in limbs.people}
        self._people: dict[int, _Person] = {}
        self._start: int | None = None
        self._checked = 0

    def measure(self, people: People) -> tuple[Floats, Floats]:
        """Lengths (P, L), m, of everybody's links, NaN = not seen, and what each counts."""
        lengths = np.empty((len(people.ids), self._model.n_links))
        weights = np.empty_like(lengths)
        if self._params.calibration != "off":
            kernels.measure(
                people.markers, people.marker_confidences, self._links, lengths, weights
            )
        return lengths, weights

    def observe(
        self, stamp: int, ids: list[int], measured: tuple[Floats, Floats], begin: int, end: int
    ) -> None:
        """Take the rows ``begin`` to ``end`` of what was measured; settle whoever is due."""
        if self._start is None:
            self._start = self._checked = stamp
        if self._params.calibration == "off":
            return
        lengths, weights = measured
        wanted = self._in_window(stamp)
        for row in range(begin, end):
            identity = ids[row]
            if identity < 0 or identity in self._given:
                continue
            person = self._people.get(identity) or self._meet(identity, stamp)
            person.last = stamp
            if wanted:
                self._measure(identity, person, lengths[row], weights[row])
            if person.waiting and stamp - person.first >= self._params.lookahead * _SECOND:
                self._settle(identity, person)
        if stamp - self._checked > _SECOND:
            self._check_absent(stamp)

    def waits_for(self, ids: list[int]) -> bool:
        """Whether one of these people may get lengths soon, so that it is worth holding back."""
        people = map(self._people.get, ids)
        return any(person is not None and person.waiting for person in people)

    def nominal(self, ids: list[int]) -> Floats:
        """(P, L) lengths to use in a frame, m, NaN where there are none; advances them."""
        lengths = np.full((len(ids), self._model.n_links), np.nan)
        for row, identity in enumerate(ids):
            if identity in self._given:
                lengths[row] = self._given[identity]
            elif (person := self._people.get(identity)) and (known := person.known):
                known.current += (known.target - known.current) / self._params.calibration_frames
                lengths[row] = known.current
        return lengths

    def finish(self) -> None:
        """Settle everybody with what there is: the log has ended."""
        for identity, person in self._people.items():
            if person.known is None:
                self._settle(identity, person)
                if person.known is None and person.rows:
                    self._reject(person, identity, f"{len(person.rows)} frames are too few")
            elif len(person.rows) >= self._enough:
                self._refine(identity, person, person.known)

    @property
    def _enough(self) -> int:
        """A third of a block, where there is no more to wait for."""
        return max(2, self._params.calibration_frames // 3)

    def _in_window(self, stamp: int) -> bool:
        windows = self._params.calibration_windows
        seconds = (stamp - (self._start or 0)) / _SECOND
        return not windows or any(start <= seconds < end for start, end in windows)

    def _meet(self, identity: int, stamp: int) -> _Person:
        n = self._model.n_links
        person = _Person(
            first=stamp,
            last=stamp,
            good=Moments.none(n),
            tried=np.zeros(n, bool),
            waiting=self._params.lookahead > 0.0,
        )
        self._people[identity] = person
        return person

    def _measure(self, identity: int, person: _Person, lengths: Floats, weights: Floats) -> None:
        if not person.rows:
            person.block_start = person.last
        person.rows.append((lengths, weights))
        full = len(person.rows) >= self._params.calibration_frames
        if not full or (person.last - person.block_start < _SPAN and not self._short_blocks):
            return
        if person.known is not None:
            self._refine(identity, person, person.known)
        elif person.waiting:
            self._close_block(person)
        else:
            self._settle(identity, person)

    @property
    def _short_blocks(self) -> bool:
        return bool(self._params.calibration_windows)

    def _close_block(self, person: _Person) -> Mask:
        """Add the links that pass the quality gate to what is good; return which."""
        block = Moments.of(*(np.array(column) for column in zip(*person.rows, strict=True)))
        person.rows.clear()
        length, deviation = block.lengths(self._params.debias)
        limit = self._params.max_variation * np.maximum(length, self._params.short_link)
        seen: Mask = ~np.isnan(length) & (block.count >= 2)
        good: Mask = seen & (deviation <= limit)
        person.good.add(block, good)
        person.tried |= seen
        return good

    def _settle(self, identity: int, person: _Person) -> None:
        """Stop waiting: calibrate from what there is, or reject it."""
        person.waiting = False
        if len(person.rows) >= self._enough or (person.rows and person.tried.any()):
            self._close_block(person)
        if not person.tried.any():
            return
        bad = person.tried & (person.good.count == 0)
        names = ", ".join(key for key, fault in zip(self._keys, bad, strict=True) if fault)
        if bad.sum() > self._params.max_free * person.tried.sum():
            self._reject(person, identity, f"{names} varies too much")
            person.good, person.tried = Moments.none(len(bad)), np.zeros(len(bad), bool)
            return
        lengths = self._estimate(person)
        person.known = _Lengths(anchor=lengths, target=lengths, current=lengths.copy())
        self._record(identity, person)
        frames = int(person.good.count.max())
        free = f", {names} left free" if names else ""
        self._events.note(
            person.last, "limbs calibrated", person=identity, detail=f"{frames} frames{free}"
        )
        self._events.count("limbs left free", n=int(bad.sum()))

    def _reject(self, person: _Person, identity: int, why: str) -> None:
        self._events.count("calibration rejected")
        self._events.note(person.last, "calibration rejected", person=identity, detail=why)

    def _refine(self, identity: int, person: _Person, known: _Lengths) -> None:
        """Let a further block of frames move the lengths within what is allowed."""
        if not self._params.refine or self._params.calibration_windows:
            person.rows.clear()
            return
        self._close_block(person)
        estimate = self._estimate(person)
        fresh = np.isnan(known.anchor)
        known.anchor[fresh] = known.current[fresh] = estimate[fresh]
        reach = self._params.max_refinement * known.anchor
        known.target = np.clip(estimate, known.anchor - reach, known.anchor + reach)
        self._record(identity, person)

    def _estimate(self, person: _Person) -> Floats:
        """(L,) best lengths so far, with the common mean of both sides if they are symmetric."""
        length, _ = person.good.lengths(self._params.debias)
        if not self._params.symmetric:
            return length
        other, n = length[self._mirror], person.good.weight
        both = (n * np.nan_to_num(length) + n[self._mirror] * np.nan_to_num(other)) / np.maximum(
            n + n[self._mirror], 1e-12
        )
        return np.where(np.isnan(length) & np.isnan(other), np.nan, both)

    def _record(self, identity: int, person: _Person) -> None:
        _, deviation = person.good.lengths(self._params.debias)
        columns = self._estimate(person), np.nan_to_num(deviation), person.good.count
        rows = zip(self._keys, *(column.tolist() for column in columns), strict=True)
        self.limbs.people[identity] = {
            key: Limb(length, spread, count)
            for key, length, spread, count in rows
            if not math.isnan(length)
        }

    def _check_absent(self, now: int) -> None:
        """Settle people who left while waited for, forget those who never got calibrated."""
        self._checked = now
        if math.isinf(self._params.lookahead):
            return
        for identity, person in list(self._people.items()):
            if person.waiting and now - person.last > _GONE:
                self._settle(identity, person)
            elif person.known is None and now - person.last > _FORGET:
                del self._people[identity]


def calibrate(
    frames: Iterable[Frame],
    model: SkeletonModel,
    params: CalibrationParams = CalibrationParams(),  # noqa: B008 - immutable
    events: Events | None = None,
) -> LimbTable:
    """Measure the limbs of everybody in a whole log: the first of the two passes.

    Memory does not grow with the log. People who fail the quality gate are not in the table;
    ``events`` names the link ("calibration rejected").
    """
    patient = params.model_copy(update={"lookahead": math.inf, "calibration": "auto"})
    calibration = Calibration(model, patient, events or Events(), LimbTable())
    for frame in frames:
        people = Block.of(frame).people
        measured = calibration.measure(people)
        calibration.observe(frame.stamp, frame.ids.tolist(), measured, 0, frame.n_people)
    calibration.finish()
    return calibration.limbs
