"""Who is who over time: MOTA, IDF1 and HOTA on 3D skeletons.

The similarity of a skeleton to a true one falls from 1 (same joints) to 0 (mean joint distance at
the matching distance or more). The numbers equal those of TrackEval on the same similarities.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hiros_mcap.evaluate.pairing import best_pairs
from hiros_mcap.skeletons import Floats

ALPHAS = np.arange(0.05, 0.99, 0.05)
"""Similarities at which a match counts, averaged over by HOTA (Luiten et al. 2021, eq. 10)."""
_KEEP = 1000.0
"""Bonus of a pair that the frame before had, over any similarity."""
_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class FrameSimilarity:
    """One frame: true people against skeletons with an id."""

    true_ids: tuple[int, ...]
    ids: tuple[int, ...]
    similarity: Floats
    """(true, found) 0..1."""


@dataclass(frozen=True, slots=True)
class TrackingScores:
    """The three families of tracking measures, 0..1 but for MOTA, which may be negative."""

    mota: float
    """1 - (missing + false + switches) / true (Bernardin and Stiefelhagen 2008)."""
    motp: float
    """Mean similarity of the matches."""
    switches: int
    """Id switches by CLEAR MOT, which keeps a match as long as it is possible."""
    idf1: float
    """F1 of the one-to-one map from true people to ids (Ristani et al. 2016)."""
    hota: float
    """Luiten et al. 2021: mean over similarities of sqrt(DetA AssA)."""


def tracking_scores(frames: Sequence[FrameSimilarity]) -> TrackingScores:
    """Compute all measures; NaN where nobody was there to be found."""
    mota, motp, switches = _clear(frames)
    return TrackingScores(mota, motp, switches, _idf1(frames), _hota(frames))


def _best_scores(score: Floats) -> list[tuple[int, int]]:
    """Pairs (row, column) of positive score with the largest sum."""
    return [(row, column) for row, column in best_pairs(-score) if score[row, column] > _TINY]


def _clear(frames: Sequence[FrameSimilarity]) -> tuple[float, float, int]:
    """MOTA, MOTP and switches; pairs of the previous frame are kept while they are possible."""
    previous: dict[int, int] = {}
    last: dict[int, int] = {}
    true = reported = matched = switches = 0
    similarity = 0.0
    for now in frames:
        true, reported = true + len(now.true_ids), reported + len(now.ids)
        if not now.true_ids or not now.ids:
            continue
        held = np.array([[previous.get(t) == i for i in now.ids] for t in now.true_ids])
        score = (now.similarity > _TINY) * (_KEEP * held + now.similarity)
        pairs = _best_scores(score)
        previous = {}
        for row, column in pairs:
            person, name = now.true_ids[row], now.ids[column]
            switches += last.get(person, name) != name
            previous[person] = last[person] = name
            similarity += float(now.similarity[row, column])
        matched += len(pairs)
    if not true:
        return np.nan, np.nan, switches
    wrong = (true - matched) + (reported - matched) + switches
    return 1 - wrong / true, similarity / matched if matched else np.nan, switches


def _counts(
    frames: Sequence[FrameSimilarity],
) -> tuple[dict[int, int], dict[int, int], Floats, Floats]:
    """Slots of people and of ids, and how often each appears."""
    people = {i: k for k, i in enumerate(sorted({i for now in frames for i in now.true_ids}))}
    names = {i: k for k, i in enumerate(sorted({i for now in frames for i in now.ids}))}
    true, reported = np.zeros(len(people)), np.zeros(len(names))
    for now in frames:
        true[[people[i] for i in now.true_ids]] += 1
        reported[[names[i] for i in now.ids]] += 1
    return people, names, true, reported


def _idf1(frames: Sequence[FrameSimilarity]) -> float:
    people, names, true, reported = _counts(frames)
    together = np.zeros((len(people), len(names)))
    for now in frames:
        for row, person in enumerate(now.true_ids):
            for column, name in enumerate(now.ids):
                close = now.similarity[row, column] > _TINY
                together[people[person], names[name]] += close
    total = true.sum() + reported.sum()
    hits = sum(together[row, column] for row, column in _best_scores(together))
    return float(2 * hits / total) if total else np.nan


def _hota(frames: Sequence[FrameSimilarity]) -> float:
    people, names, true, reported = _counts(frames)
    if not true.sum() + reported.sum():
        return np.nan
    alignment = _alignment(frames, people, names, true, reported)
    together = np.zeros((len(ALPHAS), len(people), len(names)))
    for now in frames:
        rows = [people[i] for i in now.true_ids]
        columns = [names[i] for i in now.ids]
        for r, c in _best_scores(alignment[np.ix_(rows, columns)] * now.similarity):
            together[:, rows[r], columns[c]] += now.similarity[r, c] >= ALPHAS - 1e-9
    matched = together.sum(axis=(1, 2))
    detection = matched / (true.sum() + reported.sum() - matched)
    union = true[:, None] + reported[None] - together
    shared = (together * together / np.maximum(union, 1)).sum(axis=(1, 2))
    association = shared / np.maximum(matched, 1)
    return float(np.sqrt(detection * association).mean())


def _alignment(
    frames: Sequence[FrameSimilarity],
    people: dict[int, int],
    names: dict[int, int],
    true: Floats,
    reported: Floats,
) -> Floats:
    """(people, names) How well an id follows a person over the whole log, 0..1."""
    shared = np.zeros((len(people), len(names)))
    for now in frames:
        s = now.similarity
        rows = [people[i] for i in now.true_ids]
        columns = [names[i] for i in now.ids]
        union = s.sum(axis=0, keepdims=True) + s.sum(axis=1, keepdims=True) - s
        shared[np.ix_(rows, columns)] += np.where(union > _TINY, s / np.maximum(union, _TINY), 0.0)
    return shared / (true[:, None] + reported[None] - shared)
