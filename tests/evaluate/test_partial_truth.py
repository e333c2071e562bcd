"""A truth of some of the people: the others are neither false nor an excuse for false ones."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from stick_figures import MODEL, at, person, seen

from hiros_mcap.evaluate import Truth, evaluate


def walker(k, centre=0.0):
    """Somebody who goes to and fro by 1 m."""
    return person(centre + math.sin(0.05 * k), 3 * (centre > 0))


ALL = [seen([walker(k), walker(k, 4), walker(k, 8)], at(k), ids=[0, 1, 2]) for k in range(150)]
ONE = Truth.of([f.select([0]) for f in ALL])
PARTIAL = replace(ONE, partial=True)


def scores(frames, truth):
    return evaluate(frames, truth, MODEL)


def test_people_without_a_label_are_not_false():
    whole, part = scores(ALL, ONE), scores(ALL, PARTIAL)
    assert (whole.false, whole.tracking.mota) == (300, -1)
    assert part.false is None
    assert (part.missing, part.switches) == (0, 0)
    assert part.tracking.mota == part.tracking.idf1 == part.tracking.hota == 1
    assert part.mean == whole.mean == 0


def test_who_is_missed_or_renamed_still_counts():
    frames = [f.select([1, 2]) if k < 30 else f for k, f in enumerate(ALL)]
    frames[90:] = [f.replace(ids=np.array([9, 1, 2], np.int32)) for f in frames[90:]]
    part = scores(frames, PARTIAL)
    assert (part.missing, part.switches) == (30, 1)
    assert part.tracking.mota == pytest.approx(1 - 31 / 150)
    assert part.tracking.idf1 == pytest.approx(2 * 60 / (150 + 120))
