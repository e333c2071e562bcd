"""``hiros compare``: a page with plots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap._version import __version__
from hiros_mcap.evaluate.comparison import Outcome, by_number_of_cameras
from hiros_mcap.evaluate.measures import text_of
from hiros_mcap.evaluate.score_tables import (
    best_first,
    camera_sheet,
    differences_of,
    has_truth,
    notes_on,
    system_table,
)
from hiros_mcap.summary import number
from hiros_viewer.figures import name_ends, new_axes, new_figure, tidy, value_bars
from hiros_viewer.page import Page

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def comparison_page(outcomes: Sequence[Outcome], study: str | None) -> Page:
    """Page with the systems on every log, or their errors by number of cameras."""
    page = Page("Systems compared", [f"hiros {__version__}"])
    if study == "cameras":
        errors = by_number_of_cameras(outcomes)
        page.heading("Number of cameras")
        sheet = camera_sheet(errors)
        page.table(*text_of(sheet), sheet.title)
        page.figure(_camera_figure(errors), "Mean joint error by number of cameras")
        return page
    for log in dict.fromkeys(o.log for o in outcomes):
        group = [o for o in outcomes if o.log == log]
        page.heading(log)
        if has_truth(group):
            best = best_first(group)[0]
            page.text(f"Least error: {best.name}, {number(best.error, 1, ' mm')}.")
            page.table(*system_table(group), "Least error first; mm, degrees, ms")
            page.figure(_error_bars(group), "Mean joint error; the line is its standard deviation")
        else:
            page.table(*system_table(group), "Distances and jitter in mm")
            for text in notes_on(group):
                page.text(text)
            page.figure(_self_bars(group), "Systems in the order in which they were named")
        for line in differences_of(group):
            page.text(line)
    return page


def _error_bars(outcomes: Sequence[Outcome]) -> Figure:
    ordered = best_first(outcomes)
    figure, axes = new_axes(8, 0.32 * len(ordered) + 0.9)
    deviations = [np.nan if o.scores is None else o.scores.deviation for o in ordered]
    value_bars(axes, [o.name for o in ordered], [o.error for o in ordered], deviations)
    axes.set_xlabel("mm")
    return figure


def _self_bars(outcomes: Sequence[Outcome]) -> Figure:
    """Plot what each system does without a truth; none of it alone says who is best."""
    figure = new_figure(10, 0.32 * len(outcomes) + 1.1)
    shown = {
        "disagreement with the camera left out, mm": [o.disagreement for o in outcomes],
        "jitter, mm": [o.jitter for o in outcomes],
        "limb-length variation, %": [100 * o.limb_variation for o in outcomes],
    }
    for axes, (label, values) in zip(
        figure.subplots(1, len(shown), sharey=True), shown.items(), strict=True
    ):
        tidy(axes)
        value_bars(axes, [o.name for o in outcomes], values, None)
        axes.set_xlabel(label)
    return figure


def _camera_figure(table: dict[str, dict[int, tuple[float, float]]]) -> Figure:
    figure, axes = new_axes(7, 3.4)
    for name, row in table.items():
        sizes = sorted(row)
        axes.plot(sizes, [row[size][0] for size in sizes], marker="o", label=name)
    axes.set(xlabel="cameras", ylabel="mm", ylim=(0, None))
    axes.set_xticks(sorted({size for row in table.values() for size in row}))
    name_ends(axes)
    return figure
