"""Who is who over time: MOTA, IDF1 and HOTA on 3D skeletons.

The similarity of a skeleton to a true one falls from 1 (same joints) to 0 (mean joint distance at
the matching distance or more). The numbers equal those of TrackEval on the same similarities.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hiros_mcap.kernels.assignment import assign
from hiros_mcap.skeletons import Floats, Stamps

ALPHAS = np.arange(0.05, 0.99, 0.05)
"""Similarities at which a match counts, averaged over by HOTA (Luiten et al. 2021, eq. 10)."""
_KEEP = 1000.0  # bonus of a pair that the frame before had, over any similarity
_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class FrameSimilarity:
    """One frame: true people against skeletons with an id."""

    true_ids: tuple[int, ...]
    ids: tuple[int, ...]
    similarity: Floats  # (true, found) 0..1


@dataclass(frozen=True, slots=True)
class TrackingScores:
    """The three families of tracking measures, 0..1 but for MOTA, which may be negative."""

    mota: float  # 1 - (missing + false + switches) / true (Bernardin and Stiefelhagen 2008)
    idf1: float  # F1 of the one-to-one map from true people to ids (Ristani et al. 2016)
    hota: float  # mean over similarities of sqrt(DetA AssA) (Luiten et al. 2021)


def tracking_scores(frames: Sequence[FrameSimilarity]) -> TrackingScores:
    """Compute all measures; NaN where nobody was there to be found."""
    people = {i: k for k, i in enumerate(sorted({i for now in frames for i in now.true_ids}))}
    names = {i: k for k, i in enumerate(sorted({i for now in frames for i in now.ids}))}
    true, reported = np.zeros((len(people), 1)), np.zeros(len(names))
    placed = []
    for now in frames:
        rows = np.array([people[i] for i in now.true_ids], np.int64)
        columns = np.array([names[i] for i in now.ids], np.int64)
        true[rows] += 1
        reported[columns] += 1
        placed.append((rows, columns, now.similarity))
    total = float(true.sum() + reported.sum())
    if not total:
        return TrackingScores(_mota(frames), np.nan, np.nan)
    together = np.zeros((len(people), len(names)))
    for rows, columns, similarity in placed:
        np.add.at(together, np.ix_(rows, columns), similarity > _TINY)
    hits = sum(together[row, column] for row, column in _best_scores(together))
    hota = _hota(placed, true, reported)
    return TrackingScores(_mota(frames), float(2 * hits / total), hota)


def _best_scores(score: Floats) -> list[tuple[int, int]]:
    """Pairs (row, column) of positive score with the largest sum."""
    return [(row, column) for row, column in best_pairs(-score) if score[row, column] > _TINY]


def _mota(frames: Sequence[FrameSimilarity]) -> float:
    """MOTA by CLEAR MOT: pairs of the previous frame are kept while they are possible."""
    previous: dict[int, int] = {}
    last: dict[int, int] = {}
    true = reported = matched = switches = 0
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
        matched += len(pairs)
    wrong = (true - matched) + (reported - matched) + switches
    return 1 - wrong / true if true else np.nan


def _hota(placed: Sequence[tuple[Stamps, Stamps, Floats]], true: Floats, reported: Floats) -> float:
    """Compute HOTA of the slots of people and ids in each frame, and how often each is there."""
    alignment = _alignment(placed, true + reported)
    together = np.zeros((len(ALPHAS), *alignment.shape))
    for rows, columns, similarity in placed:
        for r, c in _best_scores(alignment[np.ix_(rows, columns)] * similarity):
            together[:, rows[r], columns[c]] += similarity[r, c] >= ALPHAS - 1e-9
    matched = together.sum(axis=(1, 2))
    detection = matched / (true.sum() + reported.sum() - matched)
    shared = (together * together / np.maximum(true + reported - together, 1)).sum(axis=(1, 2))
    association = shared / np.maximum(matched, 1)
    return float(np.sqrt(detection * association).mean())


def _alignment(placed: Sequence[tuple[Stamps, Stamps, Floats]], both: Floats) -> Floats:
    """(people, names) How well an id follows a person over the whole log, 0..1.

    ``both`` : how often the one and the other are there.
    """
    shared = np.zeros(both.shape)
    for rows, columns, s in placed:
        union = s.sum(axis=0, keepdims=True) + s.sum(axis=1, keepdims=True) - s
        shared[np.ix_(rows, columns)] += np.where(union > _TINY, s / np.maximum(union, _TINY), 0.0)
    return shared / (both - shared)


def best_pairs(cost: Floats) -> list[tuple[int, int]]:
    """Return the pairs (row, column) of :func:`~.assignment.assign`, by row; ``cost`` is (R, C)."""
    rows = assign(np.ascontiguousarray(cost)).tolist()
    return sorted((row, column) for column, row in enumerate(rows) if row >= 0)
