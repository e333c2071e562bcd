"""How far something is, for people: a bar on a terminal or in a notebook, else a line a minute."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Event, Thread
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID


class Progress(Protocol):
    """Follows how far a run is."""

    def update(self, done: int, total: int) -> None:
        """Take note that ``done`` of ``total`` is done, in whatever unit; of a log, ns."""


MINUTE_S = 60.0
"""s between two lines where there is no terminal."""


@dataclass(frozen=True, slots=True)
class Bar:
    """Shows how far a run is; a bar without ``progress`` shows nothing."""

    progress: RichProgress | None = None
    task: TaskID | None = None
    live: bool = False  # whether a log has no end yet: then it shows how much of it has come

    def update(self, done: int, total: int) -> None:
        """Say that ``done`` of ``total`` is done, in whatever unit; of a live log, ns."""
        if self.progress is None or self.task is None:
            return
        if self.live:
            self.progress.update(self.task, description=f"live, {done * 1e-9:.0f} s of log")
        else:
            self.progress.update(self.task, completed=done, total=total)


@dataclass(slots=True)
class JobLines:
    """Says once a minute how far a run is, where there is no terminal: in the log of a job."""

    label: str
    share: float = 0.0

    def update(self, done: int, total: int) -> None:
        """Say that ``done`` of ``total`` is done."""
        self.share = done / total if total else 0.0

    def tell(self, ended: Event, interval_s: float) -> None:
        """Print a line on stderr at each interval until ``ended``."""
        minutes = 0
        while not ended.wait(interval_s):
            minutes += 1
            share = f"{self.share:.0%} after " if self.share else ""
            sys.stderr.write(f"hiros: {self.label}: {share}{minutes} min\n")
            sys.stderr.flush()


@contextmanager
def bar(
    label: str, *, quiet: bool, notebook: bool = False, live: bool = False
) -> Iterator[Progress]:
    """Show a bar with the time on stderr until the end.

    The time is what remains, or what has passed as long as nobody says how much there is to do.
    Without a terminal there is a line a minute, but none from a library (``notebook``), which has
    a bar in a notebook alone.
    """
    shown_on = None if quiet else _console(notebook=notebook)
    if shown_on is None:
        lines = JobLines(label)
        if quiet or notebook or live:
            yield lines
            return
        ended = Event()
        teller = Thread(target=lines.tell, args=(ended, MINUTE_S), daemon=True)
        teller.start()
        try:
            yield lines
        finally:
            ended.set()
            teller.join()  # no line comes after the end
        return
    from rich.progress import (
        BarColumn,
        Progress,
        Task,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Time(TimeRemainingColumn):
        def render(self, task: Task) -> Text:
            return super().render(task) if task.total else TimeElapsedColumn().render(task)

    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        Time(),
        console=shown_on,
        transient=True,
        refresh_per_second=10 if shown_on.color_system else 2,  # a notebook keeps every state
    ) as progress:
        yield Bar(progress, progress.add_task(label, total=None), live)


def _console(*, notebook: bool) -> Console | None:
    """Return where a bar can be seen, if anywhere."""
    from rich.console import Console

    if sys.stderr.isatty() and os.environ.get("TERM") != "dumb":
        return Console(stderr=True)
    if notebook and "ipykernel" in sys.modules:
        # Not rich's own way, which shows nothing unless ipywidgets are installed.
        return Console(
            stderr=True,
            color_system=None,
            force_jupyter=False,
            force_terminal=True,
            width=80,
        )
    return None
