"""Constant offsets between the cameras' clocks, from people who move.

If the stamps of a camera are ahead, its skeletons lag behind those of the other cameras by the
offset times the velocity. The offset d of a pair of cameras is the regression of their difference
on the velocity, d = sum v.(a - b) / sum v.v, repeated at the new offset until it stays.

A mean of a person's markers is compared: left and right may be swapped in it, and constant errors
of the extrinsics drop out. Both halves of the log have to agree on an offset. Where nobody moves,
nothing is decided.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from hiros_mcap.frames import Block
from hiros_mcap.skeletons import POSITION, Floats

_NEAR = 0.4  # m: farthest that a person goes between two messages
_GAP = 0.25  # s: longest pause of a track
_SAME = 0.35  # m: farthest that two cameras' views of a person are apart, on average
_SPACING = 0.06  # s between the samples of a track
_HALF_BASE = 0.1  # s: velocities are those between so long before and after
_SEARCH = np.arange(-3.0, 3.01, 0.1)  # s
_LEAST_SCORE = 0.3
_LEAST_SAMPLES = 40  # in each half of the log
_LEAST_SPEED = 0.1  # m/s, root mean square in each half
_LEAST_CORRELATION = 0.3  # of the cameras' velocities: noise looks like motion, too
_LARGEST_ERROR = 0.02  # s: a pair of cameras that is less certain says nothing
_ROUNDS = 12
_LEAST_OFFSET = 0.02  # s: what is corrected; people walk 2 cm in it
_LEAST_CERTAINTY = 4.0  # standard errors
_LEAST_GAIN = 0.03


class PairOffset(NamedTuple):
    """How far the clock of the second camera is ahead of the first one's."""

    seconds: float
    error: float
    """Standard error, s; it includes what the halves of the log differ by."""
    gain: float
    """By which part the offset reduces the difference of the cameras, in the worse half."""

    @property
    def is_proven(self) -> bool:
        """Whether the people prove that there is an offset worth a correction."""
        least = max(_LEAST_OFFSET, _LEAST_CERTAINTY * self.error)
        return abs(self.seconds) > least and self.gain > _LEAST_GAIN


@dataclass(slots=True)
class _PersonTrack:
    """A person as one camera sees him, without a pause."""

    times: list[float] = field(default_factory=list)
    places: list[Floats] = field(default_factory=list)

    def arrays(self) -> tuple[Floats, Floats]:
        """(n,) s and (n, 3) m."""
        return np.array(self.times), np.array(self.places)


Tracks = Sequence[tuple[Floats, Floats]]
"""(n,) times, s, and (n, 3) places, m, of each person of a camera."""


def clock_offsets(
    blocks: Iterable[Block], lags: Mapping[str, float], seconds: float = 30.0
) -> dict[str, PairOffset]:
    """Find how far each camera's clock is ahead of most of the cameras' clocks.

    Parameters
    ----------
    blocks : detections of all cameras in the fixed frame.
    lags : camera -> usual time, s, from stamp to log time: where to look for offsets.
    seconds : how much of the log to look at, in time with people.

    Returns
    -------
    Offsets of the cameras about which the people prove something; see :class:`PairOffset`.
    """
    tracks = person_tracks(blocks, seconds)
    pairs: dict[tuple[str, str], PairOffset] = {}
    for a, b in combinations(sorted(tracks), 2):
        hint = lags.get(a, 0.0) - lags.get(b, 0.0)
        found = pair_offset(tracks[a], tracks[b], hint)
        if found is not None:
            pairs[a, b] = found
    return _by_camera(pairs, lags)


def person_tracks(blocks: Iterable[Block], seconds: float) -> dict[str, Tracks]:
    """Follow people in each camera by itself, until ``seconds`` of the log show somebody."""
    open_tracks: dict[str, list[_PersonTrack]] = {}
    done: dict[str, list[_PersonTrack]] = {}
    occupied: set[int] = set()
    start = None
    for block in blocks:
        means = _means(block)
        rows = block.rows.tolist()
        for i, (stamp, source) in enumerate(zip(block.stamps.tolist(), block.sources, strict=True)):
            start = stamp if start is None else start
            time = (stamp - start) * 1e-9
            here = means[slice(*rows[i])]
            if len(here):
                occupied.add(int(time))
            some = open_tracks.setdefault(source, [])
            _follow(some, done.setdefault(source, []), time, here)
        if len(occupied) > seconds:
            break
    return {
        source: [t.arrays() for t in (*done[source], *some) if len(t.times) > _LEAST_SAMPLES // 2]
        for source, some in open_tracks.items()
    }


def _means(block: Block) -> Floats:
    """(P, 3) mean marker position of each person of a block, m."""
    positions = block.people.markers[:, :, POSITION]
    known = ~np.isnan(positions[:, :, :1])
    counts = np.asarray(known.sum(axis=1))
    means: Floats = np.where(known, positions, 0.0).sum(axis=1) / np.maximum(counts, 1)
    means[counts[:, 0] == 0] = np.nan
    return means


def _follow(
    some: list[_PersonTrack], done: list[_PersonTrack], time: float, places: Floats
) -> None:
    """Add what a message shows to the nearest tracks; start and end tracks."""
    for track in [t for t in some if time - t.times[-1] > _GAP]:
        some.remove(track)
        done.append(track)
    free = list(some)
    for place in places:
        if np.isnan(place[0]):
            continue
        gaps = [float(np.linalg.norm(t.places[-1] - place)) for t in free]
        if gaps and min(gaps) < _NEAR:
            track = free.pop(int(np.argmin(gaps)))
        else:
            track = _PersonTrack()
            some.append(track)
        if not track.times or time > track.times[-1]:
            track.times.append(time)
            track.places.append(place)


class _Samples(NamedTuple):
    """N samples of people whom both cameras see."""

    times: Floats
    """(N,) s."""
    differences: Floats
    """(N, 3) place in the first camera - in the second one, m, less the mean of the person."""
    velocities: Floats
    """(N, 3) m/s in the second camera, less the mean of the person."""
    own_velocities: Floats
    """(N, 3) the same in the first camera."""
    score: float
    """How well the cameras agree, at most 1."""


def pair_offset(first: Tracks, second: Tracks, hint: float) -> PairOffset | None:
    """Find how far the clock of the second camera is ahead of the first one's.

    ``hint``, s, is an offset to try besides 0. None if the people prove nothing.
    """
    start = max((0.0, hint), key=lambda offset: _sample(first, second, offset).score)
    if _sample(first, second, start).score < _LEAST_SCORE:
        start = max(_SEARCH.tolist(), key=lambda offset: _sample(first, second, offset).score)
    offset = start
    for _ in range(_ROUNDS):
        some = _sample(first, second, offset)
        if not _tells(some):
            return None
        change = float(np.clip(_regress(some), -0.2, 0.2))
        offset += change
        if abs(change) < 0.0005:
            break
    found = _sample(first, second, offset)
    if not _tells(found) or found.score < _LEAST_SCORE:
        return None
    early, late = (_regress(half) for half in _halves(found))
    error = float(np.hypot(_standard_error(found), (early - late) / 2))
    if error > _LARGEST_ERROR:
        return None
    return PairOffset(offset, error, _gain(_sample(first, second, 0.0), found))


def _sample(first: Tracks, second: Tracks, offset: float) -> _Samples:
    """Compare the first camera's people with the second one's, whose clock is ahead."""
    parts: list[tuple[Floats, ...]] = []
    score, n = 0.0, 0
    for at, places in first:
        chosen = at[np.diff(np.floor(at / _SPACING), prepend=-1.0) > 0]
        fits = [
            _compare(chosen, (at, places), (other_at - offset, other)) for other_at, other in second
        ]
        n += len(chosen)
        fit, part = max(fits, key=itemgetter(0), default=(0.0, ()))
        if fit:
            score += fit
            parts.append(part)
    if not parts:
        none = np.empty((0, 3))
        return _Samples(np.empty(0), none, none, none, 0.0)
    times, gaps, velocities, own = (np.concatenate(some) for some in zip(*parts, strict=True))
    return _Samples(times, gaps, velocities, own, score / n)


_Track = tuple[Floats, Floats]


def _compare(times: Floats, first: _Track, second: _Track) -> tuple[float, tuple[Floats, ...]]:
    """Return how well two tracks agree, 0 if they are of two people, and their samples."""
    begin, end = (max(first[0][0], second[0][0]), min(first[0][-1], second[0][-1]))
    t = times[(times > begin + _HALF_BASE) & (times < end - _HALF_BASE)]
    if len(t) < _LEAST_SAMPLES // 4:
        return 0.0, ()
    gap = _at(t, *first) - _at(t, *second)
    distance = np.linalg.norm(gap, axis=1)
    if np.median(distance) >= _SAME:
        return 0.0, ()
    vectors = (gap, _velocity(t, *second), _velocity(t, *first))
    fit = float(np.maximum(0.0, 1.0 - distance / _SAME).sum())
    return fit, (t, *(each - each.mean(axis=0) for each in vectors))


def _velocity(times: Floats, known: Floats, places: Floats) -> Floats:
    """(N, 3) m/s at some times."""
    after, before = (_at(times + shift, known, places) for shift in (_HALF_BASE, -_HALF_BASE))
    return (after - before) / (2 * _HALF_BASE)


def _at(times: Floats, known: Floats, places: Floats) -> Floats:
    """(N, 3) places at some times, between those at known times."""
    return np.stack([np.interp(times, known, places[:, k]) for k in range(3)], axis=1)


def _regress(some: _Samples) -> float:
    """Return by how much more the second clock is ahead, s."""
    gaps, v = some.differences, some.velocities
    size = np.linalg.norm(gaps, axis=1)
    weights = 1.0 / (1.0 + (size / (2.0 * np.median(size) + 1e-9)) ** 2)
    return float((weights * (v * gaps).sum(axis=1)).sum() / (weights * (v * v).sum(axis=1)).sum())


def _halves(some: _Samples) -> tuple[_Samples, _Samples]:
    """Return the earlier and the later samples."""
    early = some.times <= np.median(some.times)
    times, gaps, velocities, own, score = some
    first, second = (
        _Samples(times[part], gaps[part], velocities[part], own[part], score)
        for part in (early, ~early)
    )
    return first, second


def _tells(some: _Samples) -> bool:
    """Whether enough people move in both halves."""
    return len(some.times) >= 2 * _LEAST_SAMPLES and all(map(_moves, _halves(some)))


def _moves(some: _Samples) -> bool:
    """Whether both cameras see the same motion."""
    if len(some.times) < _LEAST_SAMPLES:
        return False
    common = float((some.velocities * some.own_velocities).sum(axis=1).mean())
    least = _LEAST_CORRELATION * _rms(some.velocities) * _rms(some.own_velocities)
    return common > max(_LEAST_SPEED**2, least)


def _rms(vectors: Floats) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _standard_error(some: _Samples) -> float:
    """Return the standard error of the regression, s, with samples of a second taken as one."""
    product = (some.velocities * some.differences).sum(axis=1)
    sums = np.bincount(some.times.astype(np.int64) - int(some.times.min()), product)
    return float(np.sqrt((sums**2).sum()) / (some.velocities**2).sum())


def _gain(without: _Samples, found: _Samples) -> float:
    """Return by which part an offset reduces the differences, in the worse half of the log."""
    if len(without.times) < 2 * _LEAST_SAMPLES or without.score < 0.5 * found.score:
        return 1.0  # without it, hardly anybody is seen by both
    halves = zip(_halves(without), _halves(found), strict=True)
    return min(1.0 - _rms(b.differences) / max(_rms(a.differences), 1e-9) for a, b in halves)


def _by_camera(
    pairs: Mapping[tuple[str, str], PairOffset], lags: Mapping[str, float]
) -> dict[str, PairOffset]:
    """Return each camera's offset from most of the cameras, by least squares over the pairs."""
    names = sorted({name for pair in pairs for name in pair})
    if not names:
        return {}
    rows = np.zeros((len(pairs), len(names)))
    values = np.zeros(len(pairs))
    for row, ((a, b), found) in enumerate(pairs.items()):
        weight = 1.0 / np.hypot(found.error, 0.002)
        rows[row, names.index(a)], rows[row, names.index(b)] = -weight, weight
        values[row] = weight * found.seconds
    offsets = np.linalg.lstsq(rows, values, rcond=None)[0]
    reference = _reference(dict(zip(names, offsets.tolist(), strict=True)), lags)
    offsets -= offsets[names.index(reference)]
    result = {}
    for name, seconds in zip(names, offsets.tolist(), strict=True):
        own = [pair for key, pair in pairs.items() if name in key]
        error = float(np.median([pair.error for pair in own]))
        result[name] = PairOffset(seconds, error, float(np.median([pair.gain for pair in own])))
    return result


def _reference(offsets: Mapping[str, float], lags: Mapping[str, float]) -> str:
    """Return the camera whose clock counts as right: the middle one.

    Of two, it is the one whose messages are logged nearest to their stamps.
    """
    if len(offsets) == 2:
        return min(offsets, key=lambda name: abs(lags.get(name, 0.0)))
    return sorted(offsets, key=lambda name: offsets[name])[(len(offsets) - 1) // 2]
