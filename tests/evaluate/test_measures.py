"""The table of measures: what it reads, and that the docs say the same."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from stick_figures import MODEL, at, person, seen

from hiros_mcap.evaluate import Truth, evaluate
from hiros_mcap.evaluate.logs import consistency
from hiros_mcap.evaluate.measures import (
    CONSISTENCY,
    ERRORS,
    LEFT_OUT,
    MEASURES,
    MOTION,
    PEOPLE,
    REPROJECTION,
    SELF,
    table_of,
)
from hiros_mcap.wording import plain

DOCS = Path(__file__).parents[2] / "docs"
SCORES = dict.fromkeys((*ERRORS, *MOTION, *PEOPLE))


def rows_of(page):
    """Cells of all tables of a page."""
    lines = (DOCS / page).read_text(encoding="utf-8").splitlines()
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line[:1] == "|"]


def test_the_page_has_the_columns_of_the_tables():
    rows = rows_of("evaluating.md")
    assert [row for row in rows if len(row) == 4 and row[1][1:-1] in MEASURES] == [
        [m.header(), f"`{m.name}`", f"`{m.field}`", m.text] for m in SCORES
    ]
    for measures in (LEFT_OUT, SELF, REPROJECTION):
        fields = [[f"`{m.field}`"] if measures is not REPROJECTION else [] for m in measures]
        expected = [[m.header(), *field, m.text] for m, field in zip(measures, fields, strict=True)]
        first = rows.index(expected[0])
        assert rows[first : first + len(expected)] == expected


def test_the_page_of_golden_files_lists_all_names():
    text = (DOCS / "golden.md").read_text(encoding="utf-8")
    listed = text.partition("Metrics: ")[2].partition(".\n")[0]
    free, _, true = listed.partition("; with a truth also ")
    assert re.findall(r"`(\w+)`", free) == [m.name for m in CONSISTENCY]
    assert sorted(re.findall(r"`(\w+)`", free + true)) == sorted(MEASURES)


def test_each_measure_is_in_the_scores_and_in_json():
    frames = [seen([person(0.01 * k)], at(k), ids=[0]) for k in range(30)]
    scores = evaluate(frames, Truth.of(frames), MODEL)
    for m in SCORES:
        path = m.field.split(".")
        value: object = plain(scores)
        for part in path if not m.name.startswith("pck") else ():
            assert isinstance(value, dict)
            if part not in value:
                assert m.is_optional
                break
            value = value[part]
    assert MEASURES["pck_50"].of(scores) == 100.0
    assert MEASURES["mpjpe"].of(scores) == 0.0
    assert MEASURES["hota"].of(scores) == pytest.approx(1.0)
    assert [m.of(consistency(frames, MODEL)) for m in CONSISTENCY[:2]] == [1, 30]


def test_columns_have_their_unit_unless_the_title_states_it():
    assert table_of("Channel", [], MOTION)[0][:2] == ("Channel", "Bending, deg")
    header, _ = table_of("Channel", [("a", object())], ERRORS, "mm")
    assert header[:2] == ("Channel", "Mean")
    assert "Torso" not in header
    assert math.isnan(MEASURES["mpjpe"].of(object()))
