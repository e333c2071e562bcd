"""A reproduced paper on the terminal and as a page: its tables, and whether its claims hold."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.text import Text

from hiros_cli.run_report import console
from hiros_cli.run_report import table as text_table
from hiros_viewer.page import Page

Rows = list[tuple[str, ...]]
TEXT_COLUMNS = ("Action", "Joint", "Variant")
"""Aligned to the left, as the first column; all others are numbers."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table of a paper, with our numbers beside the published ones."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Claim:
    """Something that a paper says, and whether it holds here."""

    text: str
    holds: bool
    detail: str


@dataclass(frozen=True, slots=True)
class PaperReport:
    """Everything that is reproduced of a paper."""

    title: str
    note: str
    """Where the published numbers come from."""
    tables: Sequence[Table]
    claims: Sequence[Claim]

    def show(self) -> None:
        """Print the report."""
        out = console()
        out.print(Text(f"{self.title}; {self.note}", style="bold"), soft_wrap=True)
        for each in self.tables:
            out.print(Text(f"\n{each.title}", style="bold"), soft_wrap=True)
            columns = (
                name if k == 0 or name in TEXT_COLUMNS else f">{name}"
                for k, name in enumerate(each.header)
            )
            out.print(text_table(*columns, rows=each.rows))
        for claim in self.claims:
            verdict = "holds" if claim.holds else "DOES NOT HOLD"
            out.print(Text(f"{verdict}: {claim.text}: {claim.detail}"), soft_wrap=True)

    def page(self) -> Page:
        """Return the report as a page."""
        page = Page(self.title)
        page.text(self.note)
        for each in self.tables:
            page.heading(each.title)
            page.table(each.header, each.rows)
        if self.claims:
            page.heading("What the paper claims")
            page.table(
                ["claim", "", "here"],
                [[c.text, "holds" if c.holds else "does not hold", c.detail] for c in self.claims],
            )
        return page

    def present(self, html: Path | None) -> None:
        """Print the report, and write it as a page if that is wanted."""
        self.show()
        if html is not None:
            self.page().write(html)


def arguments(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options that all papers have."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, default=0, help="processes at once; 0 = one per core")
    parser.add_argument("--html", type=Path, help="also write a page")
    return parser


def check_order(text: str, values: Mapping[str, float], names: Sequence[str]) -> Iterator[Claim]:
    """Claim that values rise in the order of ``names``; nothing if one of them is not known.

    With "<=" in the text, values may fall by 0.05, which is what the papers' digits hide.
    """
    if not set(names) <= set(values) or any(np.isnan(values[n]) for n in names):
        return
    allowed = 0.05 if "<=" in text else 0.0
    ours = [values[n] for n in names]
    holds = all(a <= b + allowed for a, b in pairwise(ours))
    detail = ", ".join(f"{n} {v:.1f} mm" for n, v in zip(names, ours, strict=True))
    yield Claim(text, holds, detail)


def mean(values: Iterator[float]) -> float:
    """Mean; NaN of nothing."""
    numbers = list(values)
    return float(np.mean(numbers)) if numbers else float("nan")
