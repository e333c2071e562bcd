"""Tables and numbers as a person reads them."""

from __future__ import annotations

import io
import math

import pytest
from rich.console import Console

from hiros_cli.run_report import show_table
from hiros_mcap.wording import number

HEADER = ("Channel", "Mean error", "Upper limbs", "Lower limbs")
ROWS = [("/hiros/optimized", "25.1", "32.7", "30.4"), ("/hiros/filtered", "20.2", "26.7", "23.7")]


def shown(width):
    out = Console(width=width, file=io.StringIO())
    show_table(out, "Joint error, mm", (HEADER, ROWS))
    return out.file.getvalue().splitlines()  # type: ignore[attr-defined]


@pytest.mark.parametrize("width", [30, 44, 60, 80, 1000])
def test_a_table_keeps_to_the_terminal_and_breaks_no_word(width):
    lines = shown(width)
    assert max(map(len, lines)) <= width
    assert [line.split("  ")[0].strip() for line in lines[2:]] == (
        ["Channel", "/hiros/optimized", "/hiros/filtered"] * ((len(lines) - 2) // 3)
    )
    cells = " ".join(lines).split()
    assert [cells.count(cell) for row in ROWS for cell in row[1:]] == [1] * 6


def test_what_the_terminal_has_no_room_for_follows_below():
    assert [line.split() for line in shown(44)[2:]] == [
        ["Channel", "Mean", "error", "Upper", "limbs"],
        ["/hiros/optimized", "25.1", "32.7"],
        ["/hiros/filtered", "20.2", "26.7"],
        ["Channel", "Lower", "limbs"],
        ["/hiros/optimized", "30.4"],
        ["/hiros/filtered", "23.7"],
    ]


def test_zero_has_no_sign():
    assert [number(value, 1) for value in (-0.04, -0.06, math.nan)] == ["0.0", "-0.1", "-"]
