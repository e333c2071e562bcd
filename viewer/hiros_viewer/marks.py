"""Where curves are to be doubted: bands over the plots, and their times in words above them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hiros_mcap.events import Event, hidden_times
from hiros_mcap.skeletons import Flags, Floats
from hiros_mcap.summary import number
from hiros_viewer.figures import PAUSE_S

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = {"hidden": "#f0b429", "predicted": "#d64545", "gap": "#9aa4af"}
"""Of the bands, which lie below the curves."""
_WORDS = {
    "hidden": "Yellow: hidden",
    "predicted": "Red: no camera sees the person, who is predicted",
    "gap": "Grey: not in the result",
}
BAND = "band"
"""Marks the bands of a figure for the page that draws it anew."""


class Mark(NamedTuple):
    """A span of one person's curves."""

    kind: str
    """A key of :data:`COLOURS`."""
    start: float
    """s since the channel's first frame."""
    end: float
    remark: str = ""


def hidden_marks(events: Sequence[Event], person: int, start: int) -> Iterator[Mark]:
    """Yield when somebody was hidden from a camera, and behind whom; ``start`` in ns."""
    for time in hidden_times(events, person, start):
        yield Mark("hidden", time.begin, time.end, f"{time.behind} for {time.source}")


def marks_of(seconds: Floats, is_predicted: Flags) -> Iterator[Mark]:
    """Yield spans without frames, and those whose frames (T,) nobody saw."""
    for k in np.flatnonzero(np.diff(seconds) > PAUSE_S).tolist():
        yield Mark("gap", float(seconds[k]), float(seconds[k + 1]))
    breaks = (np.diff(is_predicted.astype(int)) != 0) | (np.diff(seconds) > PAUSE_S)
    for run in np.split(np.arange(len(seconds)), np.flatnonzero(breaks) + 1):
        if len(run) and is_predicted[run[0]]:
            yield Mark("predicted", float(seconds[run[0]]), float(seconds[run[-1]]))


def in_words(marks: Sequence[Mark]) -> list[str]:
    """Return a line for each kind of mark: what its colour means, and when it is."""
    lines = []
    for kind, words in _WORDS.items():
        spans = [
            f"{number(mark.start, 1)} to {number(mark.end, 1)} s"
            + (f" ({mark.remark})" if mark.remark else "")
            for mark in marks
            if mark.kind == kind
        ]
        if spans:
            lines.append(f"{words}: {', '.join(spans)}.")
    return lines


def marked(figure: Figure, marks: Sequence[Mark]) -> Figure:
    """Draw the marks as bands over the whole height of all plots of a figure."""
    for axes in figure.axes:
        limits = axes.get_xlim()
        for mark in marks:
            colour = COLOURS[mark.kind]
            axes.axvspan(mark.start, mark.end, gid=BAND, color=colour, alpha=0.25, lw=0, zorder=0)
        axes.set_xlim(limits)
    return figure
