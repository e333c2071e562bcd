"""Tables I and II of Malaguti et al. (2019) on logs with a truth.

    python benchmarks/papers/malaguti_2019.py LOG [LOG ...] [--jobs N] [--html FILE]

The paper's numbers stand beside ours. They come from other data: Kinects v2, and markers as truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from paper_report import Claim, PaperReport, Rows, Table, arguments, check_order, mean
from published import MALAGUTI, MALAGUTI_COLUMNS, MALAGUTI_MS_PER_PERSON

from hiros_mcap.evaluate.comparison import Entry, Outcome, Task, comparison

MOST_PEOPLE = 6


def error_table(outcomes: Sequence[Outcome]) -> Table:
    """Table I: mean +- SD in cm, a row per log, the paper's rows below."""
    rows: Rows = []
    for log in dict.fromkeys(o.log for o in outcomes):
        scores = {o.name: o.scores for o in outcomes if o.log == log and o.scores is not None}
        cells = [
            _cm(scores[c].mean / 10, scores[c].deviation / 10) if c in scores else "-"
            for c in MALAGUTI_COLUMNS
        ]
        rows.append((log, *cells))
    rows += [
        (f"paper: {name}", *(_cm(*pair) for pair in pairs)) for name, pairs in MALAGUTI.items()
    ]
    means = np.array(list(MALAGUTI.values())).mean(axis=0)
    rows.append(("paper: mean", *(_cm(*pair) for pair in means)))
    return Table("Table I: joint error, cm", ("Sequence", *MALAGUTI_COLUMNS), rows)


def _cm(error: float, deviation: float) -> str:
    return f"{error:.2f} +- {deviation:.2f}"


def time_table(outcomes: Sequence[Outcome]) -> Table:
    """Table II: time for 1 to 6 people, by the mean time that one person takes."""
    each = mean(
        o.milliseconds / o.people for o in outcomes if o.name == "malaguti" and o.people > 0
    )
    rows: Rows = []
    for n in range(1, MOST_PEOPLE + 1):
        ours, paper = n * each, n * MALAGUTI_MS_PER_PERSON
        rows.append(
            (str(n), f"{ours:.3f}", f"{1000 / ours:.0f}", f"{paper:.1f}", f"{1000 / paper:.1f}")
        )
    header = ("People", "ms per message", "messages/s", "paper: ms", "paper: frames/s")
    return Table("Table II: time of malaguti, by a line (paper: i7-4770)", header, rows)


def check_claims(outcomes: Sequence[Outcome]) -> Iterator[Claim]:
    """Check the order of the systems in Table I."""
    errors = {
        name: mean(o.scores.mean for o in outcomes if o.name == name and o.scores is not None)
        for name in dict.fromkeys(o.name for o in outcomes)
    }
    order = ("malaguti", "raw", "openptrack", "maf")
    yield from check_order("Table I: malaguti < raw < openptrack < maf", errors, order)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG")
    given = parser.parse_args()
    tasks = [Task(log, Entry(name)) for log in given.logs for name in MALAGUTI_COLUMNS]
    outcomes = comparison(tasks, jobs=given.jobs)
    PaperReport(
        "Malaguti et al. 2019",
        "the paper's numbers come from other data: Kinects v2, a marker-based system as truth",
        [error_table(outcomes), time_table(outcomes)],
        list(check_claims(outcomes)),
    ).present(given.html)


if __name__ == "__main__":
    main()
