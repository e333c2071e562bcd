"""The distance of two skeletons, and the best pairs of two sets."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stick_figures import person

from hiros_mcap.evaluate.match import skeleton_distances
from hiros_mcap.evaluate.mot import best_pairs


def test_the_mean_is_over_the_markers_that_both_have():
    """One of eight markers is 80 cm off; without it nothing is."""
    a, b = person(), person()
    b[3] += [0, 0, 0.8]
    assert skeleton_distances(a[None], b[None])[0, 0] == pytest.approx(0.1)
    a[3] = np.nan
    assert skeleton_distances(a[None], b[None])[0, 0] == 0
    assert skeleton_distances(np.full((1, 8, 3), np.nan), b[None])[0, 0] == np.inf


def test_rows_are_the_first_set():
    distances = skeleton_distances(
        np.stack([person(), person(1.0)]), np.stack([person(), person(2.0), person(5.0)])
    )
    assert distances == pytest.approx(np.array([[0, 2, 5], [1, 1, 4]]))
    assert skeleton_distances(np.zeros((0, 8, 3)), np.zeros((2, 8, 3))).shape == (0, 2)


def test_as_many_pairs_as_possible_come_before_the_least_sum():
    assert best_pairs(np.array([[1.0, 100.0], [100.0, np.inf]])) == [(0, 1), (1, 0)]
    assert best_pairs(np.array([[np.inf, 1.0], [np.inf, 2.0]])) == [(0, 1)]
    assert best_pairs(np.full((2, 3), np.inf)) == best_pairs(np.zeros((0, 3))) == []


costs = st.integers(1, 4).flatmap(
    lambda rows: st.integers(1, 4).flatmap(
        lambda columns: st.lists(
            st.one_of(st.just(np.inf), st.floats(-5, 5)),
            min_size=rows * columns,
            max_size=rows * columns,
        ).map(lambda values: np.array(values).reshape(rows, columns))
    )
)


@settings(deadline=None, max_examples=60)
@given(costs)
def test_no_assignment_has_more_pairs_or_as_many_at_less_cost(cost):
    table = cost if cost.shape[0] <= cost.shape[1] else cost.T
    best = (0, 0.0)
    for columns in permutations(range(table.shape[1]), table.shape[0]):
        values = [v for v in table[np.arange(len(columns)), columns] if np.isfinite(v)]
        best = min(best, (-len(values), float(sum(values))))
    pairs = best_pairs(cost)
    assert len({row for row, _ in pairs}) == len({column for _, column in pairs}) == len(pairs)
    total = sum(cost[pair] for pair in pairs)
    assert len(pairs) == -best[0]
    assert total == pytest.approx(best[1], abs=1e-9)
