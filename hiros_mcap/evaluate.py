"""How far skeletons are from the truth, in the measures of the Hi-ROS paper (section 4).

People are matched to the true ones frame by frame, the truth is interpolated to the frame's time,
and errors are taken per joint. Angles are the eight flexions of the paper (eq 20).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from hiros_mcap.angles import flexions
from hiros_mcap.kernels.tracking import assign
from hiros_mcap.rotations import angle
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, SkeletonModel

MATCH_DISTANCE = 1.0
"""m: a skeleton farther than this from every true person, on average, is of nobody."""


@dataclass(frozen=True, slots=True)
class Scores:
    """Measures over all frames and people of one channel against the truth."""

    mean: float
    """Mean joint error, mm."""
    deviation: float
    """Standard deviation of the joint error, mm."""
    percentile_95: float
    """95 % of the joint errors are below, mm."""
    angle_rmse: float
    """Root mean square error of the eight flexion angles, degrees (eq 20); NaN without them."""
    angle_deviation: float
    """Standard deviation of the angles' errors, degrees (the bias-free error)."""
    turn_error: float
    """Mean angle between a link's orientation and the true one (eq 10), degrees."""
    limb_variation: float
    """Mean over people and links of the coefficient of variation of the length."""
    jitter: float
    """Mean norm of the second difference of joint positions between frames, mm."""
    lag: float
    """By how many ms the result is late: the shift that fits the truth best."""
    missing: int
    """True people that no skeleton was matched to, summed over frames."""
    false: int
    """Skeletons with an id that are of nobody, or of somebody twice, summed over frames."""
    switches: int
    """How often a true person's id changed."""
    frames: int


@dataclass(slots=True)
class Truth:
    """True skeletons as arrays over time: T instants, N people."""

    stamps: npt.NDArray[np.int64]
    positions: Floats
    """(T, N, M, 3) m, NaN where a person is absent."""
    turns: Floats
    """(T, N, L, 4) x y z w."""

    @classmethod
    def of(cls, frames: Iterable[Frame]) -> Truth:
        """Collect frames whose ids are the true people; sorted by time."""
        ordered = sorted(frames, key=lambda frame: frame.stamp)
        people = sorted({int(i) for frame in ordered for i in frame.ids})
        row = {person: n for n, person in enumerate(people)}
        shape = (len(ordered), len(people))
        positions = np.full((*shape, *ordered[0].markers.shape[1:2], 3), np.nan)
        turns = np.full((*shape, *ordered[0].links.shape[1:2], 4), np.nan)
        for t, frame in enumerate(ordered):
            for p, person in enumerate(frame.ids):
                positions[t, row[int(person)]] = frame.positions[p]
                turns[t, row[int(person)]] = frame.orientations[p]
        return cls(np.array([frame.stamp for frame in ordered]), positions, turns)

    def covers(self, stamp: int) -> bool:
        """Whether ``stamp`` lies between the first and the last true instant."""
        return bool(self.stamps[0] <= stamp <= self.stamps[-1])

    def at(self, stamp: int) -> tuple[Floats, Floats]:
        """(N, M, 3) positions and (N, L, 4) orientations, linear between the neighbours."""
        after = int(np.clip(np.searchsorted(self.stamps, stamp), 1, len(self.stamps) - 1))
        early, late = self.stamps[after - 1], self.stamps[after]
        part = float(stamp - early) / float(late - early)
        positions = (1 - part) * self.positions[after - 1] + part * self.positions[after]
        first, second = self.turns[after - 1], self.turns[after]
        sign = np.sign(np.sum(first * second, axis=-1, keepdims=True))
        turns = (1 - part) * first + part * sign * second
        norm = np.linalg.norm(turns, axis=-1, keepdims=True)
        return positions, turns / np.where(norm > 0, norm, np.nan)


@dataclass(slots=True)
class _Tally:
    """What is collected over the frames of a channel."""

    errors: list[Floats] = field(default_factory=list)
    angles: list[Floats] = field(default_factory=list)
    turns: list[Floats] = field(default_factory=list)
    tracks: dict[int, list[tuple[int, Floats]]] = field(default_factory=dict)
    pairs: list[tuple[int, int, Floats]] = field(default_factory=list)
    names: dict[int, int] = field(default_factory=dict)
    missing: int = 0
    false: int = 0
    switches: int = 0
    frames: int = 0


def evaluate(frames: Iterable[Frame], truth: Truth, model: SkeletonModel) -> Scores:
    """Score the tracked people of ``frames`` (fixed frame) against the truth.

    Frames before the first and after the last true instant are left out. Raises ValueError if no
    frame is left.
    """
    tally = _Tally()
    for frame in frames:
        if truth.covers(frame.stamp):
            _compare(frame, truth, model, tally)
    if not tally.frames:
        raise ValueError("no frame lies within the time of the truth")
    errors = 1000 * np.concatenate([[np.nan], *tally.errors])
    angles = np.degrees(np.concatenate([[np.nan], *tally.angles]))
    turns = np.degrees(np.concatenate([[np.nan], *tally.turns]))
    known = not np.isnan(angles).all()
    return Scores(
        mean=float(np.nanmean(errors)) if tally.errors else np.nan,
        deviation=float(np.nanstd(errors)) if tally.errors else np.nan,
        percentile_95=float(np.nanpercentile(errors, 95)) if tally.errors else np.nan,
        angle_rmse=float(np.sqrt(np.nanmean(angles**2))) if known else np.nan,
        angle_deviation=float(np.nanstd(angles)) if known else np.nan,
        turn_error=float(np.nanmean(turns)) if not np.isnan(turns).all() else np.nan,
        limb_variation=_limb_variation(tally, model),
        jitter=_jitter(tally),
        lag=_lag(tally, truth),
        missing=tally.missing,
        false=tally.false,
        switches=tally.switches,
        frames=tally.frames,
    )


def _compare(frame: Frame, truth: Truth, model: SkeletonModel, tally: _Tally) -> None:
    tally.frames += 1
    people = np.nonzero(frame.ids != UNTRACKED)[0]
    positions, turns = truth.at(frame.stamp)
    errors = np.linalg.norm(positions[:, None] - frame.positions[people][None], axis=-1)
    known = ~np.isnan(errors)
    total = np.where(known, errors, 0.0).sum(axis=-1)
    cost = np.where(known.any(axis=-1), total / np.maximum(known.sum(axis=-1), 1), np.inf)
    cost[cost > MATCH_DISTANCE] = np.inf
    match = assign(np.ascontiguousarray(cost))
    present = int((~np.isnan(positions[..., 0])).any(axis=-1).sum())
    matched = int((match >= 0).sum())
    tally.missing += present - matched
    tally.false += len(people) - matched
    for column, true in enumerate(match.tolist()):
        if true < 0:
            continue
        row = int(people[column])
        name = int(frame.ids[row])
        tally.switches += tally.names.get(true, name) != name
        tally.names[true] = name
        tally.errors.append(errors[true, column])
        tally.angles.append(
            flexions(model, frame.positions[row]) - flexions(model, positions[true])
        )
        tally.turns.append(angle(frame.orientations[row], turns[true]))
        here = frame.positions[row].copy()
        tally.tracks.setdefault(name, []).append((frame.stamp, here))
        tally.pairs.append((frame.stamp, true, here))


def _limb_variation(tally: _Tally, model: SkeletonModel) -> float:
    parents, children = np.array(model.link_parents), np.array(model.link_children)
    real = (parents >= 0) & (children >= 0)
    variations = []
    for track in tally.tracks.values():
        poses = np.stack([pose for _, pose in track])
        lengths = np.linalg.norm(poses[:, parents[real]] - poses[:, children[real]], axis=-1)
        lengths = lengths[:, ~np.isnan(lengths).all(axis=0)]
        if len(lengths) > 1 and lengths.size:
            variations.append(np.nanstd(lengths, axis=0) / np.nanmean(lengths, axis=0))
    return float(np.mean(np.concatenate(variations))) if variations else np.nan


def _jitter(tally: _Tally) -> float:
    steps = [
        np.linalg.norm(np.diff(np.stack([pose for _, pose in track]), 2, axis=0), axis=-1).ravel()
        for track in tally.tracks.values()
        if len(track) > 2
    ]
    values = np.concatenate(steps) if steps else np.array([np.nan])
    return float(1000 * np.nanmean(values)) if not np.isnan(values).all() else np.nan


def _lag(tally: _Tally, truth: Truth, shifts: Sequence[int] = range(-60, 181, 5)) -> float:
    """Shift of the truth, ms, with the least squared error; a parabola through the best three."""
    if not tally.pairs:
        return np.nan
    chosen = tally.pairs[:: max(1, len(tally.pairs) // 400)]
    costs = []
    for shift in shifts:
        off = [
            (truth.at(stamp - shift * 1_000_000)[0][true] - pose) ** 2
            for stamp, true, pose in chosen
            if truth.covers(stamp - shift * 1_000_000)
        ]
        costs.append(float(np.nanmean(off)))
    best = int(np.clip(np.argmin(costs), 1, len(costs) - 2))
    left, middle, right = costs[best - 1 : best + 2]
    bend = left - 2 * middle + right
    step = shifts[1] - shifts[0]
    return float(shifts[best] + (0.5 * step * (left - right) / bend if bend > 0 else 0.0))
