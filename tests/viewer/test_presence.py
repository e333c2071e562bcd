"""When people are shown and hidden."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_viewer.columns import GONE_NS, PAUSE_NS
from hiros_viewer.poses import HIDDEN, Crowd, Poses, Visits

Frames = list[tuple[int, set[int]]]
"""Stamp and who is there."""
MS = 1_000_000


def poses(frames):
    stamps = np.array([stamp for stamp, _ in frames], np.int64)
    ids = np.array([i for _, people in frames for i in sorted(people)], np.int32)
    counts = np.array([len(people) for _, people in frames])
    times = np.stack([stamps, stamps + 7], axis=1)
    return Poses(times, counts, ids, np.zeros((len(ids), 1, 3)), np.ones((len(ids), 1)))


def expected(frames, person, patience):
    """Walk through the frames one by one: stamps of rows, and whether the person is shown."""
    rows, seen, before = [], None, frames[0][0]
    for stamp, people in frames:
        if seen is not None and stamp - before > PAUSE_NS:
            rows.append((before + GONE_NS, False))
            seen = None
        if person in people:
            rows.append((stamp, True))
            seen = stamp
        elif seen is not None and stamp - seen >= patience:
            rows.append((stamp, False))
            seen = None
        before = stamp
    return rows if seen is None else [*rows, (seen + GONE_NS, False)]


@pytest.mark.parametrize("patience", [0, GONE_NS])
@pytest.mark.parametrize("size", [1, 3, 7, 60])
def test_people_are_hidden_when_frames_lack_them_or_stop(patience, size):
    rng = np.random.default_rng(size)
    steps = rng.choice([33, 66, 240, 400, 501, 900], 60, p=[0.6, 0.1, 0.1, 0.1, 0.05, 0.05])
    stamps = np.cumsum(steps * MS).tolist()
    there = [set(np.flatnonzero(rng.random(3) < 0.6).tolist()) for _ in stamps]
    frames = list(zip(stamps, there, strict=True))
    visits, rows = Visits(patience), dict[int, list[tuple[int, bool]]]()
    for first in range(0, len(frames), size):
        some = poses(frames[first : first + size])
        for visit in visits.of(some):
            is_shown = visit.people != HIDDEN
            rows.setdefault(visit.person, []).extend(
                zip(visit.times[:, 0].tolist(), is_shown.tolist(), strict=True)
            )
            assert (some.ids[visit.people[is_shown]] == visit.person).all()
            assert (np.diff(visit.times, axis=1) == 7).all()
    for visit in visits.finish():
        rows[visit.person].append((int(visit.times[0, 0]), False))
    for person in range(3):
        assert rows[person] == expected(frames, person, patience)


def test_a_visit_begins_when_somebody_was_not_shown_before():
    visits = Visits(0)
    (first,) = visits.of(poses([(0, {4}), (MS, set()), (2 * MS, {4})]))
    assert first.begins.tolist() == [True, False, True]
    (second,) = visits.of(poses([(3 * MS, {4}), (999 * MS, {4})]))
    assert second.begins.tolist() == [False, False, True]


def test_detections_are_hidden_in_a_pause():
    crowd = Crowd()
    times, counts = crowd.rows(poses([(0, {1, 2}), (900 * MS, set()), (1800 * MS, {1})]))
    assert times[:, 0].tolist() == [0, 250 * MS, 900 * MS, 1800 * MS]
    assert counts.tolist() == [2, 0, 0, 1]
    times, counts = crowd.rows(poses([(2800 * MS, {1})]))
    assert times[:, 0].tolist() == [2050 * MS, 2800 * MS]
    assert crowd.finish()[:, 0].tolist() == [3050 * MS]
    assert len(crowd.finish()) == 0
